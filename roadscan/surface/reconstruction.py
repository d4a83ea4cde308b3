"""The surface of a tile, from the tiles' cells or from points: the margin it needs, raw heights, smoothing.

A tile is computed on a window that reaches beyond it: by the cells of the neighbours that products read
(:data:`SHOWN_M`; before smoothing, where they ask for more, farther), by those that smoothing depends on, and, for
points, by those that triangles depend on. The outer ones are cut off again, so all that is left has the same bits in
every tile that sees it.

Detailed model: a smooth surface through every point of a region, evaluated on a fine grid.

Stages, each a module: ``sites`` (order, duplicates), ``triangulation`` (Delaunay, holes left open), ``normals``
(slopes), ``clough_tocher`` (cubic triangles, and their heights on a grid).

Seams: a height depends on points within :attr:`DetailedSettings.halo_m` only. Two regions that both hold all points
within that distance of a node give it the same height, to the bit, whatever else they hold and in whatever order.

Filling of holes in a gridded surface, up to a stated width.

A hole is a run of empty cells between two known ones, along a row or a column, of at most that width. It is filled as
the coarse model fills one (``surface/regions.py``): by the straight line between the mean heights of the last three
known cells on each side. A cell that lies in such a run both ways gets the line of the shorter one, of two of the same
length the mean. Heights that were there stay as they are, and nothing goes beyond the border of what was measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Bool, Float32, Float64, Int64
from roadscan.core.grid import QUANTUM_M, Bounds, TileGrid, TileId
from roadscan.core.strict import Strict
from roadscan.georeference.cloud import TilePoints
from roadscan.surface.heights import LowestReadings
from roadscan.surface.regions import FILLED, INTERPOLATED, MEASURED
from roadscan.surface.settings import SlopeKind, SurfaceConfig, SurfaceSmoothing
from roadscan.surface.smoothing import halo_cells, smooth_surface
from roadscan.surface.tile import EMPTY, GridWindow, SurfaceTile
from roadscan.surface.triangulation import sites, triangulate
from roadscan.tiles.cells import TileCells

if TYPE_CHECKING:
    pass


RIM: Final = 3
"""Known cells on each side to which a line is fitted."""


def cells_across(fill_m: float, cell_m: float) -> int:
    """Returns the number of empty cells in the widest hole that is filled."""
    return math.floor(fill_m / cell_m + 1e-9)


@dataclass(frozen=True)
class Holes:
    """The filled cells: (n,) places in the flat grid, by the runs in which they lie."""

    shape: tuple[int, int]
    rows: _Runs
    columns: _Runs

    @classmethod
    def of(cls, known: Bool, most: tuple[int, int]) -> Holes:
        """Returns the holes of a grid.

        Parameters
        ----------
        known : (rows, columns), True where the grid has a height.
        most : cells in the widest hole along a column (northwards), and along a row (eastwards).
        """
        rows, columns = known.shape
        return cls((rows, columns), _Runs.of(known, most[1], columns, 1), _Runs.of(known.T, most[0], 1, columns))

    def filled(self) -> Bool:
        """Returns a mask (rows, columns) of the cells in a hole."""
        found = np.zeros(self.shape, bool)
        for runs in (self.rows, self.columns):
            found.flat[runs.cell] = True
        return found

    def fill(self, values: Float64) -> Float64:
        """Returns values (rows, columns) with the holes filled.

        A cell farther than the widest hole and its rim from the window's border has the same bits in every window.
        """
        found = values.copy()
        flat, width = found.reshape(-1), np.zeros(values.size, np.int32)
        across, down = self.rows.line(values.reshape(-1)), self.columns.line(values.reshape(-1))
        flat[self.rows.cell], width[self.rows.cell] = across, self.rows.width
        before = width[self.columns.cell]
        with_row = flat[self.columns.cell]
        mean = np.where(before == self.columns.width, 0.5 * (with_row + down), down)
        wider = (before > 0) & (before < self.columns.width)
        flat[self.columns.cell] = np.where(wider, with_row, mean)
        return found


@dataclass(frozen=True)
class _Runs:
    """Runs of empty cells along lines of the grid; places are those in the flat grid."""

    first: Int64
    """(k,) place of the known cell before each run; `last` the one after it."""
    last: Int64
    beside: Int64
    """(k,) number of known cells before the run without a gap, as its rim uses them; `beyond` those after it."""
    beyond: Int64
    step: int
    """Step in the flat grid from cell to cell of a line."""
    cell: Int64
    """(n,) cells of all runs, and the run of each."""
    run: Int64
    share: Float64
    """(n,) relative position of each cell between the rims, 0 to 1."""

    @property
    def width(self) -> Int64:
        """Returns (n,) the number of cells in the run of each cell."""
        width: Int64 = ((self.last - self.first) // self.step - 1)[self.run]
        return width

    @classmethod
    def of(cls, known: Bool, most: int, line_step: int, step: int) -> _Runs:
        """Returns the runs along the rows of `known`, whose cells lie `line_step` and `step` apart in the flat grid."""
        lines, cells = known.shape
        flat = np.zeros((lines, cells + 1), bool)  # a gap after each line
        flat[:, :-1] = known
        flat = flat.reshape(-1)
        edge = np.flatnonzero(flat[1:] != flat[:-1])
        edge = edge[int(flat.size > 0 and not flat[0]) :]  # from the end of a known run on
        end, begin = edge[0:-1:2], edge[1::2] + 1
        own = (begin - end - 1 <= most) & (end // (cells + 1) == begin // (cells + 1))
        beside, beyond = (_known_from(flat, at, away) for at, away in ((end[own], -1), (begin[own], 1)))
        first, last = (at // (cells + 1) * line_step + at % (cells + 1) * step for at in (end[own], begin[own]))
        size = begin[own] - end[own] - 1
        run = np.repeat(np.arange(size.size), size)
        place = np.arange(run.size) - np.repeat(np.cumsum(size) - size, size) + 1
        return cls(first, last, beside, beyond, step, first[run] + place * step, run, place / (size + 1)[run])

    def line(self, values: Float64) -> Float64:
        """Returns (n,) the straight line between the means of both rims, from a flat grid of values."""
        before = _rim(values, self.first, self.beside, -self.step)
        after = _rim(values, self.last, self.beyond, self.step)
        found: Float64 = before[self.run] + self.share * (after - before)[self.run]
        return found


def _known_from(flat: Bool, at: Int64, away: int) -> Int64:
    """Returns (k,) the number of known cells from a place on without a gap, at most :data:`RIM`."""
    count, goes_on = np.ones(at.size, np.int64), np.ones(at.size, bool)
    for k in range(1, RIM):
        there = at + away * k
        goes_on &= flat[np.clip(there, 0, flat.size - 1)] & (there >= 0)
        count += goes_on
    return count


def _rim(values: Float64, at: Int64, count: Int64, step: int) -> Float64:
    total = values[at]
    for k in range(1, RIM):
        inside = count > k
        total = total + np.where(inside, values[np.where(inside, at + k * step, at)], 0.0)
    return np.asarray(total / count)


SHOWN_M: Final = 1.15
"""Least margin of the neighbouring tiles that products read (m)."""

_BRIGHTEST: Final = 65_535.0  # Intensities are clipped to 16 bits.
_MOST_COUNTED: Final = 65_535  # Numbers of readings are clipped to 16 bits.
_CELLS_SMOOTHED: Final = 2_000_000
"""Approximate number of cells smoothed at once: smoothing needs 100 bytes of memory a cell."""


@dataclass(frozen=True)
class SurfaceGrid:
    """The cells of a survey's surface, and the margins that a tile needs."""

    tiles: TileGrid
    config: SurfaceConfig
    around_m: float = 0.0
    """Margin before smoothing that products read, at least (m)."""

    @property
    def cell_m(self) -> tuple[float, float]:
        """Returns the edges of a cell: east, north (m)."""
        return self.config.cell_m or (self.tiles.cell_m, self.tiles.cell_m)

    @property
    def shown(self) -> int:
        """Returns the cells of the neighbours that products read, on each side."""
        return math.ceil(SHOWN_M / min(self.cell_m) - 1e-9)

    @property
    def around(self) -> int:
        """Returns the cells of the neighbours that products read before smoothing, on each side."""
        return max(self.shown, math.ceil(self.around_m / min(self.cell_m) - 1e-9))

    @property
    def smoothed(self) -> int:
        """Returns the cells beyond those on which smoothing depends."""
        settings = self.config.smoothing_settings()
        return 0 if settings is None else halo_cells(settings)

    @property
    def holes(self) -> tuple[int, int]:
        """Returns the number of empty cells in the widest hole that is filled: northwards, eastwards."""
        east, north = self.cell_m
        return cells_across(self.config.fill_m, north), cells_across(self.config.fill_m, east)

    @property
    def filled(self) -> int:
        """Returns the cells beyond those that are shown on which filling depends."""
        return max(self.holes) + RIM if max(self.holes) else 0

    def window(self, tile: TileId) -> GridWindow:
        """Returns the cells that are computed for a tile."""
        beyond = max(self.shown + self.filled + self.smoothed, self.around)
        return GridWindow.over(self.tiles.bounds(tile), *self.cell_m).grown(beyond)

    def reach(self, tile: TileId) -> Bounds:
        """Returns the box (m) of all cells or points on which a tile's surface depends."""
        box, margin = self.window(tile).bounds(), 0.0
        if self.config.method == "points":
            margin = self.detailed.halo_m + max(self.cell_m)
        return Bounds(
            box.easting_min_m - margin,
            box.northing_min_m - margin,
            box.easting_max_m + margin,
            box.northing_max_m + margin,
        )

    def rings(self) -> int:
        """Returns the number of rings of tiles around a tile that :meth:`reach` touches."""
        tile = TileId(0, 0)
        own, box = self.tiles.bounds(tile), self.reach(tile)
        beyond = max(box.easting_max_m - own.easting_max_m, box.northing_max_m - own.northing_max_m)
        return math.ceil((beyond + max(self.cell_m)) / self.tiles.size_m)

    @property
    def detailed(self) -> DetailedSettings:
        """Returns the settings of the detailed model."""
        return DetailedSettings(max_gap_m=self.config.max_gap_m, slopes=self.config.slopes)


@dataclass(frozen=True)
class Patch:
    """Raw arrays (rows, columns) of a window, row 0 the southernmost."""

    raw_m: Float64
    origin: npt.NDArray[np.uint8]
    intensity: Float32
    lowest: LowestReadings | None = None
    """Of the same cells; None where they are not known."""


def patch_of_cells(window: GridWindow, tiles: Iterable[TileCells]) -> Patch:
    """Returns a window of tiles' cells: robust heights, mean intensities, and lowest readings where they are stored.

    Parameters
    ----------
    window : in the tiles' cells.
    tiles : those that share cells with it, in any order.
    """
    shape = window.rows, window.columns
    raw, intensity = np.full(shape, np.nan), np.full(shape, np.nan, np.float32)
    lowest = LowestReadings(np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint16))
    for cells in tiles:
        row = cells.row.astype(np.int64) + (cells.tile.row * cells.cells_per_edge - window.first_row)
        column = cells.column.astype(np.int64) + (cells.tile.column * cells.cells_per_edge - window.first_column)
        own = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
        raw[row[own], column[own]] = cells.height_robust_m[own]
        intensity[row[own], column[own]] = cells.intensity_mean[own]
        lowest.drop_m[row[own], column[own]] = (cells.height_robust_m - cells.height_min_m)[own]
        lowest.count[row[own], column[own]] = np.minimum(cells.count[own], _MOST_COUNTED)
    stored = not np.isnan(lowest.drop_m).all()
    origin = np.where(np.isnan(raw), EMPTY, MEASURED).astype(np.uint8)
    return Patch(raw, origin, intensity, lowest if stored else None)


def patch_of_points(
    window: GridWindow, tiles: Iterable[TilePoints], grid: SurfaceGrid, wanted: Bool | None = None
) -> Patch:
    """Returns the detailed model through points, at the nodes of a window.

    A cell with a point in it is measured, the other cells with a height are interpolated. Intensities are a smooth
    surface over the same triangles.

    Parameters
    ----------
    tiles : those that :meth:`SurfaceGrid.reach` touches, in any order.
    wanted : (rows, columns) cells whose surface is wanted; None for all. What does not affect these may be omitted.
    """
    if wanted is None:
        return _detailed(window, tiles, grid)
    shape = window.rows, window.columns
    empty = Patch(np.full(shape, np.nan), np.zeros(shape, np.uint8), np.full(shape, np.nan, np.float32))
    if not wanted.any():
        return empty
    rows, columns = (_needed(np.asarray(wanted.any(axis=axis)), grid.filled + grid.smoothed) for axis in (1, 0))
    part = replace(
        window,
        first_row=window.first_row + rows.start,
        first_column=window.first_column + columns.start,
        rows=rows.stop - rows.start,
        columns=columns.stop - columns.start,
    )
    made = _detailed(part, tiles, grid)
    for name in ("raw_m", "origin", "intensity"):
        getattr(empty, name)[rows, columns] = getattr(made, name)
    return empty


def _needed(wanted: Bool, beyond: int) -> slice:
    """Returns the slice from the first to the last wanted one, with a margin on both sides."""
    at = np.flatnonzero(wanted)
    return slice(max(int(at[0]) - beyond, 0), min(int(at[-1]) + 1 + beyond, wanted.size))


def _detailed(window: GridWindow, tiles: Iterable[TilePoints], grid: SurfaceGrid) -> Patch:
    from roadscan.surface.clough_tocher import cubic_surface
    from roadscan.surface.normals import slopes_at

    box, margin = window.bounds(), grid.detailed.halo_m + max(grid.cell_m)
    parts = [_near(one, grid.tiles, box, margin) for one in tiles]
    places = np.concatenate([p for p, _ in parts]) if parts else np.empty((0, 3))
    light = np.concatenate([i for _, i in parts]) if parts else np.empty(0)
    ground = sites(places)
    brightness = sites(np.column_stack([places[:, :2], light]))
    mesh = triangulate(ground, grid.detailed.max_gap_m)
    raw = cubic_surface(ground, mesh, slopes_at(ground, mesh, grid.detailed.slopes).slopes).heights(window)
    grey = cubic_surface(brightness, mesh, slopes_at(brightness, mesh, "quadratic").slopes).heights(window)
    origin = np.where(np.isnan(raw), EMPTY, np.where(_held(window, places), MEASURED, INTERPOLATED))
    return Patch(raw, origin.astype(np.uint8), np.clip(grey, 0.0, _BRIGHTEST).astype(np.float32))


def surface_of(tile: TileId, patch: Patch, grid: SurfaceGrid, wanted: Bool | None = None) -> SurfaceTile:
    """Returns the surface of a window: smoothed, with holes filled, and without the margins that only these needed.

    Parameters
    ----------
    patch : of :meth:`SurfaceGrid.window`.
    wanted : (rows, columns) of the window, cells outside which there shall be no surface; None for all.
    """
    settings = grid.config.smoothing_settings()
    around_m = _around(patch.raw_m if wanted is None else np.where(wanted, patch.raw_m, np.nan), grid)
    patch, wanted = _for_smoothing(patch, grid), None if wanted is None else _cut(wanted, _beyond_smoothing(grid))
    height = patch.raw_m if settings is None else smoothed_where_known(patch.raw_m, settings)
    rim, window = grid.filled + grid.smoothed, grid.window(tile).grown(-_beyond_smoothing(grid))
    inner = (slice(rim, window.rows - rim), slice(rim, window.columns - rim))
    raw, origin = patch.raw_m[inner].copy(), patch.origin[inner].copy()
    lowest = None if patch.lowest is None else patch.lowest.part(*inner)
    if grid.filled:
        seen = (slice(grid.smoothed, window.rows - grid.smoothed), slice(grid.smoothed, window.columns - grid.smoothed))
        cut = (slice(grid.filled, -grid.filled),) * 2
        height, intensity, filled = _filled(height[seen], patch.intensity[seen], grid)
        height, intensity = height[cut], intensity[cut]
        origin[filled[cut]] = FILLED
    else:
        height, intensity = height[inner].copy(), patch.intensity[inner].copy()
    if wanted is not None:
        left_out = ~wanted[inner]
        raw[left_out] = height[left_out] = np.nan
        intensity[left_out], origin[left_out] = np.nan, EMPTY
    return SurfaceTile(
        tile, window.grown(-rim), grid.shown, raw, height, origin, intensity, grid.config.sigma_m,
        around_m=around_m, lowest=lowest,
    )  # fmt: skip


def _around(raw_m: Float64, grid: SurfaceGrid) -> Float64:
    """Returns heights before smoothing that products read, from those of a tile's window."""
    return _cut(raw_m, max(grid.shown + grid.filled + grid.smoothed - grid.around, 0))


def _for_smoothing(patch: Patch, grid: SurfaceGrid) -> Patch:
    """Returns the part of a window's patch that smoothing and filling use."""
    margin = _beyond_smoothing(grid)
    rows, columns = (slice(margin, n - margin) for n in patch.raw_m.shape)
    lowest = None if patch.lowest is None else patch.lowest.part(rows, columns)
    return Patch(_cut(patch.raw_m, margin), _cut(patch.origin, margin), _cut(patch.intensity, margin), lowest)


def _beyond_smoothing(grid: SurfaceGrid) -> int:
    """Returns the number of cells along each border of a tile's window that are used before smoothing only."""
    return max(grid.around - grid.shown - grid.filled - grid.smoothed, 0)


def _cut(cells: npt.NDArray[Any], margin: int) -> npt.NDArray[Any]:
    """Returns an array (rows, columns) without so many cells along each border."""
    return cells[margin : cells.shape[0] - margin, margin : cells.shape[1] - margin]


def _filled(height_m: Float64, intensity: Float32, grid: SurfaceGrid) -> tuple[Float64, Float32, Bool]:
    """Returns heights and intensities of a window with holes filled, and a mask of the filled cells."""
    found = Holes.of(~np.isnan(height_m), grid.holes)
    return found.fill(height_m), found.fill(intensity.astype(np.float64)).astype(np.float32), found.filled()


def smoothed_where_known(raw_m: Float64, settings: SurfaceSmoothing) -> Float64:
    """Returns smoothed heights (rows, columns), computed on the smallest box of known cells: a border acts as a hole.

    It works in strips, to save memory: a strip reaches beyond its rows by the halo of the smoothing.
    """
    known = ~np.isnan(raw_m)
    if not known.any():
        return raw_m
    spans = [np.flatnonzero(known.any(axis=axis)) for axis in (1, 0)]
    rows, columns = (slice(int(s[0]), int(s[-1]) + 1) for s in spans)
    height = np.full(raw_m.shape, np.nan)
    halo = halo_cells(settings)
    strip = max(_CELLS_SMOOTHED // (columns.stop - columns.start), 2 * halo)
    for first in range(rows.start, rows.stop, strip):
        last = min(first + strip, rows.stop)
        low, high = max(first - halo, rows.start), min(last + halo, rows.stop)
        height[first:last, columns] = smooth_surface(raw_m[low:high, columns], settings)[first - low : last - low]
    return height


def _near(points: TilePoints, tiles: TileGrid, box: Bounds, margin_m: float) -> tuple[Float64, Float64]:
    """Returns positions (n, 3) and intensities (n,) of a tile's points within `margin_m` of a box."""
    corner = tiles.bounds(points.tile)
    easting = corner.easting_min_m + points.x_quanta * QUANTUM_M
    northing = corner.northing_min_m + points.y_quanta * QUANTUM_M
    near = (easting >= box.easting_min_m - margin_m) & (easting <= box.easting_max_m + margin_m)
    near &= (northing >= box.northing_min_m - margin_m) & (northing <= box.northing_max_m + margin_m)
    places = np.column_stack([easting[near], northing[near], points.height_quanta[near] * QUANTUM_M])
    return places, points.intensity[near].astype(np.float64)


def _held(window: GridWindow, places_m: Float64) -> Bool:
    """Returns a mask (rows, columns) of the cells that contain a position."""
    column = np.floor(places_m[:, 0] / window.cell_east_m).astype(np.int64) - window.first_column
    row = np.floor(places_m[:, 1] / window.cell_north_m).astype(np.int64) - window.first_row
    own = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    held = np.zeros((window.rows, window.columns), bool)
    held[row[own], column[own]] = True
    return held


class DetailedSettings(Strict):
    """How the detailed model is made."""

    max_gap_m: float = Field(default=0.3, gt=0.0, le=100.0)
    """Widest hole that is bridged: no surface is made where a disc of this diameter holds no point."""
    slopes: SlopeKind = "cubic"
    """`cubic` follows the ground as closely as the heights' noise allows; `quadratic` is the paper's."""

    @property
    def halo_m(self) -> float:
        """Returns the distance within which all points must be given for a height to be final (m).

        A node's triangle and those beside it reach 2 gaps from it, the neighbours of their corners a gap a ring, and
        the circles that decide about the last ring are counted in that ring.
        """
        from roadscan.surface.normals import RINGS

        return (2 + RINGS) * self.max_gap_m
