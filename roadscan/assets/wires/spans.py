"""Spans of wires: cubes of returns joined along a straight line in plan that hangs as a parabola."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.spatial import cKDTree

from roadscan.assets.quantiles import median
from roadscan.compute.array_types import Float64, Int64

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
    off_m: Float64
    """(n, 2) of each cube, to the left of the span and above it."""
    heights: Float64
    """Polynomial of the height over `along_m` (m), highest power first."""

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
    """Yields the spans of pieces (:data:`roadscan.assets.wires.thin.PIECE_SCHEMA`), the surest cubes first.

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


def _grown(place: Float64, way: Float64, tree: cKDTree, free: npt.NDArray[np.bool_], seed: int) -> Span:
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
    """Returns a span without the cubes that lie off it, by the median of deviations."""
    for _ in range(_ROUNDS):
        deviation = np.maximum(1.4826 * np.array([median(off) for off in np.abs(span.off_m).T]), _LEAST_OFF_M)
        inside = (np.abs(span.off_m) <= _OUTLIER * deviation).all(axis=1)
        if inside.all() or np.count_nonzero(inside) < _LEAST_CUBES:
            return span
        span = _fitted(place, span.rows[inside], span.way)
    return span


def _beyond(
    place: Float64, way: Float64, tree: cKDTree, free: npt.NDArray[np.bool_], span: Span, step_m: float
) -> Int64:
    """Returns the cubes of a span and of its line up to a step beyond its ends."""
    ends = span.along_m[[0, -1]] + [-step_m / 2, step_m / 2]
    between = np.linspace(float(ends[0]), float(ends[1]), 2 + int(np.ptp(ends)))
    found = np.unique(np.concatenate(tree.query_ball_point(span.places_m(between), step_m + 0.5)).astype(np.int64))
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
        return Span(rows, own[0, :2], way, np.zeros(1), np.zeros((1, 2)), own[:, 2])
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
    span = Span(rows[order], middle, way, along[order], np.zeros((rows.size, 2)), heights)
    return Span(span.rows, middle, way, along[order], _seen_from(own[order], span)[1], heights)


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
