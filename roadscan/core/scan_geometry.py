"""Geometry of raw readings in their sensor's frame."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from roadscan.core.strict import Strict

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

    def rays(self) -> tuple[Float64, Float64]:
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
