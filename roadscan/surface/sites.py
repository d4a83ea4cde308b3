"""Sites: the points of a region in canonical order, on a lattice that all regions share.

Two regions that overlap must decide and round alike. So positions are whole numbers of 2⁻³⁶ m (15 pm) from the map's
own origin: map coordinates in 64-bit floats change by less than that, and every difference of two positions is exact,
in integers and in floats. What kernels compute from differences has the same bits in every region.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import RoadscanError
from roadscan.core.grid import QUANTUM_M

STEPS_PER_M: Final = 2.0**36
"""Steps of the lattice in a metre."""
FARTHEST_M: Final = 2.0**26
"""Greatest distance from the map's origin (67,000 km): the lattice in 64 bits."""
WIDEST_M: Final = 2.0**16
"""Width of the widest region (65 km): floats of 53 bits represent every difference exactly."""


@dataclass(frozen=True)
class Sites:
    """Points to be triangulated, by northing and easting (to 10 µm)."""

    x_steps: npt.NDArray[np.int64]
    """(m,) easting, lattice steps from the map's origin."""
    y_steps: npt.NDArray[np.int64]
    """(m,) northing, likewise."""
    height_m: npt.NDArray[np.float64]
    """(m,)."""
    anchor_steps: tuple[int, int]
    """Origin of :meth:`local_m`: south-west of all, in whole metres."""

    def __len__(self) -> int:
        return int(self.height_m.size)

    def local_m(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Returns eastings and northings from the anchor (m), exact."""
        return (
            from_steps(self.x_steps - self.anchor_steps[0]),
            from_steps(self.y_steps - self.anchor_steps[1]),
        )


def sites(points_m: npt.NDArray[np.float64]) -> Sites:
    """Returns ordered points, with those at one place merged.

    Points whose coordinates round to the same multiples of 10 µm (:data:`roadscan.core.grid.QUANTUM_M`) are one
    site, at the mean of their positions and of their heights. The result does not depend on the points' order.

    Parameters
    ----------
    points_m : (n, 3) easting, northing, height (m, map frame).

    Raises
    ------
    RoadscanError
        Where a value is not finite, or the points are not on one map.
    """
    _check(points_m)
    east, north, height = (np.ascontiguousarray(column) for column in points_m.T)
    x, y = steps(east), steps(north)
    column, row = (np.rint(v / QUANTUM_M).astype(np.int64) for v in (east, north))
    order = np.argsort(column, kind="stable")
    order = order[np.argsort(row[order], kind="stable")]
    new = np.ones(order.size, dtype=np.bool_)
    new[1:] = (np.diff(row[order]) != 0) | (np.diff(column[order]) != 0)
    if not new.all():
        order = np.lexsort((height, x, y, column, row))
        x, y, height = _merged(x[order], y[order], height[order], np.flatnonzero(new))
    else:
        x, y, height = x[order], y[order], height[order]
    metre = int(STEPS_PER_M)
    anchor = tuple(int(v.min()) // metre * metre if v.size else 0 for v in (x, y))
    return Sites(x, y, height, (anchor[0], anchor[1]))


def steps(coordinate_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Returns coordinates (m) as lattice steps."""
    return np.rint(coordinate_m * STEPS_PER_M).astype(np.int64)


def from_steps(difference: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Returns differences of lattice steps in metres."""
    return difference / STEPS_PER_M


def _merged(
    x: npt.NDArray[np.int64], y: npt.NDArray[np.int64], height: npt.NDArray[np.float64], first: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Returns means of runs that begin at `first`."""
    count = np.diff(first, append=x.size)
    spread = np.repeat(first, count)
    middle = (v[first] + np.add.reduceat(v - v[spread], first) // count for v in (x, y))
    return *middle, height[first] + np.add.reduceat(height - height[spread], first) / count


def _check(points_m: npt.NDArray[Any]) -> None:
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise RoadscanError(f"points of shape {points_m.shape}", expected="(n, 3): easting, northing, height in metres")
    sound = np.isfinite(points_m).all(axis=1)
    if not sound.all():
        bad = np.flatnonzero(~sound)
        raise RoadscanError(
            f"{bad.size:,} of {len(points_m):,} points have a coordinate that is not finite, the first at row {bad[0]}",
            expected="easting, northing and height in metres",
            change="leave out readings without a place before a surface is made of them",
        )
    if len(points_m) and np.abs(points_m[:, :2]).max() > FARTHEST_M:
        raise RoadscanError(
            f"a point {np.abs(points_m[:, :2]).max():.3g} m from the map's origin",
            expected=f"map coordinates below {FARTHEST_M:.3g} m",
        )
    if len(points_m) and np.ptp(points_m[:, :2], axis=0).max() > WIDEST_M:
        raise RoadscanError(
            f"points {np.ptp(points_m[:, :2], axis=0).max():.3g} m apart",
            expected=f"a region of at most {WIDEST_M:.3g} m",
            change="make the surface tile by tile",
        )
