"""What the adjustment tells of lasers, of a seeming roll, and of walls that lean, against errors that were put in."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from roadscan.adjust.adjustment import CommonErrors, adjust
from roadscan.adjust.observations import COMMON, KINDS, GaussMarkov, Observations, RunPrior
from roadscan.adjust.places import LASERS, PLANE, Track
from roadscan.adjust.settings import AdjustmentSettings
from roadscan.adjust.tasks.mountings import Mounted
from roadscan.adjust.tasks.tie_work import lidar_error_findings, lidar_error_lines
from roadscan.adjust.ties.plane import lean_findings, leans

MOUNTED = Mounted((), {("drive", "lidar"): None}, frozenset(), common_sigma=(0.01, math.radians(0.1)))  # type: ignore[dict-item]
OFFS_M = np.random.default_rng(3).normal(0.0, 0.01, 16)  # of the lasers, as their σ says


def adjusted(offs_m: npt.NDArray[np.float64]) -> CommonErrors:
    """Errors of lasers after an adjustment of ties between neighbouring seconds, each seen by two lasers."""
    rng, n, sigma_m = np.random.default_rng(9), 3000, 0.005
    first = rng.integers(0, 59, n)
    laser = rng.integers(0, offs_m.size, (n, 2)).astype(np.int32)
    sign = np.array([1.0, -1.0])
    partials = np.zeros((n, 2, 6))
    partials[:, :, 2] = sign
    common, by_common = np.full((n, len(COMMON)), -1, np.int32), np.zeros((n, len(COMMON)))
    # A laser of another sensor leaves a gap of 256 in the numbers.
    common[:, :2], by_common[:, :2] = LASERS + laser, 0.01 * sign
    away = offs_m[laser[:, 0]] - offs_m[laser[:, 1]] + rng.normal(0.0, sigma_m, n)
    ties = Observations(
        np.full(n, KINDS.index("plane_tie"), np.uint8), np.zeros((n, 2), np.int32),
        1_000_000_000 * np.stack([first, first + 1], axis=-1), partials, away,
        np.full(n, sigma_m), np.arange(n), np.arange(n), common=common, common_partials=by_common,
    )  # fmt: skip
    level, turn = GaussMarkov(0.03, 60.0), GaussMarkov(0.0, 60.0)
    prior = RunPrior("drive", 0, 59_000_000_000, (level, level, level, turn, turn, turn))
    return adjust(ties, [prior], AdjustmentSettings(knot_spacing_s=1.0, estimate_variance_components=False)).common


def test_errors_of_lasers_are_estimated_with_their_sigma() -> None:
    found = adjusted(OFFS_M)
    assert found.number.tolist() == [LASERS + k for k in range(16)]
    away = (found.error - OFFS_M / 0.01) / found.sigma
    # All sixteen share what is not known of their mean, 1/4 of the stated σ.
    np.testing.assert_allclose(found.sigma, 0.25, atol=0.03)
    assert np.abs(away).max() < 3.0
    relative = 10.0 * ((found.error - found.error.mean()) - (OFFS_M - OFFS_M.mean()) / 0.01)
    assert np.abs(relative).max() < 2.0  # mm


@pytest.mark.witness("laser_ranges_of_ties")
def test_a_laser_that_is_off_by_more_than_is_stated_is_named() -> None:
    two = Mounted((), {("drive", "left"): None, ("drive", "right"): None}, frozenset(), common_sigma=(0.01, 0.001))  # type: ignore[dict-item]
    assert lidar_error_findings(adjusted(OFFS_M), ["drive"], two) == []
    offs = OFFS_M.copy()
    offs[5] = 0.06
    [finding] = lidar_error_findings(adjusted(offs), ["drive"], two)
    assert finding.subject == "right" and "laser 5 are off by +5" in finding.text
    [line] = lidar_error_lines(adjusted(offs), ["drive"], two)
    assert line.startswith("ranges of 16 lasers of 'right'") and line.endswith("(laser 5)")


@pytest.mark.witness("seeming_roll")
def test_a_roll_that_ties_seem_to_show_is_named_beyond_its_sigma() -> None:
    number = np.array([LASERS + 1])
    usual = CommonErrors(number, np.array([1.5]), np.array([0.5]))
    assert lidar_error_findings(usual, ["first", "second"], MOUNTED) == []
    assert lidar_error_lines(usual, ["first", "second"], MOUNTED) == [
        "roll that the ties within run 'second' seem to show, which moves no pose: +0.150° (σ 0.050°)"
    ]
    large = CommonErrors(number, np.array([-3.4]), np.array([0.5]))
    [finding] = lidar_error_findings(large, ["first", "second"], MOUNTED)
    assert finding.subject == "run 'second'" and "rolled by -0.34° (σ 0.05°)" in finding.text
    blind = CommonErrors(number, np.array([-3.4]), np.array([0.9]))
    assert lidar_error_findings(blind, ["first", "second"], MOUNTED) == []


def street(roll_deg: float, back_deg: float, sides: tuple[int, ...]) -> tuple[dict[str, npt.NDArray[Any]], Track]:
    """Ties of 200 walls, 60 of them hedges, along a road to the north-east, and the track on it."""
    rng, n = np.random.default_rng(5), 200
    along, side = rng.uniform(0.0, 300.0, n), np.array(sides)[rng.integers(0, len(sides), n)]
    seconds = np.arange(61, dtype=np.int64)
    heading = math.radians(45.0)
    # A wall stands back by turning its outward normal down; normals point to either side.
    points_right = rng.choice([-1.0, 1.0], n)
    outward = points_right * side
    lean = np.radians(np.where(np.arange(n) < 140, rng.normal(0.0, 0.2, n), rng.uniform(-6.0, 6.0, n)))
    down = np.sin(points_right * math.radians(roll_deg) + outward * math.radians(back_deg) + lean)
    flat = np.sqrt(1.0 - down**2)
    place = (along // 25.0).astype(np.int64)
    across = 8.0 * side
    columns: dict[str, npt.NDArray[Any]] = {
        "kind": np.full(n, PLANE), "first_run": np.full(n, "drive"), "second_run": np.full(n, "drive"),
        "first_sensor": np.full(n, "lidar"), "second_sensor": np.full(n, "lidar"), "place": place,
        "first_epoch_gps_ns": (along / 5.0 * 1e9).astype(np.int64),
        "easting_m": along * math.sin(heading) + across * math.cos(heading),
        "northing_m": along * math.cos(heading) - across * math.sin(heading),
        "direction_north": -flat * points_right * math.sin(heading), "direction_down": down,
        "first_by_right": flat * points_right, "height_m": 93.0 + rng.uniform(-1.0, 4.0, n),
    }  # fmt: skip
    for number in range(12):
        level = {
            "place": number,
            "height_m": 90.0,
            "direction_down": -1.0,
            "direction_north": 0.0,
            "first_by_right": 0.0,
        }
        columns = {name: np.append(values, level.get(name, values[0])) for name, values in columns.items()}
    track = Track(
        0, "lidar", seconds * 1_000_000_000, seconds * 5.0 * math.sin(heading), seconds * 5.0 * math.cos(heading),
        np.zeros(61), np.full(61, heading), 20.0, 20.0, 20.0,
    )  # fmt: skip
    return columns, track


@pytest.mark.witness("walls_upright")
@pytest.mark.parametrize(
    ("roll_deg", "back_deg", "sides"), [(1.0, 0.0, (-1, 1)), (-1.0, 2.0, (-1, 1)), (2.0, 0.0, (1,))]
)
def test_walls_tell_the_roll_of_a_boresight(roll_deg: float, back_deg: float, sides: tuple[int, ...]) -> None:
    columns, track = street(roll_deg, back_deg, sides)
    [found] = leans(columns, [track], ["drive"])
    assert abs(np.degrees(found.roll_rad) - roll_deg) < 0.1
    assert 0.1 < np.degrees(found.sigma_rad) < (0.15 if len(sides) == 2 else 0.4)
    [finding] = lean_findings([found], ["drive"])
    assert finding.subject == "lidar in run 'drive'" and f"{np.degrees(found.roll_rad):+.2f}° too large" in finding.text


def test_walls_that_stand_back_are_no_roll() -> None:
    for roll_deg, back_deg, sides in ((0.0, 3.0, (-1, 1)), (0.2, 0.0, (-1, 1)), (0.0, 0.7, (1,))):
        columns, track = street(roll_deg, back_deg, sides)
        assert lean_findings(leans(columns, [track], ["drive"]), ["drive"]) == []


def test_barriers_and_cars_are_no_walls() -> None:
    columns, track = street(0.0, 4.2, (1,))
    low = {**columns, "height_m": np.where(columns["direction_down"] > -1.0, 90.9, columns["height_m"])}
    assert lean_findings(leans(columns, [track], ["drive"]), ["drive"])  # such walls would be told …
    assert leans(low, [track], ["drive"]) == []  # … a barrier as low as this is not


def test_few_walls_tell_nothing() -> None:
    columns, track = street(2.0, 0.0, (-1, 1))
    few = {name: values[:19] for name, values in columns.items()}
    one_house = {name: values[columns["place"] == 3] for name, values in columns.items()}
    assert leans(few, [track], ["drive"]) == leans(one_house, [track], ["drive"]) == []
