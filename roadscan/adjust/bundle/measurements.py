"""Measurements in pictures as observations: residuals in metres at the point, and what moves them.

A camera that sees a place in a pixel says nothing of its distance. Of each coordinate of the pixel, column or row, let
g be its derivative by the point in the camera's axes (pixels a metre). Then n = g / |g| is the direction at the point
across the ray in which the pixel moves, and the residual of the pixel over |g| is how far the ray passes the point
along it. A correction of the pose moves the ray at the point as it moves a reading of a lidar there, so the derivatives
are those of all observations (:mod:`roadscan.adjust.observations`). The equations are those of a bundle block
adjustment with GNSS/INS (Förstner & Wrobel 2016, 15.2), but that its unknowns are corrections of each run's poses in
time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from roadscan.adjust.observations import CAMERA, COMPONENTS, FIXED, KINDS, MOUNTED, Observations
from roadscan.compute.array_types import Bool, Float64, Int32, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.pictures.exposures import Exposures
from roadscan.pictures.lens import PARAMETERS, changed, derivatives, pixels_of, rays_of
from roadscan.pictures.ties.tracks import places_of
from roadscan.pictures.views import Lens
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
