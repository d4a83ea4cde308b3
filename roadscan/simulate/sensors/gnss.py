"""Simulates a GNSS receiver with real-time kinematic corrections: its solutions as RTKLIB ``.pos`` and NMEA 0183."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, utc_from_gps_ns
from roadscan.core.rig import IMU_GRADES, STANDARD_GRAVITY_M_PER_S2, ImuErrors
from roadscan.simulate.drive import Drive
from roadscan.simulate.noise import GaussMarkov, stream
from roadscan.simulate.scene import Mount, MountError, Scene
from roadscan.simulate.sensors.clock import SensorClock

FIXED: Final = 1  # quality of a fixed solution, as RTKLIB numbers it
FLOAT: Final = 2
"""Quality of a float solution, as RTKLIB numbers it."""
RECEIVER_UNDULATION_M: Final = 46.9
"""Geoid height of the receiver's coarse model, which is constant here (NMEA GGA; m)."""
_SATELLITES: Final = 14  # number of satellites in the logs
_DIFFERENCE_NS: Final = 10_000_000  # step of the velocity's differences
_VELOCITY_SIGMA_M_PER_S: Final = 0.03  # error of each velocity component
_KNOTS_PER_M_PER_S: Final = 3600.0 / 1852.0  # knots in a metre per second
_SHORTEST_JUMP_S, _LONGEST_JUMP_S = 1.0, 5.0  # duration of multipath jumps


@dataclass(frozen=True)
class Solutions:
    """n solutions of a pass; gaps are left out."""

    epoch_gps_ns: Int64
    geographic: Float64
    """(n, 3) longitude, latitude (degrees), ellipsoidal height (m) of the antenna, with errors."""
    velocity_ned_m_per_s: Float64
    """(n, 3)"""
    quality: Int64
    """(n,) :data:`FIXED` or :data:`FLOAT`."""
    sigma_ned_m: Float64
    """(n, 3) as the receiver states them; of a multipath jump it knows nothing."""


def antenna_mount(scene: Scene) -> Mount:
    """Return the antenna's mounting."""
    error = MountError(lever_arm_body_m=scene.gnss.lever_arm_error_m)
    return Mount(lever_arm_body_m=scene.gnss.lever_arm_body_m, error=error)


def solve(scene: Scene, drive: Drive) -> Solutions:
    """Return the solutions of a whole pass at the antenna, in the datum of the scene's CRS."""
    gnss = scene.gnss
    step = round(NS_PER_S / gnss.rate_hz)
    first, last = drive.recorded_span_gps_ns
    epochs = np.arange(-(-(first + _DIFFERENCE_NS) // step) * step, last - _DIFFERENCE_NS + 1, step)
    rng = stream(scene.seed, drive.number, "gnss")
    quality = _quality(scene, drive, epochs)
    sigma = np.array([gnss.sigma_horizontal_m, gnss.sigma_horizontal_m, gnss.sigma_vertical_m])
    slow = GaussMarkov(rng, sigma * math.sqrt(0.5), gnss.time_constant_s, 1.0 / gnss.rate_hz).take(epochs.size)
    error = slow + sigma * math.sqrt(0.5) * rng.standard_normal((epochs.size, 3))
    adrift = GaussMarkov(rng, np.full(3, gnss.float_sigma_m), gnss.time_constant_s, 1.0 / gnss.rate_hz)
    error += adrift.take(epochs.size) * (quality == FLOAT)[:, None]
    jumps = _jumps(scene, epochs, rng)
    mount = antenna_mount(scene)
    before, here, after = (
        drive.poses(epochs + shift).sensor(mount, np.eye(3))[0] for shift in (-_DIFFERENCE_NS, 0, _DIFFERENCE_NS)
    )
    level = drive.earth.ecef_from_level(here)
    velocity = level.inv().apply((after - before) / (2e-9 * _DIFFERENCE_NS))
    velocity += _VELOCITY_SIGMA_M_PER_S * rng.standard_normal(velocity.shape) * (gnss.sigma_horizontal_m > 0.0)
    stated_sigma = np.where((quality == FLOAT)[:, None], np.hypot(sigma, gnss.float_sigma_m), sigma)
    seen = quality > 0
    return Solutions(
        epochs[seen],
        drive.earth.geographic_from_ecef(here + level.apply(error + jumps))[seen],
        velocity[seen],
        quality[seen],
        np.maximum(stated_sigma, 0.001)[seen],
    )


def write_pos(solutions: Solutions, file: Path) -> Iterator[int]:
    """Write RTKLIB's text: GPST, degrees, ellipsoidal height; yields the number of solutions."""
    names = "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
    header = [
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
        f"%  GPST {names} vn(m/s) ve(m/s) vu(m/s)",
    ]
    with file.open("w", encoding="ascii", newline="\n") as out:
        out.writelines(f"{line}\n" for line in header)
        for i in range(solutions.epoch_gps_ns.size):
            lon, lat, height = solutions.geographic[i]
            north, east, down = solutions.velocity_ned_m_per_s[i]
            sigma_n, sigma_e, sigma_d = solutions.sigma_ned_m[i]
            fixed = solutions.quality[i] == FIXED
            out.write(
                f"{_calendar(int(solutions.epoch_gps_ns[i]))} {lat:14.10f} {lon:15.10f} {height:11.5f} "
                f"{solutions.quality[i]:3d} {_SATELLITES:3d} {sigma_n:8.4f} {sigma_e:8.4f} {sigma_d:8.4f} "
                f"{0.0:8.4f} {0.0:8.4f} {0.0:8.4f} {0.8:6.2f} {30.0 if fixed else 1.6:6.1f} "
                f"{north:10.5f} {east:10.5f} {-down:10.5f}\n"
            )
    yield solutions.epoch_gps_ns.size


def write_nmea(solutions: Solutions, file: Path) -> Iterator[int]:
    """Write GGA, RMC, VTG and GST sentences of each solution, in UTC; yields the number of solutions."""
    with file.open("w", encoding="ascii", newline="") as out:
        for i in range(solutions.epoch_gps_ns.size):
            out.writelines(f"${body}*{_checksum(body):02X}\r\n" for body in _sentences(solutions, i))
    yield solutions.epoch_gps_ns.size


def _sentences(solutions: Solutions, i: int) -> list[str]:
    epoch = int(solutions.epoch_gps_ns[i])
    utc = utc_from_gps_ns(epoch + 5_000_000)  # hundredths of a second are written, rounded
    time = f"{utc:%H%M%S}.{utc.microsecond // 10_000:02d}"
    lon, lat, height = solutions.geographic[i]
    place = (
        f"{_degrees_minutes(lat, 2)},{'N' if lat >= 0 else 'S'},{_degrees_minutes(lon, 3)},{'E' if lon >= 0 else 'W'}"
    )
    north, east, _ = solutions.velocity_ned_m_per_s[i]
    course = math.degrees(math.atan2(east, north)) % 360.0
    speed = math.hypot(north, east)
    knots = speed * _KNOTS_PER_M_PER_S
    sigma_n, sigma_e, sigma_d = solutions.sigma_ned_m[i]
    fix = 4 if solutions.quality[i] == FIXED else 5
    above = height - RECEIVER_UNDULATION_M
    return [
        f"GNGGA,{time},{place},{fix},{_SATELLITES},0.8,{above:.4f},M,{RECEIVER_UNDULATION_M:.4f},M,0.8,0000",
        f"GNRMC,{time},A,{place},{knots:.4f},{course:.3f},{utc:%d%m%y},,,R",
        f"GNVTG,{course:.3f},T,,M,{knots:.4f},N,{speed * 3.6:.4f},K,R",
        f"GNGST,{time},{sigma_n:.4f},{max(sigma_n, sigma_e):.4f},{min(sigma_n, sigma_e):.4f},0.0,"
        f"{sigma_n:.4f},{sigma_e:.4f},{sigma_d:.4f}",
    ]


def _quality(scene: Scene, drive: Drive, epochs: Int64) -> Int64:
    """Return the quality of the solution at each epoch (n,), 0 in a gap."""
    quality = np.full(epochs.size, FIXED, dtype=np.int64)
    seconds = (epochs - drive.start_gps_ns) / NS_PER_S
    gaps = [g for g in scene.gnss.gaps if not g.passes or drive.number + 1 in g.passes]
    for gap in gaps:
        end = gap.start_s + gap.duration_s
        quality[(seconds >= end) & (seconds < end + scene.gnss.float_after_gap_s)] = FLOAT
    for gap in gaps:
        quality[(seconds >= gap.start_s) & (seconds < gap.start_s + gap.duration_s)] = 0
    return quality


def _jumps(scene: Scene, epochs: Int64, rng: np.random.Generator) -> Float64:
    """Return multipath errors (n, 3), north-east-down (m)."""
    out = np.zeros((epochs.size, 3))
    if not epochs.size:
        return out
    seconds = (epochs - epochs[0]) / NS_PER_S
    count = rng.poisson(scene.gnss.jumps_per_minute * float(seconds[-1]) / 60.0)
    for start in np.sort(rng.uniform(0.0, float(seconds[-1]), count)):
        end = start + rng.uniform(_SHORTEST_JUMP_S, _LONGEST_JUMP_S)
        out[(seconds >= start) & (seconds < end)] = scene.gnss.jump_m * rng.standard_normal(3)
    return out


def _calendar(epoch_gps_ns: int) -> str:
    """Return ``2026/05/04 09:30:18.000``: GPS time as a calendar without leap seconds."""
    milliseconds = (epoch_gps_ns + 500_000) // 1_000_000 + GPS_EPOCH_UNIX_S * 1000
    moment = np.datetime64(milliseconds, "ms").item()
    return f"{moment:%Y/%m/%d %H:%M:%S}.{milliseconds % 1000:03d}"


def _degrees_minutes(degrees: float, digits: int) -> str:
    """Return ``4806.1234567``: whole degrees of `digits` figures and minutes."""
    whole, rest = divmod(round(abs(degrees) * 60 * 10**8), 60 * 10**8)
    return f"{whole:0{digits}d}{rest // 10**8:02d}.{rest % 10**8:08d}"


def _checksum(body: str) -> int:
    return functools.reduce(operator.xor, body.encode("ascii"), 0)


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
