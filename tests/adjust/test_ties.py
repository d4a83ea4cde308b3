"""Ties of two passes over a drawn road: what they measure, whether their σ are honest, and what must not be a tie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from roadscan.adjust.places import PassReadings
from roadscan.adjust.settings import TieSettings
from roadscan.adjust.tasks.tie_work import Ties, pairs_of, ties_at
from tests.adjust.drawn_patches import PLACE, Road, Seen, bars, crack, dash_end, edge_line, flat, joints, kerb, readings

SETTINGS = TieSettings()
LIFT_M = 0.012


def drawn(road: Road, draws: int, noise_m: float = 0.0005) -> tuple[list[Ties], np.ndarray]:
    """Ties of pairs of passes, and what the second is off against the first: east, north, up (draws, 3)."""
    rng = np.random.default_rng(20_261_123)
    found, off = [], np.column_stack([rng.normal(0.0, 0.02, (draws, 2)), np.full(draws, LIFT_M)])
    for east, north, up in off.tolist():
        one = readings(road, 0, Seen(noise_m=noise_m, turned_rad=rng.normal(0.0, 0.02)), rng)
        other = readings(road, 1, Seen((east, north), up, noise_m, rng.normal(0.0, 0.02)), rng)
        found.append(ties_at(PLACE, [one, other], SETTINGS))
    return found, off


def errors(found: list[Ties], off: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the ties that count, and their σ."""
    error, sigma = [], []
    for ties, truth in zip(found, off, strict=True):
        c = ties.columns
        direction = np.stack([c["direction_east"], c["direction_north"], -c["direction_down"]], axis=-1)
        which = ties.accepted & (c["kind"] == kind)
        error.append((c["value_m"] - direction @ truth)[which])
        sigma.append(c["sigma_m"][which])
    return np.concatenate(error), np.concatenate(sigma)


def of_kind(found: list[Ties], kind: str) -> tuple[int, set[str]]:
    """How many ties of a kind count, and why the others do not."""
    count, why = 0, set()
    for ties in found:
        which = ties.columns["kind"] == kind
        count += int((ties.accepted & which).sum())
        why |= set(ties.columns["why_not"][which].tolist()) - {""}
    return count, why


def test_heights_and_their_sigma() -> None:
    """Readings of 6 mm noise: the normalised squared error of 40 ties lies within its 95 % bounds."""
    found, off = drawn(flat, 40, noise_m=0.006)
    error, sigma = errors(found, off, "height_tie")
    assert error.size == 40
    low, high = chi2.ppf([0.025, 0.975], error.size) / error.size
    assert low < np.mean((error / sigma) ** 2) < high


def test_heights_of_a_profiler_are_good_to_hundredths_of_a_millimetre() -> None:
    found, off = drawn(crack, 10)
    error, sigma = errors(found, off, "height_tie")
    assert error.size == 10
    assert np.sqrt(np.mean(error**2)) < 3e-5
    assert (np.abs(error) < 4.0 * sigma).all()


@pytest.mark.parametrize(
    ("road", "directions", "worst_m"), [(edge_line, 1, 2.5e-3), (dash_end, 2, 4e-3), (crack, 2, 2.5e-3)]
)
def test_shifts_and_their_sigma(road: Road, directions: int, worst_m: float) -> None:
    """A line is known across, a line's end and a winding crack in both directions; σ are no smaller than errors."""
    found, off = drawn(road, 10)
    error, sigma = errors(found, off, "shift_tie")
    assert error.size >= 0.8 * directions * len(found)
    assert np.sqrt(np.mean(error**2)) < worst_m / 1.5
    squares = float(np.sum((error / sigma) ** 2))
    assert squares < chi2.ppf(0.999, error.size)
    assert squares > 0.05 * error.size


def test_a_flat_road_has_no_horizontal_tie() -> None:
    found, _ = drawn(flat, 4)
    count, why = of_kind(found, "shift_tie")
    assert count == 0
    assert why == {"pictures are not alike"}
    assert of_kind(found, "height_tie") == (4, set())


@pytest.mark.parametrize("road", [joints, bars])
def test_what_repeats_is_no_tie(road: Road) -> None:
    """Grooves each 60 mm and bars each 100 mm match at several shifts within the search."""
    found, _ = drawn(road, 4)
    count, why = of_kind(found, "shift_tie")
    assert count == 0
    assert "another shift fits as well" in why


def test_a_kerb_does_not_pass_for_a_change_of_height() -> None:
    """A step that lies elsewhere by what the poses are off does not move the height."""
    found, off = drawn(kerb, 5)
    error, sigma = errors(found, off, "height_tie")
    assert (np.abs(error) < 4.0 * sigma).all()


def test_another_road_is_no_tie() -> None:
    """Paint of a second place with the same line elsewhere than the search reaches."""
    rng = np.random.default_rng(5)
    one = readings(edge_line, 0, Seen(), rng)
    sine, cosine = np.sin(PLACE.heading_rad), np.cos(PLACE.heading_rad)
    far = replace(one, run=1, easting_m=one.easting_m + 0.3 * cosine, northing_m=one.northing_m - 0.3 * sine)
    ties = ties_at(PLACE, [one, far], SETTINGS)
    assert not (ties.accepted & (ties.columns["kind"] == "shift_tie")).any()


def test_vehicles_and_bridges_are_no_road() -> None:
    rng = np.random.default_rng(6)
    one, other = readings(flat, 0, Seen(), rng), readings(flat, 1, Seen(lift_m=1.4), rng)
    ties = ties_at(PLACE, [one, other], SETTINGS)
    assert ties.columns["why_not"].tolist() == ["farther apart than the bound"]
    # A car beside the lane covers a third of the patch in one pass.
    other = readings(flat, 1, Seen(lift_m=LIFT_M), rng)
    covered = np.where(other.easting_m > PLACE.easting_m + 0.15, other.height_m + 1.4, other.height_m)
    ties = ties_at(PLACE, [one, replace(other, height_m=covered)], SETTINGS)
    assert ties.accepted[0]
    assert ties.columns["value_m"][0] == pytest.approx(LIFT_M, abs=1e-4)


def test_heads_of_one_pass_are_measured_and_do_not_count() -> None:
    rng = np.random.default_rng(8)
    one, other = readings(dash_end, 0, Seen(), rng), readings(dash_end, 0, Seen(lift_m=LIFT_M), rng)
    ties = ties_at(PLACE, [one, replace(other, sensor="b")], SETTINGS)
    assert not ties.accepted.any()
    assert ties.columns["why_not"][0] == "heads of one pass"
    assert ties.columns["value_m"][0] == pytest.approx(LIFT_M, abs=1e-4)


def moved(one: PassReadings, correction: np.ndarray) -> PassReadings:
    """Readings whose body is moved by a correction (north, east, down; turn of the body), in full, not linearised."""
    from scipy.spatial.transform import Rotation

    to_level = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body = one.body_m[one.pose]
    away = np.stack([one.easting_m, one.northing_m, one.height_m], axis=-1) - body
    arm = away @ to_level.T  # level from body is the identity here
    there = Rotation.from_rotvec(correction[3:]).apply(arm) + correction[:3]
    point = body + there @ to_level
    return replace(one, easting_m=point[:, 0], northing_m=point[:, 1], height_m=point[:, 2])


def test_observations_are_explained_by_the_correction_that_undoes_them() -> None:
    """A pass that is moved and turned: partial derivatives times the correction are what the ties observe."""
    rng = np.random.default_rng(9)
    one, other = (readings(crack, run, Seen(noise_m=0.0002), rng) for run in (0, 1))
    correction = np.array([0.011, -0.008, 0.02, 0.004, -0.003, 0.002])
    ties = ties_at(PLACE, [one, moved(other, -correction)], SETTINGS)
    found = ties.counted()
    assert set(ties.columns["kind"][ties.accepted]) == {"height_tie", "shift_tie"}
    explained = found.partials[:, 1] @ correction
    assert (np.abs(found.observed_m - explained) < 3.5 * found.sigma_m).all()
    height = found.kind == 0
    assert np.abs((found.observed_m - explained)[height]).max() < 1e-4
    assert np.array_equal(found.partials[:, 0, :3], -found.partials[:, 1, :3])


def test_ties_do_not_depend_on_where_the_map_lies() -> None:
    """Directions turn with the meridian convergence; values stay."""
    rng = np.random.default_rng(10)
    one, other = readings(crack, 0, Seen(), rng), readings(crack, 1, Seen((0.01, 0.0), LIFT_M), rng)
    straight = ties_at(PLACE, [one, other], SETTINGS)
    turned = ties_at(PLACE, [replace(r, convergence_rad=0.05) for r in (one, other)], SETTINGS)
    assert np.array_equal(straight.columns["value_m"], turned.columns["value_m"], equal_nan=True)
    one_way, other_way = (ties.counted().partials[:, 0, :2].T for ties in (straight, turned))
    n, e = one_way
    assert other_way[0] == pytest.approx(np.cos(0.05) * n - np.sin(0.05) * e, abs=1e-12)
    assert other_way[1] == pytest.approx(np.sin(0.05) * n + np.cos(0.05) * e, abs=1e-12)


def test_many_passes_are_tied_in_a_ring() -> None:
    assert [pairs_of(n) for n in (0, 1, 2, 3)] == [[], [], [(0, 1)], [(0, 1), (0, 2), (1, 2)]]
    assert pairs_of(5) == [(0, 1), (0, 4), (1, 2), (2, 3), (3, 4)]
    rng = np.random.default_rng(11)
    passes = [readings(flat, run, Seen(), rng) for run in range(4)]
    two, four = ties_at(PLACE, passes[:2], SETTINGS), ties_at(PLACE, passes, SETTINGS)
    # Four ties say three things.
    assert four.counted().sigma_m[0] == pytest.approx(two.counted().sigma_m[0] * np.sqrt(4 / 3))
    assert np.unique(Ties.joined([four, four]).observations.group).size == 2 * np.unique(four.observations.group).size
    assert np.array_equal(ties_at(PLACE, passes, SETTINGS).columns["value_m"], four.columns["value_m"], equal_nan=True)
