"""Crack pieces of all tiles are joined to networks, and each network is split into cracks with figures and types.

Gaps between the ends of cracks are bridged where two ends face one another. A crack that is narrower than a cell is
lost where it runs between two: less than half of either's readings lie in it. Two free ends within `bridge_m` are
joined by a straight piece without depth or width if both point at one another, to 30° and a cell and a half; the
nearest are joined first, and each once.

A network is split into parts: nets, and strokes along, across or diagonal to the lane.

1. *Branches*: pieces joined where nothing else meets (the border of a tile). Junctions a few cells apart are one.
2. *Nets*: branches that lie on closed polygons, without the bridges between such. A net that closes enough polygons
   and has enough junctions on its ground is an alligator crack; what hangs on it and lies in its hull belongs to it.
3. *Strokes*: where others meet, the two that go on most nearly straight are one, then the next two. So a crack keeps
   its type where side branches leave it.
4. *Types* are those of most of a stroke's length. Strokes of one type that meet are one part; what is shorter than a
   crack has to be goes with the longest part that it meets, and what is short and meets a net alone with that.
"""

from __future__ import annotations

import cmath
import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.distress.cracks import CrackPiece
from roadscan.distress.settings import CrackJoining

NET: Final = 3
"""Type of a net; types 0, 1, 2 run along, across and diagonal to the lane."""
UNKNOWN: Final = 4  # Type of a stroke nowhere on which the lane's direction is known.

_FRINGE_M: Final = 0.5
"""Shorter parts (m) that meet nothing but a net belong to the net."""
_STRAIGHT_RAD: Final = math.radians(45.0)
"""Branches that turn by less than this at a junction are one stroke."""


@dataclass(frozen=True)
class Network:
    """Pieces of one network of cracks; arrays are (n, …)."""

    ends: Int64
    """(n, 2) numbers of the nodes at a piece's start and end; merged junctions share a number."""
    length_m: Float64
    outwards: Float64
    """(n, 2, 2) unit vectors that point out of a piece at its start and its end."""
    directions_m: Float64
    """(n, 3) lengths along, across and diagonal to the lane; 0 where its direction is not known."""

    def part(self, rows: Int64) -> Network:
        """Returns a subset of the pieces."""
        return Network(self.ends[rows], self.length_m[rows], self.outwards[rows], self.directions_m[rows])


def parts_of(
    whole: Network, is_net: Callable[[Int64], bool], within: Callable[[Int64, Int64], Bool], least_m: float
) -> list[tuple[int, Int64]]:
    """Returns the parts of a network, each with its type and its pieces, in the order of their first pieces.

    Parameters
    ----------
    is_net : whether pieces that close polygons are dense enough for a net.
    within : which of some pieces (second) lie on the ground of others (first).
    least_m : shorter parts go with others.
    """
    part = np.full(len(whole.ends), -1)
    kinds: list[int] = []
    for net in _closed(whole):
        if is_net(net):
            part[net] = len(kinds)
            kinds.append(NET)
    for number in range(len(kinds)):
        _take_in(whole, part, number, within)
    rest = np.flatnonzero(part < 0)
    if rest.size:
        _mark_strokes(whole, rest, part, kinds)
    _merge_short(whole, part, kinds, least_m)
    _merge_same(whole, part, kinds)
    numbers = np.unique(part)
    found = [(kinds[number], np.flatnonzero(part == number)) for number in numbers.tolist()]
    return sorted(found, key=lambda one: int(one[1][0]))


def _closed(whole: Network) -> Iterator[Int64]:
    """Yields the pieces of each connected set that lies on closed polygons, bridges left out."""
    kept = np.flatnonzero(~bridges(whole.ends))
    if kept.size:
        yield from grouped(kept, components(whole.ends[kept]))


def _take_in(whole: Network, part: Int64, number: int, within: Callable[[Int64, Int64], Bool]) -> None:
    """Add to a net the branches that meet it and lie on its ground."""
    closed = np.flatnonzero(part == number)
    while True:
        own = np.flatnonzero(part == number)
        near = (part < 0) & np.isin(whole.ends, whole.ends[own]).any(axis=1)
        rows = np.flatnonzero(near)
        rows = rows[within(closed, rows)] if rows.size else rows
        if not rows.size:
            return
        part[rows] = number


def _mark_strokes(whole: Network, rest: Int64, part: Int64, kinds: list[int]) -> None:
    """Number the strokes of the pieces `rest` in `part`, and append their types."""
    ends, outwards = whole.ends[rest], whole.outwards[rest]
    degree = np.bincount(whole.ends.ravel())
    pairs: list[tuple[int, int]] = []
    order = np.argsort(ends.ravel(), kind="stable")
    cuts = np.flatnonzero(np.diff(ends.ravel()[order])) + 1
    for meeting in np.split(order, cuts):
        node = int(ends.ravel()[meeting[0]])
        pairs += _pairs(meeting // 2, outwards[meeting // 2, meeting % 2], degree[node] == 2)
    joined = np.array(pairs, np.int64).reshape(-1, 2)
    stroke = united(joined, rest.size)
    for own in grouped(rest, stroke):
        part[own] = len(kinds)
        lengths = whole.directions_m[own].sum(axis=0)
        kinds.append(int(np.argmax(lengths)) if lengths.sum() > 0.0 else UNKNOWN)


def _pairs(pieces: Int64, outwards: Float64, only_two: bool) -> list[tuple[int, int]]:
    """Returns pairs of the pieces that meet at a node and continue one another, the straightest first."""
    count = len(pieces)
    if count == 2 and only_two:
        return [(int(pieces[0]), int(pieces[1]))]
    turn = [
        (float(np.arccos(np.clip(-outwards[a] @ outwards[b], -1.0, 1.0))), a, b)
        for a in range(count)
        for b in range(a + 1, count)
    ]
    taken: set[int] = set()
    found: list[tuple[int, int]] = []
    for angle, a, b in sorted(turn):
        if angle <= _STRAIGHT_RAD and not {a, b} & taken:
            taken |= {a, b}
            found.append((int(pieces[a]), int(pieces[b])))
    return found


def _merge_short(whole: Network, part: Int64, kinds: Sequence[int], least_m: float) -> None:
    """Merge short parts, the shortest first, into the longest part that each meets."""
    length: list[float] = np.bincount(part, whole.length_m, len(kinds)).tolist()
    nodes: list[set[int]] = [set() for _ in kinds]
    parts_at: dict[int, set[int]] = {}
    for number, ends in zip(part.tolist(), whole.ends.tolist(), strict=True):
        nodes[number].update(ends)
        for node in ends:
            parts_at.setdefault(node, set()).add(number)
    into = np.arange(len(kinds))
    limit = max(least_m, _FRINGE_M)
    waiting = [(length[k], k) for k in np.unique(part).tolist() if kinds[k] != NET and length[k] < limit]
    heapq.heapify(waiting)
    while waiting:
        size, number = heapq.heappop(waiting)
        if into[number] != number or size != length[number]:
            continue  # merged already, or grown
        beside = sorted(set[int]().union(*(parts_at[node] for node in nodes[number])) - {number})
        if not beside or (size >= least_m and any(kinds[k] != NET for k in beside)):
            continue
        longest = max(beside, key=length.__getitem__)
        into[number] = longest
        length[longest] += size
        nodes[longest] |= nodes[number]
        for node in nodes[number]:
            parts_at[node] = parts_at[node] - {number} | {longest}
        for k in beside:  # grown, or with other neighbours by now
            if kinds[k] != NET and length[k] < limit:
                heapq.heappush(waiting, (length[k], k))
    while (into != into[into]).any():
        into = into[into]
    part[:] = into[part]


def _merge_same(whole: Network, part: Int64, kinds: Sequence[int]) -> None:
    """Merge parts of one type that meet."""
    kind = np.array(kinds)[part]
    for one in np.unique(kind).tolist():
        rows = np.flatnonzero(kind == one)
        first: dict[int, int] = {}
        pairs = [
            (first.setdefault(node, int(part[row])), int(part[row]))
            for row in rows.tolist()
            for node in whole.ends[row].tolist()
        ]
        together = united(np.array(pairs, np.int64).reshape(-1, 2), len(kinds))
        lowest = np.full(len(kinds), len(kinds))
        np.minimum.at(lowest, together, np.arange(len(kinds)))
        part[rows] = lowest[together[part[rows]]]


def components(ends: Int64) -> Int64:
    """Returns the number (n,) of the connected set of each edge (n, 2) between nodes."""
    _, local = np.unique(ends, return_inverse=True)
    local = local.reshape(ends.shape)
    return united(local, int(local.max()) + 1)[local[:, 0]] if len(ends) else np.zeros(0, np.int64)


def united(pairs: Int64, count: int) -> Int64:
    """Returns the number (count,) of each element's connected set; pairs (n, 2) connect two elements."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def grouped(rows: Int64, number: Int64) -> list[Int64]:
    """Returns the rows of each number (n,)."""
    order = np.argsort(number, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(number[order])) + 1)


def bridges(ends: Int64) -> Bool:
    """Returns a mask of the edges (n, 2) between nodes that lie on no closed polygon.

    Tarjan (1974), "A note on finding the bridges of a graph", Information Processing Letters 2, 160-161. Several edges
    between the same nodes, and one from a node to itself, close polygons.
    """
    nodes, local = np.unique(ends, return_inverse=True)
    beside: list[list[tuple[int, int]]] = [[] for _ in range(nodes.size)]
    pairs: Int64 = np.asarray(local, np.int64).reshape(-1, 2)
    for edge, (a, b) in enumerate(zip(pairs[:, 0].tolist(), pairs[:, 1].tolist(), strict=True)):
        beside[a].append((b, edge))
        beside[b].append((a, edge))
    seen, low = [-1] * int(nodes.size), [0] * int(nodes.size)
    is_bridge: Bool = np.zeros(ends.shape[0], np.bool_)
    clock = 0
    for root in range(int(nodes.size)):
        if seen[root] >= 0:
            continue
        seen[root] = low[root] = clock
        clock += 1
        stack = [(root, -1, iter(beside[root]))]
        while stack:
            node, came_by, onward = stack[-1]
            for other, edge in onward:
                if edge == came_by:
                    continue
                if seen[other] < 0:
                    seen[other] = low[other] = clock
                    clock += 1
                    stack.append((other, edge, iter(beside[other])))
                    break
                low[node] = min(low[node], seen[other])
            else:
                stack.pop()
                if stack:
                    before = stack[-1][0]
                    low[before] = min(low[before], low[node])
                    is_bridge[came_by] = low[node] > seen[before]
    return is_bridge


_ASIDE: Final = math.tan(math.radians(30.0))  # Tangent of the most that an end may point past the other.
_ASIDE_CELLS: Final = 1.5  # Distance (cells) that is allowed aside on top of that angle.
_OPPOSITE: Final = -0.5
"""Greatest cosine of the angle between the directions out of two ends."""
_CHORD_M: Final = 0.1  # Directions, and those of ends, are those of chords about this long (m).


def outwards(line_m: Float64) -> Float64:
    """Returns the unit vector (2,) that points out of a line (n, 2) at its end, along a chord of about 0.1 m."""
    along = np.cumsum(np.hypot(*np.diff(line_m[::-1], axis=0).T))
    back = line_m[-1] - line_m[-2 - min(int(np.searchsorted(along, _CHORD_M)), len(line_m) - 2)]
    size = float(np.hypot(*back))
    return np.asarray(back / size) if size > 0.0 else np.zeros(2)


def bridges_of(pieces: Sequence[CrackPiece], bridge_m: float, cell_m: float) -> list[CrackPiece]:
    """Returns pieces that join free ends of other pieces; the order of `pieces` does not matter."""
    from scipy.spatial import cKDTree

    met: dict[tuple[int, int], int] = {}
    for name in (name for one in pieces for name in (one.start, one.end)):
        met[name] = met.get(name, 0) + 1
    free = sorted(
        (name, tuple(line[-1].tolist()), tuple(outwards(line).tolist()))
        for one in pieces
        for name, line in ((one.start, one.line_m[::-1]), (one.end, one.line_m))
        if met[name] == 1
    )
    if len(free) < 2 or bridge_m <= 0.0:
        return []
    place, out = (np.array([end[k] for end in free], np.float64) for k in (1, 2))
    first, second = cKDTree(place).query_pairs(bridge_m, output_type="ndarray").T
    gap = place[second] - place[first]
    size = np.hypot(*gap.T)
    facing = (out[first] * out[second]).sum(axis=1) <= _OPPOSITE
    for here, way in ((out[first], gap), (out[second], -gap)):
        along, aside = (here * way).sum(axis=1), np.abs(here[:, 0] * way[:, 1] - here[:, 1] * way[:, 0])
        facing &= (along > 0.0) & (aside <= _ASIDE * along + _ASIDE_CELLS * cell_m)
    found: list[CrackPiece] = []
    taken: set[int] = set()
    for k in np.lexsort((second, first, size)).tolist():
        a, b = int(first[k]), int(second[k])
        if facing[k] and not {a, b} & taken:
            taken |= {a, b}
            length = float(size[k])
            found.append(CrackPiece(place[[a, b]], free[a][0], free[b][0], length, 0.0, 0.0, 0.0, 0.0, 0.0))
    return found


CrackType = Literal["longitudinal", "transverse", "diagonal", "alligator", "unknown"]

_KINDS: Final[tuple[CrackType, ...]] = ("longitudinal", "transverse", "diagonal", "alligator", "unknown")
"""Names of the types, by the numbers of ``crack_parts``."""
_BESIDE_NET_M = 0.25
"""A branch that meets a net and has its middle within this distance (m) of the net's hull belongs to the net."""
_LEAST_SHARE = 0.6
"""A candidate with the section of a crack over a smaller share of its length, gaps left out, is an edge or pits."""
LEAST_SEEN: Final = 0.8
"""Where a crack's middle has a smaller share of the readings than the ground beside it, its bottom was not seen."""
_NARROW_CELLS, _WIDE_CELLS = 0.8, 1.6
"""Widths at which a crack shows least of its bottom, and all of it."""
_SIGMA_NARROW, _SIGMA_WIDE = 0.2, 0.05
"""Standard deviations of depths at these widths, as shares of the depth."""
_SIGMA_READING = 0.1
"""Standard deviation of the depth, as a share, with one reading a cell; it falls with the root of their number."""
_SIGMA_M = 0.0005
"""Standard deviation of a depth from noise and texture (m)."""
_ONE_NODE_CELLS = 4.0
"""Junctions closer than this (cells) are one: thinning makes two of a crossing."""


@dataclass(frozen=True)
class Crack:
    """A crack: a part of a network of one type, with its branches."""

    network: int
    """Number of its network, from 1; cracks that meet have the same number."""
    kind: CrackType
    length_m: float
    """Along all branches (m)."""
    width_mean_m: float
    """At half the depth, mean over the length (m); NaN where it is known nowhere."""
    width_max_m: float
    depth_mean_m: float
    depth_max_m: float
    seen_share: float
    """Readings in its middle over those beside it; 1 where readings are not counted."""
    sigma_depth_mean_m: float
    """NaN where the bottom was not seen."""
    area_m2: float
    """Length times width (m²)."""
    covered_m2: float
    """Convex hull of its line (m²)."""
    junctions: int
    """Places on it where three or more branches of any type meet."""
    ends: int
    """Number of its free ends."""
    measured_share: float
    """Share of the length that has the cross-section of a crack."""
    polygons: int
    """Number of closed polygons that it forms alone."""
    azimuth_deg: float
    """Mean direction, clockwise from map north, 0 to 180 (degrees)."""
    lane_angle_deg: float
    """Angle between that direction and the lane, 0 to 90 (degrees); NaN where the lane's direction is known nowhere."""
    longitudinal_m: float
    """Length within `lane_angle_deg` of the lane's direction (m)."""
    transverse_m: float
    diagonal_m: float
    line: Any
    """shapely MultiLineString on the map (m)."""
    pieces: Int64
    """Indices of the pieces that it consists of, without those that bridge gaps."""


def join_cracks(
    pieces: Sequence[CrackPiece], lane_azimuth_rad: npt.ArrayLike, cell_m: float, config: CrackJoining
) -> list[Crack]:
    """Returns cracks that are long and deep enough, each a part of a network with one type, from south to north.

    Parameters
    ----------
    pieces : of all tiles; their order does not matter but for the last bit of sums.
    lane_azimuth_rad : direction of the lane, clockwise from map north: one for all pieces or one for each (n,); NaN
        where it is not known.
    """
    if not pieces:
        return []
    azimuth = np.broadcast_to(np.asarray(lane_azimuth_rad, np.float64), (len(pieces),))
    seen, bridges = len(pieces), bridges_of(pieces, config.bridge_m, cell_m)
    beside = {name: k for k, one in enumerate(pieces) for name in (one.start, one.end)}
    azimuth = np.concatenate([azimuth, azimuth[[beside[one.start] for one in bridges]]])
    pieces = [*pieces, *bridges]
    names = sorted({node for one in pieces for node in (one.start, one.end)})
    number = {name: k for k, name in enumerate(names)}
    ends = np.array([[number[one.start], number[one.end]] for one in pieces])
    nodes = _Nodes.of(ends, np.array([p.length_m for p in pieces]), len(names), cell_m)
    turned = _Turned.of(pieces, azimuth, config)
    bridged_m = np.array([0.0] * seen + [one.length_m for one in bridges])
    networks = grouped(np.arange(len(pieces)), components(ends))
    whole = [
        own for own in networks if _is_crack([pieces[k] for k in own[own < seen].tolist()], bridged_m[own], config)
    ]
    parted = [_parts(own, pieces, nodes, turned, config) for own in whole]
    found = [deep for parts in parted if (deep := [c for c in parts if not c.depth_mean_m < config.min_depth_m])]
    found.sort(key=lambda parts: min(c.line.bounds[1::-1] for c in parts))
    numbered = [
        replace(c, network=k, pieces=c.pieces[c.pieces < seen]) for k, parts in enumerate(found, start=1) for c in parts
    ]
    return sorted(numbered, key=lambda c: c.line.bounds[1::-1])


def _is_crack(network: Sequence[CrackPiece], bridged_m: Float64, config: CrackJoining) -> bool:
    """Returns whether pieces are a crack, given the total length of the gaps between them (m)."""
    length, measured = sum(p.length_m for p in network), sum(p.measured_m for p in network)
    long = length + float(bridged_m.sum()) >= config.min_length_m
    return long and measured > 0.0 and measured >= _LEAST_SHARE * length


@dataclass(frozen=True)
class _Nodes:
    """Nodes at which pieces end; junctions closer than a few cells are one node."""

    ends: Int64
    """(n, 2) node numbers of each piece's ends."""
    apart: Int64
    """(n, 2) the same before close junctions are merged."""
    degree: Int64
    """Number of ends that meet at a node, without pieces inside the node."""
    cell_m: float

    @classmethod
    def of(cls, ends: Int64, length_m: Float64, nodes: int, cell_m: float) -> _Nodes:
        degree = np.bincount(ends.ravel(), minlength=nodes)
        inner = (length_m < _ONE_NODE_CELLS * cell_m) & (degree[ends] >= 3).all(axis=1)
        merged = united(ends[inner], nodes)
        return cls(merged[ends], ends, np.bincount(merged[ends[~inner]].ravel(), minlength=nodes), cell_m)

    def figures(self, own: Int64) -> tuple[int, int, int]:
        """Returns the junctions and free ends on some pieces, and the number of polygons that they close."""
        nodes = np.unique(self.ends[own])
        degree = self.degree[nodes]
        apart = self.apart[own]
        polygons = own.size - np.unique(apart).size + np.unique(components(apart)).size
        return int((degree >= 3).sum()), int((degree == 1).sum()), polygons


@dataclass(frozen=True)
class _Turned:
    """Directions of pieces (n,)."""

    turning: npt.NDArray[np.complex128]
    """Sum of the lengths of its chords, each with twice its azimuth."""
    to_lane: npt.NDArray[np.complex128]
    """The same with twice the angle to the lane; 0 where it is not known."""
    parts_m: Float64
    """(n, 3) lengths along, across and diagonal to the lane; 0 where its direction is not known."""

    @classmethod
    def of(cls, pieces: Sequence[CrackPiece], azimuth: Float64, config: CrackJoining) -> _Turned:
        rows = [_directions(p, lane, config) for p, lane in zip(pieces, azimuth.tolist(), strict=True)]
        turning, to_lane, parts = (np.array(column) for column in zip(*rows, strict=True))
        return cls(turning, to_lane, parts)


def _parts(
    own: Int64, pieces: Sequence[CrackPiece], nodes: _Nodes, turned: _Turned, config: CrackJoining
) -> list[Crack]:
    """Returns the cracks of a network."""
    lines = [pieces[k].line_m for k in own.tolist()]
    shapes = np.array([shapely.LineString(line) for line in lines], object)
    out = np.array([[outwards(line[::-1]), outwards(line)] for line in lines])
    length = np.array([pieces[k].length_m for k in own.tolist()])
    whole = Network(nodes.ends[own], length, out, turned.parts_m[own])

    def is_net(rows: Int64) -> bool:
        junctions, _, polygons = nodes.figures(own[rows])
        covered = shapely.convex_hull(shapely.multilinestrings(shapes[rows])).area
        return polygons >= config.alligator_polygons and junctions >= config.alligator_nodes_per_m2 * covered

    def within(net: Int64, rows: Int64) -> npt.NDArray[np.bool_]:
        ground = shapely.buffer(shapely.convex_hull(shapely.multilinestrings(shapes[net])), _BESIDE_NET_M)
        middle = np.array([pieces[k].middle_m for k in own[rows].tolist()])
        return np.asarray(shapely.intersects_xy(ground, *middle.T))

    found = parts_of(whole, is_net, within, config.min_length_m)
    return [_crack(own[rows], _KINDS[kind], pieces, nodes, turned) for kind, rows in found]


def _crack(own: Int64, kind: CrackType, pieces: Sequence[CrackPiece], nodes: _Nodes, turned: _Turned) -> Crack:
    mine = [pieces[k] for k in own.tolist()]
    length, measured = sum(p.length_m for p in mine), sum(p.measured_m for p in mine)
    width_sum, depth_sum = sum(p.width_sum_m2 for p in mine), sum(p.depth_sum_m2 for p in mine)
    width, depth = (total / measured if measured > 0 else math.nan for total in (width_sum, depth_sum))
    beside = sum(p.beside_sum_m for p in mine)
    seen = sum(p.seen_sum_m for p in mine) / beside if beside > 0.0 else 1.0
    line = shapely.line_merge(shapely.multilinestrings([shapely.LineString(p.line_m) for p in mine]))
    line = line if line.geom_type == "MultiLineString" else shapely.multilinestrings([line])
    parts = turned.parts_m[own].sum(axis=0)
    junctions, ends, polygons = nodes.figures(own)
    return Crack(
        network=0,
        kind=kind,
        length_m=length,
        width_mean_m=width,
        width_max_m=max(p.width_max_m for p in mine),
        depth_mean_m=depth,
        depth_max_m=max(p.depth_max_m for p in mine),
        seen_share=seen,
        sigma_depth_mean_m=depth_sigma_m(
            depth, width / nodes.cell_m, seen, beside / measured if beside > 0.0 else math.inf
        ),
        area_m2=width_sum * (length / measured) if measured > 0 else math.nan,
        covered_m2=float(shapely.convex_hull(line).area),
        junctions=junctions,
        ends=ends,
        measured_share=measured / length if length > 0 else 0.0,
        polygons=polygons,
        azimuth_deg=math.degrees(np.angle(turned.turning[own].sum()) / 2) % 180.0,
        lane_angle_deg=abs(math.degrees(np.angle(turned.to_lane[own].sum()) / 2)) if parts.any() else math.nan,
        longitudinal_m=float(parts[0]),
        transverse_m=float(parts[1]),
        diagonal_m=float(parts[2]),
        line=line,
        pieces=own,
    )


def depth_sigma_m(depth_m: float, width_cells: float, seen_share: float, readings: float) -> float:
    """Returns the standard deviation of a crack's mean depth (m); NaN where its bottom was not seen.

    width_cells : its width at half the depth. A narrow crack shows more of its walls than of its bottom.
    seen_share : readings in its middle over those beside it.
    readings : of a cell beside it; infinite where readings are not counted.
    """
    if not seen_share >= LEAST_SEEN:
        return math.nan
    narrow = min(max((_WIDE_CELLS - width_cells) / (_WIDE_CELLS - _NARROW_CELLS), 0.0), 1.0)
    share = _SIGMA_WIDE + narrow * (_SIGMA_NARROW - _SIGMA_WIDE)
    return math.hypot(share * depth_m, _SIGMA_READING * depth_m / math.sqrt(readings), _SIGMA_M)


def _directions(one: CrackPiece, lane: float, config: CrackJoining) -> tuple[complex, complex, list[float]]:
    """Returns the sums over the chords of a piece that :class:`_Turned` describes."""
    count = max(1, round(one.length_m / _CHORD_M))
    picked = one.line_m[np.unique(np.linspace(0, len(one.line_m) - 1, count + 1).round().astype(np.int64))]
    chord = np.diff(picked, axis=0)
    size = np.hypot(*chord.T)
    angle = np.arctan2(chord[:, 0], chord[:, 1])
    off = np.abs((angle - lane + np.pi / 2) % np.pi - np.pi / 2)
    limit = math.radians(config.lane_angle_deg)
    along, across = off <= limit, off >= np.pi / 2 - limit
    share = size * (one.length_m / max(size.sum(), 1e-12))
    known = 0.0 if math.isnan(lane) else 1.0
    parts = [known * float(share[own].sum()) for own in (along, across, ~along & ~across)]
    turning = complex((size * np.exp(2j * angle)).sum())
    return turning, turning * cmath.exp(-2j * lane) if known else 0j, parts
