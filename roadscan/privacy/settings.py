"""Settings of privacy (section ``[privacy]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.core.survey import Survey, SurveySection


class DetectorConfig(Strict):
    """A network that finds what is to be hidden: an ONNX file of your own. Needs the extra `onnx`."""

    model: Path
    """The ONNX file. Its first input takes pictures as (1, 3, height, width), red first, values from 0 to 1."""
    output: Literal["yolov5", "yolov8", "boxes"]
    """What the network gives. `yolov5`: (1, n, 5 + classes) with centre, size, objectness and scores of classes;
    `yolov8`: (1, 4 + classes, n) with centre, size and scores; `boxes`: corners (n, 4) and scores (n), in this order of
    the outputs. All in pixels of the input."""
    classes: list[int] | None = None
    """Numbers of the classes that are hidden; left out, all."""
    least_score: float = Field(default=0.25, ge=0.01, le=0.99)
    """Least score of what is hidden: a low one hides too much rather than too little."""
    input_px: tuple[int, int] | None = None
    """Width and height of the input (pixels), where the file leaves them open."""
    windows: bool = True
    """Look at windows of the input's size in the full resolution as well, which finds small plates in large pictures;
    otherwise at the reduced picture alone."""


class PrivacyConfig(SurveySection):
    """What is hidden in published pictures. Without a statement no picture is published."""

    table: ClassVar[str] = "privacy"
    meaning: ClassVar[str] = "What is hidden in published pictures; without `pictures` none is published."

    pictures: Literal["blur", "off"] | None = None
    """`blur`: people and vehicles are made unrecognisable in all pictures that are published; `off`: they are published
    as they are, and you answer for it. Left out, no picture is published."""
    from_classes: bool = True
    """Hide what the returns of vehicles and people cover, as the stage `assets` classes them."""
    detector: DetectorConfig | None = None
    """Hide what a network finds."""
    margin: float = Field(default=0.2, ge=0.0, le=1.0)
    """What is hidden is wider by this share on each side."""
    reach_m: float = Field(default=40.0, gt=1.0, le=200.0)
    """Returns farther from the camera than this hide nothing (m)."""


def publishes_as_they_are(survey: Survey) -> bool:
    """Return True where the survey file states that pictures are published as they are."""
    return PrivacyConfig.of(survey).pictures == "off"
