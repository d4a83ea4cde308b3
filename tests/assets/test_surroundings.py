"""Classes of what stands beside the road, against labels by hand and shapes whose class is known."""

from __future__ import annotations

import numpy as np

from roadscan.assets import classes
from roadscan.assets.ground.bare_earth import road_cells
from roadscan.assets.scene import Box, GroundModel, Returns
from roadscan.assets.surroundings import cubes_of, surroundings
from tests.assets.test_bare_earth import airborne

NO_DRIVE = np.zeros((0, 4))
VEGETATION = (classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION)


def classes_of(points: np.ndarray, drive: np.ndarray = NO_DRIVE) -> np.ndarray:
    """Classes of points (n, 3) over level ground at height 0, of a sensor 30 m away."""
    window, returns = Box(0.0, 0.0, 20.0, 20.0), airborne(points)
    far: Returns = returns.at(np.ones(len(points), np.bool_))
    for axis in (far.sensor_x_m, far.sensor_y_m, far.sensor_height_m):
        axis[:] = -30.0
    above = points[:, 2].astype(np.float32)
    cubes = cubes_of(far, above, np.ones(len(points), np.bool_), window)
    return surroundings(far, above, np.full(len(points), classes.UNCLASSIFIED, np.uint8), cubes, window, drive)


def test_a_wall_a_bush_and_a_wire() -> None:
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(2, 14, 6000), rng.normal(15.0, 0.01, 6000), rng.uniform(0.1, 6, 6000)])
    bush = np.array([16.0, 5.0, 1.2]) + rng.uniform(-1.0, 1.0, (3000, 3))
    wire = np.column_stack([rng.uniform(1, 19, 1500), rng.normal(8.0, 0.01, 1500), rng.normal(7.0, 0.01, 1500)])
    found = classes_of(np.concatenate([wall, bush, wire]))
    assert (found[:6000] == classes.BUILDING).mean() > 0.97
    assert np.isin(found[6000:9000], VEGETATION).mean() > 0.97
    heights = bush[:, 2]
    assert (found[6000:9000][heights > 2.05] == classes.HIGH_VEGETATION).mean() > 0.95
    assert (found[9000:] == classes.WIRE).mean() > 0.95


def test_a_bridge_a_gantry_and_a_roof() -> None:
    rng = np.random.default_rng(7)
    deck = np.column_stack([rng.uniform(1, 19, 20_000), rng.uniform(3, 8, 20_000), rng.normal(5.0, 0.01, 20_000)])
    side = np.column_stack([rng.uniform(1, 19, 5000), rng.normal(3.0, 0.01, 5000), rng.uniform(5.0, 6.2, 5000)])
    gantry = np.column_stack([rng.uniform(1, 19, 4000), rng.uniform(13, 13.6, 4000), rng.normal(5.5, 0.01, 4000)])
    drive = np.column_stack([np.full(20, 10.0), np.arange(20.0), np.full(20, 2.0), np.ones(20)])
    found = classes_of(np.concatenate([deck, side, gantry]), drive)
    assert (found[:25_000] == classes.BRIDGE_DECK).mean() > 0.97
    assert (found[25_000:] == classes.OVERHEAD_STRUCTURE).mean() > 0.97
    beside = drive + np.array([60.0, 0.0, 0.0, 0.0])
    assert not np.isin(classes_of(deck, beside), (classes.BRIDGE_DECK, classes.OVERHEAD_STRUCTURE)).any()


def test_the_arm_of_a_lamp_beside_a_bridge_is_none_of_its_deck() -> None:
    rng = np.random.default_rng(8)
    deck = np.column_stack([rng.uniform(1, 19, 20_000), rng.uniform(3, 8, 20_000), rng.normal(5.0, 0.01, 20_000)])
    arm = np.column_stack([rng.normal(10.0, 0.04, 600), rng.uniform(0.8, 2.7, 600), rng.normal(5.6, 0.04, 600)])
    drive = np.column_stack([np.full(20, 10.0), np.arange(20.0), np.full(20, 2.0), np.ones(20)])
    found = classes_of(np.concatenate([deck, arm]), drive)
    assert (found[:20_000] == classes.BRIDGE_DECK).mean() > 0.97
    assert (found[20_000:][arm[:, 1] < 2.1] != classes.BRIDGE_DECK).mean() > 0.95


def test_road_ends_at_a_kerb() -> None:
    rows, columns, cell_m = 80, 120, 0.25
    y = (np.arange(rows) + 0.5) * cell_m
    height = np.where(np.abs(y - 10.0) > 3.5, 0.10, 0.02 * (y - 10.0))[:, None].repeat(columns, axis=1)
    ground = GroundModel(0.0, 0.0, cell_m, height.astype(np.float32), np.ones((rows, columns), np.bool_))
    path = np.column_stack([np.arange(1.0, 30.0), np.full(29, 9.0), np.full(29, 2.0), np.ones(29)])
    road = road_cells(ground, path)
    assert road[np.abs(y - 10.0) < 3.5 - cell_m, 60].all()  # the cell beside the step is left out
    assert not road[np.abs(y - 10.0) > 3.5].any()
    assert not road_cells(ground, path[:0]).any()
