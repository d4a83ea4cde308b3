"""Measurements in pictures as observations: residuals in metres at the point, and what moves them.

A camera that sees a place in a pixel says nothing of its distance. Of each coordinate of the pixel, column or row, let
g be its derivative by the point in the camera's axes (pixels a metre). Then n = g / |g| is the direction at the point
across the ray in which the pixel moves, and the residual of the pixel over |g| is how far the ray passes the point
along it. A correction of the pose moves the ray at the point as it moves a reading of a lidar there, so the derivatives
are those of all observations (:mod:`roadscan.adjust.observations`). The equations are those of a bundle block
adjustment with GNSS/INS (Förstner & Wrobel 2016, 15.2), but that its unknowns are corrections of each run's poses in
time.

Depths of the lidar at tie points are observations as well: a tie point that lies on a surface which the lidar saw has
no distance from it. Returns of the moment of a picture are known in the axes of the body, so what they say of the tie
points of that picture rests on the two mountings and not on the poses. A surface is the plane of the returns that lie
nearest to the tie point in the picture, on all sides of it; where they are of two surfaces there is an edge of depth,
and no observation. The distance along the plane's normal (point to plane; Chen and Medioni 1992) has the same
derivatives as all observations: its moving end is the lidar, its other end the tie point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.adjust.observations import CAMERA, COMPONENTS, FIXED, KINDS, MOUNTED, Observations
from roadscan.compute.array_types import Bool, Float32, Float64, Int32, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.lens import PARAMETERS, Lens, changed, derivatives, pixels_of, rays_of
from roadscan.pictures.ties.tracks import places_of
from roadscan.poses.trajectory import Corrections, world_from_ned

FREE_M: Final = 10.0
"""1 σ of a tie point about where its rays meet (m): far more than what they leave open."""
_CLOCK, _LINE = CAMERA.index("clock_s"), CAMERA.index("line_time_s")


@dataclass(frozen=True)
class State:
    """What has been estimated so far: all 0 at the start."""

    corrections: Mapping[str, Corrections] = field(default_factory=dict)
    """By run."""
    mountings: Mapping[int, Float64] = field(default_factory=dict)
    """(7,) by number of the sensor, `MOUNTED`."""
    cameras: Mapping[int, Float64] = field(default_factory=dict)
    """(11,) by number of the camera, `CAMERA`."""


@dataclass(frozen=True)
class Numbers:
    """How an adjustment numbers what the exposures are of."""

    run: Int32
    """(c,) of each camera of the exposures: its run."""
    sensor: Int32
    """(c,) its mounting, −1: not estimated."""
    camera: Int32
    """(c,) its lens and clock, −1: not estimated."""


@dataclass(frozen=True)
class Measurements:
    """m measurements of p points in pictures."""

    exposures: Exposures
    picture: Int64
    """(m,) number of the picture."""
    pixel: Float64
    """(m, 2) u, v."""
    sigma_px: Float64
    """(m,) 1 σ of each coordinate."""
    point: Int64
    """(m,) number of the point, 0 to p − 1."""
    surveyed_world_m: Float64
    """(p, 3) of control points; NaN of tie points."""
    survey_sigma_m: Float64
    """(p, 2) 1 σ of a control point's place and height; NaN of tie points."""

    @property
    def is_tie(self) -> Bool:
        """Returns a mask (m,) of the measurements of tie points."""
        return np.asarray(np.isnan(self.surveyed_world_m[self.point, 0]))

    def at(self, rows: Int64 | Bool) -> Measurements:
        """Returns a subset; points keep their numbers."""
        return replace(
            self, picture=self.picture[rows], pixel=self.pixel[rows], sigma_px=self.sigma_px[rows],
            point=self.point[rows],
        )  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """Where the cameras were and looked when each of m measurements was exposed, by a state."""

    own: Exposures
    """(m,) the picture of each measurement."""
    lenses: tuple[Lens, ...]
    """Of each camera."""
    correction: Float64
    """(m, 6) what the state adds to the pose, `COMPONENTS` …"""
    mounting: Float64
    """(m, 7) … to the mounting, `MOUNTED` …"""
    filming: Float64
    """(m, 11) … and to lens and clock, `CAMERA`."""
    epoch_gps_ns: Int64
    """(m,) of the row of the picture."""
    since_middle_px: Float64
    """(m,) rows from the middle row, at which the stamp is."""
    body_world_m: Float64
    """(m, 3)"""
    world_from_body: Float64
    """(m, 3, 3)"""
    lever_body_m: Float64
    """(m, 3)"""
    body_from_opencv: Float64
    """(m, 3, 3)"""

    @property
    def eye_world_m(self) -> Float64:
        """Returns projection centres (m, 3)."""
        return np.asarray(self.body_world_m + np.einsum("nij,nj->ni", self.world_from_body, self.lever_body_m))

    def rays_world(self, pixel: Float64) -> Float64:
        """Returns unit vectors (m, 3) of the pixels (m, 2)."""
        ray = np.empty((self.own.camera.size, 3))
        for here, lens in self.by_lens():
            ray[here] = rays_of(lens, pixel[here])
        return np.asarray(np.einsum("nij,njk,nk->ni", self.world_from_body, self.body_from_opencv, ray))

    def by_lens(self) -> Iterator[tuple[Bool, Lens]]:
        """Yields the measurements (m,) of each camera, and its lens."""
        for k, lens in enumerate(self.lenses):
            yield self.own.camera == k, lens

    def arms_m(self, place_m: Float64) -> Float64:
        """Returns places (m, 3), world frame, in the axes of the body."""
        return np.asarray(np.einsum("nji,nj->ni", self.world_from_body, place_m - self.body_world_m))

    def in_camera_m(self, arm_m: Float64) -> Float64:
        """Returns places (m, 3), axes of the body, in those of the camera."""
        return np.asarray(np.einsum("nji,nj->ni", self.body_from_opencv, arm_m - self.lever_body_m))


def seen(measured: Measurements, state: State, numbers: Numbers) -> Seen:
    """Returns poses of the cameras at the measurements, by a state."""
    from scipy.spatial.transform import Rotation

    own = measured.exposures.at(measured.picture)
    m, lenses = own.camera.size, list[Lens]()
    mounted, filmed, middle, line = np.zeros((m, len(MOUNTED))), np.zeros((m, len(CAMERA))), np.empty(m), np.empty(m)
    for k, camera in enumerate(own.cameras):
        here, change = own.camera == k, state.cameras.get(int(numbers.camera[k]))
        interior = changed(camera.interior, change)
        lenses.append(Lens.of(interior))
        filmed[here] = 0.0 if change is None else change
        mounted[here] = state.mountings.get(int(numbers.sensor[k]), np.zeros(len(MOUNTED)))
        middle[here], line[here] = (interior.height_px - 1) / 2, 1e-6 * interior.line_time_us
    since_px = measured.pixel[:, 1] - middle
    later_s = filmed[:, _CLOCK] + since_px * (line + filmed[:, _LINE])
    epochs = own.epoch_gps_ns + np.rint(later_s * NS_PER_S).astype(np.int64)
    body = own.body_world_m + later_s[:, None] * own.velocity_world_m_s
    turned = own.world_from_body @ Rotation.from_rotvec(later_s[:, None] * own.rate_body_rad_s).as_matrix()
    correction = np.zeros((m, len(COMPONENTS)))
    for k, camera in enumerate(own.cameras):
        here, known = own.camera == k, state.corrections.get(camera.run)
        if known is not None:
            correction[here] = np.concatenate(known.at(epochs[here]), axis=1)
            axes = world_from_ned(camera.world, body[here])
            body[here] += np.einsum("nij,nj->ni", axes, correction[here, :3])
    turned = turned @ Rotation.from_rotvec(correction[:, 3:]).as_matrix()
    axes = Rotation.from_rotvec(mounted[:, 3:6]).as_matrix() @ own.body_from_opencv
    lever = own.lever_body_m + mounted[:, :3]
    return Seen(own, tuple(lenses), correction, mounted, filmed, epochs, since_px, body, turned, lever, axes)


def met_at(measured: Measurements, where: Seen, weight: Float64) -> Float64:
    """Returns places (p, 3), world frame: of tie points where their rays meet, of control points as surveyed."""
    ray, place = where.rays_world(measured.pixel), measured.surveyed_world_m.copy()
    # A lens that is far from the true one has no ray in the corners of the picture.
    rows = measured.is_tie & (weight > 0.0) & np.isfinite(ray).all(axis=1)
    point, number = np.unique(measured.point[rows], return_inverse=True)
    if point.size:
        scaled = weight[rows] / measured.sigma_px[rows] ** 2
        place[point] = places_of(number, where.eye_world_m[rows], ray[rows], scaled).place_m
    return place


@dataclass(frozen=True)
class Rows:
    """Rows of measurements in an adjustment: two of each, column and row."""

    observations: Observations
    measurement: Int64
    """(r,) of each row."""
    px_per_m: Float64
    """(r,) by which a residual is one of pixels."""
    residual_px: Float64
    """(m, 2) observed minus computed, by the state; NaN where the point is not before the camera."""
    alone_sigma_m: Float64
    """(r,) 1 σ of each row without the error that it shares with all others of its picture."""


def residuals_px(measured: Measurements, where: Seen, place_m: Float64) -> Float64:
    """Returns observed minus computed pixels (m, 2) of points (p, 3); NaN where one is not before the camera."""
    in_camera = where.in_camera_m(where.arms_m(place_m[measured.point]))
    pixel = np.full((len(in_camera), 2), np.nan)
    for here, lens in where.by_lens():
        pixel[here] = pixels_of(lens, in_camera[here])
    return np.asarray(measured.pixel - pixel)


def rows_of(measured: Measurements, where: Seen, numbers: Numbers, place_m: Float64, first_place: Int64) -> Rows:
    """Returns the observations of measurements, linear about a state; observed values are as if that were 0.

    Parameters
    ----------
    where : the cameras by that state.
    place_m : (p, 3) of the points, world frame.
    first_place : (p,) number of each point as a place of the adjustment.
    """
    own, arm = where.own, where.arms_m(place_m[measured.point])
    in_camera = where.in_camera_m(arm)
    pixel, by_point = np.full((len(arm), 2), np.nan), np.full((len(arm), 2, 3), np.nan)
    by_lens = np.full((len(arm), 2, len(PARAMETERS)), np.nan)
    level = np.empty((len(arm), 3, 3))
    for here, lens in where.by_lens():
        pixel[here], by_point[here], by_lens[here] = derivatives(lens, in_camera[here])
    for k, camera in enumerate(own.cameras):
        here = own.camera == k
        axes = world_from_ned(camera.world, where.body_world_m[here])
        level[here] = np.einsum("nji,njk->nik", axes, where.world_from_body[here])
    residual = measured.pixel - pixel
    steep = np.linalg.norm(by_point, axis=2)
    sound = np.flatnonzero(np.isfinite(residual).all(axis=1) & (steep > 0.0).all(axis=1))
    in_body = np.einsum("nij,naj->nai", where.body_from_opencv, by_point / steep[:, :, None])
    in_level = np.einsum("nij,naj->nai", level, in_body)
    turns = np.cross(arm[:, None], in_body)
    mounted = np.concatenate(
        [in_body, turns - np.cross(where.lever_body_m[:, None], in_body), np.zeros((len(arm), 2, 1))], axis=2
    )
    moving = np.einsum("nji,nj->ni", where.world_from_body, own.velocity_world_m_s) + np.cross(own.rate_body_rad_s, arm)
    by_clock = np.einsum("nai,ni->na", in_body, moving)
    filmed = np.concatenate(
        [-by_lens / steep[:, :, None], by_clock[:, :, None], (by_clock * where.since_middle_px[:, None])[:, :, None]],
        axis=2,
    )
    posed = np.concatenate([in_level, turns], axis=2)
    known = where.correction, where.mounting, where.filming
    observed = -residual / steep
    for partial, values in zip((posed, mounted, filmed), known, strict=True):
        observed = observed + np.einsum("nai,ni->na", partial, values)
    observations = _observations(
        measured.at(sound), own.camera[sound], numbers, where.epoch_gps_ns[sound], first_place,
        (observed[sound], steep[sound], posed[sound], mounted[sound], filmed[sound]),
    )  # fmt: skip
    twice = np.repeat(sound, 2)
    return Rows(observations, twice, steep[sound].ravel(), residual, observations.sigma_m)


def _observations(
    measured: Measurements,
    camera: Int64,
    numbers: Numbers,
    epochs_gps_ns: Int64,
    first_place: Int64,
    values: tuple[Float64, Float64, Float64, Float64, Float64],
) -> Observations:
    """Returns two observations of each measurement (m,), column and row.

    values : observed value (m, 2), pixels a metre (m, 2), derivatives by pose, mounting and camera (m, 2, …).
    """
    observed, steep, posed, mounted, filmed = values
    m = camera.size
    tie = measured.is_tie
    kind = np.where(tie, KINDS.index("picture_tie"), KINDS.index("picture_control")).astype(np.uint8)
    sigma = measured.survey_sigma_m[measured.point]
    flat, down = np.hypot(posed[:, :, 0], posed[:, :, 1]), posed[:, :, 2]
    surveyed = np.where(tie[:, None], FREE_M, np.hypot(flat * sigma[:, :1], down * sigma[:, 1:]))
    ends = np.zeros((2 * m, 2, 6))
    ends[:, 0] = posed.reshape(-1, 6)
    seats = np.zeros((2 * m, 2, len(MOUNTED)))
    seats[:, 0] = mounted.reshape(-1, len(MOUNTED))
    run, sensor, lens = (np.repeat(own[camera], 2) for own in (numbers.run, numbers.sensor, numbers.camera))
    beside = np.full(2 * m, -1, np.int32)
    return Observations(
        np.repeat(kind, 2), np.stack([run, np.full(2 * m, FIXED, np.int32)], axis=-1).astype(np.int32),
        np.stack([np.repeat(epochs_gps_ns, 2), np.zeros(2 * m, np.int64)], axis=-1), ends, observed.ravel(),
        (measured.sigma_px[:, None] / steep).ravel(), np.repeat(np.arange(m), 2),
        first_place[np.repeat(measured.point, 2)],
        surveyed.ravel(), np.stack([sensor, beside], axis=-1).astype(np.int32), seats, lens.astype(np.int32),
        filmed.reshape(-1, len(CAMERA)),
    )  # fmt: skip


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
