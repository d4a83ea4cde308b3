"""Settings of the poses that a lidar makes by itself (``[navigation.odometry]``)."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class OdometryConfig(Strict):
    """Poses from the sweeps of a lidar, for runs with neither a trajectory nor GNSS: a local map without a position on
    Earth.
    """

    lidar: str | None = None
    """The lidar of the rig whose sweeps are matched; the only one at hand where left out."""
    imu: str | None = None
    """The IMU of the rig that says where up is, and watches the turns; the only one at hand where left out. "none": it
    is not used, and the rig stands level at the beginning."""
    range_max_m: float = Field(default=100.0, gt=1.0, le=500.0)
    """Returns farther than this, or than the sensor's limit, are not matched (m)."""
    voxel_m: float = Field(default=0.5, gt=0.05, le=5.0)
    """Edge of the cubes of the map that sweeps are matched with (m); half of it, one return of a cube is kept. 1 m
    takes a third of the time; poses then drift two to three times as much."""
    drift_share: float = Field(default=0.02, gt=0.0, le=0.5)
    """1 σ of the position along each axis, as a share of the way since the beginning (1). 0.02 is that
    of a street whose fronts repeat themselves; among buildings and trees of all kinds it is 0.01 and less."""
    drift_deg_per_100m: float = Field(default=1.0, gt=0.0, le=45.0)
    """1 σ of the heading, and without an IMU of roll and pitch, after 100 m (degrees); it grows with the way."""
    speed_max_m_per_s: float = Field(default=60.0, gt=0.0)
    """A pose that the rig can reach only faster than this is reported (m/s)."""
