"""Settings of pictures as measurements: tie points (``[picture_ties]``) and control targets (``[picture_targets]``)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from roadscan.core.strict import Strict
from roadscan.core.survey import SurveySection

TargetStyle = Literal["ring", "disc", "checker"]


class PictureTarget(Strict):
    """What a target looks like."""

    styles: list[TargetStyle] = Field(default=["ring", "checker", "disc"], min_length=1)
    """`ring`: a black ring around a white disc; `disc`: a white disc with a black centre; `checker`: two of 2 × 2
    fields are black. Where several are named, the one that fits best counts."""
    size_m: float = Field(default=0.30, gt=0.0, le=5.0)
    """Edge of a ring's white square and of all four fields together, or diameter of the white disc (m)."""
    ring: tuple[float, float] = (0.4, 0.8)
    """Inner and outer diameter of a black ring, as shares of the edge."""
    centre: float = Field(default=0.2, gt=0.0, le=0.8)
    """Diameter of a disc's black centre, as a share of the disc's."""
    lies: Literal["flat", "upright", "any"] = "any"
    """`flat`: on the road; `upright`: on a wall or a post; `any`: both are tried."""

    @model_validator(mode="after")
    def _check(self) -> PictureTarget:
        if not 0.1 <= self.ring[0] < self.ring[1] <= 1.0:
            raise ValueError(f"ring {list(self.ring)}: give the inner diameter, 0.1 or more, and the outer, 1 or less")
        return self


class PictureTargetsConfig(PictureTarget, SurveySection):
    """Targets of control points, as pictures show them: one kind for all, or by the points' codes or names."""

    table: ClassVar[str] = "picture_targets"
    meaning: ClassVar[str] = "What control targets look like in pictures, and where they are looked for."

    codes: dict[str, PictureTarget] = {}
    """Targets of points with a surveyor's code of their own, by the code; in place of the kind above."""
    names: dict[str, PictureTarget] = {}
    """Targets of single points, by their names; in place of both."""
    position_m: float = Field(default=0.15, gt=0.0, le=5.0)
    """1 σ of the cameras' stated places on each axis (m): three of it are searched …"""
    angle_deg: float = Field(default=0.25, gt=0.0, le=10.0)
    """… and of the directions in which they look (degrees)."""
    farthest_m: float = Field(default=30.0, gt=1.0, le=500.0)
    """Targets farther away are not looked for (m)."""
    least_px: float = Field(default=7.0, ge=4.0, le=100.0)
    """Least height or width of a target in the picture (pixels)."""
    most_sigma_px: float = Field(default=0.15, gt=0.0, le=2.0)
    """A target whose middle is less certain than this (1 σ, pixels) is none."""

    def of_point(self, name: str, code: str | None) -> PictureTarget:
        """Return the target of a point."""
        return self.names.get(name) or self.codes.get(code or "", self)


class VideoFramesConfig(SurveySection):
    """Key frames of videos, which stand for pictures in all that pictures are used for.

    Cameras need an interior orientation in the rig file.
    """

    table: ClassVar[str] = "video_frames"
    meaning: ClassVar[str] = "Which frames of videos stand for pictures. Needs the extra `opencv`."

    on: bool = True
    """`false`: videos give no pictures."""
    step_m: float = Field(default=1.0, gt=0.0, le=100.0)
    """A frame is taken where the vehicle is this far (m) from where the one before was taken."""


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
    measurements: int = Field(default=200, ge=10, le=5_000)
    """Measurements of tie points that a picture keeps, at most about; long tracks first, spread evenly over it."""
    reach_m: float = Field(default=80.0, gt=1.0, le=500.0)
    """Tie points farther than this from a camera are left out (m)."""
    least_parallax_deg: float = Field(default=1.0, gt=0.0, le=20.0)
    """Rays to a tie point meet under this angle at least (degrees): below it, its distance is not known."""
