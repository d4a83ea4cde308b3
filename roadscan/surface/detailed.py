"""Detailed model: a smooth surface through every point of a region, evaluated on a fine grid.

Stages, each a module: ``sites`` (order, duplicates), ``triangulation`` (Delaunay, holes left open), ``normals``
(slopes), ``clough_tocher`` (cubic triangles, and their heights on a grid).

Seams: a height depends on points within :attr:`DetailedSettings.halo_m` only. Two regions that both hold all points
within that distance of a node give it the same height, to the bit, whatever else they hold and in whatever order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.surface.settings import SlopeKind
from roadscan.surface.sites import sites
from roadscan.surface.triangulation import triangulate
from roadscan.surface.window import GridWindow

if TYPE_CHECKING:
    from roadscan.surface.clough_tocher import CubicSurface


class DetailedSettings(Strict):
    """How the detailed model is made."""

    max_gap_m: float = Field(default=0.3, gt=0.0, le=100.0)
    """Widest hole that is bridged: no surface is made where a disc of this diameter holds no point."""
    slopes: SlopeKind = "cubic"
    """`cubic` follows the ground as closely as the heights' noise allows; `quadratic` is the paper's."""

    @property
    def halo_m(self) -> float:
        """Returns the distance within which all points must be given for a height to be final (m).

        A node's triangle and those beside it reach 2 gaps from it, the neighbours of their corners a gap a ring, and
        the circles that decide about the last ring are counted in that ring.
        """
        from roadscan.surface.normals import RINGS

        return (2 + RINGS) * self.max_gap_m


def surface_through(points_m: npt.NDArray[np.float64], settings: DetailedSettings) -> CubicSurface:
    """Returns the surface through points (n, 3): easting, northing, height (m, map frame), in any order.

    Points at one place (to 10 µm) are merged to their mean height. Without three points that are not on a line the
    surface has no triangles.

    Raises
    ------
    RoadscanError
        Where a coordinate is not finite.
    """
    from roadscan.surface.clough_tocher import cubic_surface
    from roadscan.surface.normals import slopes_at

    places = sites(points_m)
    mesh = triangulate(places, settings.max_gap_m)
    return cubic_surface(places, mesh, slopes_at(places, mesh, settings.slopes).slopes)


def detailed_surface(
    points_m: npt.NDArray[np.float64], window: GridWindow, settings: DetailedSettings
) -> npt.NDArray[np.float64]:
    """Heights (rows, columns) of a window's nodes (m, map frame), south row first, NaN where there is no surface.

    Parameters
    ----------
    points_m : (n, 3) easting, northing, height (m, map frame), in any order: those of the window and of its halo
        (:attr:`DetailedSettings.halo_m`), or all there are.

    Raises
    ------
    RoadscanError
        Where a coordinate is not finite.
    """
    return surface_through(points_m, settings).heights(window)
