"""Scenes are let go of: a worker searches square after square."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from roadscan.assets.kind import asset_kinds
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns


@pytest.mark.nightly
def test_no_kind_keeps_a_scene_in_memory() -> None:
    """A plane with a post on it, looked at by every kind."""
    random = np.random.default_rng(11)
    x, y = random.uniform(0.0, 12.0, (2, 20_000))
    height = np.zeros(x.size)
    x[:600], y[:600], height[:600] = 6.0, 4.0, random.uniform(0.0, 3.0, 600)
    ones, far = np.ones(x.size, np.uint8), np.full(x.size, 6.0)
    returns = Returns(
        (0.0, 0.0), x, y, height, 100.0 * np.ones(x.size, np.float32), np.arange(x.size) + 10**18,
        ones.astype(np.uint16), 0 * ones, 0 * ones.astype(np.uint16), ones, ones, far, far, np.full(x.size, 2.0),
        ("roof",),
    )  # fmt: skip
    box, drive = Box(0.0, 0.0, 12.0, 12.0), np.array([[6.0, v, 2.0, 1.0] for v in np.arange(0.5, 12.0, 0.5)])
    for name, kind in asset_kinds().items():
        scene = make_scene(returns, box, box, drive)
        held = weakref.ref(scene)
        kind.evidence(scene, kind.options())
        del scene
        gc.collect()
        assert held() is None, name
