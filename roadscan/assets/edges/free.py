"""Edges that may be kerbs: steps also occur along a fence, a rut under the vehicle, and plants."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.edges.find import Edge, edges_of
from roadscan.assets.edges.line_pieces import columns_of
from roadscan.assets.edges.raster import HeightRaster, raster_of
from roadscan.assets.kernels.corridors import mark_corridor
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.core.extras import cv2

_FENCE_M: Final = (0.35, 1.2)
"""Heights above the ground at which every fence and wall is seen (m)."""
_LEAST_RETURNS: Final = 2  # An object has at least this many returns in a cell.
_MOST: Final = 0.5  # Share of an edge from which it counts as taken.
_VEHICLE_M: Final = 0.9  # Half of a vehicle's width (m).
_BEHIND_M: Final = (0.1, 0.2, 0.3, 0.4)
"""Distances (m) behind a kerb's face at which its upper side is seen."""
_SCATTER_M: Final = 0.015
"""Excess scatter (m) of heights in a cell with plants, beyond the noise of the data: even ground has less."""
_OTHERS: Final = (
    classes.VEHICLE, classes.PERSON, classes.LOW_NOISE, classes.HIGH_NOISE, classes.LOW_VEGETATION,
    classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION,
)  # fmt: skip
"""Classes that stand at kerbs and are no fence."""


@once_a_scene
def free_edges(scene: Scene) -> list[Edge]:
    """Scene's edges without those that lie, at most of their nodes, at an object, on a drive, or before plants
    on the higher side.
    """
    raster, taken = raster_of(scene), _standing(scene) | _driven(scene)
    plants = _plants(scene)
    kept = []
    for edge in edges_of(scene):
        nodes = columns_of(edge)
        is_free = np.mean(taken[raster.cells_of(nodes[:, 0], nodes[:, 1])]) <= _MOST
        if is_free and not _is_grown_over(edge, plants, raster):
            kept.append(edge)
    return kept


def _plants(scene: Scene) -> npt.NDArray[np.int64]:
    """Returns the number of returns of low plants among the ground returns in each cell (rows, columns)."""
    raster = raster_of(scene)
    cells = raster.cell[raster.used & (scene.classes == classes.LOW_VEGETATION)]
    return np.bincount(cells, minlength=raster.count.size).reshape(raster.count.shape)


def _is_grown_over(edge: Edge, plants: npt.NDArray[np.int64], raster: HeightRaster) -> bool:
    """Returns whether plants are seen close behind most of an edge, on its higher side: by class or by scatter."""
    nodes = edge.nodes.at(edge.seen)
    x = nodes.x_m[:, None] + np.array(_BEHIND_M) * nodes.heading_y[:, None]
    y = nodes.y_m[:, None] - np.array(_BEHIND_M) * nodes.heading_x[:, None]
    cells = raster.cells_of(x, y)
    every = raster.count[cells].sum(axis=1)
    held = every > 0
    if not held.any():
        return False
    scatter = np.sqrt((raster.count[cells] * raster.spread_m[cells] ** 2).sum(axis=1)[held] / every[held])
    share = plants[cells].sum(axis=1)[held] / every[held]
    return float(np.median(share)) > _MOST or float(np.median(scatter)) > raster.noise_m + _SCATTER_M


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
