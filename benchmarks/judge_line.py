"""The question of the judge `line`: is a straight line in a group that may be a vehicle no flank of vehicles?

Asked about are lines of groups that the judge `vehicle` takes for vehicles, and some that it nearly does.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.judged_scenes import (
    HARD,
    PERSON,
    PLAIN,
    UNKNOWN,
    VEHICLE,
    JudgedScene,
    recorded_scenes,
    simulated,
    simulated_scenes,
)
from benchmarks.judgement import Segments
from benchmarks.parked_rows import street_of_parked_rows
from roadscan.assets import classes
from roadscan.assets.moving import CELL_M, LEVEL_M, TALL, columns_of, driven_cells, moving_cells
from roadscan.assets.road_users import VEHICLE as IS_VEHICLE
from roadscan.assets.road_users import Bodies, groups_of, lines_in
from roadscan.assets.surroundings import cubes_of

ROWS: Final = range(40)
MORE_HARD: Final = range(18, 30)
"""Seeds of streets with rows of parked cars, and of hard streets that no other judge is fitted to."""
FIT: Final[dict[str, Any]] = {"increasing": ("even", "even_part"), "min_data_in_leaf": 8, "rounds": 100}
_LEAST: Final = 0.1
"""Probability from which lines of a group are taught."""
_LEAST_RETURNS: Final = 20
"""Lines with fewer returns are not taught."""
_LOW_M: Final = 0.3
"""Returns below this height above the ground (m) do not tell what a line is."""
_RIGHT, _WRONG = 0.3, 0.7
"""Share of vehicles among the returns of a line, below and above which it is none or one."""


def segments(folder: Path) -> Iterator[Segments]:
    """Lines of each scene."""
    for one in scenes(folder):
        yield from of_scene(one)


def scenes(folder: Path) -> Iterator[JudgedScene]:
    """The scenes that all judges are fitted to, more hard streets, and rows of parked cars."""
    yield from recorded_scenes(folder)
    yield from simulated_scenes((*HARD, *MORE_HARD), PLAIN)
    for seed in ROWS:
        yield simulated(street_of_parked_rows(seed), "rows", 1.0)


def of_scene(one: JudgedScene) -> Iterator[Segments]:
    """The lines of a scene that were judged, with their features."""
    scene, returns = one.scene, one.scene.returns
    on_ground = np.isin(scene.classes, (classes.GROUND, classes.ROAD))
    above = ~on_ground & (scene.above_ground_m > 0.1)
    held = columns_of(returns, scene.above_ground_m, on_ground, scene.extent)
    cubes = cubes_of(returns, scene.above_ground_m, above, scene.extent)
    moving = moving_cells(held) | driven_cells(held, scene.drive_xyh_m)
    groups = groups_of(held, moving, Bodies(returns, scene.above_ground_m, on_ground, cubes))
    if not groups.number.size:
        return
    lines = lines_in(groups, IS_VEHICLE.probability(groups.features) >= _LEAST, held)
    column, row = (np.floor((v - o) / CELL_M).astype(int) for v, o in
                   zip((returns.x_m, returns.y_m), held.grid.origin, strict=True))  # fmt: skip
    inside = above & (scene.above_ground_m > _LOW_M) & (scene.above_ground_m < TALL * LEVEL_M)
    inside &= (row >= 0) & (column >= 0) & (row < held.top.shape[0]) & (column < held.top.shape[1])
    label = np.zeros(held.top.shape, np.int64)
    for k, cells in enumerate(zip(lines.row, lines.column, strict=True)):
        label[cells] = k + 1
    at, what = label[row[inside], column[inside]], one.what[inside]
    known, users = (np.bincount(at, weights=w, minlength=len(lines.row) + 1)[1:]
                    for w in (what != UNKNOWN, np.isin(what, (VEHICLE, PERSON))))  # fmt: skip
    share = users / np.maximum(known, 1)
    keep = (known >= _LEAST_RETURNS) & ((share < _RIGHT) | (share > _WRONG))
    if keep.any():
        places = np.array([[c.mean(), r.mean()] for r, c in zip(lines.row, lines.column, strict=True)])[keep] * CELL_M
        features = {name: values[keep] for name, values in lines.features.items()}
        weight = np.sqrt(np.clip(features["length_m"] / 10.0, 0.5, 4.0)) * one.weight
        yield Segments(one.groups(np.array(held.grid.origin) + places), one.source, features, share[keep] < _RIGHT,
                       weight)  # fmt: skip
