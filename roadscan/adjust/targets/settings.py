"""Settings of the search for control targets: one set for all of a survey."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class TargetSettings(Strict):
    """How control targets are found, and what a find has to show."""

    search_radius_m: float = Field(default=0.75, gt=0.0, le=5.0)
    """Targets are looked for within this of their stated place (m)."""
    least_likeness: float = Field(default=0.35, gt=0.0, lt=1.0)
    """Normalised correlation of a place with the shape, from which on it is a candidate."""
    most_candidates: int = Field(default=8, ge=2, le=32)
    """Candidates that are looked at, the likeliest first."""
    least_contrast: float = Field(default=3.0, gt=0.0)
    """Least contrast of paint against road, in standard deviations of single readings."""
    size_tolerance: float = Field(default=0.08, gt=0.0, le=0.5)
    """A shape larger or smaller than stated by more than this share is none."""
    least_paint: float = Field(default=0.5, gt=0.0, le=1.0)
    """Least share of the painted area that shows paint."""
    least_outline: float = Field(default=0.45, gt=0.0, le=1.0)
    """Least share of the outline that lies where the shape has it."""
    least_clear: float = Field(default=0.6, gt=0.0, le=1.0)
    """Least share of what is unpainted, around the shape and within it, that shows none."""
    moved_sigmas: float = Field(default=4.0, gt=0.0)
    """A target farther from its stated place than this many standard deviations is said to have moved."""
    sigma_paint_m: float = Field(default=0.0003, ge=0.0)
    """Standard deviation (m, each axis) by which a painted shape's middle misses the surveyed mark: stencil, edges."""
    height_radius_m: float = Field(default=0.15, gt=0.0, le=2.0)
    """Readings within this of a control point make the surface that its height is taken from (m)."""
    sigma_plane_m: float = Field(default=0.0002, ge=0.0)
    """Standard deviation (m) by which the road departs from that surface, which bends evenly."""
