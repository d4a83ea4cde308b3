"""The survey vehicle in its own pictures: what stands still in the picture while the drive moves.

Pictures far apart are compared at the same pixels. A feature counts where the poses say that anything fixed to the
ground would have moved from its pixel, however far it is: above the horizon that takes a turn of the camera, below it
the ground ends the distance. Dirt on the lens is found as well.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Bool, Int64
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.lens import Lens, pixels_of, rays_of
from roadscan.pictures.ties.matching import Features, alike

OWN_VEHICLE: Final = "picture_own_vehicle"
CELLS: Final = (20, 32)
"""Rows and columns of a picture's cells."""
_PICTURES: Final = 40  # Pictures of a camera that are compared, each with the next one, at most.
_APART_M: Final = 5.0
"""Two pictures that are compared were taken so far apart (m), at least."""
_MOVED_PX: Final = 6.0
"""By so much (px) a feature of anything else would have moved, at least: poses are off by 0.2°, or 3 px."""
_SAME_PX: Final = 1.5  # A feature that stands still lies within so much of its pixel (px).
_HORIZON: Final = np.sin(np.radians(2.0))
"""Sine of the angle below the horizon up to which a thing may be as far as the sky: where the road falls …"""
_HIGHEST_M: Final = 4.0
"""… and the greatest height of a camera above the road (m), by which a ray further down meets the ground."""
_SHARE: Final = 0.25
"""Share of the features of a cell that stand still, from which on it shows the vehicle: elsewhere it is 1 in 100."""
_PAIRS: Final = 4  # A cell stands still in so many pairs of pictures, at least.


@dataclass(frozen=True)
class Compared:
    """The features of a camera that were compared, by the cells of its pictures."""

    compared: Int64
    """(20, 32) features that would have moved."""
    still: Int64
    """(20, 32) those of them that stood still."""
    pairs: Int64
    """(20, 32) pairs of pictures in which some did."""

    @property
    def own_vehicle(self) -> Bool:
        """Returns the cells (20, 32) that show the vehicle; what lies between such cells is taken as well."""
        from scipy.ndimage import binary_closing

        shown = (self.still >= _SHARE * np.maximum(self.compared, 1)) & (self.pairs >= _PAIRS)
        return np.asarray(shown | binary_closing(shown, np.ones((3, 3), bool)))


def compared_pictures(exposures: Exposures, camera: int) -> Int64:
    """Returns the numbers of a camera's pictures that are compared, each with the next one; spread over the drive."""
    rows = np.flatnonzero(exposures.camera == camera)
    if not rows.size:
        return rows
    rows = rows[np.argsort(exposures.epoch_gps_ns[rows], kind="stable")]
    way = np.linalg.norm(np.diff(exposures.eye_world_m[rows], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(way)])
    step = max(_APART_M, float(along[-1]) / _PICTURES)
    return rows[np.unique(np.floor(along / step), return_index=True)[1]]


def compare(exposures: Exposures, pictures: Int64, lens: Lens, load: Callable[[int], Features | None]) -> Compared:
    """Returns what stands still from picture to picture of a camera.

    load : the features of a picture by its number; None where it has none.
    """
    compared, still, pairs = (np.zeros(CELLS, np.int64) for _ in range(3))
    before: Features | None = None
    for k, number in enumerate(pictures.tolist()):
        features = load(number)
        if before is not None and features is not None:
            pair = exposures.at(np.array([pictures[k - 1], number]))
            row, column = cells_of(before, lens)
            would_move = _would_move(pair, before, lens)
            stands = would_move & _stand(before, features)
            np.add.at(compared, (row[would_move], column[would_move]), 1)
            own = np.zeros(CELLS, np.int64)
            np.add.at(own, (row[stands], column[stands]), 1)
            still += own
            pairs += own > 0
        before = features
    return Compared(compared, still, pairs)


def cells_of(features: Features, lens: Lens) -> tuple[Int64, Int64]:
    """Returns row and column (k,) of the cell of each feature."""
    share = features.pixel[:, ::-1] * (np.array(CELLS) / np.array(lens.size_px[::-1]))
    row, column = np.clip(share.astype(np.int64), 0, np.array(CELLS) - 1).T
    return row, column


def _would_move(pair: Exposures, first: Features, lens: Lens) -> Bool:
    """Returns whether each feature (k,) of the first of two pictures would lie elsewhere in the second, were it of the
    farthest thing that its ray can meet.
    """
    pixel = first.pixel.astype(np.float64)
    ray = rays_of(lens, pixel)
    below = ray @ (pair.level_from_body[0, 2] @ pair.body_from_opencv[0])
    nearness = np.where(below > _HORIZON, below / _HIGHEST_M, 0.0)
    turns, eyes = pair.world_from_opencv, pair.eye_world_m
    seen = (ray @ turns[0].T + nearness[:, None] * (eyes[0] - eyes[1])) @ turns[1]
    away = np.linalg.norm(pixels_of(lens, seen) - pixel, axis=1)
    return np.asarray(~(away < _MOVED_PX) & np.isfinite(ray).all(axis=1))


def _stand(first: Features, second: Features) -> Bool:
    """Returns whether the second picture has a like feature at the same pixel as each (k,) of the first."""
    from scipy.spatial import cKDTree

    near = cKDTree(first.pixel).sparse_distance_matrix(cKDTree(second.pixel), _SAME_PX, output_type="coo_matrix")
    rows, others = near.row, near.col
    stands = np.zeros(len(first), bool)
    stands[rows[alike(first.descriptor[rows], second.descriptor[others])]] = True
    return stands


def rows_of(found: Compared) -> list[pa.Array]:
    """Returns the columns of the table: a row a cell that shows the vehicle."""
    row, column = np.nonzero(found.own_vehicle)
    compared, still = found.compared[row, column], found.still[row, column]
    return [pa.array(column, pa.int32()), pa.array(row, pa.int32()), pa.array(compared), pa.array(still)]


def cells_from(rows: pa.Table) -> Bool:
    """Returns the cells (20, 32) that show the vehicle, from rows of the table."""
    shown = np.zeros(CELLS, bool)
    shown[rows.column("row").to_numpy(), rows.column("column").to_numpy()] = True
    return shown


def detail_of(found: Compared) -> str:
    """Returns what is told of a camera: how many of its cells show the vehicle."""
    return json.dumps({"cells": int(found.own_vehicle.sum()), "of": int(np.prod(CELLS))})
