"""Steps along the road of a scene: paths cut where no step is measurable, and bridged where it is hidden or lowered."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.spatial

from roadscan.assets.edges import profiles
from roadscan.assets.edges.paths import paths_of
from roadscan.assets.edges.profiles import NODE_M, Heights, Nodes
from roadscan.assets.edges.raster import HeightRaster, raster_of
from roadscan.assets.edges.steps import step_places
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64

Mask = npt.NDArray[np.bool_]


class EdgeSettings(NamedTuple):
    """What makes a path of steps an edge. One setting for all data; a judge tells which edges are kerbs."""

    least_step_m: float = 0.015
    greatest_step_m: float = 0.28
    """Higher steps are walls."""
    seen_low: float = 0.6
    """Least share of the lower side that is seen: elsewhere, rings of a lidar look like steps."""
    seen_high_m: float = 0.25
    covered: float = 0.35
    """Least share of a node's window along the edge that is seen on both sides."""
    ratio: float = 2.5
    """Least ratio of a step to the scatter of its sides."""
    least_part_m: float = 1.0
    """Shorter parts of a path are left out."""
    least_length_m: float = 1.5
    """Least seen length of an edge, all its parts together."""
    least_evidence: float = 5.0
    """Least evidence (σ · m) of all parts of an edge."""
    bridge_m: float = 7.0
    """Longest gap between two edges in one line: a car, a driveway."""
    bridge_offset_m: float = 0.25
    """Farthest that one edge may lie beside the other's line, plus 0.04 m a metre of the gap."""
    bridge_bend_cosine: float = 0.94


class Edge(NamedTuple):
    """A line of steps of one scene; the higher side lies to the right of its direction."""

    nodes: Nodes
    seen: Mask
    """(n,) nodes whose step was measured; the others bridge hidden parts."""
    evidence: float
    """Evidence (σ · m) of its places."""
    probability: Float64 | None = None
    """(n,) of a kerb at each node; None where it was not judged."""


DEFAULT: Final = EdgeSettings()


@once_a_scene
def edges_of(scene: Scene) -> list[Edge]:
    """Returns the edges in the window of a scene, the best seen first."""
    raster, returns = raster_of(scene), scene.returns
    ground = [column[raster.used] for column in (returns.x_m, returns.y_m, returns.height_m)]
    return found_edges(raster, profiles.sorted_heights(*ground))


def edges_of_raster(raster: HeightRaster) -> list[Edge]:
    """Returns the edges of a raster of cells alone: each cell counts as one height at its middle."""
    row, column = np.nonzero(raster.count > 0)
    x = raster.x_min_m + (column.astype(np.float64) + 0.5) * raster.cell_m
    y = raster.y_min_m + (row.astype(np.float64) + 0.5) * raster.cell_m
    return found_edges(raster, profiles.sorted_heights(x, y, raster.height_m[row, column]))


def found_edges(raster: HeightRaster, heights: Heights, settings: EdgeSettings = DEFAULT) -> list[Edge]:
    """Returns the edges of a raster, with heights from which their places and steps are measured."""
    if not (raster.count > 0).any():
        return []
    slopes = raster.slopes
    parts: list[Edge] = []
    for chain in paths_of(step_places(raster)):
        nodes = profiles.nodes_of(profiles.chain_line(chain), heights, raster, slopes)
        parts += _told(nodes, chain.evidence, settings)
    return _bridged(parts, heights, raster, slopes, settings)


def _told(nodes: Nodes, evidence: float, settings: EdgeSettings) -> list[Edge]:
    """Returns runs of nodes with a measurable step; up to two nodes without are left inside a run."""
    known = np.isfinite(nodes.sigma_step_m)
    low, high, scatter = (_running(c, known) for c in (nodes.seen_low, nodes.seen_high_m, nodes.scatter_m))
    good = known & (nodes.step_m >= settings.least_step_m) & (low >= settings.seen_low)
    good &= (high >= settings.seen_high_m) & (_running(nodes.step_m, known) >= settings.ratio * scatter)
    good &= _running(nodes.step_m, known) <= settings.greatest_step_m
    good &= nodes.covered >= settings.covered
    whole = scipy.ndimage.binary_closing(np.pad(good, 3), np.ones(5))[3:-3]
    number, count = scipy.ndimage.label(whole)
    edges = []
    for k in range(1, count + 1):
        rows = np.flatnonzero(number == k)
        if (len(rows) - 1) * NODE_M >= settings.least_part_m:
            edges.append(Edge(nodes.at(rows), good[rows], evidence * len(rows) / len(good)))
    return edges


def _running(values: Float64, known: Mask) -> Float64:
    """Returns the median (n,) of five known neighbours; 0 where nothing is known."""
    at = np.flatnonzero(known)
    if at.size == 0:
        return np.zeros_like(values)
    return np.asarray(np.interp(np.arange(len(values)), at, scipy.ndimage.median_filter(values[at], 5, mode="nearest")))


def _bridged(
    parts: list[Edge], heights: Heights, raster: HeightRaster, slopes: tuple[Float64, Float64], settings: EdgeSettings
) -> list[Edge]:
    """Returns parts joined over gaps, the shortest gaps first."""
    gaps = sorted(
        (gap, i, j)
        for i, j in _near_pairs(parts, settings.bridge_m)
        if (gap := _gap_m(parts[i].nodes, parts[j].nodes, settings)) is not None
    )
    after: dict[int, int] = {}
    before: dict[int, int] = {}
    for _, i, j in gaps:
        if i not in after and j not in before and not _leads_to(after, j, i):
            after[i], before[j] = j, i
    edges = []
    for i in range(len(parts)):
        if i in before:
            continue
        edge, at = parts[i], i
        while at in after:
            at = after[at]
            edge = _joined(edge, parts[at], heights, raster, slopes, settings)
        enough = edge.evidence >= settings.least_evidence
        if enough and float(edge.seen.sum() - 1) * NODE_M >= settings.least_length_m:
            edges.append(edge)
    return edges


def _near_pairs(parts: list[Edge], reach_m: float) -> list[tuple[int, int]]:
    """Returns pairs of parts of which the first ends near where the second begins."""
    if not parts:
        return []
    ends = np.array([[p.nodes.x_m[-1], p.nodes.y_m[-1]] for p in parts])
    begins = np.array([[p.nodes.x_m[0], p.nodes.y_m[0]] for p in parts])
    near = scipy.spatial.cKDTree(begins).query_ball_point(ends, reach_m + 1e-6)
    return [(i, j) for i, some in enumerate(near) for j in some if i != j]


def _leads_to(after: dict[int, int], start: int, end: int) -> bool:
    while start in after:
        start = after[start]
        if start == end:
            return True
    return start == end


def _gap_m(a: Nodes, b: Nodes, settings: EdgeSettings) -> float | None:
    """Returns the distance from the end of an edge to the beginning of another that continues it."""
    ex, ey = b.x_m[0] - a.x_m[-1], b.y_m[0] - a.y_m[-1]
    gap = float(np.hypot(ex, ey))
    if not 0.0 < gap <= settings.bridge_m:
        return None
    ends = []
    for nodes, rows in ((a, slice(-4, None)), (b, slice(0, 4))):
        ux, uy = nodes.heading_x[rows].mean(), nodes.heading_y[rows].mean()
        length = max(float(np.hypot(ux, uy)), 1e-9)
        ends.append((ux / length, uy / length))
    (ax, ay), (bx, by) = ends
    aside = max(abs(ex * ay - ey * ax), abs(ex * by - ey * bx))
    straight = ax * bx + ay * by >= settings.bridge_bend_cosine and ex * ax + ey * ay > 0.0
    return gap if straight and aside <= settings.bridge_offset_m + 0.04 * gap else None


def _joined(
    a: Edge, b: Edge, heights: Heights, raster: HeightRaster, slopes: tuple[Float64, Float64], settings: EdgeSettings
) -> Edge:
    """Returns one edge of two and the straight way between them, whose steps are measured where they are seen."""
    ends = np.array([[a.nodes.x_m[-1], a.nodes.y_m[-1]], [b.nodes.x_m[0], b.nodes.y_m[0]]])
    pieces = max(round(float(np.hypot(*(ends[1] - ends[0]))) / NODE_M), 1)
    share = (np.arange(1, pieces) / pieces)[:, None]
    between = ends[0] + share * (ends[1] - ends[0])
    if len(between) == 0:
        return Edge(_chained(a.nodes, b.nodes), np.concatenate([a.seen, b.seen]), a.evidence + b.evidence)
    line = np.concatenate([ends[:1], between, ends[1:]])
    measured = profiles.nodes_of(line, heights, raster, slopes).at(slice(1, -1))
    seen = np.isfinite(measured.sigma_step_m) & (measured.seen_low >= settings.seen_low)
    seen &= (measured.step_m > 2.0 * measured.sigma_step_m) & (measured.covered >= settings.covered)
    seen &= np.hypot(measured.x_m - between[:, 0], measured.y_m - between[:, 1]) <= settings.bridge_offset_m
    top = np.linspace(a.nodes.top_m[-1], b.nodes.top_m[0], pieces + 1)[1:-1]
    flat = np.full(pieces - 1, np.nan)
    hidden = Nodes(
        between[:, 0], between[:, 1], top, measured.heading_x, measured.heading_y, flat, flat, flat, flat,
        np.zeros(pieces - 1), flat, flat, np.full(pieces - 1, 0.05 + 0.02 * pieces * NODE_M),
        np.zeros(pieces - 1),
    )  # fmt: skip
    mixed = Nodes(*(np.where(seen, m, h) for m, h in zip(measured, hidden, strict=True)))
    nodes = _chained(_chained(a.nodes, mixed), b.nodes)
    return Edge(nodes, np.concatenate([a.seen, seen, b.seen]), a.evidence + b.evidence)


def _chained(a: Nodes, b: Nodes) -> Nodes:
    return Nodes(*(np.concatenate([p, q]) for p, q in zip(a, b, strict=True)))
