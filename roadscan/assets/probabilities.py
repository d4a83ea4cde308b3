"""Probabilities: from measures by logistic functions, and calibrated by curves to the observed share."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

_LEAST: Final = 1e-4
"""Probabilities are clipped to this distance from 0 and 1."""


class Curve(NamedTuple):
    """A line between logarithms of odds: stated = `offset` + `slope` · evidence."""

    offset: float
    slope: float

    def stated(self, probability: float) -> float:
        """Returns the stated probability for the evidence's `probability`."""
        return _of_odds(self.offset + self.slope * _odds(probability))


CURVES: Final = {
    "surfaces": Curve(-0.07, 0.48),
    "edges": Curve(-1.56, 1.11),
    "areas": Curve(-0.04, 0.73),
    "clearances": Curve(0.08, 1.11),
    "products": Curve(0.0, 1.0),
}
"""Fitted to 771 objects of 40 drawn streets (seeds 100 to 139) by `python -m benchmarks asset_probability`. On ten
others (seeds 0 to 9, 192 objects) the expected calibration error is 0.035. A kind names its curve
(:class:`roadscan.assets.kind.AssetKind`): kinds that share their evidence share one.
"""
UNCHANGED: Final = Curve(0.0, 1.0)  # Identity: the evidence's probability is stated.


def curve_named(name: str) -> Curve:
    """Returns the curve of a name; the identity for an empty name."""
    return CURVES[name] if name else UNCHANGED


def _odds(probability: float) -> float:
    """Returns the logarithm of the odds."""
    held = min(max(probability, _LEAST), 1.0 - _LEAST)
    return math.log(held / (1.0 - held))


def _of_odds(logarithm: float) -> float:
    return 1.0 / (1.0 + math.exp(-max(min(logarithm, 30.0), -30.0)))


def logistic(start: float, terms: Iterable[tuple[float, float]]) -> float:
    """Returns the probability 1 / (1 + exp(−z)) of z = start + Σ weight · measure, between 0.001 and 0.999."""
    z = start + sum(weight * measure for weight, measure in terms)
    return min(max(1.0 / (1.0 + math.exp(-max(min(z, 50.0), -50.0))), 0.001), 0.999)
