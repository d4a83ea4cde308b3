"""Detection of all paint of a scene: lines along the road, and everything else, with the returns that show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import shapely

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.memory import once_a_scene
from roadscan.assets.paint.component_features import component_features
from roadscan.assets.paint.components import Component, components_of
from roadscan.assets.paint.contrast import CELL_M, Contrast, contrast_of
from roadscan.assets.paint.crosswalks import Bar, crosswalk_bars, is_round
from roadscan.assets.paint.road_direction import RoadDirection
from roadscan.assets.paint.stripes import AROUND_M, Stripe, stripes_of
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Int64

PAINT: Final = Judge("paint", "07f605e84c1e9659")
"""Whether a component is paint."""
LEAST: Final = 0.5  # Less probable components are left out.
ACROSS_DEG: Final = 55.0
"""Bands at this angle to the road or more (degrees) lie across it."""
WIDEST_LINE_M: Final = 0.42  # Widest line (m).
_STOP_BAR_M: Final = (0.15, 1.0)
"""Narrowest band across the road that is a bar, and shortest (m)."""
_LEAST_AREA_M2: Final = 0.03  # Least area of a patch (m²).
_INSIDE_LOGIT, _BESIDE_LOGIT = 1.5, 0.0  # Log odds of paint inside an outline, and beside it.
_OWN_LOGIT, _NEAR_LOGIT = 2.5, 1.0  # Bounds of the log odds of a return's contrast, and of the mean around it.
_SPREAD: Final = 0.25
"""1 σ of the contrast of fresh paint from place to place, as a share of its mean."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Paint that is no line."""

    shape: shapely.Geometry
    """Polygon, from the corner of the scene's returns."""
    is_bar: bool
    """True for a straight band, false for cells."""
    in_crosswalk: bool
    road_rad: float
    """Direction of the road there, anticlockwise from x; NaN where no drive is near."""
    contrast: float
    probability: float
    returns: Int64
    """Indices of the contrast's returns within it."""
    around: Int64
    """Indices of the returns beside it."""


@dataclass(frozen=True, eq=False)
class Paint:
    """All paint in the window of a scene."""

    contrast: Contrast
    lines: tuple[Stripe, ...]
    patches: tuple[Patch, ...]


@once_a_scene
def paint_of(scene: Scene) -> Paint:
    """Returns the paint of a scene."""
    found = contrast_of(scene)
    road = RoadDirection(scene)
    bands: list[Stripe] = []
    others: list[Component] = []
    for component in judged(scene, found, components_of(found)):
        stripes = stripes_of(found, component, scene.returns.corner_m, road)
        if stripes is None:
            others.append(component)
        else:
            bands += stripes
    bars = [Bar.of_stripe(s) for s in bands] + [Bar.of_cells(c.cell_x_m, c.cell_y_m) for c in others]
    in_crosswalk = crosswalk_bars(bars)
    lines, patches = [], []
    for stripe, crossed in zip(bands, in_crosswalk[: len(bands)], strict=True):
        direction = road.at(*stripe.middle_m)
        if crossed or stripe.width_m > WIDEST_LINE_M or _lies_across(stripe, direction):
            patches.append(_of_stripe(stripe, bool(crossed), direction))
        else:
            lines.append(stripe)
    rest = zip(others, bars[len(bands) :], in_crosswalk[len(bands) :], strict=True)
    for component, bar, crossed in rest:
        if component.cell.size * CELL_M**2 >= _LEAST_AREA_M2 and not is_round(bar):
            direction = road.at(float(component.cell_x_m.mean()), float(component.cell_y_m.mean()))
            patches.append(_of_cells(found, component, bool(crossed), direction))
    return Paint(found, tuple(lines), tuple(patches))


def judged(scene: Scene, found: Contrast, components: Sequence[Component]) -> list[Component]:
    """Returns the components that are probably paint, with their probability."""
    if not components:
        return []
    stated = PAINT.probability(component_features(scene, found, components))
    return [replace(one, probability=float(p)) for one, p in zip(components, stated, strict=True) if p >= LEAST]


def rows_of_paint(found: Contrast, shapes: Sequence[Stripe | Patch]) -> Int64:
    """Returns rows of the scene's returns that are paint of some shapes, ascending."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(_painted_rows(found, one) for one in shapes)]))


def _painted_rows(found: Contrast, shape: Stripe | Patch) -> Int64:
    """Rows of a shape's returns that are paint, by its outline, their contrast and that of the returns near them.

    Logarithms of odds add up: of the outline (worn paint has holes, edges are ragged), of the return's own contrast,
    and of the mean contrast around it, each held between bounds.
    """
    at = np.concatenate([shape.returns, shape.around])
    odds = np.where(np.arange(at.size) < shape.returns.size, _INSIDE_LOGIT, _BESIDE_LOGIT)
    level = shape.contrast
    for value, sigma, most in (
        (found.contrast[at], found.noise[at], _OWN_LOGIT),
        (found.mean.ravel()[found.cell[at]], found.sigma.ravel()[found.cell[at]], _NEAR_LOGIT),
    ):
        spread = np.hypot(sigma, _SPREAD * level)
        odds = odds + np.clip(level * (value - level / 2) / spread**2, -most, most)
    return np.asarray(found.rows[at[odds > 0.0]])


def _lies_across(stripe: Stripe, road_rad: float) -> bool:
    if not np.isfinite(road_rad) or stripe.width_m < _STOP_BAR_M[0] or stripe.length_m < _STOP_BAR_M[1]:
        return False
    turned = np.arctan2(stripe.along[1], stripe.along[0]) - road_rad
    return bool(abs(np.sin(turned)) >= np.sin(np.radians(ACROSS_DEG)))


def _of_stripe(stripe: Stripe, crossed: bool, road_rad: float) -> Patch:
    aside = stripe.width_m / 2 * np.array([-stripe.along[1], stripe.along[0]])
    begin, end = stripe.at(stripe.begin_m), stripe.at(stripe.end_m)
    shape = shapely.Polygon([begin - aside, end - aside, end + aside, begin + aside])
    return Patch(shape, True, crossed, road_rad, stripe.contrast, stripe.probability, stripe.returns, stripe.around)


def _of_cells(found: Contrast, component: Component, crossed: bool, road_rad: float) -> Patch:
    from scipy.spatial import cKDTree

    half = CELL_M / 2
    x, y = component.cell_x_m, component.cell_y_m
    shape = shapely.union_all(shapely.box(x - half, y - half, x + half, y + half))
    inside, outside = component.near[component.inside], component.near[~component.inside]
    away, _ = cKDTree(np.stack([x, y], axis=1)).query(
        np.stack([found.x_m[outside], found.y_m[outside]], axis=1), distance_upper_bound=AROUND_M
    )
    level = float(np.mean(found.contrast[inside])) if inside.size else 0.0
    return Patch(shape, False, crossed, road_rad, level, component.probability, inside, outside[np.isfinite(away)])
