"""What a shaft that stands is: a pole, a lamp post, a signal, a tree or a delineator, one question each.

Asked about is what stands by itself as the judge `post` says. What its returns met tells its type. The labelled
recording tells trunks from poles alone: of its poles nobody knows whether they carry a lamp or a signal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.drawn_streets import street_of_shafts
from benchmarks.judge_post import SIGHT, what_of
from benchmarks.judged_scenes import JudgedScene, recorded_scenes, simulated, simulated_scenes
from benchmarks.judgement import Segments, with_unknown
from benchmarks.street_classes import SHAFTS
from roadscan.assets.upright.standing import TYPES as JUDGES
from roadscan.assets.upright.standing import features_of_types, standing_of

TYPES: Final = tuple(JUDGES)
POST: Final = "post"
"""A pole of a type that nobody knows."""
HARD: Final = range(6)
PLAIN: Final = range(200, 204)
SHAFTS_OF: Final = (500, 501, 502, 504, 505, 508, 510, 513, 514, 516, 517, 518, 520, *range(523, 528), *range(529, 538))
"""Seeds of hard streets, one of each kind, of plain ones, and of streets that hold many of all these."""
LONG_ARMS: Final = (541, 546, 547, 548, 550, 551, 552, 557)
LONG_ARM_M: Final = 5.5
"""Seeds of streets whose lamps may have arms as long as those of signals, and how long (m)."""
_HEAD_M: Final = 0.3
"""A signal of which no box so high is seen (m), at its shaft or within reach at its arm, nobody can tell."""
_RECORDED_WEIGHT: Final = 0.15
"""How much a shaft of the recording counts: 18 views show the same street."""
BRIGHT: Final = ("bright", "head_bright", "end_bright")
"""Features that clouds without intensity do not tell."""
_FROM: Final = ("range_m", "rise_of_top")
"""Features that clouds without a trajectory do not tell."""
_MOST: Final = 0.5
"""A shaft is what this share of its returns met, or more."""
FIT: Final[dict[str, Any]] = {"rounds": 120, "num_leaves": 8, "feature_fraction": 0.4}


def segments(folder: Path) -> Iterator[Segments]:
    """Shafts that stand, of the recorded street, of streets that other judges are fitted to, and of those of shafts."""
    for one in (*recorded_scenes(folder), *simulated_scenes(HARD, PLAIN)):
        yield from of_scene(one)
    for seed in SHAFTS_OF:
        yield from of_scene(simulated(street_of_shafts(seed), "shafts", 1.0))
    for seed in LONG_ARMS:
        yield from of_scene(simulated(street_of_shafts(seed, lamp_arm_m=LONG_ARM_M), "shafts", 1.0))


def of_scene(one: JudgedScene) -> Iterator[Segments]:
    """The shafts of a scene that stand and whose type is known, with all features and without some."""
    standing = standing_of(one.scene)
    told = [type_of(one, shaft.rows) if what_of(one, shaft) else "" for shaft in standing.shafts]
    keep = np.array([t != "" for t in told], np.bool_)
    if keep.any():
        features = {name: values[keep] for name, values in features_of_types(one.scene, standing).items()}
        if one.source == "recorded":
            features |= {name: np.full(int(keep.sum()), np.nan) for name in BRIGHT}
        places = np.array([s.foot_xy_m for s in standing.shafts])[keep]
        true = np.array(told)[keep]
        weight = _RECORDED_WEIGHT if one.source == "recorded" else one.weight
        own = Segments(one.groups(places), one.source, features, true, np.full(true.size, weight))
        yield from with_unknown([own], (*SIGHT, *BRIGHT, *_FROM))


def type_of(one: JudgedScene, rows: npt.NDArray[np.int64]) -> str:
    """The type of the shaft of some returns; empty where nobody can say."""
    count = np.bincount(one.types[rows], minlength=len(SHAFTS))
    best = int(count.argmax())
    return SHAFTS[best] if best and count[best] >= _MOST * rows.size else ""


def hides_its_head(features: dict[str, npt.NDArray[np.float64]]) -> npt.NDArray[np.bool_]:
    """Which shafts (n,) show no box as high as the head of a signal."""
    return ~((features["head_high_m"] >= _HEAD_M) | (features["end_high_m"] >= _HEAD_M))


def asked(some: Segments, kind: str) -> Segments:
    """The question whether shafts are of a type: poles of which nobody knows it say only that they are no tree."""
    known = (some.true != POST) | (kind == "tree")
    known &= (some.true != "signal") | ~hides_its_head(some.features)
    group = some.group[known] if isinstance(some.group, np.ndarray) else some.group
    features = {name: values[known] for name, values in some.features.items()}
    return replace(some, group=group, features=features, true=some.true[known] == kind, weight=some.weight[known])
