"""Classification of upright surfaces: façades, walls, barriers, guardrails and fences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final, Literal

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.lines import PIECE_SCHEMA, Chain, chains_of, pieces_of_panels
from roadscan.assets.upright.panels import panels_of
from roadscan.assets.upright.probability import logistic

Surface = Literal["facade", "wall", "barrier", "guardrail", "fence"]

_SIMPLE_M: Final = 0.03  # Tolerance of the simplified line (m).
_GROUND_SIGMA_M: Final = 0.03  # 1 σ of the height of the ground at a surface (m).
_POROUS: Final = 0.5
"""A surface is a fence where more than this share of its length lets sight lines through."""
_HOVERS: Final = 0.05
"""A surface that begins high above the ground hovers where this share of the sight lines passes below it; elsewhere
something stands before its foot."""
_LEAST_FENCE_M: Final = 2.5  # Least length of a fence or a wall (m).
_MOST_VEGETATION: Final = 0.5  # Surfaces with a larger share of vegetation are none.


def told(chain: Chain) -> Surface | None:
    """Returns the kind of an upright surface; None where it is none of these.

    A façade is solid and rises to 3 m or above what scanners saw; a wall ends lower, a barrier at 1.25 m at the most; a
    guardrail has free space below its rail; a fence lets sight lines through all along. What begins 2 m above the
    ground or higher (crowns, boards, roofs), and hedges, are none.
    """
    top, low, bulk = chain.median("high_m"), chain.median("low_m"), chain.median("bulk_m")
    if not np.isfinite(top) or chain.vegetation > _MOST_VEGETATION or low > 2.0 or chain.length_m < 1.5:
        return None
    if top > 3.0 or (top > 1.4 and chain.open_top > 0.4):
        return "facade" if chain.passing < 0.4 and chain.length_m >= 2.0 else None
    if low > 0.6 and (low > 1.2 or (chain.hovering > _HOVERS and chain.porous < _POROUS)):
        return None
    if bulk > 0.36 and 0.5 <= top <= 1.15 and top - bulk < 0.5:
        return "guardrail" if chain.length_m >= 4.0 else None
    if chain.porous >= _POROUS:
        return "fence" if top >= 0.6 and chain.length_m >= _LEAST_FENCE_M else None
    if top > 1.25:
        return "wall" if chain.length_m >= _LEAST_FENCE_M else None
    return "barrier" if top >= 0.5 and chain.length_m >= 3.0 else None


def probability_of(chain: Chain) -> float:
    """Returns the probability of a surface: a logistic function of its length, covered share, returns and thickness."""
    return logistic(
        -1.5,
        [(0.5, min(chain.length_m, 10.0)), (2.0, chain.covered), (0.02, min(chain.seen, 100)),
         (-50.0, max(chain.across_m - 0.04, 0.0))],
    )  # fmt: skip


@once_a_scene
def _names_of_panels(scene: Scene) -> list[set[Surface | None]]:
    """Returns the likely kinds of the chains of each panel; none where it does not come near the tile."""
    whole = replace(scene, tile=scene.window)
    return [
        {told(c) for c in chains_of(pieces_of_panels(whole, [panel]))} if panel.comes_near(scene.tile) else set()
        for panel in panels_of(scene)
    ]


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
        marked = [
            Marked(self.marks(scene, panel.rows), self.code)
            for panel, names in zip(panels_of(scene), _names_of_panels(scene), strict=True)
            if self.name in names
        ]
        return Evidence(_pieces_of_all(scene), tuple(marked))

    def marks(self, scene: Scene, rows: Any) -> Any:
        """Returns the returns that belong to a surface of these rows."""
        return rows

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns an object for each chain of this kind."""
        return [self.made(chain) for chain in chains_of(pieces) if told(chain) == self.name]

    def made(self, chain: Chain) -> AssetObject:
        """Returns the object of a chain: its line along the ground."""
        ground = chain.values["ground_m"]
        height = np.concatenate([ground[:1], (ground[:-1] + ground[1:]) / 2, ground[-1:]])
        line = shapely.LineString(np.column_stack([chain.xy_m, height])).simplify(_SIMPLE_M)
        values = {"asset_height_m": chain.median("high_m"), "length_m": chain.length_m}
        return as_object(chain, line, values, math.hypot(_GROUND_SIGMA_M, chain.sigma_median_m("high_m")))


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
