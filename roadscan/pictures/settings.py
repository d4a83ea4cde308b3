"""Settings of tie points between pictures (section ``[picture_ties]`` of the survey file)."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from roadscan.core.survey import SurveySection


class PictureTiesConfig(SurveySection):
    """Tie points: what several pictures show is found, matched and handed to the adjustment of the poses.

    Cameras need an interior orientation in the rig file.
    """

    table: ClassVar[str] = "picture_ties"
    meaning: ClassVar[str] = (
        "Pictures as measurements of the poses: tie points between them. Left out, pictures move no pose. Needs the "
        "extra `opencv`."
    )
    may_be_left_out: ClassVar[bool] = True

    on: bool = True
    """`false`: pictures move no pose."""
    features: int = Field(default=2000, ge=100, le=20_000)
    """Features of a picture, at most; they are spread evenly over it."""
    neighbours: int = Field(default=3, ge=1, le=20)
    """A picture is compared with so many that the same camera took after it …"""
    shortest_step_m: float = Field(default=0.3, ge=0.0, le=10.0)
    """… leaving out those that were taken from less far away than this (m): a vehicle that waits sees nothing new."""
    revisits: int = Field(default=3, ge=0, le=20)
    """A picture is compared with so many of each other run or camera, or of the same one at another time …"""
    revisit_m: float = Field(default=8.0, gt=0.0, le=100.0)
    """… that were taken within this distance (m) …"""
    revisit_deg: float = Field(default=40.0, gt=0.0, le=90.0)
    """… with optical axes that differ by no more than this (degrees)."""
    measurements: int = Field(default=120, ge=10, le=5_000)
    """Measurements of tie points that a picture keeps, at most about; long tracks first, spread evenly over it."""
    reach_m: float = Field(default=80.0, gt=1.0, le=500.0)
    """Tie points farther than this from a camera are left out (m)."""
    least_parallax_deg: float = Field(default=1.0, gt=0.0, le=20.0)
    """Rays to a tie point meet under this angle at least (degrees): below it, its distance is not known."""
