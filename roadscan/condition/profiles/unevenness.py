"""Unevenness of a profile: its spectrum, and its deviations from a straightedge.

Power spectral density of longitudinal profiles, and the road class of ISO 8608.

G_d(n) = C · (n / n0)^−w, with n0 = 0.1 cycles a metre; class A is the smoothest, H the roughest. The standard's text
was not at hand. Limits of the classes, n0 and the range of the fit (0.011 to 2.83 cycles a metre) are those that are
generally quoted from it; see Andrén, *Power spectral density approximations of longitudinal road profiles* (2006). The
fit is by least squares of logarithms over thirds of an octave, where the standard smooths with bands of three widths.
Compliance is not claimed.

Rolling straightedge: height of its middle above or below the line between its end wheels.

The beam stands on a wheel at either end and has a third in its middle, whose height above the mean of the other two is
the deviation, as the rolling straightedges of EN 13036-5/-7 and of US specifications (3 m, 10 ft, 16 ft) measure it
(public descriptions; the texts were not at hand, and compliance is not claimed).
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.steps import roll_beam, roll_wheel
from roadscan.condition.profiles.profiles import COARSEST_M, RULES, heights_of, raise_fault, stations_of
from roadscan.core.errors import ProfileError

REFERENCE_PER_M = 0.1
"""Spatial frequency n0 at which C is defined (cycles a metre)."""
FIT_PER_M = (0.011, 2.83)
"""Range of the fit (cycles a metre)."""
CLASS_LIMITS_M3 = 1e-6 * np.array([32.0, 128.0, 512.0, 2048.0, 8192.0, 32768.0, 131072.0])
"""Upper limits of C for classes A to G (m³)."""
WINDOW_M = 100.0
"""Length of the windows of Welch's method (m)."""
SHORTEST_M = 25.0
"""Length of the shortest piece without gaps that is used (m)."""
THINNEST_BANDS = 5
"""Least number of bands for a fit."""


class RoadSpectrum(NamedTuple):
    """One-sided spectrum of a profile, and the fit to it."""

    frequency_per_m: Float64
    """(k,) spatial frequencies, without 0 (cycles a metre)."""
    density_m3: Float64
    """(k,) displacement power spectral density (m³)."""
    roughness_m3: float
    """C: the fitted density at 0.1 cycles a metre (m³)."""
    sigma_roughness_m3: float
    """Standard deviation of C, from the scatter of bands about the fitted line (m³)."""
    waviness: float
    """w: the fitted exponent."""
    sigma_waviness: float
    """Standard deviation of w, likewise."""
    road_class: str
    """A to H, by C."""
    fit_per_m: tuple[float, float]
    """Range of frequencies in the fit (cycles a metre)."""
    windows_m: float
    """Length of the windows (m)."""
    measured_m: float
    """Length of the pieces that were used (m)."""


def road_spectrum(x_m: npt.ArrayLike, height_m: npt.ArrayLike, window_m: float = WINDOW_M) -> RoadSpectrum:
    """Compute the spectrum by Welch's method: Hann windows that overlap by half, each less its straight line.

    Pieces between gaps of more than a foot and jumps of more than 0.1 m are put to regular stations, at their median
    spacing, and their spectra averaged by length.

    Parameters
    ----------
    x_m, height_m : (n,) stations, ascending, and heights, NaN where there is none (m).
    window_m : length of the windows; where no piece is as long, that of the longest piece (m).

    Raises
    ------
    ProfileError
        where the stations do not ascend, no piece of 25 m is without gaps, or the spectrum does not reach over enough
        of the range of the fit.
    """
    from scipy.signal import welch

    if not 0.0 < window_m < np.inf:
        raise ProfileError(f"windows of {window_m:g} m", expected="a finite length above 0 m")
    x = stations_of(x_m)
    pieces = _pieces(x, heights_of(height_m, x.size)[0])
    longest = max((xs[-1] - xs[0] for xs, _ in pieces), default=0.0)
    if longest < SHORTEST_M:
        raise_fault(f"the longest piece without a gap is {longest:.4g} m; a spectrum takes {SHORTEST_M:g} m")
    step = float(np.median(np.concatenate([np.diff(xs) for xs, _ in pieces])))
    length = min(window_m, longest)
    samples = int(length / step + 1e-6)
    total, weight = np.zeros(samples // 2 + 1), 0.0
    frequency: Float64 = np.asarray(np.fft.rfftfreq(samples, step), np.float64)
    for xs, hs in pieces:
        even = np.arange(xs[0], xs[-1] + 1e-9, step)
        if even.size >= samples:
            _, density = welch(np.interp(even, xs, hs), 1.0 / step, "hann", samples, detrend="linear")
            total += even.size * step * density
            weight += even.size * step
    density = total / weight
    fitted, seen = _fitted(frequency[1:], density[1:])
    return RoadSpectrum(
        frequency[1:], density[1:], *fitted, road_class(fitted[0]), seen, samples * step, weight
    )  # fmt: skip


def road_class(roughness_m3: float) -> str:
    """Return the class of ISO 8608, A to H, of a density at 0.1 cycles a metre (m³)."""
    return "ABCDEFGH"[int(np.searchsorted(CLASS_LIMITS_M3, roughness_m3))]


def _pieces(x: Float64, height: Float64) -> list[tuple[Float64, Float64]]:
    """Return stations and heights between gaps and jumps."""
    there = np.isfinite(height)
    xs, hs = x[there], height[there]
    broken = (np.diff(xs) > COARSEST_M) | (np.abs(np.diff(hs)) > RULES.highest_step_m)
    ends = [0, *(1 + np.flatnonzero(broken)).tolist(), xs.size]
    return [(xs[a:b], hs[a:b]) for a, b in pairwise(ends) if b - a > 1]


def _fitted(frequency: Float64, density: Float64) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Fit C and w to means over thirds of an octave; return them with standard deviations, and the range of the fit."""
    inside = (frequency >= FIT_PER_M[0]) & (frequency <= FIT_PER_M[1]) & (density > 0.0)
    n, g = frequency[inside], density[inside]
    band = np.floor(3.0 * np.log2(n / FIT_PER_M[0])).astype(np.int64)
    number, start = np.unique(band, return_index=True)
    if number.size < THINNEST_BANDS:
        raise ProfileError(
            f"a spectrum over {number.size} thirds of an octave",
            expected=f"{THINNEST_BANDS} or more with power between {FIT_PER_M[0]} and {FIT_PER_M[1]} cycles a metre",
            change="give a longer profile, or one that is not flat",
        )
    count = np.diff([*start, n.size])
    at = np.log(np.add.reduceat(n, start) / count / REFERENCE_PER_M)
    (slope, level), scatter = np.polyfit(at, np.log(np.add.reduceat(g, start) / count), 1, cov=True)
    c, spread = float(np.exp(level)), np.sqrt(np.diag(scatter))
    return (c, c * float(spread[1]), float(-slope), float(spread[0])), (float(n[0]), float(n[-1]))


LENGTHS_M = {"3 m": 3.0, "10 ft": 3.048, "16 ft": 4.8768}
"""Usual lengths of beams (m)."""


def straightedge_mm(
    x_m: npt.ArrayLike, height_m: npt.ArrayLike, length_m: float = 3.0, *, wheel_radius_m: float = 0.0
) -> Float64:
    """Return the deviation (n,) of a rolling straightedge's middle at each sample, positive over a bump (mm).

    NaN where the beam reaches beyond the profile, stands over a gap of more than a foot, or has no height under its
    middle.

    Parameters
    ----------
    x_m, height_m : (n,) stations, ascending, and heights, NaN where there is none (m).
    length_m : between the end wheels (m).
    wheel_radius_m : of all three wheels; they touch at a point where it is 0 (m).

    Raises
    ------
    ProfileError
        where the stations do not ascend, or the profile is shorter than the beam.
    """
    x = stations_of(x_m)
    heights = heights_of(height_m, x.size)[0]
    if not 0.0 < length_m <= x[-1] - x[0] or not 0.0 <= wheel_radius_m < 0.5 * length_m:
        raise ProfileError(
            f"a straightedge of {length_m:g} m with wheels of {wheel_radius_m:g} m on a profile of {x[-1] - x[0]:g} m",
            expected="a beam that is shorter than the profile, on wheels that are shorter than the beam",
        )
    there = np.isfinite(heights)
    found = np.full(x.size, np.nan)
    if there.sum() > 2:
        xs, hs = x[there], heights[there]
        wheel, deviation = np.empty(xs.size), np.empty(xs.size)
        roll_wheel(xs, hs, wheel_radius_m, wheel)
        roll_beam(xs, wheel, length_m, COARSEST_M, deviation)
        found[there] = 1e3 * deviation
    return found
