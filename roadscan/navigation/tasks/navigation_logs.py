"""Converts tables of a run's GNSS, IMU and odometer into the smoother's input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, NavigationError
from roadscan.core.rig import Rig, Sensor
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors
from roadscan.store.logs import LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

ANTENNA_SIGMA_M = 0.01
"""1 σ of an antenna's lever arm where the rig file states none: that of a tape measure."""


NO_SENSOR = "none"
"""Stands for no sensor: a kind that is not to be used in navigation."""


@dataclass(frozen=True)
class RunLogs:
    """Logs of one run from which its trajectory is computed."""

    run: str
    imu: tuple[LogRecord, ...]
    gnss: tuple[LogRecord, ...]
    encoder: tuple[LogRecord, ...]

    @property
    def records(self) -> tuple[LogRecord, ...]:
        """All of them."""
        return (*self.imu, *self.gnss, *self.encoder)


def chosen(
    records: Sequence[LogRecord], run: str, table: str, stated: str | None, setting: str
) -> tuple[LogRecord, ...]:
    """Return logs of one sensor of a run with rows in `table`: the stated sensor's, or those of the only one.

    setting : that states it, with its section, such as ``[navigation.smoother] imu``.

    Raises
    ------
    ConfigError
        where several sensors could be meant and none is stated.
    """
    own = [r for r in records if r.run == run and r.tables.get(table)]
    names = sorted({r.sensor for r in own})
    if stated == NO_SENSOR:
        return ()
    if stated is not None:
        return tuple(r for r in own if r.sensor == stated)
    if len(names) > 1:
        raise ConfigError(
            f"run '{run}' has logs of {len(names)} sensors in the table {table}: {', '.join(names)}",
            expected="to know which of them navigates",
            change=f'state {setting} = "{names[0]}" (or another)',
        )
    return tuple(own)


def imu_readings(store: Store, records: Sequence[LogRecord]) -> ImuReadings:
    """Return samples of an IMU, in the order of the store."""
    rows = _rows(store, records, "imu")
    return ImuReadings(
        rows["epoch_gps_ns"],
        np.stack([rows[f"angular_rate_{a}_rad_per_s"] for a in "xyz"], axis=-1),
        np.stack([rows[f"specific_force_{a}_m_per_s2"] for a in "xyz"], axis=-1),
    )


def gnss_solutions(store: Store, records: Sequence[LogRecord]) -> GnssSolutions:
    """Return solutions of a receiver; those without a position are left out.

    Raises
    ------
    NavigationError
        where the logs lie in different world frames.
    """
    worlds = {str(r.attributes["world_frame"]) for r in records}
    if len(worlds) != 1:
        raise NavigationError(
            f"the GNSS logs lie in different world frames: {', '.join(sorted(worlds))}", expected="one datum"
        )
    rows = _rows(store, records, "gnss")
    located = np.isfinite(rows["x_world_m"])
    rows = {name: column[located] for name, column in rows.items()}
    north, east, down = (rows[f"sigma_{a}_m"].astype(np.float64) for a in ("north", "east", "down"))
    covariance = np.empty((north.size, 3, 3))
    for i, sigma in enumerate((north, east, down)):
        covariance[:, i, i] = sigma**2
    for (i, j), name in zip(((0, 1), (0, 2), (1, 2)), ("ne", "nd", "ed"), strict=True):
        covariance[:, i, j] = covariance[:, j, i] = np.nan_to_num(rows[f"covariance_{name}_m2"])
    velocity = [rows[f"velocity_{a}_m_per_s"] for a in ("north", "east", "down")]
    sigma_velocity = [rows[f"sigma_velocity_{a}_m_per_s"].astype(np.float64) for a in ("north", "east", "down")]
    return GnssSolutions(
        worlds.pop(),
        rows["epoch_gps_ns"],
        np.stack([rows[f"{a}_world_m"] for a in "xyz"], axis=-1),
        covariance,
        rows["quality"].astype(np.str_),
        np.stack(velocity, axis=-1),
        np.stack(sigma_velocity, axis=-1),
    )


def odometer_readings(store: Store, records: Sequence[LogRecord], sensor: Sensor | None) -> OdometerReadings | None:
    """Distance driven: ticks times the rig's length of a tick, or the log's distance or speed; wheels averaged.

    Raises
    ------
    ConfigError
        where the log counts ticks and the rig does not say how long one is.
    """
    if not records:
        return None
    rows = _rows(store, records, "encoder")
    if np.isfinite(rows["distance_m"]).any():
        distance = rows["distance_m"]
    elif np.isfinite(rows["ticks"]).any():
        if sensor is None or sensor.metres_per_tick is None:
            raise unknown_way(records[0].path)
        distance = rows["ticks"] * sensor.metres_per_tick
    else:
        distance = np.full(rows["epoch_gps_ns"].size, np.nan)
    return _mean_wheel(rows["epoch_gps_ns"], rows["wheel"], distance, rows["speed_m_per_s"])


def vehicle_sensors(rig: Rig, logs: RunLogs) -> VehicleSensors:
    """Return the mounting of the sensors of a run's logs.

    Raises
    ------
    ConfigError
        where the rig file does not say where antenna or IMU are, or how good the IMU is.
    """
    imu, gnss = sensor_of(rig, logs.imu[0], "imu"), sensor_of(rig, logs.gnss[0], "gnss")
    errors = imu.imu_errors()
    if errors is None:
        raise unknown_imu(logs.imu[0].sensor)
    rotation, lever = imu.mounting().arrays()
    sigma = gnss.lever_arm_sigma_m or (ANTENNA_SIGMA_M,) * 3
    wheel = rig.sensors.get(logs.encoder[0].sensor) if logs.encoder else None
    return VehicleSensors(
        body_from_imu=rotation,
        imu_lever_arm_body_m=lever,
        imu_errors=errors,
        antenna_lever_arm_body_m=np.array(gnss.lever_arm_body_m),
        antenna_sigma_body_m=np.array(sigma),
        wheel_lever_arm_body_m=None if wheel is None else np.array(wheel.lever_arm_body_m),
    )


def unknown_imu(name: str) -> ConfigError:
    """Return the error of a rig file that does not say how good the IMU of a trajectory is."""
    return ConfigError(
        f"the rig file does not say how good the IMU '{name}' is",
        expected="its errors",
        change='add imu = "mems" (or "tactical", "industrial", "navigation", or a table of its data sheet)',
    )


def unknown_way(path: str) -> ConfigError:
    """Return the error of an encoder log that only counts ticks, where the rig does not say how long one is."""
    return ConfigError(
        f"the encoder log '{path}' counts ticks, and the way of one is not known",
        expected="metres_per_tick of its sensor in the rig file",
    )


def sensor_of(rig: Rig, record: LogRecord, kind: str) -> Sensor:
    """Return the sensor of the rig that wrote a log, which has to be of a kind."""
    sensor = rig.sensors.get(record.sensor)
    if sensor is None or sensor.kind != kind:
        raise ConfigError(
            f"log '{record.path}' of run '{record.run}' names no {kind} of the rig (it is '{record.sensor}')",
            expected=f"a sensor of kind {kind} with its lever arm: a trajectory needs to know where it sits",
            change=f'add it to the rig file and sensor = "…" to the log (rig: {", ".join(rig.sensors) or "empty"})',
        )
    return sensor


def _rows(store: Store, records: Sequence[LogRecord], table: str) -> dict[str, npt.NDArray[Any]]:
    """Return columns of all rows, in order of time; nulls of numbers become NaN."""
    files = [f for record in records for f in record.tables.get(table, ())]
    parts = [read_groups(store, f.path, range(len(f.group_rows))) for f in files]
    rows = pa.concat_tables(parts).sort_by("epoch_gps_ns") if parts else None
    if rows is None or rows.num_rows == 0:
        raise NavigationError(f"the table {table} has no rows", file=records[0].path if records else None)
    return {name: rows.column(name).to_numpy() for name in rows.column_names}


def _mean_wheel(
    epochs: npt.NDArray[np.int64], wheel: npt.NDArray[Any], distance: Float64, speed: Float64
) -> OdometerReadings:
    """Return one wheel, or the mean of several at the epochs of the first: the path of the middle between them."""
    names = np.unique(wheel.astype(np.str_))
    wheels = [wheel == name for name in names]
    first = wheels[0]
    if len(wheels) == 1:
        return OdometerReadings(epochs, np.asarray(distance, np.float64), np.asarray(speed, np.float64))
    at = epochs[first]
    inside = np.ones(at.size, bool)
    means = []
    for values in (distance, speed):
        columns = []
        for own in wheels:
            sound = own & np.isfinite(values)
            if not sound.any():
                columns.append(np.full(at.size, np.nan))
                continue
            since = (epochs[sound] - at[0]).astype(np.float64)
            columns.append(np.interp((at - at[0]).astype(np.float64), since, values[sound]))
            inside &= (at >= epochs[sound][0]) & (at <= epochs[sound][-1])
        means.append(np.mean(columns, axis=0))
    return OdometerReadings(at[inside], means[0][inside], means[1][inside])
