"""Random numbers, an independent stream for each purpose and block, and the road's random unevenness from them.

Random unevenness of the longitudinal profiles, and the roughness index that scales it.

Power spectral density of ISO 8608:2016: G(n) = G(n0) · (n / n0)^−w with n0 = 0.1 cycles/m.
"""

from __future__ import annotations

import functools
import math
import zlib
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf

from roadscan.compute.array_types import Float64
from roadscan.simulate.scene.road import Road


def stream(seed: int, run: int, purpose: str, block: int = 0) -> np.random.Generator:
    """Return the generator for one purpose ("profiler_left", "lidar" …) of one block of one run."""
    key = (run, zlib.crc32(purpose.encode()), block)
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))


class GaussMarkov:
    """First-order Gauss–Markov process, continued from call to call.

    x(t + dt) = e^(−dt/τ) · x(t) + σ · sqrt(1 − e^(−2dt/τ)) · w  (Gelb 1974, 3.8).
    """

    def __init__(self, rng: np.random.Generator, sigma: Float64, time_constant_s: npt.ArrayLike, step_s: float) -> None:
        """`sigma` (k,); `time_constant_s`: one, or (k,) of each component."""
        self._rng = rng
        self._sigma = sigma
        self._keep = np.broadcast_to(np.exp(-step_s / np.asarray(time_constant_s, np.float64)), sigma.shape)
        self._last = sigma * rng.standard_normal(sigma.size)

    def take(self, count: int) -> Float64:
        """Return the next (count, k) values, for k components of standard deviation `sigma` (k,)."""
        if count == 0:
            return np.zeros((0, self._sigma.size))
        steps = self._sigma * np.sqrt(1.0 - self._keep**2) * self._rng.standard_normal((count, self._sigma.size))
        values: Float64 = np.empty_like(steps)
        for k, keep in enumerate(self._keep.tolist()):
            values[:, k], _ = lfilter([1.0], [1.0, -keep], steps[:, k], zi=[keep * self._last[k]])
        self._last = values[-1].copy()
        return values


STEP_M: Final = 0.1
"""Distance between samples along a track (m)."""
_REFERENCE_PER_M: Final = 0.1  # n0 of ISO 8608 (cycles/m)
_LONGEST_M, _SHORTEST_M = 80.0, 0.7  # wavelengths of the unevenness
_CLASS_DEGREES_M3: Final = {"A": 16e-6, "B": 64e-6, "C": 256e-6, "D": 1024e-6, "E": 4096e-6}
"""G(n0), geometric mean of each class: ISO 8608, table 1."""
_COHERENCE_WAVE_M: Final = 5.0  # wavelength for which `coherence_m` is stated

_IRI_STEP_M: Final = 0.25  # step of the IRI (Sayers 1995)
_IRI_SPEED_M_PER_S: Final = 80.0 / 3.6  # speed of the golden car
_IRI_START_M: Final = 11.0  # length of the initial mean slope
_GOLDEN_CAR: Final = (653.0, 63.3, 6.0, 0.15)
"""Tyre and suspension stiffness (1/s²), damping (1/s) and mass ratio: Sayers (1995), table 1."""


def track_offsets_m(road: Road) -> Float64:
    """Return offsets of the tracks (t,), a tenth of a lane and at most 0.35 m apart, over the paved width."""
    step = min(road.lane_width_m / 10, 0.35)
    count = max(2, math.ceil(road.paved_m / step))
    return np.linspace(-road.paved_m, road.paved_m, 2 * count + 1)


def tracks(road: Road, station_m: Float64, waves_m: Float64, rng: np.random.Generator) -> Float64:
    """Return the unevenness (t, s) of all tracks at evenly spaced stations (s,), scaled as the scene states.

    Parameters
    ----------
    station_m : (s,) each :data:`STEP_M`.
    waves_m : (s,) what the road's waves add to every profile; it counts towards a stated IRI.
    """
    settings = road.roughness
    if settings is None:
        return np.zeros((0, 0))
    offsets = track_offsets_m(road)
    unit = _unit_tracks(offsets, station_m.size, settings.waviness, settings.coherence_m, rng)
    if settings.iso_class is not None:
        return unit * math.sqrt(_CLASS_DEGREES_M3[settings.iso_class])
    return unit * _scale_for(road, offsets, unit, waves_m, float(settings.iri_m_per_km or 0.0))


def _unit_tracks(
    offsets_m: Float64, samples: int, waviness: float, coherence_m: float, rng: np.random.Generator
) -> Float64:
    """Return tracks (t, samples) of G(n0) = 1 m³.

    A wave of n cycles/m keeps the share exp(−5 m · n · distance / coherence_m) of its likeness from track to track.
    """
    size = 2 ** math.ceil(math.log2(samples + 4))
    n = np.fft.rfftfreq(size, STEP_M)
    inside = (n >= 1.0 / _LONGEST_M) & (n <= 1.0 / _SHORTEST_M)
    density = np.zeros(n.size)
    density[inside] = (n[inside] / _REFERENCE_PER_M) ** -waviness
    # One-sided density G: a bin holds G · Δn = amplitude² / 2.
    amplitude = np.sqrt(density / (size * STEP_M)) * size / math.sqrt(2.0)
    share = np.exp(-_COHERENCE_WAVE_M * n * float(offsets_m[1] - offsets_m[0]) / coherence_m)
    waves = _complex_normal(rng, n.size)
    out = np.empty((offsets_m.size, samples))
    for track in range(offsets_m.size):
        if track:
            waves = share * waves + np.sqrt(1.0 - share**2) * _complex_normal(rng, n.size)
        out[track] = np.fft.irfft(amplitude * waves, size)[:samples]
    return out


def _complex_normal(rng: np.random.Generator, size: int) -> npt.NDArray[np.complex128]:
    """Return complex normal numbers of variance 1."""
    parts = rng.standard_normal((2, size)) / math.sqrt(2.0)
    return np.asarray(parts[0] + 1j * parts[1])


def _scale_for(road: Road, offsets_m: Float64, unit: Float64, waves_m: Float64, wanted: float) -> float:
    """Return the factor that gives the wheel paths the wanted mean IRI, by bisection."""
    wheels = [road.lane_offset_m(lane) + side for lane in range(1, road.lanes + 1) for side in (-0.8, 0.8)]
    paths = [unit[int(np.abs(offsets_m - wheel).argmin())] for wheel in wheels]

    def mean_iri(scale: float) -> float:
        return float(np.mean([iri_m_per_km(scale * path + waves_m, STEP_M) for path in paths]))

    low, high = 0.0, 0.001
    if mean_iri(0.0) >= wanted:
        return 0.0
    while mean_iri(high) < wanted:
        low, high = high, 2.0 * high
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if mean_iri(middle) < wanted else (low, middle)
    return (low + high) / 2


def iri_m_per_km(height_m: Float64, step_m: float) -> float:
    """Return the International Roughness Index of a whole profile (m/km): Sayers (1995), the golden car at 80 km/h.

    height_m : (s,) heights at even steps of `step_m`; they are resampled to 0.25 m.
    """
    length = (height_m.size - 1) * step_m
    at = np.arange(0.0, length + 1e-9, _IRI_STEP_M)
    return float(accumulated_iri(np.interp(at, step_m * np.arange(height_m.size), height_m))[-1])


def accumulated_iri(height_m: Float64) -> Float64:
    """Return the IRI (s − 1,) accumulated from the start, of heights (s,) each 0.25 m: Sayers et al. (1986), annex.

    The car starts at rest on the mean slope of the first 11 m.
    """
    top, bottom = _golden_car()
    slope = np.diff(height_m) / _IRI_STEP_M
    first = (height_m[round(_IRI_START_M / _IRI_STEP_M)] - height_m[0]) / _IRI_START_M
    # A constant slope is a state of rest, so it is removed first and changes nothing.
    motion = lfilter(top, bottom, slope - first)
    out: Float64 = np.cumsum(np.abs(motion)) / np.arange(1, slope.size + 1) * 1000.0
    return out


@functools.cache
def _golden_car() -> tuple[Float64, Float64]:
    """Return numerator and denominator of the filter from the profile's slope to the suspension's slope motion."""
    k1, k2, c, mu = _GOLDEN_CAR
    a = np.array([[0.0, 1.0, 0, 0], [-k2, -c, k2, c], [0, 0, 0, 1], [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu]])
    dt = _IRI_STEP_M / _IRI_SPEED_M_PER_S
    state = expm(a * dt)
    # The input is the profile's slope; the states are slopes too (derivatives along the road).
    force = np.linalg.solve(a, (state - np.eye(4)) @ np.array([0.0, 0.0, 0.0, k1 / mu]))
    top, bottom = ss2tf(state, force[:, None], state[[0]] - state[[2]], (force[0] - force[2])[None, None])
    return top[0], bottom
