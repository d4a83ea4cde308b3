"""The observations of mountings, to which every kind of evidence is reduced.

Every kind of evidence ends as one of three observations:

- **Ties**: two readings saw the same place. With p = t + R_world←body (R_body←sensor p_sensor + l), the whitened
  difference W (p_first − p_second) has unit variance. Rows of W say what is known: one row nᵀ/σ for two readings of
  one plane with normal n, three for a place known in all directions.
- **Directions**: the same vector seen by the sensor and by the body (gravity, acceleration, the Earth's field), each
  with an independent error.
- **Orientation**: the whole rotation of a sensor with its covariance, from a solution whose errors are not independent.

Poses have errors too. A **Traverse** is a piece of a drive within which they are one shift and one small rotation.

World frame: any right-handed Cartesian frame in metres (ECEF or the local frame).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roadscan.compute.array_types import Float64, Int64


@dataclass(frozen=True)
class Seen:
    """Places that a sensor on the vehicle saw, each with the pose of its epoch."""

    sensor: str
    point_sensor_m: Float64
    """(n, 3) sensor axes."""
    position_world_m: Float64
    """(n, 3) IMU reference point."""
    world_from_body: Float64
    """(n, 3, 3)."""
    traverse: Int64
    """(n,) number of the traverse; readings of one traverse share the error of its poses."""

    @classmethod
    def joined(cls, parts: Sequence[Seen]) -> Seen:
        """Return the places of several parts of one sensor, one part after another."""
        return cls(
            parts[0].sensor,
            np.concatenate([p.point_sensor_m for p in parts]),
            np.concatenate([p.position_world_m for p in parts]),
            np.concatenate([p.world_from_body for p in parts]),
            np.concatenate([p.traverse for p in parts]),
        )


@dataclass(frozen=True)
class Known:
    """Places that do not depend on a mounting: of a reference scan, of control points, of a calibration object."""

    point_m: Float64
    """(n, 3) world, or in the object's frame."""
    object: str | None = None
    """Calibration object whose pose in the world is estimated too; None where coordinates are world."""


@dataclass(frozen=True)
class Ties:
    """Pairs of observations of the same place: weight @ (p_first − p_second) has unit variance."""

    kind: str
    """Origin of the ties, for the report: "loops", "object", "reference" …"""
    first: Seen
    second: Seen | Known
    weight: Float64
    """(n, k, 3), 1/m, world axes (the object's axes where `second` lies on one)."""
    normal_sigma_rad: Float64 | None = None
    """(n,) 1 σ of the direction of a tie's rows, where they are normals of a surface that were estimated. A wrong
    normal seems to locate a place within the surface; when it is decided what is determined, the apparent information
    from the normals' errors is subtracted."""


@dataclass(frozen=True)
class Directions:
    """One vector in sensor and in body axes."""

    kind: str
    sensor: str
    direction_sensor: Float64
    """(n, 3) unit vectors."""
    direction_body: Float64
    """(n, 3) unit vectors."""
    sigma_rad: Float64
    """(n,) 1 σ of the angle between them."""


@dataclass(frozen=True)
class AttitudeInfluence:
    """Share of an orientation's error that comes from the trajectory's attitude errors, over one piece of a run."""

    epoch_gps_ns: Int64
    """(k,) ascending."""
    influence: Float64
    """(3, k, 3) small rotation of the orientation by errors of roll, pitch, heading at these epochs."""
    sigma_roll_pitch_heading_rad: tuple[float, float, float]
    """1 σ of these errors."""
    time_constant_s: float
    """Errors are correlated by exp(−|Δt| / time constant)."""


@dataclass(frozen=True)
class Orientation:
    """The rotation of a sensor, estimated separately."""

    kind: str
    sensor: str
    body_from_sensor: Float64
    """(3, 3)."""
    covariance_rad2: Float64
    """(3, 3) of a small rotation about the body's axes that follows `body_from_sensor`."""
    attitude: tuple[AttitudeInfluence, ...] = ()
    """By run or piece: what of the covariance is the trajectory's attitude. Orientations of two sensors that were found
    along the same drives share it, and do not average it out."""


Evidence = Ties | Directions | Orientation


@dataclass(frozen=True)
class Traverse:
    """A piece of a drive whose poses share one error; pieces of one run are correlated by the time between them."""

    run: str
    epoch_gps_ns: int
    """Epoch of its middle."""
    sigma_north_east_down_m: tuple[float, float, float]
    """1 σ of the poses' position."""
    sigma_roll_pitch_heading_rad: tuple[float, float, float]
    """1 σ of the poses' attitude, about the body's axes."""
    world_from_ned: Float64
    """(3, 3) local level axes at the place."""
    time_constant_s: float = 60.0
    """Errors of two pieces of the run are correlated by exp(−|Δt| / time constant)."""
