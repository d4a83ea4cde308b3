"""Kernels on one core, beside what a user would otherwise call."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyproj
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.timing import Figure, best_seconds
from roadscan.core.crs import MapFrame, world_from_geodetic
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.rig import Mountings, ScanGeometry, Sensor
from roadscan.georeference.charts import charts_along
from roadscan.georeference.cloud import TilePoints
from roadscan.georeference.kernels.readings import FATES, Georeferenced, Returns
from roadscan.georeference.kernels.timed_readings import CHUNK, place_returns
from roadscan.georeference.place import EVERYWHERE, HeightLimits, Placement
from roadscan.poses.trajectory import Trajectory
from roadscan.tiles.accumulator import cells_of

N = 4_000_000
HDL_32E_PER_S = 700_000


def figures(_: Path) -> Iterator[Figure]:
    """Poses, georeferencing, cells."""
    path = drive()
    rng = np.random.default_rng(0)
    epochs = np.sort(rng.integers(*path.span_gps_ns, N))
    few = epochs[::20]
    yield Figure(
        "poses, interpolated (bar: 20)",
        rate(N, lambda: path.poses(epochs)),
        "M/s",
        rate(few.size, lambda: scipy_poses(path, few)),
        "SciPy CubicSpline and Slerp",
    )
    to_map = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    world = path.poses(few).position_world_m
    proj = rate(few.size, lambda: to_map.transform(*world.T))
    placement = placed_by(path)
    first = path.span_gps_ns[0]
    batch = returns(np.sort(rng.integers(first, first + int(N / HDL_32E_PER_S * 1e9), N)), rng)
    yield Figure(
        "lidar returns → points (pose, mounting, map)",
        rate(N, lambda: placement.returns(batch, EVERYWHERE)),
        "M/s",
        proj,
        "PROJ, the map step alone",
    )
    scans, geometry = profiles(path)
    count = scans.num_rows * geometry.readings
    yield Figure(
        "profiler readings → points",
        rate(count, lambda: placement.profiles(scans, geometry, EVERYWHERE)),
        "M/s",
        proj,
        "PROJ, the map step alone",
    )
    mirror, turning = mirror_profiles(path)
    count = mirror.num_rows * turning.readings
    yield Figure(
        "turning mirror's readings, a pose each → points",
        rate(count, lambda: placement.profiles(mirror, turning, EVERYWHERE)),
        "M/s",
        proj,
        "PROJ, the map step alone",
    )
    places = Georeferenced(*np.empty((3, CHUNK)), np.empty(CHUNK, np.uint8), np.empty(CHUNK, np.int32))
    yield Figure(
        "lidar returns, placed only (no rows written)",
        rate(N, lambda: placed_only(placement, batch, places)),
        "M/s",
        proj,
        "PROJ, the map step alone",
    )
    points, grid = tile(rng), TileGrid(10.0, 0.05)
    yield Figure(
        "points → cell statistics, robust height included",
        rate(len(points), lambda: cells_of(points, grid)),
        "M/s",
        rate(len(points), lambda: pandas_cells(points)),
        "pandas groupby: count, mean, min, max, std, median",
    )


def rate(count: int, function: Callable[[], object]) -> float:
    """Millions a second."""
    return count / best_seconds(function) / 1e6


def drive() -> Trajectory:
    """Ten minutes at 200 Hz."""
    t = np.arange(0, 600, 0.005)
    position = world_from_geodetic(
        "EPSG:4978", np.column_stack([11 + 1e-4 * t, 48 + 2e-5 * np.sin(t / 20), 500 + np.sin(t / 5)])
    )
    attitude = Rotation.from_euler("ZYX", np.column_stack([0.1 * t, 0.02 * np.sin(t), 0.03 * np.cos(t)]))
    return Trajectory.of("EPSG:4978", (t * 1e9).astype(np.int64), position, attitude.as_quat(scalar_first=True))


def scipy_poses(path: Trajectory, epochs: np.ndarray) -> None:
    t = path.epochs_gps_ns * 1e-9
    CubicSpline(t, path.position_world_m)(epochs * 1e-9)
    Slerp(t, Rotation.from_quat(path.quaternion_world_from_body, scalar_first=True))(epochs * 1e-9)


def placed_by(path: Trajectory) -> Placement:
    frame = MapFrame(crs="EPSG:32632")
    sensor = Sensor(kind="lidar", lever_arm_body_m=(0.3, 0.1, -1.5))
    charts = charts_along(frame, path.world, path.position_world_m)
    return Placement(path, charts, Mountings.one(sensor.mounting()), 0.0, np.inf, HeightLimits(), 1_000_000)


def returns(epochs: np.ndarray, rng: np.random.Generator) -> pa.RecordBatch:
    columns = {f"{a}_sensor_m": rng.uniform(-40, 40, N).astype(np.float32) for a in "xyz"}
    return pa.RecordBatch.from_pydict(
        {"epoch_gps_ns": epochs, "pose_epoch_gps_ns": epochs, **columns, "intensity": np.ones(N, np.uint16)}
    )


def profiles(path: Trajectory) -> tuple[pa.RecordBatch, ScanGeometry]:
    geometry = ScanGeometry(
        kind="cartesian", readings=2000, first=-1.0, step=0.001, range_offset_m=1, range_step_m=5e-5
    )
    rows = N // geometry.readings
    ranges = np.random.default_rng(1).integers(18_000, 22_000, N).astype(np.uint16)
    lists = [
        pa.FixedSizeListArray.from_arrays(pa.array(v), geometry.readings) for v in (ranges, ranges.astype(np.uint8))
    ]
    epochs = np.linspace(*path.span_gps_ns, rows).astype(np.int64)
    return pa.RecordBatch.from_pydict({"epoch_gps_ns": epochs, "range": lists[0], "intensity": lists[1]}), geometry


def mirror_profiles(path: Trajectory) -> tuple[pa.RecordBatch, ScanGeometry]:
    """A SICK LMS at 75 Hz, 181 readings over half a turn."""
    geometry = ScanGeometry(
        kind="polar", readings=181, first=-np.pi / 2, step=np.pi / 180, range_step_m=0.001,
        reading_period_ns=1e9 / 75 / 360,
    )  # fmt: skip
    first, last = path.span_gps_ns
    epochs = np.arange(first, last, 1e9 / 75).astype(np.int64)[:20_000]
    ranges = np.random.default_rng(2).integers(1000, 30_000, epochs.size * geometry.readings).astype(np.uint16)
    lists = [
        pa.FixedSizeListArray.from_arrays(pa.array(v), geometry.readings) for v in (ranges, ranges.astype(np.uint8))
    ]
    return pa.RecordBatch.from_pydict({"epoch_gps_ns": epochs, "range": lists[0], "intensity": lists[1]}), geometry


def placed_only(placement: Placement, batch: pa.RecordBatch, places: Georeferenced) -> None:
    """What every way from returns to points or cells begins with."""
    columns = [batch.column(c).to_numpy() for c in ("pose_epoch_gps_ns", "x_sensor_m", "y_sensor_m", "z_sensor_m")]
    ((_, mounting),) = placement.mountings.pieces(columns[0])
    georeference, fates = placement.georeference(mounting), np.zeros(FATES, np.int64)
    for start in range(0, columns[0].size, CHUNK):
        end = min(start + CHUNK, columns[0].size)
        place_returns(start, end, Returns(*columns), georeference, places, fates)


def tile(rng: np.random.Generator) -> TilePoints:
    x, y = (rng.integers(0, 1_000_000, N).astype(np.int32) for _ in range(2))
    height = rng.normal(50_000_000, 200, N).astype(np.int32)
    ones = np.ones(N, np.uint16)
    return TilePoints(TileId(0, 0), x, y, height, np.arange(N), ones, np.ones(N, np.uint8), ones)


def pandas_cells(p: TilePoints) -> None:
    frame = pd.DataFrame({"cell": p.y_quanta // 5000 * 200 + p.x_quanta // 5000, "h": p.height_quanta * 1e-5})
    frame.groupby("cell")["h"].agg(["count", "mean", "min", "max", "std", "median"])
