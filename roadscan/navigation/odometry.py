"""Motion of the vehicle from overlapping scans of a lidar: registration of pairs, and the rig's motion.

Matches the sweeps of a lidar with one another: the way of the sensor, by KISS-ICP.

The library's parts (Vizzo et al. 2023, *KISS-ICP: In Defense of Point-to-Point ICP*, RA-L 8) are called in its own
order, with one difference: the motion that it assumes is scaled to the time that the sweep took, and to the time since
the one before. So neither a sweep that is cut off nor one that is missing bends the poses. One thread makes the sums:
equal sweeps give equal bits.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.extras import needed
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2, ImuErrors
from roadscan.core.settings.navigation import OdometryConfig

LIBRARY: Final = "kiss_icp.kiss_icp"
WHAT: Final = "the section [navigation.odometry]"

FEWEST_POINTS: Final = 100
"""A sweep of which fewer thinned points are left is not matched: six unknowns, and most points see one plane."""
LEAST_HELD: Final = 0.02
"""Surfaces that hold a sweep less along a direction (mean square of their normals) leave it to the guess there: 1/3
where they face all ways alike, 0.11 to 0.24 in the town streets of KITTI, below 0.01 on a simulated road in open
land."""
_PRIMING: Final = 30
"""Sweeps that are matched forwards, backwards and forwards again: where a log begins on the way, the first ones seem to
stand still, since the circles of returns on the ground move with the rig; from what follows its speed is learnt."""
_JUDGED_EVERY_S: Final = 0.5  # time between sweeps whose surfaces are judged (s): sweeps in between see the same
_NEIGHBOURS: Final = 8  # points of which a normal is made: fewer follow the noise of ranges
_FLATNESS: Final = 0.1
"""Points are on a surface where their neighbours scatter along its normal with less than this share of the variance
of the next axis."""


@dataclass(frozen=True)
class Sweep:
    """One turn of a lidar's head."""

    xyz_m: npt.NDArray[np.floating[Any]]
    """(n, 3), axes of the sensor."""
    epochs_gps_ns: Int64
    """(n,) of the poses that place the returns; all equal where the maker has compensated the sweep for motion."""

    @property
    def span_gps_ns(self) -> tuple[int, int]:
        """First and last epoch."""
        return int(self.epochs_gps_ns.min()), int(self.epochs_gps_ns.max())


@dataclass(frozen=True)
class Matched:
    """Way of the sensor: a pose at the end of each sweep that was matched, and one at the beginning of the first."""

    epochs_gps_ns: Int64
    """(n,) ascending."""
    first_from_lidar: Float64
    """(n, 4, 4), from the sensor to the sensor of the first pose."""
    thin_gps_ns: Int64
    """(t,) epochs of sweeps with too few points, which have no pose."""
    judged_gps_ns: Int64
    """(j,) epochs of the sweeps whose surfaces were counted."""
    held: Float64
    """(j,) share of their normals' squares along the direction that they hold least: 1/3 at best, 0 in a tunnel."""

    @property
    def is_held(self) -> npt.NDArray[np.bool_]:
        """(n,) whether surfaces held the last sweep that was judged by then along all directions."""
        last = np.searchsorted(self.judged_gps_ns, self.epochs_gps_ns, side="right") - 1
        return (self.held >= LEAST_HELD)[np.maximum(last, 0)]


def match(sweeps: Iterable[Sweep], config: OdometryConfig, near_m: float, far_m: float) -> Matched:
    """Return the way of the sensor.

    Parameters
    ----------
    sweeps : ascending in time, each with a return.
    near_m, far_m : returns outside these distances from the sensor are not matched.
    """
    rest = iter(sweeps)
    first = list(itertools.islice(rest, _PRIMING))
    motion = np.zeros(6)
    for order in (first, first[::-1]):
        motion = _Matcher(config, near_m, far_m, motion).all(order).motion
    return _Matcher(config, near_m, far_m, motion).all(itertools.chain(first, rest)).matched()


class _Matcher:
    """The library's parts, and the poses so far."""

    def __init__(self, config: OdometryConfig, near_m: float, far_m: float, motion: Float64) -> None:
        library = needed(LIBRARY, WHAT)
        # All fields are stated, so that no variable of the environment changes a result.
        self._parts = library.KissICP(
            library.KISSConfig(
                data={"max_range": far_m, "min_range": near_m, "deskew": True},
                mapping={"voxel_size": config.voxel_m, "max_points_per_voxel": 20},
                registration={"max_num_iterations": 500, "convergence_criterion": 1e-4, "max_num_threads": 1},
                adaptive_threshold={"fixed_threshold": None, "initial_threshold": 2.0, "min_motion_th": 0.1},
            )
        )
        self.motion = motion
        """Shift (m/s) and turn (rad/s) of the sensor in its axes."""
        self._pose = np.eye(4)
        self._epochs: list[int] = []
        self._poses: list[Float64] = []
        self._thin: list[int] = []
        self._judged: list[tuple[int, float]] = []

    def all(self, sweeps: Iterable[Sweep]) -> Self:
        """Match sweeps, ascending or descending in time."""
        for sweep in sweeps:
            self._add(sweep)
        return self

    def _add(self, sweep: Sweep) -> None:
        """Match a sweep, and join it to the map."""
        parts, (begin, end) = self._parts, sweep.span_gps_ns
        span_s = (end - begin) / NS_PER_S
        stamps = (sweep.epochs_gps_ns - begin) / NS_PER_S if span_s else np.zeros(0)  # none: nothing to compensate
        frame = parts.preprocessor.preprocess(sweep.xyz_m.astype(np.float64), stamps, _step(self.motion, span_s))
        source, kept = parts.voxelize(frame)
        if len(source) < FEWEST_POINTS:
            self._thin.append(end)
            return
        elapsed_s = (end - self._epochs[-1]) / NS_PER_S if self._epochs else 0.0
        if self._epochs and elapsed_s == 0.0:
            return
        guess = self._pose @ _step(self.motion, elapsed_s)
        sigma = parts.adaptive_threshold.get_threshold()
        pose: Float64 = np.asarray(
            parts.registration.align_points_to_map(
                points=source, voxel_map=parts.local_map, initial_guess=guess,
                max_correspondance_distance=3 * sigma, kernel=sigma,
            )
        )  # fmt: skip
        parts.adaptive_threshold.update_model_deviation(model_deviation=np.linalg.inv(guess) @ pose)
        parts.local_map.update(kept, pose)
        if self._epochs:
            self.motion = _rate(np.linalg.inv(self._pose) @ pose, elapsed_s)
        else:
            self._begin(begin, end)
        self._pose = pose
        self._epochs.append(end)
        self._poses.append(pose)
        if not self._judged or end - self._judged[-1][0] >= _JUDGED_EVERY_S * NS_PER_S:
            self._judged.append((end, _least_held(source, kept)))

    def _begin(self, begin: int, end: int) -> None:
        if end > begin:
            self._epochs.append(begin)
            self._poses.append(np.asarray(np.linalg.inv(_step(self.motion, (end - begin) / NS_PER_S)), np.float64))

    def matched(self) -> Matched:
        """Return what was matched so far."""
        poses = np.stack(self._poses) if self._poses else np.zeros((0, 4, 4))
        first = np.linalg.inv(poses[0]) if self._poses else np.eye(4)
        judged = np.array(self._judged).reshape(-1, 2)
        return Matched(
            np.array(self._epochs, np.int64), first @ poses, np.array(self._thin, np.int64),
            np.array([epoch for epoch, _ in self._judged], np.int64), judged[:, 1],
        )  # fmt: skip


def _step(motion: Float64, seconds: float) -> Float64:
    """Return the (4, 4) displacement by a motion of a while."""
    from scipy.spatial.transform import Rotation

    step = np.eye(4)
    step[:3, 3] = motion[:3] * seconds
    step[:3, :3] = Rotation.from_rotvec(motion[3:] * seconds).as_matrix()
    return step


def _rate(step: Float64, seconds: float) -> Float64:
    """Return the motion whose :func:`_step` is `step`."""
    from scipy.spatial.transform import Rotation

    return np.concatenate([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()]) / seconds


def _least_held(points_m: Float64, around_m: Float64) -> float:
    """Return how well surfaces hold points (n, 3) along the worst direction: mean square of their normals along it."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(around_m).query(points_m, k=min(_NEIGHBOURS, len(around_m)))
    patches = around_m[near] - around_m[near].mean(axis=1, keepdims=True)
    size, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))
    normals = axes[size[:, 0] < _FLATNESS * size[:, 1], :, 0]
    return float(np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))[0])


def sweeps_of(parts: Iterable[tuple[Any, Sweep]]) -> Iterator[Sweep]:
    """Yield whole sweeps of pieces that come in order of time, each with the name of its sweep; two may overlap."""
    open_: dict[Any, list[Sweep]] = {}
    for name, piece in parts:
        if name not in open_ and len(open_) > 1:
            yield _joined(open_.pop(next(iter(open_))))
        open_.setdefault(name, []).append(piece)
    yield from (_joined(pieces) for pieces in open_.values())


def _joined(pieces: list[Sweep]) -> Sweep:
    return Sweep(np.concatenate([p.xyz_m for p in pieces]), np.concatenate([p.epochs_gps_ns for p in pieces]))


WINDOW_S: Final = 5.0
"""Length of the pieces over which accelerations are averaged and turns compared (s): shorter than a turn of a road."""
_FLOOR_M, _FLOOR_DEG = 0.02, 0.1
"""1 σ of a pose beside its neighbours: centimetres by the noise of ranges and the cubes of the map."""
_AROUND_S: Final = 0.25  # time before and after an end of a window over which its speed is taken (s)
_SPEED_SIGMA_M_PER_S: Final = 0.1  # of the way at the ends of a window: centimetres in half a second, and its change
STANDING_SIGMA_DEG: Final = 2.0
"""1 σ of roll and pitch where no accelerometer says where up is: cross slope and grade of a road, springs."""


@dataclass(frozen=True)
class Way:
    """Poses of the rig's reference point in a local frame."""

    epochs_gps_ns: Int64
    """(n,) ascending."""
    position_m: Float64
    """(n, 3), 0 at the first pose; z is up."""
    world_from_body: Float64
    """(n, 3, 3)."""

    @property
    def seconds(self) -> Float64:
        """Time since the first pose (n,)."""
        seconds: Float64 = (self.epochs_gps_ns - self.epochs_gps_ns[0]) / NS_PER_S
        return seconds

    @property
    def path_m(self) -> Float64:
        """Way since the first pose (n,)."""
        steps = np.linalg.norm(np.diff(self.position_m, axis=0), axis=1)
        path: Float64 = np.append(0.0, np.cumsum(steps))
        return path

    def turned(self, rotation: Float64) -> Way:
        """Return the way in axes turned by a rotation (3, 3)."""
        return Way(self.epochs_gps_ns, self.position_m @ rotation.T, rotation @ self.world_from_body)


@dataclass(frozen=True)
class Windows:
    """What an IMU measured in pieces of the drive."""

    epochs_gps_ns: Int64
    """(w + 1,) limits of the pieces."""
    up_world: Float64
    """(w, 3) mean specific force less the mean acceleration of the way (m/s²): upwards."""
    turn_rad: Float64
    """(w,) turn about the way's upward axis by the gyroscopes less that of the way."""


def way_of(epochs_gps_ns: Int64, first_from_lidar: Float64, body_from_lidar: Float64, lever_body_m: Float64) -> Way:
    """Return the way of the reference point, level and heading along y at the first pose.

    Parameters
    ----------
    first_from_lidar : (n, 4, 4) poses of the lidar in the axes of the first.
    body_from_lidar, lever_body_m : its mounting, (3, 3) and (3,).
    """
    rotation = body_from_lidar @ first_from_lidar[:, :3, :3] @ body_from_lidar.T
    position = first_from_lidar[:, :3, 3] @ body_from_lidar.T + lever_body_m - rotation @ lever_body_m
    return Way(epochs_gps_ns, position, rotation).turned(ENU_FROM_NED)


def windows_of(
    way: Way, epochs_gps_ns: Int64, force_body_m_per_s2: Float64, rate_body_rad_per_s: Float64
) -> Windows | None:
    """Return what an IMU's samples (m,), (m, 3), (m, 3) say of a way; None where they cover no whole window."""
    from scipy.spatial.transform import Rotation, Slerp

    own = (epochs_gps_ns >= way.epochs_gps_ns[0]) & (epochs_gps_ns <= way.epochs_gps_ns[-1])
    limits = np.arange(way.epochs_gps_ns[0], way.epochs_gps_ns[-1] + 1, round(WINDOW_S * NS_PER_S))
    if limits.size < 2 or own.sum() < 2:
        return None
    seconds = (epochs_gps_ns[own] - way.epochs_gps_ns[0]) / NS_PER_S
    limits_s = (limits - way.epochs_gps_ns[0]) / NS_PER_S
    turned = Slerp(way.seconds, Rotation.from_matrix(way.world_from_body))
    attitude = turned(seconds)
    force, rate = attitude.apply(force_body_m_per_s2[own]), attitude.apply(rate_body_rad_per_s[own])
    piece = np.searchsorted(limits_s, seconds, side="right") - 1
    inside = (piece >= 0) & (piece < limits.size - 1)
    count = np.bincount(piece[inside], minlength=limits.size - 1)
    if not count.all():
        return None
    means = [np.bincount(piece[inside], column[inside], limits.size - 1) / count for column in (*force.T, rate[:, 2])]
    relative = turned(limits_s[1:]) * turned(limits_s[:-1]).inv()
    by_way = relative.as_euler("ZYX")[:, 0]
    by_gyros = means[3] * WINDOW_S
    difference = np.angle(np.exp(1j * (by_gyros - by_way)))
    return Windows(
        limits, np.stack(means[:3], axis=-1) - np.diff(_velocity(way, limits_s), axis=0) / WINDOW_S, difference
    )


def _velocity(way: Way, seconds: Float64) -> Float64:
    """Return velocities (n, 3) at times (n,) since the first pose, means over half a second around them."""
    from_s, to_s = np.maximum(seconds - _AROUND_S, 0.0), np.minimum(seconds + _AROUND_S, way.seconds[-1])
    before, after = (
        np.stack([np.interp(at, way.seconds, way.position_m[:, i]) for i in range(3)], axis=-1) for at in (from_s, to_s)
    )
    velocity: Float64 = (after - before) / (to_s - from_s)[:, None]
    return velocity


def levelled(way: Way, windows: Windows) -> Way:
    """Return the way turned so that the mean of all specific forces points up."""
    from scipy.spatial.transform import Rotation

    (turn,) = _to_up(windows.up_world.mean(axis=0, keepdims=True))
    return way.turned(Rotation.from_rotvec(turn).as_matrix())


def unbent(way: Way, windows: Windows, is_held: npt.NDArray[np.bool_]) -> Way:
    """Return the way turned so that specific forces point up all along it: its roll and pitch drift no more.

    Each step between two poses is turned like the poses; what the lidar measured of it stays as it is. Pieces in which
    surfaces do not hold a pose (n,) do not count: the speed is guessed there, and with it what is left of the forces.
    """
    from scipy.spatial.transform import Rotation

    guessed = np.searchsorted(windows.epochs_gps_ns, way.epochs_gps_ns[~is_held], side="right") - 1
    counts = ~np.isin(np.arange(len(windows.up_world)), guessed)
    if not counts.any():
        return way
    middles = ((windows.epochs_gps_ns[1:] + windows.epochs_gps_ns[:-1]) / 2 - way.epochs_gps_ns[0])[counts]
    turns = _to_up(windows.up_world[counts])
    turn = np.stack([np.interp(way.seconds, middles / NS_PER_S, turns[:, i]) for i in range(3)], axis=-1)
    steps = Rotation.from_rotvec((turn[1:] + turn[:-1]) / 2).apply(np.diff(way.position_m, axis=0))
    position = np.concatenate([way.position_m[:1], way.position_m[0] + np.cumsum(steps, axis=0)])
    return Way(way.epochs_gps_ns, position, Rotation.from_rotvec(turn).as_matrix() @ way.world_from_body)


def _to_up(up: Float64) -> Float64:
    """Return rotation vectors (n, 3) that turn directions (n, 3) to z."""
    axis = np.column_stack([up[:, 1], -up[:, 0], np.zeros(len(up))])  # up × z
    level = np.linalg.norm(axis, axis=1)
    turn: Float64 = axis * (np.arctan2(level, up[:, 2]) / np.maximum(level, 1e-12))[:, None]
    return turn


def tilt_sigma_rad(errors: ImuErrors) -> float:
    """Return 1 σ of roll and pitch of a way that was unbent."""
    return float(
        np.hypot(1e-3 * errors.accel_bias_mg, np.sqrt(2) * _SPEED_SIGMA_M_PER_S / WINDOW_S / STANDARD_GRAVITY_M_PER_S2)
    )


def sigmas(
    way: Way, is_held: npt.NDArray[np.bool_], config: OdometryConfig, tilt_rad: float, *, is_unbent: bool
) -> tuple[Float64, Float64]:
    """Return 1 σ of positions (n, 3; north, east, down; m) and of roll, pitch, heading (n, 3; rad).

    Where the surfaces around do not hold a pose (n,), matching pulls it back by any part of the way: there σ grows by
    the greatest speed that the rig had elsewhere.
    """
    path, away = way.path_m, np.linalg.norm(way.position_m[:, :2], axis=1)
    step_s = np.diff(way.seconds)
    fastest = np.max(np.diff(path) / step_s, where=is_held[1:], initial=0.0)
    guessed = np.append(0.0, np.cumsum(np.where(is_held[1:], 0.0, fastest * step_s)))
    level = np.hypot(np.hypot(_FLOOR_M, config.drift_share * path), guessed)
    angle = np.radians(np.hypot(_FLOOR_DEG, config.drift_deg_per_100m * path / 100.0))
    tilt = np.hypot(np.radians(_FLOOR_DEG) if is_unbent else angle, tilt_rad) + np.zeros_like(angle)
    return np.column_stack([level, level, np.hypot(level, tilt_rad * away)]), np.column_stack([tilt, tilt, angle])
