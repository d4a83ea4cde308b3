"""Edges that are kerbs: steps also occur along walls, hedges, ruts and beds, at rings of a lidar and between sweeps."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from roadscan.assets import classes
from roadscan.assets.edges.find import Edge, edges_of
from roadscan.assets.edges.node_features import node_features
from roadscan.assets.edges.profiles import NODE_M
from roadscan.assets.edges.raster import raster_of
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels.corridors import mark_corridor
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64
from roadscan.core.extras import cv2

KERB: Final = Judge("kerb", "cdef227f1ee2f1fc")
"""Whether a node of an edge lies at a kerb."""
LEAST: Final = 0.5
"""An edge is cut where it is less probable (smoothed) that it is a kerb."""
_SMOOTH_NODES: Final = 7  # Probabilities are means over this many nodes (3 m).
_HOLE_NODES: Final = 4  # A shorter run of doubtful nodes (2 m) does not cut an edge.
_SHORTEST_M: Final = 1.5  # Shorter parts are left out (m).
_FENCE_M: Final = (0.35, 1.2)
"""Heights above the ground at which every fence and wall is seen (m)."""
_LEAST_RETURNS: Final = 2  # An object has at least this many returns in a cell.
_MOST: Final = 0.5  # Share of an edge from which it counts as taken.
_VEHICLE_M: Final = 0.9  # Half of a vehicle's width (m).
_OTHERS: Final = (
    classes.VEHICLE, classes.PERSON, classes.LOW_NOISE, classes.HIGH_NOISE, classes.LOW_VEGETATION,
    classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION,
)  # fmt: skip
"""Classes that stand at kerbs and are no fence."""


@once_a_scene
def free_edges(scene: Scene) -> list[Edge]:
    """Returns the parts of the scene's edges that are kerbs, with the probability at each node."""
    edges = open_edges(scene)
    if not edges:
        return []
    stated = KERB.probability(node_features(scene, edges))
    ends = np.cumsum([len(edge.seen) for edge in edges])
    return [part for edge, end in zip(edges, ends, strict=True)
            for part in kerb_parts(edge, stated[end - len(edge.seen) : end])]  # fmt: skip


def open_edges(scene: Scene) -> list[Edge]:
    """Returns the scene's edges without those at whose foot mostly something stands, and those under a drive."""
    raster, edges = raster_of(scene), edges_of(scene)
    if not edges:
        return []
    taken = _standing(scene) | _driven(scene)
    return [e for e in edges if np.mean(taken[raster.cells_of(e.nodes.x_m, e.nodes.y_m)]) <= _MOST]


def _driven(scene: Scene) -> npt.NDArray[np.bool_]:
    """Returns a mask (rows, columns) of the cells within half a vehicle's width of a drive."""
    raster, drive = raster_of(scene), scene.drive_xyh_m
    inside = np.zeros(raster.count.shape, np.bool_)
    corner = np.array([raster.x_min_m, raster.y_min_m])
    for number in np.unique(drive[:, 3]).tolist():
        x, y = (np.ascontiguousarray(drive[drive[:, 3] == number, k]) for k in (0, 1))
        mark_corridor(x, y, _VEHICLE_M, corner, raster.cell_m, inside)
    return inside


def _standing(scene: Scene) -> npt.NDArray[np.bool_]:
    """Returns a mask (rows, columns) of the cells at which two returns or more are as high as a fence."""
    raster, above = raster_of(scene), scene.above_ground_m
    counted = np.ones(256, np.bool_)
    counted[list(_OTHERS)] = False
    stands = (above > _FENCE_M[0]) & (above < _FENCE_M[1]) & counted[scene.classes] & (raster.cell >= 0)
    number = np.bincount(raster.cell[stands], minlength=raster.count.size).reshape(raster.count.shape)
    wider = cv2.dilate((number >= _LEAST_RETURNS).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(wider > 0)


def kerb_parts(edge: Edge, probability: Float64) -> list[Edge]:
    """Returns the runs of an edge's nodes that are more probably a kerb than not; probability : (n,) of each node.

    Nodes whose step is hidden are as probable as the seen ones around them.
    """
    at = np.arange(len(probability))
    told = np.interp(at, at[edge.seen], probability[edge.seen])
    smooth = scipy.ndimage.uniform_filter1d(told, _SMOOTH_NODES, mode="nearest")
    good = np.pad(smooth >= LEAST, _HOLE_NODES)
    whole = scipy.ndimage.binary_closing(good, np.ones(_HOLE_NODES + 1))[_HOLE_NODES:-_HOLE_NODES]
    number, count = scipy.ndimage.label(whole)
    parts = []
    for k in range(1, count + 1):
        rows = np.flatnonzero(number == k)
        if (len(rows) - 1) * NODE_M >= _SHORTEST_M and edge.seen[rows].any():
            share = len(rows) / len(edge.seen)
            parts.append(Edge(edge.nodes.at(rows), edge.seen[rows], edge.evidence * share, smooth[rows]))
    return parts
