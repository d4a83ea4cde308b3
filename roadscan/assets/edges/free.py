"""Edges at whose foot nothing stands: along the foot of a fence heights differ as they do at a step."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.edges.find import Edge, edges_of
from roadscan.assets.edges.line_pieces import columns_of
from roadscan.assets.edges.raster import raster_of
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene

_FENCE_M: Final = (0.35, 1.2)
"""Heights above the ground at which every fence and wall is seen."""
_LEAST_RETURNS: Final = 2
_AT_FOOT: Final = 0.5
_OTHERS: Final = (
    classes.VEHICLE, classes.PERSON, classes.LOW_NOISE, classes.HIGH_NOISE, classes.LOW_VEGETATION,
    classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION,
)  # fmt: skip
"""What stands at kerbs and is no fence."""


@once_a_scene
def free_edges(scene: Scene) -> list[Edge]:
    """The scene's edges without those that lie, at most of their nodes, where something stands."""
    raster, standing = raster_of(scene), _standing(scene)
    kept = []
    for edge in edges_of(scene):
        nodes = columns_of(edge)
        if np.mean(standing[raster.cells_of(nodes[:, 0], nodes[:, 1])]) <= _AT_FOOT:
            kept.append(edge)
    return kept


def _standing(scene: Scene) -> npt.NDArray[np.bool_]:
    """Cells (rows, columns) of the raster at which two returns or more are as high as a fence."""
    raster, above = raster_of(scene), scene.above_ground_m
    counted = np.ones(256, np.bool_)
    counted[list(_OTHERS)] = False
    stands = (above > _FENCE_M[0]) & (above < _FENCE_M[1]) & counted[scene.classes] & (raster.cell >= 0)
    number = np.bincount(raster.cell[stands], minlength=raster.count.size).reshape(raster.count.shape)
    return cv2.dilate((number >= _LEAST_RETURNS).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
