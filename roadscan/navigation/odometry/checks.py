"""What contradicts poses that a lidar made by itself: too few points, no surface that holds them, leaps, an IMU."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.gpstime import iso_from_gps_ns
from roadscan.core.imu import STANDARD_GRAVITY_M_PER_S2
from roadscan.core.settings.odometry import OdometryConfig
from roadscan.core.witness import Finding, Witness
from roadscan.navigation.odometry.registration import FEWEST_POINTS, LEAST_HELD, Matched
from roadscan.navigation.odometry.rig_motion import WINDOW_S, Way, Windows

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LIDAR_ODOMETRY: Final = Witness(
    "lidar_odometry",
    input="lidar",
    fault="Sweeps were matched wrongly, or could not be matched: too few points, nothing that holds them along the "
    "road, a leap.",
    asks="the number of points of each sweep, the directions of the surfaces around, the speed that the poses need, "
    "and turns and gravity by the IMU, where there is one",
    does="a sweep with too few points gets no pose; all else is kept, and named with its time; where most sweeps are "
    "not held along the road, no trajectory is made",
    told=("findings", "error"),
)
_LEAP_M, _LEAP_M_PER_S2 = 0.5, 1.5 * STANDARD_GRAVITY_M_PER_S2
"""A pose lies off a steady motion by at most this, and by what brakes and kerbs do."""
_TURN_RAD: Final = np.radians(1.5)  # turn within a window that gyroscope and sweeps may differ by
_TILT_RAD: Final = np.radians(2.0)  # gravity of a window against that of the drive


def findings(
    subject: str, way: Way, matched: Matched, windows: Windows | None, config: OdometryConfig, max_gap_s: float
) -> Iterator[Finding]:
    """Yield a finding for each kind of contradiction, with the number of its times and the worst of them."""

    def told(bad: Flags, at: Int64, size: Float64, words: str, left_out: int = 0) -> Iterator[Finding]:
        if bad.any():
            worst = int(np.argmax(np.where(bad, size, -np.inf)))
            text = words.format(count=int(bad.sum()), of=bad.size, size=size[worst], at=iso_from_gps_ns(int(at[worst])))
            yield LIDAR_ODOMETRY.finds(subject, text, left_out)

    thin = matched.thin_gps_ns
    yield from told(
        np.ones(thin.size, bool), thin, -thin.astype(np.float64),
        f"{{count}} sweeps have fewer than {FEWEST_POINTS} thinned points, the first at {{at}}: they have no pose of "
        "their own.", thin.size,
    )  # fmt: skip
    yield from told(
        matched.held < LEAST_HELD, matched.judged_gps_ns, -matched.held,
        "{count} of {of} sweeps that were judged see surfaces that hold them along two directions only, worst at {at}: "
        "the way along the third one is guessed there, and σ says so.",
    )  # fmt: skip
    step_s, step_m = np.diff(way.seconds), np.linalg.norm(np.diff(way.position_m, axis=0), axis=1)
    yield from told(
        step_m > config.speed_max_m_per_s * step_s, way.epochs_gps_ns[1:], step_m / step_s,
        f"{{count}} poses can be reached only faster than {config.speed_max_m_per_s:g} m/s, worst {{size:.0f}} m/s at "
        "{at}.",
    )  # fmt: skip
    speed = np.diff(way.position_m, axis=0) / step_s[:, None]
    leap_m = np.linalg.norm(np.diff(speed, axis=0), axis=1) * step_s[1:]
    yield from told(
        leap_m > _LEAP_M + _LEAP_M_PER_S2 * step_s[1:] * (step_s[1:] + step_s[:-1]) / 2, way.epochs_gps_ns[2:], leap_m,
        "{count} poses leap from the motion before them by more than a vehicle can, worst {size:.2f} m at {at}.",
    )  # fmt: skip
    yield from told(
        step_s > max_gap_s, way.epochs_gps_ns[:-1], step_s,
        "{count} times there is no sweep for longer than navigation.max_gap_s, worst {size:.1f} s from {at}: the way "
        "between is guessed, and what is measured there has no pose.",
    )  # fmt: skip
    if windows is not None:
        turn = windows.turn_rad - np.median(windows.turn_rad) * (windows.turn_rad.size > 4)  # less the gyroscope's bias
        yield from told(
            np.abs(turn) > _TURN_RAD, windows.epochs_gps_ns[:-1], np.degrees(np.abs(turn)),
            f"{{count}} of {{of}} times the IMU turns otherwise than the poses within {WINDOW_S:g} s, worst by "
            "{size:.1f}° from {at}.",
        )  # fmt: skip
        mean, up = windows.up_world.mean(axis=0), windows.up_world
        cosine = up @ mean / np.linalg.norm(up, axis=1) / np.linalg.norm(mean)
        tilt = np.arccos(np.clip(cosine, -1.0, 1.0))
        yield from told(
            tilt > _TILT_RAD, windows.epochs_gps_ns[:-1], np.degrees(tilt),
            "{count} of {of} times gravity points elsewhere than on average, worst by {size:.1f}° from {at}: matching "
            "bends the way, or the accelerometers err; the way was turned to gravity.",
        )  # fmt: skip
