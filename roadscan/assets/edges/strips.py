"""Areas beside a line: runs of its nodes with a width, as polygons with their figures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage
import scipy.spatial
import shapely

from roadscan.assets.edges.line_pieces import Line
from roadscan.compute.array_types import Float64
from roadscan.compute.robust import scatter_about
from roadscan.compute.ways import way_along

MEDIAN_NODES: Final = 5
"""A width is the median of this many nodes, so that a pole or a tree does not end a strip."""
HOLE_NODES: Final = 14
"""Longest run of nodes without a width that is bridged within a strip: a car may stand there."""


class Strip(NamedTuple):
    """A run of nodes of a line, and the width behind each."""

    line: Line
    width_m: Float64
    known: npt.NDArray[np.bool_]
    """(n,) nodes whose width was seen."""

    @property
    def length_m(self) -> float:
        """Returns the length along the line."""
        return self.line.length_m

    def column(self, name: str) -> Float64:
        """Returns a column (n,) of its nodes."""
        return self.line.column(name)

    def mean(self, values: Float64) -> float | None:
        """Returns the mean of known values (n,); None where there is none."""
        good = self.known & np.isfinite(values)
        return float(np.median(values[good])) if good.any() else None


def strips_of(line: Line, usable: npt.NDArray[np.bool_], least_m: float, shortest_m: float) -> Iterator[Strip]:
    """Yields runs of the usable nodes (n,) of a line with columns of `BESIDE_PIECES`, at least `shortest_m` long.

    least_m : least width of the surface behind the line (m).
    """
    width = line.column("width_m")
    at = np.flatnonzero(usable & np.isfinite(width))
    if at.size < 2:
        return
    level = scipy.ndimage.median_filter(width[at], MEDIAN_NODES, mode="nearest")
    smooth = np.interp(np.arange(len(width)), at, level)
    known = np.zeros(len(width), np.bool_)
    known[at[level >= least_m]] = True
    whole = scipy.ndimage.binary_closing(np.pad(known, HOLE_NODES), np.ones(HOLE_NODES + 1))[HOLE_NODES:-HOLE_NODES]
    number, count = scipy.ndimage.label(whole)
    for k in range(1, count + 1):
        rows = np.flatnonzero(number == k)
        if len(rows) < 2:
            continue
        part = Line(line.nodes[rows], line.seen_by, line.names)
        if part.length_m >= shortest_m:
            yield Strip(part, smooth[rows], known[rows])


def polygon_of(strip: Strip) -> shapely.Polygon | None:
    """Returns the polygon between the line and the end of the surface behind it, with heights; None if empty."""
    nodes = strip.line.nodes
    inner = nodes[:, :3]
    ux, uy = np.gradient(nodes[:, 0]), np.gradient(nodes[:, 1])
    length = np.maximum(np.hypot(ux, uy), 1e-9)
    x = nodes[:, 0] + strip.width_m * uy / length
    y = nodes[:, 1] - strip.width_m * ux / length
    height = strip.column("outer_height_m")
    return ribbon(inner, np.column_stack([x, y, np.where(np.isfinite(height), height, inner[:, 2])]))


def ribbon(inner: Float64, outer: Float64) -> shapely.Polygon | None:
    """Returns the polygon with heights between two lines (n, 3) of facing points; None where it has no area.

    It is the union of the quadrilaterals between neighbouring points, so that it does not fold at an inner corner.
    """
    corners = np.stack([inner[:-1, :2], inner[1:, :2], outer[1:, :2], outer[:-1, :2]], axis=1)
    pieces = shapely.convex_hull(shapely.multipoints(list(corners)))
    # 5 mm more, so that neighbours meet in spite of rounding
    whole = shapely.union_all(shapely.buffer(pieces, 0.005, join_style="mitre"))
    parts = [g for g in getattr(whole, "geoms", [whole]) if g.geom_type == "Polygon" and g.area > 0.0]
    if not parts:
        return None
    ring = shapely.get_coordinates(shapely.simplify(max(parts, key=lambda g: g.area).exterior, 0.02))
    known = np.concatenate([inner, outer])
    nearest = scipy.spatial.cKDTree(known[:, :2]).query(ring)[1]
    return shapely.Polygon(np.column_stack([ring, known[nearest, 2]]))


def running_slope(strip: Strip, over_m: float = 2.0) -> float | None:
    """Returns the greatest slope (m/m, up or down) along the middle of a strip over 2 m, of smoothed heights."""
    height = strip.column("middle_height_m")
    length = way_along(strip.line.nodes)
    good = strip.known & np.isfinite(height)
    if good.sum() < 3 or length[-1] < over_m:
        return None
    at = np.arange(0.0, length[-1], over_m / 4)
    level = scipy.ndimage.uniform_filter1d(np.interp(at, length[good], height[good]), 4, mode="nearest")
    slope = (level[4:] - level[:-4]) / over_m if len(level) > 4 else np.zeros(0)
    if not slope.size:
        return None
    return float(np.abs(slope).max())


def sigma_width_m(strip: Strip) -> float:
    """Returns the standard deviation (m) of the strip's outer edge, from differences of neighbouring widths.

    It is 15 cm at least: cells shared with a wall do not belong to the strip.
    """
    width = strip.column("width_m")[strip.known]
    if width.size < 3:
        return 0.3
    return math.hypot(0.15, scatter_about(np.diff(width), 0.0) / math.sqrt(2.0))
