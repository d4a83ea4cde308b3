"""The question of the judge `post`: does a shaft stand by itself, as poles, posts and trunks do?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.judged_scenes import POLE, TRUNK, UNKNOWN, JudgedScene, judged_scenes
from benchmarks.judgement import Segments, with_unknown
from roadscan.assets.upright.shafts import Shaft
from roadscan.assets.upright.slices import places_of
from roadscan.assets.upright.standing import candidates_of, features_of

SIGHT: Final = ("goes_through", "open_more", "open_less", "open_both")
"""Features that clouds without a trajectory do not tell."""
FIT: Final[dict[str, Any]] = {
    "increasing": ("slices", "alone", "free", "filled", "alone_lower", "alone_upper", "to_surface_m", "returns",
                   *SIGHT[1:]),
    "decreasing": (
        "in_35_cm", "in_60_cm", "in_120_cm", "low_m", "residual_m", "rough", "more_lean_deg", "company_1_m",
        "company_3_m", "straight_m", "widths_m", "own_building", "building", "opposite", "sides_taken", SIGHT[0],
    ),
    "rounds": 200, "num_leaves": 10, "feature_fraction": 0.4,
}  # fmt: skip
_AROUND_M, _LOW_M, _HIGH_M = 0.3, 0.3, 2.5
"""Returns so near to the axis at the foot, and between these heights above it, tell what a shaft is (m)."""
_RIGHT, _WRONG = 0.4, 0.3
"""Share of poles and trunks among its own returns and those about it, above and below which a shaft is one or none."""


def segments(folder: Path) -> Iterator[Segments]:
    """Shafts of each scene."""
    for one in judged_scenes(folder):
        found = of_scene(one)
        if found.true.size:
            yield from with_unknown([found], SIGHT)


def of_scene(one: JudgedScene) -> Segments:
    """The shafts of a scene that were judged."""
    shafts = candidates_of(one.scene)
    told = [what_of(one, shaft) for shaft in shafts]
    keep = np.array([t is not None for t in told], np.bool_)
    places = np.array([s.foot_xy_m for s in shafts]).reshape(-1, 2)[keep]
    features = {name: values[keep] for name, values in features_of(one.scene, shafts).items()}
    true = np.array([bool(t) for t in told], np.bool_)[keep]
    return Segments(one.groups(places), one.source, features, true, np.full(true.size, one.weight))


def what_of(one: JudgedScene, shaft: Shaft) -> bool | None:
    """Whether a shaft is a pole or a trunk; None where nobody can say."""
    own = one.what[shaft.rows]
    near = places_of(one.scene).within(*shaft.foot_xy_m, _AROUND_M)
    above = one.scene.returns.height_m[near] - shaft.ground_m
    around = one.what[near[(above > _LOW_M) & (above < _HIGH_M)]]
    around = around if around.size else own
    if max(np.mean(own == UNKNOWN), np.mean(around == UNKNOWN)) > _RIGHT:
        return None
    shares = [_share(some) for some in (own, around)]
    return True if min(shares) > _RIGHT else False if max(shares) < _WRONG else None


def _share(what: npt.NDArray[np.uint8]) -> float:
    return float(np.isin(what, (POLE, TRUNK)).mean())
