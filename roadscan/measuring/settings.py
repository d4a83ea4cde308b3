"""Settings of pictures with their places (section ``[pictures]`` of the survey file)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from roadscan.core.survey import SurveySection


class PicturesConfig(SurveySection):
    """The layer of pictures with their places."""

    table: ClassVar[str] = "pictures"
    meaning: ClassVar[str] = "The layer of pictures with their places; made where the rig has a camera."

    on: bool = True
    """Whether the layer is made."""
    footprint_reach_m: float = Field(default=30.0, gt=1.0, le=200.0)
    """Footprints end at this distance from the camera, on the map (m)."""
