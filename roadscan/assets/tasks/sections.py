"""Cross-sections of bare earth by station: for each road a file for CAD, and one for spreadsheets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.files.layers import Layer, write_dxf
from roadscan.assets.files.squares import read_bare_earth
from roadscan.assets.scene import GroundModel
from roadscan.assets.settings import GroundSectionsConfig
from roadscan.assets.tasks.evidence import BARE_EARTH
from roadscan.assets.tiling import AssetGrid
from roadscan.compute.array_types import Bool, Float64
from roadscan.condition.road_line import RoadLine, Roads
from roadscan.core.grid import TileId
from roadscan.run.keys import code_digest, key_of
from roadscan.store.manifest import Manifest, OutputRecord, read_recorded
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext, publish_file

if TYPE_CHECKING:
    import pandas as pd


class CrossSections(NamedTuple):
    """Bare earth at (stations, offsets); heights and σ are NaN where it is not known."""

    station_m: Float64
    """(s,) along the reference line."""
    offset_m: Float64
    """(k,) to the right of it."""
    x_m: Float64
    """(s, k) place in the frame of the ground model."""
    y_m: Float64
    height_m: Float64
    seen: Bool
    """True where ground was seen, False where its height is interpolated or not known."""
    sigma_m: Float64
    """1 σ of the heights: the noise of the returns where they were seen; elsewhere it grows with the distance."""

    def joined(self, other: Self) -> Self:
        """Same sections from two ground models, such as those of neighbouring tiles: seen heights first, then
        interpolated ones, each from this model before the other.
        """
        better = np.isnan(self.height_m) | (other.seen & ~self.seen)
        return self._replace(
            height_m=np.where(better, other.height_m, self.height_m),
            seen=np.where(better, other.seen, self.seen),
            sigma_m=np.where(better, other.sigma_m, self.sigma_m),
        )


def cross_sections(ground: GroundModel, line_xy_m: Float64, station_m: Float64, offset_m: Float64) -> CrossSections:
    """Returns bare earth on lines square to a reference line.

    Parameters
    ----------
    line_xy_m : (n, 2) the reference line in the frame of the ground model, in the direction of its stations, which
        count from its first point (m).
    station_m : (s,) where the sections stand; beyond the line's ends nothing is known.
    offset_m : (k,) to the right of the line.
    """
    place, right = stations(line_xy_m, station_m)
    x = place[:, :1] + right[:, :1] * offset_m
    y = place[:, 1:] + right[:, 1:] * offset_m
    row, column = cells(ground, x, y)
    on_raster = inside(ground, x, y)
    height = np.full(x.shape, np.nan)
    height[on_raster] = ground.height_at(x[on_raster], y[on_raster])
    known = np.isfinite(height)
    seen = known & ground.seen[row, column]
    sigma = np.full(height.shape, np.nan)
    if ground.sigma_m is not None:
        sigma[known] = ground.sigma_m[row, column][known]
    return CrossSections(np.asarray(station_m, np.float64), np.asarray(offset_m, np.float64), x, y, height, seen, sigma)


def stations(line_xy_m: Float64, station_m: Float64) -> tuple[Float64, Float64]:
    """Returns places (s, 2) at stations of a line (n, 2), and unit vectors (s, 2) to its right; NaN beyond its ends.

    The direction at a station is that of the line from half a metre before to half a metre behind it, so that it does
    not jump at the line's vertices.
    """
    steps = np.hypot(*np.diff(line_xy_m, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    beyond = (station_m < 0.0) | (station_m > along[-1])
    near = np.clip(station_m, 0.0, along[-1])
    at = [np.column_stack([np.interp(s, along, line_xy_m[:, k]) for k in (0, 1)]) for s in _about(near)]
    way = at[2] - at[0]
    way /= np.hypot(way[:, 0], way[:, 1])[:, None]
    place = np.where(beyond[:, None], np.nan, at[1])
    return place, np.column_stack([way[:, 1], -way[:, 0]])


def _about(station_m: Float64) -> tuple[Float64, Float64, Float64]:
    return station_m - 0.5, station_m, station_m + 0.5


def inside(ground: GroundModel, x_m: Float64, y_m: Float64) -> Bool:
    """Returns a mask of the places on the raster."""
    rows, columns = ground.height_m.shape
    u, v = (x_m - ground.x_min_m) / ground.cell_m, (y_m - ground.y_min_m) / ground.cell_m
    return np.asarray((u >= 0.0) & (u < columns) & (v >= 0.0) & (v < rows))


def cells(ground: GroundModel, x_m: Float64, y_m: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Returns row and column of places, clamped to the raster."""
    rows, columns = ground.height_m.shape
    row = np.nan_to_num((y_m - ground.y_min_m) / ground.cell_m, nan=0.0)
    column = np.nan_to_num((x_m - ground.x_min_m) / ground.cell_m, nan=0.0)
    return (
        np.clip(np.floor(row), 0, rows - 1).astype(np.int64),
        np.clip(np.floor(column), 0, columns - 1).astype(np.int64),
    )


SECTIONS: Final = "ground_sections"
_SUFFIXES: Final = (".csv", ".dxf")


@dataclass(frozen=True, eq=False)
class SectionTask:
    """Cross-sections of a road."""

    line: RoadLine
    config: GroundSectionsConfig
    ground: Mapping[TileId, OutputRecord]
    """Bare earth of the squares near it."""
    key: str

    @property
    def units(self) -> tuple[str, ...]:
        """Returns its files."""
        return tuple(f"{self.line.road}{suffix}" for suffix in _SUFFIXES)


def plan_sections(
    roads: Roads, config: GroundSectionsConfig | None, grid: AssetGrid, manifest: Manifest, context: ProductContext
) -> list[SectionTask]:
    """Returns cross-sections of every road; none where they are not asked for."""
    if config is None:
        return []
    code = code_digest("roadscan.assets.tasks.sections:write_sections")
    held = {TileId.parse(r.unit): r for r in manifest.of(BARE_EARTH).values() if r.path}
    tasks = []
    for road, line in sorted(roads.lines.items()):
        strip = shapely.LineString(line.nodes_m).buffer(config.half_width_m + 1.0)
        shapely.prepare(strip)
        near = {square: r for square, r in held.items() if strip.intersects(_box(grid, square))}
        shape = [line.first_m, line.nodes_m.tolist()]
        read = [(r.unit, r.digest) for r in near.values()]
        key = key_of(code, road, config.model_dump(mode="json"), shape, read, context.map)
        tasks.append(SectionTask(line, config, near, key))
    return tasks


def _box(grid: AssetGrid, square: TileId) -> shapely.Polygon:
    (east, north), edge = grid.corner_m(square), grid.edge_m
    return shapely.box(east, north, east + edge, north + edge)


def write_sections(task: SectionTask, grid: AssetGrid, store: Store, context: ProductContext) -> list[OutputRecord]:
    """Write both files of a road."""
    rows = _rows(task, grid, store, context)
    writers: dict[str, Callable[[Path, pd.DataFrame, ProductContext], None]] = {
        ".csv": _write_csv, ".dxf": _write_drawing
    }  # fmt: skip
    records = []
    with store.scratch() as folder:
        for unit, (suffix, write) in zip(task.units, writers.items(), strict=True):
            path = folder / f"sections{suffix}"
            write(path, rows, context)
            records.append(publish_file(store, path, f"products/{SECTIONS}/{unit}", SECTIONS, unit, task.key))
    return records


def _rows(task: SectionTask, grid: AssetGrid, store: Store, context: ProductContext) -> pd.DataFrame:
    """Returns a row for each known height, by station and offset."""
    import pandas as pd  # slow to import

    line, config = task.line, task.config
    first = np.ceil(line.first_m / config.spacing_m)
    last = np.floor((line.first_m + line.length_m) / config.spacing_m)
    station = np.arange(first, last + 1) * config.spacing_m
    half = int(config.half_width_m / config.step_m + 1e-9)
    offset = np.arange(-half, half + 1, dtype=np.float64) * config.step_m
    shape = (station.size, offset.size)
    height, sigma, seen = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, bool)
    for square, record in sorted(task.ground.items(), key=lambda one: (one[0].row, one[0].column)):
        corner = grid.corner_m(square)
        model = read_bare_earth(read_recorded(store, record), corner, context)
        near = _near(line, station, config, _box(grid, square))
        if near.size:
            found = cross_sections(model, line.nodes_m - corner, station[near] - line.first_m, offset)
            _take(found, near, height, sigma, seen)
    at, across = np.nonzero(np.isfinite(height))
    place = line.places(station[at], offset[across])
    return pd.DataFrame(
        {
            "road": line.road,
            "station_m": station[at],
            "offset_m": offset[across],
            "easting_m": place[:, 0],
            "northing_m": place[:, 1],
            "height_m": height[at, across],
            "sigma_height_m": sigma[at, across],
            "seen": seen[at, across].astype(int),
        }
    )


def _near(
    line: RoadLine, station: Float64, config: GroundSectionsConfig, box: shapely.Polygon
) -> npt.NDArray[np.int64]:
    """Returns cross-sections that reach into a square."""
    middle = line.places(station, 0.0)[:, :2]
    away = shapely.distance(shapely.points(middle), box)
    return np.flatnonzero(away <= config.half_width_m + 1.0)


def _take(found: CrossSections, near: npt.NDArray[np.int64], height: Float64, sigma: Float64, seen: Bool) -> None:
    """Add heights of a square where none was known or seen before."""
    better = np.isfinite(found.height_m) & (np.isnan(height[near]) | (found.seen & ~seen[near]))
    for whole, own in ((height, found.height_m), (sigma, found.sigma_m), (seen, found.seen)):
        whole[near] = np.where(better, own, whole[near])


def _write_csv(path: Path, rows: pd.DataFrame, context: ProductContext) -> None:
    rows.to_csv(path, index=False, float_format="%.4f", lineterminator="\n")


def _write_drawing(path: Path, rows: pd.DataFrame, context: ProductContext) -> None:
    """Write a 3D line for each section, interrupted where nothing is known."""
    shapes = np.array([*_drawn(rows), None], object)[:-1]
    write_dxf(path, [Layer(SECTIONS, "LineStringZ", pa.table({}), shapes)], context)


def _drawn(rows: pd.DataFrame) -> Iterator[shapely.LineString]:
    step = rows["offset_m"].diff()
    usual = step[step > 0].min() if len(rows) > 1 else 0.0
    broken = (rows["station_m"].diff() != 0) | (step > 1.5 * usual)
    for _, own in rows.groupby(broken.cumsum()):
        if len(own) > 1:
            yield shapely.LineString(own[["easting_m", "northing_m", "height_m"]].to_numpy())
