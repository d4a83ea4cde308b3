"""The question of the judge `vehicle`: is a group of cells that stands on the ground a vehicle?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.judged_scenes import PERSON, UNKNOWN, VEHICLE, JudgedScene, judged_scenes
from benchmarks.judgement import Segments
from roadscan.assets import classes
from roadscan.assets.moving import CELL_M, LEVEL_M, TALL, columns_of, driven_cells, moving_cells
from roadscan.assets.road_users import Bodies, groups_of
from roadscan.assets.surroundings import cubes_of

FIT: Final[dict[str, Any]] = {
    "increasing": ("planarity", "fill", "ground_around", "upright", "slanting", "level"),
    "decreasing": ("tall_beside", "scattering", "leafy", "thickness", "from_28_dm", "in_columns"),
    "rounds": 200, "num_leaves": 10, "feature_fraction": 0.4,
}  # fmt: skip
_LEAST_RETURNS: Final = 20
"""Groups with fewer returns are not taught: hardly anybody could label them."""
_LOW_M: Final = 0.3
"""Returns below this height above the ground (m) do not tell what a group is."""
_RIGHT, _WRONG = 0.6, 0.2
"""Share of vehicles and people among the returns of a group, above and below which it is one or none."""


def segments(folder: Path) -> Iterator[Segments]:
    """Groups of each scene."""
    for one in judged_scenes(folder):
        found = of_scene(one)
        if found.true.size:
            yield found


def of_scene(one: JudgedScene) -> Segments:
    """The groups of a scene that were judged; large ones count more."""
    scene, returns = one.scene, one.scene.returns
    on_ground = np.isin(scene.classes, (classes.GROUND, classes.ROAD))
    above = ~on_ground & (scene.above_ground_m > 0.1)
    held = columns_of(returns, scene.above_ground_m, on_ground, scene.extent)
    cubes = cubes_of(returns, scene.above_ground_m, above, scene.extent)
    moving = moving_cells(held) | driven_cells(held, scene.drive_xyh_m)
    groups = groups_of(held, moving, Bodies(returns, scene.above_ground_m, on_ground, cubes))
    column, row = (np.floor((v - o) / CELL_M).astype(int) for v, o in
                   zip((returns.x_m, returns.y_m), held.grid.origin, strict=True))  # fmt: skip
    inside = above & (scene.above_ground_m > _LOW_M) & (scene.above_ground_m < TALL * LEVEL_M)
    inside &= (row >= 0) & (column >= 0) & (row < held.top.shape[0]) & (column < held.top.shape[1])
    label, what = groups.label[row[inside], column[inside]], one.what[inside]
    known, users, all_own = (
        np.bincount(label, weights=w, minlength=int(groups.label.max()) + 1)[groups.number]
        for w in (what != UNKNOWN, np.isin(what, (VEHICLE, PERSON)), np.ones(label.size))
    )
    share = users / np.maximum(known, 1)
    keep = (known >= _LEAST_RETURNS) & (known > _RIGHT * all_own) & ((share > _RIGHT) | (share < _WRONG))
    weight = np.clip(np.sqrt(all_own / 200.0), 0.3, 3.0)[keep] * one.weight
    features = {name: values[keep] for name, values in groups.features.items()}
    middles = groups.boxes[keep, :2] + groups.boxes[keep, 2:] / 2.0
    return Segments(one.groups(np.array(held.grid.origin) + middles * CELL_M), one.source, features,
                    share[keep] > _RIGHT, weight)  # fmt: skip
