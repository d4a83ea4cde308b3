"""Overhead wires, from support to support, with their sag and the least height above what lies below."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely
from scipy.spatial import cKDTree

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.cubes import lines_through
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Box, Scene, once_a_scene
from roadscan.assets.upright.pieces import seen_by_each
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD

CUBE_M: Final = 0.25
"""Edge of a cube (m). Cubes lie on the map's grid, so that no cut moves them."""
_LOWEST_M: Final = 3.0
"""Least height above the ground (m): lower wires hang over no way."""
_EDGE_M: Final = 4.0
"""Cubes so far (m) outside of a tile tell of the spans in it."""
_CROWD_CUBES: Final = 40
"""Cubes with returns among the 125 about one: three conductors side by side fill no more, foliage and fronts do."""
_CROWD: Final = 2.5  # Reach of those 125 (cubes).
_NEAR_M: Final = 1.5
"""Cubes up to this distance (m) tell of a line: a wire is straight to 2 mm over 3 m, with a sag of 0.5 m in 25 m."""
_LIMITS: Final = np.array([CUBE_M, 0.5, 0.35, 0.07, 0.15, 0.6])
"""Bin along a line (m); least distance of its second cube (m); greatest slope; radius (m), within which noise keeps the
middles of cubes; inner and outer radius of the tube (m) in which other things are counted."""
_LEAST_BINS: Final = 5
"""Least number of the twelve bins with returns on the line."""
_NO_WIRE: Final = (classes.GROUND, classes.ROAD, classes.LOW_NOISE, classes.PERSON)
_LEVELS: Final = np.arange(2, 9)
"""Cubes below and above one (0.5 to 2.25 m) in which a wall, a crown or a roof shows itself."""
_MOST_CUBES: Final = 20
"""More of the 63 cubes below, or of those above, belong to a wall or a crown: a line in it is no wire."""
PIECE_SCHEMA: Final = pa.schema(
    [
        ("easting_m", pa.float64()), ("northing_m", pa.float64()), ("height_m", pa.float64()),
        ("clearance_m", pa.float64()), ("way_east", pa.float64()), ("way_north", pa.float64()),
        ("way_up", pa.float64()), ("filled", pa.int64()), ("beside", pa.int64()), ("crowd", pa.int64()),
        ("below", pa.int64()), ("above", pa.int64()), ("leafy", pa.float64()), ("returns", pa.int64()),
        ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()), ("last_epoch_gps_ns", pa.int64()),
    ]
)  # fmt: skip
"""A row for each cube of a line. `filled` bins of the line; cubes `beside` it, in the `crowd` about it, `below` and
`above` it; `leafy` is the share of its returns that are vegetation."""


def thin_cubes(scene: Scene) -> tuple[pa.Table, list[Int64]]:
    """Returns the cubes that lie on a straight level line in the air, and the rows of each: of the tile and its edge.

    The edge of 4 m holds the least length of a span, so that the same returns are its own wherever squares are cut.
    """
    returns = scene.returns
    rows = np.flatnonzero((scene.above_ground_m >= _LOWEST_M) & ~np.isin(scene.classes, _NO_WIRE))
    if not rows.size:
        return PIECE_SCHEMA.empty_table(), []
    east, north = returns.corner_m
    xyh = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]])
    cell = np.floor((xyh + np.array([east, north, 0.0])) / CUBE_M).astype(np.int64)
    low = cell.min(axis=0) - 1 - (_LEVELS[-1] + 1)
    _, columns, layers = cell.max(axis=0) + 2 + (_LEVELS[-1] + 1) - low
    packed = (cell - low) @ [columns * layers, layers, 1]  # one number a cube; that of a cube beside it is so much more
    cubes_with, first, own, number = np.unique(packed, return_index=True, return_inverse=True, return_counts=True)
    places = cell[first]
    middle = np.column_stack([np.bincount(own, xyh[:, k]) for k in range(3)]) / number[:, None]
    tile = scene.tile
    inside = Box(tile.x_min_m - _EDGE_M, tile.y_min_m - _EDGE_M, tile.x_max_m + _EDGE_M, tile.y_max_m + _EDGE_M).holds(
        middle[:, 0], middle[:, 1]
    )
    crowd = cKDTree(places).query_ball_point(places, _CROWD, p=np.inf, return_length=True)
    chosen = np.flatnonzero(inside & (crowd <= _CROWD_CUBES))
    about = cKDTree(middle).query_ball_point(middle[chosen], _NEAR_M, return_sorted=True)
    starts = np.cumsum([0, *map(len, about)])
    near = np.concatenate([np.asarray(one, np.int64) for one in about]) if len(about) else np.empty(0, np.int64)
    filled, beside = np.empty(chosen.size, np.int64), np.empty(chosen.size, np.int64)
    line = np.zeros((chosen.size, 3))
    lines_through(middle, chosen, starts, near, _LIMITS, filled, beside, line)
    steps = [(i * columns + j) * layers for i in (-1, 0, 1) for j in (-1, 0, 1)]
    below, above = (_filled(cubes_with, chosen, np.add.outer(steps, way * _LEVELS).ravel()) for way in (-1, 1))
    kept = np.flatnonzero((filled >= _LEAST_BINS) & (below <= _MOST_CUBES) & (above <= _MOST_CUBES))
    cubes = chosen[kept]
    bounds, order = in_bins(own.astype(np.int32), len(places))
    held = [rows[order[bounds[k] : bounds[k + 1]]] for k in cubes.tolist()]
    of_all, starts = np.concatenate([rows[:0], *held]), np.cumsum([0, *map(len, held)])
    leaves = np.add.reduceat(np.isin(scene.classes[of_all], classes.VEGETATION), starts[:-1], dtype=np.int64)
    ground = scene.ground.height_at(middle[cubes, 0], middle[cubes, 1])
    table = pa.table(
        {
            "easting_m": east + middle[cubes, 0], "northing_m": north + middle[cubes, 1],
            "height_m": middle[cubes, 2], "clearance_m": middle[cubes, 2] - ground,
            "way_east": line[kept, 0], "way_north": line[kept, 1], "way_up": line[kept, 2], "filled": filled[kept],
            "beside": beside[kept], "crowd": crowd[cubes], "below": below[kept], "above": above[kept],
            "leafy": leaves / np.diff(starts), **seen_by_each(scene, of_all, starts),
        },
        schema=PIECE_SCHEMA,
    )  # fmt: skip
    return table, held


def _filled(cubes_with: Int64, chosen: Int64, steps: Int64) -> Int64:
    """Returns how many of the cubes some steps from each chosen one (n,) hold returns; cubes are packed, ascending."""
    asked = cubes_with[chosen][:, None] + steps
    at = np.minimum(np.searchsorted(cubes_with, asked), cubes_with.size - 1)
    return np.asarray((cubes_with[at] == asked).sum(axis=1))


_STEPS_M: Final = (1.0, 3.0)
"""A span goes on to what lies so far from its ends (m); the second step is tried where the first finds nothing."""
_ACROSS_M: Final = 0.10
"""A cube belongs to a span up to this distance from it, level and upright (m): steps of poses are 20 to 75 mm."""
_ALONG: Final = 0.9
"""Least cosine of the angle, in plan, between the line of a cube and the span."""
_BENT_M: Final = 4.0
"""From this length (m) a span is a parabola; a shorter one is straight: its sag would be a thousandth."""
_LEAST_CUBES: Final = 8
_LEAST_M: Final = 2.5
"""Fewer cubes, or a shorter span (m), are no wire that can be told."""
_KINK: Final = 0.6
"""A span is two, which meet at a support, where two parabolas leave less than this share of its deviations."""
_SUPPORT_M: Final = 1.0
"""Supports are sought in such steps (m), and not within the length of a bent span from its ends."""
_OUTLIER: Final = 3.0
"""Cubes farther from a span than this many times its deviation belong to a neighbour that it crosses."""
_LEAST_OFF_M: Final = 0.03
"""Deviation (m) below which no cube is left out: the noise of ranges."""
_ROUNDS: Final = 500
"""Most steps of a span: 1,500 m."""


@dataclass(frozen=True, eq=False)
class Span:
    """One span."""

    rows: Int64
    """Cubes: rows of the pieces, along the span."""
    middle_m: Float64
    """(2,) easting and northing at which `along_m` is 0."""
    way: Float64
    """(2,) its direction in plan."""
    along_m: Float64
    """(n,) of each cube, ascending."""
    own_m: Float64
    """(n, 3) easting, northing and height of each cube."""
    heights: Float64
    """Polynomial of the height over `along_m` (m), highest power first."""

    @cached_property
    def off_m(self) -> Float64:
        """Returns how far (n, 2) each cube lies to the left of the span and above it; a span that grows asks no one."""
        return np.zeros((1, 2)) if self.rows.size == 1 else _seen_from(self.own_m, self)[1]

    @property
    def length_m(self) -> float:
        """Returns its length in plan."""
        return float(self.along_m[-1] - self.along_m[0])

    @property
    def sag_m(self) -> float:
        """Returns how far its middle hangs below the straight line between its ends; 0 of a short one."""
        return float(self.heights[0] * self.length_m**2 / 4.0) if self.heights.size == 3 else 0.0

    def places_m(self, along_m: Float64) -> Float64:
        """Returns (n, 3) easting, northing and height."""
        plan = self.middle_m + along_m[:, None] * self.way
        return np.column_stack([plan, np.polyval(self.heights, along_m)])


def spans_of(pieces: pa.Table) -> Iterator[Span]:
    """Yields the spans of pieces (:data:`roadscan.assets.kinds.wire.PIECE_SCHEMA`), the surest cubes first.

    Where two spans meet at a support, the line's slope changes and the parabola of one does not go on into the other.
    """
    place = np.column_stack([np.asarray(pieces[n]) for n in ("easting_m", "northing_m", "height_m")])
    way = np.column_stack([np.asarray(pieces[n]) for n in ("way_east", "way_north")])
    if not len(place):
        return
    way /= np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
    tree, free = cKDTree(place), np.ones(len(place), np.bool_)
    order = np.lexsort((*place.T, np.asarray(pieces["beside"]), -np.asarray(pieces["filled"])))
    for seed in order.tolist():
        if free[seed]:
            span = _grown(place, way, tree, free, seed)
            free[span.rows] = False
            for part in _between_supports(place, span):
                if part.rows.size >= _LEAST_CUBES and part.length_m >= _LEAST_M:
                    yield part


def _between_supports(place: Float64, span: Span) -> Iterator[Span]:
    """Yields the spans from support to support of one that goes on over some."""
    best, parts = _KINK * float(np.sum(span.off_m[:, 1] ** 2)), None
    for at in np.arange(span.along_m[0] + _BENT_M, span.along_m[-1] - _BENT_M, _SUPPORT_M).tolist():
        number = int(np.searchsorted(span.along_m, at))
        if min(number, span.rows.size - number) >= _LEAST_CUBES:
            two = [_fitted(place, rows, span.way) for rows in (span.rows[:number], span.rows[number:])]
            left = sum(float(np.sum(one.off_m[:, 1] ** 2)) for one in two)
            if left < best:
                best, parts = left, two
    if parts is None:
        yield span
        return
    for part in parts:
        yield from _between_supports(place, part)


def _grown(place: Float64, way: Float64, tree: cKDTree, free: Bool, seed: int) -> Span:
    """Returns the span about a cube, of cubes that are free."""
    span = _fitted(place, np.array([seed]), way[seed])
    for _ in range(_ROUNDS):
        for step in _STEPS_M:
            more = _beyond(place, way, tree, free, span, step)
            if more.size > span.rows.size:
                break
        if more.size <= span.rows.size:
            break
        span = _fitted(place, more, span.way)
    return _without_neighbours(place, span)


def _without_neighbours(place: Float64, span: Span) -> Span:
    """Returns a span without the cubes that lie off it, by the median of deviations; one of too few as it is."""
    if span.rows.size < _LEAST_CUBES:
        return span
    for _ in range(_ROUNDS):
        deviation = np.maximum(SIGMA_OF_MAD * np.array([median(off) for off in np.abs(span.off_m).T]), _LEAST_OFF_M)
        inside = (np.abs(span.off_m) <= _OUTLIER * deviation).all(axis=1)
        if inside.all() or np.count_nonzero(inside) < _LEAST_CUBES:
            return span
        span = _fitted(place, span.rows[inside], span.way)
    return span


def _beyond(place: Float64, way: Float64, tree: cKDTree, free: Bool, span: Span, step_m: float) -> Int64:
    """Returns the cubes of a span and of its line up to a step beyond its ends."""
    ends = span.along_m[[0, -1]] + [-step_m / 2, step_m / 2]
    between = np.linspace(float(ends[0]), float(ends[1]), 2 + int(np.ptp(ends)))
    about = tree.query_ball_point(span.places_m(between), step_m + 0.5)
    found = np.array(sorted(set().union(*about)), np.int64)  # NumPy would turn list after list into an array
    found = found[free[found] & (np.abs(way[found] @ span.way) >= _ALONG)]
    along, off = _seen_from(place[found], span)
    inside = (np.abs(off) <= _ACROSS_M).all(axis=1)
    inside &= (along >= span.along_m[0] - step_m) & (along <= span.along_m[-1] + step_m)
    return np.union1d(found[inside], span.rows)


def _seen_from(place: Float64, span: Span) -> tuple[Float64, Float64]:
    """Returns places (n, 3) along a span (n,), and (n, 2) to its left and above it."""
    past = place[:, :2] - span.middle_m
    along = past @ span.way
    off = np.column_stack([past @ [-span.way[1], span.way[0]], place[:, 2] - np.polyval(span.heights, along)])
    return along, off


def _fitted(place: Float64, rows: Int64, way: Float64) -> Span:
    """Returns the span of some cubes by least squares; a short one keeps the direction `way`."""
    own = place[rows]
    if rows.size == 1:
        return Span(rows, own[0, :2], way, np.zeros(1), own, own[:, 2])
    middle = own[:, :2].mean(axis=0)
    past = own[:, :2] - middle
    if np.ptp(past @ way) > 1.0:
        _, axes = np.linalg.eigh(past.T @ past)
        way = axes[:, 1] * (1.0 if axes[:, 1] @ way >= 0.0 else -1.0)
    along = past @ way
    length = float(np.ptp(along))
    degree = 2 if length >= _BENT_M else int(length > 0.5)
    heights = np.polyfit(along, own[:, 2], degree)
    order = np.argsort(along, kind="stable")
    return Span(rows[order], middle, way, along[order], own[order], heights)


def features_of(span: Span, pieces: pa.Table) -> dict[str, float]:
    """Returns what tells a wire from an edge of a front, a branch or a beam (values by name, lengths in m)."""
    own = {n: np.asarray(pieces[n].take(pa.array(span.rows)), np.float64)
           for n in ("filled", "beside", "crowd", "below", "above", "leafy", "returns", "clearance_m")}  # fmt: skip
    return {
        "length_m": span.length_m,
        "coverage": np.unique(np.floor(span.along_m / 0.25)).size / (span.length_m / 0.25),
        "gap_m": float(np.diff(span.along_m).max()),
        "off_left_m": float(np.sqrt(np.mean(span.off_m[:, 0] ** 2))),
        "off_up_m": float(np.sqrt(np.mean(span.off_m[:, 1] ** 2))),
        "slope": float(abs(np.polyval(np.polyder(span.heights), 0.0))) if span.heights.size > 1 else 0.0,
        "curvature_per_m": float(2.0 * span.heights[0]) if span.heights.size == 3 else 0.0,
        "returns_per_m": float(own["returns"].sum() / span.length_m),
        "clearance_m": float(np.median(own["clearance_m"])),
        **{n: float(np.mean(own[n])) for n in ("filled", "beside", "crowd", "below", "above", "leafy")},
    }


JUDGE: Final = Judge("wire", "de0189f699e5a4df")
"""Who is asked whether a span is a wire."""
_LEAST: Final = 0.5
"""Less probable spans are left out."""
_VERTEX_M: Final = 1.0
"""Distance of the vertices of a line (m): with a sag of 0.5 m over 25 m, the curve leaves its chords by 1 mm."""
_INDEPENDENT_M: Final = 1.0
"""Cubes closer along a span than this (m) share the errors of one turn of the scanner."""


class Wire(AssetKind):
    """Overhead wires: spans of cubes in the air."""

    name = "wire"
    title = "Overhead wires"
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns cubes of the tile that lie on a straight level line in the air."""
        pieces, rows = _cubes_of(scene)
        east, north = scene.returns.corner_m
        own = scene.tile.holds(np.asarray(pieces["easting_m"]) - east, np.asarray(pieces["northing_m"]) - north)
        return Evidence(pieces.filter(pa.array(own)), (Marked(rows, classes.WIRE),))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields a line for each span, by its first place."""
        found = [_object(pieces, *one) for one in judged(pieces)]
        yield from sorted(found, key=lambda one: one.geometry.coords[0])


@once_a_scene
def _cubes_of(scene: Scene) -> tuple[pa.Table, Int64]:
    """Returns the cubes of a scene that lie on a line, and the returns of wires."""
    pieces, held = thin_cubes(scene)
    marked = [held[k] for span, _ in judged(pieces) for k in span.rows.tolist()]
    return pieces, np.concatenate(marked) if marked else np.empty(0, np.int64)


def judged(pieces: pa.Table) -> list[tuple[Span, float]]:
    """Returns the spans that are probably wires, each with its probability."""
    spans = list(spans_of(pieces))
    stated = JUDGE.of_each([features_of(one, pieces) for one in spans]).tolist()
    return [(span, p) for span, p in zip(spans, stated, strict=True) if p >= _LEAST]


def _object(pieces: pa.Table, span: Span, probability: float) -> AssetObject:
    own = pieces.take(pa.array(span.rows))
    ground = np.asarray(own["height_m"]) - np.asarray(own["clearance_m"])
    clearance = float(np.min(np.polyval(span.heights, span.along_m) - ground))
    along = np.linspace(span.along_m[0], span.along_m[-1], 2 + int(span.length_m / _VERTEX_M))
    line = span.places_m(along)
    if tuple(line[-1]) < tuple(line[0]):
        line = line[::-1]
    sigma = np.sqrt(np.mean(span.off_m**2, axis=0) / max(span.length_m / _INDEPENDENT_M, 1.0))
    passes = {one for row in own["passes"].to_pylist() for one in row}
    return AssetObject(
        shapely.LineString(line), float(sigma[0]), float(sigma[1]), probability,
        int(np.sum(np.asarray(own["returns"]))), len(passes), int(np.min(np.asarray(own["first_epoch_gps_ns"]))),
        int(np.max(np.asarray(own["last_epoch_gps_ns"]))),
        {"length_m": span.length_m, "sag_m": span.sag_m, "clearance_m": clearance}, math.sqrt(2.0) * float(sigma[1]),
    )  # fmt: skip
