"""Structures of georeferencing: readings, the geometry that georeferences them, and the points that are written.

    p_world = t + R_world←body · (R_body←sensor · p_sensor + l_body)
    map     = chart(p_world)

Map coordinates leave as whole quanta (10 µm).

Map coordinates of world positions from local expansions of the map projection.

A chart is the second-order expansion of the map about the centre of a small box of world space (see
``roadscan.georeference.charts``). The box is chosen by the pose, so a point never depends on which other readings were
computed with it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare_inlined, inlined
from roadscan.poses.kernels.poses import PoseIntervals


class Charts(NamedTuple):
    """Charts of the boxes that a trajectory passes."""

    lattice: tuple[float, ...]
    """(4,) edge of a box (m), and the indices of the first box along the world's x, y and z."""
    table: npt.NDArray[np.int32]
    """(nx, ny, nz) chart of each box, its indices modulo the shape; −1 where none was made."""
    centres_world_m: npt.NDArray[np.float64]
    """(c, 3) centres of the boxes."""
    coefficients: npt.NDArray[np.float64]
    """(c, 3, 10) of easting, northing and height (m): of 1, x, y, z, xx, xy, xz, yy, yz, zz from the centre (m)."""


@inlined
def box_of(px, py, pz, lattice):
    """Return the indices of the box that contains a world position (m); lattice: see :class:`Charts`."""
    return (
        np.int64(math.floor(px / lattice[0]) - lattice[1]),
        np.int64(math.floor(py / lattice[0]) - lattice[2]),
        np.int64(math.floor(pz / lattice[0]) - lattice[3]),
    )


@inlined
def chart_index(box, lattice, table, centres):
    """Return the chart of a box, −1 where there is none; lattice, table, centres: see :class:`Charts`."""
    x, y, z = box
    chart = table[x % table.shape[0], y % table.shape[1], z % table.shape[2]]
    if chart < 0:
        return chart
    edge = lattice[0]
    own = (
        abs((x + lattice[1] + 0.5) * edge - centres[chart, 0]) <= 0.5 * edge
        and abs((y + lattice[2] + 0.5) * edge - centres[chart, 1]) <= 0.5 * edge
        and abs((z + lattice[3] + 0.5) * edge - centres[chart, 2]) <= 0.5 * edge
    )
    return chart if own else np.int32(-1)


@inlined
def expansion(coefficients, k, a):
    """Return the coefficients of map coordinate `a` in chart `k` as a tuple; coefficients: see :class:`Charts`."""
    c = coefficients
    return (
        c[k, a, 0], c[k, a, 1], c[k, a, 2], c[k, a, 3], c[k, a, 4],
        c[k, a, 5], c[k, a, 6], c[k, a, 7], c[k, a, 8], c[k, a, 9],
    )  # fmt: skip


@inlined
def map_value(c, dx, dy, dz):
    """Return a map coordinate (m) at an offset (m) from the chart's centre, from its expansion `c`."""
    return (
        c[0]
        + dx * (c[1] + c[4] * dx + c[5] * dy + c[6] * dz)
        + dy * (c[2] + c[7] * dy + c[8] * dz)
        + dz * (c[3] + c[9] * dz)
    )


KEPT, NO_POSE, RANGE, HEIGHT, OUTSIDE, NO_RETURN = 0, 1, 2, 3, 4, 5
"""Outcomes of a reading: indices of the kernels' `fates` counters."""
FATES = 6  # Number of these counters.

CLASS_KEPT, CLASS_NO_RETURN, CLASS_NO_POSE, CLASS_TOO_NEAR, CLASS_TOO_FAR, CLASS_TOO_LOW, CLASS_TOO_HIGH = range(7)
"""Classes of a reading; a reading outside the window has only an outcome."""


class Limits(NamedTuple):
    """Limits of the readings that are kept (m); infinite where there is no limit."""

    range_min_m: float
    range_max_m: float
    height_min_m: float
    """Limits of heights on the map."""
    height_max_m: float
    above_body_min_m: float
    """Limits of heights above the body's origin."""
    above_body_max_m: float


class Georeference(NamedTuple):
    """The geometry that georeferences the readings of one sensor."""

    mounting: tuple[float, ...]
    """(12,) body from sensor, row by row, then the lever arm in body axes (m)."""
    poses: PoseIntervals
    charts: Charts
    limits: Limits
    quanta_per_m: float


class Returns(NamedTuple):
    """Readings with an epoch and a position each."""

    epochs: npt.NDArray[np.int64]
    """(n,) GPS ns of the pose that places each; ascending is fastest."""
    x: npt.NDArray[np.floating]
    """(n,) sensor frame, m; y and z alike."""
    y: npt.NDArray[np.floating]
    z: npt.NDArray[np.floating]


class MirrorProfiles(NamedTuple):
    """Profiles of a rotating mirror, which takes one reading after another."""

    epochs: npt.NDArray[np.int64]
    """(n,) GPS ns of each profile's first reading."""
    ranges: npt.NDArray[np.uint16]
    """(n, m) raw, 0 no return."""
    origins: npt.NDArray[np.float64]
    """(m, 3) of the rays, sensor frame, m; x is 0 (``ScanGeometry.rays``)."""
    directions: npt.NDArray[np.float64]
    """(m, 3) unit vectors, sensor frame; x is 0."""
    scale: tuple[float, float]
    """Range of a raw 0 and step between raw ranges (m)."""
    reading_period_ns: float
    """From one reading of a profile to the next."""


class Georeferenced(NamedTuple):
    """Map positions of readings, written by kernels."""

    east: npt.NDArray[np.float64]
    """(n,) whole quanta, floor(metres · quanta_per_m + ½); undefined where the class is not CLASS_KEPT."""
    north: npt.NDArray[np.float64]
    """(n,) likewise."""
    height: npt.NDArray[np.float64]
    """(n,) likewise."""
    classes: npt.NDArray[np.uint8]
    """(n,) CLASS_KEPT, or why the reading is left out."""
    intervals: npt.NDArray[np.int32]
    """(n,) interval of the trajectory, −1 outside it."""


class Window(NamedTuple):
    """The range of tiles whose points are requested."""

    tile_quanta: int
    """Edge of a tile."""
    tiles: tuple[int, int, int, int]
    """First column, first row, end column, end row; ends exclusive."""


class Points(NamedTuple):
    """Points of the readings that are kept and lie in the window, appended by kernels."""

    rows: npt.NDArray[np.int32]
    """(n,) index of the return, or of the profile."""
    readings: npt.NDArray[np.int32]
    """(n,) index in the profile; not written for returns."""
    tiles: npt.NDArray[np.int32]
    """(n, 2) column and row."""
    quanta: npt.NDArray[np.int32]
    """(n, 3) x and y from the tile's south-west corner, and height."""
    fates: npt.NDArray[np.int64]
    """(≥ FATES,) in/out, counts of all readings by fate."""
    classes: npt.NDArray[np.uint8]
    """(n,) class of every reading, kept or not; (0,) where not requested."""


@inlined
def tile_and_rest(quanta, tile_quanta):
    """Return the tile number of a coordinate (quanta, int64), and its quanta from the tile's edge.

    A floored division without the slow instruction: multiply, then correct the last unit.
    """
    tile = np.int64(math.floor(quanta * (1.0 / tile_quanta)))
    rest = quanta - tile * tile_quanta
    if rest < 0:
        tile -= 1
        rest += tile_quanta
    elif rest >= tile_quanta:
        tile += 1
        rest -= tile_quanta
    return tile, rest


@inlined
def is_wanted(column, row, tiles):
    """Return True for a tile inside a window; tiles: see :class:`Window`."""
    return tiles[0] <= column < tiles[2] and tiles[1] <= row < tiles[3]


@bare_inlined
def write_point(made, row, column_and_x, row_and_y, height, out):
    """Write point number `made` of the reading `row`; tile number and rest of either coordinate as tuples (quanta)."""
    out.rows[made] = row
    out.tiles[made, 0], out.quanta[made, 0] = column_and_x
    out.tiles[made, 1], out.quanta[made, 1] = row_and_y
    out.quanta[made, 2] = height
