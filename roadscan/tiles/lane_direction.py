"""Directions of lanes: the direction in which a vehicle drove nearby."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


STEP_M: Final = 1.0
"""Directions are those of steps of about this length."""
_LEAST_STEP_M: Final = 0.5
"""Shorter steps are ignored: the vehicle stands."""
_LONGEST_STEP_M: Final = 50.0
"""Longer steps are ignored: they are gaps between poses."""
_FARTHEST_M: Final = 20.0
"""A lane farther than this from every drive has no direction."""


@dataclass(frozen=True)
class LaneDirections:
    """Steps of all drives."""

    place_m: Float64
    """(k, 2) easting and northing of the middle of each step (m)."""
    azimuth_rad: Float64
    """(k,) direction of the step, clockwise from map north."""

    @classmethod
    def of_path(cls, path_m: npt.ArrayLike) -> Self:
        """Build from the steps between successive places (n, 2) about :data:`STEP_M` apart, in driving order."""
        path = np.asarray(path_m, np.float64).reshape(-1, 2)
        step = np.diff(path, axis=0)
        length = np.hypot(*step.T)
        own = (length >= _LEAST_STEP_M) & (length <= _LONGEST_STEP_M)
        return cls((path[:-1] + 0.5 * step)[own], np.arctan2(step[own, 0], step[own, 1]))

    def at(self, places_m: npt.ArrayLike) -> Float64:
        """Return directions (n,) at places (n, 2), from the nearest steps; NaN where none is near."""
        places = np.asarray(places_m, np.float64).reshape(-1, 2)
        if not len(self.place_m) or not len(places):
            return np.full(len(places), np.nan)
        away, nearest = self._tree.query(places)
        return np.where(away <= _FARTHEST_M, self.azimuth_rad[nearest], np.nan)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.place_m)
