"""Calibration of probabilities: curves from the probability that a kind derives from evidence to the observed share.

A kind's weights rank its objects. The share of right objects by evidence was counted on simulated streets
whose truth is known: `benchmarks/bench_asset_probability.py` fits these curves and tests them on other streets.
A curve is Platt's (1999): a straight line between the logarithms of the odds.
"""

from __future__ import annotations

import math
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

    def of_evidence(self, stated: float) -> float:
        """Returns the evidence's probability for the stated one."""
        return _of_odds((_odds(stated) - self.offset) / self.slope)


CURVES: Final = {
    "surfaces": Curve(-0.07, 0.48),
    "edges": Curve(-1.56, 1.11),
    "areas": Curve(-0.04, 0.73),
    "clearances": Curve(0.08, 1.11),
    "products": Curve(0.0, 1.0),
}
"""Fitted to 771 objects of 40 drawn streets (seeds 100 to 139) by `python -m benchmarks asset_probability`. On ten
others (seeds 0 to 9, 188 objects) the expected calibration error is 0.028. A kind names its curve
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
