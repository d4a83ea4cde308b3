"""Collects what kernels need to georeference a sensor's readings: its mounting, the trajectory, the map, limits."""

from __future__ import annotations

from roadscan.core.grid import QUANTA_PER_M
from roadscan.core.rig import Mounting
from roadscan.georeference.charts import Charts
from roadscan.georeference.kernels import charts as kernels
from roadscan.georeference.kernels.readings import Georeference, Limits
from roadscan.poses.trajectory import Trajectory


def georeference_of(mounting: Mounting, trajectory: Trajectory, charts: Charts, limits: Limits) -> Georeference:
    """Return the structure that kernels take, from a mounting, a trajectory, charts and limits."""
    rotation, lever = mounting.arrays()
    lattice = tuple(charts.lattice.tolist())
    return Georeference(
        mounting=(*rotation.ravel().tolist(), *lever.tolist()),
        poses=trajectory.intervals,
        charts=kernels.Charts(lattice, charts.table, charts.centres, charts.coefficients),
        limits=limits,
        quanta_per_m=float(QUANTA_PER_M),
    )
