"""Settings of colours (section ``[colours]`` of the survey file)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.core.survey import SurveySection


class OrthophotoConfig(Strict):
    """The orthophoto of the road."""

    cell_m: float = Field(default=0.01, ge=0.005, le=0.1)
    """Edge of a pixel (m): 0.005 to 0.02 shows paint and patches. It divides the edge of a tile."""
    beside_m: float = Field(default=8.0, ge=1.0, le=50.0)
    """How far the picture reaches to both sides of the way of the cameras (m)."""
    reach_m: float = Field(default=15.0, ge=1.0, le=100.0)
    """Farthest distance from a camera to the road that it shows (m)."""
    least_angle_deg: float = Field(default=8.0, ge=1.0, le=80.0)
    """Least angle between the ray and the road (degrees): flatter views stretch a pixel too far."""
    ground_m: float = Field(default=0.25, ge=0.05, le=1.0)
    """Edge (m) of the cells from which the height of the road is taken; it divides the edge of a tile."""


class ColoursConfig(SurveySection):
    """Colours of the cameras' pictures for the points of the survey and for the road."""

    table: ClassVar[str] = "colours"
    meaning: ClassVar[str] = (
        "Coloured points and the orthophoto of the road; left out, none are made. Needs the extra `opencv`."
    )
    may_be_left_out: ClassVar[bool] = True

    cameras: list[str] = []
    """Cameras whose pictures give colours. Left empty, all that have an interior orientation."""
    points: bool = True
    """Write the points of each tile with their colours (LAZ, point format 7)."""
    orthophoto: OrthophotoConfig | None = None
    """The orthophoto of the road; left out, none is made."""
    reach_m: float = Field(default=40.0, ge=1.0, le=200.0)
    """Farthest distance from a camera to a point that gets its colour (m)."""
    seconds: float = Field(default=5.0, ge=0.05, le=60.0)
    """Points of the same run that were seen so long before or after a picture (s) tell what hides what in it."""
    moment_s: float = Field(default=0.06, ge=0.001, le=5.0)
    """Points that were seen so near to the instant of a picture (s) show where things that move were: half a turn of
    a lidar, and a little more."""
    grazing_deg: float = Field(default=3.0, ge=0.5, le=30.0)
    """Least angle (degrees) between a ray and a surface that is seen: a flatter one counts as hidden."""
    edge_px: float = Field(default=2.0, ge=0.0, le=50.0)
    """Points that are nearer to an edge in depth (pixels) get no colour from that picture."""
    border_px: int = Field(default=8, ge=1, le=500)
    """Width (pixels) of the border of a picture that is not used."""
    balance: bool = True
    """Balance exposure and white of the pictures of a run."""
    max_block_readings: int = Field(default=3_000_000, ge=1)
    """Tiles that are expected to hold more readings together are not coloured by one task. Changes no result."""
