"""Files of a tile's cells and of their overviews: Parquet, byte planes under LZ4 by roadscan's writer.

Of 0.95 million cells of 5 mm, each of 25 readings of one pass, all columns take 20 ns of a core and 27.5 bytes a cell
(Parquet's general writer: 60 ns and 26.8 bytes under ZSTD 1, 44 ns and 27.8 bytes under LZ4), a surface 8 ns and 5.8.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, StoreError
from roadscan.core.grid import TileId
from roadscan.core.survey import CellColumns
from roadscan.store.damage import UNREADABLE
from roadscan.store.manifest import OutputRecord, recorded_table
from roadscan.store.readings.group_reader import opened
from roadscan.store.schema import table_schema
from roadscan.store.store import MADE_AGAIN, Store
from roadscan.tiles.cells import CellValues, TileCells
from roadscan.tiles.pyramid import Level

if TYPE_CHECKING:
    from roadscan.store.codecs.parquet.number_table import Lists

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
_GROUP_ROWS: Final = 1 << 20  # Rows in a row group.


def write_cells(path: Path, cells: TileCells, columns: CellColumns = "full") -> None:
    """Write a tile's cells; same cells, same bytes."""
    from roadscan.store.codecs.parquet.number_table import write_number_groups

    schema, n = _stored("cells", columns), len(cells)
    groups = (_rows_of(cells, schema, k, min(k + _GROUP_ROWS, n)) for k in range(0, n, _GROUP_ROWS))
    write_number_groups(path, schema, groups, _ROUNDED if columns == "surface" else None, _PLACES)


def _rows_of(cells: TileCells, schema: pa.Schema, first: int, end: int) -> dict[str, npt.NDArray[Any] | Lists]:
    """Return the columns of the cells `first` to `end` − 1."""
    from roadscan.store.codecs.parquet.number_table import Lists

    found: dict[str, npt.NDArray[Any] | Lists] = {}
    for field in schema:
        if pa.types.is_list(field.type):
            offsets = cells.pass_offsets[first : end + 1]
            found[field.name] = Lists(np.diff(offsets).astype(np.int64), cells.pass_ids[offsets[0] : offsets[-1]])
        else:
            found[field.name] = getattr(cells, field.name)[first:end].astype(field.type.to_pandas_dtype(), copy=False)
    return found


def write_overviews(path: Path, levels: Sequence[Level]) -> None:
    """Write a tile's overviews with a row group per level, so that one can be read without the others."""
    from roadscan.store.codecs.parquet.number_table import write_number_groups

    schema = _stored("overviews", "full")
    groups = (
        {n: getattr(one, n) for n in schema.names[1:]} | {"factor": np.full(len(one), one.factor, np.uint16)}
        for one in levels
    )
    write_number_groups(path, schema, groups, _ROUNDED, _PLACES)


def read_cells(store: Store, record: OutputRecord, cells_per_edge: int) -> TileCells:
    """Return the cells of a finished tile; columns missing in a ``surface`` are NaN, and it names no passes."""
    rows = recorded_table(store, record)
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


def read_values(store: Store, record: OutputRecord, cells_per_edge: int, name: str) -> CellValues:
    """Return one column of the cells of a finished tile; NaN where a ``surface`` lacks it."""
    rows = recorded_table(store, record, ("column", "row", name))
    column, row = (rows.column(one).to_numpy() for one in ("column", "row"))
    known = name in rows.column_names
    return CellValues(
        cells_per_edge, column, row, rows.column(name).to_numpy() if known else np.full(column.size, np.nan, np.float32)
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
        source = opened(store, record.path)
        with source.stream as stream:
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
