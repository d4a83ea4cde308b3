"""Settings of the road's condition (section ``[condition]``), of its edges and of roughness regions."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import NAME_PATTERN, Strict
from roadscan.core.survey import SurveySection


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


class RoadEdgesConfig(Strict):
    """How the edges of the road's surface are found."""

    reach_m: float = Field(default=6.0, ge=0.5, le=30.0)
    """How far beyond the border of the outermost lane an edge is sought (m)."""
    largest_sigma_m: float = Field(default=0.3, ge=0.05, le=2.0)
    """Edges with a larger standard deviation are not given (m)."""
    polygons: Path | None = None
    """Layer of polygons (shapefile, GeoPackage, GeoJSON) that hold the road's surface, relative to the survey file; its
    borders are the edges, and none are sought in the readings."""
    polygons_crs: str | None = None
    """CRS of that layer, such as "EPSG:25832"; needed where it does not name its own."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.polygons_crs is not None and self.polygons is None:
            raise ValueError("polygons_crs belongs to a layer `polygons`")
        return self


class LaneConfig(Strict):
    """A lane that the survey file states, in place of those that the drives show."""

    name: str = Field(pattern=NAME_PATTERN)
    """Name of the lane, as the road authority has it."""
    road: str | None = None
    """Id of its road (`line_id` of the layer); left out, of every road."""
    offset_m: float
    """Offset of its middle from the reference line (m), positive to the right."""
    width_m: float = Field(gt=1.0, le=20.0)
    """Its width (m)."""
    direction: Literal["forward", "backward"] = "forward"
    """Direction of travel: that of the reference line, or against it."""


class SectionConfig(Strict):
    """What the sections and values of condition are made of."""

    heights: Literal["cells", "surface"] = "cells"
    """Where heights come from: the tiles' cells; or the files of the product `surface`, the reconstructed surface on
    the same cells, with its small holes filled. Smoothing takes some of the roughness: with cells of 50 mm 2 % of an
    IRI of 2 m/km."""
    section_m: float = Field(default=100.0, ge=10.0, le=10_000.0)
    """Length of a section (m), such as 100 or 160.9344 (0.1 mile); sections begin at its multiples."""
    profile_spacing_m: float = Field(default=0.05, ge=0.005, le=0.25)
    """Distance between the heights of a longitudinal profile (m)."""
    wheel_paths_m: float = Field(default=0.85, ge=0.5, le=1.2)
    """Offset of the wheel paths from the lane's middle (m), to both sides; 0.75 to 0.9 m are common."""
    wheel_path_width_m: float = Field(default=0.1, ge=0.01, le=0.6)
    """Width over which a longitudinal profile is smoothed (m), with weights that fall to both sides; at least three
    cells."""
    cross_section_spacing_m: float = Field(default=0.5, ge=0.1, le=100.0)
    """Distance between cross-sections along the road (m)."""
    cross_section_step_m: float = Field(default=0.025, ge=0.005, le=0.2)
    """Distance between the heights of a cross-section (m)."""
    lane_width_m: float = Field(default=3.5, ge=2.0, le=6.0)
    """Width of lanes whose width nothing states (m)."""
    largest_gap_m: float = Field(default=0.5, ge=0.0, le=5.0)
    """Widest gap of a profile that is bridged by a straight line (m); a section with a wider one has no roughness."""
    joint_spacing_m: float | None = Field(default=None, gt=1.0, le=100.0)
    """Distance from joint to joint of concrete slabs along the reference line (m). With it the faulting of all joints
    is measured, also of level ones; without it that of joints with a crack or a step."""
    joint_station_m: float | None = None
    """Station of one of these joints (m); left out, where cracks and steps show them."""
    least_share: float = Field(default=0.9, ge=0.0, le=1.0)
    """Share of a cross-section's heights, or of a section's cross-sections, that have to be measured."""


class ConditionConfig(SectionConfig, SurveySection):
    """The road's condition along its lanes. Without this section no condition is computed."""

    table: ClassVar[str] = "condition"
    meaning: ClassVar[str] = "The road's condition along its lanes; left out, none is computed."
    may_be_left_out: ClassVar[bool] = True

    reference: Literal["drive", "layer"] = "drive"
    """Reference lines: the first drive over each piece of road, smoothed; or the lines of `layer`."""
    layer: Path | None = None
    """Layer of lines (shapefile, GeoPackage, GeoJSON), relative to the survey file; each line that was driven is a
    road."""
    layer_crs: str | None = None
    """CRS of the layer, such as "EPSG:25832"; needed where the layer does not name its own."""
    layer_options: dict[str, Any] = {}
    """Settings of the layer (`roadscan formats road_lines`): attributes with the lines' ids and names, and with the
    measures at their ends (`measure_from_column`, `measure_to_column`)."""
    lanes: list[LaneConfig] = []
    """Lanes; left out, those that were driven: the vehicle's way is the middle of its lane."""
    same_road_m: float = Field(default=12.0, ge=1.0, le=50.0)
    """A drive this near to a reference line and in its direction, or against it, is on that line's road (m)."""
    smoothing_m: float = Field(default=20.0, ge=2.0, le=200.0)
    """Length over which the reference lines are smoothed (m)."""
    lane_smoothing_m: float = Field(default=100.0, ge=2.0, le=1000.0)
    """Length over which the middle of a driven lane is smoothed (m)."""

    road_edges: RoadEdgesConfig | None = None
    """Edges of the road's surface, by the readings or by polygons; left out, none are sought."""
    roughness_regions: RoughnessRegionsConfig | None = None
    """Dim regions of the road's surface (utility cuts, patches, worn places), section by section; left out, none. Needs
    the extra `opencv`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.reference == "layer") != (self.layer is not None):
            raise ValueError('reference = "layer" and the path `layer` belong together')
        names = [(lane.road, lane.name) for lane in self.lanes]
        if len(set(names)) < len(names):
            raise ValueError("two lanes of one road have the same name")
        return self

    def sections(self) -> SectionConfig:
        """What shapes values once the lines are known."""
        return SectionConfig(**{name: getattr(self, name) for name in SectionConfig.model_fields})
