"""Sites: the points of a region in canonical order, on a lattice that all regions share; and their triangulation.

Two regions that overlap must decide and round alike. So positions are whole numbers of 2⁻³⁶ m (15 pm) from the map's
own origin: map coordinates in 64-bit floats change by less than that, and every difference of two positions is exact,
in integers and in floats. What kernels compute from differences has the same bits in every region.

The Delaunay triangulation of a region agrees, triangle by triangle, with that of its neighbours.

Qhull triangulates. Its answer depends on tolerances of the whole region and, where four points lie on a circle (every
mesh of gridded points), on chance. So its edges are then tested in exact arithmetic and flipped where they are
not Delaunay's; of four points on a circle, the diagonal of the first point (by northing, then easting) is taken. The
result is the one Delaunay triangulation of the points, with ties broken as if the points had been moved by
infinitely little, in the order of their absolute place (Lawson 1977; Edelsbrunner & Mücke 1990).

Cut: a triangle is kept if the circle through its corners is at most ``max_gap_m`` wide. That circle holds no point, so
this is "no surface over a hole in which a disc of that width has room"; the long thin triangles of a hull go with it.
As a triangle depends only on the points in its circle, regions agree on all kept triangles that lie more than
``max_gap_m`` inside both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import RoadscanError
from roadscan.core.grid import QUANTUM_M
from roadscan.surface.kernels.delaunay import flip_edges

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


NUDGE_M: Final = 2.0**-24
"""Qhull gets positions moved by up to this (60 nm), by a hash of the position: it is twice as fast without ties."""


@dataclass(frozen=True)
class Triangulation:
    """Triangles over sites, in order of their corners."""

    triangles: npt.NDArray[np.int64]
    """(n, 3) sites, counter-clockwise from the first in the sites' order."""
    opposite: npt.NDArray[np.int64]
    """(n, 3): 3 · triangle + corner opposite the same edge beyond the edge opposite this corner, -1 on the rim."""

    def __len__(self) -> int:
        return int(self.triangles.shape[0])

    def neighbours(self, sites: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Returns sites joined to each site by an edge: those of i from ``starts[i]`` to ``starts[i + 1]``, ascending.

        Returns
        -------
        starts : (sites + 1,); neighbours : (``starts[-1]``,).
        """
        start, end = np.roll(self.triangles, -1, axis=1), np.roll(self.triangles, 1, axis=1)
        rim = self.opposite < 0  # the other direction of an edge comes from the other triangle, if there is one
        ways = np.sort(np.concatenate([(start * sites + end).ravel(), end[rim] * sites + start[rim]]))
        starts = np.searchsorted(ways, np.arange(sites + 1) * sites)
        return starts, ways % max(sites, 1)


def triangulate(sites: Sites, max_gap_m: float) -> Triangulation:
    """Returns the triangulation of sites, with holes wider than `max_gap_m` (m) open.

    Fewer than three sites, or sites on a line, give no triangle.
    """
    raw = _qhull(sites)
    if raw is None:
        return Triangulation(np.empty((0, 3), np.int64), np.empty((0, 3), np.int64))
    triangles, across = raw
    flip_edges(sites.x_steps, sites.y_steps, triangles, across)
    first = np.argmin(triangles, axis=1)[:, None]
    triangles, across = (np.take_along_axis(v, (first + np.arange(3)) % 3, axis=1) for v in (triangles, across))
    kept = np.flatnonzero(_circle_at_most(max_gap_m, sites, triangles))
    order = kept[np.argsort(triangles[kept, 0] * len(sites) + triangles[kept, 1])]  # an edge has one triangle
    renumbered = np.full(len(triangles) + 1, -1)  # one more row, so that index -1 means no neighbour
    renumbered[order] = np.arange(order.size)
    return _paired(triangles[order], renumbered[across[order]])


def _circle_at_most(widest_m: float, sites: Sites, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of circles through the corners of at most this width; a degenerate triangle has none."""
    x, y = (v[triangles.T] for v in sites.local_m())
    dx, dy = (np.roll(v, -1, axis=0) - v for v in (x, y))
    twice_area = dx[0] * dy[1] - dy[0] * dx[1]
    sides = np.prod(dx * dx + dy * dy, axis=0)
    small: npt.NDArray[np.bool_] = (twice_area > 0.0) & (sides <= (widest_m * twice_area) ** 2)
    return small


def _paired(triangles: npt.NDArray[np.int64], across: npt.NDArray[np.int64]) -> Triangulation:
    """Returns, in the triangle across each edge, the corner opposite it: the one before the edge's end there."""
    end = np.roll(triangles, 1, axis=1)
    same = triangles[across] == end[:, :, None]
    opposite = 3 * across + (np.argmax(same, axis=2) + 2) % 3
    return Triangulation(triangles, np.where(across < 0, -1, opposite))


def _qhull(sites: Sites) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """Returns triangles and neighbours from Qhull; None where all points are collinear."""
    from scipy.spatial import Delaunay, QhullError

    if len(sites) < 3:
        return None
    places = np.stack(sites.local_m(), axis=1) + _nudges(sites)
    places -= places.mean(axis=0)
    try:
        found = Delaunay(places)
    except QhullError:  # all on a line
        return None
    return found.simplices.astype(np.int64), found.neighbors.astype(np.int64)


def _nudges(sites: Sites) -> npt.NDArray[np.float64]:
    """Returns moves (m, 2) (m) within ± NUDGE_M that depend on the position alone."""
    with np.errstate(over="ignore"):
        word = sites.x_steps.view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        word = (word ^ (word >> np.uint64(29)) ^ sites.y_steps.view(np.uint64)) * np.uint64(0xBF58476D1CE4E5B9)
        word = (word ^ (word >> np.uint64(32))) * np.uint64(0x94D049BB133111EB)
    parts = np.stack([word >> np.uint64(32), word & np.uint64(0xFFFFFFFF)], axis=1).astype(np.float64)
    return (parts * 2.0**-31 - 1.0) * NUDGE_M
