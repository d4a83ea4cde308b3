"""Files of a tile's cells and of their overviews: Parquet, in the encodings that were fastest and smallest.

Surfaces and overviews go through `roadscan/store/plane_table.py`: byte planes under LZ4 take 17 ns of one core and
5.8 bytes a cell of the line-rate pair (Parquet's general writer and ZSTD: 42 ns, 5.2 bytes). Of full tables, measured
on 1.6 million cells of 5 mm (plain bytes: 4.5 ns): rows and columns as plain numbers under ZSTD 4 and 6 ns (delta
packing 8 and 8, dictionary 8 and 14); counts split into byte planes under ZSTD 8 ns, 0.6 B (delta packing 11, 0.7;
plain 24, 0.9); heights in byte planes 16 ns, 5.0 B (plain 34, 2.1 when rounded).
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, StoreError
from roadscan.core.ids import TileId
from roadscan.core.survey import CellColumns
from roadscan.store.codecs.parquet.number_table import write_number_groups
from roadscan.store.damage import UNREADABLE
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.store import MADE_AGAIN, Store
from roadscan.tiles.cells import TileCells
from roadscan.tiles.pyramid import Level

HEIGHT_STEP_M: Final = 2.0**-20
"""Heights of surfaces and overviews are rounded to multiples of this (0.95 µm)."""

INTENSITY_STEP: Final = 2.0**-6
"""Intensities of surfaces and overviews are rounded to multiples of this."""

_ROUNDED: Final = {
    "height_robust_m": HEIGHT_STEP_M,
    "height_m": HEIGHT_STEP_M,
    "intensity_mean": INTENSITY_STEP,
    "intensity": INTENSITY_STEP,
}
_PLACES: Final = ("factor", "row", "column")
_LISTS: Final = "passes.list.element"
_GROUP_ROWS: Final = 1 << 20  # Rows in a row group.


def cells_table(cells: TileCells, columns: CellColumns = "full") -> pa.Table:
    """Return cells as rows of ``schemas/cells.toml``; a ``surface`` has only the mandatory columns, rounded."""
    schema = _stored("cells", columns)
    if columns == "surface":
        return pa.table([_rounded(n, getattr(cells, n)) for n in schema.names], schema=schema)
    passes = pa.ListArray.from_arrays(cells.pass_offsets, cells.pass_ids, type=schema.field("passes").type)
    return pa.table([passes if n == "passes" else getattr(cells, n) for n in schema.names], schema=schema)


def overviews_table(levels: Sequence[Level]) -> pa.Table:
    """Return overviews as rows of ``schemas/overviews.toml``, heights and intensities rounded."""
    schema = _stored("overviews", "full")
    parts = [
        pa.table(
            [np.full(len(one), one.factor, np.uint16), *(_rounded(n, getattr(one, n)) for n in schema.names[1:])],
            schema=schema,
        )
        for one in levels
    ]
    return pa.concat_tables([schema.empty_table(), *parts])


def write_cells(path: Path, cells: TileCells, columns: CellColumns = "full") -> None:
    """Write a tile's cells; same cells, same bytes."""
    if columns == "surface":
        schema, n = _stored("cells", columns), len(cells)
        held = {name: getattr(cells, name) for name in schema.names}
        groups = [
            {name: values[k : k + _GROUP_ROWS] for name, values in held.items()} for k in range(0, n, _GROUP_ROWS)
        ]
        write_number_groups(path, schema, groups, _ROUNDED, _PLACES)
        return
    rows = cells_table(cells, columns)
    with pq.ParquetWriter(path, rows.schema, **_settings(rows.schema)) as writer:
        writer.write_table(rows, row_group_size=_GROUP_ROWS)


def write_overviews(path: Path, levels: Sequence[Level]) -> None:
    """Write a tile's overviews with a row group per level, so that one can be read without the others."""
    schema = _stored("overviews", "full")
    groups = (
        {n: getattr(one, n) for n in schema.names[1:]} | {"factor": np.full(len(one), one.factor, np.uint16)}
        for one in levels
    )
    write_number_groups(path, schema, groups, _ROUNDED, _PLACES)


def read_cells(store: Store, record: OutputRecord, cells_per_edge: int) -> TileCells:
    """Return the cells of a finished tile; columns missing in a ``surface`` are NaN, and it names no passes."""
    rows = store.parse_table(read_recorded(store, record), record.path)
    n = rows.num_rows
    known: dict[str, Any] = {name: rows.column(name).to_numpy() for name in rows.column_names if name != "passes"}
    for column in table_schema("cells").columns:
        if column.nullable and column.name not in known and not column.is_list:
            kind = np.dtype(column.type)
            known[column.name] = np.full(n, np.nan if kind.kind == "f" else 0, kind)
    if "passes" in rows.column_names:
        passes = rows.column("passes").combine_chunks()
        offsets, ids = passes.offsets.to_numpy(), passes.values.to_numpy()
    else:
        offsets, ids = np.zeros(n + 1, np.int32), np.empty(0, np.uint16)
    return TileCells(
        tile=TileId.parse(record.unit), cells_per_edge=cells_per_edge, pass_offsets=offsets, pass_ids=ids, **known
    )


def read_overview(store: Store, record: OutputRecord, factor: int) -> Level:
    """Return one overview of a finished tile; only its part of the file is read and checked, by size and checksums.

    Raises
    ------
    DamagedError
        It is not.
    """
    path = store.path(record.path)
    try:
        with store.fs.open(path, "rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            if record.bytes and size != record.bytes:
                raise DamagedError(f"the file has {size} bytes of {record.bytes}", change=MADE_AGAIN, file=path)
            file = pq.ParquetFile(stream, page_checksum_verification=True)
            held = {int(file.metadata.row_group(k).column(0).statistics.min): k for k in range(file.num_row_groups)}
            rows = file.read_row_group(held[factor], use_threads=False) if factor in held else None
    except UNREADABLE as error:
        raise DamagedError(f"the file is damaged: {error}", change=MADE_AGAIN, file=path) from error
    if rows is None:
        raise StoreError(
            f"there is no overview of {factor} cells a pixel",
            expected=", ".join(map(str, sorted(held))) or "none: the tile is too small for overviews",
            file=path,
        )
    return Level(factor, **{f.name: rows.column(f.name).to_numpy() for f in dataclasses.fields(Level)[1:]})


@functools.cache
def _stored(table: str, columns: CellColumns) -> pa.Schema:
    schema = table_schema(table).arrow()
    if columns == "full":  # all columns are present without nulls: levels of nulls would take time
        return pa.schema([f.with_nullable(False) for f in schema])
    return pa.schema([f for f in schema if not f.nullable])


def _rounded(name: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    step = _ROUNDED.get(name)
    if step is None:
        return values
    rounded: npt.NDArray[Any] = values * values.dtype.type(1 / step)
    np.rint(rounded, out=rounded)
    rounded *= values.dtype.type(step)
    return rounded


def _settings(schema: pa.Schema) -> dict[str, Any]:
    """Return encodings by column: plain for places, which repeat; byte planes for all else; dictionaries for lists."""
    planes = {f.name: "BYTE_STREAM_SPLIT" for f in schema if f.name not in (*_PLACES, "pass_count", "passes")}
    return {
        "compression": "zstd",
        "compression_level": 1,
        "use_dictionary": [n for n in ("pass_count", _LISTS) if n.split(".")[0] in schema.names],
        "column_encoding": planes,
        "write_statistics": [n for n in _PLACES if n in schema.names],
    }
