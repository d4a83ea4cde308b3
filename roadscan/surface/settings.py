"""Settings of the reconstruction of the road's surface (section ``[surface]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.survey import SurveySection
from roadscan.surface.region_settings import RegionSettings
from roadscan.surface.smoothing_settings import SmoothingWeights, SurfaceSmoothing

SlopeKind = Literal["quadratic", "cubic"]
"""How the slopes of the detailed model are found."""


class SurfaceConfig(SurveySection):
    """How the road's surface is reconstructed, tile by tile. Without this section it is not."""

    table: ClassVar[str] = "surface"
    meaning: ClassVar[str] = "Reconstruction of the road's surface; left out, there is none. Needs the extra `opencv`."
    may_be_left_out: ClassVar[bool] = True

    method: Literal["cells", "points"]
    """`cells`: the robust heights of the tiles' cells are the grid (profilers: several readings a cell); `points`: a
    smooth surface through every reading, asked at the cells of a grid of its own (sparse sensors, such as a SICK)."""
    sigma_m: float = Field(gt=0.0, le=1.0)
    """1 σ of the noise of one cell's height (m). It decides what is a crack and what is noise: 0.0005 for a
    triangulation profiler, 0.006 for a SICK LMS; more where cells are finer than the readings are apart."""
    smooth: bool = True
    """Adaptive regularised smoothing; without it the surface is what was measured."""
    smoothing: SmoothingWeights = SmoothingWeights()
    """Its weights and thresholds; `sigma_m` is stated above."""
    cell_m: tuple[float, float] | None = None
    """`points`: edges of the grid's cells (m), east and north, such as [0.01, 0.03]; left out, `tiles.cell_m` both
    ways. The tiles' own cells are the grid of `cells`."""
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
