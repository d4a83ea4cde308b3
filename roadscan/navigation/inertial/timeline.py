"""The timeline of a solution: steps of the mechanisation, and nodes at which covariances and updates are computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.settings.smoothing import SmootherConfig
from roadscan.navigation.inertial.kernels.kalman_states import Fixes, Nodes, Steps
from roadscan.navigation.inertial.kernels.strapdown import increments
from roadscan.navigation.inertial.noise import colour_restarts, fixes_of, imu_noise
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors
from roadscan.navigation.inertial.standing import odometer_distance

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
