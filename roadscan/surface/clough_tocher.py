"""Piecewise cubic surface over triangles with continuous slopes: Clough–Tocher with cubic precision.

Each triangle is split at its centroid into three cubic Bézier triangles (Clough & Tocher 1965; Farin 1986). The paper
(section 3.2.3) gives heights of control points on the edges from slopes at the ends: a third of the way along an edge
from V1 to V2 the control point is z1 + ∇z1 · (V2 - V1) / 3 (eq. 7-9). What is left is one number an edge: the slope
across its middle. Foley & Opitz (1992) and Mann (1999) take it from the cubics of both adjacent triangles.

Let the corner a of a triangle lie at V1 + x e + y n, with e the edge, n the same turned left, and let M be the polar
form [V1, V2, n] of the surface, which sets the slope across the middle of the edge. If one cubic holds on both sides,
its control points next to the corner, [V1, a, a] and [V2, a, a], sum to

    [V1 + V2, p, p] + 2 y ((1 - x) [V1, V1, n] + x [V2, V2, n] + M) + y² [V1 + V2, n, n],      p = V1 + x e.

All terms are known from slopes but M and the last, so each triangle sees a value r = M + y [V1 + V2, n, n] / 2, and two
corners, at y and y' on either side, give

    M = (r y' - r' y) / (y' - y),

the two values interpolated to the edge. That is the condition of Foley & Opitz, freed of the choice of side: it
reproduces cubic polynomials, and since both triangles use the same M to the bit, the surface is C¹.

Where a corner lies much nearer to the edge than the other (four times), its r is a small difference over a small y:
noise in heights would be multiplied by 1 / 2y, and by the wide triangle's y once more. There M is solved, by least
squares, from two equations that a cubic through the wide triangle's corner meets exactly: the slope across the edge
given at the thin corner, and the condition above times the small y. Where the thin corner lies over an end of the edge
(on random points, beside one node in some hundred or fewer), it does not determine M, which is the mean of the
ends, exact for quadratics only.

An edge on the rim
has no other side; its triangle's inner control point is then the mean of those that its other edges ask for (which
keeps cubic precision), or that of a quadratic where it has no neighbour at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernels.patch_heights import POINTS
from roadscan.surface.kernels.clough_tocher import control_points, cross_slopes, evaluate
from roadscan.surface.tile import GridWindow
from roadscan.surface.triangulation import Sites, Triangulation, from_steps, steps

NOWHERE: Final = np.nan


@dataclass(frozen=True)
class CubicSurface:
    """A C¹ surface of cubic triangles."""

    sites: Sites
    mesh: Triangulation
    patches: npt.NDArray[np.float64]
    """(n, 19) heights of control points (m); ``kernels.surface.clough_tocher`` defines their order."""

    def heights(self, window: GridWindow) -> npt.NDArray[np.float64]:
        """Returns heights (rows, columns) (m) at the nodes of a window, south row first, NaN outside all triangles.

        A node on an edge belongs to the last triangle in the order of the sites, whatever else the region contains.
        """
        found = np.full((window.rows, window.columns), NOWHERE)
        if not found.size or not len(self.mesh):
            return found
        easting_m, northing_m = window.nodes_m()
        anchor = self.sites.anchor_steps
        node_x, node_y = from_steps(steps(easting_m) - anchor[0]), from_steps(steps(northing_m) - anchor[1])
        x, y = self.sites.local_m()
        cell = (window.cell_east_m, window.cell_north_m)
        evaluate(x, y, self.mesh.triangles, self.patches, node_x, node_y, *cell, found)
        return found


def cubic_surface(sites: Sites, mesh: Triangulation, slopes: npt.NDArray[np.float64]) -> CubicSurface:
    """Returns the surface through sites with given slopes.

    Parameters
    ----------
    slopes : (m, 2) along easting and northing (m/m).
    """
    x, y = sites.local_m()
    halves, patches = np.empty((len(mesh), 3, 3)), np.empty((len(mesh), POINTS))
    cross_slopes(x, y, sites.height_m, slopes, mesh.triangles, halves)
    control_points(x, y, sites.height_m, slopes, mesh.triangles, mesh.opposite, halves, patches)
    return CubicSurface(sites, mesh, patches)
