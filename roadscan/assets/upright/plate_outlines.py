"""Plates: shape and size from the returns of a plane, and features that tell a plate from windows, bark and leaves."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit, ndtri

from roadscan.assets import classes
from roadscan.assets.kernels.plates import nearest_sides
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.brightness import brightness
from roadscan.assets.upright.plate_beams import Beams
from roadscan.assets.upright.regions import regions_of
from roadscan.compute.array_types import Bool, Float64, Int64

_DIRECTIONS: Final = 36  # Directions in which the extent of the returns is measured.
_TRIMMED: Final = 0.0005  # Share of the outermost returns that is left out.
_BEYOND: Final = 0.35
"""The edge lies past the outermost return by this share of the mean distance between returns: none of evenly
spread returns would make it 0, a grid of them 0.5."""
_LEAST_M: Final = 0.02  # Least size of a shape (m).
_SQUARE: Final = 0.08
"""Greatest relative difference of the sides of a square."""
_CLOSE: Final = 2.0
"""Shapes whose misfit is at most this multiple of the best one are compared with the beams."""
_BLURS_M: Final = (0.02, 0.002)
"""Width (m) of the transition between beams that a plate stops and those that pass, first and at last."""
_WELL_INSIDE: Final = 0.25
"""Returns farther within an edge than this share of the plate do not determine it."""
_NEAR_EDGE_M: Final = (-0.05, 0.6)
"""Two beams that pass this far (m) beyond a side bound it."""
_LEAST_GAP_M: Final = 0.005
"""Least gap between lines that is assumed (m)."""
_LEAST_SIGMA_M: Final = 0.002
"""Least σ of the place of a side (m)."""
_BEYOND_SIDE_M: Final = 0.3
"""Beams that pass a side within this (m) tell how much of a spot has to lie on the plate."""
_SIDES_THAT_TELL: Final = 4  # Greatest number of sides whose errors are independent, of shapes with one size.
_LESS_BETWEEN: Final = (1.0 - math.sqrt(2.0), 1.0 - math.sqrt(0.5))
"""A spot's width is known along and across the scan. Between both it reaches less than a disc by a share within these
limits: those of a square and of one on its corner; beams tell which."""
_LESS_SIGMA: Final = 0.25
"""1 σ of that share before beams tell it, …"""
_HOLD_LESS_M: Final = 0.002
"""… and the weight of that knowledge against beams on the wrong side (m)."""
_HOLD: Final = 0.002
"""Weight of the first solution, where nothing else determines the result (1/m)."""


class Spot(NamedTuple):
    """Spot of the beams on a plate."""

    half_m: float
    """Half its width (m); 0 where it is not known."""
    doubt_m: float
    """1 σ of how far beyond a side the middle of a beam lies that the plate just stops (m)."""


NO_SPOT: Final = Spot(0.0, 0.0)  # Beams are lines (m).


@dataclass(frozen=True)
class Outline:
    """The shape that fits best."""

    shape: str
    middle: tuple[float, float]
    """Of its bounding box, in the coordinates of the plane (m)."""
    width_m: float
    height_m: float
    misfit_m: float
    """Root mean square distance of the returns' hull from it."""
    sigma_m: float = math.inf
    """1 σ of its size (m)."""


def outline_of(points: Float64, beams: Beams | None = None, spot: Spot = NO_SPOT) -> Outline:
    """Best of rectangle, disc, octagon, diamond and triangles about points (n, 2) of a plane, second axis up.

    A convex shape is known by how far it reaches in each direction (its support function), which is linear in its place
    and its size; each template is fitted by least squares. Where beams are known, the shapes that fit best are then set
    between those that they stopped and those that went by; the one that parts them best is taken. Where they are not
    known, half a spot is taken off each side.
    """
    hulls = _hulls(points)
    if not hulls:
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        wide, tall = map(float, high - low)
        return Outline("other", (float(middle[0]), float(middle[1])), wide, tall, math.inf)
    misfit, shape, solution = hulls[0]
    room = math.sqrt(float(solution[2] * solution[-1]) / len(points))
    sigma = math.sqrt(2.0 * (room**2 / 12.0 + spot.doubt_m**2 + _LEAST_SIGMA_M**2))
    solution[2:] = np.maximum(solution[2:] - 2.0 * spot.half_m, 0.5 * solution[2:]) if beams is None else solution[2:]
    if beams is not None:
        parted = []
        for other, name, first in hulls:
            if other <= _CLOSE * misfit:
                loss, fitted, own = _parting(name, _without_spot(first, beams), beams, spot.doubt_m)
                if (fitted[2:] > _LEAST_M).all():
                    parted.append((loss, other, name, fitted, own))
        if parted:
            _, misfit, shape, solution, sigma = min(parted, key=lambda p: p[0])
    width, height = float(solution[2]), float(solution[-1])
    if shape.startswith("triangle"):
        height = width * math.sqrt(3.0) / 2.0
    if shape == "rectangle" and abs(width - height) < _SQUARE * max(width, height):
        shape = "square"
    return Outline(shape.split()[0], (float(solution[0]), float(solution[1])), width, height, misfit, sigma)


def _hulls(points: Float64) -> list[tuple[float, str, Float64]]:
    """Returns misfit, name, and place and size of each template about points, the best first."""
    ways, outermost = _all_around(), len(points) - 1 - int(_TRIMMED * len(points))
    reach = np.partition(points @ ways.T, outermost, axis=0)[outermost]
    found = []
    for shape in _TEMPLATES:
        columns = _hull_columns(shape)
        solution, *_ = np.linalg.lstsq(columns, reach, rcond=None)
        misfit = float(np.sqrt(np.mean((columns @ solution - reach) ** 2)))
        if (solution[2:] > _LEAST_M).all():
            solution[2:] += 2.0 * _BEYOND * math.sqrt(solution[2] * solution[-1] / len(points))
            found.append((misfit, shape, solution))
    return sorted(found, key=lambda f: f[0])


@functools.cache
def _all_around() -> Float64:
    """Returns the directions (36, 2) in which the extent of the returns is measured."""
    angle = np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS)
    return np.column_stack([np.cos(angle), np.sin(angle)])


@functools.cache
def _hull_columns(shape: str) -> Float64:
    """Returns how far the hull of a template moves with place and size (36, n) in each of these directions."""
    return _columns_of(shape, _all_around())


@functools.cache
def _sides_of(shape: str) -> tuple[Float64, Float64]:
    """Returns the directions (k, 2) of the sides of a template, and how far they move with place and size (k, n)."""
    angle = np.deg2rad(_SIDES[shape])
    ways = np.column_stack([np.cos(angle), np.sin(angle)])
    return ways, _columns_of(shape, ways)


def _columns_of(shape: str, ways: Float64) -> Float64:
    return np.column_stack([ways, *[t(ways) for t in _TEMPLATES[shape]]])


def _parting(shape: str, first: Float64, beams: Beams, doubt_m: float) -> tuple[float, Float64, float]:
    """Returns loss, place and size, and σ of the size, of the template that separates hitting from passing beams.

    The loss is logistic in the distance of a beam beyond the nearest side or within it. It grows linearly on the
    wrong side, so single wrong beams do little, and leaves the edge in the middle between both on the right one.
    """
    from scipy.optimize import minimize

    ways, columns = _sides_of(shape)
    needed = _needed(columns @ first, ways, beams)
    reach_hit, reach_by = beams.hit_spot.reach(ways), beams.passed_spot.reach(ways)
    within = beams.hits @ ways.T - needed * reach_hit
    beyond = beams.passed @ ways.T - needed * reach_by
    slanted = 2.0 * np.abs(ways[:, 0] * ways[:, 1])
    reach_hit, reach_by = slanted * reach_hit, slanted * reach_by
    near = (within - columns @ first).max(axis=1) > -_WELL_INSIDE * first[2:].min()
    within, reach_hit = within[near], reach_hit[near]
    lines = _half_gap(ways, beams)
    spot = np.median(beams.hit_spot.reach(ways), axis=0)
    expected = _expected(first, ways, columns, beams, lines) @ ways.T - needed * spot
    beyond = np.concatenate([beyond, expected])
    reach_by = np.concatenate([reach_by, np.broadcast_to(slanted * spot, expected.shape)])
    begin = np.append(first, 0.0)
    sides = [(side, along, reach, np.empty(len(along), np.int64), np.empty(len(along)), np.empty(len(along)))
             for side, along, reach in ((1.0, within, reach_hit), (-1.0, beyond, reach_by))]  # fmt: skip

    def loss(solution: Float64, blur: float) -> tuple[float, Float64]:
        slope = np.append(_HOLD * (solution[:-1] - first), _HOLD_LESS_M * solution[-1] / _LESS_SIGMA**2)
        value = 0.5 * float(((solution - begin) * slope).sum())
        at = columns @ solution[:-1]
        for side, along, reach, nearest, away, grows in sides:
            nearest_sides(along, reach, solution[-1], at, nearest, away, grows)
            past = side * away / blur
            value += blur * float(np.logaddexp(0.0, past).sum())
            push = side * expit(past)
            slope[:-1] -= push @ columns[nearest]
            slope[-1] += float(push @ grows)
        return value, slope

    solution, value = begin, 0.0
    limits = [(None, None)] * first.size + [_LESS_BETWEEN]
    options = {"maxiter": 60, "gtol": 1e-4}
    for blur in _BLURS_M:
        found = minimize(loss, solution, (blur,), method="L-BFGS-B", jac=True, bounds=limits, options=options)
        solution, value = found.x, float(found.fun)
    within, beyond = within + solution[-1] * reach_hit, beyond + solution[-1] * reach_by
    solution = solution[:-1]
    if shape == "rectangle":
        reach = columns @ solution
        solution = solution + np.linalg.solve(columns, _to_sides(within - reach, beyond - reach, lines))
    reach = columns @ solution
    return value, solution, _sigma_of_size(shape, columns, _rooms(within - reach, beyond - reach, lines), doubt_m)


def _without_spot(first: Float64, beams: Beams) -> Float64:
    """Returns place and size of a template without the reach of the spots on both sides."""
    wide = 2.0 * np.median(beams.hit_spot.reach(np.eye(2)), axis=0)
    least = np.full(first.size - 2, 0.5) * first[2:]
    return np.concatenate([first[:2], np.maximum(first[2:] - (wide if first.size == 4 else wide.mean()), least)])


def _needed(reach: Float64, ways: Float64, beams: Beams) -> Float64:
    """Returns how far beyond each side (k,) the middle of a beam lies that the plate just stops, in shares of its
    spot.

    Where nothing else answers, the rim of the spot suffices: 1. Where something behind does, the plate has to send more
    light back than that, of a beam that fades as a Gaussian to e⁻² at its rim.
    """
    past = beams.passed @ ways.T - reach
    near = (past > _NEAR_EDGE_M[0]) & (past < _BEYOND_SIDE_M) & (past.argmax(axis=1)[:, None] == np.arange(len(ways)))
    share = np.where(beams.lit > 0.0, 0.5 * ndtri(1.0 / (1.0 + np.maximum(beams.lit, 1e-3))), 1.0)
    share = np.clip(share, -1.0, 1.0)
    told = near.sum(axis=0)
    every = float(share.mean()) if share.size else 1.0
    return np.where(told > 0, (near * share[:, None]).sum(axis=0) / np.maximum(told, 1), every)


def _rooms(within: Float64, beyond: Float64, half_gap: Float64) -> Float64:
    """Returns the room (k,) between the outermost beam on the plate and the nearest one that went by, at each side (m).

    within, beyond : (n, k) how far beams that hit and that passed lie past each side. half_gap : (k,).
    """
    room = 2.0 * half_gap
    outside = np.where(_past_one(beyond) & (beyond > -room), beyond, np.inf).min(axis=0, initial=np.inf)
    known = np.isfinite(outside)
    room[known] = np.minimum(room, np.abs(outside - within.max(axis=0, initial=-np.inf)))[known]
    return room


def _past_one(beyond: Float64) -> Bool:
    """Returns where (n, k) a beam lies within all sides but that one, past which it lies or not."""
    past = ~(beyond < 0.0)
    return np.asarray(past.sum(axis=1)[:, None] == past)


def _sigma_of_size(shape: str, columns: Float64, room: Float64, doubt_m: float) -> float:
    """Returns 1 σ of the size: a side lies anywhere in its room, and as far off as the spots are not known.

    columns : (k, n) how far each side moves with place and size. Sides of a diamond, and more so of a triangle, lie
    nearer to the middle than those of a disc of that width, so that their errors are a greater share of it.
    """
    side = np.sqrt(room**2 / 12.0 + doubt_m**2 + _LEAST_SIGMA_M**2)
    if shape == "rectangle":
        return float(max(math.hypot(side[0], side[2]), math.hypot(side[1], side[3])))
    told = min(side.size, _SIDES_THAT_TELL)
    return float(np.sqrt(np.mean(side**2) / told) / np.mean(columns[:, 2]))


def _to_sides(within: Float64, beyond: Float64, half_gap: Float64) -> Float64:
    """Returns the distance of each side beyond its first place (m).

    It lies in the middle between the outermost line on the plate and the nearest beam that went by. Where no beam went
    by as near as the lines lie from one another, it lies half of their widest gap beyond the outermost one.

    Parameters
    ----------
    within, beyond : (n, sides) how far beams that hit and that passed lie past each side.
    half_gap : (sides,) half the widest gap between lines (m).
    """
    out, level = np.zeros(half_gap.size), _past_one(beyond)
    for k in range(out.size):
        last, following = within[within[:, k] <= 0.0, k], beyond[level[:, k] & (beyond[:, k] >= 0.0), k]
        if last.size and following.size:
            out[k] = last.max() + min((following.min() - last.max()) / 2, half_gap[k])
    return out


def _half_gap(ways: Float64, beams: Beams) -> Float64:
    """Returns half the widest gap between lines on a plate (k,), by their reach in some directions (k, 2)."""
    starts = np.flatnonzero(np.append(True, np.diff(beams.line) != 0))
    reach = np.sort(np.maximum.reduceat(beams.hits @ ways.T, starts, axis=0), axis=0)
    return np.asarray(np.diff(reach, axis=0).max(axis=0, initial=2.0 * _LEAST_GAP_M) / 2)


def _expected(first: Float64, ways: Float64, columns: Float64, beams: Beams, lines: Float64) -> Float64:
    """Returns places (n, 2) beyond sides that no beam passed near: their widest gap beyond the outermost line."""
    reach, out = columns @ first, [np.zeros((0, 2))]
    farthest = (beams.hits @ ways.T).max(axis=0)
    for k in range(0, len(ways), max(1, len(ways) // 8)):
        past = beams.passed @ ways[k] - reach[k]
        aside = np.abs((beams.passed - first[:2]) @ [-ways[k, 1], ways[k, 0]])
        near = (past > _NEAR_EDGE_M[0]) & (past < _NEAR_EDGE_M[1]) & (aside < 0.45 * first[2:].max())
        if near.sum() < 2:
            out.append((first[:2] + ways[k] * (farthest[k] + 2.0 * lines[k] - first[:2] @ ways[k]))[None])
    return np.concatenate(out)


def _disc(ways: Float64) -> Float64:
    return np.full(len(ways), 0.5)


def _octagon(ways: Float64) -> Float64:
    corners = np.deg2rad(22.5 + 45.0 * np.arange(8))
    radius = 0.5 / math.cos(math.pi / 8)
    out: Float64 = radius * np.max(ways @ np.array([np.cos(corners), np.sin(corners)]), axis=1)
    return out


def _diamond(ways: Float64) -> Float64:
    out: Float64 = 0.5 * np.abs(ways).max(axis=1)
    return out


def _triangle(ways: Float64) -> Float64:
    """Support function of a triangle with equal sides, one of them below; its bounding box has the width 1."""
    half = math.sqrt(3.0) / 4.0
    out: Float64 = np.max(ways @ np.array([[-0.5, 0.5, 0.0], [-half, -half, half]]), axis=1)
    return out


def _triangle_down(ways: Float64) -> Float64:
    return _triangle(ways * np.array([1.0, -1.0]))


_TEMPLATES: Final = {
    "rectangle": (lambda w: 0.5 * np.abs(w[:, 0]), lambda w: 0.5 * np.abs(w[:, 1])),
    "round": (_disc,),
    "octagon": (_octagon,),
    "diamond": (_diamond,),
    "triangle": (_triangle,),
    "triangle down": (_triangle_down,),
}
"""Support functions for a width, or a width and a height, of 1."""
_SIDES: Final = {
    "rectangle": 90.0 * np.arange(4),
    "round": 5.0 * np.arange(72),
    "octagon": 45.0 * np.arange(8),
    "diamond": 45.0 + 90.0 * np.arange(4),
    "triangle": 120.0 * np.arange(3) - 90.0,
    "triangle down": 120.0 * np.arange(3) + 90.0,
}
"""Directions in which the sides face (degrees from the first axis)."""


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
    green = np.isin(scene.classes[near[around]], classes.VEGETATION)
    return {
        "returns": math.log(number), "range_m": float(np.median(scene.returns.ranges_m(plane.rows))),
        "bright_median": float(np.median(light)), "bright_high": float(np.quantile(light, 0.9)),
        "residual_m": residual_m, "beside": beside,
        "behind": float((inside & (away > _THIN_M) & (away < _BEHIND_M)).sum()) / number,
        "around": float(around.sum()) / number, "on_top": float(on_top.sum()) / number,
        "green": float(green.mean()) if green.size >= 5 else math.nan,
        "above_m": above_m, "width_m": outline.width_m, "height_m": outline.height_m,
        "ratio": math.log(outline.height_m / outline.width_m),
        "misfit": outline.misfit_m / min(outline.width_m, outline.height_m), "tilt": abs(float(plane.normal[2])),
        "filled": _filled(u, v, inside & (away < _THIN_M), wide, tall),
        "passed": _passed(beams, outline), "vehicle": _vehicles(scene, plane.middle) / number,
        "wall_m": _to_wall(scene, plane),
    }  # fmt: skip


def _filled(u: Float64, v: Float64, on: Bool, wide: float, tall: float) -> float:
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
            if away < least and _among(region.rows, plane.rows).mean() < 0.5:
                least = away
    return least


def _among(rows: Int64, asked: Int64) -> Bool:
    """Returns a mask (n,) of those asked for that are among rows (k,), ascending: a plate asks of a large surface."""
    at = np.minimum(np.searchsorted(rows, asked), rows.size - 1)
    return np.asarray(rows[at] == asked)
