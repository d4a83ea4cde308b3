"""Brightness of returns where a scene shows little."""

from __future__ import annotations

import numpy as np

from roadscan.assets import classes
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.assets.upright.brightness import brightness


def test_dark_returns_beside_a_single_lit_one_are_no_reference() -> None:
    """Four returns of five came back without light, as far returns of KITTI do: the lit one is as bright as itself."""
    n = 5
    light, x = np.array([0.0, 0.0, 8.0, 0.0, 0.0], np.float32), np.linspace(10.0, 11.0, n)
    one, zero = np.ones(n, np.uint8), np.zeros(n)
    returns = Returns(
        (0.0, 0.0), x, x, zero + 2.0, light, np.arange(n), one.astype(np.uint16), zero.astype(np.uint8),
        zero.astype(np.uint16), one, one, zero, zero, zero + 2.0, ("lidar",),
    )  # fmt: skip
    box, flat = Box(0.0, 0.0, 20.0, 20.0), np.zeros((4, 4), np.float32)
    scene = Scene(
        returns, box, box, GroundModel(0.0, 0.0, 5.0, flat, np.ones((4, 4), np.bool_)), np.full(n, 2.0, np.float32),
        np.full(n, classes.UNCLASSIFIED, np.uint8), np.zeros((0, 4)),
    )  # fmt: skip
    assert brightness(scene).tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]
