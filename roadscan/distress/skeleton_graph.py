"""The cells of a skeleton as a graph: neighbours, short side branches, paths from node to node."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64

PRUNINGS = 2  # Passes of pruning.


@dataclass(frozen=True)
class SkeletonGraph:
    """Cells (n,) in order of row and column, and edges (m, 2) between neighbours, the first cell before the second.

    Cells that share a side are neighbours; cells that share a corner are, unless sides of another cell join them. So
    three cells in a corner are no loop.
    """

    row: Int64
    column: Int64
    edges: Int64

    @classmethod
    def of(cls, skeleton: Bool) -> SkeletonGraph:
        """Returns the graph of a grid of cells (rows, columns)."""
        row, column = np.nonzero(skeleton)
        number = np.full((skeleton.shape[0] + 1, skeleton.shape[1] + 2), -1)
        number[row, column + 1] = np.arange(row.size)
        east, north = number[row, column + 2], number[row + 1, column + 1]
        west = number[row, column]
        own = np.arange(row.size)
        pairs = [np.stack([own, other], axis=-1)[other >= 0] for other in (east, north)]
        for side, other in ((east, number[row + 1, column + 2]), (west, number[row + 1, column])):
            joined = (other >= 0) & (side < 0) & (north < 0)
            pairs.append(np.stack([own, other], axis=-1)[joined])
        return cls(row, column, np.concatenate(pairs))

    @property
    def degree(self) -> Int64:
        """Returns the number of neighbours (n,) of each cell."""
        return np.bincount(self.edges.ravel(), minlength=self.row.size)

    def neighbours(self) -> list[list[int]]:
        """Returns the neighbours of each cell, ascending."""
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        both = both[np.lexsort((both[:, 1], both[:, 0]))]
        cuts = np.searchsorted(both[:, 0], np.arange(self.row.size + 1)).tolist()
        beside = both[:, 1].tolist()
        return [beside[a:b] for a, b in itertools.pairwise(cuts)]

    def spurs(self, cells: int) -> list[int]:
        """Returns the cells of branches that end within `cells` of a junction; if all do, the longest branch stays."""
        beside = self.neighbours()
        at: dict[int, list[list[int]]] = {}
        for end in np.flatnonzero(self.degree == 1).tolist():
            path, before, here = [end], -1, end
            while len(path) <= cells and len(beside[here]) <= 2:
                onward = [k for k in beside[here] if k != before]
                if not onward:
                    break
                before, here = here, onward[0]
                path.append(here)
            if len(beside[here]) > 2:
                at.setdefault(here, []).append(path[:-1])
        found: list[int] = []
        for junction, paths in at.items():
            paths.sort(key=lambda path: (-len(path), path[0]))
            goes_on = len(beside[junction]) - len(paths) >= 2
            found += [k for path in paths[0 if goes_on else 1 :] for k in path]
        return found

    def loose_ends(self, doubtful: Bool, cells: int) -> list[int]:
        """Returns `doubtful` cells (n,) at ends of the skeleton, up to the first that is not doubtful or is a junction.

        At most `cells` cells are taken from each end.
        """
        beside = self.neighbours()
        found: list[int] = []
        for end in np.flatnonzero((self.degree <= 1) & doubtful).tolist():
            before, here = -1, end
            for _ in range(cells):
                if not doubtful[here] or len(beside[here]) > 2:
                    break
                found.append(here)
                onward = [k for k in beside[here] if k != before]
                if not onward:
                    break
                before, here = here, onward[0]
        return found

    def smoothed(self, place: Float64) -> Float64:
        """Returns positions (n, 2) moved halfway to the middle of both neighbours, where a cell has two."""
        total = np.zeros_like(place)
        np.add.at(total, self.edges[:, 0], place[self.edges[:, 1]])
        np.add.at(total, self.edges[:, 1], place[self.edges[:, 0]])
        return np.where((self.degree == 2)[:, None], 0.5 * place + 0.25 * total, place)

    def paths(self, own: Bool) -> Iterator[list[int]]:
        """Yields the paths (cells) from node to node over the edges (m,) that are `own`.

        A node is a cell with other than two neighbours, or one where these edges end.
        """
        mine = SkeletonGraph(self.row, self.column, self.edges[own])
        beside = mine.neighbours()
        is_node = (self.degree != 2) | (mine.degree != 2)
        walked: set[tuple[int, int]] = set()
        rings = np.flatnonzero(~is_node).tolist()
        for start in [*np.flatnonzero(is_node & (mine.degree > 0)).tolist(), *rings]:
            for second in beside[start]:
                if (start, second) in walked:
                    continue
                path = _walk(start, second, beside, is_node)
                walked.update(itertools.pairwise(path))
                walked.update(itertools.pairwise(path[::-1]))
                yield path


def trimmed(skeleton: Bool, doubtful: Bool, end_cells: int) -> Bool:
    """Returns a skeleton without its doubtful ends, at most so many cells of each; all are grids of cells."""
    cells = skeleton.copy()
    if doubtful.any():
        graph = SkeletonGraph.of(cells)
        loose = graph.loose_ends(doubtful[graph.row, graph.column], end_cells)
        cells[graph.row[loose], graph.column[loose]] = False
    return cells


def pruned(skeleton: Bool, spur_cells: int) -> SkeletonGraph:
    """Returns the graph of a skeleton without its spurs."""
    cells = skeleton.copy()
    graph = SkeletonGraph.of(cells)
    for _ in range(PRUNINGS):
        spurs = graph.spurs(spur_cells)
        cells[graph.row[spurs], graph.column[spurs]] = False
        graph = SkeletonGraph.of(cells)
    return graph


def _walk(start: int, second: int, beside: list[list[int]], is_node: Bool) -> list[int]:
    path = [start, second]
    while not is_node[path[-1]] and path[-1] != start:
        onward = [k for k in beside[path[-1]] if k != path[-2]]
        path.append(onward[0])
    return path
