"""Points of a section of road: canonical order, rotation, and the pyramid that thins them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ProfileError


@dataclass(frozen=True, eq=False)
class RoadPoints:
    """Points (n,) of a section of road: readings, or cells that stand for several readings."""

    x_m: Float64
    """Easting, or way along the road where the points are rotated."""
    y_m: Float64
    """Northing, or way to the left."""
    height_m: Float64
    intensity: Float64
    """On any scale that begins at 0."""
    readings: Float64
    """Number of readings for which a point stands."""

    def __len__(self) -> int:
        return int(self.x_m.size)

    @classmethod
    def of(
        cls,
        easting_m: npt.ArrayLike,
        northing_m: npt.ArrayLike,
        height_m: npt.ArrayLike,
        intensity: npt.ArrayLike,
        readings: npt.ArrayLike = 1.0,
    ) -> RoadPoints:
        """Return the points in canonical order (northing, easting, height, intensity).

        Parameters
        ----------
        easting_m, northing_m, height_m, intensity : (n,); readings : (n,) or one number.

        Raises
        ------
        ProfileError
            where the arrays differ in size, or a number is not finite.
        """
        size = np.size(easting_m)
        given = (easting_m, northing_m, height_m, intensity, np.broadcast_to(readings, (size,)))
        columns = [np.asarray(one, np.float64).ravel() for one in given]
        if {c.size for c in columns} != {size}:
            raise ProfileError(
                f"points with {', '.join(str(c.size) for c in columns)} values", expected="arrays of one size"
            )
        if not all(np.isfinite(c).all() for c in columns):
            raise ProfileError("points with numbers that are not finite", expected="finite coordinates and intensities")
        order = np.lexsort((columns[4], columns[3], columns[2], columns[0], columns[1]))
        return cls(*(c[order] for c in columns))

    def take(self, rows: npt.NDArray[np.generic]) -> RoadPoints:
        """Return the points at `rows`: indices or a mask."""
        return RoadPoints(*(getattr(self, f.name)[rows] for f in fields(self)))

    def rotated(self, origin_m: tuple[float, float], heading_rad: float) -> RoadPoints:
        """Return the points about an origin, turned about the vertical so that the heading points along x.

        heading_rad : mean heading of the vehicle, clockwise from north.
        """
        e, n = self.x_m - origin_m[0], self.y_m - origin_m[1]
        sin, cos = math.sin(heading_rad), math.cos(heading_rad)
        return RoadPoints(e * sin + n * cos, n * sin - e * cos, self.height_m, self.intensity, self.readings)


def rotated_back(xy_m: Float64, origin_m: tuple[float, float], heading_rad: float) -> Float64:
    """Return easting and northing (n, 2) of places along and to the left (n, 2); undoes :meth:`RoadPoints.rotated`."""
    sin, cos = math.sin(heading_rad), math.cos(heading_rad)
    x, y = xy_m[:, 0], xy_m[:, 1]
    return np.column_stack([origin_m[0] + x * sin - y * cos, origin_m[1] + x * cos + y * sin])


def pyramid(points: RoadPoints, cell_m: float, levels: int) -> list[RoadPoints]:
    """Return the points, and as many increasingly thinned levels (Crawford 2009, window-size filter).

    The windows of the first level are two cells wide, those of each further level twice as wide as before. Of each
    window the point is kept whose intensity is nearest to the window's mean, of equals the first; a level is thinned
    from the one before. A kept point stands for all readings of its window.
    """
    found = [points]
    for level in range(1, levels + 1):
        found.append(_thinned(found[-1], cell_m * 2.0**level))
    return found


def _thinned(points: RoadPoints, window_m: float) -> RoadPoints:
    if not len(points):
        return points
    column, row = (np.floor(v / window_m).astype(np.int64) for v in (points.x_m, points.y_m))
    window = (row - row.min()) * (int(np.ptp(column)) + 1) + column - column.min()
    order = np.argsort(window, kind="stable")
    window = window[order]
    starts = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
    number = np.cumsum(np.diff(window, prepend=window[0]) != 0)
    readings, intensity = points.readings[order], points.intensity[order]
    many = np.add.reduceat(readings, starts)
    mean = np.add.reduceat(readings * intensity, starts) / many
    away = np.abs(intensity - mean[number])
    nearest = np.lexsort((np.arange(away.size), away, number))[starts]
    kept = points.take(order[nearest])
    return RoadPoints(kept.x_m, kept.y_m, kept.height_m, kept.intensity, many)
