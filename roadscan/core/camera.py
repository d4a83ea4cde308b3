"""Interior orientation of a camera: a pinhole in OpenCV's model (Brown–Conrady), or a picture of 360°."""

from __future__ import annotations

import datetime as dt
import math
from typing import Any, Literal

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


class Interior(Strict):
    """Interior orientation: a pixel has u = cx + fx · x', v = cy + fy · y', where x', y' are the distorted tangents.

    Tangents are taken in OpenCV's camera axes, x right, y down, z along the optical axis; the sensor frame of the
    rig has x along the optical axis, y right, z down (`axes = "frd"`). In a picture of 360° x' and y' are angles
    (radians): x' to the right around the camera's y axis, from −π to π, and y' downwards from its horizon.
    """

    model: Literal["perspective", "equirectangular"] = "perspective"
    """`perspective`, or `equirectangular` for pictures of 360°, whose columns and rows are even steps of these angles;
    the optical axis is then the direction that the middle column looks to."""
    width_px: int = Field(ge=1)
    """Width of the pictures that this holds for."""
    height_px: int = Field(ge=1)
    """Height of these pictures."""
    focal_px: tuple[float, float]
    """fx, fy (pixels; of a picture of 360° pixels a radian, those of the whole sphere where left out)."""
    principal_px: tuple[float, float]
    """cx, cy, from the centre of the upper left pixel (pixels); may be left out for a picture of 360°: its middle."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    line_time_us: float = Field(default=0.0, ge=-1000.0, le=1000.0)
    """Time from the exposure of a row to that of the row below (µs): of a rolling shutter; 0 of a global one. The stamp
    of a picture is the time of its middle row."""
    sigma_focal_px: tuple[float, float] | None = None
    """1 σ of `focal_px`, from the calibration."""
    sigma_principal_px: tuple[float, float] | None = None
    """1 σ of `principal_px`."""
    sigma_distortion: tuple[float, float, float, float, float] | None = None
    """1 σ of `distortion`."""
    sigma_line_time_us: float | None = Field(default=None, ge=0.0)
    """1 σ of `line_time_us`."""
    rms_px: float | None = Field(default=None, ge=0.0)
    """RMS of the calibration's residuals (pixels)."""
    pictures: int | None = Field(default=None, ge=0)
    """Pictures the calibration used."""
    date: dt.date | None = None
    """Day of the calibration."""

    @model_validator(mode="before")
    @classmethod
    def _of_the_sphere(cls, values: Any) -> Any:
        """Return the values with focal length and principal point filled in from the size of a full-sphere picture."""
        if not isinstance(values, dict) or values.get("model") != "equirectangular":
            return values
        width, height = values.get("width_px"), values.get("height_px")
        if not isinstance(width, int) or not isinstance(height, int):
            return values
        sphere = {
            "focal_px": (width / (2.0 * math.pi), height / math.pi),
            "principal_px": ((width - 1) / 2.0, (height - 1) / 2.0),
        }
        return sphere | values

    @model_validator(mode="after")
    def _has_no_lens(self) -> Interior:
        if self.model == "equirectangular":
            if any(self.distortion):
                raise ValueError("distortion is none of an equirectangular picture: its pixels are angles")
            if self.width_px > 2.0 * math.pi * self.focal_px[0] + 1.0:
                raise ValueError(
                    f"width_px {self.width_px} is more than a turn of 360° with focal_px {self.focal_px[0]:g}"
                )
        return self
