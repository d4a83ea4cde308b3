"""Statistics of cells of one slot each against NumPy, from one height to a full slot, with heights far apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from roadscan.compute.kernels.column_statistics import LANES, REACH
from roadscan.compute.kernels.slots import slot_statistics_of_8, slot_statistics_of_28


def _expected(heights: Any, light: int, base: int, floor: float) -> list[float]:
    """Mean, robust, lowest, highest height, deviation, intensity of one cell, in quanta."""
    own = np.sort(heights.astype(np.int64))
    median = own[(own.size - 1) // 2]
    away = np.abs(own - median)
    mad = np.sort(away)[(own.size - 1) // 2]
    near = own[away <= max(REACH * mad, floor)]
    return [base + own.mean(), base + near.mean(), base + own[0], base + own[-1], own.std(), light / own.size]


@pytest.mark.parametrize(("kernel", "most"), [(slot_statistics_of_8, 8), (slot_statistics_of_28, 28)])
@pytest.mark.parametrize("spread", [2, 300, 32_000])
def test_statistics_of_slots_are_those_of_numpy(kernel: Any, most: int, spread: int) -> None:
    rng = np.random.default_rng(spread + most)
    for floor in (0.0, 100.0, 1e6):
        heights = rng.integers(-spread, spread + 1, (most, LANES)).astype(np.int16)
        heights[:, 0] = rng.choice([-32_000, 32_000], most)
        counts = np.append(rng.integers(1, most + 1, LANES - 3), [1, most - 1, most]).astype(np.int32)
        light = rng.integers(0, 60_000, LANES).astype(np.int32)
        bases = rng.integers(-(10**7), 10**7, LANES).astype(np.int32)
        pairs = np.ascontiguousarray(heights.reshape(most // 2, 2, LANES).transpose(0, 2, 1)).view(np.int32)[..., 0]
        out = np.empty((6, LANES))
        kernel(np.ascontiguousarray(pairs), counts, light, bases, floor, 1.0, out)
        for lane in range(LANES):
            wanted = _expected(heights[: counts[lane], lane], int(light[lane]), int(bases[lane]), floor)
            np.testing.assert_allclose(out[:, lane], wanted, rtol=1e-12, atol=1e-6)
