"""Steps along the road of a scene as paths, the features of their nodes, and which of them are kerbs.

A judge tells kerbs by features of what is seen around the nodes, which depend on no scanner and no site.
Heights of steps, their scatter, bends, ranges, densities and distances from the drive tell streets and scanners apart,
not kerbs; without them it judges unseen ones better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.spatial

from roadscan.assets import classes
from roadscan.assets.edges import profiles
from roadscan.assets.edges.profiles import NODE_M, Heights, Nodes, paths_of, runs_along
from roadscan.assets.edges.rings import share_within_rings
from roadscan.assets.edges.steps import LEAST_STEP_M, HeightRaster, raster_of, step_places
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.columns import mark_corridor
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.regions import on_thin
from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import without_holes
from roadscan.core.extras import cv2


class EdgeSettings(NamedTuple):
    """What makes a path of steps an edge. One setting for all data; a judge tells which edges are kerbs."""

    least_step_m: float = LEAST_STEP_M
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
    seen: Bool
    """(n,) nodes whose step was measured; the others bridge hidden parts."""
    evidence: Float64
    """(n,) evidence (σ · m) of the places about each node."""
    probability: Float64 | None = None
    """(n,) of a kerb at each node; None where it was not judged."""
    lap: int = 0
    """Number of nodes of a lap of a closed line, of which there are three; 0: it is open."""

    def at(self, rows: npt.NDArray[np.int64]) -> Edge:
        """Returns the part with some of its nodes, which follow one another."""
        probability = None if self.probability is None else self.probability[rows]
        return Edge(self.nodes.at(rows), self.seen[rows], self.evidence[rows], probability)

    def once(self) -> Edge:
        """Returns it with one lap, where it is closed: its first and last node are the westernmost."""
        if not self.lap:
            return self
        lap = np.arange(self.lap, 2 * self.lap)
        lap = np.roll(lap, -np.lexsort((self.nodes.y_m[lap], self.nodes.x_m[lap]))[0])
        return self.at(np.append(lap, lap[:1]))


DEFAULT: Final = EdgeSettings()


@once_a_scene
def edges_of(scene: Scene) -> list[Edge]:
    """Returns the edges in the window of a scene, the best seen first; closed ones with three laps."""
    raster, returns = raster_of(scene), scene.returns
    ground = [column[raster.used] for column in (returns.x_m, returns.y_m, returns.height_m)]
    return found_edges(raster, profiles.sorted_heights(*ground))


def edges_of_raster(raster: HeightRaster) -> list[Edge]:
    """Returns the edges of a raster of cells alone: each cell counts as one height at its middle."""
    row, column = np.nonzero(raster.count > 0)
    x = raster.x_min_m + (column.astype(np.float64) + 0.5) * raster.cell_m
    y = raster.y_min_m + (row.astype(np.float64) + 0.5) * raster.cell_m
    return [edge.once() for edge in found_edges(raster, profiles.sorted_heights(x, y, raster.height_m[row, column]))]


def found_edges(raster: HeightRaster, heights: Heights, settings: EdgeSettings = DEFAULT) -> list[Edge]:
    """Returns the edges of a raster, with heights from which their places and steps are measured."""
    if not (raster.count > 0).any():
        return []
    slopes = raster.slopes
    parts: list[Edge] = []
    for chain in paths_of(step_places(raster)):
        line, lap = profiles.chain_line(chain)
        near, evidence = profiles.places_along(line, chain)
        parts += _measured_runs(profiles.nodes_of(line, heights, raster, slopes, near), evidence, lap, settings)
    return _bridged(parts, heights, raster, slopes, settings)


def _measured_runs(nodes: Nodes, evidence: Float64, lap: int, settings: EdgeSettings) -> list[Edge]:
    """Returns runs of nodes with a measurable step; up to four nodes without are left inside a run."""
    known = np.isfinite(nodes.sigma_step_m)
    low, high, scatter = (_medians_of_five(c, known) for c in (nodes.seen_low, nodes.seen_high_m, nodes.scatter_m))
    good = known & (nodes.step_m >= settings.least_step_m) & (low >= settings.seen_low)
    good &= (high >= settings.seen_high_m) & (_medians_of_five(nodes.step_m, known) >= settings.ratio * scatter)
    good &= _medians_of_five(nodes.step_m, known) <= settings.greatest_step_m
    good &= nodes.covered >= settings.covered
    whole = without_holes(good, 4)
    return [
        Edge(nodes.at(rows), good[rows], evidence[rows], lap=lap if len(rows) == len(good) else 0)
        for rows in runs_along(whole, lap)
        if (len(rows) - 1) * NODE_M >= settings.least_part_m
    ]


def _medians_of_five(values: Float64, known: Bool) -> Float64:
    """Returns the median (n,) of five known neighbours; 0 where nothing is known."""
    at = np.flatnonzero(known)
    if at.size == 0:
        return np.zeros_like(values)
    return np.asarray(np.interp(np.arange(len(values)), at, scipy.ndimage.median_filter(values[at], 5, mode="nearest")))


def _bridged(
    parts: list[Edge], heights: Heights, raster: HeightRaster, slopes: tuple[Float64, Float64], settings: EdgeSettings
) -> list[Edge]:
    """Returns parts joined over gaps, the shortest gaps first; some are closed then."""
    gaps = sorted(
        (gap, i, j)
        for i, j in _near_pairs(parts, settings.bridge_m)
        if (gap := _gap_m(parts[i].nodes, parts[j].nodes, settings)) is not None
    )
    after: dict[int, int] = {}
    before: dict[int, int] = {}
    for _, i, j in gaps:
        if i not in after and j not in before:
            after[i], before[j] = j, i
    edges = []
    done: set[int] = set()
    for i in [*(i for i in range(len(parts)) if i not in before), *range(len(parts))]:
        if i in done:
            continue
        edge, at = parts[i], i
        done.add(i)
        while at in after and after[at] not in done:
            at = after[at]
            done.add(at)
            edge = _joined(edge, parts[at], heights, raster, slopes, settings)
        if at in after:
            edge = _closed(_joined(edge, parts[i], heights, raster, slopes, settings), len(parts[i].seen))
        enough = float(edge.evidence.sum()) >= settings.least_evidence
        if enough and float(edge.seen.sum() - 1) * NODE_M >= settings.least_length_m:
            edges.append(edge)
    return edges


def _closed(edge: Edge, again: int) -> Edge:
    """Returns a closed edge of one that ends with its first nodes, so many, once more."""
    lap = len(edge.seen) - again
    rows = np.append(np.tile(np.arange(lap), 3), 0)
    return edge.at(rows)._replace(lap=lap)


def _near_pairs(parts: list[Edge], reach_m: float) -> list[tuple[int, int]]:
    """Returns pairs of parts of which the first ends near where the second begins."""
    if not parts:
        return []
    ends = np.array([[p.nodes.x_m[-1], p.nodes.y_m[-1]] for p in parts])
    begins = np.array([[p.nodes.x_m[0], p.nodes.y_m[0]] for p in parts])
    near = scipy.spatial.cKDTree(begins).query_ball_point(ends, reach_m + 1e-6)
    return [(i, j) for i, some in enumerate(near) for j in some if not parts[i].lap and not parts[j].lap]


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
        return _end_to_end(a, b)
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
    return _end_to_end(_end_to_end(a, Edge(mixed, seen, np.zeros(len(seen)))), b)


def _end_to_end(a: Edge, b: Edge) -> Edge:
    nodes = Nodes(*(np.concatenate([p, q]) for p, q in zip(a.nodes, b.nodes, strict=True)))
    return Edge(nodes, np.concatenate([a.seen, b.seen]), np.concatenate([a.evidence, b.evidence]))


_AROUND_NODES: Final = 7
"""Features are medians over this many nodes (3 m): an edge is what it is over a length, not at a point."""
_BESIDE_M: Final = 0.7  # Returns this near to a node (m) tell of its sides …
_FACE_M: Final = 0.08  # … unless they are nearer to the edge than this (m): those are on its face.
_STANDING_M: Final = (0.3, 2.0)
"""Heights above the ground (m) at which fences, walls and hedges are seen."""
_PLANTS_M: Final = (0.05, 0.3)  # Heights above the ground (m) of grass and of the lower parts of plants.
_LONG_M: Final = 12.0  # Longer edges (m) are alike: windows cut them anywhere.
_EVIDENCE_NODES: Final = 20  # Nodes (10 m) to both sides whose evidence counts.
_MOST_EVIDENCE: Final = 4.0  # Greatest evidence (σ) a metre that is told.
_MOST_RATIO: Final = 30.0  # Greatest significance that is told: more says no more.
_LEAST_SIGMA_M: Final = 0.004  # Error (m) of a step that the lines of its sides do not show.


def node_features(scene: Scene, edges: Sequence[Edge]) -> dict[str, Float64]:
    """Returns features (n,) by name of all nodes of some edges, one edge after the other; NaN where one is not known.

    The measured ones are medians over 3 m of an edge.
    """
    nodes = [edge.nodes for edge in edges]
    names = ("x_m", "y_m", "heading_x", "heading_y", "step_m", "sigma_step_m", "seen_low", "covered")
    x, y, ux, uy, step, sigma, seen_low, covered = (np.concatenate([getattr(n, k) for n in nodes]) for k in names)
    place, seen = np.column_stack([x, y, ux, uy]), np.concatenate([edge.seen for edge in edges])
    ends = np.cumsum([len(n.x_m) for n in nodes])
    rows = [slice(end - len(n.x_m), end) for end, n in zip(ends, nodes, strict=True)]
    # Of equal nodes of several laps one stands for all.
    lap = [np.arange(len(e.seen)) % e.lap if e.lap else np.arange(len(e.seen)) for e in edges]
    one, again = np.unique(np.concatenate([k.start + at for k, at in zip(rows, lap, strict=True)]), return_inverse=True)
    of_returns = _of_returns(scene, place[one], np.where(seen, step, np.nan)[one])
    measured = {
        "seen_low": seen_low, "covered": covered,
        "significance": np.minimum(step / np.hypot(sigma, _LEAST_SIGMA_M), _MOST_RATIO),
        "outward": _outward(scene, place), **{name: column[again] for name, column in of_returns.items()},
    }  # fmt: skip
    out = {name: np.concatenate([_medians_of_known(column[k]) for k in rows]) for name, column in measured.items()}
    lengths = [np.full(len(edge.seen), min(NODE_M * len(edge.seen), _LONG_M)) for edge in edges]
    evidence = np.concatenate([_evidence_a_metre(edge) for edge in edges])
    return out | {"length_m": np.concatenate(lengths), "evidence": np.minimum(evidence, _MOST_EVIDENCE)}


def _evidence_a_metre(edge: Edge) -> Float64:
    """Returns the evidence (n,) (σ) a metre that is seen of an edge within 10 m of each node, as far as it goes."""
    seen = means_about(edge.seen.astype(np.float64), _EVIDENCE_NODES)
    return means_about(edge.evidence, _EVIDENCE_NODES) / np.maximum(NODE_M * seen, 1e-9)


def _medians_of_known(values: Float64) -> Float64:
    """Returns the median (n,) of the known among the values around each; NaN where none is known."""
    half = _AROUND_NODES // 2
    held = np.lib.stride_tricks.sliding_window_view(np.pad(values, half, constant_values=np.nan), _AROUND_NODES)
    ordered, known = np.sort(held, axis=1), np.isfinite(held).sum(axis=1)  # NaN come last
    row = np.arange(len(values))
    low, high = (ordered[row, np.maximum(at, 0)] for at in ((known - 1) // 2, known - 1 - (known - 1) // 2))
    return np.where(known > 0, 0.5 * (low + high), np.nan)


def _of_returns(scene: Scene, place: Float64, step_m: Float64) -> dict[str, Float64]:
    """Returns features (n,) of the returns beside each node: shares that stand and that grow by side, `crossing` and
    `within_rings`, the share of the step (n,) that single rings show.

    `crossing` is the mean cosine between beams and the edge: 0 where the edge lies along the ring that a laser draws.
    """
    raster, returns, count = raster_of(scene), scene.returns, len(place)
    rows = np.flatnonzero(_near(place, raster)[np.maximum(raster.cell, 0)] & (raster.cell >= 0))
    within_rings = share_within_rings(returns, rows[raster.used[rows]], place, step_m)
    away, owner = scipy.spatial.cKDTree(place[:, :2]).query(
        np.column_stack([returns.x_m[rows], returns.y_m[rows]]), distance_upper_bound=_BESIDE_M
    )
    rows, owner = rows[np.isfinite(away)], owner[np.isfinite(away)].astype(np.int64)
    x, y, ux, uy = place[owner].T
    across = (returns.x_m[rows] - x) * uy - (returns.y_m[rows] - y) * ux
    above = scene.above_ground_m[rows]

    def share(of: tuple[float, float], among: Bool) -> Float64:
        number, held = (
            np.bincount(owner[k], minlength=count) for k in (among, among & (above > of[0]) & (above < of[1]))
        )
        return np.where(number > 0, held / np.maximum(number, 1), np.nan)

    sides = {"high": across > _FACE_M, "low": across < -_FACE_M}
    dx, dy = returns.x_m[rows] - returns.sensor_x_m[rows], returns.y_m[rows] - returns.sensor_y_m[rows]
    on_ground = raster.used[rows] & (sides["high"] | sides["low"])
    crossing = np.abs(dx * ux + dy * uy) / np.maximum(np.hypot(dx, dy), 1e-9)
    number = np.bincount(owner[on_ground], minlength=count)
    total = np.bincount(owner[on_ground], crossing[on_ground], minlength=count)
    return {
        **{f"{name}_{side}": share(of, own) for name, of in (("stands", _STANDING_M), ("grows", _PLANTS_M))
           for side, own in sides.items()},
        "crossing": np.where(number > 0, total / np.maximum(number, 1), np.nan), "within_rings": within_rings,
    }  # fmt: skip


def _near(place: Float64, raster: HeightRaster) -> Bool:
    """Returns a mask of flat cells that come near to nodes."""
    mark = np.zeros(raster.count.shape, np.bool_)
    mark[raster.cells_of(place[:, 0], place[:, 1])] = True
    away = scipy.ndimage.distance_transform_edt(~mark) * raster.cell_m
    return np.asarray(away.ravel() <= _BESIDE_M + raster.cell_m)


def _outward(scene: Scene, place: Float64) -> Float64:
    """Returns the sine (n,) from an edge's direction to the way from the drive; positive where it rises outward."""
    drive = scene.drive_xyh_m
    if not len(drive):
        return np.full(len(place), np.nan)
    away, at = scipy.spatial.cKDTree(drive[:, :2]).query(place[:, :2])
    x, y, ux, uy = place.T
    return np.asarray(((x - drive[at, 0]) * uy - (y - drive[at, 1]) * ux) / np.maximum(away, 1e-9))


KERB: Final = Judge("kerb", "cdef227f1ee2f1fc")
"""Whether a node of an edge lies at a kerb."""
LEAST: Final = 0.5
"""An edge is cut where it is less probable (smoothed) that it is a kerb."""
_LEAST_WITHIN_RINGS: Final = 0.2
"""There is no kerb where single rings show less than this share of a step."""
_SMOOTH_NODES: Final = 7  # Probabilities are means over this many nodes (3 m).
_HOLE_NODES: Final = 4  # A shorter run of doubtful nodes (2 m) does not cut an edge.
_SHORTEST_M: Final = 1.5  # Shorter parts are left out (m).
_FENCE_M: Final = (0.35, 1.2)
"""Heights above the ground at which every fence and wall is seen (m)."""
_LEAST_RETURNS: Final = 2  # An object has at least this many returns in a cell.
_MOST: Final = 0.5  # Share of an edge's nodes from which it counts as taken.
_FOOT_NODES: Final = 12  # Nodes (6 m) to both sides over which that share is taken.
_VEHICLE_M: Final = 0.9  # Half of a vehicle's width (m).
_OTHERS: Final = (
    classes.VEHICLE, classes.PERSON, classes.LOW_NOISE, classes.HIGH_NOISE, classes.LOW_VEGETATION,
    classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION,
)  # fmt: skip
"""Classes that stand at kerbs and are no fence, but for what lies on an upright plane: a wall that was seen from both
sides scatters as leaves do."""


@once_a_scene
def free_edges(scene: Scene) -> list[Edge]:
    """Returns the parts of the scene's edges that are kerbs, with the probability at each node."""
    edges = open_edges(scene)
    if not edges:
        return []
    features = node_features(scene, edges)
    stated = np.where(features["within_rings"] < _LEAST_WITHIN_RINGS, 0.0, KERB.probability(features))
    ends = np.cumsum([len(edge.seen) for edge in edges])
    return [part.once() for edge, end in zip(edges, ends, strict=True)
            for part in kerb_parts(edge, stated[end - len(edge.seen) : end])]  # fmt: skip


def open_edges(scene: Scene) -> list[Edge]:
    """Returns the scene's edges without the parts at whose foot mostly something stands, and those under a drive."""
    raster, edges = raster_of(scene), edges_of(scene)
    if not edges:
        return []
    taken = _standing(scene) | _driven(scene)
    return [part for e in edges for part in free_parts(e, taken[raster.cells_of(e.nodes.x_m, e.nodes.y_m)])]


def free_parts(edge: Edge, taken: Bool) -> list[Edge]:
    """Returns the runs of an edge's nodes about which less than half is taken; taken : (n,) of each node.

    What lies farther along the edge does not count: a scene does not hold all of a long one.
    """
    free = means_about(taken.astype(np.float64), _FOOT_NODES) <= _MOST
    if free.all():
        return [edge]
    return _parts(edge, free)


def _parts(edge: Edge, chosen: Bool) -> list[Edge]:
    """Returns the runs of an edge's chosen nodes (n,) that are long enough and of which one was seen."""
    return [
        edge if len(rows) == len(chosen) else edge.at(rows)
        for rows in runs_along(chosen, edge.lap)
        if (len(rows) - 1) * NODE_M >= _SHORTEST_M and edge.seen[rows].any()
    ]


def means_about(values: Float64, nodes: int) -> Float64:
    """Returns means (n,) of the values of so many nodes to both sides of each, as far as the edge goes."""
    total, at = np.append(0.0, np.cumsum(values)), np.arange(len(values))
    first, end = np.maximum(at - nodes, 0), np.minimum(at + nodes + 1, len(values))
    return np.asarray((total[end] - total[first]) / (end - first))


def _driven(scene: Scene) -> Bool:
    """Returns a mask (rows, columns) of the cells within half a vehicle's width of a drive."""
    raster, drive = raster_of(scene), scene.drive_xyh_m
    inside = np.zeros(raster.count.shape, np.bool_)
    corner = np.array([raster.x_min_m, raster.y_min_m])
    for number in np.unique(drive[:, 3]).tolist():
        x, y = (np.ascontiguousarray(drive[drive[:, 3] == number, k]) for k in (0, 1))
        mark_corridor(x, y, _VEHICLE_M, corner, raster.cell_m, inside)
    return inside


def _standing(scene: Scene) -> Bool:
    """Returns a mask (rows, columns) of the cells at which two returns or more are as high as a fence."""
    raster, above = raster_of(scene), scene.above_ground_m
    counted = np.ones(256, np.bool_)
    counted[list(_OTHERS)] = False
    high = (above > _FENCE_M[0]) & (above < _FENCE_M[1]) & (raster.cell >= 0)
    stands = high & (counted[scene.classes] | on_thin(scene))
    number = np.bincount(raster.cell[stands], minlength=raster.count.size).reshape(raster.count.shape)
    wider = cv2.dilate((number >= _LEAST_RETURNS).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(wider > 0)


def kerb_parts(edge: Edge, probability: Float64) -> list[Edge]:
    """Returns the runs of an edge's nodes that are more probably a kerb than not; probability : (n,) of each node.

    Nodes whose step is hidden are as probable as the seen ones around them. Where both sides are seen without a step
    there is no kerb.
    """
    at = np.arange(len(probability))
    told = np.interp(at, at[edge.seen], probability[edge.seen])
    told[~edge.seen & _both_sides_seen(edge.nodes)] = 0.0
    smooth = scipy.ndimage.uniform_filter1d(told, _SMOOTH_NODES, mode="nearest")
    return _parts(edge._replace(probability=smooth), without_holes(smooth >= LEAST, _HOLE_NODES))


def _both_sides_seen(nodes: Nodes, settings: EdgeSettings = DEFAULT) -> Bool:
    """Returns a mask (n,) of nodes at which a step would be measured if there were one."""
    seen = np.isfinite(nodes.sigma_step_m) & (nodes.covered >= settings.covered)
    return seen & (nodes.seen_low >= settings.seen_low) & (nodes.seen_high_m >= settings.seen_high_m)
