"""Random numbers: an independent stream for each purpose and block, so that no result depends on chunks."""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from roadscan.compute.array_types import Float64


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
