"""The recorded drive (``data/drive``) as the smoother takes it: a car, MEMS IMU at 100 Hz, RTK at 4 Hz, 549 s."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from roadscan.core.crs import world_from_geodetic
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S
from roadscan.core.rig import ImuErrors
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors

WORLD = "EPSG:4978"
Logs = tuple[ImuReadings, GnssSolutions, OdometerReadings | None, VehicleSensors]


@cache
def recorded_drive(folder: Path) -> Logs:
    """Logs on GPS time, and the rig of the recording's own configuration."""
    imu = pd.read_csv(folder / "drive" / "imu.csv.gz")
    gnss = pd.read_csv(folder / "drive" / "gnss_rtk.pos.gz", sep=r"\s+", skiprows=1, header=None)
    late_s = 0.125
    epochs = np.round((imu["gpst_unix_s"].to_numpy() - late_s - GPS_EPOCH_UNIX_S) * 1e4).astype(np.int64) * 100_000
    force, rate = imu.iloc[:, 1:4].to_numpy() * 9.80665, np.radians(imu.iloc[:, 4:7].to_numpy())
    stamps = pd.to_datetime(gnss[0] + " " + gnss[1]).astype("datetime64[ns]").astype("int64").to_numpy()
    solutions = GnssSolutions(
        WORLD,
        stamps - GPS_EPOCH_UNIX_S * NS_PER_S,
        world_from_geodetic(WORLD, gnss[[3, 2, 4]].to_numpy()),
        np.einsum("ni,ij->nij", gnss[[7, 8, 9]].to_numpy() ** 2, np.eye(3)),
        np.where(gnss[5] == 1, "fixed", "float"),
        gnss[[15, 16, 17]].to_numpy() * [1, 1, -1],
        gnss[[18, 19, 20]].to_numpy(),
    )
    # The recording's own configuration names the angles from the body's axes to the IMU's.
    body_from_imu = Rotation.from_euler("ZYX", [185.35, -6.79, 180.0], degrees=True).as_matrix().T
    errors = ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.23, gyro_bias_deg_per_h=300.0, gyro_scale_ppm=3000.0,
        accel_noise_ug_per_sqrt_hz=70.0, accel_bias_mg=20.0, accel_scale_ppm=3000.0,
    )  # fmt: skip
    vehicle = VehicleSensors(body_from_imu, np.zeros(3), errors, np.array([0.0, -0.05, 0.0]), np.full(3, 0.01))
    return ImuReadings(epochs, rate, force), solutions, None, vehicle
