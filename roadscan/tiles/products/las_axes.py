"""Coordinates as a point file stores them: integers, a scale and an offset, in the CRS's unit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError
from roadscan.core.grid import QUANTA_PER_M

_INT32_MAX: Final = 2**31 - 1  # Largest stored coordinate.


@dataclass(frozen=True)
class Axis:
    """One coordinate as LAS stores it: value = stored · scale + offset, in the CRS's unit."""

    stored: npt.NDArray[np.int32]
    scale: float
    offset: float
    error_max_m: float
    """Largest difference between a point and what a reader gets back (m)."""


Axes = tuple[Axis, Axis, Axis]


def axis(quanta: npt.NDArray[Any], corner_quanta: int, scale_m: float, unit_m: float, product: str) -> Axis:
    """Return an axis that stores `quanta` (n,) from `corner_quanta`; offsets are whole units, shared by all tiles.

    Raises :class:`ConfigError` where the scale is too fine for 32 bits.
    """
    unit_quanta = QUANTA_PER_M * unit_m
    scale = _scale(scale_m, unit_m)
    offset = float(math.floor(corner_quanta / unit_quanta))
    steps = np.rint((quanta + (corner_quanta - offset * unit_quanta)) / (unit_quanta * scale))
    if steps.size and np.abs(steps).max() > _INT32_MAX:
        raise ConfigError(f"{product}.scale_m = {scale_m:g} is too fine for these coordinates", change="make it larger")
    true_m = (quanta.astype(np.float64) + corner_quanta) / QUANTA_PER_M
    error_m = np.abs((steps * scale + offset) * unit_m - true_m)
    return Axis(steps.astype(np.int32), scale, offset, float(error_m.max(initial=0.0)))


def rounding_errors(axes: Axes) -> dict[str, float]:
    """Return the largest rounding error of each coordinate (m), rounded to nanometres."""
    return {name: round(one.error_max_m, 9) for name, one in zip("xyz", axes, strict=True)}


def set_coordinates(record: Any, axes: Axes) -> None:
    """Fill the three coordinates of a point record."""
    for name, one in zip("XYZ", axes, strict=True):
        record[name] = one.stored


def _scale(scale_m: float, unit_m: float) -> float:
    if unit_m == 1.0:
        return scale_m
    exponent = math.floor(math.log10(scale_m / unit_m))
    leading = scale_m / unit_m / 10.0**exponent
    step = max(digit for digit in (1, 2, 5) if digit <= leading or digit == 1)
    return float(f"{step}e{exponent}")
