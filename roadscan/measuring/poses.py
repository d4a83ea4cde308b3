"""Places and orientations of pictures on the map, with the uncertainty that trajectory and mounting state.

Orientations of pictures in the conventions that other programs use.

Camera axes are OpenCV's: x right, y down, z ahead. Image axes of photogrammetry are x right, y up, z backwards.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.frames import SENSOR_FROM_OPENCV, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import of_run
from roadscan.core.rig import Sensor
from roadscan.georeference.picture_axes import camera_from_map, map_from_ned
from roadscan.georeference.plan.plan import SurveyPlan, mountings_of, trajectory_source
from roadscan.georeference.sources import MOUNTING_COLUMNS, MOUNTING_SIGMAS, key_of_row, load_mountings
from roadscan.navigation.tasks.trajectories import (
    TrajectorySource,
    load_corrections,
    load_trajectory,
    pose_sigma,
    stated_pose_sigma,
)
from roadscan.pictures.lens import JOINT, PARAMETERS, JointCovariances, load_joint_covariances
from roadscan.pictures.lens import TABLE as CAMERA_CHANGES
from roadscan.pictures.placed import Pictures
from roadscan.poses.trajectory import world_from_ned
from roadscan.store.small_tables import read_small

_IMAGE_FROM_CAMERA: Final = np.diag([1.0, -1.0, -1.0])
"""Image axes of photogrammetry (right, up, backwards) from OpenCV's (right, down, ahead); its own inverse."""


def nearest_rotation(matrix: Float64) -> Float64:
    """Return the rotations (n, 3, 3) nearest to matrices that also scale (n, 3, 3). Polar decomposition by SVD."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v, np.float64)


def omega_phi_kappa_deg(map_from_camera: Float64) -> Float64:
    """Return ω, φ, κ (n, 3; degrees) of rotations (n, 3, 3) from camera axes to easting, northing, height.

    The image axes are turned into those of the map by Rx(ω) · Ry(φ) · Rz(κ) (Kraus 2007, Photogrammetry, B 3.3).
    """
    r = map_from_camera @ _IMAGE_FROM_CAMERA
    omega, phi = np.arctan2(-r[:, 1, 2], r[:, 2, 2]), np.arcsin(np.clip(r[:, 0, 2], -1.0, 1.0))
    kappa = np.arctan2(-r[:, 0, 1], r[:, 0, 0])
    out: Float64 = np.degrees(np.stack([omega, phi, kappa], axis=-1))
    return out


def yaw_pitch_roll_deg(ned_from_camera: Float64) -> Float64:
    """Return yaw, pitch, roll (n, 3; degrees) of the optical axes of rotations (n, 3, 3) from camera axes to NED.

    Yaw is clockwise from true north, from 0 to 360; pitch is upwards from the horizon; roll is about the optical axis,
    positive where the picture's right side is lowered.
    """
    roll, pitch, yaw = rph_from_rotation(ned_from_camera @ SENSOR_FROM_OPENCV.T)
    return np.degrees(np.stack([yaw, pitch, roll], axis=-1))


_WORDS: Final = {0: "position", 3: "roll, pitch, heading"}
"""Words for the components of a pose, by the first of each."""
_LENS_WORDS: Final = {"focal length": slice(0, 2), "principal point": slice(2, 4), "distortion": slice(4, 9)}
"""Words for the parameters of a lens, with their place among `PARAMETERS`."""
_SINGULAR: Final = 1e-9
"""Eigenvalues of a correlation matrix that are smaller are rounding."""
_MOUNTED: Final = 12
"""Errors of a picture's pose and mounting; those of its lens follow."""


@dataclass(frozen=True, eq=False)
class PicturePoses:
    """Poses of n pictures; the order is that of `pictures`."""

    pictures: Pictures
    place_m: Float64
    """(n, 3) easting, northing, height of the projection centres."""
    geographic: Float64
    """(n, 3) longitude, latitude (degrees), ellipsoidal height (m) in the trajectory's datum; NaN of local frames."""
    camera_from_map: Float64
    """(n, 3, 3) from differences on the map to camera axes: a rotation with the map's scale in it."""
    map_from_ned: Float64
    """(n, 3, 3) derivative of the map by north, east, down."""
    ned_from_camera: Float64
    """(n, 3, 3) rotations."""
    influence: Float64
    """(n, 6, 12) how errors (of position by north, east, down; of attitude, lever arm, boresight by body axes)
    move the camera (north, east, down; m) and turn it (about north, east, down; rad)."""
    sigma: Float64
    """(n, 12) 1 σ of those errors (m and rad)."""
    lens_sigma: Float64
    """(n, 9) 1 σ of the lens's `PARAMETERS`; NaN where nothing states it."""
    root: Float64
    """(n, 21, 21) of the covariance of these 21 errors (pose, mounting, lens): root · rootᵀ. The first six columns are
    what is the pose's own, the others come with mounting and lens."""
    told: tuple[str, ...]
    """(n,) which σ are assumed because nothing states them; "" where all are stated."""
    correlation_s: float
    """Time after which errors of poses are correlated by 1/e (s), where no adjustment told how they are."""
    joint: Mapping[tuple[str, str], JointCovariances]
    """What an adjustment found, by run and camera."""

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self.told)

    @functools.cached_property
    def map_from_camera(self) -> Float64:
        """Rotations (n, 3, 3) from camera axes to easting, northing, height, without the map's scale."""
        return nearest_rotation(self.map_from_ned) @ self.ned_from_camera

    @functools.cached_property
    def covariance(self) -> Float64:
        """Covariance (n, 6, 6) of place (north, east, down; m) and small turn (about these axes; rad)."""
        scaled = self.influence @ self.root[:, :_MOUNTED]
        return scaled @ scaled.transpose(0, 2, 1)

    def assumed(self, number: int) -> str:
        """Return which σ of a picture's pose, mounting and lens nothing states; "" where all are stated."""
        missing = [words for words, part in _LENS_WORDS.items() if np.isnan(self.lens_sigma[number, part]).all()]
        lens = f"lens without σ of {', '.join(missing)}, taken as 0" if missing else ""
        return "; ".join(filter(None, (self.told[number], lens)))

    def shared(self, first: int, second: int) -> Float64:
        """Return the covariance (21, 21) of the errors of one picture (rows) with those of another.

        Errors of poses of a run hang together as an adjustment told, else they fade over time; those of different runs
        are independent. A mounting is one error, and so is a lens.
        """
        pictures = self.pictures
        one, other = (pictures.logs[pictures.log[k]] for k in (first, second))
        epochs = [int(pictures.epochs_gps_ns[k]) for k in (first, second)]
        fading = np.exp(-abs(epochs[0] - epochs[1]) / NS_PER_S / self.correlation_s) if one.run == other.run else 0.0
        alike = np.full(JOINT, fading)
        alike[6:] = 1.0 if one.sensor == other.sensor else 0.0
        found = np.asarray(self.root[first] * alike @ self.root[second].T)
        joint = self.joint.get((one.run, one.sensor)) if one.run == other.run else None
        told = None if joint is None else joint.between(epochs[0], epochs[1], self.correlation_s)
        if joint is not None and told is not None:
            own = np.einsum("kii->ki", joint.at(np.array(epochs)))[:, :6]
            roots = self.root[[first, second], :6]
            more = np.sqrt(np.maximum((roots**2).sum(axis=2) - own, 0.0))
            found[:6, :6] = told + np.diag(fading * more[0] * more[1])
        return found


def picture_poses(plan: SurveyPlan, pictures: Pictures) -> PicturePoses:
    """Return the poses of a survey's pictures on the map with their σ."""
    views, count = pictures.views, len(pictures)
    place, geographic = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    from_map, slope, level = (np.full((count, 3, 3), np.nan) for _ in range(3))
    for number, world in enumerate(pictures.worlds):
        own = np.flatnonzero(views.world == number)
        if not own.size:
            continue
        eye, turn = views.eye_world_m[own], views.opencv_from_world[own]
        place[own], from_map[own] = camera_from_map(pictures.map, world, eye, turn)
        slope[own] = map_from_ned(pictures.map, world, eye)
        level[own] = world_from_ned(world, eye).transpose(0, 2, 1) @ turn.transpose(0, 2, 1)
        if world != LOCAL_WORLD:
            geographic[own] = geodetic_from_world(world, eye)
    influence, sigma = np.zeros((count, 6, _MOUNTED)), np.zeros((count, _MOUNTED))
    lens_sigma, root = np.zeros((count, len(PARAMETERS))), np.zeros((count, JOINT, JOINT))
    told, joint = np.full(count, "", object), dict[tuple[str, str], JointCovariances]()
    for number in np.unique(pictures.log).tolist():
        own = np.flatnonzero(pictures.log == number)
        influence[own], sigma[own], told[own] = _errors(plan, pictures, number, own, level[own])
        log, epochs = pictures.logs[number], pictures.epochs_gps_ns[own]
        lens_sigma[own] = _lens_sigma(plan, log.sensor)
        known = load_joint_covariances(plan.store, log.run, log.sensor)
        root[own] = _root(np.hstack([sigma[own], np.nan_to_num(lens_sigma[own])]), known, epochs)
        joint |= {} if known is None else {(log.run, log.sensor): known}
    settings = plan.survey.config.navigation.calibration
    return PicturePoses(
        pictures, place, geographic, from_map, slope, level, influence, sigma, lens_sigma, root, tuple(told.tolist()),
        settings.traverse_time_constant_s, joint,
    )  # fmt: skip


def _errors(
    plan: SurveyPlan, pictures: Pictures, number: int, own: Int64, ned_from_camera: Float64
) -> tuple[Float64, Float64, str]:
    """Return influence (k, 6, 12) and σ (k, 12) of the errors of a log's pictures, and what is assumed of them."""
    log, epochs = pictures.logs[number], pictures.epochs_gps_ns[own]
    camera, calibrated = plan.survey.rig.sensors[log.sensor], load_mountings(plan.store)
    mountings = mountings_of(log.run, log.sensor, camera.mounting(), calibrated)
    influence = np.zeros((own.size, 6, 12))
    for part, mounting in mountings.pieces(epochs):
        rotation, lever = mounting.arrays()
        body = ned_from_camera[part] @ (rotation @ SENSOR_FROM_OPENCV).T
        influence[part, :3, 3:6] = -body @ _cross(lever)
        influence[part, :3, 6:9] = body
        influence[part, 3:, 3:6] = influence[part, 3:, 9:] = body
    influence[:, :3, :3] = np.eye(3)
    poses, assumed = _pose_sigma(plan, trajectory_source(log.run, plan.records), epochs)
    mounted, unknown = _mounting_sigma(plan, log.run, log.sensor, camera, epochs)
    told = "; ".join(filter(None, (assumed, unknown)))
    return influence, np.hstack([poses, mounted]), told


def _pose_sigma(plan: SurveyPlan, source: TrajectorySource, epochs: Int64) -> tuple[Float64, str]:
    """Return 1 σ (k, 6; m and rad) of poses: adjusted, else stated, else those of the settings."""
    settings, store = plan.survey.config.navigation.calibration, plan.store
    sigma = pose_sigma(store, plan.records, source, epochs, settings)
    _, stated = stated_pose_sigma(store, plan.records, source)
    known = [bool(np.isfinite(stated[:, k]).any()) for k in range(6)]
    span = (int(epochs.min()), int(epochs.max()))
    corrections = load_corrections(store, source.run)
    trajectory = load_trajectory(store, source, [span], plan.ground.max_gap_s)
    if trajectory.sigma_ned_m is not None and np.isfinite(trajectory.sigma_ned_m).all() and trajectory.sigma_ned_m.size:
        since = (trajectory.epochs_gps_ns - span[0]).astype(np.float64)
        for k in range(3):
            sigma[:, k] = np.interp((epochs - span[0]).astype(np.float64), since, trajectory.sigma_ned_m[:, k])
        known[:3] = [True] * 3
    if corrections is not None and corrections.sigma is not None and np.isfinite(corrections.sigma[:, 3:]).all():
        since = (corrections.epochs_gps_ns - span[0]).astype(np.float64)
        for k in range(3, 6):
            sigma[:, k] = np.interp((epochs - span[0]).astype(np.float64), since, corrections.sigma[:, k])
        known[3:] = [True] * 3
    missing = [words for first, words in _WORDS.items() if not all(known[first : first + 3])]
    return sigma, f"σ of {' and '.join(missing)} as in navigation.calibration" if missing else ""


def _mounting_sigma(plan: SurveyPlan, run: str, sensor: str, camera: Sensor, epochs: Int64) -> tuple[Float64, str]:
    """Return 1 σ (k, 6; m and rad) of a camera's mounting: adjusted, else calibrated, else the rig file's, else 0."""
    lever, turn = camera.lever_arm_sigma_m, camera.boresight_sigma_deg
    stated = np.array([*(lever or (np.nan,) * 3), *np.radians(turn or (np.nan,) * 3)])
    sigma = np.tile(stated, (epochs.size, 1))
    table = read_small(plan.store, "mountings")
    rows: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in () if table is None else table.sort_by("valid_from_gps_ns").to_pylist():
        rows.setdefault((row["run"], row["sensor"]), []).append(row)
    for row in of_run(rows, run, sensor) or ():
        values = np.array([np.nan if row[name] is None else row[name] for name in MOUNTING_SIGMAS])
        values[3:] = np.radians(values[3:])
        sigma[epochs >= row["valid_from_gps_ns"]] = values
    changes = read_small(plan.store, "mounting_corrections")
    held = {key_of_row(row): row for row in ([] if changes is None else changes.to_pylist())}
    sigma = _adjusted(held.get((run, sensor), held.get(("*", sensor))), MOUNTING_COLUMNS[:6], sigma)
    unknown = bool(np.isnan(sigma).any())
    return np.nan_to_num(sigma), "mounting without σ, taken as 0" if unknown else ""


def _lens_sigma(plan: SurveyPlan, sensor: str) -> Float64:
    """Return 1 σ (9,) of a camera's lens, `PARAMETERS`: adjusted, else the rig file's; NaN where nothing states it."""
    interior = plan.survey.rig.sensors[sensor].interior
    if interior is None or interior.model == "equirectangular":
        return np.zeros(len(PARAMETERS))
    two, five = (np.nan,) * 2, (np.nan,) * 5
    stated = [*(interior.sigma_focal_px or two), *(interior.sigma_principal_px or two)]
    stated += interior.sigma_distortion or five
    table = read_small(plan.store, CAMERA_CHANGES)
    held = {row["sensor"]: row for row in ([] if table is None else table.to_pylist())}
    return _adjusted(held.get(sensor), PARAMETERS, np.array(stated))


def _root(sigma: Float64, joint: JointCovariances | None, epochs: Int64) -> Float64:
    """Return a root (k, 21, 21) of the covariance of errors with σ (k, 21), see `PicturePoses.root`.

    joint : of an adjustment. What the pose's σ have beyond it, and what it did not estimate,
    is independent.
    """
    if joint is None:
        return sigma[:, :, None] * np.eye(JOINT)
    covariance = joint.at(epochs)
    diagonal = np.arange(JOINT)
    own = covariance[:, diagonal, diagonal]
    known_alone = np.hstack([np.maximum(own[:, :6], sigma[:, :6] ** 2), np.where(own > 0.0, own, sigma**2)[:, 6:]])
    covariance[:, diagonal, diagonal] = known_alone
    scale = np.sqrt(covariance[:, diagonal, diagonal])
    scale[scale == 0.0] = 1.0
    unit = covariance / (scale[:, :, None] * scale[:, None, :])
    pose, rest = slice(0, 6), slice(6, JOINT)
    root = np.zeros_like(unit)
    root[:, rest, rest], inverse = _symmetric_root(unit[:, rest, rest])
    root[:, pose, rest] = unit[:, pose, rest] @ inverse
    left = unit[:, pose, pose] - root[:, pose, rest] @ root[:, pose, rest].transpose(0, 2, 1)
    root[:, pose, pose] = _symmetric_root(left)[0]
    return np.asarray(scale[:, :, None] * root)


def _symmetric_root(matrix: Float64) -> tuple[Float64, Float64]:
    """Return roots R (k, m, m) of positive matrices, and R⁻ᵀ; 0 where rounding leaves nothing."""
    values, vectors = np.linalg.eigh(matrix)
    roots = np.sqrt(np.maximum(values, 0.0))
    inverse = np.where(values > _SINGULAR, 1.0 / np.maximum(roots, _SINGULAR), 0.0)
    return vectors * roots[:, None, :], vectors * inverse[:, None, :]


def _adjusted(row: Mapping[str, Any] | None, names: Sequence[str], sigma: Float64) -> Float64:
    """Return σ (…, k) of named values with those after an adjustment, for the values that it estimated."""
    if row is None:
        return sigma
    after, prior = (np.array([row[f"{w}sigma_{n}"] or 0.0 for n in names], np.float64) for w in ("", "prior_"))
    return np.where(prior > 0.0, after, sigma)


def _cross(vector: Float64) -> Float64:
    """Return the matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
