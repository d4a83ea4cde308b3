"""The rig (``RIG.toml``): sensors, the geometry of their readings and beams, and how they are mounted."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from roadscan.core.frames import BODY_FROM_AXES, body_from_axes, rotation_from_rph
from roadscan.core.strict import Strict, load_toml

Rays = npt.NDArray[np.float64]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


class ScanGeometry(Strict):
    """Geometry of a line scanner's readings: reading i lies at origin_i + range · direction_i.

    The profile lies in the sensor's y-z plane; z points along the range of the middle reading
    (down to the road for a scanner that looks down), y to the right where the sensor is mounted
    without misalignment in axes ``frd``.
    """

    kind: Literal["cartesian", "polar"]
    """cartesian: reading i is measured along z at transverse position y_i (laser triangulation);
    polar: along a beam at angle a_i from z towards y (rotating mirror)."""
    readings: int = Field(gt=0)
    """Readings a profile."""
    first: float
    """y of the first reading (m), or angle of the first beam (rad)."""
    step: float
    """Step from reading to reading (m, or rad)."""
    range_offset_m: float = 0.0
    """Range of the raw value 0, if it were valid (m)."""
    range_step_m: float = Field(gt=0)
    """Range of one raw unit (m)."""
    reading_period_ns: float = Field(default=0.0, ge=0.0)
    """Time from one reading to the next (ns); 0 where all readings of a profile are simultaneous."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.step == 0.0 and self.readings > 1:
            raise ValueError("step is 0: all readings would lie on one line")
        return self

    def rays(self) -> tuple[Rays, Rays]:
        """Return origins (n, 3) in metres and unit directions (n, 3) of the readings, in the sensor frame."""
        where = self.first + self.step * np.arange(self.readings)
        zero, one = np.zeros_like(where), np.ones_like(where)
        if self.kind == "cartesian":
            return np.stack([zero, where, zero], axis=-1), np.stack([zero, zero, one], axis=-1)
        return np.zeros((self.readings, 3)), np.stack([zero, np.sin(where), np.cos(where)], axis=-1)

    def raw_limits(self, range_min_m: float, range_max_m: float) -> tuple[int, int]:
        """Return the lowest and highest raw value whose range is within the limits (m); (1, 0) where none is."""
        every = self.range_offset_m + self.range_step_m * np.arange(1 << 16)
        kept = 1 + np.flatnonzero((every[1:] >= range_min_m) & (every[1:] <= range_max_m))
        return (int(kept[0]), int(kept[-1])) if kept.size else (1, 0)

    def all_epochs(self, epochs_gps_ns: Int64) -> Int64:
        """Return the epochs (n · m,) of all m readings of n profiles, profile by profile."""
        later_ns = self.reading_epochs(np.zeros(self.readings, np.int64), np.arange(self.readings))
        return (epochs_gps_ns[:, None] + later_ns).reshape(-1)

    def reading_epochs(self, epochs_gps_ns: Int64, reading: npt.NDArray[np.integer[Any]]) -> Int64:
        """Return the epochs (n,) of readings from their numbers in the profile (n,) and their profiles' epochs (n,)."""
        if not self.reading_period_ns:
            return epochs_gps_ns
        later_ns: Int64 = np.floor(reading * self.reading_period_ns + 0.5).astype(np.int64)
        return epochs_gps_ns + later_ns


class Interior(Strict):
    """Interior orientation: a pixel has u = cx + fx · x', v = cy + fy · y', where x', y' are the distorted tangents.

    Tangents are taken in OpenCV's camera axes, x right, y down, z along the optical axis; the sensor frame of the
    rig has x along the optical axis, y right, z down (`axes = "frd"`). In a picture of 360° x' and y' are angles
    (radians): x' to the right around the camera's y axis, from −π to π, and y' downwards from its horizon.
    """

    model: Literal["perspective", "equirectangular"] = "perspective"
    """`perspective`, or `equirectangular` for pictures of 360°, whose columns and rows are even steps of these angles;
    the optical axis is then the direction that the middle column looks to."""
    width_px: int = Field(ge=1)
    """Width of the pictures that this holds for."""
    height_px: int = Field(ge=1)
    """Height of these pictures."""
    focal_px: tuple[float, float]
    """fx, fy (pixels; of a picture of 360° pixels a radian, those of the whole sphere where left out)."""
    principal_px: tuple[float, float]
    """cx, cy, from the centre of the upper left pixel (pixels); may be left out for a picture of 360°: its middle."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    line_time_us: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    """Time from the exposure of a row to that of the row below (µs): of a rolling shutter; 0 of a global one. The stamp
    of a picture is the time of its middle row."""
    sigma_focal_px: tuple[float, float] | None = None
    """1 σ of `focal_px`, from the calibration."""
    sigma_principal_px: tuple[float, float] | None = None
    """1 σ of `principal_px`."""
    sigma_distortion: tuple[float, float, float, float, float] | None = None
    """1 σ of `distortion`."""
    sigma_line_time_us: float | None = Field(default=None, ge=0.0)
    """1 σ of `line_time_us`."""
    rms_px: float | None = Field(default=None, ge=0.0)
    """RMS of the calibration's residuals (pixels)."""
    pictures: int | None = Field(default=None, ge=0)
    """Pictures the calibration used."""
    date: dt.date | None = None
    """Day of the calibration."""

    @model_validator(mode="before")
    @classmethod
    def _of_the_sphere(cls, values: Any) -> Any:
        """Return the values with focal length and principal point filled in from the size of a full-sphere picture."""
        if not isinstance(values, dict) or values.get("model") != "equirectangular":
            return values
        width, height = values.get("width_px"), values.get("height_px")
        if not isinstance(width, int) or not isinstance(height, int):
            return values
        sphere = {
            "focal_px": (width / (2.0 * math.pi), height / math.pi),
            "principal_px": ((width - 1) / 2.0, (height - 1) / 2.0),
        }
        return sphere | values

    @model_validator(mode="after")
    def _has_no_lens(self) -> Interior:
        if self.model == "equirectangular":
            if any(self.distortion):
                raise ValueError("distortion is none of an equirectangular picture: its pixels are angles")
            if self.width_px > 2.0 * math.pi * self.focal_px[0] + 1.0:
                raise ValueError(
                    f"width_px {self.width_px} is more than a turn of 360° with focal_px {self.focal_px[0]:g}"
                )
        return self


STANDARD_GRAVITY_M_PER_S2: Final = 9.80665
"""Size of the unit g (CGPM 1901), and the gravity of local frames."""
ImuGrade = Literal["perfect", "navigation", "tactical", "industrial", "mems"]
"""How good an inertial measurement unit is."""


class ImuErrors(Strict):
    """Errors of an inertial measurement unit, 1 σ; biases change as Gauss–Markov processes."""

    gyro_noise_deg_per_sqrt_h: float = Field(ge=0.0)
    """Angle random walk."""
    gyro_bias_deg_per_h: float = Field(ge=0.0)
    """Bias of each gyroscope."""
    gyro_scale_ppm: float = Field(ge=0.0)
    """Scale error of each gyroscope."""
    accel_noise_ug_per_sqrt_hz: float = Field(ge=0.0)
    """Velocity random walk, as noise density of the accelerometers (µg/√Hz)."""
    accel_bias_mg: float = Field(ge=0.0)
    """Bias of each accelerometer (mg)."""
    accel_scale_ppm: float = Field(ge=0.0)
    """Scale error of each accelerometer."""
    bias_time_constant_s: float = Field(default=600.0, gt=0.0)
    """Time constant of the biases (s)."""


IMU_GRADES: Final[dict[ImuGrade, ImuErrors]] = {
    "perfect": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.0,
        gyro_bias_deg_per_h=0.0,
        gyro_scale_ppm=0.0,
        accel_noise_ug_per_sqrt_hz=0.0,
        accel_bias_mg=0.0,
        accel_scale_ppm=0.0,
    ),
    "navigation": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.002,
        gyro_bias_deg_per_h=0.005,
        gyro_scale_ppm=5.0,
        accel_noise_ug_per_sqrt_hz=10.0,
        accel_bias_mg=0.03,
        accel_scale_ppm=50.0,
        bias_time_constant_s=3600.0,
    ),
    "tactical": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.07,
        gyro_bias_deg_per_h=1.0,
        gyro_scale_ppm=150.0,
        accel_noise_ug_per_sqrt_hz=50.0,
        accel_bias_mg=1.0,
        accel_scale_ppm=300.0,
    ),
    "industrial": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.2,
        gyro_bias_deg_per_h=10.0,
        gyro_scale_ppm=500.0,
        accel_noise_ug_per_sqrt_hz=60.0,
        accel_bias_mg=3.0,
        accel_scale_ppm=1000.0,
    ),
    "mems": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.4,
        gyro_bias_deg_per_h=100.0,
        gyro_scale_ppm=3000.0,
        accel_noise_ug_per_sqrt_hz=150.0,
        accel_bias_mg=10.0,
        accel_scale_ppm=3000.0,
    ),
}
"""Errors by grade, the orders of magnitude of Groves (2013), table 4.1 and 4.2."""


SensorKind = Literal["profiler", "lidar", "camera", "gnss", "imu", "encoder"]


_MOUNTING_KEYS: Final = ("axes", "boresight", "body_from_sensor", "lever_arm_body_m")


@dataclass(frozen=True)
class Mounting:
    """Lever arm and boresight: p_body = body_from_sensor · p_sensor + lever_arm_body_m."""

    lever_arm_body_m: tuple[float, float, float]
    """IMU reference point to sensor origin, body axes (forward, right, down), metres."""
    body_from_sensor: tuple[tuple[float, float, float], ...]
    """(3, 3) rotation, sensor frame to body."""

    def arrays(self) -> tuple[Float64, Float64]:
        """Rotation (3, 3) and lever arm (3,)."""
        return np.array(self.body_from_sensor), np.array(self.lever_arm_body_m)


UNMOUNTED: Final = Mounting((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
"""Mounting of a sensor that measures in body axes at the reference point."""


@dataclass(frozen=True)
class Mountings:
    """Mountings of one sensor, each valid from an epoch on, as after a head was remounted or calibrated again."""

    since_gps_ns: tuple[int, ...]
    """Start epochs, ascending; the first mounting also applies before the first epoch."""
    mountings: tuple[Mounting, ...]

    @classmethod
    def one(cls, mounting: Mounting) -> Self:
        """Return mountings with the same mounting at all times."""
        return cls((0,), (mounting,))

    def longest_lever_m(self) -> float:
        """Return the length of the longest lever arm (m)."""
        return max(math.hypot(*mounting.lever_arm_body_m) for mounting in self.mountings)

    def pieces(self, epochs_gps_ns: npt.NDArray[np.int64]) -> Iterator[tuple[slice, Mounting]]:
        """Yield slices of consecutive readings with one mounting, for epochs (n,) in any order."""
        if len(self.mountings) == 1:
            yield slice(0, epochs_gps_ns.size), self.mountings[0]
            return
        index = np.searchsorted(np.array(self.since_gps_ns[1:]), epochs_gps_ns, side="right")
        ends = [*(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
        start = 0
        for end in ends:
            if end > start:
                yield slice(start, end), self.mountings[int(index[start])]
            start = end


class Boresight(Strict):
    """Small rotation between the sensor's nominal axes and its true ones (degrees, Z-Y-X)."""

    roll_deg: float = 0.0
    """Rotation about body x (forward); positive lowers the right side."""
    pitch_deg: float = 0.0
    """Rotation about body y (right); positive raises the front."""
    heading_deg: float = 0.0
    """Rotation about body z (down); positive turns clockwise seen from above."""


class Sensor(Strict):
    """One sensor of the rig."""

    kind: SensorKind
    """What it is: profiler, lidar, camera, gnss, imu or encoder. A log that it cannot have written is refused: scans
    are of a profiler or lidar, returns of a lidar, images of a camera, clouds of any of these three."""
    model: str = ""
    """Maker's name, such as "Velodyne HDL-32E"; it tells the width of a lidar's beam."""
    axes: str = "frd"
    """Where the sensor's x, y, z point when it is mounted without misalignment: three letters of f(orward) b(ack)
    r(ight) l(eft) u(p) d(own), right-handed: one of 24 codes such as frd, flu or urf. Ignored with
    `body_from_sensor`. Where it is left out, the log's statement holds, if its format makes one."""
    lever_arm_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the IMU reference point to the sensor's origin, body axes forward, right, down (m)."""
    boresight: Boresight = Boresight()
    """Misalignment: body_from_sensor = R(roll, pitch, heading) · body_from_axes."""
    body_from_sensor: tuple[tuple[float, float, float], ...] | None = None
    """The whole 3 × 3 rotation as rows, in place of `axes` and `boresight` (from a calibration sheet)."""
    mounts_vehicle_frame: bool = False
    """Confirms a lever arm or axes for readings that are in the vehicle's frame already, which are refused otherwise:
    the maker's vehicle frame is then mounted in the body, because it is not the one that the trajectory holds."""
    range_min_m: float = Field(default=0.0, ge=0.0)
    """Returns and readings of profiles nearer than this are left out (the vehicle); points of clouds have no range."""
    range_max_m: float = Field(default=float("inf"), gt=0.0, allow_inf_nan=True)
    """Returns and readings of profiles farther than this are left out."""
    divergence_deg: float | None = Field(default=None, ge=0.0, le=2.0)
    """Full angle of a lidar's beam (degrees), the wider one where its maker states two. Things appear larger by the
    spot, and sizes of signs are reduced by it. Left out, it is that of the `model`, where that is known (HDL-64E,
    HDL-32E, VLP-16, VLP-32C, OS0, OS1, PandarXT-32)."""
    metres_per_tick: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """Nominal way of one tick of an encoder (m): its wheel's circumference over its ticks a turn."""
    lever_arm_sigma_m: tuple[float, float, float] | None = None
    """1 σ of `lever_arm_body_m`, as good as it was measured (forward, right, down; m); a calibration starts from it."""
    boresight_sigma_deg: tuple[float, float, float] | None = None
    """1 σ of the boresight's roll, pitch, heading (degrees); a calibration starts from it."""
    range_scale_sigma: float | None = Field(default=None, ge=0.0, le=0.1)
    """1 σ of the scale of its ranges, as a share: the accuracy that its maker states for a measured range. The
    adjustment starts from it."""
    imu: ImuErrors | ImuGrade | None = None
    """Errors of an IMU: a grade ("navigation", "tactical", "industrial", "mems"), or a table from its data sheet."""
    interior: Interior | None = None
    """Interior orientation of a camera, as `roadscan camera` finds it."""
    above_road_m: float | None = Field(default=None, gt=0.0, le=20.0)
    """Height of a camera's projection centre above the road, as measured on the standing vehicle (m). Where no ground
    is surveyed below the camera, footprints of its pictures lie on a level plane so far below it; left out, they have
    none."""
    own_vehicle_px: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Polygons in a camera's pictures that show the vehicle, each a list of corners (u, v), in pixels from the
    centre of the upper left one: neither a colour nor a tie point is taken from there."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.axes not in BODY_FROM_AXES:
            raise ValueError(
                f"axes '{self.axes}' are no right-handed set of directions, expected one of {', '.join(BODY_FROM_AXES)}"
            )
        if self.range_max_m <= self.range_min_m:
            raise ValueError(f"range_max_m {self.range_max_m:g} is not above range_min_m {self.range_min_m:g}")
        if any(len(polygon) < 3 for polygon in self.own_vehicle_px):
            raise ValueError("own_vehicle_px holds a polygon of fewer than three corners")
        if self.body_from_sensor is not None:
            matrix = np.array(self.body_from_sensor, dtype=np.float64)
            if matrix.shape != (3, 3) or np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4:
                raise ValueError("body_from_sensor is not a 3 × 3 rotation (rows do not make an orthonormal set)")
            if np.linalg.det(matrix) < 0:
                raise ValueError("body_from_sensor mirrors (determinant −1): an axis points the wrong way")
        return self

    def stated_mounting(self) -> list[str]:
        """Return the keys of the mounting that the rig file states."""
        return [key for key in _MOUNTING_KEYS if key in self.model_fields_set]

    def mounted_as(self, known: Mapping[str, Any]) -> Self:
        """Return the sensor with the mounting that its log states, where the rig file states none.

        Parameters
        ----------
        known : values by key, of those that :meth:`stated_mounting` may name.
        """
        stated = self.stated_mounting()
        turned = {"axes", "boresight"} if "body_from_sensor" in stated else set()
        added = {key: value for key, value in known.items() if key not in {*stated, *turned}}
        return self.parse({**self.model_dump(exclude_unset=True), **added}) if added else self

    def beam_divergence_deg(self) -> float | None:
        """Return the full angle of a lidar's beam (degrees), as stated or the model's; None where it is not known."""
        return divergence_of(self.model) if self.divergence_deg is None else self.divergence_deg

    def imu_errors(self) -> ImuErrors | None:
        """Return the errors of an IMU; None where the rig file states none."""
        return IMU_GRADES[self.imu] if isinstance(self.imu, str) else self.imu

    def mounting(self) -> Mounting:
        """Return the mounting that the rig file states."""
        if self.body_from_sensor is not None:
            rotation = np.array(self.body_from_sensor)
        else:
            b = self.boresight
            rotation = rotation_from_rph(*np.radians([b.roll_deg, b.pitch_deg, b.heading_deg])) @ body_from_axes(
                self.axes
            )
        rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in rotation)
        return Mounting(self.lever_arm_body_m, rows)


class Rig(Strict):
    """A vehicle and its sensors."""

    name: str = ""
    """Name of the rig."""
    sensors: dict[str, Sensor] = {}
    """Sensors by name; logs refer to them by this name."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read ``RIG.toml``."""
        return cls.parse(load_toml(path), file=path)


DIVERGENCE_DEG: Final = {
    "hdl64": 0.115, "hdl32": 0.17, "vlp16": 0.18, "vlp32": 0.18, "os0": 0.35, "os1128": 0.18, "os1": 0.13,
    "xt32": 0.095,
}  # fmt: skip
"""Full angle of the beam, the wider one where two are stated (degrees), by letters and digits of the model. Velodyne:
HDL-64E S2 manual 2.0 mrad, HDL-32E manual 2.97 mrad, VLP-16 manual 63-9243 and VLP-32C 3.0 mrad; Ouster: OS0 data sheet
0.35°, OS1 data sheet 0.18° with 128 beams and 0.13° with 64 and 16 (full width at half maximum); Hesai: PandarXT-32
data sheet 0.095°. OS1's were read again in the data sheet when this was written, the others were not: a rig file that
states `divergence_deg` goes before them."""


def divergence_of(model: str) -> float | None:
    """Return the full angle of a model's beam (degrees); None where it is not known.

    model : maker's name for it in any spelling, such as "Velodyne HDL-32E".
    """
    plain = re.sub(r"[^a-z0-9]", "", model.lower())
    return next((width for name, width in DIVERGENCE_DEG.items() if name in plain), None)
