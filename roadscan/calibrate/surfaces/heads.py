"""Ties between two heads that see the same strip in one drive, and the agreement of their heights.

The strip where the profiles of two heads overlap is narrow, and both see it with one trajectory: any difference there
comes from their mountings alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.calibrate.evidence import Seen, Ties, Traverse
from roadscan.calibrate.surfaces.readings import Pieces, Placed, Readings, level_from_world, placed
from roadscan.calibrate.unknowns import Estimate
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.robust import scatter_about
from roadscan.core.errors import NavigationError

_CELL_M: Final = 0.01  # Edge of a cell in which heights are compared.
_LEAST: Final = 4  # Least number of readings of a cell, and least number of common cells.
_EVEN: Final = 4.0
"""Cells with a variance above this multiple of the usual one lie on an edge."""
_FLOOR_M: Final = 2e-5  # Added to the limit for outlying differences: rounding.
_COMMON_M: Final = 1e-4
"""1 σ of an error that the whole strip of a drive shares (m)."""
_OUTLYING: Final = 4.0  # A difference farther from the median than this many σ is left out.


@dataclass(frozen=True)
class Agreement:
    """Agreement of two heads in the cells that both see."""

    cells: int
    mean_m: float
    """Mean of first − second."""
    rms_m: float
    beyond_noise_m: float
    """RMS less the scatter of the readings within their cells, which is noise and texture."""


def agreement(first: Placed, second: Placed, cell_m: float = 0.01, least: int = 4) -> Agreement:
    """Compare mean heights in cells of the level frame that hold at least so many readings of each head.

    Cells across an edge have no one height and are left out: those whose readings scatter far more than usual.

    Raises
    ------
    NavigationError
        where the heads have no such cell in common.
    """
    near, other = (_cells(one.place_m, cell_m, least) for one in (first, second))
    _, a, b = np.intersect1d(near.key, other.key, assume_unique=True, return_indices=True)
    if a.size == 0:
        raise NavigationError(
            f"'{first.readings.sensor}' and '{second.readings.sensor}' see no place in common in "
            f"{first.readings.drive}",
            expected=f"cells of {cell_m:g} m with {least} readings of each",
            change="take larger cells, or heads whose profiles overlap",
        )
    away = near.height_m[a] - other.height_m[b]
    noise = near.variance_m2[a] + other.variance_m2[b]
    even = noise <= _EVEN * np.median(noise)
    a, away, noise = a[even], away[even], noise[even]
    mean_square = float(np.mean(away**2))
    beyond = max(mean_square - float(noise.mean()), 0.0)
    return Agreement(int(a.size), float(away.mean()), mean_square**0.5, beyond**0.5)


@dataclass(frozen=True)
class _Cells:
    key: Int64
    height_m: Float64
    variance_m2: Float64
    """Of the mean."""
    middle_m: Float64
    """(m, 2) mean x and y of the cell's readings."""
    reading: Int64
    """(m,) index of one of them."""


def _cells(place_m: Float64, cell_m: float, least: int) -> _Cells:
    whole = np.floor(place_m[:, :2] / cell_m).astype(np.int64)
    key, inverse = np.unique((whole[:, 0] << 32) + whole[:, 1], return_inverse=True)
    count = np.bincount(inverse)
    # Relative to the mean height, since squares of heights above sea level would lose all digits.
    height = place_m[:, 2] - place_m[:, 2].mean()
    mean = np.bincount(inverse, height) / count
    square = np.bincount(inverse, (height - mean[inverse]) ** 2)
    enough = count >= least
    variance = square[enough] / (count[enough] - 1) / count[enough]
    origin = place_m[0, :2] if len(place_m) else np.zeros(2)
    middle = np.stack([np.bincount(inverse, place_m[:, k] - origin[k]) / count for k in (0, 1)], axis=-1) + origin
    reading = np.zeros(key.size, dtype=np.int64)
    reading[inverse] = np.arange(inverse.size)
    return _Cells(key[enough], mean[enough] + place_m[:, 2].mean(), variance, middle[enough], reading[enough])


@dataclass
class HeadTies:
    """Finds ties between heads in the strip that both see; the estimator takes it as its evidence.

    Parameters
    ----------
    readings : of all heads and drives. pieces : how drives are cut.
    traverses : the pieces' errors of poses, as the estimator has them.
    """

    readings: Sequence[Readings]
    pieces: Pieces
    traverses: Mapping[int, Traverse]

    def __call__(self, estimate: Estimate) -> list[Ties]:
        """Ties of heights, one a cell that both heads of a drive see; none where their profiles do not overlap."""
        level = level_from_world(self.readings)
        drives: dict[str, list[Placed]] = {}
        for one in self.readings:
            at = placed(one, estimate, self.pieces, self.traverses, level)
            drives.setdefault(one.drive, []).append(at)
        pairs = [pair for heads in drives.values() for pair in itertools.combinations(heads, 2)]
        return [ties for first, second in pairs if (ties := _strip(first, second, level)) is not None]


def _strip(first: Placed, second: Placed, level_from_world: Float64) -> Ties | None:
    """Return the ties of two heads in one drive."""
    if first.readings.sensor == second.readings.sensor:
        return None
    own, other = (_cells(one.place_m, _CELL_M, _LEAST) for one in (first, second))
    _, a, b = np.intersect1d(own.key, other.key, assume_unique=True, return_indices=True)
    if a.size < _LEAST:
        return None
    variance = own.variance_m2[a] + other.variance_m2[b]
    away = own.height_m[a] - other.height_m[b]
    spread = scatter_about(away, float(np.median(away)))
    kept = (variance <= _EVEN * np.median(variance)) & (np.abs(away - np.median(away)) <= _OUTLYING * spread + _FLOOR_M)
    if kept.sum() < _LEAST:
        return None
    a, b, variance = a[kept], b[kept], variance[kept]
    # An error that all cells share does not average out.
    sigma = np.sqrt(variance + _COMMON_M**2 * variance.size)
    weight = level_from_world[None, 2:3, :] / sigma[:, None, None]
    return Ties("overlap, heads", _seen(first, own, a), _seen(second, other, b), weight)


def _seen(one: Placed, cells: _Cells, which: Int64) -> Seen:
    """Return mean places of cells as the head would have seen them from the pose of one of their readings."""
    place = np.concatenate([cells.middle_m[which], cells.height_m[which, None]], axis=1)
    return one.seen(place, one.readings.pose[cells.reading[which]].astype(np.int64))
