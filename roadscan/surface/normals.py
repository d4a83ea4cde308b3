"""Slopes of the surface at the sites: the normals of the detailed model.

Neighbours are sites joined by edges of kept triangles, so a slope never looks across a hole. Two kinds:

``quadratic``
    The paper's (Yu, Sukumar, Koschan, Page & Abidi, *3D reconstruction of road surfaces using an integrated
    multi-sensory approach*, Optics and Lasers in Engineering 45 (2007), eq. 5 and 6): a quadratic polynomial that
    passes through the site is fitted by least squares to one ring of neighbours, at least six, all alike.
``cubic``
    Good enough for cubic triangles: the slope of a smoothing spline over two rings, at least 20 neighbours (Wahba,
    *Spline models for observational data*, SIAM 1990, chapters 1 and 4). Heights are z = p + s + noise, with p a
    quadratic polynomial that is not penalised, and s of a covariance that falls with distance⁵, as that of a quintic
    spline (r⁵; Duchon 1977), written as Wendland's C⁴ function of a reach of 12 units, which is positive definite.
    The heights determine the share of noise: of two variances, one almost zero (0.001) and one that leaves
    little more than the polynomial (3), each counts by the restricted likelihood that it gives the heights of the
    neighbourhood (generalised maximum likelihood, Wahba 1985, Annals of Statistics 13, 1378-1402).

Both are exact where the heights are a quadratic polynomial. On Franke's function the error with ``cubic`` is a seventh
of that with ``quadratic`` for 1,000 points, and smaller than that of SciPy's `CloughTocher2DInterpolator` (which
minimises curvature along edges; Nielson 1983, Renka 1984) on each of 40 sets of 100 to 10,000 random points. Of noise
it makes smaller slopes, too: half of those of ``quadratic``.

The unit of length is the root mean square offset of two rings along each axis, the same in all directions. Where a
neighbourhood is more than three times longer than wide (profiles far apart), its length is counted in larger units by
what is beyond three.

Conditioning, ``quadratic``: offsets are counted from the site and whitened by their mean square, so stretched
meshes are as well conditioned as square ones; the normal matrix is scaled to a unit diagonal and refused where a pivot
falls below 0.01. ``cubic``: the same for the polynomial's normal matrix, weighted by the inverse covariance.
Another ring is taken, up to the fourth, while neighbours are too few, refused (``quadratic``), or *narrow*: spread
eight times less across than along, so that the scatter of one profile would pass for the slope across it. After the
fourth ring narrow neighbours have to do. Of more than 32 neighbours a spline takes the nearest (whitened). What
``cubic`` refuses, and sites with fewer than ten neighbours, are left to ``quadratic``; what that refuses gets a plane;
and where neighbours lie on a line (or there are none) the slope is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.surface.kernels.delaunay import MOST, MOST_RINGS, neighbourhoods
from roadscan.surface.kernels.spline_gradients import FITTED, LEVEL, WORK, spline_gradients, vertex_gradients
from roadscan.surface.settings import SlopeKind
from roadscan.surface.triangulation import Sites, Triangulation

RINGS: Final = MOST_RINGS
"""Greatest distance of a neighbour on which a slope depends, in edges."""
_TOGETHER: Final = 4096
"""Sites whose neighbourhoods are in memory at a time."""


@dataclass(frozen=True)
class Slopes:
    """Slopes at sites."""

    slopes: npt.NDArray[np.float64]
    """(m, 2) along easting and northing (m/m)."""
    sources: npt.NDArray[np.uint8]
    """(m,) FITTED, PLANE or LEVEL of ``kernels.surface.vertex_gradients``."""


def slopes_at(sites: Sites, mesh: Triangulation, kind: SlopeKind) -> Slopes:
    """Returns slopes at all sites; zero at those without a triangle."""
    starts, neighbours = mesh.neighbours(len(sites))
    slopes, sources = np.zeros((len(sites), 2)), np.full(len(sites), LEVEL, np.uint8)
    if kind == "cubic":
        _splines(sites, starts, neighbours, slopes, sources)
    x, y = sites.local_m()
    vertex_gradients(x, y, sites.height_m, starts, neighbours, np.flatnonzero(sources != FITTED), slopes, sources)
    return Slopes(slopes, sources)


def _splines(
    sites: Sites,
    starts: npt.NDArray[np.int64],
    neighbours: npt.NDArray[np.int64],
    slopes: npt.NDArray[np.float64],
    sources: npt.NDArray[np.uint8],
) -> None:
    """Compute slopes of splines where the neighbours determine one."""
    x, y = sites.local_m()
    ring, seen = np.empty(len(sites) + 1, np.int64), np.full(len(sites), -1)
    work = np.empty(math.prod(WORK) + 8)  # aligned to 64 bytes, so that one register is one cache line
    work = work[-work.ctypes.data % 64 // 8 :][: math.prod(WORK)].reshape(WORK)
    for first in range(0, len(sites), _TOGETHER):
        many = min(_TOGETHER, len(sites) - first)
        members, counts, axes = np.empty((many, MOST), np.int64), np.empty(many, np.int64), np.empty((many, 3))
        neighbourhoods(x, y, starts, neighbours, first, ring, seen, members, counts, axes)
        order = np.argsort(counts, kind="stable")
        order = order[counts[order] > 0]
        spline_gradients(x, y, sites.height_m, first, order, members, counts, axes, work, FITTED, slopes, sources)
