"""Footprints on one core: bounds of row groups, beside placing every reading as was done before."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from benchmarks.timing import Figure, best_seconds
from roadscan.core.crs import MapFrame, world_from_geodetic
from roadscan.core.rig import Mountings, ScanGeometry, Sensor
from roadscan.georeference.charts import charts_along
from roadscan.georeference.place import HeightLimits, Placement
from roadscan.georeference.reach import RangeSpans, Reach
from roadscan.poses.trajectory import Trajectory, world_from_ned

SECONDS = 10.0
TILE_QUANTA = 1_000_000
GROUP_ROWS = 128


def figures(folder: Path) -> Iterator[Figure]:
    """One head of the line-rate pair, a SICK, an HDL-32E."""
    path = drive()
    charts = charts_along(MapFrame(crs="EPSG:32632"), path.world, path.position_world_m)
    mountings = Mountings.one(Sensor(kind="profiler", lever_arm_body_m=(-1.7, 0.6, -2.1)).mounting())
    reach = Reach(path, charts, mountings, 0.0, 100.0, TILE_QUANTA)
    placed = Placement(path, charts, mountings, 0.0, 100.0, HeightLimits(), TILE_QUANTA)
    yield from profiler(reach, placed, folder)
    yield from sick(reach, placed)
    yield from lidar(reach, placed)


def profiler(reach: Reach, placed: Placement, folder: Path) -> Iterator[Figure]:
    """14,000 profiles/s of 4,000 readings."""
    geometry = ScanGeometry(
        kind="cartesian", readings=4000, first=-2.0, step=0.001, range_offset_m=1, range_step_m=5e-5
    )
    count = round(14_000 * SECONDS)
    epoch, starts = epochs(count)
    low = np.random.default_rng(0).integers(20_000, 20_100, count).astype(np.uint16)
    few = 2000
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.repeat(low[:few], 4000)), 4000)
    batch = pa.RecordBatch.from_pydict({"epoch_gps_ns": epoch[:few], "range": lists})
    exact = 1e9 * best_seconds(lambda: placed.touched(batch, geometry)) / few
    spans = RangeSpans.of_profiles(low, low + np.uint16(1000), geometry)
    yield Figure(
        "profiler of 4,000 readings: bounds",
        1e9 * best_seconds(lambda: reach.profiles(epoch, spans, starts, geometry)) / count,
        "ns/profile",
        exact,
        "placing every reading, without decoding them",
    )
    file = folder / "flat.parquet"
    rows = pa.table({"epoch_gps_ns": epoch, "range_low": low, "range_high": low + np.uint16(1000)})
    packed = dict.fromkeys(rows.column_names, "DELTA_BINARY_PACKED")
    pq.write_table(
        rows, file, row_group_size=GROUP_ROWS, compression="zstd", use_dictionary=False, column_encoding=packed
    )
    yield Figure(
        f"  reading what they need, row groups of {GROUP_ROWS} profiles (bar for both: 600)",
        1e9 * best_seconds(lambda: pq.ParquetFile(file).read(use_threads=False)) / count,
        "ns/profile",
    )


def sick(reach: Reach, placed: Placement) -> Iterator[Figure]:
    """75 profiles/s of 181 readings, a pose a reading, in a street between facades."""
    geometry = ScanGeometry(
        kind="polar", readings=181, first=-np.pi / 2, step=np.pi / 180, range_step_m=0.01, reading_period_ns=37_000.0
    )
    count = round(75 * SECONDS)
    epoch, starts = epochs(count)
    angle = geometry.first + geometry.step * np.arange(geometry.readings)
    wall = np.minimum(2.2 / np.maximum(np.cos(angle), 1e-3), 12.0 / np.maximum(np.abs(np.sin(angle)), 1e-3))
    far = np.random.default_rng(1).uniform(0.95, 1.05, (count, angle.size))
    ranges = (100 * wall * far).astype(np.uint16)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(ranges.ravel()), geometry.readings)
    batch = pa.RecordBatch.from_pydict({"epoch_gps_ns": epoch, "range": lists})
    yield Figure(
        "SICK of 181 readings: bounds from decoded ranges (bar: 5,000)",
        1e9 * best_seconds(lambda: reach.profiles(epoch, RangeSpans.of_ranges(ranges), starts, geometry)) / count,
        "ns/profile",
        1e9 * best_seconds(lambda: placed.touched(batch, geometry)) / count,
        "placing every reading",
    )


def lidar(reach: Reach, placed: Placement) -> Iterator[Figure]:
    """695,000 returns/s, ten turns a second, to 90 m."""
    for group_rows in (8192, 65_536):
        groups = round(695_000 * SECONDS / group_rows)
        ends = np.linspace(*span(), groups + 1).astype(np.int64)
        turns = np.linspace(0, 2 * np.pi * 10 * SECONDS, groups + 1)
        azimuth = np.linspace(turns[:-1], turns[1:], 400, axis=1)
        sides = [90 * np.cos(azimuth), 90 * np.sin(azimuth)]
        sides = [np.column_stack([np.minimum(s.min(axis=1), 0), np.maximum(s.max(axis=1), 0)]) for s in sides]
        boxes = np.stack([*sides, np.tile([-20.0, 10.0], (groups, 1))], axis=1)
        spans, counts = np.column_stack([ends[:-1], ends[1:]]), np.full(groups, group_rows)
        seconds = best_seconds(lambda b=boxes, s=spans, c=counts: reach.returns(s, b, c))
        few = 200_000
        rng = np.random.default_rng(2)
        xyz = {f"{a}_sensor_m": rng.uniform(-50, 50, few).astype(np.float32) for a in "xyz"}
        times = np.linspace(*span(), few).astype(np.int64)
        batch = pa.RecordBatch.from_pydict({"epoch_gps_ns": times, "pose_epoch_gps_ns": times, **xyz})
        yield Figure(
            f"HDL-32E in row groups of {group_rows:,}: bounds (bar: 2)",
            1e9 * seconds / counts.sum(),
            "ns/return",
            1e9 * best_seconds(lambda b=batch: placed.touched(b, None)) / few,
            "placing every return, without decoding them",
        )


def span() -> tuple[int, int]:
    return 2 * 10**9, 2 * 10**9 + round(SECONDS * 1e9)


def epochs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Epochs of profiles, and where their row groups start."""
    return np.linspace(*span(), count).astype(np.int64), np.append(np.arange(0, count, GROUP_ROWS), count)


def drive() -> Trajectory:
    """100 km/h eastward, swaying, poses at 200 Hz."""
    t = np.arange(0, SECONDS + 4, 0.005)
    position = world_from_geodetic(
        "EPSG:4978", np.column_stack([11 + 27.8 / 7.4e4 * t, np.full_like(t, 48.0), 500 + np.sin(t / 5)])
    )
    turn = np.column_stack([np.pi / 2 + 0.05 * np.sin(t), 0.02 * np.sin(t), 0.03 * np.cos(t)])
    attitude = Rotation.from_matrix(world_from_ned("EPSG:4978", position)) * Rotation.from_euler("ZYX", turn)
    return Trajectory.of("EPSG:4978", (t * 1e9).astype(np.int64), position, attitude.as_quat(scalar_first=True))
