"""Navigate: GNSS, IMU and odometer of a run → its trajectory, beside the logs it came from.

A computed trajectory is held like a log of its own (sensor ``navigation``): its key names the logs, the rig, the
settings and the code that it was made from, and it is replaced when one of them changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.jobs.clocks import load_clocks
from roadscan.jobs.fingerprint import key_of, solver_version
from roadscan.jobs.ingest import plan_logs, survey_records
from roadscan.jobs.navigation_logs import (
    RunLogs,
    chosen,
    gnss_solutions,
    imu_readings,
    odometer_readings,
    vehicle_sensors,
)
from roadscan.model.errors import ConfigError, RoadscanError, RunError
from roadscan.model.survey import Survey
from roadscan.navigation.clocks import ClockCorrection
from roadscan.navigation.inertial.checks import prepared
from roadscan.navigation.inertial.readings import GnssSolutions, Innovations, Solution
from roadscan.navigation.inertial.smoother import solve
from roadscan.products.pictures.navigation import NavigationPicture, draw_navigation
from roadscan.tables.logs import LogRecord, has_log, read_log_records, retire_log, write_log_record
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store
from roadscan.tables.writer import LogWriter

NAVIGATION: Final = "navigation"
"""Sensor of the records of computed trajectories."""
SMOOTHER: Final = "smoother"
"""Their format."""

_ROWS: Final = 1 << 18


@dataclass(frozen=True)
class PlannedSolution:
    """A trajectory to compute."""

    logs: RunLogs
    clocks: tuple[tuple[str, ClockCorrection], ...]
    """Estimated corrections of the sensors' clocks."""
    key: str


def plan_solutions(survey: Survey, store: Store, records: Sequence[LogRecord]) -> list[PlannedSolution]:
    """Trajectories that the survey's logs ask for.

    Raises
    ------
    ConfigError
        where it is not clear which sensors navigate.
    """
    settings = survey.config.navigation
    if settings.solve == "never":
        return []
    clocks = load_clocks(store)
    found: list[PlannedSolution] = []
    for run in (r.id for r in survey.config.runs):
        if settings.solve == "missing" and any(r.run == run and r.tables.get("trajectory") for r in records):
            continue
        if not all(any(r.run == run and r.tables.get(table) for r in records) for table in ("imu", "gnss")):
            continue
        logs = RunLogs(
            run,
            *(chosen(records, run, t, getattr(settings.smoother, t)) for t in ("imu", "gnss", "encoder")),
        )
        if not logs.imu or not logs.gnss:
            continue
        sensors = sorted({r.sensor for r in logs.records})
        own = tuple((s, c) for s in sensors if (c := clocks.get((run, s)) or clocks.get(("*", s))) is not None)
        rig = {s: survey.rig.sensors[s].model_dump(mode="json") for s in sensors if s in survey.rig.sensors}
        key = key_of(
            SMOOTHER, solver_version(), run, [r.key for r in logs.records], rig, own,
            settings.smoother.model_dump(mode="json"),
        )  # fmt: skip
        found.append(PlannedSolution(logs, own, key))
    return found


def navigate(survey: Survey, store: Store, report: Callable[[str], None] = lambda _: None) -> list[LogRecord]:
    """Compute the trajectories that are missing or out of date.

    Raises
    ------
    RunError
        after all runs were tried, if one could not be computed; the others are kept.
    """
    done: list[LogRecord] = []
    failures: list[str] = []
    for planned in plan_solutions(survey, store, survey_records(survey, store)):
        fresh = not has_log(store, planned.key)
        if fresh:
            try:
                _compute(survey, store, planned, report)
            except RoadscanError as error:
                failures.append(f"run '{planned.logs.run}': {error}")
                report(f"failed: {failures[-1]}")
                continue
        record = read_log_records(store, [planned.key])[0]
        done.append(record)
        report(f"{'computed' if fresh else 'known'}: {record.run}/{NAVIGATION} {record.rows:,} rows{_figures(record)}")
    if failures:
        raise RunError(
            f"{len(failures)} trajectories could not be computed: " + " | ".join(failures),
            change="correct the survey or rig file or the logs; the next run computes only what is missing",
        )
    return done


def records_with_trajectories(survey: Survey, store: Store) -> list[LogRecord]:
    """Records of the survey file's logs and of the trajectories computed from them.

    Raises
    ------
    RunError
        where a log is not ingested, or a trajectory not computed from the logs as they are.
    """
    records = survey_records(survey, store)
    planned = plan_solutions(survey, store, records)
    missing = [p.logs.run for p in planned if not has_log(store, p.key)]
    if missing:
        raise RunError(
            f"the trajectory of run '{missing[0]}' is not computed, or of older logs or settings",
            change="run `roadscan navigate` (or `roadscan run`) first",
        )
    return [*records, *read_log_records(store, [p.key for p in planned])]


def known_keys(survey: Survey, store: Store) -> list[str]:
    """Keys of the survey file's logs that the store holds, and of the trajectories computed from them."""
    planned, _ = plan_logs(survey, store)
    keys = [log.key for log in planned if has_log(store, log.key)]
    try:
        solutions = plan_solutions(survey, store, read_log_records(store, keys))
    except ConfigError:
        return keys
    return keys + [p.key for p in solutions if has_log(store, p.key)]


def _compute(survey: Survey, store: Store, planned: PlannedSolution, report: Callable[[str], None]) -> None:
    logs = planned.logs
    clocks = dict(planned.clocks)
    vehicle = vehicle_sensors(survey.rig, logs)
    encoder = survey.rig.sensors.get(logs.encoder[0].sensor) if logs.encoder else None
    imu, gnss, odometer, repairs = prepared(
        _on_time(imu_readings(store, logs.imu), clocks.get(logs.imu[0].sensor)),
        _on_time(gnss_solutions(store, logs.gnss), clocks.get(logs.gnss[0].sensor)),
        _on_time(
            odometer_readings(store, logs.encoder, encoder),
            clocks.get(logs.encoder[0].sensor) if logs.encoder else None,
        ),
        vehicle,
    )
    for repair in repairs:
        report(f"repaired: run '{logs.run}': {repair}")
    solution = solve(imu, gnss, odometer, vehicle, survey.config.navigation.smoother)
    with store.scratch() as folder:
        writer = LogWriter(folder, None)
        for table, batch in _batches(solution):
            writer.add(table, batch)
        writer.finish()
        for old in read_log_records(store):
            if (old.run, old.sensor, old.format) == (logs.run, NAVIGATION, SMOOTHER) and old.key != planned.key:
                retire_log(store, old)
        tables = writer.publish(store, logs.run, NAVIGATION, planned.key)
        picture = folder / "navigation.png"
        title = f"{survey.config.id}, run {logs.run}"
        draw_navigation(picture, NavigationPicture(title, solution, gnss, vehicle.antenna_lever_arm_body_m))
        store.publish(picture, f"products/navigation/{logs.run}.png")
    write_log_record(
        store,
        LogRecord(
            key=planned.key,
            run=logs.run,
            sensor=NAVIGATION,
            format=SMOOTHER,
            path="",
            content=planned.key,
            source_bytes=0,
            tables=tables,
            attributes={
                "world_frame": solution.world,
                "logs": [r.key for r in logs.records],
                "repairs": [str(r) for r in repairs],
                **_summary(solution, gnss),
            },
            rows=writer.rows["trajectory"],
            rejected=0,
            reject_reasons={},
        ),
    )


def _on_time(readings: Any, clock: ClockCorrection | None) -> Any:
    """Readings with their clock's estimated correction applied."""
    if readings is None or clock is None:
        return readings
    return type(readings)(**{**readings.__dict__, "epochs_gps_ns": clock.applied(readings.epochs_gps_ns)})


def _batches(solution: Solution) -> Iterator[tuple[str, pa.RecordBatch]]:
    """Rows of the solution's tables."""
    sigma_ned = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2))
    columns: dict[str, npt.NDArray[Any]] = {"epoch_gps_ns": solution.epochs_gps_ns}
    columns |= {f"{a}_world_m": solution.position_world_m[:, i] for i, a in enumerate("xyz")}
    columns |= {q: solution.quaternion_world_from_body[:, i] for i, q in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {f"sigma_{a}_m": sigma_ned[:, i] for i, a in enumerate(("north", "east", "down"))}
    columns |= {
        f"sigma_{a}_deg": np.degrees(solution.sigma_rph_rad[:, i]) for i, a in enumerate(("roll", "pitch", "heading"))
    }
    yield from _rows("trajectory", columns)
    if solution.innovations is not None:
        yield from _rows("innovations", _innovation_columns(solution.innovations))
    for name, (value, sigma) in solution.states.items():
        for axis in range(1 if value.ndim == 1 else value.shape[1]):
            of_axis = (value, sigma) if value.ndim == 1 else (value[:, axis], sigma[:, axis])
            n = solution.state_epochs_gps_ns.size
            yield from _rows(
                "navigation_states",
                {
                    "epoch_gps_ns": solution.state_epochs_gps_ns,
                    "state": np.full(n, name),
                    "axis": np.full(n, axis, np.int32),
                    "value": of_axis[0],
                    "sigma": of_axis[1],
                },
            )


def _innovation_columns(found: Innovations) -> dict[str, npt.NDArray[Any]]:
    residuals = {f"residual_{i + 1}": found.residual[:, i] for i in range(3)}
    return {
        "epoch_gps_ns": found.epochs_gps_ns,
        "kind": found.kind,
        **residuals,
        "normalised": found.normalised,
        "weight": found.weight,
    }


def _rows(table: str, columns: dict[str, npt.NDArray[Any]]) -> Iterator[tuple[str, pa.RecordBatch]]:
    schema = table_schema(table).arrow()
    n = columns["epoch_gps_ns"].size
    for start in range(0, n, _ROWS):
        part = slice(start, start + _ROWS)
        arrays = {
            name: pa.array(values[part], from_pandas=True).cast(schema.field(name).type, safe=False)
            for name, values in columns.items()
        }
        yield table, pa.RecordBatch.from_pydict(arrays)


def _summary(solution: Solution, gnss: GnssSolutions) -> dict[str, Any]:
    """Figures of a solution for its record and for whoever looks at the run."""
    sigma = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2))
    found = solution.innovations
    figures: dict[str, Any] = {
        "gnss_epochs": int(gnss.epochs_gps_ns.size),
        "largest_sigma_horizontal_m": float(np.hypot(sigma[:, 0], sigma[:, 1]).max()),
        "largest_sigma_down_m": float(sigma[:, 2].max()),
        "largest_sigma_heading_deg": float(np.degrees(solution.sigma_rph_rad[:, 2].max())),
    }
    if found is not None:
        figures["updates"] = int(found.weight.size)
        figures["outliers"] = int((found.weight < 1).sum())
    return figures


def _figures(record: LogRecord) -> str:
    a = record.attributes
    text = f", σ up to {a['largest_sigma_horizontal_m']:.3f} m horizontal, {a['largest_sigma_down_m']:.3f} m down"
    if "outliers" in a:
        text += f", {a['outliers']:,} of {a['updates']:,} updates are outliers"
    return text
