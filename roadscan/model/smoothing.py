"""Settings of the smoother that makes a trajectory from GNSS, IMU and odometer (``[navigation.smoother]``)."""

from __future__ import annotations

from pydantic import Field

from roadscan.model.strict import Strict


class SmootherConfig(Strict):
    """Loosely coupled smoothing of GNSS solutions, IMU and odometer."""

    imu: str | None = None
    """The IMU of the rig that navigates; the only one at hand where left out."""
    gnss: str | None = None
    """The GNSS receiver or antenna of the rig; the only one at hand where left out."""
    encoder: str | None = None
    """The odometer of the rig; the only one where left out, none where the run has none."""
    poses_per_s: float = Field(default=100.0, gt=0.0, le=2000.0)
    """Poses of the trajectory a second; at most the IMU's rate."""
    land_vehicle: bool = True
    """The body moves neither sideways nor up with respect to itself (non-holonomic constraint), and stands still
    now and then (zero-velocity and zero-rotation updates)."""
