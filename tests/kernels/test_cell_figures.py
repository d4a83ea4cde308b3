"""Figures of cells: NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.tiles.kernels.cell_statistics import median, totals


@pytest.mark.parametrize("n", [1, 2, 3, 1000, 1001])
def test_figures_are_those_of_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    values = rng.exponential(1e-3, n).astype(np.float32)
    values[::3] = np.float32(-0.0) if n == 3 else values[0]
    assert median(values) == float(np.median(values))
    count = rng.integers(1, 1 << 32, n, dtype=np.uint32)
    points, light, high = totals(count, values, values.astype(np.float64))
    assert points == count.sum(dtype=np.uint64)
    assert light == pytest.approx((values.astype(np.float64) * count).sum(), rel=1e-12)
    assert high == pytest.approx(values.sum(dtype=np.float64), rel=1e-12)
