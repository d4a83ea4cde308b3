"""Settings of the road's condition (section ``[condition]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from roadscan.condition.road_edges.settings import RoadEdgesConfig
from roadscan.condition.roughness_regions.settings import RoughnessRegionsConfig
from roadscan.core.strict import NAME_PATTERN, Strict
from roadscan.core.survey import SurveySection


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
