"""Quantiles of few numbers: bit-identical to NumPy's, and faster."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


def quantiles(values: Float64, shares: Sequence[float]) -> list[float]:
    """Returns the numbers below which these shares of values (n,) lie, interpolated; values are finite, n ≥ 1."""
    last = values.size - 1
    places = [last * share for share in shares]
    lower = [min(int(place), last) for place in places]
    upper = [min(k + 1, last) for k in lower]
    held = np.partition(values, sorted({*lower, *upper}))
    found = []
    for place, i, j in zip(places, lower, upper, strict=True):
        below, above, past = float(held[i]), float(held[j]), place - i
        step = above - below
        found.append(above - step * (1.0 - past) if past >= 0.5 else below + step * past)
    return found


def median(values: Float64) -> float:
    """Returns the median of values (n,); they are finite, n ≥ 1."""
    half = values.size // 2
    if values.size % 2:
        return float(np.partition(values, half)[half])
    held = np.partition(values, [half - 1, half])
    return float((held[half - 1] + held[half]) / 2.0)
