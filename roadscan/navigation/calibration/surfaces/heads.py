"""How well the clouds of two heads agree where both see the same place in the same drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.model.errors import NavigationError
from roadscan.navigation.calibration.surfaces.readings import Placed

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Agreement:
    """Heights of two heads in the cells that both see."""

    cells: int
    mean_m: float
    """First − second."""
    rms_m: float
    beyond_noise_m: float
    """RMS without what the scatter of the readings within their cells explains: noise and texture."""


def agreement(first: Placed, second: Placed, cell_m: float = 0.01, least: int = 4) -> Agreement:
    """Compare mean heights in cells of the level frame that hold at least so many readings of each head.

    Raises
    ------
    NavigationError
        where the heads have no such cell in common.
    """
    own, other = (_cells(one.place_m, cell_m, least) for one in (first, second))
    _, a, b = np.intersect1d(own.key, other.key, assume_unique=True, return_indices=True)
    if a.size == 0:
        raise NavigationError(
            f"'{first.readings.sensor}' and '{second.readings.sensor}' see no place in common in "
            f"{first.readings.drive}",
            expected=f"cells of {cell_m:g} m with {least} readings of each",
            change="take larger cells, or heads whose profiles overlap",
        )
    away = own.height_m[a] - other.height_m[b]
    noise = own.variance_m2[a] + other.variance_m2[b]
    mean_square = float(np.mean(away**2))
    beyond = max(mean_square - float(noise.mean()), 0.0)
    return Agreement(int(a.size), float(away.mean()), mean_square**0.5, beyond**0.5)


@dataclass(frozen=True)
class _Cells:
    key: Int64
    height_m: Float64
    variance_m2: Float64
    """Of the mean."""


def _cells(place_m: Float64, cell_m: float, least: int) -> _Cells:
    whole = np.floor(place_m[:, :2] / cell_m).astype(np.int64)
    key, inverse = np.unique((whole[:, 0] << 32) + whole[:, 1], return_inverse=True)
    count = np.bincount(inverse)
    # About the mean of all heights: squares of heights above the sea would leave no digits.
    height = place_m[:, 2] - place_m[:, 2].mean()
    mean = np.bincount(inverse, height) / count
    square = np.bincount(inverse, (height - mean[inverse]) ** 2)
    enough = count >= least
    variance = square[enough] / (count[enough] - 1) / count[enough]
    return _Cells(key[enough], mean[enough] + place_m[:, 2].mean(), variance)
