"""The direction of the road at a place, from the drives near it."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import Scene
from roadscan.compute.ways import way_along

_STEP_M: Final = 1.0  # Distance of points along a drive (m).
_OVER_M: Final = 3.0
"""The direction is that of a chord of twice this length (m)."""
_FARTHEST_M: Final = 25.0  # No direction is known farther from all drives (m).


class RoadDirection:
    """Direction of the drive nearest to a place."""

    def __init__(self, scene: Scene) -> None:
        places, directions = [np.zeros((0, 2))], [np.zeros(0)]
        drive = scene.drive_xyh_m
        for number in np.unique(drive[:, 3]) if len(drive) else []:
            xy = drive[drive[:, 3] == number, :2]
            driven = way_along(xy)
            moved = np.concatenate([[True], np.diff(driven) > 1e-6])
            if np.count_nonzero(moved) < 2:
                continue
            at = np.arange(0.0, driven[-1] + _STEP_M, _STEP_M)
            place = _along(at, driven[moved], xy[moved])
            chord = _along(at + _OVER_M, driven[moved], xy[moved]) - _along(at - _OVER_M, driven[moved], xy[moved])
            places.append(place)
            directions.append(np.arctan2(chord[:, 1], chord[:, 0]))
        self._place = np.concatenate(places)
        self._direction = np.concatenate(directions)

    def at(self, x_m: float, y_m: float) -> float:
        """Returns the direction (rad) anticlockwise from x; NaN where no drive is within 25 m."""
        if not self._direction.size:
            return float("nan")
        away = np.hypot(self._place[:, 0] - x_m, self._place[:, 1] - y_m)
        nearest = int(np.argmin(away))
        return float(self._direction[nearest]) if away[nearest] <= _FARTHEST_M else float("nan")


def _along(
    at: npt.NDArray[np.float64], driven: npt.NDArray[np.float64], xy: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Returns points (n, 2) at lengths along a line, clamped to its ends."""
    return np.stack([np.interp(at, driven, xy[:, i]) for i in (0, 1)], axis=1)
