"""IRI against the World Bank's check table, published segments of a real profile, and SciPy's solution of the car."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

from roadscan.condition.profiles.profiles import SPEED_M_PER_S
from roadscan.condition.profiles.ride import (
    Segments,
    half_car_ride,
    iri_of,
    mean_roughness_index,
    ride,
    rolling_iri,
    segments_of,
)
from roadscan.condition.profiles.tables import stretches_above
from roadscan.core.errors import ProfileError

K1, K2, C, MU = 653.0, 63.3, 6.0, 0.15
MOTION = np.array([[0, 1, 0, 0], [-K2, -C, K2, C], [0, 0, 0, 1], [K2 / MU, C / MU, -(K1 + K2) / MU, -C / MU]])
ROAD = np.array([[0], [0], [0], [K1 / MU]])


def whole(x: np.ndarray, h: np.ndarray) -> float:
    on = ride(x, h)
    assert on.faults == ("",) * len(on.faults)
    return float(iri_of(on, segments_of(x[0], x[-1])).iri_m_per_km[0, 0])


def smooth(x: np.ndarray) -> np.ndarray:
    """A road without waves shorter than 7 m, between 2 and 3 m/km."""
    waves = ((0.004, 7.1, 0.3), (0.006, 11.3, 1.0), (0.01, 17.9, 2.0), (0.02, 41.0, 0.1))
    return sum(a * np.sin(2 * np.pi * x / length + phase) for a, length, phase in waves)


def test_worldbank_triangle(recordings: Path) -> None:
    """The check table of World Bank Technical Paper 46: all 120 values, printed with five decimals."""
    table = np.loadtxt(recordings / "iri" / "worldbank_triangle.csv", delimiter=",", skiprows=1)
    x = np.concatenate([[0.0], table[:, 0]])
    on = ride(x, 1e-3 * np.concatenate([[0.0], table[:, 1]]))
    found = iri_of(on, Segments(np.zeros(120), x[1:])).iri_m_per_km[0]
    assert table.shape[0] == 120
    assert np.abs(found - table[:, 2]).max() < 1e-5


def test_published_segments_of_a_profile(recordings: Path) -> None:
    """Šroubek, Šorel, Žák (2021): 27 segments of 20 m and five of 100 m of their profile A."""
    x, h = np.loadtxt(recordings / "iri" / "profile_a.txt").T
    on = ride(x, h)
    short = iri_of(on, segments_of(x[0], x[0] + 540.0, 20.0)).iri_m_per_km[0]
    assert short[:3] == pytest.approx([3.67079, 3.94293, 4.37140], abs=1e-3)
    assert short.mean() == pytest.approx(3.30898, abs=1e-3) and short.size == 27
    long = iri_of(on, segments_of(x[0], x[0] + 500.0, 100.0)).iri_m_per_km[0]
    assert long == pytest.approx([3.29852, 2.44211, 3.55511, 4.08554, 2.70790], abs=1e-3)


def test_a_harmonic_road_settles_at_the_gain_of_the_car() -> None:
    """Far from the start, a sine of 15 m gives its amplitude times the car's gain (SciPy's frequency response)."""
    wave, amplitude, dx = 15.0, 0.005, 0.01
    x = np.arange(0.0, 300.0, dx)
    h = amplitude * np.sin(2 * np.pi * x / wave)
    found = iri_of(ride(x, h), Segments(np.array([150.0]), np.array([150.0 + 9 * wave]))).iri_m_per_km[0, 0]
    time = x / SPEED_M_PER_S
    slope = amplitude * 2 * np.pi / wave * np.cos(2 * np.pi * x / wave) * np.sinc(0.25 / wave)
    stroke = StateSpace(MOTION, ROAD, np.array([[1.0, 0.0, -1.0, 0.0]]), np.zeros((1, 1)))
    _, y, _ = lsim(stroke, slope, time)
    far = (x >= 150.0) & (x < 150.0 + 9 * wave)
    assert found == pytest.approx(1e3 * np.abs(y[far]).mean(), rel=1e-3)


@pytest.mark.parametrize("spacing", [0.025, 0.05, 0.1, 0.15, 0.2, 0.25])
def test_the_spacing_does_not_matter_on_a_smooth_road(spacing: float) -> None:
    fine = np.arange(0.0, 400.0, 0.01)
    x = np.arange(0.0, 400.0 - 1e-9, spacing)
    assert whole(x, smooth(x)) == pytest.approx(whole(fine, smooth(fine)), rel=0.005)


def test_irregular_spacing_does_not_matter_on_a_smooth_road() -> None:
    fine = np.arange(0.0, 400.0, 0.01)
    x = np.concatenate([[0.0], np.cumsum(np.random.default_rng(1).uniform(0.005, 0.25, 4000))])
    x = x[x < 400.0]
    assert whole(x, smooth(x)) == pytest.approx(whole(fine, smooth(fine)), rel=0.005)


def test_level_tilt_and_side_change_nothing_but_scale_does() -> None:
    x = np.arange(0.0, 200.0, 0.1)
    h = smooth(x)
    usual = whole(x, h)
    assert whole(x + 5e4, h + 560.0) == pytest.approx(usual, rel=1e-7)
    assert whole(x, -h) == pytest.approx(usual, rel=1e-12)
    assert whole(x, h + 0.03 * x) == pytest.approx(usual, rel=1e-9)
    assert whole(x, 2.0 * h) == pytest.approx(2.0 * usual, rel=1e-12)


def test_many_profiles_at_once_are_each_as_alone() -> None:
    x = np.arange(0.0, 100.0, 0.1)
    heights = np.stack([smooth(x), smooth(x + 3.0), np.where(x < 40, smooth(x), np.nan)])
    heights[1, 300:304] = np.nan
    on = ride(x, heights)
    for row, h in enumerate(heights):
        alone = ride(x, h)
        assert np.array_equal(alone.response_m[0], on.response_m[row])
        assert np.array_equal(alone.measured_m[0], on.measured_m[row])


def test_gaps_jumps_and_notes() -> None:
    """A short dropout is bridged; behind a gap or a jump the car begins anew; what is not measured is told."""
    x = np.arange(0.0, 200.0, 0.1)
    h = smooth(x)
    usual = iri_of(ride(x, h), segments_of(0.0, x[-1], 20.0)).iri_m_per_km[0]
    broken = h.copy()
    broken[500:502] = np.nan  # 0.3 m between its neighbours
    broken[(x > 65.0) & (x < 83.0)] = np.nan
    broken[x > 150.0] += 1.0
    on = ride(x, broken)
    parts = segments_of(0.0, x[-1], 20.0)
    iri, share = (values[0] for values in iri_of(on, parts))
    notes = on.notes(parts, 20.0)[0]
    assert np.abs(iri[:2] - usual[:2]).max() < 1e-9
    assert notes[:3] == ["start", "", ""]
    assert notes[3] == "gap" and np.isnan(iri[3]) and share[3] == pytest.approx(0.25, abs=0.01)
    assert notes[4] == "start, gap" and share[4] == pytest.approx(0.845, abs=0.01)
    assert notes[7] == "start, jump" and iri[7] < 1.5 * usual[7]
    assert notes[8] == "start" and notes[9] == "short"
    assert iri[9] == pytest.approx(usual[9], rel=0.01)


def test_what_lies_beyond_the_ends_or_between_near_gaps_is_told() -> None:
    x = np.arange(0.0, 100.0, 0.1)
    h = np.where(((x > 40.0) & (x < 41.0)) | ((x > 51.0) & (x < 52.0)), np.nan, smooth(x))
    on = ride(x, h)
    parts = segments_of(0.0, 130.0, stations_m=[-30.0, 10.0, 30.0, 42.0, 50.0, 90.0, 130.0])
    iri, share = (values[0] for values in iri_of(on, parts))
    assert on.notes(parts)[0] == ["start, gap", "start", "start, gap", "start, gap", "start, gap", "gap"]
    assert np.isnan(iri).tolist() == [True, False, False, True, False, True]
    assert share == pytest.approx([0.25, 1.0, 10 / 12, 0.0, 0.95, 0.2475], abs=0.01)


def test_a_gap_costs_nothing_far_behind_it() -> None:
    x = np.arange(0.0, 300.0, 0.1)
    h = smooth(x)
    broken = np.where((x > 100.0) & (x < 120.0), np.nan, h)
    last = Segments(np.array([200.0]), np.array([300.0]))
    assert iri_of(ride(x, broken), last).iri_m_per_km == pytest.approx(iri_of(ride(x, h), last).iri_m_per_km, rel=1e-5)


def test_rolling_iri_and_rough_places() -> None:
    x = np.arange(0.0, 100.0, 0.05)
    h = smooth(x) + 0.02 * np.exp(-(((x - 60.0) / 0.5) ** 2))
    on = ride(x, h)
    rolling = rolling_iri(on)[0]
    k = 1000
    there = Segments(x[k : k + 1] - 3.81, x[k : k + 1] + 3.81)
    assert rolling[k] == pytest.approx(iri_of(on, there).iri_m_per_km[0, 0])
    assert np.isnan(rolling[x < 3.8]).all() and np.isfinite(rolling[(x > 3.82) & (x < 96.1)]).all()
    place = max(stretches_above(x, rolling, 10.0), key=lambda one: one.peak)
    assert 55.0 < place.from_m < 60.0 < place.to_m < 68.0
    assert place.peak == np.nanmax(rolling) == rolling[x == place.peak_m]
    assert (rolling[(x >= place.from_m) & (x <= place.to_m)] > 10.0).all()


def test_two_wheel_paths() -> None:
    x = np.arange(0.0, 200.0, 0.1)
    left, right = smooth(x), smooth(x + 2.5)
    parts = segments_of(x[0], x[-1])
    iri = iri_of(ride(x, np.stack([left, right])), parts).iri_m_per_km
    mean = mean_roughness_index(iri[0], iri[1])[0]
    half = iri_of(half_car_ride(x, left, right), parts).iri_m_per_km[0, 0]
    assert mean == pytest.approx((whole(x, left) + whole(x, right)) / 2)
    assert half < mean
    assert iri_of(half_car_ride(x, left, -left), parts).iri_m_per_km[0, 0] < 1e-9


def test_segments_at_fixed_stations_and_of_160_9_m() -> None:
    parts = segments_of(3.0, 400.0, stations_m=[500, 0, 100, 250])
    assert list(parts.from_m) == [0, 100, 250] and list(parts.to_m) == [100, 250, 500]
    mile = segments_of(0.0, 400.0, 160.9)
    assert mile.to_m == pytest.approx([160.9, 321.8, 400.0])
    for wrong in ({"length_m": -1.0}, {"stations_m": [7.0]}, {"length_m": 1.0, "stations_m": [0.0, 9.0]}):
        with pytest.raises(ProfileError):
            segments_of(0.0, 400.0, **wrong)


def test_what_is_no_profile_is_refused_or_has_a_fault() -> None:
    x = np.arange(0.0, 100.0, 0.1)
    h = smooth(x)
    for stations in (x[::-1], np.zeros(x.size), np.where(x > 50, np.nan, x), x[:, None]):
        with pytest.raises(ProfileError):
            ride(stations, h)
    with pytest.raises(ProfileError, match="shape"):
        ride(x, h[:-1])
    assert "millimetres" in ride(x, 1e3 * h).faults[0]
    assert "0.5 m" in ride(x[::5], h[::5]).faults[0]
    assert "10 m" in ride(x[:101], h[:101]).faults[0]
    assert "0 of" in ride(x, np.full(x.size, np.nan)).faults[0]
    bad = ride(x, 1e3 * h)
    assert np.isnan(iri_of(bad, segments_of(0.0, 99.9)).iri_m_per_km).all()
