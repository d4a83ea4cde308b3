"""A network of cracks is split into parts: nets, and strokes along, across or diagonal to the lane.

1. *Branches*: pieces joined where nothing else meets (the border of a tile). Junctions a few cells apart are one.
2. *Nets*: branches that lie on closed polygons, without the bridges between such. A net that closes enough polygons
   and has enough junctions on its ground is an alligator crack; what hangs on it and lies in its hull belongs to it.
3. *Strokes*: where others meet, the two that go on most nearly straight are one, then the next two. So a crack keeps
   its type where side branches leave it.
4. *Types* are those of most of a stroke's length. Strokes of one type that meet are one part; what is shorter than a
   crack has to be goes with the longest part that it meets, and what is short and meets a net alone with that.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64

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
