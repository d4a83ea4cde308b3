"""Probabilities from measures by logistic functions."""

from __future__ import annotations

import math
from collections.abc import Iterable


def logistic(start: float, terms: Iterable[tuple[float, float]]) -> float:
    """Returns the probability 1 / (1 + exp(−z)) of z = start + Σ weight · measure, between 0.001 and 0.999."""
    z = start + sum(weight * measure for weight, measure in terms)
    return min(max(1.0 / (1.0 + math.exp(-max(min(z, 50.0), -50.0))), 0.001), 0.999)
