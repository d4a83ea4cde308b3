"""Vehicles and people: returns that others labelled or framed as theirs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.ground.surface import Grid
from roadscan.assets.kind import asset_kinds
from roadscan.assets.make_scene import make_scene
from roadscan.assets.moving import Columns, load_levels, moving_cells
from roadscan.assets.road_users import _upper_part
from roadscan.assets.scene import Box, Scene
from tests.assets.drives import CAR, PERSON, kitti_drive_returns

SET_APART = (classes.VEHICLE, classes.PERSON)
NO_ASSET = (*SET_APART, classes.GROUND, classes.ROAD, classes.LOW_NOISE)
WHOLE_DRIVE = slice(None)


def test_a_cabin_behind_a_bonnet_belongs_to_its_vehicle_and_a_plate_beside_it_does_not() -> None:
    """Cells of 0.2 m: a bonnet of 2 m by 1 m, behind it a cabin of 2 m by 3 m of which three sides are seen, from 1.2 m
    to 2.4 m above the ground; beside the bonnet a plate 0.6 m wide.
    """
    body, levels = np.zeros((16, 30), np.bool_), np.zeros((16, 30), np.uint32)
    body[3:13, 3:8], levels[3:13, 3:8] = True, 0b111110
    cabin = np.zeros_like(body)
    cabin[3:13, 8], cabin[3:13, 22], cabin[3, 8:23] = True, True, True
    levels[cabin] = 0b111111000000
    levels[1, 4:7] = 0b111000000000
    upper, highest = _upper_part(levels, ~body, body)
    assert np.array_equal(upper, cabin)
    assert set(highest[cabin].tolist()) == {11}


def drive(scans: slice) -> tuple[Scene, np.ndarray]:
    returns, framed, _, path = kitti_drive_returns(scans)
    lowest, highest = path[:, :2].min(axis=0) - 40.0, path[:, :2].max(axis=0) + 40.0
    window = Box(*lowest.tolist(), *highest.tolist())
    inside = window.holds(returns.x_m, returns.y_m)
    return make_scene(returns.at(inside), window, window, path), framed[inside]


def left_over(scene: Scene, framed: np.ndarray, last_s: float = 0.0) -> tuple[float, float]:
    """Shares of the returns in frames of cars and of people that could end in an asset; those of the last seconds of
    the drive do not count.
    """
    free = ~np.isin(scene.classes, NO_ASSET)
    epoch = scene.returns.epoch_gps_ns
    counted = epoch <= epoch.max() - int(last_s * 1e9)
    return float(free[counted & (framed == CAR)].mean()), float(free[counted & (framed == PERSON)].mean())


@pytest.mark.slow
def test_three_seconds_of_a_drive() -> None:
    """Who follows the recording car is seen where that has just been, and belongs to no frame."""
    scene, framed = drive(slice(30, 40))
    cars, people = left_over(scene, framed)
    assert cars <= 0.03
    assert people <= 0.15  # 0.09: some came into sight as they stood
    returns, way = scene.returns, cKDTree(scene.drive_xyh_m[:, :2])
    driven = way.query(np.column_stack([returns.x_m, returns.y_m]))[0] < 0.6
    driven &= (scene.above_ground_m > 0.65) & (scene.above_ground_m < 1.35)
    assert driven.sum() > 500
    assert np.isin(scene.classes[driven], NO_ASSET).all()


@pytest.mark.nightly
def test_a_whole_drive() -> None:
    """Who comes into sight in the last second is not told from what stands, since no ground is seen there later."""
    scene, framed = drive(WHOLE_DRIVE)
    cars, people = left_over(scene, framed)
    assert cars <= 0.02  # 0.018; the bar is 0.03
    assert people <= 0.07  # 0.059
    assert left_over(scene, framed, last_s=1.0)[1] <= 0.01  # 0.005
    marked = np.zeros(len(scene.returns), np.bool_)
    for name in ("pole", "lighting", "signal", "sign", "tree", "delineator", "facade", "fence", "wall", "barrier"):
        kind = asset_kinds()[name]
        for part in kind.evidence(scene, kind.options()).marked:
            marked[part.rows] = True
    assert marked[framed == CAR].mean() <= 0.002  # 0.0002


def test_the_top_of_a_lorry_moves_along_and_a_branch_over_its_track_does_not() -> None:
    """Cells of 0.2 m: the lorry shows at 1 m and at 3.5 m in the same slots, not in the same cells; a branch stays."""
    shape = (12, 20)
    things, highs = np.zeros(shape, np.uint64), np.zeros(shape, np.uint64)
    levels = np.zeros(shape, np.uint32)
    inside = np.zeros(shape, np.bool_)
    inside[2:10] = True
    for column in range(20):
        slot = np.uint64(1) << np.uint64(column // 4)
        things[2:10:2, column], levels[2:10:2, column] = slot, 1 << 5
        highs[3:10:2, column], levels[3:10:2, column] = slot, 1 << 17
    highs[5, 8:11], levels[5, 8:11] = np.uint64(2**20 - 1), 1 << 15
    grid = Grid(0.0, 0.0, 0.2, *shape)
    held = Columns(
        grid, levels, np.full(shape, 5, np.int32), things[..., None], np.zeros((*shape, 1), np.uint64), highs[..., None]
    )
    found = load_levels(held, (slice(None), slice(None)), inside)
    assert (found[3, :] == 18).all() and (found[5, :7] == 18).all()
    assert (found[5, 8:11] == 0).all() and (found[2::2] == 0).all()
    highs[3:10:2] = np.uint64(2**20 - 1)  # a crown all along
    assert not load_levels(held, (slice(None), slice(None)), inside).any()


def test_a_post_stands_although_its_edges_are_seen_now_and_then() -> None:
    """Slots of 0.2 s: the middle cell shows the post ten times, those around it once, as of somebody who passes."""
    things, grounds = np.zeros((9, 9), np.uint64), np.full((9, 9), 0b1111, np.uint64)
    things[3:6, 3:6] = 1 << 8
    held = Columns(Grid(0.0, 0.0, 0.2, 9, 9), np.zeros((9, 9), np.uint32), np.zeros((9, 9), np.int32),
                   things[..., None], grounds[..., None], np.zeros((9, 9, 1), np.uint64))  # fmt: skip
    assert moving_cells(held)[3:6, 3:6].all()
    things[4, 4] = 0b11_1111_1111 << 8
    assert not moving_cells(held)[4, 4] and moving_cells(held)[3, 3:6].all()
