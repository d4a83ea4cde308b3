"""Features by which a plate is told from windows, doors of vans, boxes, bark and leaves."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.upright.brightness import brightness
from roadscan.assets.upright.outlines import Outline
from roadscan.assets.upright.plate_beams import Beams
from roadscan.assets.upright.regions import regions_of
from roadscan.compute.array_types import Float64, Int64

_THIN_M, _BEHIND_M = 0.06, 0.3
"""Returns between these distances from the plane (m) are close before or behind it."""
_BELOW_M: Final = 1.0
"""What carries a plate is looked at down to this far below it (m)."""
_AROUND_M: Final = 0.5
"""What surrounds a plate lies this far beyond its outline, at the most (m)."""
_VEHICLE_M: Final = 0.8
"""Returns of vehicles are counted within this distance, seen from above (m)."""
_WALL_M: Final = 2.0
"""Large surfaces farther off than this (m) do not matter."""
_LONG_M: Final = 2.5
"""Surfaces from this length (m) are large."""
_CELLS: Final = 5
"""Cells along each side of the outline, of which some are filled."""
_VEGETATION: Final = (classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION)


class PlaneOfPlate(NamedTuple):
    """A plate, and what lies near it."""

    rows: Int64
    """Returns on it."""
    near: Int64
    """Returns about it, seen from above."""
    middle: Float64
    normal: Float64
    right: Float64
    up: Float64

    def placed(self, scene: Scene, rows: Int64) -> tuple[Float64, Float64, Float64]:
        """Returns how far right and up of the middle some returns lie, and how far off the plane (k,; m)."""
        returns = scene.returns
        past = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]]) - self.middle
        return past @ self.right, past @ self.up, np.abs(past @ self.normal)


def features_of(
    scene: Scene, plane: PlaneOfPlate, outline: Outline, beams: Beams | None, residual_m: float, beside: float,
    above_m: float,
) -> dict[str, float]:  # fmt: skip
    """Returns the features of a plate by name; NaN where one is not known.

    beside : share of the returns on its plane that lie just outside of it. above_m : height of its middle above ground.
    """
    near = plane.near
    u, v, away = plane.placed(scene, near)
    wide, tall = outline.width_m / 2, outline.height_m / 2
    inside = (np.abs(u) < wide) & (np.abs(v) < tall)
    column = (np.abs(u) < wide + 0.1) & (away < 0.25)
    below = column & (v < -tall - 0.05) & (v > -tall - _BELOW_M)
    on_top = column & (v > tall + 0.05) & (v < tall + _AROUND_M)
    about = (np.abs(u) < wide + _AROUND_M) & (np.abs(v) < tall + _AROUND_M) & (away < _AROUND_M)
    around = about & ~inside & ~below
    number = max(plane.rows.size, 1)
    light = brightness(scene)[plane.rows]
    green = np.isin(scene.classes[near[around]], _VEGETATION)
    return {
        "returns": math.log(number), "range_m": float(np.median(scene.returns.ranges_m(plane.rows))),
        "bright_median": float(np.median(light)), "bright_high": float(np.quantile(light, 0.9)),
        "residual_m": residual_m, "beside": beside,
        "behind": float((inside & (away > _THIN_M) & (away < _BEHIND_M)).sum()) / number,
        "around": float(around.sum()) / number, "on_top": float(on_top.sum()) / number,
        "below": float(below.sum()) / number,
        "below_wide": float(np.std(u[below])) / outline.width_m if below.sum() >= 5 else math.nan,
        "green": float(green.mean()) if green.size >= 5 else math.nan,
        "above_m": above_m, "width_m": outline.width_m, "height_m": outline.height_m,
        "ratio": math.log(outline.height_m / outline.width_m),
        "misfit": outline.misfit_m / min(outline.width_m, outline.height_m), "tilt": abs(float(plane.normal[2])),
        "filled": _filled(u, v, inside & (away < _THIN_M), wide, tall),
        "passed": _passed(beams, outline), "vehicle": _vehicles(scene, plane.middle) / number,
        "wall_m": _to_wall(scene, plane),
    }  # fmt: skip


def _filled(u: Float64, v: Float64, on: npt.NDArray[np.bool_], wide: float, tall: float) -> float:
    """Returns the share of the cells of the outline with returns; NaN of fewer returns than cells."""
    if on.sum() < _CELLS**2:
        return math.nan
    column = np.floor((u[on] / wide + 1.0) / 2.0 * _CELLS).astype(np.int64)
    row = np.floor((v[on] / tall + 1.0) / 2.0 * _CELLS).astype(np.int64)
    return float(np.unique(row * _CELLS + column).size) / _CELLS**2


def _passed(beams: Beams | None, outline: Outline) -> float:
    """Returns the share of the beams well within the outline that passed; NaN where beams are not known."""
    if beams is None:
        return math.nan
    half = 0.35 * np.array([outline.width_m, outline.height_m])
    through, stopped = (
        float((np.abs(b - outline.middle) < half).all(axis=1).sum()) for b in (beams.passed, beams.hits)
    )
    return through / max(through + stopped, 1.0)


def _vehicles(scene: Scene, middle: Float64) -> float:
    """Returns the number of returns of vehicles beside a place."""
    tree = _tree_of_vehicles(scene)
    return 0.0 if tree is None else float(tree.query_ball_point(middle[:2], _VEHICLE_M, return_length=True))


@once_a_scene
def _tree_of_vehicles(scene: Scene) -> cKDTree | None:
    rows = np.flatnonzero(scene.classes == classes.VEHICLE)
    return cKDTree(np.column_stack([scene.returns.x_m[rows], scene.returns.y_m[rows]])) if rows.size else None


def _to_wall(scene: Scene, plane: PlaneOfPlate) -> float:
    """Returns the distance from a plate to the nearest large surface that it is not itself (m), at most 2."""
    least = _WALL_M
    for region in regions_of(scene):
        if region.length_m > _LONG_M:
            away = region.distance_m(float(plane.middle[0]), float(plane.middle[1]), 0.3)
            if away < least and np.isin(plane.rows, region.rows).mean() < 0.5:
                least = away
    return least
