"""What observations of mountings look like, whatever they come from.

Every kind of evidence ends as one of two observations:

- **Ties**: two readings saw the same place. With p = t + R_world←body (R_body←sensor p_sensor + l), the whitened
  difference W (p_first − p_second) has unit variance. Rows of W say what is known: one row nᵀ/σ for two readings of
  one plane with normal n, three for a place known in all directions.
- **Directions**: the same vector seen by the sensor and by the body (gravity, acceleration, the Earth's field).

World frame: any right-handed Cartesian frame in metres (ECEF or the local frame).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Seen:
    """Places as a sensor on the vehicle saw them, each with the pose of its epoch."""

    sensor: str
    point_sensor_m: Float64
    """(n, 3) sensor axes."""
    position_world_m: Float64
    """(n, 3) IMU reference point."""
    world_from_body: Float64
    """(n, 3, 3)."""
    traverse: Int64
    """(n,) which drive over the place: readings of one traverse share the error of its poses."""


@dataclass(frozen=True)
class Known:
    """Places that no sensor's mounting moves: of a reference scan, of control points, of a calibration object."""

    point_m: Float64
    """(n, 3) world, or in the object's own frame."""
    object: str | None = None
    """Calibration object whose pose in the world is estimated too; None: coordinates are world."""


@dataclass(frozen=True)
class Ties:
    """Pairs of places that are one: weight @ (p_first − p_second) has unit variance."""

    kind: str
    """What found them, for the report: "loops", "object", "reference" …"""
    first: Seen
    second: Seen | Known
    weight: Float64
    """(n, k, 3), 1/m, world axes (the object's axes where `second` lies on one)."""


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


Evidence = Ties | Directions
