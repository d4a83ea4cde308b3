"""The timeline of a solution: steps of the mechanisation, and nodes at which covariances and updates are computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.kernels.kalman_states import Fixes, Nodes, Steps
from roadscan.navigation.inertial.kernels.strapdown import increments
from roadscan.navigation.inertial.noise import colour_restarts, fixes_of, imu_noise
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors

WINDOW_S: Final = 1.0
"""Length of the window over which vibration is measured."""
_STILL_M_PER_S: Final = 0.15
"""GNSS speed below which a vehicle may stand."""
_MOVING_M_PER_S: Final = 0.5  # GNSS speed above which a vehicle moves.
_STILL_M: Final = 0.02
"""Distance that an odometer may count in a window while standing (play, rounding)."""
_LEARNING_S: Final = 4.0
"""Least standing time, by GNSS, from which the vibration of a standing vehicle is estimated."""


def standing(imu: ImuReadings, gnss: GnssSolutions, odometer: OdometerReadings | None, vehicle: VehicleSensors) -> Bool:
    """Return True (n,) at samples of an IMU within a standstill.

    How much a standing vehicle trembles, engine on, is learnt from the times when GNSS or odometer say that it stands;
    a sample stands when rate and force tremble no more than there, and nothing says that it moves. Where nothing ever
    stands, the noise of the data sheet is the measure.
    """
    from scipy.ndimage import minimum_filter1d

    seconds = (imu.epochs_gps_ns - imu.epochs_gps_ns[0]) * 1e-9
    if seconds.size < 10:
        return np.zeros(seconds.size, bool)
    step = float(np.median(np.diff(seconds)))
    size = max(5, round(WINDOW_S / step))
    rate = _trembling(imu.angular_rate_rad_per_s, size)
    force = _trembling(imu.specific_force_m_per_s2, size)
    speed = _speed(imu.epochs_gps_ns, gnss)
    stands, moves = speed < _STILL_M_PER_S, speed > _MOVING_M_PER_S
    if odometer is not None:
        counted = _counted(imu.epochs_gps_ns, odometer)
        stands = np.where(np.isfinite(counted), counted < _STILL_M, stands)
        moves = np.where(np.isfinite(counted), counted >= _STILL_M, moves)
    whole = minimum_filter1d(stands.astype(np.uint8), 2 * size) > 0
    errors = vehicle.imu_errors
    density = (
        np.radians(errors.gyro_noise_deg_per_sqrt_h) / 60.0,
        errors.accel_noise_ug_per_sqrt_hz * 9.80665e-6,
    )
    found = ~moves
    for trembles, noise in zip((rate, force), density, strict=True):
        found &= trembles <= _limit(trembles, whole, moves, noise**2 / step * 3.0, step)
    # Only samples that stand for a whole window, and away from its ends.
    return np.asarray(minimum_filter1d(found.astype(np.uint8), size) > 0)


def _limit(trembles: Float64, stands: Bool, moves: Bool, noise: float, step_s: float) -> float:
    """Return the largest variance of a standing window."""
    if np.count_nonzero(stands) * step_s < _LEARNING_S:
        return 4.0 * noise
    limit = 3.0 * float(np.quantile(trembles[stands], 0.9))
    if np.any(moves):
        limit = min(limit, max(float(np.quantile(trembles[moves], 0.02)), float(np.quantile(trembles[stands], 0.5))))
    return max(limit, 2.0 * noise)


def _trembling(vectors: Float64, size: int) -> Float64:
    """Return the variance (n,) within windows of `size`, summed over axes."""
    from scipy.ndimage import uniform_filter1d

    centred = vectors - vectors.mean(axis=0)
    mean = uniform_filter1d(centred, size, axis=0)
    square = uniform_filter1d(centred**2, size, axis=0)
    return np.asarray(np.maximum(square - mean**2, 0.0).sum(axis=1))


def _speed(epochs: Int64, gnss: GnssSolutions) -> Float64:
    """Return GNSS speed (m/s) at epochs, NaN where no solution with a velocity is within a second."""
    known = np.isfinite(gnss.velocity_ned_m_per_s).all(axis=1)
    at = gnss.epochs_gps_ns[known]
    if at.size < 2:
        return np.full(epochs.size, np.nan)
    speed = np.linalg.norm(gnss.velocity_ned_m_per_s[known], axis=1)
    nearest = np.clip(np.searchsorted(at, epochs), 1, at.size - 1)
    gap = np.minimum(np.abs(epochs - at[nearest - 1]), np.abs(epochs - at[nearest]))
    value = np.interp((epochs - at[0]).astype(np.float64), (at - at[0]).astype(np.float64), speed)
    return np.where(gap < 1_000_000_000, value, np.nan)


def _counted(epochs: Int64, odometer: OdometerReadings) -> Float64:
    """Return the distance (m) that the odometer counted within half a window on both sides, NaN where it has none."""
    from scipy.ndimage import maximum_filter1d

    at, distance = odometer_distance(odometer)
    if at.size < 2:
        return np.full(epochs.size, np.nan)
    half = round(WINDOW_S / 2 * 1e9)
    since, values = (at - at[0]).astype(np.float64), (epochs - at[0]).astype(np.float64)
    inside = (epochs >= at[0]) & (epochs <= at[-1])
    before, after = np.interp(values - half, since, distance), np.interp(values + half, since, distance)
    longest = maximum_filter1d(np.append(np.diff(since), 0.0), 3)
    nearest = np.clip(np.searchsorted(at, epochs) - 1, 0, at.size - 1)
    return np.where(inside & (longest[nearest] < 1e9), np.abs(after - before), np.nan)


def odometer_distance(odometer: OdometerReadings) -> tuple[Int64, Float64]:
    """Epochs (k,) and distance (k,) of an odometer that states a distance or a speed, without damaged records."""
    if np.isfinite(odometer.distance_m).any():
        sound = np.isfinite(odometer.distance_m)
        return odometer.epochs_gps_ns[sound], odometer.distance_m[sound]
    sound = np.isfinite(odometer.speed_m_per_s)
    at, speed = odometer.epochs_gps_ns[sound], odometer.speed_m_per_s[sound]
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(at) * 1e-9
    return at, np.append(0.0, np.cumsum(steps))[: at.size]


_REPORT_NS = 1_000_000_000  # Interval of reported states.
_ODOMETER_GAP_NS = 500_000_000  # Longest gap over which the odometer's distance is used.
_SHORTEST_NS = 20_000_000
"""Shorter intervals get no constraint; the next interval does."""


@dataclass(frozen=True)
class Timeline:
    """Steps, nodes and updates of one unbroken piece."""

    bounds: Int64
    """(s + 1,) epochs between the steps."""
    steps: Steps
    nodes: Nodes
    fixes: Fixes
    samples: Int64
    """(n,) bound of each IMU sample."""

    @property
    def node_epochs(self) -> Int64:
        """(k,) epochs of the nodes."""
        return self.bounds[self.nodes.bound]

    @property
    def reported(self) -> Int64:
        """(j,) epochs at which all states are stored."""
        return self.node_epochs[self.nodes.report >= 0]

    @property
    def most_updates(self) -> int:
        """Upper bound on the number of updates."""
        nodes = self.nodes
        with_gnss = np.count_nonzero(nodes.gnss >= 0)
        return int(
            2 * with_gnss
            + 2 * np.count_nonzero(nodes.still)
            + np.count_nonzero(np.isfinite(nodes.travel))
            + np.count_nonzero(nodes.constrained)
        )


def timeline(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    still: Bool,
    vehicle: VehicleSensors,
    config: SmootherConfig,
) -> Timeline:
    """Build the timeline between the first and the last IMU sample of a piece.

    Parameters
    ----------
    imu : unbroken but for gaps up to `max_imu_gap_s`; gnss : usable solutions; still : (n,) standing samples.
    vehicle : how the IMU sits on it, and how good it is.
    """
    epochs = imu.epochs_gps_ns
    gnss = _within(gnss, int(epochs[0]), int(epochs[-1]))
    node_epochs = _filled(merged(epochs[[0, -1]], gnss.epochs_gps_ns), config)
    bounds = merged(epochs, node_epochs)
    bound = np.searchsorted(bounds, node_epochs)
    return Timeline(
        bounds,
        _steps(imu, bounds, config),
        _nodes(imu, gnss, odometer, still, vehicle, config, node_epochs, bound),
        fixes_of(gnss, config),
        np.searchsorted(bounds, epochs),
    )


def _within(gnss: GnssSolutions, first: int, last: int) -> GnssSolutions:
    return chosen(gnss, (gnss.epochs_gps_ns >= first) & (gnss.epochs_gps_ns <= last))


def chosen(gnss: GnssSolutions, rows: Bool) -> GnssSolutions:
    """Return some of the solutions."""
    return GnssSolutions(
        gnss.world,
        gnss.epochs_gps_ns[rows],
        gnss.position_world_m[rows],
        gnss.covariance_ned_m2[rows],
        gnss.quality[rows],
        gnss.velocity_ned_m_per_s[rows],
        gnss.sigma_velocity_ned_m_per_s[rows],
    )


def merged(*epochs: Int64) -> Int64:
    """Merge epochs of ascending lists, each once."""
    together = np.sort(np.concatenate(epochs), kind="stable")
    return together[np.diff(together, prepend=together[0] - 1) > 0]


def _filled(epochs: Int64, config: SmootherConfig) -> Int64:
    """Return epochs with evenly spaced others added where they lie more than one and a half constraints apart."""
    interval = 1e9 / config.constraints_per_s
    gaps = np.diff(epochs)
    parts = np.where(gaps > 1.5 * interval, np.ceil(gaps / interval), 1).astype(np.int64)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = np.arange(parts.sum()) - first
    between = np.repeat(epochs[:-1], parts) + share * np.repeat(gaps, parts) // np.repeat(parts, parts)
    return np.append(between, epochs[-1:])


def _steps(imu: ImuReadings, bounds: Int64, config: SmootherConfig) -> Steps:
    epochs, count = imu.epochs_gps_ns, bounds.size - 1
    seconds, turn, push = np.empty(count), np.empty((count, 3)), np.empty((count, 3))
    increments(
        epochs,
        np.ascontiguousarray(imu.angular_rate_rad_per_s),
        np.ascontiguousarray(imu.specific_force_m_per_s2),
        config.imu_samples == "instant",
        bounds,
        seconds,
        turn,
        push,
    )
    intervals = np.diff(epochs)
    usual = int(np.median(intervals))
    silent = intervals > 2.5 * usual
    loose = np.zeros(count)
    if silent.any():
        sample = np.searchsorted(epochs, bounds[1:]) - 1
        loose = np.where(silent[sample], (intervals[sample] - usual) * 1e-9, 0.0)
    return Steps(seconds, turn, push, loose)


def _nodes(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    still: Bool,
    vehicle: VehicleSensors,
    config: SmootherConfig,
    epochs: Int64,
    bound: Int64,
) -> Nodes:
    count = epochs.size
    row = np.full(count, -1)
    row[np.searchsorted(epochs, gnss.epochs_gps_ns)] = np.arange(gnss.epochs_gps_ns.size)
    seconds = np.append(0.0, np.diff(epochs)) * 1e-9
    keep = np.exp(-seconds / config.gnss_correlation_s)
    restarts = colour_restarts(gnss)
    keep[(row >= 0) & restarts[np.maximum(row, 0)] if restarts.size else np.zeros(count, bool)] = 0.0
    long_enough = np.append(False, np.diff(epochs) >= _SHORTEST_NS)
    stands = _whole(imu.epochs_gps_ns, still, epochs) & long_enough & config.land_vehicle
    travel = np.where(long_enough, _travel(odometer, epochs), np.nan)
    rate_noise, force_noise = imu_noise(imu, vehicle, config, epochs)
    return Nodes(
        bound=bound,
        colour_keep=keep,
        gnss=row,
        still=stands,
        travel=travel,
        constrained=long_enough & ~stands & config.land_vehicle,
        report=_reports(epochs),
        rate_noise=rate_noise,
        force_noise=force_noise,
    )


def _whole(samples: Int64, still: Bool, epochs: Int64) -> Bool:
    """Return True (k,) where all samples of the interval before a node are standing ones."""
    total = np.append(0, np.cumsum(~still))
    at = np.searchsorted(samples, epochs, side="right")
    before = np.append(at[:1], at[:-1])
    moving = total[np.minimum(at + 1, still.size)] - total[np.maximum(before - 1, 0)]
    return np.asarray(moving == 0)


def _travel(odometer: OdometerReadings | None, epochs: Int64) -> Float64:
    """Return the distance (m) counted over the interval before each node (k,), NaN where the odometer was silent."""
    unknown = np.full(epochs.size, np.nan)
    if odometer is None:
        return unknown
    at, distance = odometer_distance(odometer)
    if at.size < 2:
        return unknown
    place = np.interp((epochs - at[0]).astype(np.float64), (at - at[0]).astype(np.float64), distance)
    after = np.searchsorted(at, epochs)
    inside = (after > 0) & (after < at.size) | (epochs == at[0])
    gap = at[np.minimum(after, at.size - 1)] - at[np.maximum(after - 1, 0)]
    place[~inside | (gap > _ODOMETER_GAP_NS)] = np.nan
    unknown[1:] = np.diff(place)
    return unknown


def _reports(epochs: Int64) -> Int64:
    """Return the row of the reported states for the first node of each second and the last node, −1 for others."""
    slots = epochs // _REPORT_NS
    first = np.diff(slots, prepend=slots[0] - 1) > 0
    first[-1] = True
    rows = np.full(epochs.size, -1)
    rows[first] = np.arange(np.count_nonzero(first))
    return rows
