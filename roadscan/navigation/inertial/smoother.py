"""The smoother computes a trajectory from IMU, GNSS and odometer.

A loosely coupled error-state Kalman filter (:mod:`roadscan.navigation.inertial.kernels.kalman`) runs forwards over a
run, a smoother (:mod:`roadscan.navigation.inertial.kernels.kalman_smoother`) back. The order of things is
:mod:`~roadscan.navigation.inertial.timeline`, the first attitude :mod:`~roadscan.navigation.inertial.alignment`,
standstill :mod:`~roadscan.navigation.inertial.timeline`, the trust in readings
:mod:`~roadscan.navigation.inertial.noise`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import NavigationError
from roadscan.core.frames import quaternion_from_rotation
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.alignment import Alignment, align, ecef_from_level
from roadscan.navigation.inertial.kernels.kalman import filter_forwards
from roadscan.navigation.inertial.kernels.kalman_smoother import Poses, smooth_backwards, spread
from roadscan.navigation.inertial.kernels.kalman_states import (
    NAVIGATION,
    Layout,
    Model,
    Nodes,
    Record,
    Start,
    Track,
    Updates,
)
from roadscan.navigation.inertial.noise import usable
from roadscan.navigation.inertial.readings import (
    GnssSolutions,
    ImuReadings,
    Innovations,
    OdometerReadings,
    Solution,
    VehicleSensors,
)
from roadscan.navigation.inertial.timeline import Timeline, chosen, standing, timeline

KINDS: Final = np.array(
    ["gnss position", "gnss velocity", "odometer", "non-holonomic", "zero velocity", "zero rotation"]
)
_SHORTEST_PIECE_S: Final = 5.0  # Least time of GNSS in a piece that is solved.
_FINE_S: Final = 60.0
"""The first pass over the beginning continues for this long after the coarse alignment."""
_UNKNOWN_AXLE_SIGMA_M: Final = (1.5, 0.5, 1.0)  # 1 σ of the axle (forward, right, down) where no wheel is stated.


def solve(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    vehicle: VehicleSensors,
    config: SmootherConfig,
    *,
    smooth: bool = True,
) -> Solution:
    """Compute the trajectory of the IMU reference point over all samples of an IMU.

    Parameters
    ----------
    imu, gnss, odometer : readings of one run in GPS time, checked, strictly ascending.
    vehicle : how the sensors sit on it, and how good the IMU is.
    smooth : False gives what the filter knew forwards in time, without what came later.

    Returns
    -------
    Poses at the IMU's epochs, thinned to `poses_per_s`; a silence of the IMU longer than `max_imu_gap_s` divides it
    into pieces (`Solution.pieces`) that know nothing of one another.

    Raises
    ------
    NavigationError
        where GNSS has no geocentric frame, or no piece can be solved.
    """
    if gnss.world == LOCAL_WORLD:
        raise NavigationError(
            "the GNSS positions lie in a local frame",
            expected="a geocentric one: gravity and the Earth's rotation depend on the place",
            change="state the CRS of the GNSS log",
        )
    gnss = chosen(gnss, usable(gnss))
    solved: list[Solution] = []
    notes: list[str] = []
    failures: list[NavigationError] = []
    for piece in _pieces(imu, config):
        try:
            solved.append(_solve_piece(piece, gnss, odometer, vehicle, config, smooth=smooth))
        except NavigationError as error:
            failures.append(error)
            notes.append(f"no trajectory from {_span(piece)}: {error}")
    if not solved:
        raise failures[0]
    if len(solved) + len(failures) > 1:
        notes = [f"solved from {_span(p)} by itself" for p in solved] + notes
    return _joined(solved, tuple(notes))


def _span(of: ImuReadings | Solution) -> str:
    first, last = int(of.epochs_gps_ns[0]), int(of.epochs_gps_ns[-1])
    return f"GPS time {first / 1e9:.3f} s to {last / 1e9:.3f} s ({(last - first) / 1e9:.1f} s)"


def _pieces(imu: ImuReadings, config: SmootherConfig) -> list[ImuReadings]:
    """Return unbroken pieces of the IMU's samples."""
    cuts = np.flatnonzero(np.diff(imu.epochs_gps_ns) > config.max_imu_gap_s * 1e9) + 1
    edges = [0, *cuts.tolist(), imu.epochs_gps_ns.size]
    return [_part(imu, slice(a, b)) for a, b in itertools.pairwise(edges)]


def _part(imu: ImuReadings, rows: slice) -> ImuReadings:
    return ImuReadings(imu.epochs_gps_ns[rows], imu.angular_rate_rad_per_s[rows], imu.specific_force_m_per_s2[rows])


def _solve_piece(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    vehicle: VehicleSensors,
    config: SmootherConfig,
    *,
    smooth: bool,
) -> Solution:
    epochs = imu.epochs_gps_ns
    gnss = chosen(gnss, (gnss.epochs_gps_ns >= epochs[0]) & (gnss.epochs_gps_ns <= epochs[-1]))
    if gnss.epochs_gps_ns.size < 3 or epochs[-1] - epochs[0] < _SHORTEST_PIECE_S * 1e9:
        raise NavigationError(
            f"{gnss.epochs_gps_ns.size} usable GNSS solutions lie within the IMU's samples from {_span(imu)}",
            expected=f"at least 3, and {_SHORTEST_PIECE_S:g} s",
            change="check the clocks of both logs",
        )
    begin = int(np.searchsorted(epochs, gnss.epochs_gps_ns[0]))
    imu = _part(imu, slice(max(begin - 1, 0), None))
    still = standing(imu, gnss, odometer, vehicle)
    instant = config.imu_samples == "instant"
    alignment = align(imu, gnss, still, vehicle, instant=instant, land_vehicle=config.land_vehicle)
    layout = _layout(odometer, vehicle, config)
    model = _model(vehicle, config)
    start = _start(alignment, vehicle, config, layout, odometer)
    whole = timeline(imu, gnss, odometer, still, vehicle, config)
    start = _refined(start, alignment, whole, model, layout, vehicle)
    return _Run.of(whole, model, layout, start, smooth=smooth).solution(gnss.world, vehicle, config, smooth=smooth)


def _layout(odometer: OdometerReadings | None, vehicle: VehicleSensors, config: SmootherConfig) -> Layout:
    """Return the columns of the states that this solution has."""
    errors = vehicle.imu_errors
    size = inertial = 21 if errors.gyro_scale_ppm > 0.0 or errors.accel_scale_ppm > 0.0 else 15
    columns = {}
    wanted = {
        "antenna": (3, True),
        "axle": (3, config.land_vehicle or odometer is not None),
        "tilt": (2, config.land_vehicle or odometer is not None),
        "scale": (1, odometer is not None),
        "colour": (3, True),
        "lag": (1, config.gnss_velocity_lag_s != 0.0 or config.gnss_velocity_lag_sigma_s > 0.0),
        "delay": (1, config.imu_clock_sigma_s > 0.0 or config.imu_clock_wander_ms_per_sqrt_s > 0.0),
    }
    for name, (width, needed) in wanted.items():
        columns[name] = size if needed else -1
        size += width if needed else 0
    return Layout(size, inertial, **columns)


def _model(vehicle: VehicleSensors, config: SmootherConfig) -> Model:
    from scipy.special import chdtri

    errors = vehicle.imu_errors
    return Model(
        gyro_bias=_gyro_bias_sigma(vehicle),
        accel_bias=_accel_bias_sigma(vehicle),
        bias_seconds=errors.bias_time_constant_s,
        body_from_imu=np.ascontiguousarray(vehicle.body_from_imu),
        travel_sigma=config.odometer_sigma_m_per_s,
        travel_share=config.odometer_slip,
        side_sigma=config.sideways_m_per_s,
        side_slip=float(np.radians(config.side_slip_deg_per_m_per_s2)),
        up_sigma=config.upwards_m_per_s,
        zero_sigma=config.standing_m_per_s,
        zero_rate_sigma=float(np.radians(config.standing_deg_per_s)),
        loose_rate=0.2,
        loose_force=2.0,
        outlier=np.array([np.inf, *(chdtri(c, config.outlier_probability) / c for c in (1, 2, 3))]),
        patience_s=config.outlier_patience_s,
        delay_wander=config.imu_clock_wander_ms_per_sqrt_s * 1e-3,
        interval_s=1.0 / config.constraints_per_s,
    )


def _gyro_bias_sigma(vehicle: VehicleSensors) -> float:
    return float(np.radians(vehicle.imu_errors.gyro_bias_deg_per_h)) / 3600.0


def _accel_bias_sigma(vehicle: VehicleSensors) -> float:
    return vehicle.imu_errors.accel_bias_mg * 1e-3 * STANDARD_GRAVITY_M_PER_S2


def _start(
    alignment: Alignment,
    vehicle: VehicleSensors,
    config: SmootherConfig,
    layout: Layout,
    odometer: OdometerReadings | None,
) -> Start:
    """Return nominal state and covariance at the first sample."""
    values, sigma = np.zeros(layout.size), np.zeros(layout.size)
    sigma[0:3], sigma[3:6] = alignment.sigma_position_m, alignment.sigma_velocity_m_per_s
    sigma[9:12], sigma[12:15] = _gyro_bias_sigma(vehicle), _accel_bias_sigma(vehicle)
    if layout.inertial > 15:
        sigma[15:18] = vehicle.imu_errors.gyro_scale_ppm * 1e-6
        sigma[18:21] = vehicle.imu_errors.accel_scale_ppm * 1e-6
    antenna = slice(layout.antenna, layout.antenna + 3)
    values[antenna] = vehicle.antenna_lever_arm_body_m - vehicle.imu_lever_arm_body_m
    sigma[antenna] = vehicle.antenna_sigma_body_m
    if layout.axle >= 0:
        axle = slice(layout.axle, layout.axle + 3)
        place, sigma[axle] = _axle(vehicle, config, odometer)
        values[axle] = place - vehicle.imu_lever_arm_body_m
        sigma[layout.tilt : layout.tilt + 2] = np.radians(config.travel_sigma_deg)
    if layout.scale >= 0:
        sigma[layout.scale] = config.odometer_scale_sigma
    sigma[layout.colour : layout.colour + 3] = 1.0
    if layout.delay >= 0:
        sigma[layout.delay] = config.imu_clock_sigma_s
    if layout.lag >= 0:
        values[layout.lag], sigma[layout.lag] = config.gnss_velocity_lag_s, config.gnss_velocity_lag_sigma_s
    covariance = np.diag(sigma**2)
    level = ecef_from_level(alignment.position_ecef_m[None])[0]
    tilts = np.diag([alignment.sigma_level_rad, alignment.sigma_level_rad, alignment.sigma_heading_rad]) ** 2
    covariance[6:9, 6:9] = level @ tilts @ level.T
    return Start(
        quaternion_from_rotation(alignment.ecef_from_imu),
        np.ascontiguousarray(alignment.velocity_ecef_m_per_s),
        np.ascontiguousarray(alignment.position_ecef_m),
        values[NAVIGATION:],
        covariance,
    )


def _axle(
    vehicle: VehicleSensors, config: SmootherConfig, odometer: OdometerReadings | None
) -> tuple[Float64, Float64]:
    """Return the point that moves only forwards, from the IMU reference point, and its σ, body axes (m)."""
    if config.axle_body_m is not None:
        return np.array(config.axle_body_m), np.array(config.axle_sigma_m)
    if odometer is not None and vehicle.wheel_lever_arm_body_m is not None:
        return vehicle.wheel_lever_arm_body_m, np.array(config.axle_sigma_m)
    return np.zeros(3), np.array(_UNKNOWN_AXLE_SIGMA_M)


def _refined(
    start: Start, alignment: Alignment, whole: Timeline, model: Model, layout: Layout, vehicle: VehicleSensors
) -> Start:
    """Return the start from a smoothed first pass over the beginning, so that errors are small enough to be linear."""
    last = int(np.searchsorted(whole.node_epochs, alignment.ready_gps_ns + _FINE_S * 1e9))
    first = _Run.of(_until(whole, min(last, whole.nodes.bound.size - 1)), model, layout, start, smooth=True)
    poses = first.poses(np.zeros(1, np.int64), vehicle, at_imu=True)
    level = ecef_from_level(poses.position)[0]
    return start._replace(
        quaternion=poses.quaternion[0], velocity=level @ poses.velocity[0], position=poses.position[0]
    )


def _until(whole: Timeline, last: int) -> Timeline:
    """Return the beginning of a timeline, up to a node."""
    columns: list[Any] = [column[: last + 1] for column in whole.nodes]
    nodes = Nodes(*columns)
    return Timeline(whole.bounds[: int(nodes.bound[-1]) + 1], whole.steps, nodes, whole.fixes, whole.samples)


@dataclass(frozen=True)
class _Run:
    """Filter and smoother run over a timeline."""

    timeline: Timeline
    layout: Layout
    track: Track
    record: Record
    updates: Updates
    correction: Float64
    covariance: Float64
    values: Float64
    """(j, n − 9)."""
    sigmas: Float64
    smooth: bool

    @classmethod
    def of(cls, whole: Timeline, model: Model, layout: Layout, start: Start, *, smooth: bool) -> _Run:
        bounds, count, n = whole.bounds.size, whole.nodes.bound.size, layout.size
        reports = int(np.count_nonzero(whole.nodes.report >= 0))
        most = whole.most_updates
        track = Track(np.empty((bounds, 4)), np.empty((bounds, 3)), np.empty((bounds, 3)), np.zeros((bounds, 3)))
        record = Record(
            np.zeros((count, NAVIGATION, layout.inertial)),
            np.ones(count),
            np.empty((count, NAVIGATION, n)),
            np.zeros((count, NAVIGATION)),
            np.zeros(count + 1, np.int64),
            np.empty((reports, n - NAVIGATION)),
            np.empty((reports, n, n)),
        )
        updates = Updates(
            np.empty((most, 3, n)),
            np.empty((most, 3, n)),
            np.zeros((most, 3)),
            np.zeros(most, np.int64),
            np.zeros(most, np.int64),
            np.zeros(most, np.int64),
            np.empty((most, 3)),
            np.empty(most),
            np.empty(most),
        )
        made = filter_forwards(whole.steps, whole.nodes, whole.fixes, model, layout, start, track, record, updates)
        columns: list[Any] = [column[:made] for column in updates]
        updates = Updates(*columns)
        correction, covariance = np.zeros((count, NAVIGATION)), np.empty((count, NAVIGATION, NAVIGATION))
        values, sigmas = np.empty((reports, n - NAVIGATION)), np.empty((reports, n - NAVIGATION))
        if smooth:
            smooth_backwards(whole.nodes, layout, record, updates, correction, covariance, values, sigmas)
        else:
            covariance[:] = record.rows[:, :, :NAVIGATION]
            values[:] = record.values
            sigmas[:] = np.sqrt(np.einsum("nii->ni", record.covariance)[:, NAVIGATION:])
        if not all(np.isfinite(a).all() for a in (correction, covariance, sigmas, track.position, track.quaternion)):
            raise NavigationError(
                "the filter's numbers left all bounds",
                expected="readings in rad/s and m/s², a GNSS that fits the IMU",
                change="check axes, units and clocks of IMU and GNSS",
            )
        if not _definite(covariance):
            raise NavigationError(
                "covariances of position, velocity and attitude are not positive definite: rounding exceeds them",
                expected="σ of the sensors, none of them many orders of magnitude below the others",
                change="check noise and biases of the IMU and σ of lever arms in the rig file, and σ of the GNSS log",
            )
        return cls(whole, layout, track, record, updates, correction, covariance, values, sigmas, smooth)

    def poses(self, wanted: Int64, vehicle: VehicleSensors, *, at_imu: bool = False) -> Poses:
        """Return poses of the reference point, or of the IMU in its axes, at bounds (e,)."""
        count = wanted.size
        poses = Poses(
            *(np.empty(shape) for shape in ((count, 3), (count, 4), (count, 3), (3, count, 3, 3), (count, 3)))
        )
        body_from_imu = np.eye(3) if at_imu else vehicle.body_from_imu
        arm = np.zeros(3) if at_imu else -vehicle.body_from_imu.T @ vehicle.imu_lever_arm_body_m
        spread(
            wanted,
            self.timeline.nodes.bound,
            self.track,
            self.record.applied,
            self.correction,
            self.covariance,
            self.smooth,
            arm,
            quaternion_from_rotation(body_from_imu.T),
            poses,
        )
        return poses

    def solution(self, world: str, vehicle: VehicleSensors, config: SmootherConfig, *, smooth: bool) -> Solution:
        """Return poses at the IMU's epochs, states and innovations."""
        wanted = _thinned(self.timeline, config)
        poses = self.poses(wanted, vehicle)
        return Solution(
            world=world,
            epochs_gps_ns=self._on_gnss_time(self.timeline.bounds[wanted]),
            position_world_m=poses.position,
            quaternion_world_from_body=poses.quaternion,
            velocity_ned_m_per_s=poses.velocity,
            covariance_position_ned_m2=poses.covariance[0],
            covariance_attitude_rad2=poses.covariance[1],
            covariance_velocity_ned=poses.covariance[2],
            sigma_rph_rad=poses.sigma_rph,
            states=self._states(vehicle),
            state_epochs_gps_ns=self._on_gnss_time(self.timeline.reported),
            innovations=self._innovations(),
        )

    def _on_gnss_time(self, epochs: Int64) -> Int64:
        """Convert stamps of the IMU (ascending, ns) to GNSS time, by the estimated delay."""
        if self.layout.delay < 0:
            return epochs
        known = self.timeline.reported
        delay = self.values[:, self.layout.delay - NAVIGATION]
        late = np.interp((epochs - known[0]).astype(np.float64), (known - known[0]).astype(np.float64), delay)
        return np.asarray(epochs - np.rint(late * 1e9).astype(np.int64))

    def _states(self, vehicle: VehicleSensors) -> dict[str, tuple[Float64, Float64]]:
        layout = self.layout
        columns = {
            "gyro_bias_imu_rad_per_s": (9, 3),
            "accel_bias_imu_m_per_s2": (12, 3),
            "gyro_scale_imu": (15 if layout.inertial > 15 else -1, 3),
            "accel_scale_imu": (18 if layout.inertial > 15 else -1, 3),
            "antenna_lever_arm_body_m": (layout.antenna, 3),
            "axle_lever_arm_body_m": (layout.axle, 3),
            "travel_pitch_heading_rad": (layout.tilt, 2),
            "odometer_scale": (layout.scale, 1),
            "gnss_slow_error_sigmas": (layout.colour, 3),
            "imu_delay_s": (layout.delay, 1),
            "gnss_velocity_lag_s": (layout.lag, 1),
        }
        found = {}
        for name, (column, width) in columns.items():
            if column < 0:
                continue
            rows = slice(column - NAVIGATION, column - NAVIGATION + width)
            value, sigma = self.values[:, rows], self.sigmas[:, rows]
            if name.endswith("lever_arm_body_m"):
                value = value + vehicle.imu_lever_arm_body_m
            found[name] = (value[:, 0], sigma[:, 0]) if width == 1 else (value, sigma)
        return found

    def _innovations(self) -> Innovations:
        updates = self.updates
        return Innovations(
            self.timeline.node_epochs[updates.node],
            KINDS[updates.kind],
            updates.residual,
            updates.normalised,
            updates.weight,
        )


def _definite(covariance: Float64) -> bool:
    """Return whether all of them (k, n, n) are positive definite, by Cholesky factors, which are free of units."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return False
    return True


def _thinned(whole: Timeline, config: SmootherConfig) -> Int64:
    """Return bounds of the samples that become poses: the first of each interval of `poses_per_s`, and the last."""
    epochs = whole.bounds[whole.samples]
    slots = epochs // round(1e9 / config.poses_per_s)
    keep = np.diff(slots, prepend=slots[0] - 1) > 0
    keep[-1] = True
    return whole.samples[keep]


def _joined(parts: list[Solution], notes: tuple[str, ...]) -> Solution:
    """Join the solutions of several successive pieces."""
    first = parts[0]
    arrays = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in (
            "epochs_gps_ns", "position_world_m", "quaternion_world_from_body", "velocity_ned_m_per_s",
            "covariance_position_ned_m2", "covariance_attitude_rad2", "covariance_velocity_ned", "sigma_rph_rad",
            "state_epochs_gps_ns",
        )
    }  # fmt: skip
    states = {
        name: (
            np.concatenate([p.states[name][0] for p in parts]),
            np.concatenate([p.states[name][1] for p in parts]),
        )
        for name in first.states
    }
    listed = [p.innovations for p in parts if p.innovations is not None]
    innovations = Innovations(
        **{
            name: np.concatenate([getattr(i, name) for i in listed])
            for name in ("epochs_gps_ns", "kind", "residual", "normalised", "weight")
        }
    )
    pieces = tuple((int(p.epochs_gps_ns[0]), int(p.epochs_gps_ns[-1])) for p in parts)
    return Solution(world=first.world, states=states, innovations=innovations, pieces=pieces, notes=notes, **arrays)
