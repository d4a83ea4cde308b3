"""The unknowns of a calibration with their priors: mountings, errors of poses, poses of calibration objects.

All unknowns are one vector in units of prior σ: x = root · z with z ~ N(0, 1), so that a part without any uncertainty
never moves and information of 1 equals that of the prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.evidence import Traverse
from roadscan.calibrate.rotations import exponential, left_jacobian
from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.rig import Mounting, Sensor
from roadscan.core.settings.calibration import CalibrationSettings

MOUNTING: Final = 7
"""Unknowns of a sensor: lever arm (3), small rotation about body axes (3), range offset."""
BODY: Final = 6
"""Unknowns of a traverse or object: shift (3), small rotation about its axes (3)."""


@dataclass(frozen=True)
class Prior:
    """Prior of a sensor's mounting before the calibration."""

    mounting: Mounting
    lever_arm_sigma_m: tuple[float, float, float]
    """1 σ forward, right, down; 0 keeps it fixed."""
    boresight_sigma_rad: tuple[float, float, float]
    """1 σ about body x, y, z; 0 keeps it fixed."""
    range_offset_sigma_m: float = 0.0
    """1 σ of a constant range error; 0 for none."""
    beam_axis_sensor: tuple[float, float, float] | None = None
    """Direction in which a range offset moves a point, for heads with parallel beams; None: away from the sensor."""

    @classmethod
    def of(cls, sensor: Sensor, settings: CalibrationSettings, range_offset_sigma_m: float = 0.0) -> Self:
        """Return mounting and σ of the rig file; σ of the settings where it states none."""
        boresight = np.radians(sensor.boresight_sigma_deg or settings.boresight_sigma_deg)
        return cls(
            sensor.mounting(),
            sensor.lever_arm_sigma_m or settings.lever_arm_sigma_m,
            (float(boresight[0]), float(boresight[1]), float(boresight[2])),
            range_offset_sigma_m,
            (0.0, 0.0, 1.0) if sensor.kind == "profiler" else None,
        )


def priors_of(sensors: Mapping[str, Sensor], settings: CalibrationSettings) -> dict[str, Prior]:
    """Return the priors of sensors' mountings, by name.

    Raises
    ------
    ConfigError
        where the settings allow a range offset for a sensor that is not among them.
    """
    for name in settings.range_offset_sigma_m:
        if name not in sensors:
            raise ConfigError(
                f"range_offset_sigma_m names the sensor '{name}', which is not calibrated{nearest(name, sensors)}",
                expected="one of " + ", ".join(sensors),
            )
    return {
        name: Prior.of(sensor, settings, settings.range_offset_sigma_m.get(name, 0.0))
        for name, sensor in sensors.items()
    }


@dataclass(frozen=True)
class ObjectPose:
    """Approximate pose of a calibration object."""

    position_world_m: Float64
    """(3,) its origin."""
    world_from_object: Float64
    """(3, 3)."""
    sigma_m: float = 1.0
    sigma_rad: float = 0.2


@dataclass(frozen=True)
class Correction:
    """Estimated error of a traverse's poses, to be added to them."""

    shift_north_east_down_m: Float64
    """(3,)"""
    turn_roll_pitch_heading_rad: Float64
    """(3,) small rotation vector about the body's axes."""


@dataclass(frozen=True)
class Estimate:
    """Values of all unknowns at one step, from which ties are searched for."""

    mountings: dict[str, Mounting]
    range_offsets_m: dict[str, float]
    objects: dict[str, ObjectPose]
    corrections: dict[int, Correction]


@dataclass(frozen=True)
class Geometry:
    """The same values as arrays for the observations. S sensors, B bodies: traverses, then objects."""

    lever_arm_m: Float64
    """(S, 3)"""
    body_from_sensor: Float64
    """(S, 3, 3)"""
    range_offset_m: Float64
    """(S,)"""
    shift_world_m: Float64
    """(B, 3)"""
    turn: Float64
    """(B, 3, 3) rotation of the body, in its axes."""
    derivative: Float64
    """(P, P) derivative of lever arm, small rotation, offset, world shift and small body turn by z."""


@dataclass(frozen=True)
class Unknowns:
    """Order of the unknowns: sensors (7 each), traverses (6 each), objects (6 each)."""

    priors: Mapping[str, Prior]
    traverses: Mapping[int, Traverse]
    objects: Mapping[str, ObjectPose] = field(default_factory=dict)

    @cached_property
    def sensor_index(self) -> dict[str, int]:
        """Index of each sensor."""
        return {name: index for index, name in enumerate(self.priors)}

    @cached_property
    def traverse_keys(self) -> npt.NDArray[np.int64]:
        """Numbers of the traverses, ascending: their order among the unknowns."""
        return np.array(sorted(self.traverses), dtype=np.int64)

    @cached_property
    def object_index(self) -> dict[str, int]:
        """Index of each object among the bodies."""
        return {name: self.traverse_keys.size + index for index, name in enumerate(self.objects)}

    @property
    def bodies(self) -> int:
        """Number of traverses and objects."""
        return len(self.traverses) + len(self.objects)

    @property
    def mounting_size(self) -> int:
        """Number of unknowns of the sensors, which come first."""
        return MOUNTING * len(self.priors)

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.mounting_size + BODY * self.bodies

    def mounting_slice(self, sensor: str) -> slice:
        """Return the place of a sensor's unknowns."""
        begin = MOUNTING * self.find_sensor(sensor)
        return slice(begin, begin + MOUNTING)

    def body_slice(self, body: int) -> slice:
        """Return the place of a body's unknowns."""
        begin = self.mounting_size + BODY * body
        return slice(begin, begin + BODY)

    def find_sensor(self, sensor: str) -> int:
        """Return the index of a sensor; raises :class:`ConfigError` where it is unknown."""
        if sensor not in self.sensor_index:
            raise ConfigError(
                f"evidence of the sensor '{sensor}', which is not calibrated{nearest(sensor, self.priors)}",
                expected="one of " + ", ".join(self.priors),
            )
        return self.sensor_index[sensor]

    def find_traverses(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the indices (n,) among the bodies of traverses (n,); raises :class:`ConfigError` for unknown ones."""
        keys = self.traverse_keys
        place = np.searchsorted(keys, numbers)
        known = np.zeros(numbers.shape, dtype=bool)
        inside = place < keys.size
        known[inside] = keys[place[inside]] == numbers[inside]
        if not known.all():
            raise ConfigError(
                f"evidence of the unknown traverse {numbers[~known][0]}",
                expected=f"one of the {keys.size} traverses with a stated error of poses",
            )
        return place.astype(np.int64)

    def find_object(self, name: str) -> int:
        """Return the index of an object among the bodies; raises :class:`ConfigError` where it is unknown."""
        if name not in self.object_index:
            raise ConfigError(
                f"evidence of the unknown calibration object '{name}'{nearest(name, self.objects)}",
                expected="one of " + (", ".join(self.objects) or "none: no object's pose is stated"),
            )
        return self.object_index[name]

    @cached_property
    def root(self) -> Float64:
        """Return a root (P, P) of the prior covariance, root · rootᵀ (m, rad); traverses shift north, east, down."""
        root = np.zeros((self.size, self.size))
        for name, prior in self.priors.items():
            sigma = [*prior.lever_arm_sigma_m, *prior.boresight_sigma_rad, prior.range_offset_sigma_m]
            place = self.mounting_slice(name)
            root[place, place] = np.diag(sigma)
        self._traverse_root(root)
        for name, pose in self.objects.items():
            place = self.body_slice(self.object_index[name])
            root[place, place] = np.diag(np.repeat([pose.sigma_m, pose.sigma_rad], 3))
        return root

    def _traverse_root(self, root: Float64) -> None:
        """Fill in the root of traverses: Gauss–Markov within each run, independent between runs."""
        by_run: dict[str, list[int]] = {}
        for body, key in enumerate(self.traverse_keys.tolist()):
            by_run.setdefault(self.traverses[key].run, []).append(body)
        for members in by_run.values():
            pieces = [self.traverses[int(self.traverse_keys[body])] for body in members]
            seconds = np.array([(p.epoch_gps_ns - pieces[0].epoch_gps_ns) * 1e-9 for p in pieces])
            constant = np.array([p.time_constant_s for p in pieces])
            apart = np.abs(seconds[:, None] - seconds[None, :])
            correlation = np.exp(-apart / np.sqrt(constant[:, None] * constant[None, :]))
            # Pieces at one epoch would make the matrix singular.
            factor = np.linalg.cholesky(correlation + 1e-10 * np.eye(len(pieces)))
            sigma = np.array([[*p.sigma_north_east_down_m, *p.sigma_roll_pitch_heading_rad] for p in pieces])
            for axis in range(BODY):
                places = [self.mounting_size + BODY * body + axis for body in members]
                root[np.ix_(places, places)] = sigma[:, axis, None] * factor

    def geometry(self, z: Float64) -> Geometry:
        """Return the arrays at z (P,)."""
        x = self.root @ z
        mounting = x[: self.mounting_size].reshape(-1, MOUNTING)
        body = x[self.mounting_size :].reshape(-1, BODY)
        nominal = [prior.mounting.arrays() for prior in self.priors.values()]
        world_from_shift = [self.traverses[int(k)].world_from_ned for k in self.traverse_keys]
        world_from_shift += [np.eye(3)] * len(self.objects)
        change = np.eye(self.size)
        for index, row in enumerate(mounting):
            begin = MOUNTING * index + 3
            change[begin : begin + 3, begin : begin + 3] = left_jacobian(row[3:6])
        for index, row in enumerate(body):
            begin = self.mounting_size + BODY * index
            change[begin : begin + 3, begin : begin + 3] = world_from_shift[index]
            change[begin + 3 : begin + 6, begin + 3 : begin + 6] = left_jacobian(-row[3:6])
        shift = [m @ row[:3] for m, row in zip(world_from_shift, body, strict=True)]
        return Geometry(
            lever_arm_m=np.array([lever for _, lever in nominal]).reshape(-1, 3) + mounting[:, :3],
            body_from_sensor=exponential(mounting[:, 3:6]) @ np.array([r for r, _ in nominal]).reshape(-1, 3, 3),
            range_offset_m=mounting[:, 6],
            shift_world_m=np.array(shift).reshape(-1, 3),
            turn=exponential(body[:, 3:6]),
            derivative=change @ self.root,
        )

    def estimate(self, z: Float64) -> Estimate:
        """Return mountings, object poses and corrections at z (P,)."""
        now = self.geometry(z)
        body = (self.root @ z)[self.mounting_size :].reshape(-1, BODY)
        objects = {}
        for name, index in self.object_index.items():
            pose = self.objects[name]
            turned = pose.world_from_object @ now.turn[index]
            objects[name] = ObjectPose(
                pose.position_world_m + now.shift_world_m[index], turned, pose.sigma_m, pose.sigma_rad
            )
        return Estimate(
            mountings={
                name: mounting_of(now.body_from_sensor[i], now.lever_arm_m[i]) for name, i in self.sensor_index.items()
            },
            range_offsets_m={name: float(now.range_offset_m[i]) for name, i in self.sensor_index.items()},
            objects=objects,
            corrections={int(k): Correction(body[i, :3], body[i, 3:]) for i, k in enumerate(self.traverse_keys)},
        )


def mounting_of(body_from_sensor: Float64, lever_arm_m: Float64) -> Mounting:
    """Return a mounting with a rotation (3, 3) and a lever arm (3,)."""
    rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in body_from_sensor)
    return Mounting((float(lever_arm_m[0]), float(lever_arm_m[1]), float(lever_arm_m[2])), rows)
