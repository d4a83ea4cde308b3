"""Computes the trajectory of a run from its GNSS, IMU and odometer: load, check, smooth, yield rows.

Checks whether a smoothed trajectory follows the measurements that it was computed from.

Some wrong inputs cannot be detected by comparing motions beforehand (a horizontal gyroscope with the wrong sign on an
even road). They show in the result: the smoother has to trust either the IMU or GNSS, and they disagree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import NavigationError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.grid import of_run
from roadscan.core.survey import Survey
from roadscan.ingest.clock_correction import ClockCorrection
from roadscan.navigation.inertial.readings import GnssSolutions, Innovations, Solution, VehicleSensors
from roadscan.navigation.tasks.navigation_logs import (
    RunLogs,
    chosen,
    gnss_solutions,
    imu_readings,
    odometer_readings,
    vehicle_sensors,
)
from roadscan.navigation.tasks.trajectories import load_clocks
from roadscan.run.keys import code_digest, key_of, name_of
from roadscan.store.logs import NAVIGATION, LogRecord
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

Rows = tuple[str, pa.RecordBatch]


_ROWS: Final = 1 << 18  # Rows that are written at a time.


@dataclass(frozen=True)
class Computed:
    """A computed trajectory."""

    rows: Iterator[Rows]
    """Tables and rows."""
    attributes: dict[str, Any]
    """Attributes of its record: the world frame, the logs it was computed from, statistics."""


class PlannedTrajectory(Protocol):
    """A trajectory to compute."""

    @property
    def run(self) -> str:
        """Run it belongs to."""

    @property
    def format(self) -> str:
        """Name of the method: `smoother`, `spline` or `odometry`."""

    @property
    def key(self) -> str:
        """Hash of the logs, settings and code that determine it."""

    def compute(self, report: Callable[[str], None]) -> Computed:
        """Compute it."""


def sigma_figures(sigma_ned_m: Float64) -> dict[str, float]:
    """Return median and largest σ (m) of a trajectory, horizontal and down, for its record; empty where not stated.

    sigma_ned_m : (n, 3), NaN where unknown.
    """
    known = sigma_ned_m[np.isfinite(sigma_ned_m).all(axis=1)]
    if not known.size:
        return {}
    found: dict[str, float] = {}
    for name, values in (("horizontal", np.hypot(known[:, 0], known[:, 1])), ("down", known[:, 2])):
        found |= {f"median_sigma_{name}_m": float(np.median(values)), f"largest_sigma_{name}_m": float(values.max())}
    return found


def trajectory_rows(
    epochs_gps_ns: npt.NDArray[np.int64],
    position_world_m: Float64,
    quaternion_world_from_body: Float64,
    sigma_ned_m: Float64,
    sigma_rph_rad: Float64,
) -> Iterator[Rows]:
    """Yield rows of the table ``trajectory``; σ that are NaN become nulls."""
    columns: dict[str, npt.NDArray[Any]] = {"epoch_gps_ns": epochs_gps_ns}
    columns |= {f"{a}_world_m": position_world_m[:, i] for i, a in enumerate("xyz")}
    columns |= {q: quaternion_world_from_body[:, i] for i, q in enumerate(("qw", "qx", "qy", "qz"))}
    columns |= {f"sigma_{a}_m": sigma_ned_m[:, i] for i, a in enumerate(("north", "east", "down"))}
    columns |= {f"sigma_{a}_deg": np.degrees(sigma_rph_rad[:, i]) for i, a in enumerate(("roll", "pitch", "heading"))}
    yield from table_rows("trajectory", columns)


def table_rows(table: str, columns: dict[str, npt.NDArray[Any]]) -> Iterator[Rows]:
    """Yield rows of a table in pieces; NaN become nulls."""
    schema = table_schema(table).arrow()
    for start in range(0, columns["epoch_gps_ns"].size, _ROWS):
        part = slice(start, start + _ROWS)
        arrays = {
            name: pa.array(values[part], from_pandas=True).cast(schema.field(name).type, safe=False)
            for name, values in columns.items()
        }
        yield table, pa.RecordBatch.from_pydict(arrays)


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
        from roadscan.navigation.inertial.adaptive import solve_adaptively  # not for `sql`, which plans alone
        from roadscan.navigation.inertial.checks import prepared

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


FAR_SIGMAS: Final = 6.0
"""A position this many σ from the trajectory disagrees with it."""
LEAST_SIGMA_M: Final = 0.02
"""Least σ of a GNSS position in this check: receivers often state too small ones."""
FAR_SHARE: Final = 0.05
"""Largest share of positions that may disagree."""
CONTRADICTED: Final = 1 / 3
"""Largest share of another kind of measurement that may be outliers where positions disagree."""
_DOUBTFUL: Final = 0.1
"""Share of outliers above which a kind of measurement contradicts the trajectory."""
_LARGE: Final = 3.0
"""RMS of innovations over their σ above which it does."""
_LEAST: Final = 20  # With fewer measurements of a kind nothing is reported.
_CAUSE: Final = (
    "check axes, signs and units of the IMU (its horizontal axes above all), its errors in the rig file, clocks, the "
    "antenna's lever arm and the σ of the GNSS log"
)


@dataclass(frozen=True)
class Residuals:
    """Antenna position of the trajectory less that of GNSS."""

    records: Int64
    """(k,) rows of the GNSS log."""
    ned_m: Float64
    """(k, 3)."""
    sigmas: Float64
    """(k,) length over its σ."""


def residuals_of(solution: Solution, gnss: GnssSolutions, vehicle: VehicleSensors) -> Residuals:
    """Return residuals of the GNSS positions within the trajectory's pieces that state a covariance."""
    from roadscan.navigation.inertial.motion import ned_from_world

    epochs = gnss.epochs_gps_ns
    first, last = int(solution.epochs_gps_ns[0]), int(solution.epochs_gps_ns[-1])
    pieces = solution.pieces or ((first, last),)
    inside = np.any([(epochs >= a) & (epochs <= b) for a, b in pieces], axis=0)
    sigma = np.sqrt(np.trace(gnss.covariance_ned_m2, axis1=1, axis2=2))
    rows = np.flatnonzero(inside & np.isfinite(gnss.position_world_m[:, 0]) & np.isfinite(sigma))
    arm = vehicle.antenna_lever_arm_body_m
    found = solution.states.get("antenna_lever_arm_body_m")
    if found is not None and len(found[0]):
        arm = found[0][-1]
    antenna = solution.position_world_m + rotation_from_quaternion(solution.quaternion_world_from_body) @ arm
    origin = antenna[0]
    known, wanted = ((e - first).astype(np.float64) / NS_PER_S for e in (solution.epochs_gps_ns, epochs[rows]))
    at = np.stack([np.interp(wanted, known, antenna[:, k] - origin[k]) for k in range(3)], axis=-1)
    ned = (at - (gnss.position_world_m[rows] - origin)) @ ned_from_world(solution.world, origin).T
    own = np.interp(wanted, known, np.sqrt(np.einsum("nii->n", solution.covariance_position_ned_m2)))
    stated = np.maximum(sigma[rows], LEAST_SIGMA_M)
    return Residuals(rows, ned, np.linalg.norm(ned, axis=1) / np.hypot(stated, own))


def check_outcome(solution: Solution, gnss: GnssSolutions, vehicle: VehicleSensors) -> list[str]:
    """Reject a trajectory that its measurements contradict; return notes on one that is suspect.

    Multipath makes GNSS positions disagree, and them alone. Where an IMU is wrong, velocities, odometer and the
    constraints of a vehicle disagree, too.

    Returns
    -------
    What the user should know; empty where measurements and trajectory agree.

    Raises
    ------
    NavigationError
        where positions and another kind of measurement disagree with it.
    """
    doubted = _doubted(solution)
    positions = doubted.pop("gnss position", 0.0)
    most = max(doubted.values(), default=0.0)
    found = residuals_of(solution, gnss, vehicle)
    far = found.sigmas > FAR_SIGMAS
    is_far = found.sigmas.size >= _LEAST and far.mean() > FAR_SHARE
    if not (is_far and most > CONTRADICTED) and not min(positions, most) > 1.2 * CONTRADICTED:
        others = sum(share > _DOUBTFUL for share in doubted.values())
        if positions > 1.5 * _DOUBTFUL and others >= 2:
            said = _in_words(positions, doubted)
            return [f"measurements of several kinds disagree with the trajectory ({said} are outliers): {_CAUSE}"]
        return []
    size = np.linalg.norm(found.ned_m, axis=1)
    worst = int(np.argmax(size))
    record = int(found.records[worst])
    raise NavigationError(
        f"the measurements contradict the trajectory: {_in_words(positions, doubted)} count as outliers, and "
        f"{far.mean():.0%} of the GNSS positions lie more than {FAR_SIGMAS:g} σ away, the farthest, record {record} "
        f"({iso_from_gps_ns(int(gnss.epochs_gps_ns[record]))}), by {size[worst]:.2f} m",
        expected=f"less than a third of each kind, and at most {FAR_SHARE:.0%} so far away",
        change=_CAUSE,
        record=record,
    )


@dataclass(frozen=True)
class KindFigures:
    """Statistics of the updates of a kind."""

    kind: str
    updates: int
    outliers: float
    """Share that is down-weighted."""
    innovation: float
    """RMS of the innovations over their predicted σ."""


def figures_of(solution: Solution) -> list[KindFigures]:
    """Return statistics of the updates by kind, those of GNSS also together as 'gnss'."""
    found = solution.innovations
    if found is None:
        return []
    rows = {str(kind): found.kind == kind for kind in np.unique(found.kind)}
    rows = {"gnss": np.char.startswith(found.kind.astype(str), "gnss"), **rows}
    return [
        KindFigures(
            kind,
            int(own.sum()),
            float((found.weight[own] < 1.0).mean()),
            float(np.sqrt(found.normalised[own].mean())),
        )
        for kind, own in rows.items()
        if own.any()
    ]


def warnings_of(solution: Solution) -> list[str]:
    """Describe the kinds of measurement with many outliers, or with large innovations.

    Both a poor receiver and a wrong trajectory cause this: :func:`check_outcome` distinguishes them.
    """
    said = []
    for one in figures_of(solution):
        if one.updates < _LEAST or one.kind.startswith(("gnss ", "zero")):
            continue
        found = []
        if one.outliers > _DOUBTFUL:
            found.append(f"{one.outliers:.0%} of {one.updates:,} updates are outliers (at most {_DOUBTFUL:.0%})")
        if one.innovation > _LARGE:
            found.append(f"innovations are {one.innovation:.1f} σ (RMS; at most {_LARGE:g})")
        if found:
            said.append(f"'{one.kind}': {' and '.join(found)}")
    return [f"measurements disagree with the trajectory: {'; '.join(said)}: {_CAUSE}"] if said else []


def _doubted(solution: Solution) -> dict[str, float]:
    """Return the share of down-weighted measurements of each kind; kinds with too few are left out."""
    found = solution.innovations
    if found is None:
        return {}
    kinds = [kind for kind in np.unique(found.kind).tolist() if not kind.startswith("zero")]
    return {k: float((found.weight[found.kind == k] < 1.0).mean()) for k in kinds if (found.kind == k).sum() >= _LEAST}


def _in_words(positions: float, others: dict[str, float]) -> str:
    shares = {"gnss position": positions} | others
    return ", ".join(f"{share:.0%} of '{kind}'" for kind, share in shares.items())
