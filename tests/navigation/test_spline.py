"""Spline smoothing against the truth of a simulated drive: smaller errors inside outages, not a bit changed outside."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.settings.navigation import SmootherConfig, SplineConfig
from roadscan.navigation.inertial.smoother import solve
from roadscan.navigation.spline import Smoothed, smoothed
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene
from roadscan.simulate.drive import drives_of
from roadscan.simulate.path import Earth
from roadscan.simulate.surface import Surface
from tests.navigation.recorded_drive import recorded_drive

WORLD = "EPSG:4978"
STEP_NS = 10_000_000
ROUTE = [
    {"length_m": 150.0},
    {"length_m": 40.0, "radius_m": 60.0},
    {"length_m": 90.0},
    {"length_m": 70.0, "radius_m": -50.0},
    {"length_m": 100.0},
]


@cache
def truth() -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Epochs, positions and attitudes of a drive of 85 s with two bends, 100 poses a second."""
    scene = Scene().changed(
        length_m=300.0,
        passes=[{"route": {"station_m": 10.0, "offset_m": 0.0, "pieces": ROUTE}}],
        profilers={"on": False},
        lidar={"on": False},
        road={"verge_width_m": 120.0, "lead_m": 200.0},
        vehicle={"standstill_s": 10.0, "speed_m_per_s": 9.0},
    )
    drive = drives_of(scene, Earth(scene.map.crs), Surface(scene, ride=True))[0]
    first, last = drive.recorded_span_gps_ns
    epochs = np.arange(first, last, STEP_NS)
    poses = drive.poses(epochs)
    return epochs, poses.position_ecef_m, poses.ecef_from_body


def seconds() -> np.ndarray:
    epochs = truth()[0]
    return (epochs - epochs[0]) / NS_PER_S


def drifting(begin_s: float, end_s: float, at2: np.ndarray, at3: np.ndarray, turn_rad: float, seed: int) -> Trajectory:
    """The drive with 1 mm of noise, as a forward filter leaves it: errors grow with t² and t³, and leap back."""
    epochs, position, attitude = truth()
    t = seconds()
    since = np.where(t < end_s, np.clip(t - begin_s, 0.0, None), 0.0)[:, None]
    noise = 0.001 * np.random.default_rng(seed).standard_normal(position.shape)
    wrong = position + noise + since**2 / 2 * at2 + since**3 / 6 * at3
    turned = attitude * Rotation.from_rotvec(since / (end_s - begin_s) * [0.0, 0.0, turn_rad])
    return Trajectory(WORLD, epochs, wrong, turned.as_quat(scalar_first=True))


def errors(found: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Of positions (m) and attitudes (rad), (n,)."""
    _, position, attitude = truth()
    turn = attitude.inv() * Rotation.from_quat(found.quaternion_world_from_body, scalar_first=True)
    return np.linalg.norm(found.position_world_m - position, axis=1), turn.magnitude()


def untouched_bits(before: Trajectory, found: Smoothed) -> bool:
    same = ~found.touched
    return (
        np.array_equal(found.trajectory.position_world_m[same], before.position_world_m[same])
        and np.array_equal(found.trajectory.quaternion_world_from_body[same], before.quaternion_world_from_body[same])
        and np.array_equal(found.trajectory.epochs_gps_ns, before.epochs_gps_ns)
    )


def velocity_jump(found: Trajectory, at: int) -> float:
    """Change of velocity (m/s) at a pose, from parabolas on both sides of it."""
    t = (found.epochs_gps_ns[at - 30 : at + 31] - found.epochs_gps_ns[at]) / NS_PER_S
    p = found.position_world_m[at - 30 : at + 31] - found.position_world_m[at]
    slopes = [np.polynomial.polynomial.polyfit(t[s], p[s], 2)[1] for s in (slice(0, 31), slice(31, 61))]
    return float(np.linalg.norm(slopes[1] - slopes[0]))


@settings(max_examples=12, deadline=None, derandomize=True)  # of all draws some keep 0.4 of their error
@given(st.integers(0, 2**31), st.floats(10.0, 25.0), st.floats(8.0, 30.0))
def test_drift_of_an_outage_is_taken_back(seed: int, begin_s: float, long_s: float) -> None:
    rng = np.random.default_rng(seed)
    at2, at3 = 0.004 * rng.standard_normal(3), 1e-4 * rng.standard_normal(3)
    before = drifting(begin_s, begin_s + long_s, at2, at3, 0.01, seed)
    outage = (
        int(before.epochs_gps_ns[0] + begin_s * NS_PER_S),
        int(before.epochs_gps_ns[0] + (begin_s + long_s) * 1e9),
    )
    found = smoothed(before, SplineConfig(), [outage])
    inside = (seconds() > begin_s) & (seconds() < begin_s + long_s)
    worst, mended = errors(before)[0][inside].max(), errors(found.trajectory)[0][inside].max()
    assert untouched_bits(before, found)
    assert not found.touched[~inside].any()
    if worst > 0.1:
        assert [c.kind for c in found.changes] == ["step"]
        assert mended < 0.35 * worst
        assert errors(found.trajectory)[1][inside].max() < 0.7 * errors(before)[1][inside].max()
        change = found.changes[0]
        assert change.greatest_shift_m == pytest.approx(worst, rel=0.1, abs=0.02)
        assert change.poses == found.touched.sum()


def test_end_of_the_outage_is_continuous() -> None:
    at2 = np.array([0.004, -0.003, 0.002])
    before = drifting(20.0, 50.0, at2, np.zeros(3), 0.02, 1)
    found = smoothed(before, SplineConfig(), [(int(before.epochs_gps_ns[2000]), int(before.epochs_gps_ns[5000]))])
    at = int(np.flatnonzero(seconds() >= 50.0)[0]) - 1
    steps = np.linalg.norm(np.diff(found.trajectory.position_world_m, n=2, axis=0), axis=1)
    assert np.linalg.norm(np.diff(before.position_world_m, n=2, axis=0), axis=1).max() > 2.0
    seam = steps[[*range(at - 5, at + 5), *range(1995, 2005)]]
    assert seam.max() < 0.01  # with 1 mm of noise
    assert velocity_jump(before, at) > 0.1
    assert velocity_jump(found.trajectory, at) < 0.05
    assert velocity_jump(found.trajectory, 2000) == pytest.approx(velocity_jump(before, 2000), abs=0.001)


def test_outages_are_found_by_sigma_or_by_the_leap_alone() -> None:
    before = drifting(20.0, 50.0, np.array([0.004, -0.003, 0.002]), np.array([0.0, 1e-4, 0.0]), 0.0, 2)
    t = seconds()
    grown = 0.01 + np.where((t > 20.0) & (t < 50.0), 0.0005 * np.clip(t - 20.0, 0.0, None) ** 2, 0.0)
    told = Trajectory(*list(vars(before).values())[:4], 1.0, np.repeat(grown[:, None], 3, axis=1))
    by_sigma, by_leap = smoothed(told, SplineConfig()), smoothed(before, SplineConfig())
    worst = errors(before)[0].max()
    assert worst > 2.0
    assert errors(by_sigma.trajectory)[0].max() < 0.15 * worst
    # Nothing says when the drift began: it is taken back over `step_reach_s`.
    assert errors(by_leap.trajectory)[0].max() < 0.4 * worst
    assert "step (2026-05-04T09:30:" in str(by_sigma.changes[0])
    assert by_sigma.trajectory.sigma_ned_m is told.sigma_ned_m


def test_jitter_is_replaced_by_a_spline() -> None:
    epochs, position, attitude = truth()
    rng = np.random.default_rng(3)
    t = seconds()
    rugged = (t > 30.0) & (t < 45.0)
    wrong = position + rng.standard_normal(position.shape) * np.where(rugged, 0.03, 0.001)[:, None]
    shaken = attitude * Rotation.from_rotvec(
        rng.standard_normal(position.shape) * np.where(rugged, 3e-3, 1e-5)[:, None]
    )
    before = Trajectory(WORLD, epochs, wrong, shaken.as_quat(scalar_first=True))
    found = smoothed(before, SplineConfig())
    assert [c.kind for c in found.changes] == ["jitter"]
    was, now = (np.sqrt((errors(x)[0][rugged] ** 2).mean()) for x in (before, found.trajectory))
    assert was > 0.05
    assert now < 0.25 * was
    turned = [np.sqrt((errors(x)[1][rugged] ** 2).mean()) for x in (before, found.trajectory)]
    assert turned[1] < 0.6 * turned[0]
    assert untouched_bits(before, found)
    assert not found.touched[(t < 28.0) | (t > 47.0)].any()
    edge = int(np.flatnonzero(found.touched)[0])
    assert np.linalg.norm(found.trajectory.position_world_m[edge] - wrong[edge]) < 1e-4


def test_attitude_that_does_not_scatter_is_left_alone() -> None:
    """Springs move faster than the spline's knots: a smooth attitude would only lose by it."""
    epochs, position, attitude = truth()
    rugged = (seconds() > 30.0) & (seconds() < 45.0)
    noise = np.random.default_rng(4).standard_normal(position.shape) * np.where(rugged, 0.03, 0.001)[:, None]
    before = Trajectory(WORLD, epochs, position + noise, attitude.as_quat(scalar_first=True))
    found = smoothed(before, SplineConfig())
    assert found.touched.any()
    assert errors(found.trajectory)[1].max() < 1e-7


def test_a_good_trajectory_stays_as_it_is() -> None:
    epochs, position, attitude = truth()
    for noise_m in (0.0, 0.0005, 0.01):
        noisy = position + noise_m * np.random.default_rng(5).standard_normal(position.shape)
        before = Trajectory(WORLD, epochs, noisy, attitude.as_quat(scalar_first=True))
        found = smoothed(before, SplineConfig(fill_gap_s=10.0), [(int(epochs[3000]), int(epochs[5000]))])
        assert found.changes == []
        assert np.array_equal(found.trajectory.position_world_m, noisy)


@pytest.mark.slow
def test_filled_gaps_state_an_honest_sigma() -> None:
    """Gaps of 1 to 6 s at many places: errors in the middle, divided by their σ, have about unit variance."""
    epochs, position, attitude = truth()
    noisy = position + 0.001 * np.random.default_rng(6).standard_normal(position.shape)
    ratios, turns = [], []
    for long_s in (1.0, 3.0, 6.0):
        for start_s in np.arange(15.0, 65.0, 10.0):
            keep = ~((seconds() > start_s) & (seconds() < start_s + long_s))
            quaternion = attitude.as_quat(scalar_first=True)[keep]
            sigma = np.full((keep.sum(), 3), 0.001)
            before = Trajectory(WORLD, epochs[keep], noisy[keep], quaternion, 0.5, sigma)
            found = smoothed(before, SplineConfig(fill_gap_s=6.5))
            assert np.array_equal(found.trajectory.epochs_gps_ns, epochs)
            assert np.array_equal(found.touched, ~keep)
            assert np.array_equal(found.trajectory.position_world_m[keep], noisy[keep])
            middle = int((start_s + long_s / 2) * NS_PER_S / STEP_NS)
            error, turn = errors(found.trajectory)
            ratios.append(error[middle] / np.linalg.norm(found.trajectory.sigma_ned_m[middle]))  # type: ignore[index]
            turns.append(turn.max())
            assert "poses filled in, 1 σ up to" in str(found.changes[0])
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5
    assert max(ratios) < 4.0
    assert np.degrees(max(turns)) < 15.0


def test_gaps_are_filled_only_up_to_the_stated_length() -> None:
    epochs, position, attitude = truth()
    keep = ~((seconds() > 30.0) & (seconds() < 36.0))
    before = Trajectory(WORLD, epochs[keep], position[keep], attitude.as_quat(scalar_first=True)[keep])
    for config in (SplineConfig(), SplineConfig(fill_gap_s=5.0)):
        assert smoothed(before, config).trajectory is before
    filled = smoothed(before, SplineConfig(fill_gap_s=7.0)).trajectory
    assert filled.sigma_ned_m is not None
    assert np.isnan(filled.sigma_ned_m[:2900]).all()  # what was there states none
    assert np.isfinite(filled.sigma_ned_m[3100:3500]).all()


def test_step_in_a_local_frame_and_few_poses() -> None:
    t = np.arange(0.0, 40.0, 0.05)
    position = np.stack([5 * t, np.zeros_like(t), np.zeros_like(t)], axis=1)
    position[t < 20.0] += np.stack([np.zeros_like(t), 0.001 * t**2, np.zeros_like(t)], axis=1)[t < 20.0]
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (t.size, 1))
    before = Trajectory("local", np.round(t * NS_PER_S).astype(np.int64), position, quaternion)
    found = smoothed(before, SplineConfig(), [(int(0.05e9), int(20e9))])
    assert np.abs(found.trajectory.position_world_m[:, 1]).max() < 0.03  # 0.4 m before
    few = Trajectory("local", before.epochs_gps_ns[:5], position[:5], quaternion[:5])
    assert smoothed(few, SplineConfig()).trajectory is few


def test_outage_that_ends_before_it_begins() -> None:
    epochs, position, attitude = truth()
    before = Trajectory(WORLD, epochs, position, attitude.as_quat(scalar_first=True))
    with pytest.raises(NavigationError, match="an outage ends at 2026-05-04T09:29"):
        smoothed(before, SplineConfig(), [(int(epochs[500]), int(epochs[100]))])


@pytest.mark.slow
def test_forward_filter_of_the_recorded_drive(recordings: Path) -> None:
    """Eleven outages of 15 s: greatest horizontal error of each, of a real-time filter before and after."""
    imu, gnss, _, vehicle = recorded_drive(recordings)
    t = (gnss.epochs_gps_ns - gnss.epochs_gps_ns[0]) / NS_PER_S
    spans = [(40.0 + 45 * k, 55.0 + 45 * k) for k in range(11)]
    seen = ~np.any([(t >= a) & (t < b) for a, b in spans], axis=0)
    arrays = {f.name: getattr(gnss, f.name)[seen] for f in fields(gnss) if f.name != "world"}
    solution = solve(imu, replace(gnss, **arrays), None, vehicle, SmootherConfig(), smooth=False)
    before = Trajectory(
        solution.world, solution.epochs_gps_ns, solution.position_world_m, solution.quaternion_world_from_body
    )
    outages = [(int(gnss.epochs_gps_ns[t < a][-1]), int(gnss.epochs_gps_ns[t >= b][0])) for a, b in spans]
    found = smoothed(before, SplineConfig(), outages)
    up = gnss.position_world_m[0] / np.linalg.norm(gnss.position_world_m[0])

    def worst(one: Trajectory) -> np.ndarray:
        poses = one.poses(gnss.epochs_gps_ns)
        antenna = poses.position_world_m + poses.world_from_body @ vehicle.antenna_lever_arm_body_m
        error = antenna - gnss.position_world_m
        flat = np.linalg.norm(error - (error @ up)[:, None] * up, axis=1)
        return np.array([np.nanmax(flat[(t >= a) & (t < b)]) for a, b in spans])

    was, now = worst(before), worst(found.trajectory)
    assert np.median(now) < 0.5 * np.median(was)
    assert now.max() < 0.3 * was.max()
    assert untouched_bits(before, found)
