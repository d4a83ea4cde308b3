"""Interior orientation of a camera, in OpenCV's model (Brown–Conrady)."""

from __future__ import annotations

import datetime as dt

from pydantic import Field

from roadscan.model.strict import Strict


class Interior(Strict):
    """How a camera's pixels look out: u = cx + fx · x', v = cy + fy · y', where x', y' are the distorted tangents.

    Tangents are taken in OpenCV's camera axes, x right, y down, z along the optical axis; the sensor frame of the
    rig has x along the optical axis, y right, z down (`axes = "frd"`).
    """

    width_px: int = Field(ge=1)
    """Width of the pictures that this holds for."""
    height_px: int = Field(ge=1)
    """Height of these pictures."""
    focal_px: tuple[float, float]
    """fx, fy (pixels)."""
    principal_px: tuple[float, float]
    """cx, cy, from the centre of the upper left pixel (pixels)."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    sigma_focal_px: tuple[float, float] | None = None
    """1 σ of `focal_px`, from the calibration."""
    sigma_principal_px: tuple[float, float] | None = None
    """1 σ of `principal_px`."""
    sigma_distortion: tuple[float, float, float, float, float] | None = None
    """1 σ of `distortion`."""
    rms_px: float | None = Field(default=None, ge=0.0)
    """RMS of the calibration's residuals (pixels)."""
    pictures: int | None = Field(default=None, ge=0)
    """Pictures the calibration used."""
    date: dt.date | None = None
    """Day of the calibration."""
