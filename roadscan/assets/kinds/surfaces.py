"""Kinds of upright surfaces: façades, walls, barriers, guard rails and fences, with their classification."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets import classes
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.probabilities import logistic
from roadscan.assets.scene import Scene, once_a_tile
from roadscan.assets.upright.lines import PIECE_SCHEMA, Chain, beside, chain_of, chains_of, outline, pieces_of_panels
from roadscan.assets.upright.panels import SIGHT_M, panels_of
from roadscan.assets.upright.sorts import JUDGES, probabilities_of
from roadscan.compute.array_types import Bool

Surface = Literal["facade", "wall", "barrier", "guardrail", "fence"]

_SIMPLE_M: Final = 0.03  # Tolerance of the simplified line (m).
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a surface (m).
_LEAST_M: Final = {"fence": 1.5, "guardrail": 4.0, "wall": 2.5, "barrier": 3.0, "facade": 2.0}
"""Least length of each (m): a gate is a fence."""
_LEAST_TOP_M: Final = {"fence": 0.6, "guardrail": 0.5, "barrier": 0.5}
"""Least height of each (m)."""
_WALL_M: Final = 1.25  # A solid surface that is higher (m) is a wall.
_LOW_PARTS_M: Final = 2.0  # What begins higher above the ground (m) is a crown, a board or a roof.
_FREE_M: Final = 0.6
"""What begins higher above the ground (m) stands on it where its foot is hidden, but not where lines pass below it: a
handrail of stairs is neither a fence nor a wall."""
_LEAFY, _THICK_M = 0.9, 0.035
"""What looks solid is a trimmed hedge where a larger share of its returns is classed as plants, and it is thicker (m,
1 σ). Held out, that takes 60 m of hedges and 2 m of walls from what is solid on the labelled street, and 30 m of the
2,282 m of hard streets."""
_MOST_PASSING: Final = 0.8  # What lets more of the sight lines pass is no surface: parts of a room, seen through panes.
_SOLID_PASSING: Final = 0.4  # What lets more of the sight lines pass is no façade.
_FACADE_M: Final = 3.0  # What is higher is a façade (m), …
_OPEN_M: Final = 1.4  # … as is what is higher than this (m) and rises beyond what scanners saw.
_CHANGE: Final = 3.0
"""A change of sort along a surface costs as much as three metres of a sort that is e times less probable."""
_HIGH: Final = len(JUDGES)
"""Number of the sort of high stretches; the others are those that judges tell."""
_GARDEN_M: Final = 1.6  # What is lower than this (m) is no part of a façade.
_SURE, _MAY_BE = 0.02, 0.25
"""Least probability of a sort, such as that a low stretch is of a façade; and probability that one between low and high
is, of which a van or an awning hides a part."""
_SOLID, _FENCE, _RAIL = (list(JUDGES).index(name) for name in ("solid", "fence", "guardrail"))
_NAMED: Final[dict[int, Surface]] = {_FENCE: "fence", _RAIL: "guardrail"}


def is_high(chain: Chain) -> Bool:
    """Returns which stretches (k,) are as high as a façade, or end above what scanners saw."""
    top = chain.values["high_m"] - chain.values["ground_m"]
    with np.errstate(invalid="ignore"):
        return np.asarray((top > _FACADE_M) | ((top > _OPEN_M) & (chain.values["open_top"] > 0.5)))


def parts_of(chain: Chain) -> list[tuple[Surface | None, int, int]]:
    """Returns the kinds of the parts of an upright surface, each with its first stretch and the one after its last.

    A house, its gate and its garden wall may stand in one line. So judges tell the sort of each stretch; the sorts
    along the surface are the most probable ones, where each change has its cost.
    """
    sort = _sorts(chain)
    edges = np.flatnonzero(np.concatenate([[True], np.diff(sort) != 0, [True]])).tolist()
    out: list[tuple[Surface | None, int, int]] = []
    for first, last in itertools.pairwise(edges):
        name = _named(chain.part(first, last), int(sort[first]))
        begin = out.pop()[1] if out and out[-1][0] == name else first
        out.append((name, begin, last))
    return out


def _named(part: Chain, sort: int) -> Surface | None:
    """Returns the kind of a part of one sort; None where it is none, or too short or low for its kind."""
    top, low = part.median("top_m"), part.median("low_m")
    if not np.isfinite(top) or low > _LOW_PARTS_M or part.passing > _MOST_PASSING:
        return None
    if sort in (_FENCE, _SOLID) and low > _FREE_M and part.free_below:
        return None
    if sort == _SOLID and part.leaves > _LEAFY and part.across_m > _THICK_M:
        return None
    name: Surface | None
    if sort == _HIGH:
        name = "facade" if part.passing < _SOLID_PASSING else None
    elif sort == _SOLID:
        name = "wall" if top > _WALL_M else "barrier"
    else:
        name = _NAMED.get(sort)
    if name is None or part.length_m < _LEAST_M[name]:
        return None
    return name if top >= _LEAST_TOP_M.get(name, 0.0) else None


def _sorts(chain: Chain) -> npt.NDArray[np.int64]:
    """Returns the sort of each stretch (k,): the cheapest way through their costs (Viterbi 1967)."""
    high, top = is_high(chain), chain.values["high_m"] - chain.values["ground_m"]
    known = np.isfinite(top)
    share = np.column_stack([probabilities_of(chain), np.where(np.nan_to_num(top) > _GARDEN_M, _MAY_BE, _SURE)])
    share[high] = _SURE
    share[high, _HIGH] = 1.0
    costs = -np.log(np.maximum(share, _SURE)) * (known * chain.values["length_m"])[:, None]
    change = _CHANGE * (1.0 - np.eye(_HIGH + 1))
    best, back = costs[0], np.zeros((len(costs), _HIGH + 1), np.int64)
    for k in range(1, len(costs)):
        ways = best[:, None] + change
        back[k] = ways.argmin(axis=0)
        best = ways.min(axis=0) + costs[k]
    out = np.empty(len(costs), np.int64)
    out[-1] = best.argmin()
    for k in range(len(costs) - 1, 0, -1):
        out[k - 1] = back[k, out[k]]
    return out


def probability_of(chain: Chain) -> float:
    """Returns the probability of a surface: a logistic function of its length, covered share, returns and thickness."""
    return logistic(
        -1.5,
        [(0.5, min(chain.length_m, 10.0)), (2.0, chain.covered), (0.02, min(chain.seen, 100)),
         (-50.0, max(chain.across_m - 0.04, 0.0))],
    )  # fmt: skip


@once_a_tile
def _named_rows(scene: Scene) -> list[tuple[Surface | None, npt.NDArray[np.int64]]]:
    """Returns the likely kind of each part of each panel that comes near the tile, with its returns."""
    return [
        (name, panel.rows[(panel.stretch >= first) & (panel.stretch < last)])
        for panel in panels_of(scene)
        if panel.comes_near(scene.tile)
        for name, first, last in parts_of(chain_of(panel))
    ]


@once_a_tile
def _pieces_of_all(scene: Scene) -> pa.Table:
    """Returns pieces of all panels inside the scene's tile."""
    return pieces_of_panels(scene, panels_of(scene))


class SurfaceKind(AssetKind):
    """A kind of upright surfaces: its evidence are the pieces of all of them, classified once they are joined."""

    code: ClassVar[int]
    piece_schema = PIECE_SCHEMA
    reach_m: ClassVar[float] = SIGHT_M + 1.0

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Pieces of all upright surfaces in the tile; marked are the returns of those that look like this kind."""
        marked = [Marked(self.marks(scene, rows), self.code) for name, rows in _named_rows(scene) if name == self.name]
        return Evidence(_pieces_of_all(scene), tuple(marked))

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns that belong to a surface of these rows."""
        return rows

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each chain of this kind."""
        return [
            self.made(chain.part(first, last))
            for chain in chains_of(pieces)
            for name, first, last in parts_of(chain)
            if name == self.name
        ]

    def made(self, chain: Chain) -> AssetObject:
        """Returns the object of a chain: its line along the ground."""
        ground = chain.values["ground_m"]
        height = np.concatenate([ground[:1], (ground[:-1] + ground[1:]) / 2, ground[-1:]])
        line = shapely.LineString(np.column_stack([chain.xy_m, height])).simplify(_SIMPLE_M)
        values = {"asset_height_m": chain.median("top_m"), "length_m": chain.length_m}
        return as_object(chain, line, values, math.hypot(_GROUND_SIGMA_M, chain.sigma_median_m("top_m")))


def as_object(
    chain: Chain, geometry: shapely.Geometry, values: Mapping[str, Any], sigma_size_m: float | None = None
) -> AssetObject:
    """Returns an object of a chain."""
    sigma = max(0.005, chain.across_m / np.sqrt(max(chain.seen / max(chain.length_m, 1.0), 1.0)))
    passes = len(chain.passes)
    return AssetObject(
        geometry, float(sigma), _GROUND_SIGMA_M, probability_of(chain), chain.seen, passes, *chain.epochs_gps_ns,
        values, sigma_size_m,
    )  # fmt: skip


class Barrier(SurfaceKind):
    """Barriers, from upright surfaces."""

    name = "barrier"
    title = "Barrier"
    curve = "surfaces"
    code = classes.BARRIER


class Guardrail(SurfaceKind):
    """Guard rails, from upright surfaces."""

    name = "guardrail"
    title = "Guard Rail"
    curve = "surfaces"
    code = classes.BARRIER


class Wall(SurfaceKind):
    """Walls, from upright surfaces."""

    name = "wall"
    title = "Wall"
    curve = "surfaces"
    code = classes.BARRIER


_BESIDE_M: Final = 0.15  # Posts, foot and rails lie so near to the surface of a fence (m).
_FOOT_M: Final = 0.05  # Below this height above bare earth (m) the foot is not told from the ground.


class Fence(SurfaceKind):
    """Fences, from upright surfaces."""

    name = "fence"
    title = "Fencing"
    curve = "surfaces"
    code = classes.FENCE

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns on the surface, on its posts and on the wall at its foot."""
        near, above = beside(scene, rows, _BESIDE_M, _BESIDE_M), scene.above_ground_m
        return near[(above[near] > _FOOT_M) & (above[near] <= np.max(above[rows]) + _BESIDE_M)]


class Facade(SurfaceKind):
    """Façades, from upright surfaces, with their outline."""

    name = "facade"
    title = "Façade"
    curve = "surfaces"
    code = classes.BUILDING

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns on the surface, in its recesses and on its balconies."""
        return beside(scene, rows)

    def made(self, chain: Chain) -> AssetObject:
        """Returns the object of a chain: its outline, upright."""
        polygon = outline(chain)
        shown = np.isfinite(chain.values["high_m"])
        heights = (chain.values["high_m"] - chain.values["low_m"])[shown]
        way = chain.xy_m[-1] - chain.xy_m[0]
        normal = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-9)
        to_sensor = np.array(chain.sensor_xy_m) - chain.xy_m.mean(axis=0)
        normal = normal if float(normal @ to_sensor) > 0.0 else -normal
        values = {
            "asset_height_m": float(np.nanmax(chain.values["high_m"] - chain.values["ground_m"])),
            "length_m": chain.length_m,
            "area_m2": float(chain.values["length_m"][shown] @ heights),
            "facing_deg": math.degrees(math.atan2(float(normal[0]), float(normal[1]))) % 360.0,
        }
        return as_object(chain, shapely.Polygon(polygon), values)
