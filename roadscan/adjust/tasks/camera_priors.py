"""Cameras whose pictures take part in the adjustment, and how well they are known before it."""

from __future__ import annotations

import numpy as np

from roadscan.adjust.bundle.settings import CameraPriors
from roadscan.adjust.observations import CAMERA
from roadscan.compute.array_types import Float64
from roadscan.core.rig import Sensor
from roadscan.core.survey import Survey
from roadscan.pictures.settings import PictureTiesConfig


def asks_pictures(survey: Survey) -> bool:
    """Returns whether pictures take part in the adjustment."""
    return survey.has(PictureTiesConfig.table) and PictureTiesConfig.of(survey).on


def adjusted_cameras(survey: Survey) -> dict[str, Sensor]:
    """Returns the cameras whose pictures take part, by name: those with an interior orientation."""
    sensors = sorted(survey.rig.sensors.items()) if asks_pictures(survey) else ()
    return {name: one for name, one in sensors if one.kind == "camera" and one.interior is not None}


def camera_sigma(camera: Sensor, own: CameraPriors) -> tuple[Float64, Float64]:
    """Returns 1 σ (7,) of a camera's mounting, `MOUNTED`, and (11,) of its lens and clock, `CAMERA`."""
    lever = camera.lever_arm_sigma_m or (own.sigma_lever_m,) * 3
    boresight = camera.boresight_sigma_deg or (own.sigma_boresight_deg,) * 3
    mounted = np.array([*lever, *np.radians(boresight), 0.0])
    interior = camera.interior
    if interior is None:
        return mounted, np.zeros(len(CAMERA))
    focal = interior.sigma_focal_px or tuple(own.sigma_focal * f for f in interior.focal_px)
    principal = interior.sigma_principal_px or tuple(own.sigma_principal * f for f in interior.focal_px)
    bent = interior.sigma_distortion or (own.sigma_k1, 0.0, 0.0, 0.0, 0.0)
    if interior.model == "equirectangular":
        focal, principal, bent = (0.0, 0.0), (0.0, 0.0), (0.0,) * 5
    line = interior.sigma_line_time_us
    line = (own.sigma_line_time_us if interior.line_time_us else 0.0) if line is None else line
    return mounted, np.array([*focal, *principal, *bent, own.sigma_clock_s, 1e-6 * line])
