"""Settings of bare earth (``[assets.ground]``)."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from roadscan.core.strict import Strict

_LARGEST_HOLE_M: Final = 10.0
"""Across holes that reach farther from seen ground (m), heights depend little on ground that lies farther away."""


class GroundSettings(Strict):
    """How returns on bare earth are told from all others."""

    method: Literal["morphological", "planes"] = "morphological"
    """The filter: "morphological" opens the surface of lowest returns with growing windows; "planes" fits planes to
    the returns again and again (RANSAC), each to what the planes before left over."""
    cell_m: float = Field(default=0.25, ge=0.05, le=2.0)
    """Edge of a cell of the bare-earth raster (m)."""
    steepest: float = Field(default=0.15, gt=0.0, le=1.0)
    """Slope of the terrain above which a step over a window's width counts as an object's (m/m)."""
    largest_object_m: float = Field(default=18.0, gt=0.0, le=100.0)
    """Greatest half-width of an object that stands on the ground (m)."""
    reach_m: float = Field(default=10.0, ge=0.0, le=1000.0)
    """How far from ground that was seen its height is interpolated; beyond, it is not known (m)."""

    @property
    def depends_on_m(self) -> float:
        """Returns how far away a return can change the ground at a place (m).

        An opening looks at disks that hold the place, and at all of each: twice the half-width of the largest object.
        The height of a hole depends on ground that was seen around it.
        """
        return 2.0 * self.largest_object_m + min(self.reach_m, _LARGEST_HOLE_M)
