"""Computes the trajectory of a run from its GNSS, IMU and odometer: load, check, smooth, yield rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.ids import of_run
from roadscan.core.survey import Survey
from roadscan.ingest.clocks.correction import ClockCorrection
from roadscan.navigation.inertial.adaptive import solve_adaptively
from roadscan.navigation.inertial.checks import prepared
from roadscan.navigation.inertial.outcome import check_outcome, warnings_of
from roadscan.navigation.inertial.readings import GnssSolutions, Innovations, Solution
from roadscan.navigation.tasks.clock_tables import load_clocks
from roadscan.navigation.tasks.computed_trajectory import Computed, Rows, sigma_figures, table_rows, trajectory_rows
from roadscan.navigation.tasks.navigation_logs import (
    RunLogs,
    chosen,
    gnss_solutions,
    imu_readings,
    odometer_readings,
    vehicle_sensors,
)
from roadscan.run.code_reach import code_digest, name_of
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.logs import NAVIGATION, LogRecord
from roadscan.store.store import Store

SMOOTHER: Final = "smoother"
"""Format of the records of these trajectories."""


@dataclass(frozen=True)
class PlannedSolution:
    """A trajectory to compute from a run's sensors."""

    survey: Survey
    store: Store
    logs: RunLogs
    clocks: tuple[tuple[str, ClockCorrection], ...]
    """Estimated corrections of the sensors' clocks."""
    key: str
    format: str = SMOOTHER

    @property
    def run(self) -> str:
        """Run it belongs to."""
        return self.logs.run

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Smooth the logs.

        Raises
        ------
        RoadscanError
            where logs or rig file do not suffice, or contradict one another.
        """
        logs, clocks, survey = self.logs, dict(self.clocks), self.survey
        settings = survey.config.navigation.smoother
        vehicle = vehicle_sensors(survey.rig, logs)
        wheel = logs.encoder[0].sensor if logs.encoder else ""
        imu, gnss, odometer, repairs = prepared(
            on_time(imu_readings(self.store, logs.imu), clocks.get(logs.imu[0].sensor)),
            on_time(gnss_solutions(self.store, logs.gnss), clocks.get(logs.gnss[0].sensor)),
            on_time(odometer_readings(self.store, logs.encoder, survey.rig.sensors.get(wheel)), clocks.get(wheel)),
            vehicle,
            drove_backwards=logs.run in settings.reversed_runs,
        )
        for repair in repairs:
            report(f"repaired: run '{logs.run}': {repair}")
        adapted = solve_adaptively(imu, gnss, odometer, vehicle, settings)
        solution = adapted.solution
        for note in (*adapted.notes, *solution.notes):
            report(f"navigate: run '{logs.run}': {note}")
        doubts = [*check_outcome(solution, gnss, vehicle), *warnings_of(solution)]
        for doubt in doubts:
            report(f"doubtful: run '{logs.run}': {doubt}")
        attributes = {
            "world_frame": solution.world,
            "logs": [r.key for r in logs.records],
            "repairs": [str(r) for r in repairs],
            "notes": list(solution.notes),
            "measured_noise": {name: list(pair) for name, pair in adapted.measured.items()},
            "pieces": [list(piece) for piece in solution.pieces],
            "doubts": doubts,
            **_summary(solution, gnss),
        }
        return Computed(_batches(solution), attributes)


def plan_solutions(survey: Survey, store: Store, records: Sequence[LogRecord]) -> list[PlannedSolution]:
    """Return trajectories that the survey's logs request.

    Raises
    ------
    ConfigError
        where it is not clear which sensors navigate.
    """
    settings = survey.config.navigation
    if settings.solve == "never":
        return []
    clocks, code = load_clocks(store), code_digest(name_of(PlannedSolution))
    found: list[PlannedSolution] = []
    for run in (r.id for r in survey.config.runs):
        given = (r for r in records if r.run == run and r.tables.get("trajectory") and r.sensor != NAVIGATION)
        if settings.solve == "missing" and any(given):
            continue
        if not all(any(r.run == run and r.tables.get(table) for r in records) for table in ("imu", "gnss")):
            continue
        logs = RunLogs(
            run,
            *(
                chosen(records, run, t, getattr(settings.smoother, t), f"[navigation.smoother] {t}")
                for t in ("imu", "gnss", "encoder")
            ),
        )
        if not logs.imu or not logs.gnss:
            continue
        sensors = sorted({r.sensor for r in logs.records})
        own = tuple((s, c) for s in sensors if (c := of_run(clocks, run, s)) is not None)
        rig = {s: survey.rig.sensors[s].model_dump(mode="json") for s in sensors if s in survey.rig.sensors}
        key = key_of(
            SMOOTHER, code, run, [r.key for r in logs.records], rig, own,
            settings.smoother.model_dump(mode="json"),
        )  # fmt: skip
        found.append(PlannedSolution(survey, store, logs, own, key))
    return found


def on_time(readings: Any, clock: ClockCorrection | None) -> Any:
    """Return readings with their clock's estimated correction applied."""
    if readings is None or clock is None:
        return readings
    return type(readings)(**{**readings.__dict__, "epochs_gps_ns": clock.applied(readings.epochs_gps_ns)})


def _batches(solution: Solution) -> Iterator[Rows]:
    """Yield rows of the solution's tables."""
    sigma_ned = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2))
    yield from trajectory_rows(
        solution.epochs_gps_ns,
        solution.position_world_m,
        solution.quaternion_world_from_body,
        sigma_ned,
        solution.sigma_rph_rad,
    )
    if solution.innovations is not None:
        yield from table_rows("innovations", _innovation_columns(solution.innovations))
    for name, (value, sigma) in solution.states.items():
        for axis in range(1 if value.ndim == 1 else value.shape[1]):
            of_axis = (value, sigma) if value.ndim == 1 else (value[:, axis], sigma[:, axis])
            n = solution.state_epochs_gps_ns.size
            yield from table_rows(
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


def _summary(solution: Solution, gnss: GnssSolutions) -> dict[str, Any]:
    """Return statistics of a solution for its record."""
    sigma = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2))
    found = solution.innovations
    figures: dict[str, Any] = {
        "gnss_epochs": int(gnss.epochs_gps_ns.size),
        **sigma_figures(sigma),
        "largest_sigma_heading_deg": float(np.degrees(solution.sigma_rph_rad[:, 2].max())),
    }
    if found is not None:
        figures["updates"] = int(found.weight.size)
        figures["outliers"] = int((found.weight < 1).sum())
    return figures
