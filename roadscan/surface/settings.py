"""Settings of the reconstruction of the road's surface (section ``[surface]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict
from roadscan.core.survey import SurveySection


class SmoothingWeights(Strict):
    """Weights and thresholds of ``surface/smoothing.py``; the weights are those of Yu et al. (2007), section 4."""

    curvature_weight: float = Field(default=50.0, ge=0.0, le=10_000.0)
    """λ_C, weight of the directional high-pass filters against the weight 1 of the measured heights."""
    median_weight: float = Field(default=30.0, gt=0.0, le=10_000.0)
    """λ_M, weight of the detail-preserving median against the weight 1 of the measured heights."""
    tolerance: float = Field(default=0.001, gt=0.0, lt=1.0)
    """The iteration ends where at most this share of the start's distance from the minimum can be left."""
    detail_sigmas: float = Field(default=4.0, gt=0.0)
    """A crack, edge or stone begins where medians along a line differ from the ground by this many of their σ …"""
    edge_sigmas: float = Field(default=2.5, gt=0.0)
    """… and goes on as long as they differ by this many."""
    outlier_sigmas: float = Field(default=4.0, gt=0.0)
    """A height farther than this many σ from the median has no weight of its own; "inf": all have (the paper)."""
    filter_sigmas: float = Field(default=0.5, gt=0.0)
    """A filter is off at a cell where it finds more than this many σ in the median: it would flatten a form."""


class SurfaceSmoothing(SmoothingWeights):
    """Weights and thresholds, and the noise that they are measured by."""

    sigma_m: float = Field(default=0.0005, gt=0.0, le=1.0)
    """1 σ of the noise of one cell's height (m): 0.0005 for a triangulation profiler, 0.006 for a SICK LMS."""
    independent: bool = True
    """Whether cells have noise of their own. Interpolated between readings they share it, so that lines of it pass for
    cracks: then no crack is looked for that single cells do not show."""


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


SlopeKind = Literal["quadratic", "cubic"]
"""How the slopes of the detailed model are found."""


class SurfaceConfig(SurveySection):
    """How the road's surface is reconstructed, tile by tile. Without this section it is not."""

    table: ClassVar[str] = "surface"
    meaning: ClassVar[str] = "Reconstruction of the road's surface; left out, there is none. Needs the extra `opencv`."
    may_be_left_out: ClassVar[bool] = True

    method: Literal["cells", "points"]
    """`cells`: the robust heights of the tiles' cells are the grid (profilers: several readings a cell); `points`: a
    smooth surface through every reading, asked at the cells of a separate grid (sparse sensors, such as a SICK)."""
    sigma_m: float = Field(gt=0.0, le=1.0)
    """1 σ of the noise of one cell's height (m). It decides what is a crack and what is noise: 0.0005 for a
    triangulation profiler, 0.006 for a SICK LMS; more where cells are finer than the readings are apart."""
    smooth: bool = True
    """Adaptive regularised smoothing; without it the surface is what was measured."""
    smoothing: SmoothingWeights = SmoothingWeights()
    """Its weights and thresholds; `sigma_m` is stated above."""
    cell_m: tuple[float, float] | None = None
    """`points`: edges of the grid's cells (m), east and north, such as [0.01, 0.03]; left out, `tiles.cell_m` both
    ways. The tiles' cells are the grid of `cells`."""
    max_gap_m: float = Field(default=0.3, gt=0.0, le=10.0)
    """`points`: widest hole that is bridged (m), at most half a tile's edge: no surface is made where a disc of this
    diameter holds no reading."""
    fill_m: float = Field(default=0.1, ge=0.0, le=1.0)
    """Widest hole that is filled (m), along the grid's rows or columns, by a straight line between its rims; such cells
    are marked as filled (origin 3). Water and glass give no reading. 0: holes stay open."""
    slopes: SlopeKind = "quadratic"
    """`points`: how the slope at a reading is found: `quadratic` is the paper's, `cubic` follows the ground as closely
    as the noise of the heights allows."""
    regions: Literal["everywhere", "polygons", "found"] = "everywhere"
    """`points`: where the surface is made: wherever there are readings; inside the polygons of a layer; or where the
    coarse model of the profiles varies in depth more than its street does."""
    search: RegionSettings = RegionSettings()
    """How such regions are found; of `regions = "found"`."""
    polygons: Path | None = None
    """Layer of polygons (GeoPackage, GeoJSON, shapefile), relative to the survey file."""
    polygons_crs: str | None = None
    """CRS of that layer, such as "EPSG:25832" or "local"; needed where it does not name its own."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.smooth and self.smoothing != SmoothingWeights():
            raise ValueError("smooth = false, and yet settings of the smoothing: leave one of them out")
        if self.method == "cells":
            for name in ("cell_m", "max_gap_m", "slopes", "regions", "search", "polygons", "polygons_crs"):
                if getattr(self, name) != type(self).model_fields[name].default:
                    raise ValueError(f'{name} is a setting of method = "points"')
        if self.cell_m is not None and not all(0.0005 <= edge <= 1.0 for edge in self.cell_m):
            raise ValueError(
                f"cells of {self.cell_m[0]:g} × {self.cell_m[1]:g} m: edges from 0.0005 to 1 m are expected"
            )
        if (self.regions == "polygons") != (self.polygons is not None):
            raise ValueError('regions = "polygons" and the layer `polygons` belong together')
        if self.regions != "found" and self.search != RegionSettings():
            raise ValueError('settings of the search, and yet regions = "found" is not asked for')
        return self

    def smoothing_settings(self) -> SurfaceSmoothing | None:
        """Returns the smoothing with its noise; None where it is off."""
        if not self.smooth:
            return None
        weights = self.smoothing.model_dump()
        return SurfaceSmoothing(sigma_m=self.sigma_m, independent=self.method == "cells", **weights)
