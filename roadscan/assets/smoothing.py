"""Rasters smoothed by a Gaussian."""

from __future__ import annotations

import numpy as np

from roadscan.assets.kernels.smoothing import convolve
from roadscan.compute.array_types import Float64
from roadscan.compute.kernel_options import read_only


def gaussian(values: Float64, sigma_cells: float, truncate: float) -> Float64:
    """Returns values (rows, columns) through a Gaussian, up to `truncate` σ; the raster is mirrored at its edges."""
    away = np.arange(int(truncate * sigma_cells + 0.5) + 1)
    half = np.exp(-0.5 / (sigma_cells * sigma_cells) * away**2)
    weights = half / np.concatenate([half[:0:-1], half]).sum()
    out, between = np.empty(values.shape), np.empty(values.shape)
    line = np.empty(values.shape[1] + 2 * away[-1])
    convolve(read_only(np.ascontiguousarray(values)), weights, line, between, out)
    return out
