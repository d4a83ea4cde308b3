"""Finds roads and lanes of a survey: reference lines from a layer or from the drives, and the drives of each lane."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import smoothed_knots, way_along
from roadscan.compute.kernels.curved_grid import thin_path
from roadscan.condition.road_line import NODE_M, Lane, RoadLine
from roadscan.condition.settings import ConditionConfig

LEAST_M: Final = 20.0
"""Shorter pieces of a drive are neither a road nor a lane."""
_KNOT_M: Final = 0.25  # Spacing of the points of a smoothed drive.
_PARALLEL: Final = 0.85
"""Least cosine of the angle between a drive and its reference line."""
_SAME_LANE_M: Final = 1.5
"""Largest difference of the mean offsets of drives on one lane."""
_AGAIN_M: Final = 60.0
"""A drive that returns to a place this far behind it along its way drives there again."""
_HALF_TURN_M: Final = 2  # Nodes on each side over which a direction is taken.


@dataclass(frozen=True, eq=False)
class Drive:
    """Path of a pass."""

    pass_id: int
    path_m: Float64
    """(k, 2) easting and northing in the order of travel."""
    lane: str = ""
    """Name of its lane, if the survey file states it."""


@dataclass(frozen=True, eq=False)
class StatedLine:
    """A line of a layer."""

    road: str
    path_m: Float64
    """(k, 2) its vertices."""
    name: str | None = None
    measure_from: float | None = None
    """Measure at its first vertex."""
    measure_to: float | None = None
    """Measure at its last vertex."""


@dataclass(frozen=True, eq=False)
class _Piece:
    """A piece of a drive along a road."""

    drive: Drive
    sign: int
    first_m: int
    offset_m: Float64

    @property
    def middle_m(self) -> float:
        return float(np.median(self.offset_m))


def find_roads(
    drives: Sequence[Drive], stated: Sequence[StatedLine], config: ConditionConfig
) -> tuple[list[RoadLine], list[Lane]]:
    """Return the reference lines that were driven, and their lanes, each from left to right.

    Parameters
    ----------
    drives : in the order of passes; stated : lines of the layer, none where the drives are the lines.
    """
    ways = [(drive, nodes_along(drive.path_m, config.smoothing_m)) for drive in drives]
    ways = [(drive, way) for drive, way in ways if len(way) > LEAST_M]
    if config.reference == "layer":
        lines = [line for one in stated if (line := _line_of(one)) is not None]
    else:
        lines = _lines_of_drives(ways, config)
    net = _Net(lines, config.same_road_m)
    pieces: dict[int, list[_Piece]] = {}
    for drive, way in ways:
        for number, piece in net.pieces(drive, way, config):
            pieces.setdefault(number, []).append(piece)
    found: list[Lane] = []
    driven: list[RoadLine] = []
    for number in sorted(pieces):
        driven.append(lines[number])
        found += _lanes(lines[number], pieces[number], config)
    return driven, found


def nodes_along(path_m: Float64, smoothing_m: float) -> Float64:
    """Return (k, 2) nodes :data:`NODE_M` apart along a path, smoothed by local parabolas (Savitzky and Golay 1964)."""
    kept = np.zeros(len(path_m), bool)
    if len(path_m):
        thin_path(np.ascontiguousarray(path_m), _KNOT_M, kept)
    path = path_m[kept]
    if not len(path) or int(way_along(path)[-1] / _KNOT_M) + 1 < 8:
        return np.zeros((0, 2))
    _, knots = smoothed_knots(path, _KNOT_M, smoothing_m)
    way = way_along(knots)
    nodes: Float64 = scipy.interpolate.CubicSpline(way, knots)(NODE_M * np.arange(int(way[-1] / NODE_M) + 1))
    return nodes


def _line_of(stated: StatedLine) -> RoadLine | None:
    """Return a layer's line with corners rounded within two metres."""
    length = float(way_along(stated.path_m)[-1])
    nodes = nodes_along(_densified(stated.path_m), 2.0)
    if len(nodes) < 3:
        return None
    per_m = None
    if stated.measure_from is not None and stated.measure_to is not None:
        per_m = (stated.measure_to - stated.measure_from) / length
    return RoadLine(stated.road, nodes, 0, stated.name, stated.measure_from if per_m is not None else None, per_m)


def _densified(path_m: Float64) -> Float64:
    along = way_along(path_m)
    at = np.union1d(along, np.arange(0.0, along[-1], _KNOT_M))
    return np.column_stack([np.interp(at, along, path_m[:, a]) for a in range(2)])


def _lines_of_drives(ways: Sequence[tuple[Drive, Float64]], config: ConditionConfig) -> list[RoadLine]:
    """Return a line for each piece of road, from the first drive over it."""
    lines: list[RoadLine] = []
    for _, way in ways:
        known = _Net(lines, config.same_road_m).near(way) if lines else np.zeros(len(way), bool)
        fresh = ~(known | _again(way, config.same_road_m))
        for start, end in _runs(fresh, round(LEAST_M)):
            lines.append(RoadLine(f"road{len(lines) + 1}", way[start:end]))
    return lines


def _again(way: Float64, near_m: float) -> Bool:
    """Return nodes of a drive at which it is on a road that it drove before."""
    from scipy.spatial import cKDTree

    direction = _directions(way)
    tree = cKDTree(way)
    again = np.zeros(len(way), bool)
    for k, others in enumerate(tree.query_ball_point(way, near_m)):
        before = np.array([j for j in others if j < k - _AGAIN_M], np.int64)
        if before.size:
            again[k] = bool((np.abs(direction[before] @ direction[k]) > _PARALLEL).any())
    return again


class _Net:
    """Index of lines by place."""

    def __init__(self, lines: Sequence[RoadLine], near_m: float) -> None:
        from scipy.spatial import cKDTree

        self._lines, self._near_m = lines, near_m
        self._nodes = np.concatenate([np.zeros((0, 2)), *(line.nodes_m for line in lines)])
        self._directions = np.concatenate([np.zeros((0, 2)), *(_directions(line.nodes_m) for line in lines)])
        self._line = np.repeat(np.arange(len(lines)), [len(line.nodes_m) for line in lines])
        self._index = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(line.nodes_m)) for line in lines)])
        self._tree = cKDTree(self._nodes)

    def near(self, way: Float64) -> Bool:
        """Return nodes of a drive that are on the road of one of the lines."""
        return self._nearest(way)[0] >= 0

    def _nearest(self, way: Float64) -> tuple[npt.NDArray[np.int64], Float64, Float64, Float64]:
        """Return line (−1 for none), station, offset, and cosine of the angle to it, of each node of a drive (k, 2)."""
        count = min(4, len(self._nodes))
        away, found = self._tree.query(way, k=np.arange(1, count + 1))
        direction = _directions(way)
        cosine = np.einsum("nka,na->nk", self._directions[found], direction)
        fits = (away <= self._near_m) & (np.abs(cosine) > _PARALLEL)
        first = np.argmax(fits, axis=1)
        own = found[np.arange(len(way)), first]
        along = self._directions[own]
        beside = way - self._nodes[own]
        ahead = np.einsum("na,na->n", beside, along)
        offset = beside[:, 0] * along[:, 1] - beside[:, 1] * along[:, 0]
        fits_any = fits.any(axis=1) & (np.abs(ahead) <= 2.0)
        line = np.where(fits_any, self._line[own], -1)
        return line, self._index[own] + ahead, offset, cosine[np.arange(len(way)), first]

    def pieces(self, drive: Drive, way: Float64, config: ConditionConfig) -> Iterator[tuple[int, _Piece]]:
        """Return pieces of a drive along the lines, by the line's number."""
        if not self._lines:
            return
        line, station, offset, cosine = self._nearest(way)
        sign = np.where(cosine > 0.0, 1, -1)
        group = np.where(line < 0, 0, (line + 1) * sign)
        for value in sorted({int(g) for g in np.unique(group)} - {0}):
            number, own = abs(value) - 1, 1 if value > 0 else -1
            for start, end in _runs(group == value, round(LEAST_M), bridge=5):
                part = slice(start, end)
                held = group[part] == value
                made = _piece(drive, own, station[part][held], offset[part][held], config.lane_smoothing_m)
                if made is not None:
                    yield number, made


def _piece(drive: Drive, sign: int, station: Float64, offset: Float64, smoothing_m: float) -> _Piece | None:
    from scipy.ndimage import uniform_filter1d

    order = np.argsort(station, kind="stable")
    station, offset = station[order], offset[order]
    first, last = int(np.ceil(station[0] - 1e-6)), int(np.floor(station[-1] + 1e-6))
    if last - first < LEAST_M:
        return None
    at = np.arange(first, last + 1, dtype=np.float64)
    smooth = uniform_filter1d(np.interp(at, station, offset), max(round(smoothing_m), 1), mode="nearest")
    return _Piece(drive, sign, max(first, 0), smooth[max(-first, 0) :])


def _lanes(line: RoadLine, pieces: Sequence[_Piece], config: ConditionConfig) -> list[Lane]:
    stated = [lane for lane in config.lanes if lane.road in (None, line.road)]
    if stated:
        first = min(p.first_m for p in pieces)
        last = max(p.first_m + len(p.offset_m) for p in pieces) - 1
        found = []
        for one in stated:
            sign = 1 if one.direction == "forward" else -1
            own = [p for p in pieces if p.sign == sign and abs(p.middle_m - one.offset_m) < one.width_m / 2]
            middle = np.full(last - first + 1, one.offset_m)
            passes = tuple(sorted({p.drive.pass_id for p in own}))
            found.append(Lane(line.road, one.name, sign, first, middle, one.width_m, "stated", passes))
        return sorted(found, key=lambda lane: lane.offset_m[0])
    groups: list[list[_Piece]] = []
    for piece in sorted(pieces, key=lambda p: (p.middle_m, p.drive.pass_id)):
        mate = next((g for g in groups if _same_lane(g[0], piece)), None)
        if mate is None:
            groups.append([piece])
        else:
            mate.append(piece)
    lanes = [_driven_lane(line, group, config) for group in groups]
    return _named(lanes, groups)


def _same_lane(one: _Piece, other: _Piece) -> bool:
    named = one.drive.lane == other.drive.lane or not (one.drive.lane and other.drive.lane)
    return one.sign == other.sign and named and abs(one.middle_m - other.middle_m) < _SAME_LANE_M


def _driven_lane(line: RoadLine, group: Sequence[_Piece], config: ConditionConfig) -> Lane:
    """Return the lane along the mean path of its drives."""
    first = min(p.first_m for p in group)
    end = min(max(p.first_m + len(p.offset_m) for p in group), len(line.nodes_m))
    total, count = np.zeros(end - first), np.zeros(end - first)
    for p in sorted(group, key=lambda p: (p.drive.pass_id, p.first_m)):
        part = slice(p.first_m - first, min(p.first_m - first + len(p.offset_m), end - first))
        total[part] += p.offset_m[: part.stop - part.start]
        count[part] += 1
    known = np.flatnonzero(count)
    middle = np.interp(np.arange(end - first), known, total[known] / count[known])
    passes = tuple(sorted({p.drive.pass_id for p in group}))
    return Lane(line.road, "", group[0].sign, first, middle, config.lane_width_m, "default", passes)


def _named(lanes: Sequence[Lane], groups: Sequence[Sequence[_Piece]]) -> list[Lane]:
    """Return lanes with the names of their passes; without names, numbered from the left."""
    stated = [next((p.drive.lane for p in g if p.drive.lane), "") for g in groups]
    names: list[str] = []
    for number, name in enumerate(stated, 1):
        wanted = name or str(number)
        while wanted in names:
            wanted += "b"
        names.append(wanted)
    return [replace(lane, name=name) for lane, name in zip(lanes, names, strict=True)]


def _directions(way: Float64) -> Float64:
    """Return (k, 2) unit vectors along nodes (k, 2), k ≥ 2, over some nodes on both sides."""
    index = np.arange(len(way))
    ahead = way[np.minimum(index + _HALF_TURN_M, len(way) - 1)] - way[np.maximum(index - _HALF_TURN_M, 0)]
    length = np.hypot(ahead[:, 0], ahead[:, 1])
    unit: Float64 = ahead / np.where(length > 0.0, length, 1.0)[:, None]
    return unit


def _runs(mask: Bool, least: int, bridge: int = 0) -> list[tuple[int, int]]:
    """Return start and end of runs of at least `least` set values; gaps of up to `bridge` values are bridged."""
    held = np.flatnonzero(mask)
    if not held.size:
        return []
    breaks = np.flatnonzero(np.diff(held) > bridge + 1)
    starts, ends = np.append(held[0], held[breaks + 1]), np.append(held[breaks], held[-1]) + 1
    return [(int(a), int(b)) for a, b in zip(starts, ends, strict=True) if b - a >= least]
