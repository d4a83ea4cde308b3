"""Uncertainty of the poses from which assets were seen: a share of σ common to all returns of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.assets.tasks.plan import AssetPlan
from roadscan.compute.array_types import Float64, Int64
from roadscan.core.rig import UNMOUNTED, Mountings
from roadscan.georeference.plan.plan import trajectory_source
from roadscan.georeference.sensor_places import sensor_places
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_trajectory, pose_sigma
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.small_tables import small_path

_TICK_NS: Final = 1_000_000_000
"""Interval of the poses that are used (ns)."""
_REACH_M: Final = 100.0
"""Farthest distance (m) from which anything is seen."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Poses (k,) of all drives, one a second."""

    places_m: Float64
    """(k, 2) easting and northing."""
    epochs_gps_ns: Int64
    sigma: Float64
    """(k, 6) of north, east, down (m), roll, pitch, heading (rad)."""

    def sigma_m(self, places_m: Float64, seen_gps_ns: Int64) -> Float64:
        """Returns the 1 σ (n, 2) that poses give to places (n, 2), horizontal (of each axis) and down.

        It is the root mean square of the poses within 100 m while a place was seen. Errors of angles count with the
        distance to the nearest one of them.

        Parameters
        ----------
        seen_gps_ns : (n, 2) first and last epoch that shows each.
        """
        import scipy.spatial

        found = np.zeros((len(places_m), 2))
        if not len(self.places_m):
            return found
        tree = scipy.spatial.cKDTree(self.places_m)
        for number, (place, (first, last)) in enumerate(zip(places_m, seen_gps_ns.tolist(), strict=True)):
            near = np.array(sorted(tree.query_ball_point(place, _REACH_M)), np.intp)
            epochs = self.epochs_gps_ns[near]
            near = near[(epochs >= first - _TICK_NS) & (epochs <= last + _TICK_NS)]
            if not near.size:
                near = np.array([tree.query(place)[1]], np.intp)
            away = float(np.hypot(*(self.places_m[near] - place).T).min())
            north, east, down, roll, pitch, heading = np.mean(self.sigma[near] ** 2, axis=0)
            found[number] = (north + east + away**2 * heading) / 2, down + away**2 * max(roll, pitch)
        return np.sqrt(found)


def drives_key(plan: AssetPlan) -> str:
    """Returns the key of what :func:`load_drives` reads."""
    survey, runs = plan.survey, [source.run for source in _sources(plan)]
    settings = survey.survey.config.navigation.calibration
    files = [
        [r.run, [f.digest for name in ("trajectory", "trajectory_accuracy") for f in r.tables.get(name, ())]]
        for r in survey.records
        if r.run in runs
    ]
    path = small_path("corrections")
    corrections = bytes_digest(survey.store.read_bytes(path)) if survey.store.exists(path) else ""
    return key_of(files, corrections, settings.traverse_sigma_m, settings.traverse_sigma_deg)


def load_drives(plan: AssetPlan) -> Drives:
    """Returns poses of the runs in which assets are sought; those of clouds without a trajectory are not known."""
    survey, parts = plan.survey, []
    for source in _sources(plan):
        spans = [span for file in source.files for span in file.group_spans]
        whole = (min(first for first, _ in spans), max(last for _, last in spans))
        trajectory = load_trajectory(survey.store, source, [whole], survey.ground.max_gap_s)
        knots = np.flatnonzero(np.diff(trajectory.epochs_gps_ns // _TICK_NS, prepend=-1))
        epochs = trajectory.epochs_gps_ns[knots]
        if epochs.size < 2:
            continue
        sigma = pose_sigma(survey.store, survey.records, source, epochs, survey.survey.config.navigation.calibration)
        if trajectory.sigma_ned_m is not None:  # of the adjustment, where it states any
            adjusted = trajectory.sigma_ned_m[knots]
            sigma[:, :3] = np.where(np.isfinite(adjusted), adjusted, sigma[:, :3])
        places = sensor_places(trajectory, survey.ground.map, Mountings.one(UNMOUNTED), epochs)[:, :2]
        known = np.isfinite(places).all(axis=1)
        parts.append((places[known], epochs[known], sigma[known]))
    if not parts:
        return Drives(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 6)))
    return Drives(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def with_pose_sigma(rows: pa.Table, drives: Drives) -> pa.Table:
    """Returns rows of objects whose σ of the place includes that of the poses."""
    places = np.column_stack([rows["easting_m"].to_numpy(), rows["northing_m"].to_numpy()])
    seen = np.column_stack([rows["first_epoch_gps_ns"].to_numpy(), rows["last_epoch_gps_ns"].to_numpy()])
    sigma = drives.sigma_m(places, seen)
    for column, name in enumerate(("sigma_horizontal_m", "sigma_height_m")):
        index = rows.schema.get_field_index(name)
        values = pa.array(np.hypot(rows[name].to_numpy(), sigma[:, column]))
        rows = rows.set_column(index, rows.schema.field(index), values)
    return rows


def _sources(plan: AssetPlan) -> list[TrajectorySource]:
    runs = {s.run for s, _ in plan.survey.sources if s.trajectory is not None and s.sensor in plan.sensors}
    own = {run: trajectory_source(run, plan.survey.records) for run in runs} | dict(plan.ways)
    return [source for _, source in sorted(own.items()) if source.files]
