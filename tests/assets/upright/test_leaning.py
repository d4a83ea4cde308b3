"""The lean of a shaft and the tilt of a plate, against the angles that they were made with."""

from __future__ import annotations

import math

import numpy as np
import pytest

from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box
from roadscan.assets.upright.axis import fit_axis
from roadscan.assets.upright.plates import SignOptions, plates_of
from tests.assets.edges.streets import returns_of


@pytest.mark.parametrize("lean_deg", [0.0, 3.0, 8.0])
def test_a_leaning_post(lean_deg: float) -> None:
    """A post of 12 cm, seen from its south, that leans to the east."""
    rng = np.random.default_rng(3)
    height, turn = rng.uniform(0.3, 4.0, 800), rng.uniform(-1.4, 1.4, 800)
    x = 5.0 + height * math.tan(math.radians(lean_deg)) + 0.06 * np.sin(turn)
    y = 9.0 - 0.06 * np.cos(turn) + rng.normal(0.0, 0.005, 800)
    axis = fit_axis(np.column_stack([x, y, height]), np.tile([5.0, 0.0], (800, 1)))
    assert axis.lean_deg == pytest.approx(lean_deg, abs=0.5)


@pytest.mark.parametrize("tilt_deg", [-12.0, 0.0, 12.0])
def test_a_tilted_plate(tilt_deg: float) -> None:
    """A plate of 0.8 m on a post that looks to the south-east, upwards where its tilt is positive."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0.0, 12.0, (40_000, 2)), rng.normal(50.0, 0.005, 40_000)])
    along, tilt = math.radians(135.0), math.radians(tilt_deg)
    right = np.array([-math.cos(along), math.sin(along), 0.0])
    normal = np.array([math.sin(along) * math.cos(tilt), math.cos(along) * math.cos(tilt), math.sin(tilt)])
    up = np.cross(normal, right)
    plate = np.array([6.0, 6.0, 52.5]) + rng.uniform(-0.4, 0.4, (600, 1)) * right
    plate = plate + rng.uniform(-0.4, 0.4, (600, 1)) * up + rng.normal(0.0, 0.004, (600, 1)) * normal
    turn, height = rng.uniform(0.0, 2.0 * math.pi, 300), rng.uniform(50.0, 52.1, 300)
    post = np.column_stack([5.95 + 0.03 * np.sin(turn), 6.05 + 0.03 * np.cos(turn), height])
    xyz = np.vstack([ground, post, plate])
    light = np.append(np.full(len(ground) + len(post), 2000.0), np.full(len(plate), 40_000.0))
    sensor = np.tile([11.0, 1.0, 52.0], (len(xyz), 1))
    drive = np.column_stack([np.linspace(8.0, 12.0, 9), np.ones(9), np.full(9, 52.0), np.zeros(9)])
    box = Box(0.0, 0.0, 12.0, 12.0)
    scene = make_scene(returns_of(xyz, light, np.arange(len(xyz)), sensor), box, box, drive)
    (found,) = plates_of(scene, SignOptions())
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=1.5)
    assert found.facing_deg == pytest.approx(135.0, abs=1.5)
