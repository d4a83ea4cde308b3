"""Quantiles and medians of few numbers against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.quantiles import median, quantiles


@pytest.mark.parametrize("size", [1, 2, 5, 8, 101])
def test_they_are_those_of_numpy_to_the_bit(size: int) -> None:
    values = np.random.default_rng(size).normal(size=size)
    shares = [0.003, 0.02, 0.15, 0.5, 0.98, 0.997]
    assert quantiles(values, shares) == np.quantile(values, shares).tolist()
    assert median(values) == float(np.median(values))
