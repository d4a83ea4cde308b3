"""Slopes of the surface at the sites: the normals of the detailed model.

Around each site a polynomial that passes through it is fitted to its neighbours by least squares, and its derivatives
at the site are taken (Yu, Sukumar, Koschan, Page & Abidi, *3D reconstruction of road surfaces using an integrated
multi-sensory approach*, Optics and Lasers in Engineering 45 (2007), eq. 5 and 6). Neighbours are sites joined by edges
of kept triangles, so a slope never looks across a hole. Two kinds:

``quadratic``
    The paper's: five terms, all neighbours alike; one ring of neighbours, at least six. Calm where heights are noisy:
    noise of σ gives slopes of about 1.0 σ over the spacing of points.
``cubic``
    Nine terms, of which the four cubic ones are damped; two rings, at least 15 neighbours, near ones count most.
    Follows the ground several times more closely (on Franke's function with 1,000 points, the error is a quarter of the
    quadratic's), and gives slopes of about 3.7 σ over the spacing. Not for noisy profiles that lie more than ten times
    farther apart than their points.

Both are exact where the heights are a quadratic polynomial.

Conditioning: offsets are counted from the site and whitened by their own mean square, so stretched meshes are as well
conditioned as square ones; the normal matrix is scaled to a unit diagonal and refused where a pivot falls below 0.01.
Another ring is taken, up to the fourth, while neighbours are too few, refused, or *narrow*: spread eight times less
across than along, so that the scatter of one profile would pass for the slope across it. After the fourth ring narrow
neighbours have to do. Where they are refused still, a plane is fitted to them; where they lie on a line (or there are
none) the slope is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels.vertex_gradients import CUBIC_TERMS, MOST_RINGS, QUADRATIC_TERMS, vertex_gradients
from roadscan.model.surface import SlopeKind
from roadscan.surfaces.sites import Sites
from roadscan.surfaces.triangulation import Triangulation

RINGS: Final = MOST_RINGS
"""Farthest neighbours that a slope depends on, in edges."""
_NEIGHBOURHOODS: Final = {"quadratic": (QUADRATIC_TERMS, 1, 6), "cubic": (CUBIC_TERMS, 2, 15)}
"""Terms, rings, least number of neighbours."""


@dataclass(frozen=True)
class Slopes:
    """Slopes at sites."""

    slopes: npt.NDArray[np.float64]
    """(m, 2) along easting and northing (m/m)."""
    sources: npt.NDArray[np.uint8]
    """(m,) FITTED, PLANE or LEVEL of ``kernels.vertex_gradients``."""


def slopes_at(sites: Sites, mesh: Triangulation, kind: SlopeKind) -> Slopes:
    """Slopes at all sites; zero at those without a triangle."""
    terms, rings, least = _NEIGHBOURHOODS[kind]
    starts, neighbours = mesh.neighbours(len(sites))
    slopes, sources = np.empty((len(sites), 2)), np.empty(len(sites), np.uint8)
    x, y = sites.local_m()
    vertex_gradients(x, y, sites.height_m, starts, neighbours, terms, rings, least, slopes, sources)
    return Slopes(slopes, sources)
