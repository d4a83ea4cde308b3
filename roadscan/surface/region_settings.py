"""Settings of the search for regions of interest on the coarse model (``surface/regions.py``)."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class RegionSettings(Strict):
    """Settings of the search for regions of interest."""

    patch_m: float = Field(default=0.25, gt=0.0)
    """Edge of a patch, about (m): a whole number of steps of the coarse model."""
    level_patches: int = Field(default=5, ge=3)
    """Patches along the road whose plane is the street's level at the middle one; odd."""
    section_m: float = Field(default=50.0, gt=0.0)
    """Length of road whose median roughness is the street's own (m)."""
    factor: float = Field(default=2.5, gt=1.0)
    """How many times rougher than the street a patch of interest is."""
    least_m: float = Field(default=0.0015, ge=0.0)
    """Least roughness of a patch of interest (m, root mean square)."""
    join_m: float = Field(default=0.5, ge=0.0)
    """Patches this near to one another belong together (m)."""
    patches_min: int = Field(default=2, ge=1)
    """Fewest patches of a region."""
    pad_m: float = Field(default=0.25, ge=0.0)
    """What a region's box extends beyond its patches (m)."""
