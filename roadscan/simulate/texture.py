"""Macrotexture of a pavement as a periodic height field with a given mean profile depth.

Random stones: a band of wavelengths around the grain size, its peaks worn flat by traffic. The mean profile depth is
that of ISO 13473-1:2019 on profiles along the field.
"""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d

from roadscan.compute.array_types import Float32, Float64
from roadscan.simulate.noise import stream

CELLS: Final = 1024
"""Cells along an edge of the field, a power of two."""
CELL_M: Final = 0.001  # edge of a cell
_BAND: Final = 0.55
"""Width of the band, as standard deviation of ln(wavelength)."""
_WORN_SIGMA: Final = 0.5
"""Height of peaks, in standard deviations, above which they are worn down …"""
_WORN_SHARE: Final = 0.25
"""… to this share of their excess."""
_FINE_PER_CELL: Final = 2  # samples in a step of the profile
_BASE_MM: Final = 100.0  # segment of the mean profile depth (ISO 13473-1)
_LOW_PASS_MM: Final = 2.4  # cut-off wavelength of the low-pass (ISO 13473-1)


@functools.lru_cache(maxsize=4)
def texture_field(mpd_mm: float, grain_mm: float, seed: int) -> Float32:
    """Return heights (c, c) in metres over station and offset, periodic, mean 0, with the given mean profile depth."""
    rng = stream(seed, 0, "texture")
    frequency = np.fft.fftfreq(CELLS, CELL_M * 1e3)
    f = np.hypot(frequency[:, None], np.fft.rfftfreq(CELLS, CELL_M * 1e3)[None])
    f[0, 0] = 1e-9
    # A band in wavelength, as an area density: amplitude² · f² is a bell in ln f.
    amplitude = np.exp(-((np.log(f * grain_mm) / _BAND) ** 2) / 4) / f
    amplitude[0, 0] = 0.0
    raw = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((CELLS, CELLS))) * amplitude, s=(CELLS, CELLS))
    raw /= raw.std()
    worn = np.minimum(raw, _WORN_SIGMA) + _WORN_SHARE * np.maximum(raw - _WORN_SIGMA, 0.0)
    worn -= worn.mean()
    depth = float(np.mean([mean_profile_depth_mm(line, 1.0) for line in worn[:: CELLS // 64]]))
    field: Float32 = (worn * (mpd_mm / depth) * 1e-3).astype(np.float32)
    return field


def mean_profile_depth_mm(height_mm: Float64, step_mm: float) -> float:
    """Return the mean profile depth (mm), ISO 13473-1:2019: 100 mm segments, slope removed, mean of both peaks.

    height_mm : (s,) heights at even steps of `step_mm`. The low-pass of 2.4 mm is a Gaussian here.
    """
    fine = np.interp(
        np.arange(0.0, (height_mm.size - 1) * step_mm, step_mm / _FINE_PER_CELL),
        step_mm * np.arange(height_mm.size),
        height_mm,
    )
    sigma_mm = _LOW_PASS_MM * np.sqrt(np.log(2.0) / 2.0) / np.pi
    smooth = gaussian_filter1d(fine, sigma_mm / (step_mm / _FINE_PER_CELL))
    size = round(_BASE_MM / (step_mm / _FINE_PER_CELL))
    segments = smooth[: smooth.size // size * size].reshape(-1, size)
    x = np.linspace(-1.0, 1.0, size)
    slopes = (segments @ x) / (x @ x)
    level = segments - segments.mean(axis=1, keepdims=True) - slopes[:, None] * x
    halves = level.reshape(-1, 2, size // 2).max(axis=2)
    return float(halves.mean())
