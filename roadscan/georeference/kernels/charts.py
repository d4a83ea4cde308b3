"""Map coordinates of world positions from local expansions of the map projection.

A chart is the second-order expansion of the map about the centre of a small box of world space (see
``roadscan.georeference.charts``). The box is chosen by the pose, so a point never depends on which other readings were
computed with it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined


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
