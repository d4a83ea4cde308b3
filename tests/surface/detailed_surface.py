"""The surface through points in one call, as the stage's tiles make it of their points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.surface.clough_tocher import CubicSurface, cubic_surface
from roadscan.surface.normals import slopes_at
from roadscan.surface.reconstruction import DetailedSettings
from roadscan.surface.tile import GridWindow
from roadscan.surface.triangulation import sites, triangulate


def surface_through(points_m: npt.NDArray[np.float64], settings: DetailedSettings) -> CubicSurface:
    """Return the surface through points (n, 3): easting, northing, height (m, map frame), in any order."""
    places = sites(points_m)
    mesh = triangulate(places, settings.max_gap_m)
    return cubic_surface(places, mesh, slopes_at(places, mesh, settings.slopes).slopes)


def detailed_surface(
    points_m: npt.NDArray[np.float64], window: GridWindow, settings: DetailedSettings
) -> npt.NDArray[np.float64]:
    """Return heights (rows, columns) of a window's nodes (m, map frame), south row first, NaN where none is."""
    return surface_through(points_m, settings).heights(window)
