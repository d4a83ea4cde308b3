"""Roughness of wheel paths whose heights are means over windows and hold noise, against that of the road itself."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import correlate1d

from roadscan.condition.lane_data import Profile
from roadscan.condition.profiles.ride import Segments, iri_of, ride, ride_number_of, ride_number_ride
from roadscan.condition.wheel_paths import WheelPath, noise, without_noise

Float64 = npt.NDArray[np.float64]

FINE_M, SPACING_M, LENGTH_M = 0.005, 0.05, 300.0
ENDS = Segments(np.array([100.0]), np.array([280.0]))


def road(iri_m_per_km: float) -> Float64:
    """Heights each 5 mm of a road whose density falls with the square of frequency."""
    rng = np.random.default_rng(1)
    n = round(LENGTH_M / FINE_M)
    per_m = np.fft.rfftfreq(n, FINE_M)
    size = np.divide(1.0, per_m, out=np.zeros_like(per_m), where=per_m > 0.01)
    height = np.fft.irfft(size * np.exp(2j * np.pi * rng.random(per_m.size)), n)
    return height * iri_m_per_km / iri(height[::10])


def iri(height_m: Float64) -> float:
    return float(iri_of(ride(stations(height_m), height_m), ENDS).iri_m_per_km[0, 0])


def stations(height_m: Float64) -> Float64:
    return SPACING_M * np.arange(height_m.size, dtype=np.float64)


def path(height_m: Float64, sigma_m: float, cell_m: float, window_m2: float) -> WheelPath:
    x = stations(height_m)
    profile = Profile(x, np.column_stack([x, 0.0 * x]), height_m, np.full(x.size, sigma_m))
    return WheelPath(profile, ENDS, (x >= 100.0) & (x <= 280.0), 1.0, "", SPACING_M, cell_m, window_m2)


@pytest.mark.parametrize(
    ("cell_m", "plain", "sharp"), [(0.01, 0.004, 0.003), (0.05, 0.01, 0.003), (0.1, 0.03, 0.003), (0.25, 0.12, 0.01)]
)
def test_what_windows_took_of_short_waves_is_given_back(cell_m: float, plain: float, sharp: float) -> None:
    """Cells are means; a height is a mean of cells with weights that fall to the ends of its window."""
    height = road(2.0)
    half = max(SPACING_M, 1.5 * cell_m)
    box = np.ones(round(cell_m / FINE_M) | 1)
    weights = 1.0 - np.abs(np.arange(-half + FINE_M, half, FINE_M)) / half
    seen = correlate1d(correlate1d(height, box / box.sum()), weights / weights.sum())[::10]
    found = path(seen, 0.0, cell_m, half**2 / 6 + cell_m**2 / 12)
    tried = iri_of(ride(stations(seen), found.tried()), ENDS).iri_m_per_km[:, 0]
    cleared = without_noise(tried)
    assert iri(seen) == pytest.approx(2.0, rel=plain)
    assert iri(seen) < 2.0
    assert cleared.value == pytest.approx(2.0, rel=sharp)
    assert abs(cleared.value - 2.0) <= max(2.0 * cleared.sigma, 0.006)


def test_noise_adds_nothing_in_the_mean_and_its_sigma_holds() -> None:
    height = road(1.0)[::10]
    held = []
    plain = path(height, 0.2e-3, SPACING_M, 0.0)
    for error in np.concatenate([noise(plain.profile, SPACING_M, SPACING_M, stream) for stream in (40, 60)]):
        one = path(height + error, 0.2e-3, SPACING_M, 0.0)
        tried = iri_of(ride(stations(height), one.tried()), ENDS).iri_m_per_km[:, 0]
        held.append((tried[0], *without_noise(tried)[:2]))
    raw, value, sigma = np.array(held).T
    assert raw.mean() > 1.02
    assert value.mean() == pytest.approx(1.0, abs=0.006)
    assert 0.5 < np.sqrt(np.mean(((value - 1.0) / sigma) ** 2)) < 1.2


def test_where_noise_makes_the_most_of_it_there_is_no_value() -> None:
    height = road(0.3)[::10]
    rough = path(height + noise(path(height, 2e-3, 0.05, 0.0).profile, 0.05, 0.05, 40)[0], 2e-3, 0.05, 0.0)
    cleared = without_noise(iri_of(ride(stations(height), rough.tried()), ENDS).iri_m_per_km[:, 0])
    assert np.isnan(cleared.value)
    assert "noise of the heights makes" in cleared.reason


def test_what_is_not_known_has_no_sigma_and_gaps_stay() -> None:
    height = road(2.0)[::10]
    unknown = path(height, np.nan, 0.05, 0.001)
    on = ride_number_ride(stations(height), unknown.tried())
    cleared = without_noise(ride_number_of(on, ENDS).profile_index[:, 0])
    assert np.isfinite(cleared.value)
    assert np.isnan(cleared.sigma)
    broken = height.copy()
    broken[2000:2040] = np.nan
    sharp = unknown.sharpened(broken[None])[0]
    np.testing.assert_array_equal(np.isnan(sharp), np.isnan(broken))
    assert np.nanmax(np.abs(sharp - height)) < 0.02
