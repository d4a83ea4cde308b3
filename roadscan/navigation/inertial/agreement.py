"""Checks whether IMU, GNSS receiver and odometer measured the same drive: units, axes, signs and clocks.

A question is answered only where the drive can answer it: without a turn there is no word on the sign of the yaw rate,
at an even speed none on the forward axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np

from roadscan.compute.array_types import Bool, Float64
from roadscan.compute.arrays import runs_of
from roadscan.core.errors import ConfigError, NavigationError, TimeSystemError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import STANDARD_GRAVITY_M_PER_S2
from roadscan.navigation.inertial.motion import STEP_S, Windows, imu_means
from roadscan.navigation.inertial.readings import ImuReadings, VehicleSensors

TILT_DRIVING_DEG: Final = 10.0
"""Largest angle between gravity, corrected for the road's slope, and its direction by the mounting."""
TILT_STANDING_DEG: Final = 20.0
"""The same where no slope is known."""
LAG_S: Final = 0.2
"""Least difference of clocks (and five times its σ) that is judged here."""
ALIKE: Final = 0.8
"""Least correlation of two signals of the same motion."""
UNLIKE: Final = 0.5
"""Below this correlation two signals are not the same motion."""
SCALES: Final = (0.8, 1.25)
"""Range of ratios of two signals in the same unit."""
_LONGEST_LAG_S: Final = 600.0  # Longest lag that is searched.
_TURNED_RAD: Final = np.radians(60.0)  # Least sum of turns by which axes are judged.
_ALONG_M_PER_S2: Final = 0.3  # Least acceleration along the way that is judged.
_ASIDE_M_PER_S2: Final = 0.5  # Least acceleration across the way that is judged.
_LEAST_S: Final = 5.0  # Least time for a check, and length of the blocks in which tilts are compared.
_TIPPED_RAD: Final = np.radians(6.0)  # Least tipping by which units are judged.
_TILTED_RAD: Final = np.radians(0.2)  # Least tilt by which axes are judged.
_TILT_ALIKE: Final = 0.4  # Least correlation of two tilts.
_TILT_BLOCKS: Final = 12  # Least number of blocks by which tilts are judged.
_AXES: Final = ("x", "y", "z")
_BODY: Final = ("forward", "right", "down")


@dataclass(frozen=True)
class Felt:
    """Measurements of the IMU over the windows of a drive, body axes according to the mounting."""

    windows: Windows
    rate: Float64
    """(n, 3) rad/s."""
    force: Float64
    """(n, 3) m/s²."""
    known: Bool
    """(n,) True where the IMU log covers the window."""
    sample_s: float
    """Time between samples."""

    @classmethod
    def by(cls, imu: ImuReadings, windows: Windows, vehicle: VehicleSensors) -> Felt:
        """Compute means of a log over windows."""
        rate, force = imu_means(imu, windows.epochs_gps_ns, windows.window_s, vehicle.body_from_imu)
        sample_s = float(np.median(np.diff(imu.epochs_gps_ns))) / NS_PER_S
        return cls(windows, rate, force, np.isfinite(rate[:, 0]), sample_s)


def check_gravity(imu: ImuReadings, vehicle: VehicleSensors) -> None:
    """Check that the mean force of an IMU is that of gravity.

    Raises
    ------
    ConfigError
        where it is in another unit, or not above the vehicle.
    """
    size = np.linalg.norm(imu.specific_force_m_per_s2, axis=1)
    felt = float(np.median(size))
    step_s = float(np.median(np.diff(imu.epochs_gps_ns))) / NS_PER_S
    if not 0.95 < felt / STANDARD_GRAVITY_M_PER_S2 < 1.05:
        _wrong_force(felt, step_s)
    mean = vehicle.body_from_imu @ imu.specific_force_m_per_s2.mean(axis=0)
    tilt = np.degrees(np.arccos(np.clip(-mean[2] / np.linalg.norm(mean), -1.0, 1.0)))
    if tilt > TILT_STANDING_DEG:
        _wrong_gravity(mean, vehicle, float(tilt), TILT_STANDING_DEG)


def check_tipping(imu: ImuReadings, vehicle: VehicleSensors) -> None:
    """Check that gravity moves as the gyroscopes say the body tips: this tells degrees from radians without a turn.

    Raises
    ------
    ConfigError
        where it tips by far more than gravity shows.
    """
    step, half = round(STEP_S * NS_PER_S), round(STEP_S * NS_PER_S)
    middles = np.arange(imu.epochs_gps_ns[0] + half, imu.epochs_gps_ns[-1] - half, step)
    if middles.size * STEP_S < _LEAST_S:
        return
    rate, force = imu_means(imu, middles, 2 * STEP_S, vehicle.body_from_imu)
    rate, force = rate[np.isfinite(rate[:, 0])], force[np.isfinite(rate[:, 0])]
    size = round(_LEAST_S / STEP_S)
    tipped, moved = _detrended(np.cumsum(rate[:, :2], axis=0) * STEP_S, size), _detrended(force[:, 1::-1], size)
    angle, feels = np.sqrt((tipped**2).mean(axis=0)), np.sqrt((moved**2).mean(axis=0))
    for axis in range(2):
        if angle[axis] > _TIPPED_RAD and feels[axis] < 0.2 * STANDARD_GRAVITY_M_PER_S2 * np.sin(min(angle[axis], 1.5)):
            raise ConfigError(
                f"the gyroscope about the {_BODY[axis]} axis says that the vehicle tips by "
                f"{np.degrees(angle[axis]):.0f}° (1 σ within {_LEAST_S:g} s), but gravity moves only as for "
                f"{np.degrees(feels[axis] / STANDARD_GRAVITY_M_PER_S2):.1f}°",
                expected="angular rates in rad/s",
                change="state that the log's rates are in degrees a second, if they are",
            )


def check_axes(felt: Felt, vehicle: VehicleSensors, gnss_name: str = "GNSS") -> None:
    """Check that the IMU turns, accelerates and leans as the antenna's path does.

    Raises
    ------
    ConfigError
        where units or axes differ.
    TimeSystemError
        where the motions agree only at other times.
    """
    w, ok = felt.windows, felt.windows.driving & felt.known
    if not ok.any():
        _check_turning_while_standing(felt)
        return
    _check_slope(felt, ok, vehicle)
    turns = ok & (np.abs(w.turn) > 4 * w.turn_noise)
    if np.abs(w.turn[turns]).sum() * STEP_S > _TURNED_RAD:
        _check_turn(felt, ok, vehicle, gnss_name)
    _check_along(felt, ok, vehicle)
    signs = directions(felt)
    _check_lag(felt, ok, signs, vehicle)
    _check_tilt(felt, signs, vehicle)


def directions(felt: Felt) -> Float64:
    """Return 1 (n,) where the vehicle drives forward, −1 backwards, 0 where its accelerations do not show it.

    Driving backwards, accelerations along and across the direction of travel change their sign in the body.
    """
    w = felt.windows
    out = np.zeros(w.speed.size)
    for a, b in w.stints:
        rows = np.flatnonzero(felt.known[a:b]) + a
        if rows.size * STEP_S < _LEAST_S:
            continue
        out[a:b] = _direction(
            _told(felt.force[rows, 0], w.along[rows], max(_ALONG_M_PER_S2, 5 * w.along_noise)),
            _told(felt.force[rows, 1], w.aside[rows], max(_ASIDE_M_PER_S2, 5 * w.along_noise)),
        )
    return out


def check_direction(felt: Felt, signs: Float64, odometer: Float64 | None, *, drove_backwards: bool) -> None:
    """Check that the vehicle mostly drives forward, unless another sensor confirms that it does not.

    odometer : (n,) its speed over the windows.

    Raises
    ------
    ConfigError
        where IMU or odometer feel a drive backwards that nothing else confirms.
    """
    w = felt.windows
    if drove_backwards:
        return
    counted = np.zeros(w.speed.size) if odometer is None else np.nan_to_num(odometer)
    forward, back = (float(w.speed[signs == s].sum()) * STEP_S for s in (1.0, -1.0))
    if back > forward and counted[signs == -1.0].sum() >= 0.0:
        up = ", and the odometer counts upwards" if counted.any() else ""
        raise ConfigError(
            f"by its accelerations the vehicle drives backwards over {back:.0f} m and forward over {forward:.0f} m{up}",
            expected="a vehicle that drives forward for the most part",
            change="turn the IMU's boresight heading by 180° in the rig file, or, if it really was driven backwards, "
            "say so (drove_backwards)",
        )
    if not signs.any() and counted[w.driving].sum() < 0.0:
        raise ConfigError(
            "the odometer counts downwards, and the accelerations do not tell which way the vehicle drives",
            expected="a counter that grows forwards",
            change="change the sign of the log's counter, or, if the vehicle was driven backwards, say so "
            "(drove_backwards)",
        )


def check_velocity(track: Windows, moved: Float64, stated: Float64) -> None:
    """Check that the velocities of a GNSS log are those of its positions.

    moved, stated : (n, 3) velocities over windows, from positions and as the log states them.

    Raises
    ------
    ConfigError
        where unit or axes differ.
    """
    ok = track.driving & np.isfinite(moved).all(axis=1) & np.isfinite(stated).all(axis=1)
    if ok.sum() * STEP_S < _LEAST_S:
        return
    p, v = moved[ok], stated[ok]
    # Medians, so that a leap of the positions does not affect the velocities.
    flat = float(np.median((p[:, :2] * v[:, :2]).sum(axis=1) / (v[:, :2] ** 2).sum(axis=1)))
    rest = _left(p, flat * v)
    if rest > 0.4:
        fitting = [
            name
            for name, other in (
                ("east and north exchanged", v[:, [1, 0]]),
                ("south instead of north", v[:, :2] * [-1, 1]),
                ("west instead of east", v[:, :2] * [1, -1]),
            )
            if _left(p, other) < 0.3
        ]
        hint = f"the velocities have {fitting[0]}" if fitting else "check columns, axes and clock of the velocities"
        raise ConfigError(
            f"the velocities of the GNSS log are not those of its positions ({rest:.0%} of the motion is left over)",
            expected="north, east, down in m/s",
            change=hint,
        )
    if not SCALES[0] < flat < SCALES[1]:
        raise ConfigError(
            f"the antenna's positions move {flat:.4g} times as fast as the velocities of the GNSS log say",
            expected="positions in m and velocities in m/s",
            change=_hint(1 / flat, {"velocities are in km/h": 3.6, "velocities are in knots": 1.9438,
                                    "positions are in feet": 0.3048, "positions are in km": 1000.0,
                                    "positions are in mm": 0.001, "velocities are in mph": 2.2369}),
        )  # fmt: skip
    calm = np.abs(p[:, 2]) < 5.0
    if p[calm, 2].std() > 0.15 and _alike(p[calm, 2], v[calm, 2]) < -0.7:
        raise ConfigError(
            "the vertical velocities of the GNSS log have the opposite sign of its positions' changes",
            expected="velocity down positive",
            change="the log's vertical velocity counts upwards",
        )


def check_odometer(speed: Float64, windows: Windows) -> None:
    """Check that the odometer counts as fast as the antenna moves, and when it moves.

    speed : (n,) of the odometer over the windows.

    Raises
    ------
    ConfigError
        where its unit is wrong.
    TimeSystemError
        where it moves at other times.
    """
    ok = windows.driving & np.isfinite(speed) & (np.abs(speed) > 1e-3)
    if ok.sum() * STEP_S < _LEAST_S:
        return
    size = float(np.median(np.abs(speed[ok]) / windows.speed[ok]))
    both = windows.covered & np.isfinite(speed)
    rest = _rest(np.abs(speed[both]) / size, windows.speed[both])
    if rest > 0.1:
        lag, alike = _best_lag(np.where(both, np.abs(speed), 0.0), np.isfinite(speed), windows.speed, windows.covered)
        if abs(lag) > LAG_S and alike > 0.9 and alike > _alike(np.abs(speed[both]), windows.speed[both]) + 0.05:
            raise TimeSystemError(
                f"the odometer feels the drive {abs(lag):.1f} s {'later' if lag > 0 else 'earlier'} than the GNSS "
                f"receiver (correlation {alike:.2f})",
                expected=f"clocks that agree within {LAG_S:g} s",
                change=f"add {-lag:+.1f} s to the odometer's clock (offset_s), and measure it",
            )
    if not SCALES[0] < size < SCALES[1]:
        raise ConfigError(
            f"the odometer counts {size:.4g} times the way that the GNSS antenna drives",
            expected=f"{SCALES[0]:g} to {SCALES[1]:g} times",
            change=_hint(size, {"its speed is in km/h": 3.6, "its speed is in mph": 2.2369, "it counts in km": 0.001,
                                "it counts in cm": 100.0, "it counts in mm": 1000.0, "it counts in feet": 3.2808,
                                "it counts radius instead of circumference": 1 / (2 * np.pi)})
            + "; otherwise correct metres_per_tick of the encoder",
        )  # fmt: skip


def _told(force: Float64, motion: Float64, least: float) -> float:
    """Return 1 or −1 where a motion is measured with this sign, 0 where it is too small or not measured."""
    if np.sqrt(np.mean(motion**2)) < least:
        return 0.0
    alike = float(motion @ force) / np.sqrt(max(float(motion @ motion) * float(force @ force), 1e-12))
    return float(np.sign(alike)) if abs(alike) > 0.7 else 0.0


def _direction(along: float, aside: float) -> float:
    """Return the direction of travel from both accelerations; 0 where they contradict each other."""
    return float(np.sign(along + aside))


def _check_turning_while_standing(felt: Felt) -> None:
    w = felt.windows
    still = w.covered & felt.known & (w.speed < 0.5)
    if still.sum() * STEP_S < 3 * _LEAST_S or still.sum() < 0.9 * (w.covered & felt.known).sum():
        return
    turned = np.cumsum(felt.rate[still, 2] - np.median(felt.rate[still, 2])) * STEP_S
    if np.ptp(turned) > np.radians(90.0) and felt.rate[still, 2].std() > np.radians(5.0):
        raise NavigationError(
            f"the IMU turns by {np.degrees(np.ptp(turned)):.0f}° while the GNSS antenna stands still",
            expected="logs of one vehicle",
            change="check that both logs belong to this run, and that the receiver does not repeat one solution",
        )


def _check_slope(felt: Felt, ok: Bool, vehicle: VehicleSensors) -> None:
    w = felt.windows
    signs = np.where(directions(felt) < 0, -1.0, 1.0)
    mean = felt.force[ok].mean(axis=0) - [(signs * w.along)[ok].mean(), (signs * w.aside)[ok].mean(), 0.0]
    tilt = float(np.degrees(np.arccos(np.clip(-mean[2] / np.linalg.norm(mean), -1.0, 1.0))))
    if tilt > TILT_DRIVING_DEG and ok.sum() * STEP_S > _LEAST_S:
        _wrong_gravity(mean, vehicle, tilt, TILT_DRIVING_DEG)


def _check_turn(felt: Felt, ok: Bool, vehicle: VehicleSensors, gnss_name: str) -> None:
    """Compare the turn of the course with the three rates: axis, sign, unit and time."""
    turn, rate = felt.windows.turn, felt.rate
    alike = np.array([_alike(rate[ok, k], turn[ok]) for k in range(3)])
    slope = np.array([_slope(rate[ok, k], turn[ok]) for k in range(3)])
    axis = int(np.argmax(np.abs(alike * slope)))
    if alike[2] > ALIKE and SCALES[0] < slope[2] < SCALES[1]:
        _check_leaning(alike, slope)
        return
    if np.abs(alike).max() < ALIKE:
        _wrong_time(felt, ok, turn, [rate[:, k] for k in (2, 0, 1)], "turns", float(alike[2]), gnss_name)
        return
    if axis != 2 or alike[axis] < 0:
        direction = np.zeros(3)
        direction[axis] = np.sign(alike[axis])
        _wrong_axis("the turn of the GNSS course", "down", "gyroscope", direction, alike[axis], vehicle)
    raise ConfigError(
        f"the yaw rate of the IMU is {slope[2]:.4g} times the turn of the GNSS course (correlation {alike[2]:.2f})",
        expected=f"rates in rad/s: a ratio of {SCALES[0]:g} to {SCALES[1]:g}",
        change=_rate_hint(float(slope[2]), felt.sample_s),
    )


def _check_leaning(alike: Float64, slope: Float64) -> None:
    """Check that turns are measured about the vertical only, apart from the slope of the road."""
    for axis in range(2):
        lean_deg = float(np.degrees(np.arctan2(slope[axis], slope[2])))
        if abs(alike[axis]) > 0.7 and abs(lean_deg) > TILT_DRIVING_DEG:
            raise ConfigError(
                f"turns are felt by the gyroscope about the {_BODY[axis]} axis, too: {abs(slope[axis]):.2f} of them "
                f"(correlation {alike[axis]:.2f}), as if it leaned by {abs(lean_deg):.0f}°",
                expected=f"within {TILT_DRIVING_DEG:g}° of the vertical",
                change="correct axes or boresight of the IMU in the rig file, or the signs of the gyroscope's columns",
            )


def _check_along(felt: Felt, ok: Bool, vehicle: VehicleSensors) -> None:
    w = felt.windows
    along, aside = w.along[ok] - w.along[ok].mean(), w.aside[ok] - w.aside[ok].mean()
    force = felt.force[ok] - felt.force[ok].mean(axis=0)
    if ok.sum() * STEP_S < 2 * _LEAST_S:
        return
    turned = np.where(directions(felt)[ok] < 0, -1.0, 1.0)
    for axis, motion, least in ((0, along, _ALONG_M_PER_S2), (1, aside, _ASIDE_M_PER_S2)):
        if motion.std() < max(least, 5 * w.along_noise):
            continue
        alike = np.array([_alike(force[:, k], turned * motion) for k in range(3)])
        wanted, name = (w.along, w.aside)[axis], ("accelerations", "bends")[axis]
        if abs(_alike(force[:, axis], motion)) < 0.95:
            _check_other_time(felt, ok, wanted, felt.force[:, axis], _alike(force[:, axis], motion))
        best = int(np.argmax(np.abs(alike)))
        if abs(alike[best]) > ALIKE and (best != axis or alike[best] < 0):
            direction = np.zeros(3)
            direction[best] = np.sign(alike[best])
            what = ("the change of the GNSS speed", "the GNSS path's bends")[axis]
            _wrong_axis(what, _BODY[axis], "accelerometer", direction, float(alike[best]), vehicle)
        elif np.abs(alike).max() < UNLIKE:
            _wrong_time(
                felt, ok, wanted, [felt.force[:, k] for k in (axis, 1 - axis, 2)], name, float(alike[axis]), "GNSS"
            )


def _check_lag(felt: Felt, ok: Bool, signs: Float64, vehicle: VehicleSensors) -> None:
    """Check clocks that differ by a part of a second: find the lag that removes most of the difference."""
    w = felt.windows
    total, weight = 0.0, 0.0
    sense = np.where(signs < 0, -1.0, 1.0)
    for motion, feels, noise in (
        (w.turn, felt.rate[:, 2], w.turn_noise),
        (sense * w.along, felt.force[:, 0], np.full(w.speed.size, w.along_noise)),
    ):
        if not ok.any() or motion[ok].std() < 5 * np.median(noise[ok]):
            continue
        lag, sigma = _small_lag(motion, feels, ok)
        if np.isfinite(sigma) and sigma > 0.0:
            total, weight = total + lag / sigma**2, weight + 1 / sigma**2
    if weight == 0.0:
        return
    lag, sigma = total / weight, weight**-0.5
    arm = float(np.linalg.norm(vehicle.antenna_lever_arm_body_m[:2])) / float(np.median(w.speed[ok]))
    if abs(lag) > LAG_S + 5 * sigma + arm:
        _refuse_lag(lag, 1.0, sigma)


def _check_tilt(felt: Felt, signs: Float64, vehicle: VehicleSensors) -> None:
    """Compare roll and pitch of the gyroscopes with the tilt from gravity: axes and signs that no turn shows.

    Within blocks of `_LEAST_S`; a road that tilts the vehicle by less than `_TILTED_RAD` does not count.
    """
    w = felt.windows
    sense = np.where(signs < 0, -1.0, 1.0)
    level = felt.force[:, :2] - np.stack([sense * w.surge, np.where(w.driving, sense * w.aside, 0.0)], axis=1)
    shown = np.stack([-level[:, 1], level[:, 0]], axis=1) / STANDARD_GRAVITY_M_PER_S2
    turned = np.cumsum(np.nan_to_num(felt.rate[:, :2]), axis=0) * STEP_S
    size = round(_LEAST_S / STEP_S)
    pairs = [
        (_detrended(turned[a:b], size), _detrended(shown[a:b], size))
        for a, b in runs_of(w.covered & felt.known)
        if b - a >= size
    ]
    if sum(len(gyro) for gyro, _ in pairs) < _TILT_BLOCKS * size:
        return
    gyro, gravity = (np.concatenate(columns) for columns in zip(*pairs, strict=True))
    for axis in range(2):
        own, other = (_same_angle(gyro[:, k], gravity[:, axis]) for k in (axis, 1 - axis))
        if gyro.std(axis=0).min() < _TILTED_RAD or (own > -_TILT_ALIKE and (own > 0.2 or abs(other) < _TILT_ALIKE)):
            continue
        direction = np.zeros(3)
        direction[axis if own < -_TILT_ALIKE else 1 - axis] = np.sign(own if own < -_TILT_ALIKE else other)
        what = ("the tilt to the side that gravity shows", "the tilt ahead that gravity shows")[axis]
        alike = own if own < -_TILT_ALIKE else other
        _wrong_axis(what, _BODY[axis], "gyroscope", direction, alike, vehicle)


def _small_lag(motion: Float64, feels: Float64, ok: Bool) -> tuple[float, float]:
    """Return the delay (s) of a signal, and its σ, from the first-order change with time."""
    a, b = motion - motion[ok].mean(), feels - feels[ok].mean()
    lag, sigma = 0.0, np.inf
    at = np.arange(a.size) * STEP_S
    filled = np.interp(at, at[np.isfinite(b)], b[np.isfinite(b)])
    for _ in range(4):
        late = np.interp(at + lag, at, filled)
        change = np.gradient(late, STEP_S)[ok]
        rest = (a - late)[ok]
        power = float(change @ change)
        if power <= 0.0:
            return 0.0, np.inf
        lag += float(change @ rest) / power
        sigma = float(rest.std()) * np.sqrt(1.0 / STEP_S / power)
    return lag, sigma


def _wrong_time(
    felt: Felt, ok: Bool, motion: Float64, signals: list[Float64], what: str, alike: float, gnss_name: str
) -> None:
    """Reject motions that disagree at the stated times; name the time at which they agree, if any."""
    best = max((_best_lag(s, felt.known, motion, ok) for s in signals), key=lambda found: found[1])
    if best[1] > 0.9 and abs(best[0]) > LAG_S:
        _refuse_lag(best[0], best[1], STEP_S)
    if abs(alike) < UNLIKE:
        raise NavigationError(
            f"the {what} that the IMU feels are not those of the {gnss_name} path (correlation {alike:.2f}), and not "
            f"within {_LONGEST_LAG_S:g} s of it either (best {best[1]:.2f})",
            expected=f"logs of one drive: a correlation of {ALIKE:g} or more",
            change="check that both logs belong to this run, the IMU's axes, and both clocks (week, time system)",
        )


def _check_other_time(felt: Felt, ok: Bool, motion: Float64, feels: Float64, alike: float) -> None:
    """Reject a motion that agrees much better at another time."""
    lag, there = _best_lag(feels, felt.known, motion, ok)
    if there > 0.97 and there > abs(alike) + 0.1 and abs(lag) > LAG_S:
        _refuse_lag(lag, there, STEP_S)


def _refuse_lag(lag_s: float, alike: float, sigma_s: float) -> NoReturn:
    later = "later" if lag_s > 0 else "earlier"
    digits = 1 if sigma_s > 0.02 else 2
    seconds = abs(lag_s)
    is_leap = round(seconds) in range(13, 20) and abs(seconds - round(seconds)) < 0.3
    likely = " (leap seconds: UTC taken for GPS time?)" if is_leap else ""
    raise TimeSystemError(
        f"the IMU feels the motion {abs(lag_s):.{digits}f} s {later} than the GNSS antenna makes it{likely}"
        + ("" if alike == 1.0 else f" (correlation {alike:.2f} there)"),
        expected=f"clocks that agree within {LAG_S:g} s",
        change=f"add {-lag_s:+.{digits}f} s to the IMU's clock (offset_s), or estimate it (roadscan clocks)",
    )


def _wrong_force(felt: float, step_s: float) -> NoReturn:
    units = {"g": 1 / STANDARD_GRAVITY_M_PER_S2, "mg": 1000 / STANDARD_GRAVITY_M_PER_S2,
             "cm/s² (Gal)": 100.0, "ft/s²": 3.28084,
             "m/s over each sample (velocity increments)": step_s,
             "g·s over each sample": step_s / STANDARD_GRAVITY_M_PER_S2}  # fmt: skip
    fitting = [name for name, factor in units.items() if 0.95 < felt / (STANDARD_GRAVITY_M_PER_S2 * factor) < 1.05]
    raise ConfigError(
        f"the IMU feels a force of {felt:.4g} (median), at samples {step_s * 1e3:.4g} ms apart",
        expected=f"about {STANDARD_GRAVITY_M_PER_S2:.2f} m/s², gravity's, for the most part",
        change=f"the log seems to be in {' or '.join(fitting)}: state its unit"
        if fitting
        else "check the unit of the accelerations, and that gravity was not removed",
    )


def _wrong_gravity(mean: Float64, vehicle: VehicleSensors, tilt_deg: float, limit_deg: float) -> NoReturn:
    reads = vehicle.body_from_imu.T @ mean
    axis = int(np.argmax(np.abs(reads)))
    sign = "+" if reads[axis] > 0 else "−"
    roll = np.degrees(np.arctan2(-mean[1], -mean[2]))
    pitch = np.degrees(np.arctan2(mean[0], np.hypot(mean[1], mean[2])))
    raise ConfigError(
        f"gravity lies {tilt_deg:.1f}° from where the IMU's mounting has it: its axes read "
        f"({reads[0]:.2f}, {reads[1]:.2f}, {reads[2]:.2f}) m/s² on average, so {sign}{_AXES[axis]} points up",
        expected=f"within {limit_deg:g}° of the vehicle's up",
        change=f"correct axes or boresight of the IMU in the rig file (the vehicle would stand with roll {roll:.1f}° "
        f"and pitch {pitch:.1f}°), or the signs of the log's columns",
    )


def _wrong_axis(
    what: str, body: str, sensor: str, direction: Float64, alike: float, vehicle: VehicleSensors
) -> NoReturn:
    should = vehicle.body_from_imu.T @ np.eye(3)[_BODY.index(body)]
    does = vehicle.body_from_imu.T @ direction
    raise ConfigError(
        f"{what} is felt by the {sensor} on {_named(does)} (correlation {abs(alike):.2f})",
        expected=f"on {_named(should)}, which the mounting has as {body}",
        change="correct axes or boresight of the IMU in the rig file, or order and signs of the log's columns",
    )


def _named(direction: Float64) -> str:
    axis = int(np.argmax(np.abs(direction)))
    return f"the IMU's {'+' if direction[axis] > 0 else '−'}{_AXES[axis]}"


def _rate_hint(ratio: float, step_s: float) -> str:
    degrees = 180 / np.pi
    for name, factor in (("degrees a second", degrees), ("milliradians a second", 1000.0),
                         ("degrees an hour", degrees * 3600), ("radians over each sample (increments)", step_s),
                         ("degrees over each sample (increments)", degrees * step_s)):  # fmt: skip
        if 0.8 < ratio / factor < 1.25:
            return f"the log's rates seem to be in {name}: state their unit"
    return "check the unit of the log's angular rates "


def _hint(ratio: float, units: dict[str, float]) -> str:
    for name, factor in units.items():
        if 0.93 < ratio / factor < 1.07:
            return f"probably {name}"
    return "check the unit"


def _best_lag(late: Float64, late_known: Bool, motion: Float64, known: Bool) -> tuple[float, float]:
    """Lag (s) with the highest correlation of a signal with a motion, and that correlation, up to ±10 min."""
    a, b = np.where(known, motion, 0.0), np.where(late_known, late, 0.0)
    m, n = known.astype(np.float64), late_known.astype(np.float64)
    a = np.where(known, a - a[known].mean(), 0.0)
    b = np.where(late_known, b - b[late_known].mean(), 0.0)
    size = 1 << int(np.ceil(np.log2(2 * a.size)))

    def correlated(x: Float64, y: Float64) -> Float64:
        product = np.fft.irfft(np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size), size)
        return np.concatenate([product[-(a.size - 1) :], product[: a.size]])

    power_a, power_b = correlated(a * a, n), correlated(m, b * b)
    lags = np.arange(-(a.size - 1), a.size) * STEP_S
    usable = (power_a > 0.6 * (a @ a)) & (np.abs(lags) <= _LONGEST_LAG_S) & (power_b > 0)
    alike = np.zeros(lags.size)
    alike[usable] = correlated(a, b)[usable] / np.sqrt(power_a[usable] * power_b[usable])
    at, other = int(np.argmax(alike)), int(np.argmin(alike))
    if -alike[other] > alike[at] + 0.1:
        at = other
    return float(lags[at]), abs(float(alike[at]))


def _detrended(values: Float64, size: int) -> Float64:
    """Subtract from values (n, k) the straight line through each block of `size` rows."""
    blocks = len(values) // size
    cut = values[: blocks * size].reshape(blocks, size, -1)
    line = np.linspace(-1.0, 1.0, size)[None, :, None]
    slope = (cut * line).sum(axis=1, keepdims=True) / (line**2).sum()
    rest: Float64 = (cut - cut.mean(axis=1, keepdims=True) - slope * line).reshape(blocks * size, -1)
    return rest


def _alike(a: Float64, b: Float64) -> float:
    """Return the correlation; 0 where one of the two does not change."""
    x, y = a - a.mean(), b - b.mean()
    power = float(x @ x) * float(y @ y)
    return float(x @ y) / np.sqrt(power) if power > 0 else 0.0


def _same_angle(gyro: Float64, gravity: Float64) -> float:
    """Return the correlation of two angles; 0 where their sizes differ."""
    alike = _alike(gyro, gravity)
    size = abs(_slope(gravity, gyro)) if gyro.std() > 0 else 0.0
    return alike if 0.4 < size < 2.5 else 0.0


def _slope(a: Float64, b: Float64) -> float:
    """Return the factor from b to a, by least squares."""
    x, y = a - a.mean(), b - b.mean()
    return float(x @ y) / float(y @ y)


def _left(moved: Float64, stated: Float64) -> float:
    """Return the median share of horizontal velocities (n, 2 or 3) that differs from the others."""
    rest = np.linalg.norm(moved[:, :2] - stated[:, :2], axis=1)
    return float(np.median(rest / np.maximum(np.linalg.norm(moved[:, :2], axis=1), 1e-3)))


def _rest(a: Float64, b: Float64) -> float:
    """Return the share of b that remains after subtracting a."""
    return float(np.sqrt(((a - b) ** 2).mean() / max((b**2).mean(), 1e-12)))
