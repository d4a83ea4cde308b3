"""Passes that larger patches put decimetres apart, against the ties between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.adjust.places import SHIFT
from roadscan.adjust.settings import AgainSettings, TieSettings
from roadscan.adjust.tasks.ties_again import agreeing

AHEAD = np.array([0.87, -0.49]) / np.hypot(0.87, 0.49)
"""North and east of the road's direction."""


def shifts(ahead_m: npt.ArrayLike, aside_m: npt.ArrayLike, sigma_m: float) -> dict[str, npt.NDArray[Any]]:
    """Columns of shift ties along and across the road, both at each place."""
    ahead, aside = np.asarray(ahead_m, np.float64), np.asarray(aside_m, np.float64)
    n, across = ahead.size, np.array([-AHEAD[1], AHEAD[0]])
    directions = np.concatenate([np.tile(AHEAD, (n, 1)), np.tile(across, (n, 1))])
    return {
        "kind": np.array([SHIFT] * 2 * n, dtype=object),
        "place": np.tile(np.arange(n), 2),
        "value_m": np.concatenate([ahead, aside]),
        "sigma_m": np.full(2 * n, sigma_m),
        "direction_north": directions[:, 0],
        "direction_east": directions[:, 1],
        "accepted": np.ones(2 * n, np.uint8),
    }


def found(near: dict[str, npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    larger = shifts(np.full(6, 0.68), np.zeros(6), 0.01)
    return agreeing(larger, near, AgainSettings(), TieSettings(), 0.1)[1]


def test_a_mark_that_repeats_moves_no_pass_that_ties_hold_in_place() -> None:
    """Paint matches 0.68 m further on; ties find the passes where they are, to the millimetres that poses wander by."""
    wander = 0.008 * np.sin(np.arange(30.0))
    assert (found(shifts(wander, np.zeros(30), 0.003)) == 0.0).all()


def test_ties_that_match_by_chance_hold_nothing() -> None:
    """Passes are 0.68 m apart: what ties find within their search differs from place to place."""
    chance = np.random.default_rng(7).uniform(-0.1, 0.1, 30)
    assert np.allclose(found(shifts(chance, chance[::-1], 0.003))[:2], 0.68 * AHEAD, atol=0.01)


def test_ties_that_were_observed_where_the_passes_lie_agree_with_larger_patches() -> None:
    again = shifts(np.full(30, 0.683), np.zeros(30), 0.003)
    assert np.allclose(found(again)[:2], 0.68 * AHEAD, atol=0.01)
