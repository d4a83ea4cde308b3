"""The question of the judge `line`: is a straight line in a group that may be a vehicle no flank of vehicles?

Asked about are lines of groups that the judge `vehicle` takes for vehicles, and some that it nearly does.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.judge_vehicle import standing_in
from benchmarks.judged_scenes import HARD, PLAIN, JudgedScene, recorded_scenes, simulated, simulated_scenes
from benchmarks.judgement import Segments
from benchmarks.parked_rows import street_of_parked_rows
from roadscan.assets.moving import CELL_M
from roadscan.assets.road_users import VEHICLE as IS_VEHICLE
from roadscan.assets.road_users import lines_in

ROWS: Final = range(40)
MORE_HARD: Final = range(18, 30)
"""Seeds of streets with rows of parked cars, and of hard streets beside those that most judges are fitted to."""
FIT: Final[dict[str, Any]] = {"increasing": ("even", "even_part"), "min_data_in_leaf": 8, "rounds": 100}
_LEAST: Final = 0.1
"""Probability from which lines of a group are taught."""
_LEAST_RETURNS: Final = 20
"""Lines with fewer returns are not taught."""
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
    stands = standing_in(one)
    if not stands.groups.number.size:
        return
    likely = IS_VEHICLE.probability(stands.groups.features) >= _LEAST
    lines = lines_in(stands.groups, likely, stands.raster)
    label = np.zeros(stands.raster.top.shape, np.int64)
    for k, cells in enumerate(zip(lines.row, lines.column, strict=True)):
        label[cells] = k + 1
    known, users = (of_label[1:] for of_label in stands.known_and_users(label, len(lines.row) + 1))
    share = users / np.maximum(known, 1)
    keep = (known >= _LEAST_RETURNS) & ((share < _RIGHT) | (share > _WRONG))
    if keep.any():
        places = np.array([[c.mean(), r.mean()] for r, c in zip(lines.row, lines.column, strict=True)])[keep] * CELL_M
        features = {name: values[keep] for name, values in lines.features.items()}
        weight = np.sqrt(np.clip(features["length_m"] / 10.0, 0.5, 4.0)) * one.weight
        yield Segments(one.groups(np.array(stands.raster.grid.origin) + places), one.source, features,
                       share[keep] < _RIGHT, weight)  # fmt: skip
