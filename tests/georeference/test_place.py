"""Georeferencing against an independent chain: SciPy rotations and PROJ, point by point."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyarrow as pa
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from roadscan.core.crs import Anchor, MapFrame, world_frame_of
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Mountings, ScanGeometry, Sensor
from roadscan.georeference.charts import charts_along
from roadscan.georeference.place import EVERYWHERE, HeightLimits, Placement, Window, pass_numbers, passes_of
from roadscan.poses.trajectory import Trajectory

TILE_QUANTA = 1_000_000

PLACES = {
    "utm north": ("EPSG:32632", 9.9, 48.1, 520.0),
    "utm south": ("EPSG:32756", 151.2, -33.9, 40.0),
    "state plane, feet": ("EPSG:6539", -73.8, 40.8, 12.0),
    "far from the meridian": ("EPSG:32632", 14.9, 60.0, -10.0),
    "local": (None, 9.9, 48.1, 520.0),
}

SENSOR = Sensor(
    kind="lidar",
    axes="flu",
    lever_arm_body_m=(-1.7, 0.6, -2.1),
    boresight={"roll_deg": 1.5, "pitch_deg": -12.0, "heading_deg": 3.0},
)


def ned_axes(lon_deg: float, lat_deg: float, height: float, to_ecef: Transformer) -> np.ndarray:
    """Columns north, east, down in ECEF by differences of PROJ's own conversion."""
    here = np.array(to_ecef.transform(lon_deg, lat_deg, height))
    north = np.array(to_ecef.transform(lon_deg, lat_deg + 1e-5, height)) - here
    up = np.array(to_ecef.transform(lon_deg, lat_deg, height + 1.0)) - here
    north, up = north / np.linalg.norm(north), up / np.linalg.norm(up)
    north -= up * (north @ up)
    north /= np.linalg.norm(north)
    return np.stack([north, np.cross(north, up), -up], axis=1)


def scene(place: str, heading_deg: float, roll_deg: float, pitch_deg: float):
    """A short drive: trajectory, map frame, and a function placing body vectors on the map without roadscan."""
    crs, lon, lat, height = PLACES[place]
    geographic = "EPSG:4979" if crs is None else Transformer.from_crs(crs, crs).source_crs.geodetic_crs.to_3d()
    world = world_frame_of(crs or "EPSG:4979")
    to_ecef = Transformer.from_crs(geographic, world, always_xy=True)
    frame = MapFrame(crs=crs) if crs else MapFrame(crs=None, local_name="yard", anchor=Anchor(lat, lon, height, 25.0))
    times = np.arange(0, 4, 0.1)
    origin = np.array(to_ecef.transform(lon, lat, height))
    ned = ned_axes(lon, lat, height, to_ecef)
    course = Rotation.from_euler("ZYX", [heading_deg, pitch_deg, roll_deg], degrees=True)
    step = ned @ (course.as_matrix() @ np.array([20.0, 0, 0]))
    positions = origin + times[:, None] * step
    attitude = Rotation.from_matrix(ned @ course.as_matrix())
    epochs = (times * NS_PER_S).astype(np.int64) + 10**18
    path = Trajectory.of(world, epochs, positions, np.tile(attitude.as_quat(scalar_first=True), (times.size, 1)))

    def on_map(time_s: np.ndarray, p_sensor: np.ndarray) -> np.ndarray:
        boresight = Rotation.from_euler("ZYX", [3.0, -12.0, 1.5], degrees=True).as_matrix()
        body = p_sensor @ (boresight @ np.diag([1.0, -1, -1])).T + np.array([-1.7, 0.6, -2.1])
        ecef = origin + time_s[:, None] * step + body @ attitude.as_matrix().T
        if crs is None:
            c, s = np.cos(np.radians(25.0)), np.sin(np.radians(25.0))
            north, east, down = ned.T
            return (ecef - origin) @ np.stack([east * c - north * s, east * s + north * c, -down]).T
        out = Transformer.from_crs(world, Transformer.from_crs(crs, crs).source_crs.to_3d(), always_xy=True)
        unit = 0.30480060960121924 if "feet" in place else 1.0
        x, y, z = out.transform(*ecef.T)
        return np.stack([np.array(x) * unit, np.array(y) * unit, np.array(z)], axis=1)

    return path, frame, on_map


def placement(path: Trajectory, frame: MapFrame, **limits: float) -> Placement:
    return Placement(
        trajectory=path,
        charts=charts_along(frame, path.world, path.position_world_m),
        mountings=Mountings.one(SENSOR.mounting()),
        range_min_m=limits.pop("range_min_m", 0.0),
        range_max_m=limits.pop("range_max_m", np.inf),
        heights=HeightLimits(**limits),
        tile_quanta=TILE_QUANTA,
    )


def returns(times_s: np.ndarray, xyz: np.ndarray) -> pa.RecordBatch:
    epochs = np.round(times_s * NS_PER_S).astype(np.int64) + 10**18
    return pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": epochs,
            "pose_epoch_gps_ns": epochs,
            **{f"{a}_sensor_m": xyz[:, i].astype(np.float32) for i, a in enumerate("xyz")},
            "intensity": np.arange(len(xyz), dtype=np.uint16),
        }
    )


def metres(placed) -> np.ndarray:
    whole = placed.tiles.astype(np.int64) * TILE_QUANTA + placed.quanta[:, :2]
    return np.column_stack([whole, placed.quanta[:, 2]]) * 1e-5


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("heading", "roll", "pitch"), [(0, 0, 0), (359.5, 5, 6.8), (181, -5, -6.8), (91, 3, 2)])
def test_returns_lie_where_the_independent_chain_puts_them(place, heading, roll, pitch) -> None:
    path, frame, on_map = scene(place, heading, roll, pitch)
    rng = np.random.default_rng(3)
    times = np.round(rng.uniform(0.1, 3.8, 500), 9)
    xyz = rng.uniform(-100, 100, (500, 3)).astype(np.float32)
    placed = placement(path, frame).returns(returns(times, xyz), EVERYWHERE)
    assert placed.fates[0] == 500
    assert np.abs(metres(placed) - on_map(times, xyz.astype(np.float64))).max() < 2e-5


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("period_ns", [0.0, 37_037.0])
def test_profiles_lie_where_the_independent_chain_puts_them(place, period_ns) -> None:
    path, frame, on_map = scene(place, 217.0, -4.0, 5.0)
    rng = np.random.default_rng(4)
    geometry = ScanGeometry(
        kind="polar", readings=180, first=-1.5, step=3.0 / 179, range_offset_m=0.5, range_step_m=0.001,
        reading_period_ns=period_ns,
    )  # fmt: skip
    times = np.sort(np.round(rng.uniform(0.1, 3.7, 50), 9))
    raw = rng.integers(0, 65_000, (50, 180)).astype(np.uint16)
    raw[3, 7] = 0
    batch = pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": np.round(times * NS_PER_S).astype(np.int64) + 10**18,
            "range": pa.FixedSizeListArray.from_arrays(pa.array(raw.ravel()), 180),
            "intensity": pa.nulls(50, pa.list_(pa.uint8(), 180)),
        }
    )
    placed = placement(path, frame).profiles(batch, geometry, EVERYWHERE)
    angle = -1.5 + np.arange(180) * 3.0 / 179
    distance = 0.5 + 0.001 * raw
    xyz = np.stack([np.zeros_like(distance), distance * np.sin(angle), distance * np.cos(angle)], axis=-1)
    when = times[:, None] + np.arange(180) * period_ns * 1e-9
    keep = raw.ravel() > 0
    expected = on_map(when.ravel()[keep], xyz.reshape(-1, 3)[keep])
    assert placed.fates[5] == (raw == 0).sum()
    assert np.abs(metres(placed) - expected).max() < 2e-5


def test_sweep_already_compensated_is_taken_at_its_reference_epoch() -> None:
    path, frame, _ = scene("utm north", 45, 0, 0)
    xyz = np.array([[5.0, 1.0, -1.0]] * 2)
    batch = returns(np.array([1.0, 1.05]), xyz)
    moved = batch.set_column(1, "pose_epoch_gps_ns", pa.array(np.full(2, NS_PER_S + 10**18)))
    placed = placement(path, frame).returns(moved, EVERYWHERE)
    assert np.array_equal(placed.quanta[0], placed.quanta[1])
    assert placed.epoch_gps_ns[1] - placed.epoch_gps_ns[0] == 50_000_000
    apart = metres(placement(path, frame).returns(batch, EVERYWHERE))
    assert np.linalg.norm(apart[1] - apart[0]) == pytest.approx(1.0, abs=2e-3)  # 20 m/s · 0.05 s (grid scale aside)


def test_every_reading_has_one_fate() -> None:
    path, frame, _ = scene("utm north", 10, 0, 0)
    times = np.array([1.0, 1.0, 1.0, 99.0, 1.0])
    xyz = np.array([[0.5, 0, 0], [5, 0, 0], [200, 0, 0], [5, 0, 0], [5, 0, 40.0]])
    p = placement(path, frame, range_min_m=1.0, range_max_m=100.0, above_body_max_m=20.0)
    placed = p.returns(returns(times, xyz), EVERYWHERE)
    assert placed.fates.tolist() == [1, 1, 2, 1, 0, *[0] * 6]
    column, row = placed.tiles[0]
    window = Window(int(column) + 1, int(row), int(column) + 2, int(row) + 1)
    assert p.returns(returns(times, xyz), window).fates.tolist() == [0, 1, 2, 1, 1, *[0] * 6]


def test_intensity_of_eight_bits_fills_sixteen() -> None:
    path, frame, _ = scene("utm north", 10, 0, 0)
    geometry = ScanGeometry(kind="cartesian", readings=2, first=-1, step=2, range_step_m=0.001)
    batch = pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": np.array([NS_PER_S + 10**18]),
            "range": pa.FixedSizeListArray.from_arrays(pa.array([1000, 1000], pa.uint16()), 2),
            "intensity": pa.FixedSizeListArray.from_arrays(pa.array([0, 255], pa.uint8()), 2),
        }
    )
    assert placement(path, frame).profiles(batch, geometry, EVERYWHERE).intensity.tolist() == [0, 65_535]


def test_passes_are_half_open_spans() -> None:
    from roadscan.core.grid import LanePass, PassId, RunId

    passes = [LanePass(PassId(7), RunId("r"), 10, 20), LanePass(PassId(9), RunId("r"), 20, 30)]
    assert passes_of(np.array([9, 10, 19, 20, 29, 30]), passes).tolist() == [0, 7, 7, 9, 9, 0]
    for epochs in (
        np.array([9, 10, 19, 20, 29, 30]),
        np.array([30, 9, 20, 10, 19, 29]),
        np.array([11, 12]),
        np.array([], int),
    ):
        for some in (passes, passes[:1]):
            ids = np.array([3, 7, 9], np.uint16)
            wanted = [list(ids).index(k) if k else -1 for k in passes_of(epochs, some)]
            assert pass_numbers(epochs, some, ids).tolist() == wanted


def test_each_reading_is_placed_by_the_mounting_of_its_epoch() -> None:
    path, frame, _ = scene("utm north", 91.0, 3.0, 2.0)
    rng = np.random.default_rng(8)
    times = np.round(rng.uniform(0.1, 3.7, 300), 9)
    xyz = rng.uniform(-30, 30, (300, 3)).astype(np.float32)
    xyz[5] = 0.0  # nearer than the limit, in the second mounting's time or the first's
    later = Sensor(kind="lidar", axes="flu", lever_arm_body_m=(1.0, 0.2, -2.0), boresight={"heading_deg": 40.0})
    since = 10**18 + 2 * NS_PER_S
    both = Mountings((0, since), (SENSOR.mounting(), later.mounting()))
    base = placement(path, frame, range_min_m=1.0)

    def placed(mountings: Mountings):
        return dataclasses.replace(base, mountings=mountings).returns(returns(times, xyz), EVERYWHERE, marked=True)

    mixed, first, second = (
        placed(both),
        placed(Mountings.one(SENSOR.mounting())),
        placed(Mountings.one(later.mounting())),
    )
    before = times < 2.0
    assert mixed.tiles.shape == (300, 2)
    np.testing.assert_array_equal(mixed.quanta, np.where(before[:, None], first.quanta, second.quanta))
    np.testing.assert_array_equal(mixed.tiles, np.where(before[:, None], first.tiles, second.tiles))
    np.testing.assert_array_equal(mixed.intensity, np.arange(300))
    np.testing.assert_array_equal(mixed.classes, first.classes)
    assert mixed.classes[5] != 0 and (mixed.fates == first.fates).all()
    assert not np.array_equal(first.quanta, second.quanta)


def test_profiles_too_are_placed_by_the_mounting_of_their_epoch() -> None:
    path, frame, _ = scene("local", 91.0, 3.0, 2.0)
    geometry = ScanGeometry(kind="polar", readings=40, first=-0.5, step=0.025, range_offset_m=0.5, range_step_m=0.001)
    times = np.array([0.5, 2.5, 1.0, 3.0])  # out of order on purpose
    raw = np.arange(160).reshape(4, 40).astype(np.uint16) * 100
    batch = pa.RecordBatch.from_pydict(
        {
            "epoch_gps_ns": np.round(times * NS_PER_S).astype(np.int64) + 10**18,
            "range": pa.FixedSizeListArray.from_arrays(pa.array(raw.ravel()), 40),
            "intensity": pa.nulls(4, pa.list_(pa.uint8(), 40)),
        }
    )
    later = Sensor(kind="lidar", axes="flu", lever_arm_body_m=(1.0, 0.2, -2.0))
    base = placement(path, frame)
    both = Mountings((0, 10**18 + 2 * NS_PER_S), (SENSOR.mounting(), later.mounting()))

    def placed(mountings: Mountings):
        return dataclasses.replace(base, mountings=mountings).profiles(batch, geometry, EVERYWHERE)

    mixed, first, second = (
        placed(both),
        placed(Mountings.one(SENSOR.mounting())),
        placed(Mountings.one(later.mounting())),
    )
    before = np.repeat(times < 2.0, 40)[raw.ravel() > 0]
    np.testing.assert_array_equal(mixed.quanta, np.where(before[:, None], first.quanta, second.quanta))
    np.testing.assert_array_equal(mixed.epoch_gps_ns, first.epoch_gps_ns)
