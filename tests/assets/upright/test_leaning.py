"""Lean of a pole, and tilt, width and height of a plate, that are drawn with them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from tests.assets.edges.streets import returns_of
from tests.assets.upright.scene import objects_of

LEAN_DEG, TILT_DEG = 6.0, 8.0
WIDE_M, TALL_M = 0.9, 0.6


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A plain with a pole of 5 m at (8, 4) that leans to the east, and a plate at (14, 4) that looks up, and south."""
    rng = np.random.default_rng(7)
    drive = np.column_stack([np.arange(0.0, 20.0, 0.5), np.full(40, -3.0), np.full(40, 2.0), np.ones(40)])
    flat = np.column_stack([rng.uniform(0.0, 20.0, 60_000), rng.uniform(-8.0, 8.0, 60_000), np.zeros(60_000)])
    n = 6000
    up, seen_from = rng.uniform(0.0, 5.0, n), drive[rng.integers(0, 40, n), :2]
    turn = np.arctan2(seen_from[:, 1] - 4.0, seen_from[:, 0] - 8.0) + rng.uniform(-1.4, 1.4, n)
    east = 8.0 + math.tan(math.radians(LEAN_DEG)) * up
    pole = np.column_stack([east + 0.06 * np.cos(turn), 4.0 + 0.06 * np.sin(turn), up])
    across, along = rng.uniform(-WIDE_M / 2, WIDE_M / 2, 1500), rng.uniform(-TALL_M / 2, TALL_M / 2, 1500)
    tilt = math.radians(TILT_DEG)
    plate = np.column_stack([14.0 + across, 4.0 + along * math.sin(tilt), 2.5 + along * math.cos(tilt)])
    places = np.concatenate([flat, pole, plate])
    places += rng.normal(0.0, 0.003, places.shape)
    at = drive[rng.integers(0, 40, len(places)), :3]
    at[len(flat) : len(flat) + n, :2] = seen_from
    light = np.repeat([1000.0, 1000.0, 6000.0], [len(flat), n, len(plate)])
    box = Box(0.0, -8.0, 20.0, 8.0)
    order = np.lexsort((places[:, 1], places[:, 0]))
    returns = returns_of(places[order], light[order], np.arange(len(places)) * 1000, at[order])
    return make_scene(returns, box, box, drive)


@pytest.mark.slow
def test_a_leaning_pole(scene: Scene) -> None:
    (pole,) = objects_of(scene, "pole")
    assert pole.attributes["lean_deg"] == pytest.approx(LEAN_DEG, abs=0.3)
    assert pole.attributes["diameter_m"] == pytest.approx(0.12, abs=0.02)
    # The place is the foot of the axis, not its middle.
    assert (pole.geometry.x, pole.geometry.y) == (pytest.approx(8.0, abs=0.02), pytest.approx(4.0, abs=0.02))


def test_a_plate_that_looks_up(scene: Scene) -> None:
    (sign,) = objects_of(scene, "sign")
    assert sign.attributes["tilt_deg"] == pytest.approx(TILT_DEG, abs=1.0)
    assert sign.attributes["facing_deg"] == pytest.approx(180.0, abs=1.0)
    assert sign.attributes["width_m"] == pytest.approx(WIDE_M, abs=0.05)
    assert sign.attributes["plate_height_m"] == pytest.approx(TALL_M, abs=0.05)
    assert sign.attributes["shape"] == "rectangle"


def test_plates_back_to_back_are_two_signs() -> None:
    """Two plates on one post, 8 cm apart; drives on both sides see each its own. A plate whose back shines is one."""
    rng = np.random.default_rng(9)
    drive = np.column_stack([np.full(40, 10.0), np.linspace(-9.0, 9.0, 40), np.full(40, 2.0), np.ones(40)])
    flat = np.column_stack([rng.uniform(0.0, 20.0, 60_000), rng.uniform(-10.0, 10.0, 60_000), np.zeros(60_000)])
    parts, sensors = [flat], [drive[rng.integers(0, 40, len(flat)), :3]]
    for east, apart in ((6.0, 0.04), (14.0, 0.002)):
        for side in (-1.0, 1.0):
            face = np.column_stack(
                [rng.uniform(-0.4, 0.4, 700), np.full(700, side * apart), rng.uniform(-0.3, 0.3, 700)]
            )
            parts.append(np.array([east, 0.0, 2.6]) + face)
            sensors.append(np.column_stack([np.full(700, 10.0), side * rng.uniform(3.0, 9.0, 700), np.full(700, 2.0)]))
    places = np.concatenate(parts)
    places += rng.normal(0.0, 0.003, places.shape)
    light = np.repeat([1000.0, 6000.0], [len(flat), len(places) - len(flat)])
    box = Box(0.0, -10.0, 20.0, 10.0)
    scene = make_scene(
        returns_of(places, light, np.arange(len(places)) * 1000, np.concatenate(sensors)), box, box, drive
    )
    signs = [(round(s.geometry.x), round(s.attributes["facing_deg"]) % 360) for s in objects_of(scene, "sign")]
    assert sorted(signs)[:2] == [(6, 0), (6, 180)]
    assert [east for east, _ in signs].count(14) == 1


@pytest.mark.parametrize("middle_m", [2.0, 2.4, 2.8])
def test_a_low_plate_without_a_post_is_a_sign(middle_m: float) -> None:
    """What ends 1.6 m above the ground could be a shaft by itself: 0.8 m wide and tall, seen from one place."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0.0, 12.0, (40_000, 2)), rng.normal(50.0, 0.005, 40_000)])
    right, normal = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0]), np.array([math.sqrt(0.5), -math.sqrt(0.5), 0.0])
    plate = np.array([6.0, 6.0, 50.0 + middle_m]) + rng.uniform(-0.4, 0.4, (600, 1)) * right
    plate += rng.uniform(-0.4, 0.4, (600, 1)) * np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.004, (600, 1)) * normal
    places = np.vstack([ground, plate])
    light, sensor = np.repeat([2000.0, 40_000.0], [len(ground), 600]), np.tile([11.0, 1.0, 52.0], (len(places), 1))
    drive = np.column_stack([np.linspace(8.0, 12.0, 9), np.ones(9), np.full(9, 52.0), np.zeros(9)])
    box = Box(0.0, 0.0, 12.0, 12.0)
    scene = make_scene(returns_of(places, light, np.arange(len(places)), sensor), box, box, drive)
    (sign,) = objects_of(scene, "sign")
    assert sign.geometry.z == pytest.approx(50.0 + middle_m, abs=0.02)
