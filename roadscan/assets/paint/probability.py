"""The probability that what looks like paint is paint."""

from __future__ import annotations

from typing import Final

import numpy as np

_EVEN_SIGMAS: Final = 8.5  # Evidence (σ) at which half of the components are paint.
_PER_LOGIT: Final = 1.5
"""Evidence (σ) per unit of the logarithm of the odds; both are from the
labelled street of SemanticKITTI (sequence 00, sweeps 0 to 7)."""
_PER_DASH: Final = 1.0  # Log odds per further dash.
_PER_M: Final = 0.2  # Log odds per painted metre.
_MOST: Final = 6.0  # Greatest absolute log odds.


def probability(evidence_sigma: float, painted_m: float, dashes: int) -> float:
    """Returns the probability of paint from its contrast in σ, its painted length (m), and the number of its dashes."""
    logit = (evidence_sigma - _EVEN_SIGMAS) / _PER_LOGIT + _PER_DASH * (dashes - 1) + _PER_M * painted_m
    return float(1.0 / (1.0 + np.exp(-np.clip(logit, -_MOST, _MOST))))
