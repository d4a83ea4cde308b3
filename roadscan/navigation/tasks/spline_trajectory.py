"""Smooths the trajectory log of a run by cubics in GNSS outages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.navigation.tasks.computed_trajectory import Computed, sigma_figures, trajectory_rows
from roadscan.poses.trajectory import Trajectory
from roadscan.run.code_reach import code_digest, name_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.logs import NAVIGATION, LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]

SPLINE: Final = "spline"
"""Format of the records of these trajectories."""

_POSE: Final = ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz"]
_SIGMA: Final = ["sigma_north_m", "sigma_east_m", "sigma_down_m"]
_ANGLE_SIGMA: Final = ["sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg"]


@dataclass(frozen=True)
class PlannedSpline:
    """A trajectory log to smooth."""

    survey: Survey
    store: Store
    run: str
    records: tuple[LogRecord, ...]
    key: str
    format: str = SPLINE

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Smooth the logs.

        Raises
        ------
        ConfigError
            where the run's logs lie in different world frames.
        """
        from roadscan.navigation.spline import smoothed

        worlds = {str(r.attributes["world_frame"]) for r in self.records}
        if len(worlds) != 1:
            raise ConfigError(f"run '{self.run}' has trajectories in different world frames", expected="one datum")
        trajectory, angle_sigma = self._load(worlds.pop())
        result = smoothed(trajectory, self.survey.config.navigation.spline)
        for change in result.changes:
            report(f"smoothed: run '{self.run}': {change}")
        smooth = result.trajectory
        sigma = np.full_like(smooth.position_world_m, np.nan) if smooth.sigma_ned_m is None else smooth.sigma_ned_m
        rows = trajectory_rows(
            smooth.epochs_gps_ns,
            smooth.position_world_m,
            smooth.quaternion_world_from_body,
            sigma,
            _at(smooth.epochs_gps_ns, trajectory.epochs_gps_ns, np.radians(angle_sigma)),
        )
        attributes = {
            "world_frame": smooth.world,
            "logs": [r.key for r in self.records],
            "changes": [str(c) for c in result.changes],
            "poses_changed": int(result.touched.sum()),
            **sigma_figures(sigma),
        }
        return Computed(rows, attributes)

    def _load(self, world: str) -> tuple[Trajectory, Float64]:
        """Return poses of all logs, and σ (n, 3) of roll, pitch, heading (degrees)."""
        files = [f for r in self.records for f in r.tables["trajectory"]]
        parts = [
            read_groups(self.store, f.path, range(len(f.group_rows)), [*_POSE, *_SIGMA, *_ANGLE_SIGMA]) for f in files
        ]

        def column(name: str) -> npt.NDArray[np.generic]:
            return np.concatenate([part.column(name).to_numpy() for part in parts])

        def columns(names: list[str]) -> Float64:
            return np.stack([column(name).astype(np.float64) for name in names], axis=-1)

        epochs = column("epoch_gps_ns").astype(np.int64)
        trajectory = Trajectory.of(
            world, epochs, columns(_POSE[1:4]), columns(_POSE[4:]), self.survey.config.navigation.max_gap_s,
            columns(_SIGMA),
        )  # fmt: skip
        _, first = np.unique(epochs, return_index=True)
        return trajectory, columns(_ANGLE_SIGMA)[first]


def plan_splines(
    survey: Survey, store: Store, records: Sequence[LogRecord], runs: Sequence[str]
) -> list[PlannedSpline]:
    """Return trajectory logs of `runs` for which the survey file requests smoothing."""
    config = survey.config.navigation
    if not config.spline.on:
        return []
    code = code_digest(name_of(PlannedSpline))
    found: list[PlannedSpline] = []
    for run in runs:
        own = tuple(r for r in records if r.run == run and r.tables.get("trajectory") and r.sensor != NAVIGATION)
        if own:
            key = key_of(
                SPLINE, code, run, [r.key for r in own], config.spline.model_dump(mode="json"),
                config.max_gap_s,
            )  # fmt: skip
            found.append(PlannedSpline(survey, store, run, own, key))
    return found


def _at(epochs: npt.NDArray[np.int64], knots: npt.NDArray[np.int64], values: Float64) -> Float64:
    """Return values (k, 3) at knots (k,), interpolated linearly at epochs (n,)."""
    since, at = (epochs - knots[0]).astype(np.float64), (knots - knots[0]).astype(np.float64)
    return np.stack([np.interp(since, at, values[:, a]) for a in range(values.shape[1])], axis=-1)
