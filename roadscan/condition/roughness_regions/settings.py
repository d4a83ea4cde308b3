"""Settings of roughness regions (section ``[condition.roughness_regions]`` of the survey file)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from roadscan.core.strict import Strict


class RoughnessRegionsConfig(Strict):
    """How dim regions of the road's surface are found, and which of them are reported."""

    sensor_height_m: float | None = Field(default=None, ge=0.3, le=10.0)
    """Height of the lidar above the road (m), where its intensities fall with range and incidence: they are normalised
    as for beams from this height above the middle of the nearest lane. Left out, they are taken as they are."""
    road: Literal["lanes", "all"] = "lanes"
    """What is looked at of a section: its lanes, or all that has cells."""
    cell_m: float = Field(default=0.06, ge=0.01, le=0.5)
    """Edge of the cells of the intensity raster (m): about the points' distance from one another."""
    section_m: float = Field(default=10.0, ge=5.0, le=20.0)
    """Length of a section with thresholds of its own (m); sections begin at the multiples of it."""
    width_m: float = Field(default=30.0, ge=3.0, le=60.0)
    """Width of a section, half to each side of the reference line (m)."""
    largest_gap_m: float = Field(default=0.3, ge=0.0, le=5.0)
    """Raster cells farther than this from every point are left out (m)."""
    clip_share: float = Field(default=0.001, ge=0.0, le=0.1)
    """Share of the raster's cells at each end of the intensities that the 8-bit scale clips; 0 takes the least and the
    greatest intensity."""
    closing_cells: int = Field(default=3, ge=1, le=31)
    """Edge of the square of cells that closes the raster."""
    least_area_m2: float = Field(default=0.1, ge=0.0)
    """Smaller regions are left out (m²)."""
    least_density_per_m2: float = Field(default=25.0, ge=0.0)
    """Regions with fewer readings to a square metre are left out (t_d)."""
    largest_height_sigma_m: float = Field(default=0.2, gt=0.0)
    """Regions whose points lie farther than this from the section's road surface, as root mean square, are left out
    (t_sd, m): vehicles."""
    least_contrast: float = Field(default=0.15, ge=0.0, le=1.0)
    """Share by which a region's median intensity has to be lower than that of the road around it; 0 takes every
    region."""
    around_m: float = Field(default=0.5, ge=0.1, le=5.0)
    """Width of the ring of road around a region that its intensity and its heights are compared with (m)."""
