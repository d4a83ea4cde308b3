"""What the kernels need to place the readings of a sensor: its mounting, the trajectory, the map, limits."""

from __future__ import annotations

from roadscan.core.grid import QUANTA_PER_M
from roadscan.core.rig import Mounting
from roadscan.georeference.charts import Charts
from roadscan.georeference.kernels import charts as kernels
from roadscan.georeference.kernels.readings import Georeference, Limits
from roadscan.poses.trajectory import Trajectory


def georeference_of(mounting: Mounting, trajectory: Trajectory, charts: Charts, limits: Limits) -> Georeference:
    """The structure that kernels take, over the arrays of a trajectory and of charts."""
    rotation, lever = mounting.arrays()
    lattice = tuple(charts.lattice.tolist())
    return Georeference(
        mounting=(*rotation.ravel().tolist(), *lever.tolist()),
        poses=trajectory.intervals,
        charts=kernels.Charts(lattice, charts.table, charts.centres, charts.coefficients),
        limits=limits,
        quanta_per_m=float(QUANTA_PER_M),
    )
