"""Settings of the road's edges (section ``[condition.road_edges]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


class RoadEdgesConfig(Strict):
    """How the edges of the road's surface are found."""

    reach_m: float = Field(default=6.0, ge=0.5, le=30.0)
    """How far beyond the border of the outermost lane an edge is sought (m)."""
    largest_sigma_m: float = Field(default=0.3, ge=0.05, le=2.0)
    """Edges with a larger standard deviation are not told (m)."""
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
