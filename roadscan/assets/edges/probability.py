"""Probability that a line of steps is a kerb, from how it was seen."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.edges.line_pieces import Line

_BEHIND_M: Final = 0.5  # Width of the surface behind a kerb that is used (m).


class Weights(NamedTuple):
    """Weights of a logistic function, fitted to lines of simulated and recorded streets whose truth is known."""

    constant: float = -2.2
    evidence: float = 0.9
    """Of the logarithm of the evidence (σ, squares summed over independent metres)."""
    ratio: float = 1.0
    """Of the logarithm of the step over the scatter of its sides, less that of 4."""
    low: float = 3.0
    """Of the share of the lower side that was seen, less 0.9."""
    behind: float = 12.0
    """Of the width of the surface behind it, up to 0.5 m, less that (m): where less is seen, a wall or hedge stands."""


WEIGHTS: Final = Weights()


def features(line: Line) -> tuple[float, float, float, float]:
    """Logarithms of the evidence and of step over scatter (less that of 4), share of the lower side seen (less 0.9),
    width of the surface behind (up to 0.5 m, less that).
    """
    step, sigma, seen = line.column("step_m"), line.column("sigma_step_m"), line.column("seen") > 0.5
    known = seen & np.isfinite(step) & np.isfinite(sigma)
    if not known.any():
        return 0.0, -2.0, -0.9, -_BEHIND_M
    # 4 mm for errors that the lines of both sides do not show; neighbours share half of their returns
    score = np.minimum(step[known] / np.hypot(sigma[known], 0.004), 8.0)
    evidence = math.sqrt(float(np.sum(score**2)) / 2.0)
    scatter = float(np.median(line.column("scatter_m")[known]))
    ratio = float(np.median(step[known])) / max(scatter, 0.002)
    low = float(np.median(line.column("seen_low")[known]))
    behind = min(float(np.nanmedian(line.column("seen_high_m")[known])), _BEHIND_M) - _BEHIND_M
    return math.log(max(evidence, 1e-3)), math.log(max(ratio, 1e-3) / 4.0), low - 0.9, behind


def kerb_probability(line: Line, weights: Weights = WEIGHTS) -> float:
    """Returns the probability of a line, between 0.01 and 0.995."""
    evidence, ratio, low, behind = features(line)
    value = weights.constant + weights.evidence * evidence + weights.ratio * ratio + weights.low * low
    value += weights.behind * behind
    return float(np.clip(1.0 / (1.0 + math.exp(-value)), 0.01, 0.995))
