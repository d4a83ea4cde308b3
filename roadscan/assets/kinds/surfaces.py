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

Surface = Literal["facade", "wall", "barrier", "guardrail", "fence"]

_SIMPLE_M: Final = 0.03  # Tolerance of the simplified line (m).
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a surface (m).
_POROUS: Final = 0.5
"""A surface is a fence where more than this share of its length lets sight lines through."""
_HOVERS: Final = 0.05
"""A surface that begins high above the ground hovers where this share of the sight lines passes below it; elsewhere
something stands before its foot."""
_LEAST_FENCE_M, _LEAST_WALL_M = 1.5, 2.5  # Least length of a fence, such as a gate, and of a wall (m).
_LEAST_PASSING: Final = 0.08  # The uneven top of a wall lets fewer of the sight lines pass than any fence.
_RAIL_PASSING: Final = 0.5  # What lets more of the sight lines pass is no rail, but a low fence.
_MOST_PASSING: Final = 0.8  # What lets more of the sight lines pass is no surface: parts of a room, seen through panes.
_FACADE_M: Final = 3.0  # What is higher is a façade (m), …
_OPEN_M: Final = 1.4  # … as is what is higher than this (m) and rises beyond what scanners saw.
_GARDEN_M: Final = 1.6  # What is lower than this (m) is no part of a façade.
_LEAST_TOP_M: Final = 0.5  # Lower surfaces (m) are of no kind.
_CHANGE_M: Final = 1.5  # A change of sort along a surface counts as so many metres of another sort.
_MOST_VEGETATION: Final = 0.5  # Surfaces with a larger share of vegetation are hedges, …
_THIN_M: Final = 0.035  # … unless they scatter less across their plane (m) …
_MORE_THAN_LEAVES, _SURE = 0.4, 2.0
"""… or let a larger share of the sight lines pass, by two standard deviations of their number. On sweeps 0–3 of the
labelled street hedges scatter by 43 to 55 mm, and let 24 % pass at the most."""


def told(chain: Chain) -> Surface | None:
    """Returns the kind of an upright surface; None where it is none of these.

    A façade is solid and rises to 3 m or above what scanners saw; a wall ends lower, a barrier at 1.25 m at the most; a
    guardrail has free space below its rail; a fence lets sight lines through all along. What begins 2 m above the
    ground or higher (crowns, boards, roofs), and hedges, are none.
    """
    top, low, bulk = chain.median("high_m"), chain.median("low_m"), chain.median("bulk_m")
    if not np.isfinite(top) or low > 2.0 or chain.length_m < 1.5:
        return None
    is_leafy = chain.vegetation > _MOST_VEGETATION and chain.across_m > _THIN_M
    if is_leafy and not chain.lets_more_through(_MORE_THAN_LEAVES, _SURE):
        return None
    if top > _FACADE_M or (top > _OPEN_M and chain.open_top > 0.4):
        return "facade" if chain.passing < 0.4 and chain.length_m >= 2.0 else None
    if low > 0.6 and (low > 1.2 or chain.free_below or (chain.hovering > _HOVERS and chain.porous < _POROUS)):
        return None
    is_rail = bulk > 0.36 and 0.5 <= top <= 1.15 and top - bulk < 0.5 and chain.passing < _RAIL_PASSING
    if is_rail and chain.length_m >= 4.0:
        return "guardrail"
    if chain.porous >= _POROUS and chain.passing >= _LEAST_PASSING and chain.openings >= _POROUS:
        is_fence = top >= 0.6 and chain.length_m >= _LEAST_FENCE_M and chain.passing <= _MOST_PASSING
        return "fence" if is_fence else None
    if chain.median("top_m") > 1.25:
        return "wall" if chain.length_m >= _LEAST_WALL_M else None
    return "barrier" if top >= _LEAST_TOP_M and chain.length_m >= 3.0 else None


def parts_of(chain: Chain) -> list[tuple[Surface | None, int, int]]:
    """Returns the kinds of the parts of an upright surface, each with its first stretch and the one after its last.

    A house, its gate and its garden wall may stand in one line. So stretches are judged each by itself: high ones,
    solid ones, ones that let sight lines through, and ones too low for any kind. The sorts along the surface are those
    that the fewest metres contradict, where each change counts as 1.5 m. Guard rails, whose posts and gaps differ, are
    judged as a whole.
    """
    count = chain.values["returns"].size
    if told(chain) == "guardrail":
        return [("guardrail", 0, count)]
    sort = _sorts(chain)
    edges = np.flatnonzero(np.concatenate([[True], np.diff(sort) != 0, [True]])).tolist()
    out: list[tuple[Surface | None, int, int]] = []
    for first, last in itertools.pairwise(edges):
        name = told(chain.part(first, last))
        begin = out.pop()[1] if out and out[-1][0] == name else first
        out.append((name, begin, last))
    return out


def _sorts(chain: Chain) -> npt.NDArray[np.int64]:
    """Returns the sort of each stretch (k,): the cheapest way through their costs (Viterbi 1967)."""
    top = chain.values["high_m"] - chain.values["ground_m"]
    known = np.isfinite(top)
    high = known & ((top > _FACADE_M) | ((top > _OPEN_M) & (chain.values["open_top"] > 0.5)))
    low, least = known & (top <= _GARDEN_M), known & (top < _LEAST_TOP_M)
    told_of, through = chain.lets_through()
    wrong = np.stack([low, high | least | (told_of & through), high | least | (told_of & ~through), known & ~least])
    costs = (wrong * chain.values["length_m"]).T
    change = _CHANGE_M * (1.0 - np.eye(len(wrong)))
    best, back = costs[0], np.zeros((len(costs), len(wrong)), np.int64)
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
