"""Computes the trajectories of a survey from its logs, and stores them beside these.

A computed trajectory is stored like a separate log (sensor ``navigation``): its key names the logs, the rig, the
settings and the code that it was made from, and it is replaced when one of them changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, DamagedError, RoadscanError, RunError
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingested_of, survey_records
from roadscan.ingest.planned_logs import Logs, plan_logs
from roadscan.navigation.tasks.odometry_trajectory import plan_odometry
from roadscan.navigation.tasks.solve_trajectory import (
    Computed,
    PlannedTrajectory,
    plan_solutions,
    sigma_figures,
    trajectory_rows,
)
from roadscan.poses.trajectory import Trajectory
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.run.session import Session, found_once
from roadscan.store.logs import NAVIGATION, LogRecord, has_log, read_log_records, retire_log, write_log_record
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store


def plan_trajectories(survey: Survey, store: Store, records: Sequence[LogRecord]) -> list[PlannedTrajectory]:
    """Return trajectories that the survey file and its logs request, at most one for each run.

    Raises
    ------
    ConfigError
        where it is not clear which sensors navigate.
    """
    solutions = plan_solutions(survey, store, records)
    solved = {s.run for s in solutions}
    rest = [run.id for run in survey.config.runs if run.id not in solved]
    return [*solutions, *plan_splines(survey, store, records, rest), *plan_odometry(survey, store, records, rest)]


def navigate(
    survey: Survey, store: Store, report: Callable[[str], None] = lambda _: None, logs: Logs | None = None
) -> list[LogRecord]:
    """Compute the trajectories that are missing or out of date.

    Raises
    ------
    RunError
        after all runs were tried, if one could not be computed; the others are kept.
    """
    from roadscan.navigation.tasks.navigation_pictures import draw_trajectories

    done: list[LogRecord] = []
    failures: list[str] = []
    wanted = plan_trajectories(survey, store, survey_records(survey, store, logs))
    for planned in wanted:
        fresh = not has_log(store, planned.key)
        if fresh:
            try:
                keep_trajectory(store, planned, report)
            except RoadscanError as error:
                failures.append(f"run '{planned.run}': {error}")
                report(f"failed: {failures[-1]}")
                continue
        record = read_log_records(store, [planned.key])[0]
        done.append(record)
        report(f"{'computed' if fresh else 'known'}: {record.run}/{NAVIGATION} {record.rows:,} poses{_figures(record)}")
        if not fresh:
            for doubt in record.attributes.get("doubts", ()):
                report(f"doubtful: run '{record.run}': {doubt}")
    draw_trajectories(survey, store, done, [planned.run for planned in wanted], report)
    if failures:
        number = "1 trajectory" if len(failures) == 1 else f"{len(failures)} trajectories"
        raise RunError(
            f"{number} could not be computed: " + " | ".join(failures),
            change="correct the survey or rig file or the logs; the next run computes only what is missing",
        )
    return done


def records_with_trajectories(
    survey: Survey, store: Store, ingested: Sequence[LogRecord] | None = None
) -> list[LogRecord]:
    """Records of the survey file's logs (`ingested`, where known) and of the trajectories computed from them.

    Raises
    ------
    RunError
        where a log is not ingested, or a trajectory not computed from the logs as they are.
    """
    records = survey_records(survey, store) if ingested is None else ingested
    planned = plan_trajectories(survey, store, records)
    missing = [p.run for p in planned if not has_log(store, p.key)]
    if missing:
        raise RunError(
            f"the trajectory of run '{missing[0]}' is not computed, or of older logs or settings",
            change="run `roadscan navigate` (or `roadscan run`) first",
        )
    return [*records, *read_log_records(store, [p.key for p in planned])]


def known_keys(survey: Survey, store: Store, logs: Logs | None = None) -> list[str]:
    """Return keys of the survey file's logs in the store, and of the trajectories computed from them."""
    planned, _ = plan_logs(survey, store) if logs is None else logs
    keys = [log.key for log in planned if has_log(store, log.key)]
    try:
        solutions = plan_trajectories(survey, store, read_log_records(store, keys, damaged=[]))
    except (ConfigError, DamagedError):  # the run and `verify` report it
        return keys
    return keys + [p.key for p in solutions if has_log(store, p.key)]


def keep_trajectory(store: Store, planned: PlannedTrajectory, report: Callable[[str], None]) -> None:
    """Compute a trajectory and store it, in place of an older one of its run."""
    from roadscan.store.writer import LogWriter

    computed = planned.compute(report)
    with store.scratch() as folder:
        writer = LogWriter(folder, None)
        for table, batch in computed.rows:
            writer.add(table, batch)
        writer.finish()
        for old in read_log_records(store):
            if (old.run, old.sensor) == (planned.run, NAVIGATION) and old.key != planned.key:
                retire_log(store, old)
        tables = writer.publish(store, planned.run, NAVIGATION, planned.key)
    write_log_record(
        store,
        LogRecord(
            key=planned.key,
            run=planned.run,
            sensor=NAVIGATION,
            format=planned.format,
            path="",
            content=planned.key,
            source_bytes=0,
            tables=tables,
            attributes=computed.attributes,
            rows=writer.rows["trajectory"],
            rejected=0,
            reject_reasons={},
        ),
    )


def _figures(record: LogRecord) -> str:
    a = record.attributes
    if "poses_changed" in a:
        return f", {a['poses_changed']:,} of them smoothed in {len(a['changes'])} places"
    text = f", σ up to {a['largest_sigma_horizontal_m']:.3f} m horizontal, {a['largest_sigma_down_m']:.3f} m down"
    if "outliers" in a:
        text += f", {a['outliers']:,} of {a['updates']:,} updates are outliers"
    return text


@found_once
def records_of(session: Session) -> tuple[LogRecord, ...]:
    """Return records of the survey file's logs and of the trajectories computed from them.

    Raises
    ------
    RunError
        where one is missing.
    """
    return tuple(records_with_trajectories(session.survey, session.store, ingested_of(session)))


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
