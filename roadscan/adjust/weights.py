"""Weights of observations: Huber's weights first, then IGG III of residuals that leave their group out.

Huber's function (1964) has one minimum, so the start does not matter, but a false observation keeps some pull. From
there, IGG III (Yang 1994) takes away all of it from what lies beyond a limit. Its statistic is the residual of a
prediction made without the observation over that prediction's σ, which holds as well for an observation that no
longer counts: one that was rejected because of a false neighbour comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.calibrate.robust import length_limit
from roadscan.compute.array_types import Float64, Int64

HUBER_LIMIT: Final = 1.5
"""Huber's limit (σ): at least 95 % efficiency where all is normal."""

_TURNED: Final = 0.5
"""Share that is left of a value's step when it turns."""
_ONWARD: Final = 1.2
"""Growth of that share while it goes on."""


class Pace:
    """How far each of n values moves towards what it should be: less where it went back and forth.

    Two observations that exclude one another, or a factor and the weights that follow from it, alternate for ever where
    each moves all the way. A value's share of its way is halved whenever it turns (Riedmiller & Braun 1993), and grows
    again while it goes on.
    """

    def __init__(self, size: int) -> None:
        self._share, self._before = np.ones(size), np.zeros(size)

    def step(self, way: Float64) -> Float64:
        """Returns the part (n,) of a way (n,) that is gone."""
        turned = way * self._before < 0.0
        self._share = np.where(turned, _TURNED * self._share, np.minimum(1.0, _ONWARD * self._share))
        self._before = way
        return self._share * way


@dataclass(frozen=True)
class LeftOut:
    """Prediction of each observation from the others."""

    residual: Float64
    """(n,) observed minus predicted without it."""
    variance: Float64
    """(n,) of that prediction."""
    statistic: Float64
    """(n,) residual over its σ: standard normal where all is as stated."""
    redundancy: Float64
    """(n,) share of an error of the observation that its residual shows; 1 where it does not count."""


def left_out(residual: Float64, variance: Float64, own: Float64, weight: Float64) -> LeftOut:
    """Returns residuals without the observation itself, from those with it (Cook & Weisberg 1982, 2.2).

    Parameters
    ----------
    residual : (n,) observed minus computed.
    variance : (n,) of the computed value.
    own : (n,) variance of the observation as stated.
    weight : (n,) that it counts with, 0 to 1.
    """
    redundancy = np.maximum(1.0 - weight * variance / own, 1e-12)
    without, predicted = residual / redundancy, variance / redundancy
    return LeftOut(without, predicted, without / np.sqrt(own + predicted), redundancy)


@dataclass(frozen=True)
class Groups:
    """Observations that stand or fall together."""

    of_row: Int64
    """(n,) group of each, 0 to the last."""

    def lengths(self, statistic: Float64) -> tuple[Float64, Int64]:
        """Returns the root of the summed squares of each row's group, and the group's rows."""
        count = np.bincount(self.of_row)
        total = np.bincount(self.of_row, statistic**2)
        return np.sqrt(total)[self.of_row], count[self.of_row]

    def huber(self, statistic: Float64) -> Float64:
        """Returns Huber's weights."""
        length, rows = self.lengths(statistic)
        return np.minimum(1.0, _limits(HUBER_LIMIT, rows) / np.maximum(length, 1e-300))

    def igg_iii(self, statistic: Float64, whole: float, reject: float) -> Float64:
        """Returns weights of IGG III: 1 up to `whole` σ, 0 from `reject` σ on."""
        length, rows = self.lengths(statistic)
        return igg_iii(length, _limits(whole, rows), _limits(reject, rows))


def igg_iii(length: Float64, near: Float64 | float, far: Float64 | float) -> Float64:
    """Returns weights (n,) of IGG III (Yang 1994) of residuals by their lengths: 1 up to `near`, 0 from `far` on."""
    slope = (far - np.minimum(length, far)) / (far - near)
    return np.where(length <= near, 1.0, near / np.maximum(length, near) * slope**2)


def _limits(limit: float, rows: Int64) -> Float64:
    """For each row the limit of its group's length that is as rare as `limit` for one standard normal number."""
    by_rows = np.array([length_limit(limit, max(int(n), 1)) for n in range(int(rows.max(initial=0)) + 1)])
    return by_rows[rows]
