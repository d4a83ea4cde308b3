"""Readings with an epoch each: pose steps against exact poses, and independence of how readings are batched."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from roadscan.compute.kernel_options import read_only
from roadscan.core.crs import LOCAL_WORLD, Anchor, MapFrame
from roadscan.core.rig import Mounting
from roadscan.georeference.charts import charts_along, georeference_of
from roadscan.georeference.kernels.readings import (
    CLASS_KEPT,
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    FATES,
    Georeference,
    Georeferenced,
    Limits,
    MirrorProfiles,
    Returns,
)
from roadscan.georeference.kernels.timed_readings import STEP_NS, place_mirror, place_returns
from roadscan.poses.trajectory import Trajectory

START = 10**18
WIDE = (0.0, 1e4, -1e5, 1e5, -1e5, 1e5)
LEVER, BORESIGHT = np.array([-1.7, 0.6, -2.1]), Rotation.from_euler("ZYX", [30.0, -12.0, 4.0], degrees=True)
MOUNTING = Mounting(tuple(LEVER.tolist()), tuple(map(tuple, BORESIGHT.as_matrix().tolist())))
PER_M = 1e9
YARD = MapFrame(crs=None, local_name="yard", anchor=Anchor(48.0, 11.0, 500.0, 0.0))


def common(path: Trajectory, frame: MapFrame, limits=WIDE, per_m=PER_M) -> Georeference:
    charts = charts_along(frame, path.world, path.position_world_m)
    made = georeference_of(MOUNTING, path, charts, Limits(*limits))
    return made._replace(quanta_per_m=per_m)


def outputs(n: int) -> tuple[np.ndarray, ...]:
    return np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.uint8), np.empty(n, np.int32), np.zeros(FATES, int)


def placed(start: int, end: int, epochs: np.ndarray, xyz: np.ndarray, how: Georeference) -> tuple[np.ndarray, ...]:
    out = outputs(end - start)
    columns = (read_only(np.ascontiguousarray(xyz[:, a])) for a in range(3))
    place_returns(start, end, Returns(read_only(epochs), *columns), how, Georeferenced(*out[:5]), out[5])
    return out


def wild_drive(knot_ns: int) -> Trajectory:
    """Turning at 300 °/s, from 1 s on braked by 5 rad/s² at once, rolling and pitching, at 10 m/s²."""
    epochs = START + np.arange(0, 2_000_000_001, knot_ns)
    t = (epochs - START) * 1e-9
    rate, bend = np.radians(300.0), 5.0
    angle = rate * t - 0.5 * bend * np.maximum(t - 1.0, 0.0) ** 2
    attitude = Rotation.from_euler("ZYX", np.column_stack([angle, 0.3 * np.sin(2 * t), 0.2 * np.cos(3 * t)]))
    position = np.column_stack([5.0 * t**2, 30.0 * t, 2.0 + np.sin(3 * t)])
    return Trajectory.of(LOCAL_WORLD, epochs, position, attitude.as_quat(scalar_first=True))


def exact(path: Trajectory, epochs: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    poses = path.poses(epochs, strict=True)
    body = BORESIGHT.apply(xyz) + LEVER
    return poses.position_world_m + np.einsum("nij,nj->ni", poses.world_from_body, body)


@pytest.mark.parametrize("knot_ns", [1_000_000, 5_000_000, 8_000_000, 100_000_000])
def test_pose_steps_stay_within_a_micrometre_at_a_hundred_metres(knot_ns: int) -> None:
    path = wild_drive(knot_ns)
    rng = np.random.default_rng(1)
    epochs = np.sort(rng.integers(*path.span_gps_ns, 4000))
    epochs[:200] = rng.choice(path.epochs_gps_ns, 200)  # knots themselves, and the last one
    epochs[-1] = path.span_gps_ns[1]
    away = rng.normal(size=(4000, 3))
    xyz = (100.0 * away / np.linalg.norm(away, axis=1)[:, None]).astype(np.float32)
    east, north, height, classes, intervals, fates = placed(0, 4000, epochs, xyz, common(path, YARD))
    assert (classes == CLASS_KEPT).all() and not fates.any()
    np.testing.assert_array_equal(
        intervals, np.minimum(np.searchsorted(path.epochs_gps_ns, epochs, "right") - 1, path.epochs_gps_ns.size - 2)
    )
    found = np.column_stack([east, north, height]) / PER_M
    assert np.linalg.norm(found - exact(path, epochs, xyz.astype(float)), axis=1).max() < 1e-6


def mirror(path: Trajectory, limits=WIDE) -> tuple:
    rng = np.random.default_rng(2)
    angle = np.radians(np.linspace(-90, 90, 181))
    zero = np.zeros(181)
    rays = np.zeros((181, 3)), np.column_stack([zero, np.sin(angle), np.cos(angle)])
    ranges = rng.integers(1, 65_000, (40, 181)).astype(np.uint16)
    ranges[3, 50] = 0
    epochs = START + 13_333_333 * np.arange(40)
    profiles = MirrorProfiles(read_only(epochs), read_only(ranges), *rays, (0.5, 0.0015), 37_037.04)
    return profiles, common(path, YARD, limits)


def test_readings_of_a_mirror_lie_where_exact_poses_put_them() -> None:
    path = wild_drive(5_000_000)
    how = mirror(path)
    out = outputs(40 * 181)
    place_mirror(0, 40, *how, Georeferenced(*out[:5]), out[5])
    epochs, ranges, _, directions, *_ = how[0]
    when = (epochs[:, None] + np.floor(np.arange(181) * 37_037.04 + 0.5).astype(np.int64)).ravel()
    xyz = ((0.5 + 0.0015 * ranges)[:, :, None] * directions).reshape(-1, 3)
    seen = ranges.ravel() > 0
    found = np.column_stack(out[:3]) / PER_M
    assert np.linalg.norm(found - exact(path, when, xyz), axis=1)[seen].max() < 1e-6
    assert out[3][~seen].tolist() == [CLASS_NO_RETURN] and out[5].tolist() == [0, 0, 0, 0, 0, 1]


def test_no_bit_depends_on_how_returns_are_divided_or_ordered() -> None:
    path = wild_drive(7_000_000)
    rng = np.random.default_rng(3)
    n = 3000
    epochs = np.sort(rng.integers(path.span_gps_ns[0] - 10**8, path.span_gps_ns[1] + 10**8, n))
    xyz = rng.uniform(-90, 90, (n, 3)).astype(np.float32)
    how = common(path, YARD, (1.0, 120.0, -20.0, 1e5, -50.0, 60.0))
    whole = placed(0, n, epochs, xyz, how)
    assert set(np.unique(whole[3])) > {CLASS_KEPT, CLASS_NO_POSE, CLASS_TOO_FAR}
    cuts = [0, *sorted(rng.choice(n, 40, replace=False).tolist()), n]
    parts = [placed(a, b, epochs, xyz, how) for a, b in itertools.pairwise(cuts)]
    order = rng.permutation(n)
    shuffled = placed(0, n, epochs[order], xyz[order], how)
    kept = whole[3] == CLASS_KEPT
    for column in range(5):
        mine = kept if column < 3 else slice(None)
        np.testing.assert_array_equal(np.concatenate([p[column] for p in parts])[mine], whole[column][mine])
        back = np.empty_like(whole[column])
        back[order] = shuffled[column]
        np.testing.assert_array_equal(back[mine], whole[column][mine])
    assert sum(p[5] for p in parts).tolist() == shuffled[5].tolist() == whole[5].tolist()
    low, high = whole[5][2], whole[5][3]
    distance = np.linalg.norm(xyz.astype(float), axis=1)
    assert low == ((distance < 1.0) | (distance > 120.0)).sum() and high > 0


def test_no_bit_depends_on_how_profiles_of_a_mirror_are_divided() -> None:
    how = mirror(wild_drive(5_000_000), (5.0, 80.0, -1e5, 40.0, -1e5, 1e5))
    whole, one = outputs(40 * 181), outputs(181)
    place_mirror(0, 40, *how, Georeferenced(*whole[:5]), whole[5])
    for p in range(40):
        place_mirror(p, p + 1, *how, Georeferenced(*one[:5]), one[5])
        kept = one[3] == CLASS_KEPT
        for column in range(5):
            mine = kept if column < 3 else slice(None)
            np.testing.assert_array_equal(one[column][mine], whole[column][p * 181 : (p + 1) * 181][mine])
    assert one[5].tolist() == whole[5].tolist() and (whole[5] > 0).sum() >= 3


def test_gaps_and_ends_of_the_trajectory_are_where_they_are() -> None:
    full = wild_drive(5_000_000)
    keep = (full.epochs_gps_ns <= START + 500_000_000) | (full.epochs_gps_ns >= START + 800_000_000)
    path = Trajectory.of(
        LOCAL_WORLD, full.epochs_gps_ns[keep], full.position_world_m[keep], full.quaternion_world_from_body[keep], 0.1
    )
    edges = START + np.array([0, 500_000_000, 800_000_000, 2_000_000_000])
    epochs = np.sort(np.concatenate([edges + d for d in (-STEP_NS, -1, 0, 1, STEP_NS)]))
    out = placed(0, epochs.size, epochs, np.full((epochs.size, 3), 5.0, np.float32), common(path, YARD))
    found = path.poses(epochs).found
    np.testing.assert_array_equal(out[3] == CLASS_KEPT, found)
    np.testing.assert_array_equal(out[3] == CLASS_NO_POSE, ~found)
    assert out[5][1] == (~found).sum() > 0
    np.testing.assert_array_equal(out[4] >= 0, (epochs >= edges[0]) & (epochs <= edges[-1]))


def test_points_meet_across_the_borders_of_charts() -> None:
    """A fast straight run through several 200 m boxes: PROJ point by point."""
    world = "EPSG:4978"
    to_world = Transformer.from_crs("EPSG:4979", world, always_xy=True)
    begin = np.array(to_world.transform(9.9, 48.1, 520.0))
    along = np.array(to_world.transform(9.913, 48.104, 520.0)) - begin  # 1 km in 2 s
    t = np.arange(0, 2.001, 0.01)
    turned = np.tile(Rotation.from_euler("ZYX", [0.3, 0.2, 0.1]).as_quat(scalar_first=True), (t.size, 1))
    path = Trajectory.of(world, START + np.round(t * 1e9).astype(np.int64), begin + along * t[:, None] / 2, turned)
    frame = MapFrame(crs="EPSG:32632")
    to_map = Transformer.from_crs(world, Transformer.from_crs("EPSG:32632", world).source_crs.to_3d(), always_xy=True)
    epochs = START + np.linspace(0, 2_000_000_000, 3000).astype(np.int64)
    xyz = np.random.default_rng(5).uniform(-60, 60, (3000, 3)).astype(np.float32)
    how = common(path, frame, per_m=1e6)
    out = placed(0, 3000, epochs, xyz, how)
    expected = np.column_stack(to_map.transform(*exact(path, epochs, xyz.astype(float)).T))
    assert np.unique(np.floor(path.position_world_m / 200.0), axis=0).shape[0] > 4
    assert np.abs(np.column_stack(out[:3]) * 1e-6 - expected).max() < 1e-5
