"""Ride number against SciPy's quarter car, spectra of roads of known class, straightedges on shapes known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim, welch

from roadscan.condition.kernels.steps import roll_beam, roll_wheel
from roadscan.condition.profiles.ride import Segments, ride_number_of, ride_number_ride, segments_of
from roadscan.condition.profiles.tables import stretches_above
from roadscan.condition.profiles.unevenness import LENGTHS_M, road_spectrum, straightedge_mm
from roadscan.core.errors import ProfileError


def random_road(c: float, w: float, length_m: float, step: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A road whose density is C (n / 0.1)^−w: Gaussian waves of random phase, by an inverse transform."""
    rng = np.random.default_rng(seed)
    samples = int(length_m / step)
    n = np.fft.rfftfreq(samples, step)
    density = np.zeros(n.size)
    density[n > 0.005] = c * (n[n > 0.005] / 0.1) ** -w
    waves = np.sqrt(density * samples / step / 4) * (rng.normal(size=n.size) + 1j * rng.normal(size=n.size))
    return step * np.arange(samples), np.fft.irfft(waves, samples)


def test_profile_index_against_lsim() -> None:
    """RMS of the stroke of the car with K1 = 5120, K2 = 390, C = 17, µ = 0.036 on a fine random road."""
    k1, k2, c, mu = 5120.0, 390.0, 17.0, 0.036
    motion = np.array([[0, 1, 0, 0], [-k2, -c, k2, c], [0, 0, 0, 1], [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu]])
    car = StateSpace(motion, np.array([[0], [0], [0], [k1 / mu]]), np.array([[1.0, 0, -1, 0]]), np.zeros((1, 1)))
    step = 0.01
    x, h = random_road(16e-6, 2.0, 200.0, step, 5)
    k = round(0.125 / step)
    slope = (np.interp(x + 0.125, x, h) - np.interp(x - 0.125, x, h)) / 0.25
    _, stroke, _ = lsim(car, slope, x * 3.6 / 80.0)
    far = (x > 50.0) & (x < 200.0 - k * step)
    found = ride_number_of(ride_number_ride(x, h), Segments(x[far][:1], x[far][-1:]))
    expected = np.sqrt(np.mean(stroke[far] ** 2))
    assert found.profile_index[0, 0] == pytest.approx(expected, rel=2e-3)
    assert found.ride_number[0] == pytest.approx(5 * np.exp(-160 * expected), rel=2e-3)
    assert 2.0 < found.ride_number[0] < 4.5


def test_ride_number_of_two_wheel_paths_and_of_a_flat_road() -> None:
    x, left = random_road(16e-6, 2.0, 200.0, 0.05, 6)
    _, right = random_road(64e-6, 2.0, 200.0, 0.05, 7)
    parts = segments_of(x[0], x[-1], 50.0)
    both = ride_number_of(ride_number_ride(x, np.stack([left, right])), parts)
    assert both.ride_number == pytest.approx(5 * np.exp(-160 * np.sqrt((both.profile_index**2).mean(axis=0))))
    alone = [ride_number_of(ride_number_ride(x, h), parts).ride_number for h in (left, right)]
    assert (both.ride_number < alone[0]).all() and (both.ride_number > alone[1]).all()
    assert ride_number_of(ride_number_ride(x, 0 * x + 3.0), parts).ride_number == pytest.approx(5.0)


@pytest.mark.parametrize(("c", "w", "road_class"), [(16e-6, 2.0, "A"), (64e-6, 2.3, "B"), (1024e-6, 1.8, "D")])
def test_class_of_a_random_road(c: float, w: float, road_class: str) -> None:
    x, h = random_road(c, w, 4000.0, 0.1, 11)
    found = road_spectrum(x, h)
    assert found.road_class == road_class
    assert found.roughness_m3 == pytest.approx(c, rel=0.15)
    assert found.waviness == pytest.approx(w, abs=0.06)
    assert found.measured_m == pytest.approx(4000.0)


def test_spectrum_is_that_of_scipy_on_even_stations_and_bridges_none() -> None:
    x, h = random_road(64e-6, 2.0, 1000.0, 0.1, 12)
    found = road_spectrum(x, h)
    n, g = welch(h, 10.0, "hann", 1000, detrend="linear")
    assert found.frequency_per_m == pytest.approx(n[1:]) and found.density_m3 == pytest.approx(g[1:], rel=1e-6)
    power = np.sum(found.density_m3) * (found.frequency_per_m[1] - found.frequency_per_m[0])
    assert power == pytest.approx(np.mean([np.var(part) for part in np.split(h, 10)]), rel=0.5)
    broken = h.copy()
    broken[5000:5100] = np.nan
    broken[8000:] += 2.0
    again = road_spectrum(x, broken)
    assert again.measured_m == pytest.approx(990.0, abs=0.3)
    assert again.roughness_m3 == pytest.approx(found.roughness_m3, rel=0.2)
    uneven = np.unique(np.random.default_rng(2).uniform(0, 999, 30_000))
    assert road_spectrum(uneven, np.interp(uneven, x, h)).roughness_m3 == pytest.approx(found.roughness_m3, rel=0.1)


def test_what_has_no_spectrum_is_refused() -> None:
    x = np.arange(0.0, 100.0, 0.1)
    with pytest.raises(ProfileError, match="20 m"):
        road_spectrum(x[:201], 0.01 * x[:201])
    with pytest.raises(ProfileError, match="not flat"):
        road_spectrum(x, 0.02 * np.zeros(x.size))


def test_straightedge_on_an_arc_and_a_ramp() -> None:
    """An arc of radius R stands L²/8R above its chord; a ramp nothing."""
    x = np.arange(0.0, 50.0, 0.05)
    for length in LENGTHS_M.values():
        arc = straightedge_mm(x, -(x**2) / (2 * 1000.0), length)
        inside = (x >= length / 2) & (x <= x[-1] - length / 2)
        assert arc[inside] == pytest.approx(1e3 * length**2 / 8000.0, rel=2e-3)
        assert np.isnan(arc[~inside]).all()
        assert np.nanmax(np.abs(straightedge_mm(x, 0.03 * x, length))) < 1e-9


def test_straightedge_on_a_bump_and_over_gaps() -> None:
    x = np.arange(0.0, 20.0, 0.01)
    h = np.where(np.abs(x - 10.0) < 0.05, 0.006, 0.0)
    found = straightedge_mm(x, h, 3.0)
    (bump,) = stretches_above(x, found, 4.0)
    assert bump.peak == pytest.approx(6.0) and bump.peak_m == pytest.approx(10.0, abs=0.06)
    assert np.nanmin(found) == pytest.approx(-3.0)  # an end wheel on the bump
    h[1200:1240] = np.nan
    broken = straightedge_mm(x, h, 3.0)
    blind = (x > 11.995 - 1.5) & (x < 12.395 + 1.5)
    assert np.isnan(broken[blind]).all()
    seen = ~blind & np.isfinite(found)
    assert np.array_equal(broken[seen], found[seen])
    for length, radius in ((30.0, 0.0), (3.0, 2.0), (0.0, 0.0)):
        with pytest.raises(ProfileError):
            straightedge_mm(x, h, length, wheel_radius_m=radius)


def test_wheels_do_not_fall_into_narrow_gaps() -> None:
    """A wheel of radius r on the edges of a gap of width w sinks by r − √(r² − w²/4)."""
    x = np.arange(0.0, 10.0, 0.001)
    radius, width = 0.1, 0.02
    h = np.where(np.abs(x - 5.0) < width / 2 - 1e-9, -0.05, 0.0)
    wheel = np.empty(x.size)
    roll_wheel(x, h, radius, wheel)
    assert wheel.min() == pytest.approx(np.sqrt(radius**2 - width**2 / 4) - radius, abs=1e-7)
    assert straightedge_mm(x, h, 3.0)[5000] == pytest.approx(-50.0)
    assert straightedge_mm(x, h, 3.0, wheel_radius_m=radius)[5000] == pytest.approx(1e3 * wheel.min(), rel=1e-6)
    out = np.empty(x.size)
    roll_beam(x, wheel, 3.0, 0.3048, out)
    assert np.nanmin(out) == pytest.approx(wheel.min())
