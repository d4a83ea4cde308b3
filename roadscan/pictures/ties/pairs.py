"""Pairs of pictures that are compared: neighbours of a drive, other cameras and revisits; never all with all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.settings import PictureTiesConfig

_SAME_VISIT_NS: Final = 20 * NS_PER_S
"""Pictures of one camera so near in time (ns) are neighbours; later ones are a revisit."""
_MOST_NEAR: Final = 400
"""Pictures around a place that are looked at for revisits; a vehicle that waits takes many."""


def pairs_of(exposures: Exposures, settings: PictureTiesConfig) -> Int64:
    """Returns pairs (p, 2) of pictures, the earlier number first, in order."""
    if not len(exposures):
        return np.zeros((0, 2), np.int64)
    axis = exposures.world_from_opencv[:, :, 2]
    alike = float(np.cos(np.radians(settings.revisit_deg)))
    found = {(a, b) for a, b in _neighbours(exposures, settings) if axis[a] @ axis[b] >= alike}
    if settings.revisits:
        found |= set(_revisits(exposures, settings, axis, alike))
    return np.array(sorted(found), np.int64).reshape(-1, 2)


def _neighbours(exposures: Exposures, settings: PictureTiesConfig) -> Iterator[tuple[int, int]]:
    """Yields each picture with those that the same camera took after it, a step apart each."""
    eye, epoch = exposures.eye_world_m, exposures.epoch_gps_ns
    for camera in np.unique(exposures.camera).tolist():
        rows = np.flatnonzero(exposures.camera == camera)
        rows = rows[np.argsort(epoch[rows], kind="stable")]
        for k, first in enumerate(rows.tolist()):
            last, count = first, 0
            for other in rows[k + 1 :].tolist():
                if epoch[other] - epoch[first] > _SAME_VISIT_NS or count == settings.neighbours:
                    break
                if np.linalg.norm(eye[other] - eye[last]) < settings.shortest_step_m:
                    continue
                last, count = other, count + 1
                yield min(first, other), max(first, other)


def _revisits(
    exposures: Exposures, settings: PictureTiesConfig, axis: Float64, alike: float
) -> Iterator[tuple[int, int]]:
    """Yields each picture with the nearest of each other camera, and of its own at another time."""
    from scipy.spatial import cKDTree

    eye, epoch, camera = exposures.eye_world_m, exposures.epoch_gps_ns, exposures.camera
    worlds = [exposures.cameras[k].world for k in camera.tolist()]
    for world in sorted(set(worlds)):
        rows = np.flatnonzero([own == world for own in worlds])
        tree = cKDTree(eye[rows])
        distances, near = tree.query(eye[rows], k=min(_MOST_NEAR, rows.size), distance_upper_bound=settings.revisit_m)
        for first, away, others in zip(
            rows.tolist(), np.atleast_2d(distances.T).T, np.atleast_2d(near.T).T, strict=True
        ):
            taken: dict[tuple[int, int], int] = {}
            for other in rows[others[np.isfinite(away)]].tolist():
                same = camera[other] == camera[first]
                if other == first or (same and abs(epoch[other] - epoch[first]) <= _SAME_VISIT_NS):
                    continue
                visit = (int(camera[other]), int(epoch[other] // _SAME_VISIT_NS) if same else 0)
                if axis[first] @ axis[other] >= alike and taken.get(visit, 0) < settings.revisits:
                    taken[visit] = taken.get(visit, 0) + 1
                    yield min(first, other), max(first, other)
