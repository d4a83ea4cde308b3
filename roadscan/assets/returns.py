"""Returns of a piece of the map, the input of the detection of assets."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float32, Float64


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns (n,) of an asset tile and its halo, in canonical order, so that equal readings give equal bytes.

    Coordinates count from `corner_m`, a corner of the tile in the map: x to the east, y to the north (m). Heights are
    those of the map frame.
    """

    corner_m: tuple[float, float]
    """Easting and northing of the corner from which x and y count (m)."""
    x_m: Float64
    y_m: Float64
    height_m: Float64
    intensity: Float32
    """As recorded, or calibrated where the survey has gains (`calibrated`); digital numbers of 16 bits."""
    epoch_gps_ns: npt.NDArray[np.int64]
    pass_id: npt.NDArray[np.uint16]
    """Number of the pass of the survey that saw it: a drive of a lane."""
    sensor: npt.NDArray[np.uint8]
    """Number of the sensor, an index of `sensors`."""
    laser: npt.NDArray[np.uint16]
    """Laser of the sensor (ring), 0 for scanners with one."""
    return_number: npt.NDArray[np.uint8]
    """1 for the first return of a pulse."""
    number_of_returns: npt.NDArray[np.uint8]
    sensor_x_m: Float64
    """Position of the sensor when it saw the return: x, y from `corner_m` and height, like those of the return."""
    sensor_y_m: Float64
    sensor_height_m: Float64
    sensors: tuple[str, ...] = ()
    """Names of the sensors."""
    divergence_deg: tuple[float, ...] = ()
    """Full angle of the beam of each sensor (degrees), NaN where it is not known; empty: of none."""
    calibrated: bool = False
    evened: Float32 | None = None
    """(n,) intensity with the gains of lasers alone; None: as `intensity`."""

    def __len__(self) -> int:
        return int(self.x_m.size)

    @property
    def range_m(self) -> Float64:
        """Returns the distance (n,) from the sensor to the return (m)."""
        return self.ranges_m(slice(None))

    def ranges_m(self, rows: npt.NDArray[np.integer[Any]] | slice) -> Float64:
        """Returns the distance (k,) from the sensor to some returns (m)."""
        away = self.x_m[rows] - self.sensor_x_m[rows], self.y_m[rows] - self.sensor_y_m[rows]
        return np.sqrt(away[0] ** 2 + away[1] ** 2 + (self.height_m[rows] - self.sensor_height_m[rows]) ** 2)

    @property
    def light(self) -> Float32:
        """Returns the light (n,) that came back, lasers made alike; it still falls with range and incidence."""
        return self.intensity if self.evened is None else self.evened

    def half_beam_rad(self, rows: npt.NDArray[np.integer[Any]]) -> Float64:
        """Returns half the angle (n,) of the beams of some returns (rad); NaN where it is not known."""
        known = np.full(256, np.nan)
        known[: len(self.divergence_deg)] = np.radians(self.divergence_deg) / 2.0
        return np.asarray(known[self.sensor[rows]])

    def at(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.integer[Any]]) -> Self:
        """Returns the returns at `rows`, a mask (n,) or indices."""
        arrays: dict[str, Any] = {
            f.name: v[rows] for f in fields(self) if isinstance(v := getattr(self, f.name), np.ndarray)
        }
        return replace(self, **arrays)
