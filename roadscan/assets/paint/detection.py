"""Detection of all paint of a scene: lines along the road with their pieces, crosswalks, and everything else.

A judge tells paint by what a component of bright cells looks like, in figures that depend on no scanner. Bright
patches, covers, faces of kerbs, slabs and gravel are bright, too. Noise, density, scan lines, drives and edges tell
streets apart, not paint; without them it judges unseen ones better.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.classes import ROAD
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.paint.components import CELL_M, Component, Contrast, components_of, contrast_of
from roadscan.assets.paint.stripes import AROUND_M, RoadDirection, Stripe, stripes_of
from roadscan.assets.paint.symbols import UNKNOWN, symbol_of, turned
from roadscan.assets.scene import Box, Scene, once_a_scene
from roadscan.compute.array_types import Bool, Float64, Int64

_WIDTH_M: Final = (0.25, 1.0)  # Width of a bar (m).
_LENGTH_M: Final = (1.2, 9.0)  # Length of a bar (m).
_PARALLEL_DEG: Final = 12.0  # Greatest angle between two bars (degrees).
_SPACING: Final = (1.3, 3.6)
"""Spacing of bars from middle to middle, in widths of a bar."""
_OVERLAP: Final = 0.5  # Least common length of two bars (share of the longer).
_FEWEST: Final = 3  # Least number of bars.
_COVER_M: Final = (0.4, 1.0)  # Diameter of a manhole cover (m).
_ROUND: Final = 0.1  # Tolerance of a disc's share of its rectangle.
_FILLED: Final = 0.7
"""Least share of its rectangle that a bar covers."""


class Bar(NamedTuple):
    """A rectangle of paint."""

    x_m: float
    y_m: float
    angle_rad: float
    length_m: float
    width_m: float
    filled: float

    @classmethod
    def of_stripe(cls, stripe: Stripe) -> Self:
        """Returns the rectangle of a band."""
        x, y = stripe.at((stripe.begin_m + stripe.end_m) / 2)
        return cls(x, y, float(np.arctan2(stripe.along[1], stripe.along[0])), stripe.length_m, stripe.width_m, 1.0)

    @classmethod
    def of_cells(cls, x_m: Float64, y_m: Float64) -> Self:
        """Returns the rectangle along the main axis of cells."""
        dx, dy = x_m - x_m.mean(), y_m - y_m.mean()
        angle = 0.5 * float(np.arctan2(2 * float(dx @ dy), float(dx @ dx - dy @ dy)))
        s, o = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        length, width = float(np.ptp(s)) + CELL_M, float(np.ptp(o)) + CELL_M
        ms, mo = float(s.max() + s.min()) / 2, float(o.max() + o.min()) / 2
        x = float(x_m.mean()) + ms * np.cos(angle) - mo * np.sin(angle)
        y = float(y_m.mean()) + ms * np.sin(angle) + mo * np.cos(angle)
        return cls(float(x), float(y), angle, length, width, x_m.size * CELL_M**2 / (length * width))


def is_round(bar: Bar) -> bool:
    """Returns True for a shape as long as wide without corners: the cover of a manhole."""
    return bool(
        _COVER_M[0] <= bar.width_m <= bar.length_m <= min(_COVER_M[1], 1.2 * bar.width_m + CELL_M)
        and abs(bar.filled - np.pi / 4) <= _ROUND
    )


def crosswalk_bars(bars: Sequence[Bar]) -> Bool:
    """Returns a mask (n,) of the bars that stand in a row of three or more alike."""
    out = np.zeros(len(bars), np.bool_)
    fit = [
        i
        for i, b in enumerate(bars)
        if _WIDTH_M[0] <= b.width_m <= _WIDTH_M[1]
        and _LENGTH_M[0] <= b.length_m <= _LENGTH_M[1]
        and b.filled >= _FILLED
        and b.length_m >= 1.5 * b.width_m
    ]
    group = {i: i for i in fit}

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for place, i in enumerate(fit):
        for j in fit[place + 1 :]:
            if _side_by_side(bars[i], bars[j]):
                a, b = root(i), root(j)
                group[max(a, b)] = min(a, b)
    roots = [root(i) for i in fit]
    for i, own in zip(fit, roots, strict=True):
        out[i] = roots.count(own) >= _FEWEST
    return out


def _side_by_side(one: Bar, other: Bar) -> bool:
    if abs(np.sin(one.angle_rad - other.angle_rad)) > np.sin(np.radians(_PARALLEL_DEG)):
        return False
    dx, dy = other.x_m - one.x_m, other.y_m - one.y_m
    along = abs(dx * np.cos(one.angle_rad) + dy * np.sin(one.angle_rad))
    across = abs(dy * np.cos(one.angle_rad) - dx * np.sin(one.angle_rad))
    width = (one.width_m + other.width_m) / 2
    common = (one.length_m + other.length_m) / 2 - along
    return bool(
        _SPACING[0] * width <= across <= _SPACING[1] * width and common >= _OVERLAP * max(one.length_m, other.length_m)
    )


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


PAINT: Final = Judge("paint", "07f605e84c1e9659")
"""Whether a component is paint."""
LEAST: Final = 0.5  # Less probable components are left out.
ACROSS_DEG: Final = 55.0
"""Bands at this angle to the road or more (degrees) lie across it."""
WIDEST_LINE_M: Final = 0.42  # Widest line (m).
_STOP_BAR_M: Final = (0.15, 1.0)
"""Narrowest band across the road that is a bar, and shortest (m)."""
_LEAST_AREA_M2: Final = 0.03  # Least area of a patch (m²).
SYMBOL_M: Final = 6.0
"""Larger paint (m) that is no line is an area."""
_SYMBOL_ACROSS_M: Final = 0.45
"""Least extent of a symbol across the road (m): worn lines of 0.3 m, the widest but for bars, are told as narrower."""
_INSIDE_LOGIT, _BESIDE_LOGIT = 1.5, 0.0  # Log odds of paint inside an outline, and beside it.
_OWN_LOGIT, _NEAR_LOGIT = 2.5, 1.0  # Bounds of the log odds of a return's contrast, and of the mean around it.
_SPREAD: Final = 0.25
"""1 σ of the contrast of fresh paint from place to place, as a share of its mean."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Paint that is no line."""

    shape: shapely.Geometry
    """Polygon, from the corner of the scene's returns."""
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
    shapes = judged(scene, found, components_of(found))
    return sorted_paint(found, shapes, scene.returns.corner_m, RoadDirection.of(scene))


def sorted_paint(
    found: Contrast, shapes: Sequence[Component], corner_m: tuple[float, float], road: RoadDirection
) -> Paint:
    """Returns components that are paint, as lines along the road and as all else.

    corner_m : the map's place of the components' origin.
    """
    bands: list[Stripe] = []
    others: list[Component] = []
    for component in shapes:
        stripes = None
        if not _is_symbol(component, road):
            stripes = stripes_of(found, component, corner_m, road)
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


def _is_symbol(one: Component, road: RoadDirection) -> bool:
    """Returns whether a component shows a symbol: the shaft of an arrow and the sides of a triangle are bands, too."""
    x, y = one.cell_x_m - one.cell_x_m.mean(), one.cell_y_m - one.cell_y_m.mean()
    if max(np.ptp(x), np.ptp(y)) > SYMBOL_M or one.cell.size * CELL_M**2 < _LEAST_AREA_M2:
        return False
    direction = road.at(float(one.cell_x_m.mean()), float(one.cell_y_m.mean()))
    if not math.isfinite(direction):
        return False
    if np.ptp(y * math.cos(direction) - x * math.sin(direction)) < _SYMBOL_ACROSS_M:
        return False
    return symbol_of(turned(_shape_of(one), direction)) != UNKNOWN


def _shape_of(one: Component) -> shapely.Geometry:
    """Returns the outline of a component's cells."""
    x, y, half = one.cell_x_m, one.cell_y_m, CELL_M / 2
    return shapely.union_all(shapely.box(x - half, y - half, x + half, y + half))


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
    return Patch(stripe.outline, crossed, road_rad, stripe.contrast, stripe.probability, stripe.returns, stripe.around)


def _of_cells(found: Contrast, component: Component, crossed: bool, road_rad: float) -> Patch:
    from scipy.spatial import cKDTree

    x, y, shape = component.cell_x_m, component.cell_y_m, _shape_of(component)
    inside, outside = component.near[component.inside], component.near[~component.inside]
    away, _ = cKDTree(np.stack([x, y], axis=1)).query(
        np.stack([found.x_m[outside], found.y_m[outside]], axis=1), distance_upper_bound=AROUND_M
    )
    level = float(np.mean(found.contrast[inside])) if inside.size else 0.0
    return Patch(shape, crossed, road_rad, level, component.probability, inside, outside[np.isfinite(away)])


LINE_PIECES: Final = pa.schema(
    [
        *(pa.field(f"{end}_{axis}_m", pa.float64()) for end in ("begin", "end") for axis in ("x", "y", "height")),
        pa.field("begin_seen", pa.bool_()),
        pa.field("end_seen", pa.bool_()),
        pa.field("width_m", pa.float64()),
        pa.field("contrast", pa.float64()),
        pa.field("sigma_across_m", pa.float64()),
        pa.field("sigma_height_m", pa.float64()),
        pa.field("probability", pa.float64()),
        pa.field("returns", pa.int64()),
        pa.field("passes", pa.list_(pa.uint16())),
        pa.field("first_epoch_gps_ns", pa.int64()),
        pa.field("last_epoch_gps_ns", pa.int64()),
    ]
)
"""A straight piece of a line: its ends in the map, and whether bare ground was seen beyond them."""

_SHORTEST_M: Final = 0.01  # Shorter pieces are left out (m).


_PART: Final = 0.7
"""What lies by this share in a shape is a part of it …"""
_ROUND_M: Final = 0.1  # … which may be so much larger on all sides (m).


def line_outlines(rows: Iterable[Mapping[str, Any]]) -> list[shapely.Geometry]:
    """Returns the outlines of pieces of lines, as rows of `LINE_PIECES`."""
    return [
        shapely.LineString([(r["begin_x_m"], r["begin_y_m"]), (r["end_x_m"], r["end_y_m"])])
        .buffer(r["width_m"] / 2, cap_style="flat")
        for r in rows
    ]  # fmt: skip


def covers(shapes: Sequence[shapely.Geometry], part: shapely.Geometry) -> bool:
    """Returns whether shapes cover most of a smaller one."""
    whole = shapely.union_all(shapes).buffer(_ROUND_M)
    return bool(shapely.intersection(whole, part).area >= _PART * part.area)


def shown_pieces(shown: pa.Table, name: str, schema: pa.Schema) -> pa.Table:
    """Returns the pieces in a column of structures of `roadscan.assets.tasks.pictured_paint.PAINTED`."""
    return pa.Table.from_pylist([row for row in shown[name].to_pylist() if row is not None], schema=schema)


def line_pieces(scene: Scene, paint: Paint) -> pa.Table:
    """Returns pieces of lines within the scene's tile, in the order of the paint's lines."""
    rows = [piece for stripe in paint.lines if (piece := _piece(scene, paint, stripe)) is not None]
    return pa.Table.from_pylist(rows, schema=LINE_PIECES)


def _piece(scene: Scene, paint: Paint, stripe: Stripe) -> dict[str, object] | None:
    """Returns the part of a stripe in the tile."""
    span = within(stripe, scene.tile)
    if span is None:
        return None
    begin, end = stripe.at(span[0]), stripe.at(span[1])
    found, returns = paint.contrast, scene.returns
    along, _ = stripe.coordinates(found.x_m[stripe.returns], found.y_m[stripe.returns])
    own = stripe.returns[(along >= span[0]) & (along <= span[1])]
    seen = returns.at(found.rows[own if own.size else stripe.returns])
    heights = scene.ground.height_at([begin[0], end[0]], [begin[1], end[1]])
    east, north = returns.corner_m
    return {
        "begin_x_m": east + begin[0], "begin_y_m": north + begin[1], "begin_height_m": float(heights[0]),
        "end_x_m": east + end[0], "end_y_m": north + end[1], "end_height_m": float(heights[1]),
        "begin_seen": stripe.begin_seen and span[0] == stripe.begin_m,
        "end_seen": stripe.end_seen and span[1] == stripe.end_m,
        "width_m": stripe.width_m,
        "contrast": stripe.contrast,
        "sigma_across_m": stripe.sigma_across_m,
        "sigma_height_m": height_sigma(seen.height_m - scene.ground.height_at(seen.x_m, seen.y_m)),
        "probability": stripe.probability,
        "returns": len(seen) if own.size else 0,
        "passes": [int(p) for p in np.unique(seen.pass_id)],
        "first_epoch_gps_ns": int(seen.epoch_gps_ns.min()),
        "last_epoch_gps_ns": int(seen.epoch_gps_ns.max()),
    }  # fmt: skip


def height_sigma(above_m: Float64) -> float:
    """Returns 1 σ (m) of the mean height of returns (n,) that lie this high above the ground model."""
    if above_m.size < 2:
        return 0.05
    return float(np.std(above_m) / np.sqrt(above_m.size) + abs(float(np.median(above_m))))


def within(stripe: Stripe, box: Box) -> tuple[float, float] | None:
    """Returns where the centre line runs inside a box (Liang and Barsky, 1984), from its middle; None outside."""
    low, high = stripe.begin_m, stripe.end_m
    for axis, (least, greatest) in enumerate(((box.x_min_m, box.x_max_m), (box.y_min_m, box.y_max_m))):
        place, step = float(stripe.middle_m[axis]), float(stripe.along[axis])
        if abs(step) < 1e-12:
            if not least <= place < greatest:
                return None
            continue
        near, far = sorted(((least - place) / step, (greatest - place) / step))
        low, high = max(low, near), min(high, far)
    return (low, high) if high - low >= _SHORTEST_M else None
