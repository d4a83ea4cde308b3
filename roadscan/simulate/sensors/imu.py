"""Simulates inertial measurement units: gyroscopes and accelerometers on the moving vehicle, as a CSV log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.imu import IMU_GRADES, STANDARD_GRAVITY_M_PER_S2, ImuErrors
from roadscan.simulate.drive import Drive
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.scene import Mount, Scene
from roadscan.simulate.sensors.clock import SensorClock

CHUNK: Final = 16_384  # samples of a chunk
AT_BODY: Final = Mount(lever_arm_body_m=(0.0, 0.0, 0.0))
"""An IMU at the IMU reference point, axes forward, right, down."""
_STENCIL_S: Final = 0.010
"""Approximate step (s) of differences of motion: with a shorter one, the rounding of ECEF positions shows."""
COLUMNS: Final = (
    "time_ns",
    *(f"angular_rate_{a}_rad_per_s" for a in "xyz"),
    *(f"specific_force_{a}_m_per_s2" for a in "xyz"),
)


@dataclass(frozen=True)
class ImuOnRig:
    """One IMU: its mounting and its errors."""

    name: str
    mount: Mount
    errors: ImuErrors
    rate_hz: float

    @property
    def step_ns(self) -> int:
        """Time from sample to sample (ns)."""
        return round(NS_PER_S / self.rate_hz)

    @property
    def stride(self) -> int:
        """Samples on each side over which motion is differentiated."""
        return max(1, round(_STENCIL_S * self.rate_hz))


def first_gps_ns(drive: Drive, imu: ImuOnRig) -> int:
    """Return the epoch of the first sample of a pass."""
    return drive.recorded_span_gps_ns[0] + 2 * imu.stride * imu.step_ns


def imu_of(scene: Scene) -> ImuOnRig:
    """Return the vehicle's IMU."""
    return ImuOnRig("imu", AT_BODY, scene.imu.errors or IMU_GRADES[scene.imu.grade], scene.imu.rate_hz)


def head_imus(scene: Scene) -> list[ImuOnRig]:
    """Return the IMUs inside the profiler heads, with the heads' mountings; none where they have none."""
    grade = scene.profilers.head_imus
    if grade is None or not scene.profilers.on:
        return []
    heads = {"profiler_left_imu": scene.profilers.left, "profiler_right_imu": scene.profilers.right}
    return [ImuOnRig(name, mount, IMU_GRADES[grade], scene.imu.rate_hz) for name, mount in heads.items()]


def write_imu(scene: Scene, drive: Drive, imu: ImuOnRig, clock: SensorClock, file: Path) -> Iterator[int]:
    """Write the samples of one pass, a chunk a step; yields the samples of each."""
    schema = pa.schema([(c, pa.int64() if c == "time_ns" else pa.float64()) for c in COLUMNS])
    options = pa_csv.WriteOptions(quoting_style="none")
    with pa_csv.CSVWriter(file, schema, write_options=options) as writer:
        for epochs, rate, force in samples(scene, drive, imu):
            columns = [clock.stamps_ns(epochs), *np.round(rate, 9).T, *np.round(force, 8).T]
            writer.write_batch(pa.RecordBatch.from_arrays([pa.array(c) for c in columns], schema=schema))
            yield epochs.size


def samples(scene: Scene, drive: Drive, imu: ImuOnRig) -> Iterator[tuple[Int64, Float64, Float64]]:
    """Yield epochs (n,), angular rates (n, 3; rad/s) and specific forces (n, 3; m/s²) of one pass, a chunk a step."""
    step, stride = imu.step_ns, imu.stride
    begins, last = first_gps_ns(drive, imu), drive.recorded_span_gps_ns[1] - 2 * stride * step
    errors = _SensorErrors(
        imu, stream(scene.seed, drive.number, imu.name), stream(scene.seed, drive.number, f"{imu.name} bias")
    )
    for begin in range(begins, last + 1, step * CHUNK):
        epochs = np.arange(begin, min(begin + step * CHUNK, last + 1), step)
        yield epochs, *errors.applied(*felt(drive, imu.mount, epochs, step, stride))


def felt(drive: Drive, mount: Mount, epochs: Int64, step_ns: int, stride: int = 2) -> tuple[Float64, Float64]:
    """Return angular rate (rad/s) and specific force (m/s²) in sensor axes, (n, 3) each, at even epochs (n,).

    Derivatives are central differences of fourth order over `stride` epochs. In ECEF, with the Earth's rate ω:
    rate = rate of the body + ω; force = acceleration + 2 ω × velocity + force at rest (Groves 2013, eq. 5.36).
    """
    around = np.arange(epochs[0] - 2 * stride * step_ns, epochs[-1] + 2 * stride * step_ns + 1, step_ns)
    poses = drive.poses(around)
    origin, matrix = poses.sensor(mount, np.eye(3))
    h = stride * step_ns / NS_PER_S
    x = [origin[stride * i : origin.shape[0] - stride * (4 - i)] for i in range(5)]
    turn = [Rotation.from_matrix(matrix[stride * i : matrix.shape[0] - stride * (4 - i)]) for i in range(5)]
    velocity = (8 * (x[3] - x[1]) - (x[4] - x[0])) / (12 * h)
    acceleration = (16 * (x[3] + x[1] - 2 * x[2]) - (x[4] + x[0] - 2 * x[2])) / (12 * h * h)
    away = [(turn[2].inv() * turn[i]).as_rotvec() for i in (0, 1, 3, 4)]
    rate = (8 * (away[2] - away[1]) - (away[3] - away[0])) / (12 * h)
    earth_rate = drive.earth.rotation_ecef_rad_per_s
    force = acceleration + 2 * np.cross(earth_rate, velocity) + drive.earth.specific_force_at_rest(x[2])
    to_sensor = turn[2].inv()
    return rate + to_sensor.apply(earth_rate), to_sensor.apply(force)


class _SensorErrors:
    """Scale, drifting bias and noise on six axes, continued from chunk to chunk: two streams, so that chunks change
    nothing.
    """

    def __init__(self, imu: ImuOnRig, rng: np.random.Generator, bias_rng: np.random.Generator) -> None:
        e = imu.errors
        gyro_bias = np.radians(e.gyro_bias_deg_per_h) / 3600.0
        accel_bias = e.accel_bias_mg * 1e-3 * STANDARD_GRAVITY_M_PER_S2
        self._scale = 1.0 + rng.standard_normal(6) * np.repeat([e.gyro_scale_ppm, e.accel_scale_ppm], 3) * 1e-6
        gyro_noise = np.radians(e.gyro_noise_deg_per_sqrt_h) / 60.0 * np.sqrt(imu.rate_hz)
        accel_noise = e.accel_noise_ug_per_sqrt_hz * 1e-6 * STANDARD_GRAVITY_M_PER_S2 * np.sqrt(imu.rate_hz)
        self._noise = np.repeat([gyro_noise, accel_noise], 3)
        self._rng = rng
        self._bias = GaussMarkov(
            bias_rng, np.repeat([gyro_bias, accel_bias], 3), e.bias_time_constant_s, 1.0 / imu.rate_hz
        )

    def applied(self, rate: Float64, force: Float64) -> tuple[Float64, Float64]:
        """Return rates and forces (n, 3) with the sensor's errors."""
        true = np.concatenate([rate, force], axis=1)
        noise = self._noise * self._rng.standard_normal(true.shape)
        stated = true * self._scale + self._bias.take(len(true)) + noise
        return stated[:, :3], stated[:, 3:]
