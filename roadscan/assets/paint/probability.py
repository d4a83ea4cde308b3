"""The probability that what looks like paint is paint."""

from __future__ import annotations

from typing import Final

import numpy as np

_EVEN_SIGMAS: Final = 8.5
_PER_LOGIT: Final = 1.5
"""Evidence at which half of the components are paint, and by how much the logarithm of the odds grows with it: from the
labelled street of SemanticKITTI (sequence 00, sweeps 0 to 7)."""
_PER_DASH: Final = 1.0
_PER_M: Final = 0.2
_MOST: Final = 6.0


def probability(evidence_sigma: float, painted_m: float, dashes: int) -> float:
    """Probability of paint from its contrast in σ, its painted length (m), and the number of its dashes."""
    logit = (evidence_sigma - _EVEN_SIGMAS) / _PER_LOGIT + _PER_DASH * (dashes - 1) + _PER_M * painted_m
    return float(1.0 / (1.0 + np.exp(-np.clip(logit, -_MOST, _MOST))))
