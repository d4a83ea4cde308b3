"""Statistics of a tile's cells, overviews of them in ever larger pixels, and their files.

Files are Parquet, byte planes under LZ4 by roadscan's writer. Of 0.95 million cells of 5 mm, each of 25 readings of one
pass, all columns take 20 ns of a core and 27.5 bytes a cell (Parquet's general writer: 60 ns and 26.8 bytes under ZSTD
1, 44 ns and 27.8 bytes under LZ4), a surface 8 ns and 5.8.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError, DamagedError, StoreError
from roadscan.core.grid import TileId
from roadscan.core.survey import CellColumns
from roadscan.store.digest import UNREADABLE
from roadscan.store.manifest import OutputRecord, recorded_table
from roadscan.store.readings.row_groups import opened
from roadscan.store.schema import table_schema
from roadscan.store.store import MADE_AGAIN, Store
from roadscan.tiles.kernels.pyramid import Levels, Pixels, reduce_cells

if TYPE_CHECKING:
    from roadscan.store.codecs.parquet.tables import Lists


@dataclass(frozen=True)
class TileCells:
    """Cells of one tile with at least one point, in order of row and column; columns as in ``schemas/cells.toml``.

    All arrays are (n,); heights are metres in the map frame.
    """

    tile: TileId
    cells_per_edge: int
    column: npt.NDArray[np.uint16]
    """Column counted from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row counted from the south edge."""
    count: npt.NDArray[np.uint32]
    height_mean_m: npt.NDArray[np.float64]
    height_robust_m: npt.NDArray[np.float64]
    height_min_m: npt.NDArray[np.float64]
    height_max_m: npt.NDArray[np.float64]
    height_std_m: npt.NDArray[np.float32]
    intensity_mean: npt.NDArray[np.float32]
    pass_count: npt.NDArray[np.uint16]
    pass_offsets: npt.NDArray[np.int32]
    """(n + 1,): the passes of cell i are ``pass_ids[pass_offsets[i]:pass_offsets[i + 1]]``."""
    pass_ids: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return int(self.column.size)

    def raster(self, name: str) -> npt.NDArray[np.float32]:
        """Return a (rows, columns) float32 image of one quantity, north up, NaN where no point lies.

        Parameters
        ----------
        name : a column such as ``"height_robust_m"`` or ``"count"``.
        """
        image = np.full((self.cells_per_edge, self.cells_per_edge), np.nan, dtype=np.float32)
        image[self.cells_per_edge - 1 - self.row.astype(np.int64), self.column] = getattr(self, name)
        return image


class CellValues(NamedTuple):
    """One column of a tile's cells; arrays are (n,), in the order of :class:`TileCells`."""

    cells_per_edge: int
    column: npt.NDArray[np.uint16]
    """Column counted from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row counted from the south edge."""
    values: npt.NDArray[Any]


@dataclass(frozen=True)
class TileEvidence:
    """Epochs of a tile's readings, and σ of the poses that georeferenced them."""

    first_epoch_gps_ns: int
    last_epoch_gps_ns: int
    sigma_horizontal_m: float
    """Largest 1 σ of the poses; NaN where a trajectory does not state it."""
    sigma_down_m: float


WANTED_FACTORS: Final = (2, 8, 32)
"""Cells along an edge of a pixel: cells of 5 mm become pixels of 10, 40 and 160 mm."""

LARGEST_FACTOR: Final = 256
"""Largest factor: sums stay exact while a pixel's cells, times their height above the first cell, are below 2²¹ m."""


@dataclass(frozen=True)
class Level:
    """Pixels of one overview with at least one point, in order of row and column; all arrays are (n,)."""

    factor: int
    """Cells of the tile along an edge of a pixel."""
    column: npt.NDArray[np.uint16]
    """Column of the pixel in its tile, from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row of the pixel in its tile, from the south edge."""
    count: npt.NDArray[np.uint32]
    """Number of points in the pixel."""
    cells: npt.NDArray[np.uint32]
    """Number of cells of the pixel with a point."""
    height_m: npt.NDArray[np.float64]
    """Mean of the robust heights of those cells, each counted once, rounded to 2⁻³² m before summation."""
    intensity: npt.NDArray[np.float32]
    """Mean intensity of the pixel's points."""

    def __len__(self) -> int:
        return int(self.column.size)


@functools.cache
def overview_factors(cells_per_edge: int, wanted: tuple[int, ...] = WANTED_FACTORS) -> tuple[int, ...]:
    """Return the factors of a tile's overviews: for each wanted one the nearest that fits, ascending.

    A factor fits if it divides the tile's edge, so that no pixel straddles two tiles, and is a multiple of the
    factor before it. Nearest is by ratio, the smaller of two equally near. 10 m tiles with cells of 5 mm get
    2, 8 and 40 (10, 40 and 200 mm; 160 mm does not divide 10 m); tiles of 8 or 16 m get 2, 8 and 32. A wanted
    factor is left out where none within twice or half of it fits.
    """
    found: list[int] = []
    for near in wanted:
        last = found[-1] if found else 1
        fits = [
            f
            for f in range(2 * last, min(2 * near, cells_per_edge, LARGEST_FACTOR) + 1, last)
            if cells_per_edge % f == 0 and 2 * f >= near
        ]
        if fits:
            found.append(min(fits, key=lambda f: (max(f / near, near / f), f)))
    return tuple(found)


def pyramid_of(cells: TileCells, factors: Sequence[int]) -> list[Level]:
    """Compute overviews of a tile by `factors`, in that order; the result does not depend on the other factors.

    Sums are of whole units: heights of 2⁻³² m, intensities of digital numbers (a cell's mean times its count,
    rounded: exact up to 128 readings of 65,535 a cell). Raises :class:`ConfigError` for factors that do not
    divide the tile's edge or are not ascending multiples of one another.
    """
    from roadscan.tiles.kernels.pyramid import Cells

    edge = cells.cells_per_edge
    _check(edge, factors)
    if not factors:
        return []
    steps = np.array(factors, np.int64)
    edges = edge // steps
    rooms = np.minimum(edges * edges, len(cells))
    ends = np.cumsum(rooms)
    starts, total = ends - rooms, int(ends[-1])
    column, row = np.empty(total, np.uint16), np.empty(total, np.uint16)
    count, covered = np.empty(total, np.uint32), np.empty(total, np.uint32)
    height, intensity = np.empty(total, np.float64), np.empty(total, np.float32)
    written = np.zeros(len(factors), np.int64)
    base = float(np.rint(cells.height_robust_m[0])) if len(cells) else 0.0
    held = Cells(
        cells.column, cells.row, read_only(cells.height_robust_m), cells.intensity_mean, cells.count
    )  # fmt: skip
    pixels = Pixels(column, row, count, covered, height, intensity)
    reduce_cells(held, base, Levels(steps, edges, starts, written), np.zeros((len(factors), 4, edges[0])), pixels)
    levels: list[Level] = []
    for factor, start, size in zip(factors, starts.tolist(), written.tolist(), strict=True):
        own = slice(start, start + size)
        levels.append(Level(factor, column[own], row[own], count[own], covered[own], height[own], intensity[own]))
    return levels


def _check(edge: int, factors: Sequence[int]) -> None:
    for before, factor in itertools.pairwise((1, *factors)):
        if not before < factor <= LARGEST_FACTOR or factor % before or math.gcd(edge, factor) != factor:
            raise ConfigError(
                f"overviews by {', '.join(map(str, factors))} of a tile of {edge} cells",
                expected=f"ascending factors up to {LARGEST_FACTOR} that divide the tile and one another",
                change="use overview_factors(cells_per_edge)",
            )


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
    from roadscan.store.codecs.parquet.tables import write_number_groups

    schema, n = _stored("cells", columns), len(cells)
    groups = (_rows_of(cells, schema, k, min(k + _GROUP_ROWS, n)) for k in range(0, n, _GROUP_ROWS))
    write_number_groups(path, schema, groups, _ROUNDED if columns == "surface" else None, _PLACES)


def _rows_of(cells: TileCells, schema: pa.Schema, first: int, end: int) -> dict[str, npt.NDArray[Any] | Lists]:
    """Return the columns of the cells `first` to `end` − 1."""
    from roadscan.store.codecs.parquet.tables import Lists

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
    from roadscan.store.codecs.parquet.tables import write_number_groups

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


MOST_CELL_BYTES: Final = 800 << 20
"""Memory that the cells of active tiles may take (bytes)."""
