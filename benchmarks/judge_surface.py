"""The question of the judges of upright surfaces: of which sort is a stretch of one?

A fence lets sight lines through, a guard rail is a rail on posts, and walls, fronts and fences of panels are solid;
hedges, vehicles and what is only a part of something are no surface. Asked about are stretches lower than a façade. The
labelled recording tells fences, fronts and plants.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.spatial

from benchmarks.drawn_streets import drawn_street
from benchmarks.hard_streets import hard_street
from benchmarks.judged_scenes import in_window, recorded_views
from benchmarks.judgement import Float64, Segments
from benchmarks.labelled_returns import LabelledReturns, labelled_returns
from benchmarks.parked_rows import street_of_parked_rows
from benchmarks.street_scores import BUILDING, FENCE, NOT_JUDGED, STRUCTURE
from benchmarks.walls_with_gaps import street_of_gapped_walls
from roadscan.assets.kinds.surfaces import is_high
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.lines import Chain, chains_of, pieces_of_panels
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.sorts import JUDGES, features_of
from roadscan.simulate import Scene as Street

TYPES: Final = tuple(JUDGES)
HARD: Final = range(30, 76)
PLAIN: Final = range(200, 208)
ROWS: Final = range(100, 110)
GAPS: Final = range(10)
"""Seeds of hard streets, plain ones, streets of parked rows, and of walls with gaps."""
FIT: Final[dict[str, Any]] = {"rounds": 250, "num_leaves": 8, "feature_fraction": 0.4}
_NO_SURFACE, _FENCE, _GUARDRAIL, _SOLID, _UNKNOWN = range(5)
_OF_KIND: Final = {"guardrail": _GUARDRAIL, "ground": _UNKNOWN, "none": _NO_SURFACE,
                   **dict.fromkeys(("wall", "facade", "door", "shop_sign"), _SOLID)}  # fmt: skip
"""What the returns of a kind tell; those of fences and gates tell their style."""
_FOOT_M, _HIGHEST_M = 0.25, 3.5
"""Returns between these heights above the ground (m) tell what a stretch is."""
_BESIDE_M, _LEAST, _MOST = 0.2, 4, 0.6
"""So near to its line (m) lie returns of a stretch, so many at the least, and this share of them are of one sort."""
_PART_M: Final = 20.0
"""Edge of the parts of the recorded street that are held out together (m)."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """A scene, and of which sort its returns (n,) are."""

    scene: Scene
    sort: npt.NDArray[np.int64]
    name: str
    source: str


def segments(folder: Path) -> Iterator[Segments]:
    """Stretches of the recorded street and of simulated ones."""
    of_label = np.full(256, _NO_SURFACE)
    of_label[list(NOT_JUDGED)], of_label[FENCE], of_label[[BUILDING, STRUCTURE]] = _UNKNOWN, _FENCE, _SOLID
    for scene, label in recorded_views(folder):
        yield from _of_scene(_Shown(scene, of_label[label], "street", "recorded"))
    for seed in HARD:
        yield from of_street(hard_street(seed), "hard")
    for seed in PLAIN:
        yield from of_street(drawn_street(seed), "plain")
    for seed in ROWS:
        yield from of_street(street_of_parked_rows(seed), "rows")
    for seed in GAPS:
        yield from of_street(street_of_gapped_walls(seed), "gaps")


def of_street(street: Street, source: str) -> Iterator[Segments]:
    """Stretches of a simulated street."""
    seen = labelled_returns(street)
    inside, window, station, offset = in_window(seen, street)
    scene = make_scene(seen.returns.at(inside), window, window, seen.drive_xyh_m)
    yield from _of_scene(_Shown(scene, _sorts(seen, street, inside, station, offset), street.id, source))


def _sorts(
    seen: LabelledReturns, street: Street, inside: npt.NDArray[np.int64], station: Float64, offset: Float64
) -> npt.NDArray[np.int64]:
    """Returns the sort of each return (n,) of a simulated street."""
    of_kind = np.array([_OF_KIND.get(kind, _NO_SURFACE) for kind in seen.kinds])
    out = of_kind[seen.kind[inside]]
    fences = np.isin(seen.kind[inside], [k for k, kind in enumerate(seen.kinds) if kind in ("fence", "gate")])
    out[fences] = _UNKNOWN
    for one in street.roadside.fences:
        own = fences & (np.abs(offset - one.offset_m) < 0.5) & (station > one.start_m) & (station < one.end_m)
        out[own] = _SOLID if one.style == "panels" else _FENCE
    return out


def _of_scene(one: _Shown) -> Iterator[Segments]:
    scene = one.scene
    returns, above = scene.returns, scene.above_ground_m
    rows = np.flatnonzero((above > _FOOT_M) & (above < _HIGHEST_M))
    places = np.column_stack([returns.x_m, returns.y_m])[rows]
    tree, sort = scipy.spatial.cKDTree(places), one.sort[rows]
    for chain in chains_of(pieces_of_panels(scene, panels_of(scene))):
        true = _true_of(chain, np.array(returns.corner_m), tree, sort)
        keep = (true != _UNKNOWN) & ~is_high(chain) & np.isfinite(chain.values["high_m"])
        if keep.any():
            middle = (chain.xy_m[:-1] + chain.xy_m[1:])[keep] / 2
            part = [f"{one.name} {x:.0f} {y:.0f}" for x, y in np.floor(middle / _PART_M)]
            group = np.array(part if one.source == "recorded" else [one.name] * int(keep.sum()), np.str_)
            features = {name: value[keep] for name, value in features_of(chain).items()}
            names = np.array(TYPES)[true[keep]]
            yield Segments(group, one.source, features, names, chain.values["length_m"][keep])


def _true_of(
    chain: Chain, corner_m: Float64, tree: scipy.spatial.cKDTree, sort: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Returns the sort of each stretch (k,) of a surface: that of most returns on it."""
    middle, way = (chain.xy_m[:-1] + chain.xy_m[1:]) / 2 - corner_m, np.diff(chain.xy_m, axis=0)
    out = np.full(len(way), _UNKNOWN)
    for k, long in enumerate(np.hypot(*way.T).tolist()):
        near = np.array(tree.query_ball_point(middle[k], long / 2 + _BESIDE_M), np.int64)
        past, along = tree.data[near] - middle[k], way[k] / max(long, 1e-9)
        on = (np.abs(past @ along) <= long / 2) & (np.abs(past[:, 1] * along[0] - past[:, 0] * along[1]) < _BESIDE_M)
        count = np.bincount(sort[near[on]], minlength=_UNKNOWN + 1)
        if count.sum() >= _LEAST and count.max() >= _MOST * count.sum():
            out[k] = count.argmax()
    return out
