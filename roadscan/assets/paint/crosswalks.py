"""Zebra crossings: bars side by side, alike and evenly spaced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roadscan.assets.paint.contrast import CELL_M
from roadscan.assets.paint.stripes import Stripe
from roadscan.compute.array_types import Float64

_WIDTH_M: Final = (0.25, 1.0)  # Width of a bar (m).
_LENGTH_M: Final = (1.2, 9.0)  # Length of a bar (m).
_PARALLEL_DEG: Final = 12.0  # Greatest angle between two bars (degrees).
_SPACING: Final = (1.3, 3.6)
"""Spacing of bars from middle to middle, in widths of a bar."""
_OVERLAP: Final = 0.5  # Least common length of two bars (share of the longer).
_FEWEST: Final = 3  # Least number of bars.
_COVER_M: Final = (0.4, 1.0)  # Diameter of a manhole cover (m).
_ROUND: Final = 0.1  # Tolerance of a disc's share of its rectangle.
_FILLED: Final = 0.7
"""Least share of its rectangle that a bar covers."""


class Bar(NamedTuple):
    """A rectangle of paint."""

    x_m: float
    y_m: float
    angle_rad: float
    length_m: float
    width_m: float
    filled: float

    @classmethod
    def of_stripe(cls, stripe: Stripe) -> Self:
        """Returns the rectangle of a band."""
        x, y = stripe.at((stripe.begin_m + stripe.end_m) / 2)
        return cls(x, y, float(np.arctan2(stripe.along[1], stripe.along[0])), stripe.length_m, stripe.width_m, 1.0)

    @classmethod
    def of_cells(cls, x_m: Float64, y_m: Float64) -> Self:
        """Returns the rectangle along the main axis of cells."""
        dx, dy = x_m - x_m.mean(), y_m - y_m.mean()
        angle = 0.5 * float(np.arctan2(2 * float(dx @ dy), float(dx @ dx - dy @ dy)))
        s, o = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        length, width = float(np.ptp(s)) + CELL_M, float(np.ptp(o)) + CELL_M
        ms, mo = float(s.max() + s.min()) / 2, float(o.max() + o.min()) / 2
        x = float(x_m.mean()) + ms * np.cos(angle) - mo * np.sin(angle)
        y = float(y_m.mean()) + ms * np.sin(angle) + mo * np.cos(angle)
        return cls(float(x), float(y), angle, length, width, x_m.size * CELL_M**2 / (length * width))


def is_round(bar: Bar) -> bool:
    """Returns True for a shape as long as wide without corners: the cover of a manhole."""
    return bool(
        _COVER_M[0] <= bar.width_m <= bar.length_m <= min(_COVER_M[1], 1.2 * bar.width_m + CELL_M)
        and abs(bar.filled - np.pi / 4) <= _ROUND
    )


def crosswalk_bars(bars: Sequence[Bar]) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of the bars that stand in a row of three or more alike."""
    out = np.zeros(len(bars), np.bool_)
    fit = [
        i
        for i, b in enumerate(bars)
        if _WIDTH_M[0] <= b.width_m <= _WIDTH_M[1]
        and _LENGTH_M[0] <= b.length_m <= _LENGTH_M[1]
        and b.filled >= _FILLED
        and b.length_m >= 1.5 * b.width_m
    ]
    group = {i: i for i in fit}

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for place, i in enumerate(fit):
        for j in fit[place + 1 :]:
            if _side_by_side(bars[i], bars[j]):
                a, b = root(i), root(j)
                group[max(a, b)] = min(a, b)
    roots = [root(i) for i in fit]
    for i, own in zip(fit, roots, strict=True):
        out[i] = roots.count(own) >= _FEWEST
    return out


def _side_by_side(one: Bar, other: Bar) -> bool:
    if abs(np.sin(one.angle_rad - other.angle_rad)) > np.sin(np.radians(_PARALLEL_DEG)):
        return False
    dx, dy = other.x_m - one.x_m, other.y_m - one.y_m
    along = abs(dx * np.cos(one.angle_rad) + dy * np.sin(one.angle_rad))
    across = abs(dy * np.cos(one.angle_rad) - dx * np.sin(one.angle_rad))
    width = (one.width_m + other.width_m) / 2
    common = (one.length_m + other.length_m) / 2 - along
    return bool(
        _SPACING[0] * width <= across <= _SPACING[1] * width and common >= _OVERLAP * max(one.length_m, other.length_m)
    )
