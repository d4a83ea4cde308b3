"""Classification of upright surfaces: façades, walls, barriers, guardrails and fences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.boundaries import judged
from roadscan.assets.upright.lines import PIECE_SCHEMA, Chain, chain_of_panel, chains_of, pieces_of_panels
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.probability import logistic

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Surface = Literal["facade", "wall", "barrier", "guardrail", "fence"]

_SIMPLE_M: Final = 0.03  # Tolerance of the simplified line (m).
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a surface (m).
_LEAST_FENCE_M: Final = 1.2
"""Least length of a fence, as of a gate for people (m) …"""
_LEAST_WALL_M, _LEAST_BARRIER_M, _LEAST_RAIL_M = 2.5, 3.0, 4.0
"""… of a wall, a barrier, and a guardrail (m): shorter ones are boxes and fronts of other things."""
_WALL_M, _LEAST_HIGH_M = 1.25, 0.25
"""Walls are higher than this, barriers lower; what is lower than the second is a kerb or the edge of a bed (m)."""
_FACADE_M: Final = 3.0
"""Fronts of houses are higher than this (m)."""
_MOST_OTHERS: Final = 0.5  # Façades have no larger share of returns on vegetation, vehicles and people.
_LOW_M: Final = 1.5
"""What is lower than this in line with the front of a house is no part of it, such as a hedge (m)."""
_LOW, _HIGH, _SOLID, _POROUS = range(4)
"""What stretches are: no boundary, low or high; a boundary that is solid, or that beams pass."""


@dataclass(frozen=True)
class Part:
    """Stretches of a chain that are of one kind."""

    kind: Surface
    first: int
    end: int
    """The stretch before which it ends."""
    probability: float


def parts_of(chain: Chain) -> list[Part]:
    """Returns the parts of an upright surface of which a kind is known.

    Each stretch is judged (:mod:`roadscan.assets.upright.boundaries`): a boundary that lets beams through is a fence;
    one that does not is a guardrail where it has free space below its rail, else a wall, or a barrier up to 1.25 m. The
    rest is a façade where it is solid and rises to 3 m or above what scanners saw. Hedges, vehicles, crowns and boards
    are none.
    """
    boundary, fence = judged(chain)
    top = _above(chain, "high_m")
    made = (boundary >= 0.5) & ~(top > _FACADE_M)
    low = (top <= _LOW_M) & (chain.values["open_top"] == 0.0)
    code = np.where(made, np.where(fence >= 0.5, _POROUS, _SOLID), np.where(low, _LOW, _HIGH))
    code = without_short(code, chain.values["length_m"])
    out = []
    for first, end in _runs(code):
        part = chain.between(first, end)
        kind = _told(part, int(code[first]))
        if kind is not None:
            sure = boundary[first:end] * np.where(kind == "fence", fence[first:end], 1.0 - fence[first:end])
            stated = (
                probability_of(part) if kind == "facade" else float(np.average(sure, weights=part.values["length_m"]))
            )
            out.append(Part(kind, first, end, stated))
    return out


def _told(part: Chain, code: int) -> Surface | None:
    """Returns the kind of stretches that are all high, solid or porous; None of low ones, and where it is none."""
    top, low, bulk, length = part.median("high_m"), part.median("low_m"), part.median("bulk_m"), part.length_m
    if code == _LOW or not np.isfinite(top):
        return None
    if code == _HIGH:
        is_high = top > _FACADE_M or (top > 1.4 and part.open_top > 0.4)
        solid = part.passing < 0.4 and part.vegetation + part.users <= _MOST_OTHERS and low <= 2.0
        return "facade" if is_high and solid and length >= 2.0 else None
    if top < _LEAST_HIGH_M:
        return None
    if code == _POROUS:
        return "fence" if length >= _LEAST_FENCE_M else None
    if bulk > 0.36 and 0.5 <= top <= 1.15 and top - bulk < 0.5:
        return "guardrail" if length >= _LEAST_RAIL_M else None
    if top > _WALL_M:
        return "wall" if length >= _LEAST_WALL_M else None
    return "barrier" if length >= _LEAST_BARRIER_M else None


def _above(chain: Chain, name: str) -> Float64:
    """Returns a height (k,) above the ground; NaN where none is known."""
    return np.asarray(chain.values[name] - chain.values["ground_m"])


def without_short(code: Int64, length_m: Float64, least_m: float = 1.2) -> Int64:
    """Returns kinds (k,) in which a run shorter than this between two of one kind has their kind."""
    out = code.copy()
    runs = _runs(code)
    for (_, before), (first, end), (after, _) in zip(runs[:-2], runs[1:-1], runs[2:], strict=True):
        if length_m[first:end].sum() < least_m and out[before - 1] == out[after]:
            out[first:end] = out[after]
    return out


def _runs(code: Int64) -> list[tuple[int, int]]:
    """Returns first and end of each run of equal values."""
    ends = [*(np.flatnonzero(np.diff(code)) + 1).tolist(), code.size]
    return list(itertools.pairwise([0, *ends])) if code.size else []


def probability_of(chain: Chain) -> float:
    """Returns the probability of a façade: a logistic function of its length, covered share, returns and thickness."""
    return logistic(
        -1.5,
        [(0.5, min(chain.length_m, 10.0)), (2.0, chain.covered), (0.02, min(chain.seen, 100)),
         (-50.0, max(chain.across_m - 0.04, 0.0))],
    )  # fmt: skip


@once_a_scene
def _rows_of_panels(scene: Scene) -> list[tuple[Surface, Int64]]:
    """Returns kind and returns of the parts of each panel that comes near the tile."""
    out = []
    for panel in panels_of(scene):
        if panel.comes_near(scene.tile):
            for part in parts_of(chain_of_panel(panel)):
                own = (panel.stretch >= part.first) & (panel.stretch < part.end)
                out.append((part.kind, panel.rows[own]))
    return out


@once_a_scene
def _pieces_of_all(scene: Scene) -> pa.Table:
    """Returns pieces of all panels inside the scene's tile."""
    return pieces_of_panels(scene, panels_of(scene))


class SurfaceKind(AssetKind):
    """A kind of upright surfaces: its evidence are the pieces of all of them, classified once they are joined."""

    code: ClassVar[int]
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Pieces of all upright surfaces in the tile; marked are the returns of those that look like this kind."""
        rows = [own for kind, own in _rows_of_panels(scene) if kind == self.name and own.size]
        marked = [Marked(self.marks(scene, own), self.code) for own in rows]
        return Evidence(_pieces_of_all(scene), tuple(marked))

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns that belong to a surface of these rows."""
        return rows

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each chain of this kind."""
        return [
            self.made(chain.between(part.first, part.end), part.probability)
            for chain in chains_of(pieces)
            for part in parts_of(chain)
            if part.kind == self.name
        ]

    def made(self, chain: Chain, probability: float) -> AssetObject:
        """Returns the object of a chain: its line along the ground."""
        ground = chain.values["ground_m"]
        height = np.concatenate([ground[:1], (ground[:-1] + ground[1:]) / 2, ground[-1:]])
        line = shapely.LineString(np.column_stack([chain.xy_m, height])).simplify(_SIMPLE_M)
        values = {"asset_height_m": chain.median("high_m"), "length_m": chain.length_m}
        return as_object(chain, line, values, probability, math.hypot(_GROUND_SIGMA_M, chain.sigma_median_m("high_m")))


def as_object(
    chain: Chain,
    geometry: shapely.Geometry,
    values: Mapping[str, Any],
    probability: float,
    sigma_size_m: float | None = None,
) -> AssetObject:
    """Returns an object of a chain."""
    sigma = max(0.005, chain.across_m / np.sqrt(max(chain.seen / max(chain.length_m, 1.0), 1.0)))
    passes = len(chain.passes)
    return AssetObject(
        geometry, float(sigma), _GROUND_SIGMA_M, probability, chain.seen, passes, *chain.epochs_gps_ns,
        values, sigma_size_m,
    )  # fmt: skip
