"""Estimates clocks of sensors, stores them in the tables ``clocks`` and ``clock_residuals``, and loads them."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.clock_evidence import MotionEvidence
from roadscan.core.errors import ConfigError, RoadscanError, RunError, nearest
from roadscan.core.extras import can_draw
from roadscan.core.survey import LogConfig, Survey
from roadscan.ingest.clock_correction import ClockCorrection, Residuals
from roadscan.ingest.clock_pairs import log_pairs
from roadscan.ingest.ingest import survey_records
from roadscan.ingest.planned_logs import Logs
from roadscan.navigation.clocks.motion import MotionFit, clock_from_motion
from roadscan.navigation.clocks.picture import ClockPicture, draw_clock
from roadscan.navigation.clocks.signals import (
    Felt,
    Motion,
    driving,
    felt_by_encoder,
    felt_by_imu,
    turning,
    turning_of_imu,
)
from roadscan.navigation.inertial.readings import OdometerReadings
from roadscan.navigation.tasks.navigation_logs import imu_readings, odometer_readings
from roadscan.navigation.tasks.recorded_pictures import CLOCK_PICTURE, keep_file, picture_key, remove_others
from roadscan.navigation.tasks.trajectories import (
    ClockEstimate,
    clock_picture_path,
    clock_unit,
    keep_estimates,
    kept_estimates,
    load_clocks,
)
from roadscan.poses.trajectory import Trajectory
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.store.logs import NAVIGATION, LogRecord, read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

__all__ = ["ClockEstimate", "estimate_clocks", "load_clocks"]

_POSES: Final = ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz"]
_MAX_GAP_S: Final = 1.0  # Poses farther apart are not interpolated.

Report = Callable[[str], None]


def estimate_clocks(
    survey: Survey,
    store: Store,
    report: Report = lambda _: None,
    *,
    before_navigation: bool = False,
    logs: Logs | None = None,
) -> list[ClockEstimate]:
    """Estimate the clocks that the survey file requests, and store them; unchanged ones are not estimated again.

    Clocks from motion (``[[clocks]]``) become corrections of ingested epochs. Pairs of stamps in a log's `clock` were
    applied when it was ingested; they are listed with their residuals. A picture of the residuals lies in
    ``products/clocks/``. `before_navigation`: only those that need no trajectory, so that one can be computed from
    them.

    Raises
    ------
    RunError
        after all were tried, if one could not be estimated; the others are kept. One that fails leaves no row.
    """
    records = survey_records(survey, store, logs)
    known = {(e.run, e.sensor, e.applied): e for e in kept_estimates(store)}
    found: list[ClockEstimate] = []
    failures: list[str] = []
    tasks = [*_pair_tasks(survey, records), *_motion_tasks(survey, store, records, before_navigation)]
    if not tasks and not known:
        return []
    manifest = Manifest(store)
    for task in tasks:
        old = [known.get((task.run, sensor, task.applied)) for sensor in task.sensors]
        if all(e is not None and e.key == task.key for e in old):
            found += [e for e in old if e is not None]
            _draw(survey, store, manifest, task, found[-len(old)])
            report(f"known: {_line(found[-len(old)])}")
            continue
        try:
            fresh = task.solve(store, report)
        except RoadscanError as error:
            failures.append(str(error))
            report(f"failed: {error}")
            continue
        _draw(survey, store, manifest, task, fresh[0])
        found += fresh
        report(f"estimated: {_line(fresh[0])}")
    if before_navigation:
        done = {(e.run, e.sensor, e.applied) for e in found}
        found += [e for place, e in known.items() if place not in done]
    else:
        remove_others(manifest, CLOCK_PICTURE, [task.unit for task in tasks] if can_draw() else [])
    if sorted(map(_place, found)) != sorted(map(_place, known.values())):
        keep_estimates(store, found)
    if failures:
        raise RunError(
            f"{len(failures)} clocks could not be estimated: " + " | ".join(failures),
            change="correct the survey file; the next run estimates only what is missing",
        )
    return found


def _place(estimate: ClockEstimate) -> tuple[str, ...]:
    return estimate.run, estimate.sensor, estimate.applied, estimate.key


# --- what is to be estimated --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Task:
    """One clock to estimate."""

    run: str
    sensors: tuple[str, ...]
    """The sensor, followed by those that share its clock."""
    applied: str
    key: str
    solve: Callable[[Store, Report], list[ClockEstimate]]

    @property
    def unit(self) -> str:
        """Name of its picture's record: the file's name without suffix."""
        return clock_unit(self.run, self.sensors[0], self.applied)


def _pair_tasks(survey: Survey, records: Sequence[LogRecord]) -> Iterator[_Task]:
    """Return logs whose clock comes from pairs of stamps, one for each run and sensor."""
    code = code_digest("roadscan.navigation.tasks.clocks:_of_pairs")
    seen: set[tuple[str, str]] = set()
    for run in survey.config.runs:
        for log in run.logs:
            found = log_pairs(survey, log)
            if found is None or log.clock is None:
                continue
            own = (r for r in records if r.path == str(log.path) and log.format in {None, r.format})
            sensor = log.sensor or next((r.sensor for r in own), "trajectory")
            if (run.id, sensor) in seen:
                continue  # further logs of a sensor share its row
            seen.add((run.id, sensor))
            key = key_of("pairs", code, run.id, sensor, log.clock.model_dump(mode="json"), found.fit)

            def solve(
                _store: Store, report: Report, run_id: str = run.id, sensor: str = sensor, log: LogConfig = log,
                key: str = key,
            ) -> list[ClockEstimate]:  # fmt: skip
                return [_of_pairs(survey, report, run_id, sensor, log, key)]

            yield _Task(run.id, (sensor,), "ingest", key, solve)


def _of_pairs(survey: Survey, report: Report, run: str, sensor: str, log: LogConfig, key: str) -> ClockEstimate:
    found = log_pairs(survey, log)
    evidence = log.clock.pairs if log.clock is not None else None
    if found is None or evidence is None:
        raise ConfigError(f"log '{log.path}' has no pairs of stamps")
    for fault in found.faults[:5]:
        report(f"left out: {fault}")
    if len(found.faults) > 5:
        report(f"left out: {len(found.faults) - 5} more records of that table")
    if evidence.arrivals and evidence.least_latency_s == 0.0:
        report(
            f"note: {run}/{sensor}: no least_latency_s is stated for the arrivals, so its epochs are late by the "
            "shortest time that a record took to arrive"
        )
    method = "arrivals" if evidence.arrivals else "pairs"
    return _estimate(run, sensor, method, "ingest", found.fit.correction, found.fit.residuals, key)


def _motion_tasks(
    survey: Survey, store: Store, records: Sequence[LogRecord], before_navigation: bool
) -> Iterator[_Task]:
    """Return clocks from motion, one for each run with the sensor's log."""
    runs = [run.id for run in survey.config.runs]
    for evidence in survey.config.clocks:
        _check(survey, evidence, runs)
        if before_navigation and evidence.against == "trajectory":
            continue
        own = [r for r in records if r.sensor == evidence.sensor and (r.tables.get("imu") or r.tables.get("encoder"))]
        found = [run for run in evidence.runs or runs if any(r.run == run for r in own)]
        if not found:
            raise ConfigError(
                f"[[clocks]] names '{evidence.sensor}', and no run holds a log of it with rows of an IMU or encoder",
                expected="a log of that sensor",
                change="add it to the runs, or take the entry away",
            )
        code = code_digest(name_of(_MotionTask))
        for run in found:
            felt = tuple(r for r in own if r.run == run)
            against = _against(store, records, run, evidence)
            _check_independence(evidence, run, felt, against)
            inputs = [[f.digest for files in r.tables.values() for f in files] for r in (*felt, *against)]
            sensor = survey.rig.sensors.get(evidence.sensor)
            way = None if sensor is None else sensor.metres_per_tick
            key = key_of("motion", code, run, evidence.model_dump(mode="json"), inputs, way)
            task = _MotionTask(survey, run, evidence, felt, against, key)
            yield _Task(run, (evidence.sensor, *evidence.also), "epochs", key, task.solve)


def check_clocks(survey: Survey) -> None:
    """Raise :class:`ConfigError` where ``[[clocks]]`` names a sensor or run that does not exist; reads no log."""
    for evidence in survey.config.clocks:
        _check(survey, evidence, [run.id for run in survey.config.runs])


def _check(survey: Survey, evidence: MotionEvidence, runs: Sequence[str]) -> None:
    """Reject names that the rig or the survey file does not contain."""
    sensors = survey.rig.sensors
    for name in (evidence.sensor, *evidence.also, *([] if evidence.against == "trajectory" else [evidence.against])):
        if name not in sensors:
            raise ConfigError(
                f"[[clocks]] names the unknown sensor '{name}'{nearest(name, sensors)}",
                expected="a sensor of the rig: " + (", ".join(sensors) or "it has none"),
            )
    for run in evidence.runs:
        if run not in runs:
            raise ConfigError(f"[[clocks]] of '{evidence.sensor}' names the unknown run '{run}'{nearest(run, runs)}")
    kinds = {evidence.sensor: ("imu", "encoder"), evidence.against: ("imu",)}
    for name, allowed in kinds.items():
        if name in sensors and sensors[name].kind not in allowed:
            raise ConfigError(
                f"[[clocks]] names '{name}', which is of kind {sensors[name].kind}",
                expected=f"a sensor of kind {' or '.join(allowed)}: it has to feel the motion",
                change="name the IMU inside it, and the sensor itself in also",
            )
    if evidence.against != "trajectory" and sensors[evidence.sensor].kind == "encoder":
        raise ConfigError(f"[[clocks]] holds the encoder '{evidence.sensor}' against an IMU", expected="the trajectory")


def _against(store: Store, records: Sequence[LogRecord], run: str, evidence: MotionEvidence) -> tuple[LogRecord, ...]:
    """Return logs with the same motion on GPS time: a trajectory, recorded or computed, or those of an IMU."""
    if evidence.against == "trajectory":
        found = [r for r in records if r.run == run and r.tables.get("trajectory")]
        found = found or [r for r in read_log_records(store) if (r.run, r.sensor) == (run, NAVIGATION)]
    else:
        found = [r for r in records if (r.run, r.sensor) == (run, evidence.against) and r.tables.get("imu")]
    if not found:
        raise ConfigError(
            f"run '{run}' has no {evidence.against} to hold the clock of '{evidence.sensor}' against",
            expected="a trajectory of the run (a log of poses, or `roadscan navigate`)"
            if evidence.against == "trajectory"
            else f"a log of '{evidence.against}' in the run",
            change="name in against what the run has",
        )
    return tuple(found)


def _check_independence(
    evidence: MotionEvidence, run: str, felt: Sequence[LogRecord], against: Sequence[LogRecord]
) -> None:
    """Reject a computed trajectory that depends on the sensor's clock itself."""
    own = {r.key for r in felt}
    if any(own & set(r.attributes.get("logs", ())) for r in against):
        raise ConfigError(
            f"the trajectory of run '{run}' was computed with the log of '{evidence.sensor}', so it has that clock's "
            "error in it",
            expected="motion that was measured by other sensors",
            change="hold it against an IMU (against), or name another sensor in [navigation.smoother]",
        )


@dataclass(frozen=True)
class _MotionTask:
    """The estimation of one sensor's clock in one run from motion."""

    survey: Survey
    run: str
    evidence: MotionEvidence
    felt: tuple[LogRecord, ...]
    against: tuple[LogRecord, ...]
    key: str

    def solve(self, store: Store, _report: Report) -> list[ClockEstimate]:
        """Load the logs and estimate the clock."""
        e = self.evidence
        felt, motion = self._signals(store)
        what = f"run '{self.run}', sensor '{e.sensor}'"
        fit: MotionFit = clock_from_motion(felt, motion, search_s=e.search_s, drift=e.drift, what=what)
        correction = replace(fit.correction, offset_s=fit.correction.offset_s + e.delay_s)
        method = f"motion against {e.against}"
        first = _estimate(self.run, e.sensor, method, "epochs", correction, fit.residuals, self.key)
        shared = [replace(first, sensor=name, method=f"shared with {e.sensor}", residuals=None) for name in e.also]
        return [first, *shared]

    def _signals(self, store: Store) -> tuple[Felt, Motion]:
        """Return measured and expected motion."""
        if self.survey.rig.sensors[self.evidence.sensor].kind == "encoder":
            odometer = odometer_readings(store, self.felt, self.survey.rig.sensors[self.evidence.sensor])
            if odometer is None:
                raise ConfigError(f"run '{self.run}' has no log of '{self.evidence.sensor}'")
            motion = driving(_poses(store, self.against), backwards_counts_down=_counts_down(odometer))
            return felt_by_encoder(odometer), motion
        if self.evidence.against == "trajectory":
            motion = turning(_poses(store, self.against))
        else:
            motion = turning_of_imu(imu_readings(store, self.against))
        return felt_by_imu(imu_readings(store, self.felt), motion.interval_s), motion


def _counts_down(odometer: OdometerReadings) -> bool:
    """Return True where a counter has fallen, or a speed was negative: it has a direction."""
    distance, speed = odometer.distance_m, odometer.speed_m_per_s
    return bool((distance[1:] < distance[:-1]).any() or (speed < 0.0).any())


def _poses(store: Store, records: Sequence[LogRecord]) -> Trajectory:
    """Return poses as recorded: an adjustment's corrections do not change clocks."""
    files = [f for r in records for f in r.tables["trajectory"]]
    rows = pa.concat_tables([read_groups(store, f.path, range(len(f.group_rows)), _POSES) for f in files])
    column = {name: rows.column(name).to_numpy() for name in _POSES}
    xyz, wxyz = ([column[c] for c in names] for names in (_POSES[1:4], _POSES[4:]))
    world = str(records[0].attributes["world_frame"])
    return Trajectory.of(world, column["epoch_gps_ns"], _columns(xyz), _columns(wxyz), _MAX_GAP_S)


# --- results -------------------------------------------------------------------------------------------


def _estimate(
    run: str, sensor: str, method: str, applied: str, correction: ClockCorrection, residuals: Residuals, key: str
) -> ClockEstimate:
    used = int(residuals.used.sum())
    now = dt.datetime.now(dt.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    return ClockEstimate(
        run, sensor, method, applied, correction, residuals, used, residuals.used.size - used, residuals.rms_s, key, now
    )


def _draw(survey: Survey, store: Store, manifest: Manifest, task: _Task, estimate: ClockEstimate) -> None:
    """Draw the picture of an estimate's residuals, unless it is there or there is no Matplotlib."""
    if estimate.residuals is None or not can_draw():
        return
    picture = ClockPicture(
        title=f"{survey.config.id} · run {estimate.run} · clock of {', '.join(task.sensors)}",
        method=estimate.method,
        correction=estimate.correction,
        residuals=estimate.residuals,
    )
    key = picture_key(picture.title, estimate.key, estimate.estimated_at)
    if not manifest.is_current(CLOCK_PICTURE, task.unit, key):
        target = clock_picture_path(task.unit)
        keep_file(store, manifest, (CLOCK_PICTURE, task.unit), key, target, lambda path: draw_clock(path, picture))


def _line(estimate: ClockEstimate) -> str:
    """Return one line of progress."""
    c = estimate.correction
    left = f", {estimate.refused} left out" if estimate.refused else ""
    return (
        f"{estimate.run}/{estimate.sensor}: {estimate.method}: {c.offset_s:+.6f} s ± {c.sigma_offset_s * 1e3:.3g} ms, "
        f"drift {c.drift * 1e6:+.3f} ± {c.sigma_drift * 1e6:.3g} ppm, "
        f"RMS {estimate.rms_s * 1e3:.3g} ms over {estimate.used} residuals{left}"
    )


def _columns(columns: list[npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    return np.stack(columns, axis=-1)
