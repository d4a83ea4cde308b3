"""Checks logs before smoothing: sorts them, repairs them where that is certain, and rejects them otherwise.

- records (records.py): order, repeated and contradicting epochs, no numbers, gaps, saturation;
- positions (positions.py): frame and unit of GNSS positions, leaps, positions that are repeated;
- times: the logs overlap;
- motion (agreement.py): gravity, turns, accelerations, speeds: units, axes, signs, clocks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of
from roadscan.core.errors import NavigationError, TimeSystemError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, WEEK_S, iso_from_gps_ns
from roadscan.navigation.inertial.agreement import (
    Felt,
    check_axes,
    check_direction,
    check_gravity,
    check_odometer,
    check_tipping,
    check_velocity,
    directions,
)
from roadscan.navigation.inertial.motion import (
    STEP_S,
    Windows,
    check_frame,
    imu_means,
    odometer_means,
    position_velocity,
    track_of,
    windows_of,
    without_leaps,
)
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors
from roadscan.navigation.inertial.records import (
    Kept,
    Repair,
    gnss_in_order,
    imu_in_order,
    listed,
    odometer_in_order,
)

__all__ = ["Prepared", "Repair", "prepared"]


LEAST_OVERLAP_S: Final = 2.0
"""Least time that IMU and GNSS log have in common."""
STUCK_S: Final = 2.0
"""A sensor that shows the same value for this long while the vehicle drives is stuck."""
HANGS_S: Final = 0.5
"""An odometer that shows standstill for this long while the vehicle drives hangs."""
STUCK_SHARE: Final = 0.5
"""Largest share of the drive for which an odometer may be stuck and still be used elsewhere."""
SPEED_S: Final = 0.1
"""Where a log cannot be used as distances, speeds are computed over about this time."""


class Prepared(NamedTuple):
    """Logs that the smoother can use, and the repairs to them."""

    imu: ImuReadings
    gnss: GnssSolutions
    odometer: OdometerReadings | None
    repairs: list[Repair]


def prepared(
    imu: ImuReadings,
    gnss: GnssSolutions,
    odometer: OdometerReadings | None,
    vehicle: VehicleSensors,
    *,
    drove_backwards: bool = False,
) -> Prepared:
    """Check the logs of a run by themselves and against one another.

    Parameters
    ----------
    imu, gnss, odometer : as they were recorded, in any order; records are counted from 0 as they stand there.
    vehicle : how the sensors sit on the vehicle.
    drove_backwards : the run was driven backwards for the most part; otherwise accelerations that say so mean an IMU
        turned by 180°.

    Raises
    ------
    ConfigError
        Units, axes and signs that are not those stated.
    CrsError
        GNSS positions that are not in the stated frame.
    TimeSystemError
        Clocks that step back, or do not agree with one another.
    NavigationError
        Damaged, stuck and saturated sensors, logs of different drives.
    """
    samples, solutions = imu_in_order(imu), gnss_in_order(gnss)
    check_frame(solutions.log, solutions.records)
    check_gravity(samples.log, vehicle)
    check_tipping(samples.log, vehicle)
    _check_velocity(solutions.log)
    solutions = without_leaps(solutions)
    span = _overlap("IMU", samples.log.epochs_gps_ns, solutions.log.epochs_gps_ns)
    readings = None if odometer is None else odometer_in_order(odometer)
    if readings is not None:
        _overlap("odometer", readings.log.epochs_gps_ns, solutions.log.epochs_gps_ns)
    track = track_of(solutions.log)
    repairs = samples.repairs + solutions.repairs
    if track.epochs_gps_ns.size >= 2:
        windows = windows_of(track, span)
        if windows.speed.size:
            _check_stuck(samples, windows, vehicle)
            readings = _compared(samples.log, windows, readings, vehicle, drove_backwards)
    if readings is None:
        return Prepared(samples.log, solutions.log, None, repairs)
    return Prepared(samples.log, solutions.log, readings.log, repairs + readings.repairs)


def _overlap(name: str, epochs: Int64, others: Int64) -> tuple[int, int]:
    """Return the first and last epoch that a log and the GNSS log have in common.

    Raises
    ------
    TimeSystemError
        where they have none; it says what would bring them together.
    """
    first, last = max(int(epochs[0]), int(others[0])), min(int(epochs[-1]), int(others[-1]))
    if last - first >= LEAST_OVERLAP_S * NS_PER_S or (len(others) == 1 and first == last):
        return first, last
    away = (int(epochs[0]) + int(epochs[-1]) - int(others[0]) - int(others[-1])) / 2 / NS_PER_S
    raise TimeSystemError(
        f"the {name} log ({_span(epochs)}) and the GNSS log ({_span(others)}) have "
        f"{max(last - first, 0) / NS_PER_S:.1f} s in common",
        expected=f"at least {LEAST_OVERLAP_S:g} s",
        change=_cause(away, (int(epochs[-1]) - int(epochs[0]) + int(others[-1]) - int(others[0])) / 2 / NS_PER_S),
    )


def _span(epochs: Int64) -> str:
    return f"{iso_from_gps_ns(int(epochs[0]))} to {iso_from_gps_ns(int(epochs[-1]))}"


def _cause(away_s: float, reach_s: float) -> str:
    """Return the likely cause of an interval between two logs, which may be shifted by `reach_s` and still overlap."""
    if abs(abs(away_s) - GPS_EPOCH_UNIX_S) < 60.0 + reach_s:
        return "the stamps differ by the years from 1970 to 1980: one clock counts Unix time, the other GPS time"
    for name, unit in (("GPS weeks", WEEK_S), ("days", 86_400), ("hours", 3600)):
        count = round(away_s / unit)
        if count and abs(away_s - count * unit) < min(reach_s, 0.25 * unit):
            return f"the stamps differ by {count:+d} {name}: correct week, date or zone of one clock"
    return f"the stamps differ by {away_s:+.1f} s: check time system and offset of both clocks"


def _check_stuck(kept: Kept[ImuReadings], windows: Windows, vehicle: VehicleSensors) -> None:
    """Reject an axis that shows one value while the vehicle drives, unless the sensor is stated to have no noise."""
    imu, errors = kept.log, vehicle.imu_errors
    driving = np.interp(
        (imu.epochs_gps_ns - imu.epochs_gps_ns[0]).astype(np.float64),
        (windows.epochs_gps_ns - imu.epochs_gps_ns[0]).astype(np.float64),
        windows.driving.astype(np.float64),
        left=0.0,
        right=0.0,
    )
    for kind, values, noise in (
        ("gyroscope", imu.angular_rate_rad_per_s, errors.gyro_noise_deg_per_sqrt_h),
        ("accelerometer", imu.specific_force_m_per_s2, errors.accel_noise_ug_per_sqrt_hz),
    ):
        for axis in range(3):
            if noise <= 0.0:
                continue
            held = runs_of((np.diff(values[:, axis]) == 0.0) & (driving[1:] == 1.0))
            seconds = (imu.epochs_gps_ns[held[:, 1]] - imu.epochs_gps_ns[held[:, 0]]) / NS_PER_S
            if seconds.size and seconds.max() > STUCK_S:
                row = int(held[np.argmax(seconds), 0])
                raise NavigationError(
                    f"{kind} {'xyz'[axis]} shows {values[row, axis]:.6g} for {seconds.max():.1f} s while the vehicle "
                    f"drives, from {listed(kept.records[row : row + 1], imu.epochs_gps_ns[row : row + 1])}",
                    expected="readings that change",
                    change="the sensor or its logger hangs: cut the run there",
                    record=int(kept.records[row]),
                )


def _check_velocity(gnss: GnssSolutions) -> None:
    """Compare the velocities of a GNSS log with its positions."""
    epochs, moved = position_velocity(gnss)
    stated = np.isfinite(gnss.velocity_ned_m_per_s[:, 0])
    if stated.sum() < 3 or epochs.size < 3:
        return
    windows = windows_of(track_of(gnss), (int(gnss.epochs_gps_ns[0]), int(gnss.epochs_gps_ns[-1])))
    if windows.speed.size == 0:
        return
    both = [
        _means(e, v, windows)
        for e, v in ((epochs, moved), (gnss.epochs_gps_ns[stated], gnss.velocity_ned_m_per_s[stated]))
    ]
    check_velocity(windows, *both)


def _means(epochs: Int64, velocity: Float64, windows: Windows) -> Float64:
    """Return mean velocities (n, 3) over windows."""
    log = ImuReadings(epochs, velocity, velocity)
    return imu_means(log, windows.epochs_gps_ns, windows.window_s, np.eye(3))[0]


def _compared(
    imu: ImuReadings,
    windows: Windows,
    readings: Kept[OdometerReadings] | None,
    vehicle: VehicleSensors,
    drove_backwards: bool,
) -> Kept[OdometerReadings] | None:
    """Compare the IMU, then the odometer, with the antenna's motion; return the usable part of the odometer."""
    felt = Felt.by(imu, windows, vehicle)
    check_axes(felt, vehicle)
    signs = directions(felt)
    if readings is None:
        check_direction(felt, signs, None, drove_backwards=drove_backwards)
        return None
    speed = odometer_means(readings.log, windows.epochs_gps_ns, windows.window_s)
    hangs = _long(windows.driving & (np.abs(speed) < 1e-3), HANGS_S)
    check_odometer(np.where(hangs, np.nan, speed), windows)
    check_direction(felt, signs, np.where(hangs, np.nan, speed), drove_backwards=drove_backwards)
    if drove_backwards and not signs.any():
        signs = np.where(windows.driving, -1.0, 0.0)
    return _counting_right(readings, windows, speed, signs, hangs)


def _counting_right(
    readings: Kept[OdometerReadings], windows: Windows, speed: Float64, signs: Float64, hangs: Bool
) -> Kept[OdometerReadings]:
    """Return the odometer with forward positive, without drives in which it hangs or counts the wrong way."""
    told = windows.driving & (signs != 0.0) & (np.abs(speed) > 1e-3)
    wrong = told & (np.sign(speed) != signs)
    right = told & ~wrong
    if np.abs(speed[wrong]).sum() > 0 and np.abs(speed[right]).sum() < 0.05 * np.abs(speed[wrong]).sum():
        log = readings.log
        turned = replace(log, distance_m=-log.distance_m, speed_m_per_s=-log.speed_m_per_s)
        what = "counts downwards, against the direction of travel; all its readings changed their sign"
        ends = np.array([0, readings.records.size - 1])
        repair = Repair("odometer", what, readings.records[ends], log.epochs_gps_ns[ends])
        readings = Kept(turned, readings.records, [*readings.repairs, repair])
        wrong = np.zeros_like(wrong)
    if hangs.sum() > STUCK_SHARE * windows.driving.sum():
        rows = _rows_of(readings.log.epochs_gps_ns, windows, hangs)
        raise NavigationError(
            f"the odometer stands still over {hangs.sum() / max(windows.driving.sum(), 1):.0%} of the drive, first at "
            f"{listed(readings.records[rows[:1]], readings.log.epochs_gps_ns[rows[:1]])}",
            expected="a counter that counts while the vehicle drives",
            change="check wheel and encoder, or leave the encoder out of the survey file",
        )
    readings = _without(readings, windows, hangs, "stand still while the vehicle drives; they were left out")
    what = "count the wrong way (the wheel's direction is not told apart); they were left out"
    return _without(readings, windows, _whole_stints(windows, wrong), what)


def _without(readings: Kept[OdometerReadings], windows: Windows, bad: Bool, what: str) -> Kept[OdometerReadings]:
    """Return the odometer as speeds, without the windows in which it is wrong, across which no distance counts."""
    if not bad.any():
        return readings
    log = readings.log
    rows = _rows_of(log.epochs_gps_ns, windows, bad)
    if rows.size == 0:
        return readings
    keep = np.ones(log.epochs_gps_ns.size, dtype=bool)
    keep[rows] = False
    epochs, speeds, records = [], [], []
    for a, b in runs_of(keep):
        piece = np.arange(a, b)
        seconds, of, at = _speeds(log, piece)
        epochs.append(seconds)
        speeds.append(of)
        records.append(readings.records[at])
    speed = np.concatenate(speeds) if speeds else np.zeros(0)
    when = np.concatenate(epochs) if epochs else np.zeros(0, np.int64)
    kept = np.concatenate(records) if records else np.zeros(0, np.int64)
    repair = Repair("odometer", what, readings.records[rows], log.epochs_gps_ns[rows])
    return Kept(OdometerReadings(when, np.full(speed.size, np.nan), speed), kept, [*readings.repairs, repair])


def _speeds(log: OdometerReadings, piece: Int64) -> tuple[Int64, Float64, Int64]:
    """Return epochs, speeds and rows of a piece of an odometer's log: as stated, or from distances over `SPEED_S`."""
    stated = piece[np.isfinite(log.speed_m_per_s[piece])]
    if stated.size:
        return log.epochs_gps_ns[stated], log.speed_m_per_s[stated], stated
    counted = piece[np.isfinite(log.distance_m[piece])]
    if counted.size < 2:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64)
    usual = float(np.median(np.diff(log.epochs_gps_ns[counted]))) / NS_PER_S
    ends = counted[:: max(1, round(SPEED_S / usual))]
    steps = np.diff(log.epochs_gps_ns[ends])
    return log.epochs_gps_ns[ends[:-1]] + steps // 2, np.diff(log.distance_m[ends]) * NS_PER_S / steps, ends[:-1]


def _rows_of(epochs: Int64, windows: Windows, bad: Bool) -> Int64:
    """Return rows whose epochs lie in runs of bad windows, with half a window and a step around."""
    half = round((windows.window_s / 2 + STEP_S) * NS_PER_S)
    inside = np.zeros(epochs.size, dtype=bool)
    for a, b in runs_of(bad):
        first, last = windows.epochs_gps_ns[a] - half, windows.epochs_gps_ns[b - 1] + half
        inside |= (epochs >= first) & (epochs <= last)
    return np.flatnonzero(inside)


def _long(flags: Bool, least_s: float) -> Bool:
    """Return the runs of flags of at least this length."""
    out = np.zeros_like(flags)
    for a, b in runs_of(flags):
        out[a:b] = (b - a) * STEP_S >= least_s
    return out


def _whole_stints(windows: Windows, wrong: Bool) -> Bool:
    """Return the stints of which the greater part is wrong."""
    out = np.zeros_like(wrong)
    for a, b in windows.stints:
        out[a:b] = wrong[a:b].mean() > 0.5
    return out
