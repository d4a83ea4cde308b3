"""Estimates the orientation of a sensor head from the IMU inside it and the trajectory, in stop-and-go driving.

While the vehicle stands, gravity gives roll and pitch of the head, as well as the biases of its accelerometers allow.
When it turns, the vector of the angular rate gives both without them; gravity then gives the biases; and braking and
driving through curves give the heading. All of it is one least-squares adjustment over short windows:

- **Force.** Over 2 T with triangular weights, the mean acceleration of the head is a second difference of its
  positions, (x(t + T) − 2 x(t) + x(t − T)) / T², and needs no derivative of the trajectory. It is compared with the
  mean of the specific forces, each turned by the attitude of its epoch.
- **Rotation.** Between two epochs, the head's rotation vector is the body's in other axes, exactly, if the rates are
  composed with coning and the body's rotation counts against inertial space.

Beside the orientation, the adjustment holds as unknown, each with its prior: biases of gyroscopes and accelerometers
(Gauss–Markov, as `ImuErrors` states them), their scales, the attitude error of the trajectory (Gauss–Markov), the
head's lever arm, and the time by which its stamps are late. The noise of the windows is taken from their residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_matrix, diags

from roadscan.calibrate.evidence import AttitudeInfluence, Orientation
from roadscan.calibrate.rotations import cross_matrix, exponential, logarithm
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import NavigationError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2, ImuErrors, Mounting
from roadscan.navigation.inertial.alignment import EARTH_RATE_ECEF_RAD_PER_S, gravity_ecef
from roadscan.navigation.inertial.readings import ImuReadings
from roadscan.poses.trajectory import Trajectory

KIND: Final = "stop and go"

_FORCE_S: Final = 1.0
"""Half the width of a window of forces: the error of a second difference falls with its power 1.5."""
_TURN_S: Final = 0.2
"""Length of a window of rotations: short compared with the body's motion on its springs."""
_KNOT_S: Final = 2.0
"""Slow errors are linear between knots this far apart: as they wander between knots, windows of one curve err alike,
which their residuals do not show."""
_PIECE_S: Final = 150.0
"""Longer runs are cut into pieces whose slow errors are independent."""
_CLOCK_SIGMA_S: Final = 0.01
"""1 σ of the delay of stamps: half a sample, and what is left after the clocks' estimate."""
_CLOCK_STEP_NS: Final = 5_000_000  # Step of the numerical derivative by the delay of stamps.
_UNKNOWN_RAD: Final = 1.0
"""Prior σ of the orientation, which stands for no prior."""
_ROUNDS: Final = 12  # Most rounds of the adjustment.
_HUBER: Final = 3.0  # Residuals beyond this many times the robust scale get less weight.
_LOCAL_GRAVITY_SIGMA_M_PER_S2: Final = 0.03  # Of gravity in local frames.
_LOCAL_RATE_SIGMA_RAD_PER_S: Final = 7.3e-5
"""In a local frame the Earth's rotation is not known better; it is added to the gyroscopes' bias."""
_STANDING_M_PER_S: Final = 0.05  # Below this speed a window counts as standing.
_FAR_OFF_RAD: Final = np.radians(20.0)  # Largest change of the nominal orientation.

_SHARED: Final = 6
"""Unknowns that all runs share: orientation (3), lever arm (3)."""
_SLOW: Final = 9
"""Unknowns of a knot: bias of the accelerometers (3), of the gyroscopes (3), attitude error (3)."""
_FIXED: Final = 7
"""Unknowns of a run: scales of accelerometers (3) and gyroscopes (3), delay (1)."""

_Rows = tuple[Float64, Float64, csr_matrix]


@dataclass(frozen=True)
class HeadRun:
    """One run with the samples of a head's IMU."""

    readings: ImuReadings
    """Samples; their epochs are instants."""
    trajectory: Trajectory
    sigma_roll_pitch_heading_rad: tuple[float, float, float]
    """1 σ of the trajectory's attitude."""
    time_constant_s: float = 60.0
    """Of its error."""


@dataclass(frozen=True)
class HeadOrientation:
    """Orientation of a head's IMU, with statistics of its estimation."""

    body_from_imu: Float64
    """(3, 3)"""
    covariance_rad2: Float64
    """(3, 3) of a small rotation about the body's axes that follows `body_from_imu`."""
    correction_rad: Float64
    """(3,) from the nominal orientation to this one."""
    windows: int
    """Number of windows of forces."""
    standing: int
    """Number of those during which the vehicle stood."""
    late_s: tuple[float, ...]
    """Delay of the stamps of the head's IMU, by run (pieces of long ones)."""
    accelerometer_bias_m_per_s2: Float64
    """(runs or pieces, 3) mean over each, IMU axes."""
    attitude: tuple[AttitudeInfluence, ...] = ()
    """By run or piece: the part of the error that comes from the trajectory, which other heads share."""

    @property
    def sigma_rad(self) -> Float64:
        """(3,) about body x, y, z."""
        return np.sqrt(np.diag(self.covariance_rad2))

    def evidence(self, sensor: str, sensor_nominal: Mounting, imu_nominal: Mounting) -> Orientation:
        """Return the orientation of the sensor in whose head the IMU sits, through the rig file's relative rotation."""
        body_from_sensor, _ = sensor_nominal.arrays()
        body_from_imu, _ = imu_nominal.arrays()
        imu_from_sensor = body_from_imu.T @ body_from_sensor
        body_from_sensor = self.body_from_imu @ imu_from_sensor
        return Orientation(KIND, sensor, body_from_sensor, self.covariance_rad2, self.attitude)


def find_orientation(
    runs: Sequence[HeadRun],
    nominal: Mounting,
    lever_arm_sigma_m: tuple[float, float, float],
    errors: ImuErrors,
) -> HeadOrientation:
    """Estimate the orientation of a head's IMU.

    Parameters
    ----------
    runs : drives that stop and go; biases are those of each.
    nominal : mounting of the IMU as the rig file states it; its rotation may be off by some degrees.
    lever_arm_sigma_m : 1 σ of its lever arm (forward, right, down).
    errors : of the IMU.

    Raises
    ------
    NavigationError
        where no run has samples with poses for a window, or the head's motion is not the vehicle's.
    """
    prepared = [_Run(piece, nominal, errors) for run in runs for piece in _pieces(run)]
    prepared = [run for run in prepared if run.count]
    if not prepared:
        raise NavigationError(
            "no samples of the head's IMU have poses around them",
            expected=f"runs of more than {2 * _FORCE_S:g} s with a trajectory and the IMU's log",
        )
    rotation, _ = nominal.arrays()
    noise = _Noise.first(errors, 1.0 / prepared[0].rate_hz)
    solution = _solved(prepared, rotation, np.array(lever_arm_sigma_m), noise)
    for _ in range(_ROUNDS):
        rotation = exponential(solution.step_rad) @ rotation
        noise = noise.renewed(solution)
        solution = _solved(prepared, rotation, np.array(lever_arm_sigma_m), noise)
        if (np.abs(solution.step_rad) < 1e-3 * np.sqrt(np.diag(solution.covariance))).all():
            break
    rotation = exponential(solution.step_rad) @ rotation
    return _result(prepared, rotation, nominal, solution)


def _pieces(run: HeadRun) -> Iterator[HeadRun]:
    """Cut a run into pieces of `_PIECE_S` at most."""
    epochs = run.readings.epochs_gps_ns
    if not epochs.size:
        return
    count = max(1, round((epochs[-1] - epochs[0]) / NS_PER_S / _PIECE_S))
    for part in np.array_split(np.arange(epochs.size), count):
        chosen = slice(int(part[0]), int(part[-1]) + 1)
        readings = ImuReadings(
            epochs[chosen],
            run.readings.angular_rate_rad_per_s[chosen],
            run.readings.specific_force_m_per_s2[chosen],
        )
        yield replace(run, readings=readings)


class _Run:
    """Windows of one run, with what does not depend on the orientation."""

    def __init__(self, run: HeadRun, nominal: Mounting, errors: ImuErrors) -> None:
        self._run = run
        self._lever_m = nominal.arrays()[1]
        readings = run.readings
        self.epochs = readings.epochs_gps_ns
        self._local = run.trajectory.world == LOCAL_WORLD
        step = int(np.median(np.diff(self.epochs))) if self.epochs.size > 1 else NS_PER_S
        self.rate_hz = NS_PER_S / step
        found = run.trajectory.poses(self.epochs)
        usable = found.found & np.isfinite(readings.angular_rate_rad_per_s).all(1)
        usable &= np.isfinite(readings.specific_force_m_per_s2).all(1)
        breaks = np.cumsum(np.r_[0, np.diff(self.epochs) > 2.5 * step])
        self._unbroken = _Unbroken(breaks, usable)
        self._force_windows(found.world_from_body)
        self._turn_windows()
        self._priors(errors)

    @property
    def count(self) -> int:
        """Number of windows of forces."""
        return len(self.force_centres)

    def _force_windows(self, world_from_body: Float64) -> None:
        half = round(_FORCE_S * self.rate_hz)
        middle = np.arange(half, self.epochs.size - half, half)
        middle = middle[self._unbroken.between(middle - half, middle + half)]
        middle = middle[self._posed(middle, round(_FORCE_S * NS_PER_S))]
        self.force_centres = middle
        self._body_from_world = np.swapaxes(world_from_body[middle], 1, 2)
        rows = middle[:, None] + np.arange(-half + 1, half)
        seconds = (self.epochs[rows] - self.epochs[middle][:, None]) / NS_PER_S
        weight = np.maximum(1.0 - np.abs(seconds) / _FORCE_S, 0.0)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        force = self._run.readings.specific_force_m_per_s2
        self.turned = np.empty((middle.size, 3, 3))
        self.force = np.empty((middle.size, 3, 3, 3))
        for index, row in enumerate(rows):
            matrices = np.einsum("ij,sjk,s->sik", self._body_from_world[index], world_from_body[row], weight[index])
            self.turned[index] = matrices.sum(axis=0)
            self.force[index] = np.einsum("sij,sk->ijk", matrices, force[row])
        self.felt, self.lever, self.speed = self._felt(0)
        later, earlier = self._felt(_CLOCK_STEP_NS)[0], self._felt(-_CLOCK_STEP_NS)[0]
        self.felt_by_time = (later - earlier) / (2 * _CLOCK_STEP_NS / NS_PER_S)

    def _posed(self, samples: Int64, around_ns: int) -> npt.NDArray[np.bool_]:
        """Return which samples have poses at their epochs and on both sides."""
        whole = np.ones(samples.size, dtype=bool)
        for side in (-around_ns, 0, around_ns):
            for late in (-_CLOCK_STEP_NS, _CLOCK_STEP_NS):
                whole &= self._run.trajectory.poses(self.epochs[samples] + side + late).found
        return whole

    def _felt(self, late_ns: int) -> tuple[Float64, Float64, Float64]:
        """Mean specific force (n, 3) from the trajectory, body axes; derivative by lever arm (n, 3, 3); speed (n,)."""
        epochs = self.epochs[self.force_centres] + late_ns
        step = round(_FORCE_S * NS_PER_S)
        before, here, after = (self._run.trajectory.poses(epochs + side) for side in (-step, 0, step))
        by_lever = (after.world_from_body - 2 * here.world_from_body + before.world_from_body) / _FORCE_S**2
        position = (after.position_world_m - here.position_world_m) - (here.position_world_m - before.position_world_m)
        velocity = (after.position_world_m - before.position_world_m) / (2 * _FORCE_S)
        velocity += (after.world_from_body - before.world_from_body) @ self._lever_m / (2 * _FORCE_S)
        force = position / _FORCE_S**2 + by_lever @ self._lever_m - self._gravity(here.position_world_m)
        if not self._local:
            force += 2 * np.cross(EARTH_RATE_ECEF_RAD_PER_S, velocity)
        speed = np.linalg.norm(after.position_world_m - before.position_world_m, axis=1) / (2 * _FORCE_S)
        # The axes are those of the window's middle as the samples were turned, whatever the time.
        return (
            np.einsum("nij,nj->ni", self._body_from_world, force),
            self._body_from_world @ by_lever,
            speed,
        )

    def _gravity(self, position_m: Float64) -> Float64:
        if self._local:
            return np.broadcast_to(np.array([0.0, 0.0, -STANDARD_GRAVITY_M_PER_S2]), position_m.shape)
        return np.array([gravity_ecef(p) for p in position_m]).reshape(-1, 3)

    def _turn_windows(self) -> None:
        stride = max(1, round(_TURN_S * self.rate_hz))
        start = np.arange(0, max(self.epochs.size - stride, 0), stride)
        start = start[self._unbroken.between(start, start + stride)]
        start = start[self._posed(start, round(2 * _TURN_S * NS_PER_S))]
        end = start + stride
        attitude = _composed(self._run.readings)
        self.turn_starts = start
        self.turn_seconds = (self.epochs[end] - self.epochs[start]) / NS_PER_S
        self.head_turn = logarithm(np.swapaxes(attitude[start], 1, 2) @ attitude[end])
        self.body_turn = self._body_turn(start, end, 0)
        later, earlier = (self._body_turn(start, end, late) for late in (_CLOCK_STEP_NS, -_CLOCK_STEP_NS))
        self.body_turn_by_time = (later - earlier) / (2 * _CLOCK_STEP_NS / NS_PER_S)

    def _body_turn(self, start: Int64, end: Int64, late_ns: int) -> Float64:
        """Return (n, 3) rotation vectors of the body relative to inertial space, body axes of the start."""
        first, last = (self._run.trajectory.poses(self.epochs[i] + late_ns).world_from_body for i in (start, end))
        earth = np.zeros(3) if self._local else EARTH_RATE_ECEF_RAD_PER_S
        turned = exponential(earth * self.turn_seconds[:, None]) @ last
        return logarithm(np.swapaxes(first, 1, 2) @ turned)

    def _priors(self, errors: ImuErrors) -> None:
        used = np.r_[self.force_centres, self.turn_starts]
        first, last = (int(self.epochs[i]) for i in (used.min(), used.max())) if used.size else (0, 0)
        span_s = max((last - first) / NS_PER_S, _KNOT_S)
        knots = max(int(np.ceil(span_s / _KNOT_S)), 1) + 1
        self._origin, self._knot_s = first, span_s / (knots - 1)
        self.knots = knots
        apart = np.abs(np.arange(knots)[:, None] - np.arange(knots)) * self._knot_s
        accelerometer = errors.accel_bias_mg * 1e-3 * STANDARD_GRAVITY_M_PER_S2
        gyroscope = np.radians(errors.gyro_bias_deg_per_h) / 3600.0
        if self._local:
            accelerometer = np.hypot(accelerometer, _LOCAL_GRAVITY_SIGMA_M_PER_S2)
            gyroscope = np.hypot(gyroscope, _LOCAL_RATE_SIGMA_RAD_PER_S)
        bias = np.exp(-apart / errors.bias_time_constant_s)
        attitude = np.exp(-apart / self._run.time_constant_s)
        sigma = [*[accelerometer] * 3, *[gyroscope] * 3, *self._run.sigma_roll_pitch_heading_rad]
        size = _SLOW * knots + _FIXED
        covariance = np.zeros((size, size))
        for axis, value in enumerate(sigma):
            place = np.arange(knots) * _SLOW + axis
            covariance[np.ix_(place, place)] = max(value, 1e-9) ** 2 * (bias if axis < 6 else attitude)
        scales = np.repeat([errors.accel_scale_ppm, errors.gyro_scale_ppm], 3) * 1e-6
        fixed = np.maximum([*scales, _CLOCK_SIGMA_S], 1e-9)
        place = np.arange(_SLOW * knots, size)
        covariance[place, place] = fixed**2
        covariance[np.diag_indices(size)] *= 1.0 + 1e-9
        self.prior = _inverse(covariance)

    def between(self, samples: Int64) -> tuple[Int64, Float64]:
        """Return the knot before each sample (n,), and the fraction to the next (n,) in [0, 1]."""
        at = (self.epochs[samples] - self._origin) / NS_PER_S / self._knot_s
        knot = np.clip(np.floor(at), 0, self.knots - 2).astype(np.int64)
        return knot, np.clip(at - knot, 0.0, 1.0)

    def attitude_influence(self, by_own: Float64) -> AttitudeInfluence:
        """Select, from errors (3, 9 knots + 7) by the run's unknowns, those by the trajectory's attitude."""
        knots = by_own[:, : _SLOW * self.knots].reshape(3, self.knots, _SLOW)
        epochs = self._origin + np.rint(np.arange(self.knots) * self._knot_s * NS_PER_S).astype(np.int64)
        sigma = self._run.sigma_roll_pitch_heading_rad
        return AttitudeInfluence(epochs, knots[:, :, 6:], sigma, self._run.time_constant_s)

    def rows(self, rotation: Float64) -> tuple[_Rows, _Rows]:
        """Return residuals (n, 3) and derivatives by shared (n, 3, 6) and the run's unknowns (3 n, 9 knots + 7)."""
        return self._force_rows(rotation), self._turn_rows(rotation)

    def _force_rows(self, rotation: Float64) -> _Rows:
        residual = np.einsum("nabc,bc->na", self.force, rotation) - self.felt
        by_axis = np.einsum("nabc,ec->nabe", self.force, rotation)
        by_turn = -np.einsum("nabe,bed->nad", by_axis, _LEVI_CIVITA)
        shared = np.concatenate([by_turn, -self.lever], axis=2)
        slow = np.concatenate([-self.turned @ rotation, np.zeros_like(by_turn), by_turn], axis=2)
        fixed = np.zeros((len(residual), 3, _FIXED))
        fixed[..., :3] = -np.einsum("nabc,bc->nac", self.force, rotation)
        fixed[..., 6] = -self.felt_by_time
        return residual, shared, self._own(self.force_centres, slow, fixed)

    def _turn_rows(self, rotation: Float64) -> _Rows:
        in_body = self.head_turn @ rotation.T
        residual = in_body - self.body_turn
        by_turn = -cross_matrix(in_body)
        by_bias = -self.turn_seconds[:, None, None] * rotation
        shared = np.concatenate([by_turn, np.zeros_like(by_turn)], axis=2)
        slow = np.concatenate([np.zeros_like(by_turn), by_bias, by_turn], axis=2)
        fixed = np.zeros((len(residual), 3, _FIXED))
        fixed[..., 3:6] = -rotation * self.head_turn[:, None, :]
        fixed[..., 6] = -self.body_turn_by_time
        return residual, shared, self._own(self.turn_starts, slow, fixed)

    def _own(self, samples: Int64, slow: Float64, fixed: Float64) -> csr_matrix:
        """Spread derivatives by slow errors (n, 3, 9) over the knots around, and append fixed ones (n, 3, 7)."""
        knot, way = self.between(samples)
        way = way[:, None, None]
        values = np.concatenate([slow * (1.0 - way), slow * way, fixed], axis=2)
        near = _SLOW * knot[:, None] + np.arange(2 * _SLOW)
        last = np.broadcast_to(_SLOW * self.knots + np.arange(_FIXED), (samples.size, _FIXED))
        columns = np.repeat(np.concatenate([near, last], axis=1), 3, axis=0)
        rows, wide = columns.shape
        starts = wide * np.arange(rows + 1)
        return csr_matrix((values.ravel(), columns.ravel(), starts), shape=(rows, _SLOW * self.knots + _FIXED))


_LEVI_CIVITA: Final[Float64] = cross_matrix(np.eye(3)).transpose(1, 0, 2)
"""(b, e, d): v × w = Σ ε[b, e, d] v[e] w[d]."""


@dataclass(frozen=True)
class _Unbroken:
    """Finds spans of samples without a gap or an unusable sample."""

    piece: Int64
    usable: npt.NDArray[np.bool_]

    def between(self, first: Int64, last: Int64) -> npt.NDArray[np.bool_]:
        """Return which spans (n,) are unbroken, both ends included."""
        bad = np.r_[0, np.cumsum(~self.usable)]
        whole: npt.NDArray[np.bool_] = (self.piece[first] == self.piece[last]) & (bad[last + 1] == bad[first])
        return whole


def _composed(readings: ImuReadings) -> Float64:
    """Return the (n, 3, 3) attitude at each sample relative to the first, from rates alone: means of neighbours."""
    seconds = np.diff(readings.epochs_gps_ns) / NS_PER_S
    rate = np.nan_to_num(readings.angular_rate_rad_per_s)
    steps = exponential(0.5 * (rate[1:] + rate[:-1]) * seconds[:, None])
    attitude = np.concatenate([np.eye(3)[None], steps])
    reach = 1
    while reach < len(attitude):
        attitude[reach:] = attitude[:-reach] @ attitude[reach:]
        reach *= 2
    return attitude


@dataclass(frozen=True)
class _Solution:
    """Result of one iteration of the adjustment."""

    step_rad: Float64
    """(3,) small rotation that follows the orientation."""
    covariance: Float64
    """(3, 3)"""
    own: tuple[Float64, ...]
    """Unknowns of each run."""
    force: tuple[Float64, ...]
    """Residuals (n, 3) after the adjustment, by run."""
    turn: tuple[Float64, ...]
    influence: tuple[Float64, ...]
    """By run: derivatives (3, 9 knots + 7) of the orientation by the prior values of the run's unknowns."""


@dataclass(frozen=True)
class _Noise:
    """1 σ of windows, body axes, and the weight of each window."""

    force: Float64
    """(3,) m/s²"""
    turn: Float64
    """(3,) rad"""
    force_least: float
    turn_least: float
    force_weight: tuple[Float64, ...] | None = None
    """By run: (n,)."""
    turn_weight: tuple[Float64, ...] | None = None

    @classmethod
    def first(cls, errors: ImuErrors, step_s: float) -> _Noise:
        """Return the noise that the IMU states; the noise from residuals is not taken lower."""
        density = errors.accel_noise_ug_per_sqrt_hz * 1e-6 * STANDARD_GRAVITY_M_PER_S2
        force = max(density * np.sqrt(2 / (3 * _FORCE_S)), 1e-5)
        walk = np.radians(errors.gyro_noise_deg_per_sqrt_h) / 60.0
        turn = max(walk * np.sqrt(max(_TURN_S, step_s)), 1e-7)
        return cls(np.full(3, max(force, 0.01)), np.full(3, max(turn, 1e-4)), force, turn)

    def renewed(self, solution: _Solution) -> _Noise:
        """Estimate the noise from residuals, robust against a tenth of outlying windows."""
        force, turn = _spread(solution.force, self.force_least), _spread(solution.turn, self.turn_least)
        return _Noise(
            force,
            turn,
            self.force_least,
            self.turn_least,
            tuple(_huber(r / force) for r in solution.force),
            tuple(_huber(r / turn) for r in solution.turn),
        )


def _spread(residuals: Sequence[Float64], least: float) -> Float64:
    """Return a robust scale (3,) that equals the root mean square of normal residuals."""
    whole = np.concatenate(residuals)
    if not whole.size:
        return np.full(3, least)
    middle = SIGMA_OF_MAD * np.median(np.abs(whole), axis=0)
    clipped = np.clip(whole, -_HUBER * middle, _HUBER * middle)
    return np.asarray(np.maximum(np.sqrt(np.mean(clipped**2, axis=0)), least))


def _huber(normed: Float64) -> Float64:
    worst = np.abs(normed).max(axis=1, initial=0.0)
    return np.asarray(np.minimum(1.0, _HUBER / np.maximum(worst, 1e-12)))


def _solved(runs: Sequence[_Run], rotation: Float64, lever_arm_sigma_m: Float64, noise: _Noise) -> _Solution:
    """Solve the linearised adjustment; each run's unknowns are eliminated."""
    shared = np.diag(1.0 / np.r_[np.full(3, _UNKNOWN_RAD), np.maximum(lever_arm_sigma_m, 1e-6)] ** 2)
    right = np.zeros(_SHARED)
    parts = []
    for index, run in enumerate(runs):
        own, mixed, own_right = run.prior.copy(), np.zeros((len(run.prior), _SHARED)), np.zeros(len(run.prior))
        for rows, sigma, weights in zip(
            run.rows(rotation), (noise.force, noise.turn), (noise.force_weight, noise.turn_weight), strict=True
        ):
            weight = np.ones(len(rows[0])) if weights is None else weights[index]
            scale = np.sqrt(weight)[:, None] / sigma
            r = (rows[0] * scale).ravel()
            a = (rows[1] * scale[..., None]).reshape(-1, _SHARED)
            b = diags(scale.ravel()) @ rows[2]
            shared += a.T @ a
            right -= a.T @ r
            own += (b.T @ b).toarray()
            mixed += b.T @ a
            own_right -= b.T @ r
        factor = cho_factor(own)
        parts.append((factor, mixed, own_right))
        shared -= mixed.T @ cho_solve(factor, mixed)
        right -= mixed.T @ cho_solve(factor, own_right)
    covariance = _inverse(shared)
    step = covariance @ right
    owns = tuple(cho_solve(factor, own_right - mixed @ step) for factor, mixed, own_right in parts)
    left = [_left_over(run, rotation, step, own) for run, own in zip(runs, owns, strict=True)]
    # x̂ = C Aᵀ V⁻¹ y with V = N + B P Bᵀ, and AᵀV⁻¹B = AᵀN⁻¹B (BᵀN⁻¹B + P⁻¹)⁻¹ P⁻¹ (Woodbury).
    influence = tuple(
        covariance[:3] @ cho_solve(factor, mixed).T @ run.prior
        for run, (factor, mixed, _) in zip(runs, parts, strict=True)
    )
    force, turn = zip(*left, strict=True)
    return _Solution(step[:3], covariance[:3, :3], owns, force, turn, influence)


def _left_over(run: _Run, rotation: Float64, step: Float64, own: Float64) -> tuple[Float64, Float64]:
    force, turn = (r + a @ step + (b @ own).reshape(-1, 3) for r, a, b in run.rows(rotation))
    return force, turn


def _inverse(matrix: Float64) -> Float64:
    return np.asarray(cho_solve(cho_factor(0.5 * (matrix + matrix.T)), np.eye(len(matrix))))


def _result(runs: Sequence[_Run], rotation: Float64, nominal: Mounting, solution: _Solution) -> HeadOrientation:
    correction = logarithm(rotation @ nominal.arrays()[0].T)
    sigma = np.sqrt(np.diag(solution.covariance))
    if np.linalg.norm(correction) > _FAR_OFF_RAD + 3 * sigma.max():
        first = iso_from_gps_ns(int(runs[0].epochs[0]))
        raise NavigationError(
            f"the head's IMU is turned by {np.degrees(np.linalg.norm(correction)):.1f}° against the rig file "
            f"(run from {first})",
            expected=f"less than {np.degrees(_FAR_OFF_RAD):.0f}°",
            change="check its axes and boresight in the rig file, the units of its log, and its clock",
        )
    slow = [
        own[: _SLOW * run.knots].reshape(-1, _SLOW).mean(axis=0) for run, own in zip(runs, solution.own, strict=True)
    ]
    return HeadOrientation(
        body_from_imu=rotation,
        covariance_rad2=solution.covariance,
        correction_rad=correction,
        windows=sum(run.count for run in runs),
        standing=sum(int((run.speed < _STANDING_M_PER_S).sum()) for run in runs),
        late_s=tuple(float(own[-1]) for own in solution.own),
        accelerometer_bias_m_per_s2=np.array([s[:3] for s in slow]),
        attitude=tuple(run.attitude_influence(by) for run, by in zip(runs, solution.influence, strict=True)),
    )
