"""Sorts and filters the records of the smoother's logs: unusable ones are left out and reported, or a log is rejected.

A record is counted from 0 in the order in which it arrived.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of
from roadscan.core.errors import NavigationError, TimeSystemError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings

LOST_SHARE: Final = 0.05
"""Largest share of samples that an IMU log may lack in gaps up to `SHORT_GAP_S`."""
SHORT_GAP_S: Final = 1.0
"""A longer gap is a pause."""
DAMAGED_SHARE: Final = 0.05
"""Largest share of a log's records that may be left out for invalid values."""
CONFLICT_SHARE: Final = 0.01
"""Largest share of records that may contradict another one of the same epoch."""
FEWEST_SPOILT: Final = 5
"""Up to this many damaged records never cause a log to be rejected by their share."""
FASTEST_M_PER_S: Final = 100.0
"""Largest speed of a road vehicle."""
CLIPPED_S: Final = 0.1
"""Longest time that a sensor may stay at the end of its scale."""
CLIPPED_SHARE: Final = 0.001
"""Largest share of samples at the end of the scale."""
_CLIPPED_SAMPLES: Final = 3  # Least number of equal samples in a row that are the end of a scale.
_LEAST_SCALE: Final = (1.0, 14.0)
"""Least end of scale of a gyroscope (rad/s) and of an accelerometer (m/s²)."""
_LISTED: Final = 3  # Most records that a message lists.

Log = TypeVar("Log")


@dataclass(frozen=True)
class Repair:
    """A repair of some records of a log, so that the rest can be used."""

    sensor: str
    """'IMU', 'GNSS' or 'odometer'."""
    what: str
    """What was wrong with them, and the repair."""
    records: Int64
    """(n,) records counted from 0 in order of arrival; for a gap the record before it."""
    epochs_gps_ns: Int64
    """(n,) their epochs."""

    def __str__(self) -> str:
        return f"{self.sensor}: {self.what}: {listed(self.records, self.epochs_gps_ns)}"


@dataclass(frozen=True)
class Kept(Generic[Log]):
    """A log sorted by time."""

    log: Log
    records: Int64
    """(n,) record of each row in order of arrival."""
    repairs: list[Repair]


def listed(records: Int64, epochs_gps_ns: Int64) -> str:
    """``record 12 (2026-05-04T09:30:00.1Z), record 15 (…) and 4 more``."""
    named = [f"record {r} ({iso_from_gps_ns(int(e))})" for r, e in zip(records[:_LISTED], epochs_gps_ns, strict=False)]
    more = records.size - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")


def imu_in_order(imu: ImuReadings) -> Kept[ImuReadings]:
    """Return samples sorted, each epoch once, all of them numbers; gaps are reported and stay.

    Raises
    ------
    NavigationError
        where many samples are missing, are no numbers, or are saturated.
    TimeSystemError
        where the clock stepped back.
    """
    values = np.column_stack([imu.angular_rate_rad_per_s, imu.specific_force_m_per_s2])
    rows, repairs = _each_epoch_once("IMU", imu.epochs_gps_ns, values)
    bad = ~np.isfinite(values[rows]).all(axis=1)
    if bad.any():
        repairs.append(_left_out("IMU", "no finite numbers", rows[bad], imu.epochs_gps_ns, rows.size))
        rows = rows[~bad]
    if rows.size < 2:
        raise NavigationError(f"the IMU log has {rows.size} usable samples", expected="at least two")
    epochs, values = imu.epochs_gps_ns[rows], values[rows]
    clipped, said = _saturation(epochs, values, rows)
    repairs += said
    epochs, values, rows = epochs[~clipped], values[~clipped], rows[~clipped]
    log = ImuReadings(epochs, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]))
    return Kept(log, rows, repairs + _gaps(epochs, rows))


def gnss_in_order(gnss: GnssSolutions) -> Kept[GnssSolutions]:
    """Return solutions sorted, each epoch once; incomplete positions and invalid covariances become NaN.

    Raises
    ------
    NavigationError
        where hardly a solution is usable.
    TimeSystemError
        where the clock stepped back.
    """
    position, velocity = gnss.position_world_m, gnss.velocity_ned_m_per_s
    rows, repairs = _each_epoch_once("GNSS", gnss.epochs_gps_ns, np.column_stack([position, velocity]))
    position, halves = _whole(position[rows])
    velocity, half_velocities = _whole(velocity[rows])
    covariance, flawed = _covariances(gnss.covariance_ned_m2[rows])
    epochs = gnss.epochs_gps_ns[rows]
    for bad, what in (
        (halves, "a position of which a part is no finite number was left out"),
        (half_velocities, "a velocity of which a part is no finite number was left out"),
        (flawed, "a covariance that is not positive definite counts as not stated"),
    ):
        if bad.any():
            repairs.append(Repair("GNSS", what, rows[bad], epochs[bad]))
    if not np.isfinite(position[:, 0]).any():
        raise NavigationError(
            f"none of {rows.size} GNSS solutions has a position",
            expected="positions of the antenna",
            change="check the log's columns, or name another receiver in navigation.smoother.gnss",
        )
    sigma = np.where(gnss.sigma_velocity_ned_m_per_s[rows] > 0.0, gnss.sigma_velocity_ned_m_per_s[rows], np.nan)
    log = GnssSolutions(gnss.world, epochs, position, covariance, gnss.quality[rows], velocity, sigma)
    return Kept(log, rows, repairs)


def odometer_in_order(odometer: OdometerReadings) -> Kept[OdometerReadings]:
    """Return readings sorted, each epoch once; a counter that restarted continues where it was.

    Raises
    ------
    NavigationError
        where the counter leaps all the time.
    TimeSystemError
        where the clock stepped back.
    """
    values = np.column_stack([odometer.distance_m, odometer.speed_m_per_s])
    rows, repairs = _each_epoch_once("odometer", odometer.epochs_gps_ns, values)
    values = np.where(np.isfinite(values), values, np.nan)
    bad = np.isnan(values[rows]).all(axis=1)
    if bad.any():
        repairs.append(
            _left_out("odometer", "neither distance nor speed", rows[bad], odometer.epochs_gps_ns, rows.size)
        )
        rows = rows[~bad]
    epochs = odometer.epochs_gps_ns[rows]
    distance, restarted = _going_on(epochs, values[rows, 0], rows)
    return Kept(OdometerReadings(epochs, distance, values[rows, 1]), rows, repairs + restarted)


def _each_epoch_once(sensor: str, epochs: Int64, values: Float64) -> tuple[Int64, list[Repair]]:
    """Return rows in the order of their epochs, each epoch once, and the repairs for it."""
    if epochs.size == 0:
        raise NavigationError(f"the {sensor} log is empty", expected="at least two records")
    repairs = []
    late = np.flatnonzero(epochs < np.maximum.accumulate(epochs))
    order = np.argsort(epochs, kind="stable")
    if late.size:
        _check_not_interleaved(sensor, epochs, order, late)
        repairs.append(Repair(sensor, "stood behind later records and were sorted", late, epochs[late]))
    first = np.concatenate([[True], np.diff(epochs[order]) > 0])
    group = np.cumsum(first) - 1
    leader = order[first][group]
    same = np.all((values[order] == values[leader]) | (np.isnan(values[order]) & np.isnan(values[leader])), axis=1)
    contradicted = np.zeros(group[-1] + 1, dtype=bool)
    contradicted[group[~same]] = True
    repeated = order[~first & ~contradicted[group]]
    if repeated.size:
        what = "repeat the epoch and the values of another record and were dropped"
        repairs.append(Repair(sensor, what, repeated, epochs[repeated]))
    against = order[contradicted[group]]
    if against.size:
        _check_conflicts(sensor, epochs, against)
        what = "share their epoch with records of other values; none of them can be trusted, all were dropped"
        repairs.append(Repair(sensor, what, against, epochs[against]))
    return order[first & ~contradicted[group]], repairs


def _check_not_interleaved(sensor: str, epochs: Int64, order: Int64, late: Int64) -> None:
    """Reject records that interleave with others once sorted: the clock went back over a time that it had shown."""
    steps = np.diff(epochs[order])
    if not (steps > 0).any():
        return
    is_late = np.zeros(epochs.size, dtype=bool)
    is_late[late] = True
    beside = is_late[order][1:] | is_late[order][:-1]
    crowded = int((beside & (steps < 0.6 * np.median(steps[steps > 0]))).sum())
    step_back = int(np.argmin(np.diff(epochs)))
    if crowded > max(FEWEST_SPOILT, 0.3 * late.size):
        back_s = -np.diff(epochs)[step_back] / NS_PER_S
        raise TimeSystemError(
            f"the clock of the {sensor} log steps back by {back_s:.3f} s at record {step_back + 1} "
            f"({iso_from_gps_ns(int(epochs[step_back + 1]))}), and what follows runs in between what was before",
            expected="a clock that never shows the same time twice",
            change="split the log at that record, and state the clock of each part",
            record=step_back + 1,
        )


def _check_conflicts(sensor: str, epochs: Int64, against: Int64) -> None:
    if against.size <= max(2 * FEWEST_SPOILT, CONFLICT_SHARE * epochs.size):
        return
    steps = np.diff(epochs)
    step_back = int(np.argmin(steps))
    back = steps[step_back] < 0
    record = step_back + 1 if back else int(against.min())
    cause = f"; the clock steps back by {-steps[step_back] / NS_PER_S:.3f} s at record {record}" if back else ""
    raise TimeSystemError(
        f"{against.size} of {epochs.size} {sensor} records share their epoch with a record of other values, first "
        f"{listed(against[:1], epochs[against[:1]])}{cause}",
        expected="one record an epoch",
        change="check the clock of the log and the resolution of its stamps; split a log that holds two recordings",
        record=record,
    )


def _left_out(sensor: str, what: str, rows: Int64, epochs: Int64, of: int) -> Repair:
    if rows.size > max(FEWEST_SPOILT, DAMAGED_SHARE * of):
        raise NavigationError(
            f"{rows.size} of {of} {sensor} records hold {what}, first {listed(rows[:1], epochs[rows[:1]])}",
            expected=f"at most {DAMAGED_SHARE:.0%} such records",
            change="check the log's columns and what wrote it",
            record=int(rows[0]),
        )
    return Repair(sensor, f"hold {what} and were left out", rows, epochs[rows])


def _gaps(epochs: Int64, rows: Int64) -> list[Repair]:
    """Return the gaps of an IMU log: short ones are crossed with a wider σ, long ones divide the run."""
    steps = np.diff(epochs)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > 2.5 * usual)
    if gaps.size == 0:
        return []
    _check_share(np.rint(steps[gaps] / usual).astype(np.int64) - 1, epochs, rows, gaps)
    longest_s = float(steps[gaps].max()) / NS_PER_S
    what = (
        f"are followed by gaps of up to {longest_s:.3f} s; nothing was filled in: short gaps widen σ, longer ones than "
        "navigation.smoother.max_imu_gap_s divide the trajectory"
    )
    return [Repair("IMU", what, rows[gaps], epochs[gaps])]


def _check_share(counts: Int64, epochs: Int64, rows: Int64, gaps: Int64) -> None:
    """Reject a log that loses samples throughout; a pause is one gap, whatever its length."""
    short = counts * float(np.median(np.diff(epochs))) < SHORT_GAP_S * NS_PER_S
    counts, gaps = counts[short], gaps[short]
    if counts.sum() > max(FEWEST_SPOILT, LOST_SHARE * epochs.size):
        raise NavigationError(
            f"{counts.sum()} samples are missing from an IMU log of {epochs.size}, in {gaps.size} gaps; the first "
            f"follows {listed(rows[gaps[:1]], epochs[gaps[:1]])}",
            expected=f"at most {LOST_SHARE:.0%} missing samples",
            change="check what recorded the log: it loses samples",
            record=int(rows[gaps[0]]),
        )


def _saturation(epochs: Int64, values: Float64, rows: Int64) -> tuple[Bool, list[Repair]]:
    """Find samples at the end of a sensor's scale: few are left out, many cause rejection."""
    repairs = []
    out = np.zeros(epochs.size, dtype=bool)
    step_s = float(np.median(np.diff(epochs))) / NS_PER_S
    for axis in range(6):
        kind, name = axis // 3, f"{('gyroscope', 'accelerometer')[axis // 3]} {'xyz'[axis % 3]}"
        column = values[:, axis]
        for end in (column.max(), column.min()):
            held = runs_of(column == end)
            held = held[held[:, 1] - held[:, 0] >= _CLIPPED_SAMPLES]
            if abs(end) < _LEAST_SCALE[kind] or held.size == 0 or _is_constant(column):
                continue
            clipped = np.concatenate([np.arange(a, b) for a, b in held])
            longest = int((held[:, 1] - held[:, 0]).max())
            if longest * step_s > max(CLIPPED_S, 4 * step_s) or clipped.size > max(
                2 * FEWEST_SPOILT, CLIPPED_SHARE * column.size
            ):
                raise NavigationError(
                    f"{name} stands at the end of its scale, {end:.6g} {('rad/s', 'm/s²')[kind]}, in {clipped.size} "
                    f"samples, up to {longest} on end, first {listed(rows[clipped[:1]], epochs[clipped[:1]])}",
                    expected=f"no more than {CLIPPED_S:g} s on end and {CLIPPED_SHARE:.1%} of the samples",
                    change="record with a wider scale, or mount the IMU more softly",
                    record=int(rows[clipped[0]]),
                )
            what = f"{name} stands at the end of its scale, {end:.6g}, and felt more; the samples were left out"
            repairs.append(Repair("IMU", what, rows[clipped], epochs[clipped]))
            out[clipped] = True
    return out, repairs


def _is_constant(column: Float64) -> bool:
    return bool(column.min() == column.max())


def _whole(vectors: Float64) -> tuple[Float64, Bool]:
    """Return vectors (n, 3), all NaN where a part is not finite; flags where that was not so."""
    finite = np.isfinite(vectors)
    whole: Bool = np.asarray(finite.all(axis=1))
    missing: Bool = np.asarray(np.isnan(vectors).all(axis=1))
    return np.where(whole[:, None], vectors, np.nan), ~whole & ~missing


def _covariances(covariance: Float64) -> tuple[Float64, Bool]:
    """Return covariances (n, 3, 3), NaN where invalid; flags of stated ones that are invalid."""
    stated = ~np.isnan(covariance).all(axis=(1, 2))
    finite = np.isfinite(covariance).all(axis=(1, 2))
    smallest = np.full(len(covariance), -1.0)
    smallest[finite] = np.linalg.eigvalsh(covariance[finite])[:, 0] if finite.any() else 0.0
    good = finite & (smallest > 0.0)
    flawed: Bool = stated & ~good
    return np.where(good[:, None, None], covariance, np.nan), flawed


def _going_on(epochs: Int64, distance: Float64, rows: Int64) -> tuple[Float64, list[Repair]]:
    """Return distances (n,) in which a counter that leaps continues as before its leap."""
    known = np.flatnonzero(~np.isnan(distance))
    steps, seconds = np.diff(distance[known]), np.diff(epochs[known]) / NS_PER_S
    leaps = np.flatnonzero(np.abs(steps) > FASTEST_M_PER_S * seconds + 1.0)
    if leaps.size == 0:
        return distance, []
    after = known[leaps + 1]
    if leaps.size > max(FEWEST_SPOILT, CONFLICT_SHARE * known.size):
        raise NavigationError(
            f"the odometer's distance leaps {leaps.size} times faster than {FASTEST_M_PER_S:g} m/s, the first time at "
            f"{listed(rows[after[:1]], epochs[after[:1]])}, by {steps[leaps[0]]:.6g} m",
            expected="a running total in metres",
            change="check the unit of the distance (metres_per_tick of the encoder in the rig file)",
            record=int(rows[after[0]]),
        )
    good = np.ones(steps.size, dtype=bool)
    good[leaps] = False
    speeds = np.where(good, steps / np.maximum(seconds, 1e-9), 0.0)
    instead = np.interp(leaps, np.flatnonzero(good), speeds[good]) * seconds[leaps]
    steps = steps.copy()
    steps[leaps] = instead
    mended = distance.copy()
    mended[known] = distance[known[0]] + np.concatenate([[0.0], np.cumsum(steps)])
    what = (
        f"the counter leaps (by {np.diff(distance[known])[leaps[0]]:.6g} m); it goes on as the speed before and after"
    )
    return mended, [Repair("odometer", what, rows[after], epochs[after])]
