"""Patches behind a hedge are no ground, a terrace is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from roadscan.assets.ground.dense import without_islands
from roadscan.assets.ground.surface import Grid, Place, Surface
from roadscan.assets.settings import GroundSettings

GRID = Grid(0.0, 0.0, 0.25, 80, 80)


def kept(size_m: float, height_m: float) -> np.ndarray:
    """Which returns of a patch 2 m behind a level street stay ground."""
    rng = np.random.default_rng(4)
    street = rng.uniform([0.0, 0.0], [20.0, 12.0], (40_000, 2))
    patch = np.array([6.0, 14.0]) + rng.uniform(0.0, size_m, (2000, 2))
    x, y = np.concatenate([street, patch]).T
    above = np.concatenate([np.zeros(len(street)), np.full(len(patch), height_m)]).astype(np.float32)
    place = cast(Any, SimpleNamespace(returns=SimpleNamespace(x_m=x, y_m=y), settings=GroundSettings()))
    base = Surface(GRID, np.zeros(GRID.shape, np.float32))
    found = without_islands(cast(Place, place), base, above, np.ones(x.size, np.bool_), GRID)
    assert found[: len(street)].all()
    return found[len(street) :]


def test_a_small_patch_far_above_is_no_ground() -> None:
    assert not kept(0.8, 2.5).any()
    assert not kept(0.8, -2.5).any()


def test_a_terrace_and_a_level_patch_stay_ground() -> None:
    assert kept(3.0, 2.5).all()
    assert kept(0.8, 0.2).all()
