"""The same work as a skilled user would write it with NumPy, SciPy, pyproj, laspy and rasterio: stored scans and
trajectory → 5 mm height, intensity and count as GeoTIFF, and LAZ at 100 mm.

Vectorised throughout, no loop over readings, no compiler. It shares no code with roadscan beyond the names of columns,
so it is an oracle as well: the rule of a cell's robust height is that of ``schemas/cells.toml``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.dataset
import pyproj
import rasterio
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

_FLOOR_M = 1e-3
_UNIT_M = 1e-5
"""Coordinates are rounded to this: heights are sorted as whole numbers, and readings next to an edge of a cell fall
on the same side of it as in roadscan's."""
_CHUNK_PROFILES = 2_000
_TO_16_BITS = np.uint16(257)
_TILE_CELLS = 2_000


@dataclass(frozen=True)
class Head:
    """A profiler as its log states it."""

    y_sensor_m: Float64
    range_offset_m: float
    range_step_m: float
    lever_arm_body_m: Float64
    body_from_sensor: Float64


@dataclass(frozen=True)
class Poses:
    """Splines through a trajectory: seconds after `first_gps_ns` → position (ECEF, m), rotation ECEF from body."""

    first_gps_ns: int
    position: CubicSpline
    rotation: Slerp

    @classmethod
    def load(cls, folder: Path, margin: tuple[int, int]) -> Poses:
        """Read a table `trajectory` between two epochs (GPS ns)."""
        rows = _table(folder, margin).sort_by("epoch_gps_ns")
        epochs = rows["epoch_gps_ns"].to_numpy()
        seconds = (epochs - epochs[0]) * 1e-9
        position = np.column_stack([rows[f"{axis}_world_m"] for axis in "xyz"])
        turned = Rotation.from_quat(np.column_stack([rows[f"q{c}"] for c in "xyzw"]))
        return cls(int(epochs[0]), CubicSpline(seconds, position), Slerp(seconds, turned))

    def at(self, epochs_gps_ns: Int64) -> tuple[Float64, Float64]:
        """Positions (p, 3) and rotation matrices (p, 3, 3)."""
        seconds = (epochs_gps_ns - self.first_gps_ns) * 1e-9
        return self.position(seconds), self.rotation(seconds).as_matrix()


@dataclass(frozen=True)
class Points:
    """Readings on the map (n,)."""

    easting_m: Float64
    northing_m: Float64
    height_m: Float64
    intensity: npt.NDArray[np.uint16]
    """As LAS wants it: 16 bits."""


@dataclass(frozen=True)
class Cells:
    """Cells that hold a point, sorted by row, then column, both counted from the map's origin (n,)."""

    column: Int64
    row: Int64
    count: Int64
    height_mean_m: Float64
    height_robust_m: Float64
    intensity_mean: Float64


def place(scans: pa.Table, head: Head, poses: Poses, to_map: pyproj.Transformer) -> Iterator[Points]:
    """Profiles → points: pose, mounting, and the map through three corners of each profile's plane.

    A profile is plane and 2 m wide: between its corners the map departs from an affine form by less than a micrometre.
    """
    y_ends, r_ends = head.y_sensor_m[[0, -1]], head.range_offset_m + head.range_step_m * np.array([0.0, 65_535.0])
    corners = np.array([[0, y_ends[0], r_ends[0]], [0, y_ends[1], r_ends[0]], [0, y_ends[0], r_ends[1]]])
    in_body = corners @ head.body_from_sensor.T + head.lever_arm_body_m
    share = (head.y_sensor_m - y_ends[0]) / (y_ends[1] - y_ends[0])
    for first in range(0, len(scans), _CHUNK_PROFILES):
        part = scans.slice(first, _CHUNK_PROFILES).combine_chunks()
        shape = (len(part), share.size)
        raw = _values(part, "range").reshape(shape)
        position, rotation = poses.at(part["epoch_gps_ns"].to_numpy())
        world = position[:, None, :] + np.einsum("pij,cj->pci", rotation, in_body)
        mapped = np.stack(to_map.transform(*world.reshape(-1, 3).T), axis=-1).reshape(-1, 3, 3)
        across, down = mapped[:, 1] - mapped[:, 0], (mapped[:, 2] - mapped[:, 0]) / 65_535.0
        valid = raw > 0
        axes = [(mapped[:, 0, k, None] + across[:, k, None] * share + down[:, k, None] * raw)[valid] for k in range(3)]
        yield Points(*axes, _values(part, "intensity").reshape(shape)[valid] * _TO_16_BITS)


def to_cells(points: Points, cell_m: float, packed: bool = True) -> Cells:
    """Points → cells.

    packed : sort one 64-bit number made of cell and height (NumPy's vectorised sort); else `np.lexsort`.
    """
    column, row = _cell_numbers(points.easting_m, cell_m), _cell_numbers(points.northing_m, cell_m)
    column_0, row_0 = int(column.min()), int(row.min())
    width = int(column.max()) - column_0 + 1
    cell = (row - row_0) * width + (column - column_0)
    height = np.round(points.height_m / _UNIT_M).astype(np.int64)
    lowest = int(height.min())
    heights, cells = _sorted(cell, height - lowest, packed)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(cells) != 0]))
    count = np.diff(np.append(starts, cells.size))
    robust = _robust(heights, cells, starts, count, packed)
    light = np.bincount(cell, points.intensity, minlength=int(cells[-1]) + 1)
    kept = cells[starts]
    return Cells(
        column=column_0 + kept % width,
        row=row_0 + kept // width,
        count=count,
        height_mean_m=(lowest + np.add.reduceat(heights, starts) / count) * _UNIT_M,
        height_robust_m=(lowest + robust) * _UNIT_M,
        intensity_mean=light[kept] / count,
    )


def write_tiles(cells: Cells, cell_m: float, crs: str, folder: Path) -> int:
    """A GeoTIFF of 2,000² cells a tile: height, intensity, count; returns the files."""
    tile = np.stack([cells.column, cells.row]) // _TILE_CELLS
    names, number = np.unique(tile, axis=1, return_inverse=True)
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number.ravel()))
    edge = _TILE_CELLS * cell_m
    for (column, row), end, size in zip(names.T, ends, np.bincount(number.ravel()), strict=True):
        own = order[end - size : end]
        image = np.full((3, _TILE_CELLS, _TILE_CELLS), np.nan, np.float32)
        at = (_TILE_CELLS - 1 - cells.row[own] % _TILE_CELLS, cells.column[own] % _TILE_CELLS)
        for band, values in enumerate((cells.height_robust_m, cells.intensity_mean, cells.count)):
            image[(band, *at)] = values[own]
        profile: dict[str, Any] = {"driver": "GTiff", "dtype": "float32", "count": 3, "nodata": np.nan, "crs": crs}
        profile |= {"width": _TILE_CELLS, "height": _TILE_CELLS, "tiled": True, "blockxsize": 512, "blockysize": 512}
        profile |= {"compress": "zstd", "zstd_level": 1, "predictor": 3}
        place_ = rasterio.Affine(cell_m, 0, column * edge, 0, -cell_m, (row + 1) * edge)
        with rasterio.open(folder / f"{column}_{row}.tif", "w", transform=place_, **profile) as out:
            out.write(image)
    return names.shape[1]


def write_thinned(cells: Cells, cell_m: float, spacing_m: float, file: Path) -> int:
    """LAZ of one point a square: the cell at the lower median of the square's heights; returns the points."""
    squares = round(spacing_m / cell_m)
    column, row = cells.column // squares, cells.row // squares
    order = np.lexsort((cells.height_robust_m, column, row))
    new = (np.diff(column[order], prepend=-1) != 0) | (np.diff(row[order], prepend=-1) != 0)
    starts = np.flatnonzero(new)
    size = np.diff(np.append(starts, order.size))
    own = order[starts + (size - 1) // 2]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1e-4)
    header.offsets = np.floor([cells.column.min() * cell_m, cells.row.min() * cell_m, cells.height_robust_m.min()])
    las = laspy.LasData(header)
    las.x, las.y = (cells.column[own] + 0.5) * cell_m, (cells.row[own] + 0.5) * cell_m
    las.z = cells.height_robust_m[own]
    las.intensity = np.round(cells.intensity_mean[own]).astype(np.uint16)
    las.write(file)
    return own.size


def load_scans(folder: Path, limit: int | None = None) -> pa.Table:
    """Rows of a table `scans` in order of time, at most `limit`."""
    found = pa.dataset.dataset(folder, format="parquet", partitioning=None, exclude_invalid_files=False)
    columns = ["epoch_gps_ns", "range", "intensity"]
    rows = found.to_table(columns) if limit is None else found.head(limit, columns=columns)
    return rows.sort_by("epoch_gps_ns") if np.any(np.diff(rows["epoch_gps_ns"]) < 0) else rows


def head_of(scan_geometry: dict[str, Any] | str, lever_arm_body_m: Float64, body_from_sensor: Float64) -> Head:
    """The head from the log's geometry (JSON or parsed) and its mounting."""
    g = json.loads(scan_geometry) if isinstance(scan_geometry, str) else scan_geometry
    y = g["first"] + g["step"] * np.arange(g["readings"])
    return Head(y, g["range_offset_m"], g["range_step_m"], np.asarray(lever_arm_body_m), np.asarray(body_from_sensor))


def joined(parts: list[Points]) -> Points:
    """All points as one."""
    names = ("easting_m", "northing_m", "height_m", "intensity")
    return Points(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _cell_numbers(position_m: Float64, cell_m: float) -> Int64:
    """Cells along an axis; half a unit is added because rounded positions lie on an edge once in a few hundred."""
    return np.asarray(np.floor((np.rint(position_m / _UNIT_M) + 0.5) * (_UNIT_M / cell_m)).astype(np.int64))


def _sorted(cell: Int64, value: Int64, packed: bool) -> tuple[Int64, Int64]:
    """Values and cells, ordered by cell and then by value; both not negative."""
    if packed:
        bits = int(value.max()).bit_length()
        both = np.sort((cell << bits) | value)
        return both & ((1 << bits) - 1), both >> bits
    order = np.lexsort((value, cell))
    return value[order], cell[order]


def _robust(heights: Int64, cells: Int64, starts: Int64, count: Int64, packed: bool) -> Float64:
    """Mean of the heights within 3 · 1.4826 · MAD (at least 1 mm) of the lower median, a cell."""
    lower = starts + (count - 1) // 2
    away = heights - np.repeat(heights[lower], count)
    distances, _ = _sorted(cells, np.abs(away), packed)
    reach = np.maximum(3 * 1.4826 * distances[lower], _FLOOR_M / _UNIT_M)
    kept = np.abs(away) <= np.repeat(reach, count)
    above = np.add.reduceat(np.where(kept, away, 0), starts) / np.add.reduceat(kept.astype(np.int64), starts)
    return np.asarray(heights[lower] + above)


def _values(rows: pa.Table, name: str) -> npt.NDArray[Any]:
    """The values of a column of lists, one after another."""
    lists = rows[name].combine_chunks()
    lists = lists.chunk(0) if isinstance(lists, pa.ChunkedArray) else lists
    return np.asarray(lists.flatten().to_numpy(zero_copy_only=False))


def _table(folder: Path, between: tuple[int, int]) -> pa.Table:
    epoch = pa.dataset.field("epoch_gps_ns")
    found = pa.dataset.dataset(folder, format="parquet", partitioning=None)
    return found.to_table(filter=(epoch >= between[0]) & (epoch <= between[1]))
