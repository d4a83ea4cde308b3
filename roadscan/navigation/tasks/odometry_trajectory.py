"""Makes the trajectory of a run from the sweeps of its lidar: load, match, level, check, yield rows."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.crs import LOCAL_WORLD
from roadscan.core.errors import NavigationError
from roadscan.core.extras import is_installed
from roadscan.core.frames import quaternion_from_rotation
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.grid import of_run
from roadscan.core.rig import IMU_GRADES, STANDARD_GRAVITY_M_PER_S2, Sensor
from roadscan.core.settings.navigation import OdometryConfig
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.ingest.clock_correction import ClockCorrection
from roadscan.navigation.inertial.readings import ImuReadings
from roadscan.navigation.odometry import (
    FEWEST_POINTS,
    LEAST_HELD,
    LIBRARY,
    STANDING_SIGMA_DEG,
    WINDOW_S,
    Matched,
    Sweep,
    Way,
    Windows,
    levelled,
    match,
    sigmas,
    sweeps_of,
    tilt_sigma_rad,
    unbent,
    way_of,
    windows_of,
)
from roadscan.navigation.tasks.navigation_logs import chosen, imu_readings, sensor_of
from roadscan.navigation.tasks.solve_trajectory import Computed, on_time, sigma_figures, trajectory_rows
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.store.logs import NAVIGATION, LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

ODOMETRY: Final = "odometry"
"""Format of the records of these trajectories."""
LOCAL_MAP: Final = "local map: it has no position on Earth, and its errors grow with the way"
_LONGEST_SWEEP_S: Final = 1.0  # of a head that turns once a second
_LEAST_SHARE: Final = 0.5  # of poses that surfaces hold along all directions; with fewer, the map would be a guess
_COLUMNS: Final = ["pose_epoch_gps_ns", "x_sensor_m", "y_sensor_m", "z_sensor_m", "sweep"]


@dataclass(frozen=True)
class PlannedOdometry:
    """A trajectory to make from a lidar's sweeps."""

    survey: Survey
    store: Store
    config: OdometryConfig
    lidar: tuple[LogRecord, ...]
    imu: tuple[LogRecord, ...]
    clocks: tuple[tuple[str, ClockCorrection], ...]
    """Estimated corrections of the sensors' clocks."""
    key: str
    format: str = ODOMETRY

    @property
    def run(self) -> str:
        """Run it belongs to."""
        return self.lidar[0].run

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Match the sweeps.

        Raises
        ------
        RoadscanError
            where the library is not installed, or the log has no sweeps to match.
        """
        config, sensor = self.config, _mounted(self.survey, self.lidar[0], "lidar")
        far_m = min(config.range_max_m, sensor.range_max_m)
        matched = match(sweeps_of(self._pieces()), config, sensor.range_min_m, far_m)
        if matched.epochs_gps_ns.size < 3:
            raise NavigationError(
                f"fewer than three sweeps of the lidar '{self.lidar[0].sensor}' could be matched",
                expected="sweeps of a moving rig, numbered by the log, each with points all around",
                change="check the range limits of the sensor, and voxel_m of [navigation.odometry]",
                file=self.lidar[0].path,
            )
        if matched.is_held.mean() < _LEAST_SHARE:
            raise NavigationError(
                f"what the lidar '{self.lidar[0].sensor}' sees tells nothing of the way along the road, for "
                f"{1 - matched.is_held.mean():.0%} of the sweeps",
                expected="houses, trees, poles or cars around: odometry of a lidar cannot do without them",
                change="add a log of GNSS, or a trajectory, to the run",
                file=self.lidar[0].path,
            )
        way = way_of(matched.epochs_gps_ns, matched.first_from_lidar, *sensor.mounting().arrays())
        way, windows, tilt_rad = self._level(way, matched.is_held)
        subject = f"trajectory of run '{self.run}'"
        found = list(findings(subject, way, matched, windows, config, self.survey.config.navigation.max_gap_s))
        for one in found:
            report(f"doubtful: {one.line}")
        sigma_m, sigma_rad = sigmas(way, matched.is_held, config, tilt_rad, is_unbent=windows is not None)
        rows = trajectory_rows(
            way.epochs_gps_ns, way.position_m, quaternion_from_rotation(way.world_from_body), sigma_m, sigma_rad
        )
        attributes = {
            "world_frame": LOCAL_WORLD,
            "logs": [r.key for r in (*self.lidar, *self.imu)],
            "path_m": float(way.path_m[-1]),
            "sigma_tilt_deg": float(np.degrees(tilt_rad)),
            "sweeps_left_out": int(matched.thin_gps_ns.size),
            "least_held": float(matched.held.min(initial=1.0)),
            "findings": [asdict(one) for one in found],
            **sigma_figures(sigma_m),
        }
        return Computed(rows, attributes)

    def _level(self, way: Way, is_held: npt.NDArray[np.bool_]) -> tuple[Way, Windows | None, float]:
        """Return the way with z upwards, what the IMU measured along it, and 1 σ (rad) of its tilt."""
        standing = np.radians(STANDING_SIGMA_DEG)
        if not self.imu:
            return way, None, standing
        readings: ImuReadings = on_time(imu_readings(self.store, self.imu), dict(self.clocks).get(self.imu[0].sensor))
        sensor = _mounted(self.survey, self.imu[0], "imu")
        turn, _ = sensor.mounting().arrays()
        samples = (
            readings.epochs_gps_ns,
            readings.specific_force_m_per_s2 @ turn.T,
            readings.angular_rate_rad_per_s @ turn.T,
        )
        windows = windows_of(way, *samples)
        if windows is None:
            return way, None, standing
        way = levelled(way, windows)
        windows = windows_of(way, *samples) or windows
        return unbent(way, windows, is_held), windows, tilt_sigma_rad(sensor.imu_errors() or IMU_GRADES["mems"])

    def _pieces(self) -> Iterator[tuple[tuple[str, int], Sweep]]:
        """Yield pieces of sweeps in order of time, a row group at a time."""
        clock = dict(self.clocks).get(self.lidar[0].sensor)
        for record in sorted(self.lidar, key=lambda r: r.span("returns") or (0, 0)):
            begun: dict[int, int] = {}
            for file in sorted(record.tables["returns"], key=lambda f: f.span or (0, 0)):
                for group in range(len(file.group_rows)):
                    rows = read_groups(self.store, file.path, [group], _COLUMNS)
                    epochs, *xyz, numbers = (rows.column(name).to_numpy() for name in _COLUMNS)
                    epochs = epochs if clock is None else clock.applied(epochs)
                    points = np.stack(xyz, axis=-1)
                    for number in np.unique(numbers).tolist():
                        own = numbers == number
                        _check_length(begun.setdefault(number, int(epochs[own].min())), int(epochs[own].max()), record)
                        yield (record.key, number), Sweep(points[own], epochs[own])


def _check_length(first: int, last: int, record: LogRecord) -> None:
    if last - first > _LONGEST_SWEEP_S * NS_PER_S:
        raise NavigationError(
            f"a sweep of the lidar '{record.sensor}' lasts longer than {_LONGEST_SWEEP_S:g} s",
            expected="a log that numbers the turns of its head",
            change="a trajectory cannot be made from this log: add one to the run",
            file=record.path,
        )


def plan_odometry(
    survey: Survey, store: Store, records: Sequence[LogRecord], runs: Sequence[str]
) -> list[PlannedOdometry]:
    """Return trajectories of those of `runs` that have none and sweeps of a lidar, where the survey file asks for them.

    Raises
    ------
    ConfigError
        where it is not clear which sensors are meant.
    """
    config = survey.config.navigation.odometry
    if config is None:
        return []
    clocks, code = load_clocks(store), code_digest(name_of(PlannedOdometry))
    found: list[PlannedOdometry] = []
    for run in runs:
        if any(r.run == run and r.tables.get("trajectory") and r.sensor != NAVIGATION for r in records):
            continue
        lidar = chosen(records, run, "returns", config.lidar, "[navigation.odometry] lidar")
        imu = chosen(records, run, "imu", config.imu, "[navigation.odometry] imu")
        if not lidar:
            continue
        sensors = sorted({r.sensor for r in (*lidar, *imu)})
        own = tuple((s, c) for s in sensors if (c := of_run(clocks, run, s)) is not None)
        rig = {s: survey.rig.sensors[s].model_dump(mode="json") for s in sensors if s in survey.rig.sensors}
        version = importlib.metadata.version("kiss-icp") if is_installed(LIBRARY) else ""
        key = key_of(
            ODOMETRY, code, version, run, [r.key for r in (*lidar, *imu)], rig, own,
            config.model_dump(mode="json"), survey.config.navigation.max_gap_s,
        )  # fmt: skip
        found.append(PlannedOdometry(survey, store, config, lidar, imu, own, key))
    return found


def _mounted(survey: Survey, log: LogRecord, kind: str) -> Sensor:
    """Return the sensor of a log with the mounting that the log states, where the rig file states none."""
    return sensor_of(survey.rig, log, kind).mounted_as(log.attributes.get("mounting", {}))


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
    """Yield a finding for each kind of contradiction: how often it occurs, and when it is worst."""

    def told(bad: Bool, at: Int64, size: Float64, words: str, left_out: int = 0) -> Iterator[Finding]:
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
