"""One road edge where drives on both sides of a road, or there and back, found the same one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.spatial

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of

_SAME_EDGE_M: Final = 0.3
"""Lines this near to one another (m) are one edge if the road lies on the same side of both …"""
_SAME_LEVEL_M: Final = 1.0
"""… and they are no farther apart in height (m): those of a bridge and of the road below are two."""
_NEAR_M: Final = 0.4
"""Nodes of two such lines are this near (m) at the most: they are half a metre apart along each."""
FEWEST: Final = 5
"""Nodes along which lines lie on one another, and of what is left of one: lines that cross are two edges."""
_GAP: Final = 3
"""Nodes that follow one another are at the most so many apart."""


class FoundEdge(NamedTuple):
    """An edge along stations (n,) that follow one another."""

    nodes: Float64
    """(n, columns) easting, northing, height and others."""
    rows: Int64
    """(n,) numbers of its stations."""
    returns: Int64
    """(n,) returns that saw it at each."""
    out: Float64
    """(n, 2) unit vectors from the drive to the edge."""
    offset_m: Float64
    """(n,) distance from the drive."""

    def at(self, rows: Int64) -> FoundEdge:
        """Returns a part."""
        return FoundEdge._make(column[rows] for column in self)


class _Both(NamedTuple):
    """Nodes along which two edges lie on one another; the first is nearer to its drive."""

    kept: int
    kept_nodes: Int64
    left: int
    left_nodes: Int64


def each_once(edges: Sequence[FoundEdge]) -> list[FoundEdge]:
    """Returns edges without those parts that another one, nearer to its drive, repeats; a part may be split.

    The order of the edges, and how squares are cut, change nothing.
    """
    edges = sorted(edges, key=lambda edge: tuple(edge.nodes[0, :2]))
    free = [np.ones(len(edge.rows), np.bool_) for edge in edges]
    for both in _on_one_another(edges):
        # What is gone already takes nothing away: so one of three that lie on one another stays.
        if 2 * np.count_nonzero(free[both.kept][both.kept_nodes]) > len(both.kept_nodes):
            left = np.unique(both.left_nodes)
            for nodes in np.split(left, np.flatnonzero(np.diff(left) > _GAP) + 1):
                free[both.left][_inner(nodes, free[both.left])] = False
    return [edge.at(rows) for edge, some in zip(edges, free, strict=True) for rows in _runs(some)]


def _inner(nodes: Int64, free: Bool) -> slice:
    """Returns the nodes from the first to the last; where the edge goes on, that one stays, so that no gap is left."""
    first, last = int(nodes.min()), int(nodes.max())
    return slice(first + (first > 0 and bool(free[first - 1])), last + (last + 1 == free.size or not free[last + 1]))


def _runs(free: Bool) -> Iterator[Int64]:
    for first, end in runs_of(free):
        if end - first >= FEWEST:
            yield np.arange(first, end)


def _on_one_another(edges: Sequence[FoundEdge]) -> list[_Both]:
    """Returns where edges lie on one another, first where their drives are the most unlike in distance."""
    if len(edges) < 2:
        return []
    sizes = [len(edge.rows) for edge in edges]
    line = np.repeat(np.arange(len(edges)), sizes)
    node = np.arange(line.size) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    place = np.concatenate([edge.nodes[:, :3] for edge in edges])
    out = np.concatenate([edge.out for edge in edges])
    offset = np.concatenate([edge.offset_m for edge in edges])
    a, b = scipy.spatial.cKDTree(place[:, :2]).query_pairs(_NEAR_M, output_type="ndarray").T
    apart = place[b] - place[a]
    across = np.abs((apart[:, :2] * out[a]).sum(axis=1))
    same = (line[a] != line[b]) & (across <= _SAME_EDGE_M) & (np.abs(apart[:, 2]) <= _SAME_LEVEL_M)
    same &= (out[a] * out[b]).sum(axis=1) > 0.0  # both sides of a thin barrier are two edges
    a, b = np.sort(np.stack([a[same], b[same]]), axis=0)
    order = np.lexsort((node[b], node[a], line[b], line[a]))
    a, b = a[order], b[order]
    goes_on = (np.diff(node[a]) <= _GAP) & (np.diff(line[a]) == 0) & (np.diff(line[b]) == 0)
    begins = np.flatnonzero(~goes_on) + 1
    found = []
    for some, others in zip(np.split(a, begins), np.split(b, begins), strict=True):
        if min(np.unique(some).size, np.unique(others).size) >= FEWEST:
            farther = float(offset[others].mean() - offset[some].mean())
            kept, left = (some, others) if farther >= 0.0 else (others, some)
            both = _Both(int(line[kept[0]]), node[kept], int(line[left[0]]), node[left])
            found.append((-abs(farther), int(some[0]), int(others[0]), both))
    return [both for *_, both in sorted(found, key=lambda one: one[:3])]
