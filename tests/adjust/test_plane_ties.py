"""Ties of planes that windows of one drive saw, on drawn ground and a drawn wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roadscan.adjust.adjustment import adjust
from roadscan.adjust.observations import COMMON, KINDS, GaussMarkov, Observations, RunPrior
from roadscan.adjust.places import PassReadings, Place, Traverse
from roadscan.adjust.settings import AdjustmentSettings, TieSettings
from roadscan.adjust.tasks.tie_work import Ties, ties_at

PLACE = Place(0, 1000.0, 2000.0, 0.0, 8.0, (Traverse(0, "lidar", 0, 10**10),))
NOISE_M = 0.01


def sweeps(shifts: np.ndarray, rng: np.random.Generator) -> PassReadings:
    """Ten returns a square metre a sweep of ground that falls by 2 % to the east, and of a wall 5 m to the east.

    shifts : (s, 3) east, north, up that the poses of each sweep are off.
    """
    points, pose = [], []
    for sweep, off in enumerate(shifts):
        ground = np.column_stack([rng.uniform(-8.0, 5.0, 4000), rng.uniform(-8.0, 8.0, 4000), np.zeros(4000)])
        ground[:, 2] = -0.02 * ground[:, 0] + rng.normal(0.0, NOISE_M, 4000)
        wall = np.column_stack([np.full(1500, 5.0), rng.uniform(-8.0, 8.0, 1500), rng.uniform(0.3, 4.0, 1500)])
        wall[:, 0] += rng.normal(0.0, NOISE_M, 1500)
        points.append(np.concatenate([ground, wall]) + off + [1000.0, 2000.0, 50.0])
        pose.append(np.full(5500, sweep, np.int32))
    all_points, count = np.concatenate(points), len(shifts)
    body = np.tile([1000.0, 2000.0, 51.7], (count, 1)) + np.column_stack(
        [np.zeros(count), np.arange(count), shifts[:, 2]]
    )
    return PassReadings(
        0, "lidar", *all_points.T, np.zeros(len(all_points), np.uint16), np.concatenate(pose),
        400_000_000 * np.arange(count, dtype=np.int64), body, np.tile(np.eye(3), (count, 1, 1)),
        laser=np.zeros(len(all_points), np.uint8),
    )  # fmt: skip


@pytest.fixture(scope="module")
def tied() -> tuple[Ties, np.ndarray]:
    rng = np.random.default_rng(4)
    shifts = rng.normal(0.0, 0.02, (6, 3))
    return ties_at(PLACE, [sweeps(shifts, rng)], TieSettings(most_planes=300)), shifts


def test_planes_say_how_far_sweeps_lie_apart_along_their_normals(tied: tuple[Ties, np.ndarray]) -> None:
    ties, shifts = tied
    c = ties.columns
    assert set(c["kind"]) == {"plane_tie"}
    first, second = (c[f"{end}_epoch_gps_ns"] // 400_000_000 for end in ("first", "second"))
    direction = np.stack([c["direction_east"], c["direction_north"], -c["direction_down"]], axis=-1)
    away = np.einsum("ni,ni->n", direction, shifts[second] - shifts[first])
    error = c["value_m"] - away
    upright = np.abs(c["direction_down"]) > 0.9
    assert upright.sum() > 500
    assert (np.abs(c["direction_east"]) > 0.9).sum() > 30
    for which in (upright, ~upright):
        # Even planes: what is added for unevenness makes the σ too large by about half.
        assert 0.1 < np.mean((error[which] / c["sigma_m"][which]) ** 2) < 1.1
    assert np.median(c["direction_east"][upright] / -c["direction_down"][upright]) == pytest.approx(0.02, abs=0.002)


def test_planes_of_other_passes_are_tied_too() -> None:
    """Two runs, one window each: the wall tells their distance across, the ground their height."""
    rng = np.random.default_rng(5)
    one, other = sweeps(np.zeros((1, 3)), rng), sweeps(np.array([[0.03, 0.0, -0.05]]), rng)
    later = PassReadings(1, *(getattr(other, n) for n in list(other.__dataclass_fields__)[1:]))
    ties = ties_at(PLACE, [one, later], TieSettings())
    found = ties.counted()
    assert {tuple(r) for r in found.run.tolist()} == {(0, 1)}
    ground = np.abs(found.partials[:, 0, 2]) > 0.9
    height = -found.observed_m[ground] * np.sign(found.partials[ground, 0, 2])
    assert np.median(height) == pytest.approx(-0.05 + 0.02 * 0.03, abs=0.002)


def test_a_window_is_what_the_laser_with_the_most_returns_saw() -> None:
    """Laser 1, which has four of five returns in the first sweep and one of five in the second, sees 2 cm too low."""
    rng = np.random.default_rng(8)
    seen = sweeps(np.zeros((2, 3)), rng)
    share = np.array([0.8, 0.2])[seen.pose]
    laser = (rng.uniform(size=share.size) < share).astype(np.uint8)
    ties = ties_at(PLACE, [replace(seen, laser=laser, height_m=seen.height_m - 0.02 * laser)], TieSettings())
    c = ties.columns
    upright = (np.abs(c["direction_down"]) > 0.9) & (c["first_laser"] == 1) & (c["second_laser"] == 0)
    assert upright.sum() > 0.8 * (np.abs(c["direction_down"]) > 0.9).sum() > 10
    rise = -c["value_m"] * np.sign(c["direction_down"])
    assert np.median(rise[upright]) == pytest.approx(0.02, abs=0.002)


def test_leaves_are_no_planes() -> None:
    rng = np.random.default_rng(6)
    cloud = np.array([1000.0, 2000.0, 55.0]) + rng.uniform(-4.0, 4.0, (20_000, 3))
    pose = np.repeat(np.arange(4, dtype=np.int32), 5000)
    bush = PassReadings(
        0, "lidar", *cloud.T, np.zeros(20_000, np.uint16), pose, 400_000_000 * np.arange(4, dtype=np.int64),
        np.tile([1000.0, 2000.0, 51.7], (4, 1)), np.tile(np.eye(3), (4, 1, 1)), laser=np.zeros(20_000, np.uint8),
    )  # fmt: skip
    assert ties_at(PLACE, [bush], TieSettings()).observations.size == 0


def test_lasers_that_are_off_do_not_bend_a_drive() -> None:
    """Heights that are right, ties of neighbours whose later end a laser that measures 1 cm more mostly saw."""
    rng = np.random.default_rng(9)
    n, sigma_m, off_m = 2000, 0.005, 0.01
    first = np.sort(rng.integers(0, 59, n))
    epoch = 1_000_000_000 * np.stack([first, first + 1], axis=-1)
    laser = np.where(rng.uniform(size=(n, 1)) < 0.8, [[0, 1]], [[1, 0]])
    sign = np.array([1.0, -1.0])
    partials = np.zeros((n, 2, 6))
    partials[:, :, 2] = sign
    common, by_common = np.full((n, len(COMMON)), -1, np.int32), np.zeros((n, len(COMMON)))
    common[:, :2], by_common[:, :2] = laser, 0.01 * sign
    away = np.where(laser[:, 1] == 1, -off_m, off_m) + rng.normal(0.0, sigma_m, n)
    ties = Observations(
        np.full(n, KINDS.index("plane_tie"), np.uint8), np.zeros((n, 2), np.int32), epoch, partials, away,
        np.full(n, sigma_m), np.arange(n), np.arange(n), common=common, common_partials=by_common,
    )  # fmt: skip
    level, turn = GaussMarkov(0.03, 60.0), GaussMarkov(0.0, 60.0)
    prior = RunPrior("drive", 0, 59_000_000_000, (level, level, level, turn, turn, turn))
    settings = AdjustmentSettings(knot_spacing_s=1.0, estimate_variance_components=False)
    blind = replace(ties, common=np.full_like(common, -1))
    found, bent = (adjust(own, [prior], settings).values[0][:, 2] for own in (ties, blind))
    assert np.ptp(bent) > 0.1
    assert np.ptp(found) < 0.02
