"""Depths of the lidar at tie points: a tie point that lies on a surface which the lidar saw has no distance from it.

Returns of the moment of a picture are known in the axes of the body, so what they say of the tie points of that picture
rests on the two mountings and not on the poses. A surface is the plane of the returns that lie nearest to the tie point
in the picture, on all sides of it; where they are of two surfaces there is an edge of depth, and no observation. The
distance along the plane's normal (point to plane; Chen and Medioni 1992) has the same derivatives as all observations
(:mod:`roadscan.adjust.observations`): its moving end is the lidar, its other end the tie point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.adjust.bundle.measurements import FREE_M, Measurements, Numbers, Seen, State, seen
from roadscan.adjust.observations import COMPONENTS, FIXED, KINDS, MOUNTED, Observations
from roadscan.compute.array_types import Bool, Float32, Float64, Int64
from roadscan.pictures.lens import pixels_of
from roadscan.poses.trajectory import world_from_ned

KIND: Final = "picture_depth"
_NEAREST: Final = 12  # Returns that a plane is laid through.
_AROUND_PX: Final = 24.0
"""They lie so near to the tie point in the picture (px), all of them."""
_GAP_DEG: Final = 150.0
"""Angle about the tie point in the picture without a return, at most (degrees): else it lies beside their surface."""
_THICK_M: Final = 0.04
"""RMS distance of the returns from their plane, at most (m): twice that of a good lidar."""
_FAR_M: Final = 0.1
"""Distance of each return from the plane, at most (m): beyond there is an edge of depth, or a kerb."""
_NONE: Final = 1e-6  # Weight of a row that does not count: its σ is a thousand times larger.
_WIDE: Final = 4.0
"""Extent of the returns along the plane's shorter axis over their distance from it, at least."""


@dataclass(frozen=True)
class NearReturns:
    """Returns of a lidar about the tie points of a picture, at its moment."""

    picture: int
    """Number of the picture."""
    sensor: int
    """Number of the lidar's mounting in the adjustment, −1: not estimated."""
    lidar: str
    lever_body_m: Float64
    """(3,) of the lidar, as stated."""
    point_body_m: Float32
    """(n, 3) in the axes of the body at the picture's stamp, by the recorded poses and the stated mounting."""


@dataclass(frozen=True)
class Surfaces:
    """Planes of the lidar at k tie points of pictures."""

    measurement: Int64
    """(k,) which measurement of a tie point."""
    sensor: npt.NDArray[np.int32]
    """(k,) number of the lidar's mounting, −1: not estimated."""
    lidar: npt.NDArray[np.str_]
    """(k,) its name."""
    lever_body_m: Float64
    """(k, 3) of the lidar."""
    point_body_m: Float64
    """(k, 3) a point of the plane, as it was recorded."""
    normal_body: Float64
    """(k, 3) unit vectors."""
    sigma_m: Float64
    """(k,) 1 σ of the plane at the tie point."""

    def at(self, rows: Int64 | Bool) -> Self:
        """Returns a subset."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self | None:
        """Returns all of them; None where there are none."""
        if not parts:
            return None
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})


def surfaces_of(
    measured: Measurements, returns: Sequence[NearReturns], state: State, numbers: Numbers
) -> Surfaces | None:
    """Returns the planes of lidars at tie points, as the state sees both; None where there are none."""
    tied = np.flatnonzero(measured.is_tie)
    tied = tied[np.argsort(measured.picture[tied], kind="stable")]
    starts = np.searchsorted(measured.picture[tied], np.arange(len(measured.exposures) + 1))
    found = []
    for one in returns:
        rows = tied[starts[one.picture] : starts[one.picture + 1]]
        if rows.size and len(one.point_body_m) >= _NEAREST:
            found.append(_at_picture(measured.at(rows), rows, one, state, numbers))
    return Surfaces.joined([own for own in found if own.measurement.size])


def _at_picture(measured: Measurements, rows: Int64, near: NearReturns, state: State, numbers: Numbers) -> Surfaces:
    """Returns the planes at the tie points (m) of one picture."""
    from scipy.spatial import cKDTree

    where = seen(measured.at(np.zeros(1, np.int64)), state, numbers)
    lens = where.lenses[int(where.own.camera[0])]
    point = near.point_body_m.astype(np.float64)
    moved = _moved(point, near.lever_body_m, _mounting(state, near.sensor))
    in_camera = (moved - where.lever_body_m) @ where.body_from_opencv[0]
    pixel = pixels_of(lens, np.where(in_camera[:, 2:] > 0.5, in_camera, np.nan))
    known = np.flatnonzero(np.isfinite(pixel).all(axis=1))
    none = np.zeros(0, np.int64)
    if known.size < _NEAREST:
        return _planes(near, none, point[none], np.zeros((0, 3)), np.zeros(0))
    away, index = cKDTree(pixel[known]).query(measured.pixel, _NEAREST, distance_upper_bound=_AROUND_PX)
    full = np.flatnonzero(np.isfinite(away).all(axis=1))
    around = known[index[full]]
    surrounded = _gap(pixel[around] - measured.pixel[full, None]) <= np.radians(_GAP_DEG)
    full, around = full[surrounded], around[surrounded]
    cloud = point[around]
    middle = cloud.mean(axis=1)
    off = cloud - middle[:, None]
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off) / _NEAREST)
    normal = axes[:, :, 0]
    thick, wide = (np.sqrt(np.maximum(values[:, k], 0.0)) for k in (0, 1))
    farthest = np.abs(np.einsum("nki,ni->nk", off, normal)).max(axis=1, initial=0.0)
    flat = (thick <= _THICK_M) & (farthest <= _FAR_M) & (wide >= _WIDE * thick)
    return _planes(near, rows[full[flat]], middle[flat], normal[flat], thick[flat])


def _planes(near: NearReturns, rows: Int64, point: Float64, normal: Float64, thick: Float64) -> Surfaces:
    k = rows.size
    return Surfaces(
        rows, np.full(k, near.sensor, np.int32), np.full(k, near.lidar), np.tile(near.lever_body_m, (k, 1)), point,
        normal, np.asarray(thick * np.sqrt(3.0 / _NEAREST)),
    )  # fmt: skip


def _gap(away: Float64) -> Float64:
    """Returns the largest angle (n,) without a neighbour, from vectors (n, k, 2) to neighbours."""
    angle = np.sort(np.arctan2(away[:, :, 1], away[:, :, 0]), axis=1)
    return np.asarray(np.diff(angle, axis=1, append=angle[:, :1] + 2.0 * np.pi).max(axis=1, initial=0.0))


def _mounting(state: State, sensor: int) -> Float64:
    return state.mountings.get(sensor, np.zeros(len(MOUNTED)))


def _moved(point: Float64, lever: Float64, change: Float64) -> Float64:
    """Returns points (n, 3) of the body as a change of the mounting (7,) or (n, 7) places them."""
    away = point - lever
    turned = np.cross(np.broadcast_to(change[..., 3:6], away.shape), away)
    return np.asarray(point + change[..., :3] + turned + change[..., 6:] * away)


@dataclass(frozen=True)
class DepthRows:
    """Observations of surfaces."""

    observations: Observations
    surface: Int64
    """(r,) of each row."""
    value_m: Float64
    """(k,) distance of each tie point from its surface by the state; NaN where it has no place."""
    alone_sigma_m: Float64
    """(k,) 1 σ of each, without what it shares with all others of its picture."""


def depth_rows(
    measured: Measurements, surfaces: Surfaces, state: State, numbers: Numbers, points: tuple[Float64, Int64],
    stated: tuple[float, float], weight: Float64,
) -> DepthRows:  # fmt: skip
    """Returns the observations of surfaces, linear about a state; observed values are as if that were 0.

    Parameters
    ----------
    points : places (p, 3) of the points, world frame, and their numbers (p,) as places of the adjustment.
    stated : 1 σ of a distance beside that of its plane, and of what all of a picture are off in common (m).
    weight : (m,) of each measurement; what has none stays, with a σ by which it says nothing.
    """
    own, (place_m, first_place) = measured.at(surfaces.measurement), points
    where = _at_stamps(own, state, numbers)
    changes = np.array([_mounting(state, s) for s in surfaces.sensor.tolist()]).reshape(-1, len(MOUNTED))
    arm = _moved(surfaces.point_body_m, surfaces.lever_body_m, changes)
    normal, away = surfaces.normal_body, arm - surfaces.lever_body_m
    place = where.arms_m(place_m[own.point])
    value = np.einsum("ni,ni->n", normal, place - arm)
    level = np.empty((len(arm), 3, 3))
    for k, camera in enumerate(where.own.cameras):
        here = where.own.camera == k
        axes = world_from_ned(camera.world, where.body_world_m[here])
        level[here] = np.einsum("nji,njk->nik", axes, where.world_from_body[here])
    posed = np.concatenate([np.einsum("nij,nj->ni", level, normal), np.cross(place, normal)], axis=1)
    along = np.einsum("ni,ni->n", normal, away)
    seated = np.concatenate([normal, np.cross(away, normal), along[:, None]], axis=1)
    observed = value + (posed * where.correction).sum(axis=1) + (seated * changes).sum(axis=1)
    counts = weight[surfaces.measurement]
    number = np.bincount(own.picture, counts, minlength=len(own.exposures))[own.picture]
    alone = np.hypot(surfaces.sigma_m, stated[0])
    sigma = np.sqrt((alone**2 + number * stated[1] ** 2) / np.maximum(counts, _NONE))
    rows = np.flatnonzero(np.isfinite(observed))
    r = rows.size
    ends, seats = np.zeros((r, 2, len(COMPONENTS))), np.zeros((r, 2, len(MOUNTED)))
    ends[:, 0], seats[:, 0] = posed[rows], seated[rows]
    fixed, beside = np.full(r, FIXED, np.int32), np.full(r, -1, np.int32)
    run = numbers.run[where.own.camera[rows]].astype(np.int32)
    observations = Observations(
        np.full(r, KINDS.index(KIND), np.uint8), np.stack([run, fixed], axis=-1),
        np.stack([where.epoch_gps_ns[rows], np.zeros(r, np.int64)], axis=-1), ends, observed[rows], sigma[rows],
        np.arange(r), first_place[own.point[rows]], np.full(r, FREE_M),
        np.stack([surfaces.sensor[rows], beside], axis=-1), seats,
    )  # fmt: skip
    return DepthRows(observations, rows, value, alone)


def _at_stamps(measured: Measurements, state: State, numbers: Numbers) -> Seen:
    """Returns the poses of the body at the stamps of the pictures, to which the returns refer."""
    rows = np.array([(c.interior.height_px - 1) / 2 for c in measured.exposures.cameras])
    middle = rows[measured.exposures.camera[measured.picture]]
    level = replace(measured, pixel=np.column_stack([measured.pixel[:, 0], middle]))
    return seen(level, replace(state, cameras={}), numbers)
