"""The question of the judge `vehicle`: is a group of cells that stands on the ground a vehicle?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.judged_scenes import PERSON, UNKNOWN, VEHICLE, JudgedScene, judged_scenes
from benchmarks.judgement import Float64, Segments
from roadscan.assets import classes
from roadscan.assets.moving import CELL_M, LEVEL_M, TALL, Columns, columns_of, driven_cells, moving_cells
from roadscan.assets.road_users import Bodies, Groups, groups_of
from roadscan.assets.surroundings import cubes_of

FIT: Final[dict[str, Any]] = {
    "increasing": ("planarity", "fill", "ground_around", "upright", "slanting", "level"),
    "decreasing": ("tall_beside", "scattering", "leafy", "thickness", "from_28_dm", "in_columns"),
    "rounds": 200, "num_leaves": 10, "feature_fraction": 0.4,
}  # fmt: skip
_LEAST_RETURNS: Final = 20
"""Groups with fewer returns are not taught: hardly anybody could label them."""
_LOW_M: Final = 0.3
"""Returns below this height above the ground (m) do not tell what stands there."""
_RIGHT, _WRONG = 0.6, 0.2
"""Share of vehicles and people among the returns of a group, above and below which it is one or none."""


def segments(folder: Path) -> Iterator[Segments]:
    """Groups of each scene."""
    for one in judged_scenes(folder):
        found = of_scene(one)
        if found.true.size:
            yield found


class Standing(NamedTuple):
    """What stands on the ground in a scene, in cells."""

    raster: Columns
    groups: Groups
    row: npt.NDArray[np.int64]
    column: npt.NDArray[np.int64]
    """(n,) cell of each return that tells what stands there."""
    what: npt.NDArray[np.uint8]
    """(n,) what it met."""

    def known_and_users(self, label: npt.NDArray[Any], count: int) -> tuple[Float64, Float64]:
        """Returns (count,) that are known, and those of vehicles and people, by the label of their cells."""
        at = label[self.row, self.column]
        known, users = (
            np.bincount(at, weights=w, minlength=count)
            for w in (self.what != UNKNOWN, np.isin(self.what, (VEHICLE, PERSON)))
        )
        return known, users


def standing_in(one: JudgedScene) -> Standing:
    """What stands in a scene, and what its returns above 0.3 m met."""
    scene, returns = one.scene, one.scene.returns
    on_ground = np.isin(scene.classes, (classes.GROUND, classes.ROAD))
    above = ~on_ground & (scene.above_ground_m > 0.1)
    raster = columns_of(returns, scene.above_ground_m, on_ground, scene.extent)
    cubes = cubes_of(returns, scene.above_ground_m, above, scene.extent)
    moving = moving_cells(raster) | driven_cells(raster, scene.drive_xyh_m)
    groups = groups_of(raster, moving, Bodies(returns, scene.above_ground_m, on_ground, cubes))
    column, row = (np.floor((v - o) / CELL_M).astype(np.int64) for v, o in
                   zip((returns.x_m, returns.y_m), raster.grid.origin, strict=True))  # fmt: skip
    inside = above & (scene.above_ground_m > _LOW_M) & (scene.above_ground_m < TALL * LEVEL_M)
    inside &= (row >= 0) & (column >= 0) & (row < raster.top.shape[0]) & (column < raster.top.shape[1])
    return Standing(raster, groups, row[inside], column[inside], one.what[inside])


def of_scene(one: JudgedScene) -> Segments:
    """The groups of a scene that were judged; large ones count more."""
    stands = standing_in(one)
    groups, count = stands.groups, int(stands.groups.label.max()) + 1
    known, users = (of_label[groups.number] for of_label in stands.known_and_users(groups.label, count))
    all_own = np.bincount(groups.label[stands.row, stands.column], minlength=count)[groups.number]
    share = users / np.maximum(known, 1)
    keep = (known >= _LEAST_RETURNS) & (known > _RIGHT * all_own) & ((share > _RIGHT) | (share < _WRONG))
    weight = np.clip(np.sqrt(all_own / 200.0), 0.3, 3.0)[keep] * one.weight
    features = {name: values[keep] for name, values in groups.features.items()}
    middles = groups.boxes[keep, :2] + groups.boxes[keep, 2:] / 2.0
    return Segments(one.groups(np.array(stands.raster.grid.origin) + middles * CELL_M), one.source, features,
                    share[keep] > _RIGHT, weight)  # fmt: skip
