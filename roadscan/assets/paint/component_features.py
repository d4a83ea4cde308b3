"""What a component of bright cells looks like, in figures that depend on no scanner: the features of a judge of paint.

Bright patches, covers, faces of kerbs, slabs and gravel are bright, too. Noise, density, scan lines, drives and edges
tell streets apart, not paint; without them it judges unseen ones better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.classes import ROAD
from roadscan.assets.paint.components import Component
from roadscan.assets.paint.contrast import CELL_M, Contrast
from roadscan.assets.paint.crosswalks import Bar
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64

PIECE_M: Final = 7.0
"""Shape and flatness of longer components (m) are those of their pieces: a line bends with its road."""
_ALIKE: Final = 2.5
"""Components whose areas differ by less than this factor are alike: dashes, bars, arrows come in rows …"""
_ROW_M: Final = 8.0  # … in which they follow within this distance (m).
_BRIGHT: Final = 0.3  # A return of this contrast is bright.


def component_features(scene: Scene, found: Contrast, components: Sequence[Component]) -> dict[str, Float64]:
    """Returns features (n,) by name of some components of a scene; NaN where one is not known."""
    rows = [_of_component(scene, found, one) for one in components]
    out = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    middle = np.array([[one.cell_x_m.mean(), one.cell_y_m.mean()] for one in components])
    return out | {"alike": _alike(middle, out["area_m2"])}


def _of_component(scene: Scene, found: Contrast, one: Component) -> dict[str, float]:
    inside, around = one.near[one.inside], one.near[~one.inside]
    bar = Bar.of_cells(one.cell_x_m, one.cell_y_m)
    pieces, weight = _pieces(found, one, bar)
    rows = [_of_piece(found, piece) for piece in pieces]
    local = {name: float(np.average([row[name] for row in rows], weights=weight)) for name in rows[0]}
    contrast, beside = found.contrast[inside], found.contrast[around]
    unknown = dict.fromkeys(("beside", "beside_spread", "road_beside"), np.nan)
    return {
        "contrast": float(contrast.mean()), "bright": float(np.mean(contrast > _BRIGHT)),
        "least": float(np.percentile(contrast, 20)), "evidence": one.evidence_sigma,
        **local, "length_m": bar.length_m, "slim": bar.length_m / local["width_m"],
        "road": _share_of_road(scene, found, inside),
        **(unknown if not around.size else {
            "beside": float(beside.mean()), "beside_spread": float(np.std(beside)),
            "road_beside": _share_of_road(scene, found, around),
        }),
    }  # fmt: skip


def _pieces(found: Contrast, one: Component, bar: Bar) -> tuple[list[Component], list[int]]:
    """Returns a component cut across its axis into equal pieces, and the number of the returns of each."""
    count = math.ceil(bar.length_m / PIECE_M)
    if count == 1:
        return [one], [1]
    along = np.cos(bar.angle_rad), np.sin(bar.angle_rad)
    of_cells, of_returns = (
        np.clip(((x - bar.x_m) * along[0] + (y - bar.y_m) * along[1]) / bar.length_m * count + count / 2, 0, count - 1)
        .astype(np.int64)
        for x, y in ((one.cell_x_m, one.cell_y_m), (found.x_m[one.near], found.y_m[one.near]))
    )  # fmt: skip
    parts = [one.part(of_cells == k, of_returns == k) for k in range(count)]
    held = [part for part in parts if part.inside.any()]
    return held, [int(np.count_nonzero(part.inside)) for part in held]


def _of_piece(found: Contrast, piece: Component) -> dict[str, float]:
    """Returns what is told of places that lie together: their shape, and the ground under and around them."""
    bar = Bar.of_cells(piece.cell_x_m, piece.cell_y_m)
    height = found.height_m[piece.near] - found.height_m[piece.near].mean()
    x, y = found.x_m[piece.near] - bar.x_m, found.y_m[piece.near] - bar.y_m
    plane = np.column_stack([x, y, np.ones(x.size)])
    rest = height - plane @ np.linalg.lstsq(plane, height, rcond=None)[0]
    return {
        "area_m2": piece.cell.size * CELL_M**2, "width_m": bar.width_m, "filled": bar.filled,
        "scatter_m": float(np.std(rest)), "above_m": float(rest[piece.inside].mean()),
        "tilt": float(np.ptp(height)) / max(bar.length_m, 0.2),
    }  # fmt: skip


def _share_of_road(scene: Scene, found: Contrast, own: npt.NDArray[np.int64]) -> float:
    return float(np.mean(scene.classes[found.rows[own]] == ROAD))


def _alike(middle: Float64, area: Float64) -> Float64:
    """Returns how many others of a like size lie within a row's distance (n,)."""
    from scipy.spatial import cKDTree

    near = cKDTree(middle).query_ball_point(middle, _ROW_M)
    return np.array([sum(1 / _ALIKE < area[j] / area[i] < _ALIKE for j in some) - 1 for i, some in enumerate(near)],
                    np.float64)  # fmt: skip
