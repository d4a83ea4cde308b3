"""Bounds of row groups against every reading placed one by one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from roadscan.core.crs import Anchor, MapFrame, world_frame_of
from roadscan.core.rig import Mountings, ScanGeometry, Sensor
from roadscan.georeference.charts import charts_along
from roadscan.georeference.place import HeightLimits, Placement
from roadscan.georeference.reach import RangeSpans, Reach, Touched
from roadscan.poses.trajectory import Allowance, Corrections, Trajectory

TILE_QUANTA = 100_000
"""Tiles of 1 m: many edges to get wrong."""
START = 10**18
PROFILER = ScanGeometry(
    kind="cartesian", readings=60, first=-1.5, step=0.05, range_offset_m=1.0, range_step_m=5e-5
)  # fmt: skip
MIRROR = ScanGeometry(kind="polar", readings=80, first=-0.6, step=0.015, range_step_m=1e-4)
SICK = ScanGeometry(
    kind="polar", readings=91, first=-np.pi / 2, step=np.pi / 90, range_step_m=0.01, reading_period_ns=74_000.0
)  # fmt: skip
PLACES = {
    "utm": ("EPSG:32632", 9.9, 48.1, 520.0),
    "state plane, feet": ("EPSG:6539", -73.8, 40.8, 12.0),
    "local": (None, 9.9, 48.1, 520.0),
}
LEFT = Sensor(kind="profiler", lever_arm_body_m=(-1.7, 0.6, -2.1), boresight={"roll_deg": 8, "pitch_deg": -30})
RIGHT = Sensor(kind="profiler", lever_arm_body_m=(-1.9, -0.5, -2.1), boresight={"roll_deg": -9, "heading_deg": 25})


def turning(place: str, rate_hz: float) -> Trajectory:
    """Four seconds: straight, then round a right-angle turn, up a grade of 12 %, rolling."""
    crs, lon, lat, height = PLACES[place]
    geographic = "EPSG:4979" if crs is None else Transformer.from_crs(crs, crs).source_crs.geodetic_crs.to_3d()
    world = world_frame_of(crs or "EPSG:4979")
    to_ecef = Transformer.from_crs(geographic, world, always_xy=True)
    t = np.arange(0, 4 + 0.5 / rate_hz, 1 / rate_hz)
    fine = np.arange(0, 4.02, 0.001)
    heading = np.radians(20) + np.pi / 2 * np.clip((fine - 1) / 2, 0, 1)
    steps = 8.0 * 0.001 * np.stack([np.cos(heading), np.sin(heading), np.full_like(fine, 0.12)])
    north, east, up = (np.interp(t, fine, np.cumsum(s)) for s in steps)
    metre = 1 / 111_000
    ecef = to_ecef.transform(lon + east * metre / np.cos(np.radians(lat)), lat + north * metre, height + up)
    lon_lat = np.radians([lon, lat])
    ned = Rotation.from_euler("ZY", [lon_lat[0], -np.pi / 2 - lon_lat[1]])
    turn = np.column_stack([np.interp(t, fine, heading), np.full_like(t, 0.12), 0.08 * np.sin(3 * t)])
    attitude = (ned * Rotation.from_euler("ZYX", turn)).as_quat(scalar_first=True)
    return Trajectory.of(world, (t * 1e9).astype(np.int64) + START, np.stack(ecef, axis=-1), attitude)


def both(path: Trajectory, place: str, mountings: Mountings, range_max_m: float) -> tuple[Placement, Reach]:
    crs, lon, lat, height = PLACES[place]
    frame = MapFrame(crs=crs) if crs else MapFrame(crs=None, local_name="yard", anchor=Anchor(lat, lon, height, 25.0))
    charts = charts_along(frame, path.world, path.position_world_m)
    placed = Placement(path, charts, mountings, 0.3, range_max_m, HeightLimits(), TILE_QUANTA)
    return placed, Reach(path, charts, mountings, 0.3, range_max_m, TILE_QUANTA)


def epochs(count: int) -> np.ndarray:
    return START + np.sort(np.random.default_rng(count).integers(-(10**8), 4 * 10**9, count))


def ranges(geometry: ScanGeometry, count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    if geometry is SICK:
        angle = geometry.first + geometry.step * np.arange(geometry.readings)
        wall = np.minimum(2.2 / np.maximum(np.cos(angle), 1e-3), 9.0 / np.maximum(np.abs(np.sin(angle)), 1e-3))
        found = (wall * 100 * rng.uniform(0.9, 1.3, (count, angle.size))).astype(np.uint16)
    else:
        found = rng.integers(18_000, 24_000, (count, geometry.readings)).astype(np.uint16)
    found[rng.random(found.shape) < 0.1] = 0
    found[count // 2] = 0
    return found


def scans(epoch: np.ndarray, found: np.ndarray) -> pa.RecordBatch:
    lists = pa.FixedSizeListArray.from_arrays(pa.array(found.ravel()), found.shape[1])
    return pa.RecordBatch.from_pydict({"epoch_gps_ns": epoch, "range": lists})


def whole_spans(found: np.ndarray, geometry: ScanGeometry) -> RangeSpans:
    low = np.where(found == 0, 65535, found).min(axis=1)
    high = found.max(axis=1)
    return RangeSpans.of_profiles(np.where(high == 0, 0, low).astype(np.uint16), high, geometry)


def pairs(touched: Touched) -> set[tuple[int, int, int]]:
    return set(zip(touched.group.tolist(), touched.column.tolist(), touched.row.tolist(), strict=True))


def placed_pairs(
    placed: Placement, batch: pa.RecordBatch, starts: np.ndarray, geometry: ScanGeometry | None
) -> set[tuple[int, int, int]]:
    found: set[tuple[int, int, int]] = set()
    for group, (start, end) in enumerate(pairwise(starts)):
        tiles, _ = placed.touched(batch.slice(start, end - start), geometry)
        found |= {(group, c, r) for c, r in np.unique(tiles, axis=0).tolist()}
    return found


def profile_pairs(
    geometry: ScanGeometry, place: str, rate_hz: float, mountings: Mountings, *, blocks: bool, count: int = 1500
) -> tuple[set[tuple[int, int, int]], set[tuple[int, int, int]]]:
    """Pairs by bounds, and as placed."""
    path = turning(place, rate_hz)
    placed, reach = both(path, place, mountings, 12.0)
    epoch, found = epochs(count), ranges(geometry, count)
    spans = RangeSpans.of_ranges(found) if blocks else whole_spans(found, geometry)
    starts = np.append(np.arange(0, count, 64), count)
    return pairs(reach.profiles(epoch, spans, starts, geometry)), placed_pairs(
        placed, scans(epoch, found), starts, geometry
    )


ONE = Mountings.one(LEFT.mounting())
DATED = Mountings((0, START + 1_300_000_000), (LEFT.mounting(), RIGHT.mounting()))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    ("geometry", "rate_hz", "mountings", "blocks", "most"),
    [(PROFILER, 200, ONE, False, 1.3), (PROFILER, 1, DATED, False, 1.3), (MIRROR, 20, DATED, False, 1.3),
     (SICK, 50, ONE, True, 1.3), (SICK, 200, DATED, False, 20.0)],
    ids=["profiler", "profiler, poses each second", "mirror", "sick", "sick, whole profiles"],
)  # fmt: skip
def test_bounds_of_profiles_hold_every_reading(geometry, rate_hz, mountings, blocks, most, place) -> None:
    bounded, placed = profile_pairs(geometry, place, rate_hz, mountings, blocks=blocks)
    assert len(placed) > 100
    assert not placed - bounded
    assert len(bounded) < most * len(placed)


def test_estimates_add_up_to_the_readings() -> None:
    path = turning("utm", 50)
    _, reach = both(path, "utm", ONE, 12.0)
    count = 1000
    epoch = START + np.linspace(0, 4e9, count).astype(np.int64)
    found = np.full((count, PROFILER.readings), 20_000, np.uint16)
    touched = reach.profiles(epoch, whole_spans(found, PROFILER), np.array([0, 400, count]), PROFILER)
    assert touched.readings.sum() == pytest.approx(found.size, rel=0.05)
    assert touched.readings[touched.group == 0].sum() == pytest.approx(400 * PROFILER.readings, rel=0.05)


def test_whole_profiles_of_a_far_seeing_beam_are_loose() -> None:
    _, reach = both(turning("utm", 10), "utm", ONE, 12.0)
    assert reach.is_loose(whole_spans(ranges(SICK, 9), SICK), SICK)
    assert reach.is_loose(RangeSpans.unknown(9, SICK), SICK)
    assert not reach.is_loose(RangeSpans.of_ranges(ranges(SICK, 9)), SICK)
    assert not reach.is_loose(whole_spans(ranges(MIRROR, 9), MIRROR), MIRROR)
    assert not reach.is_loose(RangeSpans.unknown(9, PROFILER), PROFILER)


def test_spans_of_whole_profiles_are_those_of_their_parts() -> None:
    rng = np.random.default_rng(4)
    ranges = rng.integers(0, 65_536, (50, 80)).astype(np.uint16) * (rng.random((50, 80)) < 0.1)
    whole = RangeSpans.of_ranges(ranges).whole(MIRROR)
    for profile, low, high in zip(ranges, whole.low[:, 0], whole.high[:, 0], strict=True):
        there = profile[profile > 0]
        assert (low, high) == ((there.min(), there.max()) if there.size else (0, 0))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("mountings", [ONE, DATED], ids=["one mounting", "dated mountings"])
@pytest.mark.parametrize("rate_hz", [2, 100])
def test_bounds_of_returns_hold_every_reading(place, mountings, rate_hz) -> None:
    path = turning(place, rate_hz)
    placed, reach = both(path, place, mountings, 15.0)
    count = 24_000
    rng, epoch = np.random.default_rng(4), epochs(count)
    azimuth, distance = np.linspace(0, 80 * np.pi, count), rng.uniform(0, 20, count)
    polar = distance * np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.3, 0.3, count)])
    xyz = polar.T.astype(np.float32)
    columns = {f"{a}_sensor_m": xyz[:, i] for i, a in enumerate("xyz")}
    batch = pa.RecordBatch.from_pydict({"epoch_gps_ns": epoch, "pose_epoch_gps_ns": epoch, **columns})
    starts = np.append(np.arange(0, count, 1500), count)
    parts = [slice(a, b) for a, b in pairwise(starts)]
    spans = np.array([[epoch[p][0], epoch[p][-1]] for p in parts])
    boxes = np.array([[[xyz[p, a].min(), xyz[p, a].max()] for a in range(3)] for p in parts], dtype=np.float64)
    sizes = np.diff(starts)
    bounded = pairs(reach.returns(spans, boxes, sizes))
    exact = placed_pairs(placed, batch, starts, None)
    assert len(exact) > 5000
    assert not exact - bounded
    assert len(bounded) < 2 * len(exact)  # the box around returns holds tiles between them
    unknown = reach.returns(spans, np.full_like(boxes, np.inf) * [-1, 1], sizes)
    assert not exact - pairs(unknown)
    boundless = replace(reach, range_max_m=np.inf).returns(spans, np.full_like(boxes, np.inf) * [-1, 1], sizes)
    assert boundless.unbounded.all()
    assert boundless.group.size == 0


def test_bounds_are_close_enough_for_poses_a_decimetre_off_to_show() -> None:
    path = turning("utm", 20)
    placed, _ = both(path, "utm", ONE, 12.0)
    _, reach = both(replace(path, position_world_m=path.position_world_m + 0.1), "utm", ONE, 12.0)
    count = 1500
    epoch, found = epochs(count), ranges(PROFILER, count)
    starts = np.append(np.arange(0, count, 64), count)
    bounded = pairs(reach.profiles(epoch, whole_spans(found, PROFILER), starts, PROFILER))
    assert placed_pairs(placed, scans(epoch, found), starts, PROFILER) - bounded


def test_readings_without_a_pose_touch_nothing() -> None:
    path = turning("utm", 10)
    _, reach = both(path, "utm", ONE, 12.0)
    epoch = path.epochs_gps_ns[-1] + 1 + np.arange(10)
    spans = whole_spans(ranges(PROFILER, 10), PROFILER)
    assert reach.profiles(epoch, spans, np.array([0, 10]), PROFILER).group.size == 0


def moved(path: Trajectory, allowance: Allowance, place: str) -> Trajectory:
    """The trajectory with corrections as large as they may be, which change their direction four times a second."""
    rng = np.random.default_rng(len(place))
    knots = np.arange(path.epochs_gps_ns[0], path.epochs_gps_ns[-1] + 1, 250_000_000)
    azimuth = rng.uniform(0.0, 2 * np.pi, knots.size)
    shift = np.column_stack([*(allowance.shift_m * np.array([np.cos(azimuth), np.sin(azimuth)])), azimuth - 3.0])
    turn = rng.normal(size=(knots.size, 3))
    turn *= allowance.turn_rad / np.linalg.norm(turn, axis=1, keepdims=True)
    return path.corrected(Corrections(knots, shift, turn))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("rate_hz", [4, 200])
def test_bounds_hold_for_every_correction_that_is_allowed(place: str, rate_hz: float) -> None:
    allowance = Allowance(0.25, 0.02)
    path = turning(place, rate_hz)
    _, reach = both(path, place, ONE, 12.0)
    placed, _ = both(moved(path, allowance, place), place, ONE, 12.0)
    epoch, found = epochs(1500), ranges(MIRROR, 1500)
    starts = np.append(np.arange(0, 1500, 64), 1500)
    spans = whole_spans(found, MIRROR)
    seen = placed_pairs(placed, scans(epoch, found), starts, MIRROR)
    assert seen - pairs(reach.profiles(epoch, spans, starts, MIRROR))  # bounds on recorded poses alone do not hold them
    assert not seen - pairs(replace(reach, allowance=allowance).profiles(epoch, spans, starts, MIRROR))
