"""Exposure and white of the pictures of a run, balanced by what several of them see at the same place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD

CELL_M: Final = 0.5
"""Edge of the cubes (m) in which pictures are compared; they are anchored at the map's origin and at height 0."""
_ONE_IN: Final = 4  # One cube in so many, by its number, is compared.
_LEAST_POINTS: Final = 3  # Fewest points of a picture in a cube.
DARK, BRIGHT = 12.0, 243.0
"""Values outside of these are not compared: what is black or overexposed does not follow the exposure."""
_LEAST_SHARED: Final = 8  # Fewest cubes that two pictures share, to be compared.
_NEIGHBOURS: Final = 12
"""A picture is compared with so many that follow it in time, at most: farther ones add nothing but work."""
_PRIOR: Final = 0.5
"""1 σ of the logarithm of a gain before anything is compared."""
_PAIR: Final = 0.03
"""1 σ of the logarithm of the ratio of two pictures from one cube: light depends on where it is seen from."""
_ROUNDS: Final = 5  # Rounds of robust weighting.
_OUTLIER: Final = 0.1  # Difference of logarithms from which a pair weighs less.
_MOST: Final = 1.5
"""Most that the logarithm of a gain can be: a picture that would need more is black or white."""


@dataclass(frozen=True, eq=False)
class PictureSample:
    """Colours that a picture sees in some cubes."""

    cell: Int64
    """(n,) number of the cube, ascending."""
    colour: Float32
    """(n, 3) mean red, green, blue."""


def cells_of(point_m: Float64) -> Int64:
    """Returns the numbers (n,) of the cubes that hold points (n, 3) of the map."""
    at = np.floor(point_m / CELL_M).astype(np.int64)
    return ((at[:, 0] & 0x1FFFFFF) << 38) | ((at[:, 1] & 0x1FFFFFF) << 13) | (at[:, 2] & 0x1FFF)


def is_compared(cell: Int64) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of the cubes in which pictures are compared: one in four, spread evenly."""
    mixed = (cell.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)
    return np.asarray(mixed % np.uint64(_ONE_IN) == 0)


def sample_of(cell: Int64, colour: Float32, weight: Float32) -> PictureSample:
    """Returns mean colours by cube of points (n,) that a picture sees (weight above 0)."""
    seen = np.flatnonzero((weight > 0.0) & (colour.min(axis=1) >= DARK) & (colour.max(axis=1) <= BRIGHT))
    held, which, count = np.unique(cell[seen], return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(which, colour[seen, c], held.size) for c in range(3)], axis=-1) / np.maximum(
        count, 1
    ).reshape(-1, 1)
    kept = count >= _LEAST_POINTS
    return PictureSample(held[kept], means[kept].astype(np.float32))


def gains_of(samples: list[PictureSample]) -> tuple[Float64, Int64]:
    """Returns factors (n, 3) for the channels of n pictures in the order of time, and with how many each was compared.

    The logarithms of the ratios of two pictures in the cubes that both see have a robust middle; the gains agree with
    these best, in the least squares of iteratively weighted pairs (Huber 1981), and are 1 on the average of a run.
    """
    count = len(samples)
    first, second, ratio, sigma = _pairs(samples)
    compared = np.bincount(np.concatenate([first, second]), minlength=count).astype(np.int64)
    logs = np.zeros((count, 3))
    for channel in range(3 if first.size else 0):
        weight = 1.0 / sigma**2
        own = np.zeros(count)
        for _ in range(_ROUNDS):
            own = _solved(count, first, second, ratio[:, channel], weight)
            off = np.abs(ratio[:, channel] - (own[second] - own[first]))
            weight = np.minimum(1.0, _OUTLIER / np.maximum(off, 1e-9)) / sigma**2
        logs[:, channel] = own - own.mean()
    return np.exp(np.clip(logs, -_MOST, _MOST)), compared


def _pairs(samples: list[PictureSample]) -> tuple[Int64, Int64, Float64, Float64]:
    """Returns pairs (m,) of pictures, log of the first's colours over the second's (m, 3), and its 1 σ (m,)."""
    found: list[tuple[int, int, Float64, float]] = []
    for i, one in enumerate(samples):
        met = 0
        for j in range(i + 1, min(i + 1 + 4 * _NEIGHBOURS, len(samples))):
            _, here, there = np.intersect1d(one.cell, samples[j].cell, assume_unique=True, return_indices=True)
            if here.size < _LEAST_SHARED:
                continue
            ratios = np.log(one.colour[here].astype(np.float64) / samples[j].colour[there])
            middle = np.median(ratios, axis=0)
            spread = SIGMA_OF_MAD * float(np.median(np.abs(ratios - middle)))
            found.append((i, j, middle, float(np.hypot(_PAIR, spread) / np.sqrt(here.size))))
            met += 1
            if met == _NEIGHBOURS:
                break
    if not found:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros((0, 3)), np.zeros(0)
    first, second, middles, sigmas = zip(*found, strict=True)
    return np.array(first), np.array(second), np.array(middles), np.array(sigmas)


def _solved(count: int, first: Int64, second: Int64, ratio: Float64, weight: Float64) -> Float64:
    """Returns logarithms (count,) of gains: that of the second less that of the first is the ratio of each pair."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    rows = np.concatenate([first, second, first, second, np.arange(count)])
    columns = np.concatenate([first, second, second, first, np.arange(count)])
    values = np.concatenate([weight, weight, -weight, -weight, np.full(count, 1.0 / _PRIOR**2)])
    normal = coo_matrix((values, (rows, columns)), shape=(count, count)).tocsc()
    right = np.bincount(second, weight * ratio, count) - np.bincount(first, weight * ratio, count)
    return np.asarray(splu(normal).solve(right))
