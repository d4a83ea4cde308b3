"""Loads trajectories of runs, their corrections and their clocks from the store, and stores the clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import DamagedError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.settings.calibration import CalibrationSettings
from roadscan.ingest.clock_correction import ClockCorrection, Residuals
from roadscan.poses.trajectory import STENCIL_KNOTS, Corrections, Trajectory
from roadscan.store.logs import DataFile, LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store

_SIGMA_COLUMNS = ["sigma_north_m", "sigma_east_m", "sigma_down_m"]

CORRECTION_SIGMAS: Final = tuple(
    f"sigma_{name}" for name in ("north_m", "east_m", "down_m", "roll_rad", "pitch_rad", "heading_rad")
)
"""Columns of the table `corrections`."""

_POSE_COLUMNS = ["epoch_gps_ns", "x_world_m", "y_world_m", "z_world_m", "qw", "qx", "qy", "qz", *_SIGMA_COLUMNS]


@dataclass(frozen=True)
class TrajectorySource:
    """Location of the poses of a run."""

    run: str
    world: str
    files: tuple[DataFile, ...]


def load_trajectory(
    store: Store, source: TrajectorySource, spans: Sequence[tuple[int, int]], max_gap_s: float
) -> Trajectory:
    """Load poses of a run around spans of time, with corrections.

    Poses beyond each span are read as far as interpolation uses them, so the result does not depend on the spans.
    """
    return load_recorded(store, source, spans, max_gap_s).corrected(load_corrections(store, source.run))


def load_recorded(
    store: Store, source: TrajectorySource, spans: Sequence[tuple[int, int]], max_gap_s: float
) -> Trajectory:
    """Load the same poses as recorded."""
    pad = round(STENCIL_KNOTS * max_gap_s * NS_PER_S)
    wanted = np.array(spans, dtype=np.int64).reshape(-1, 2) + np.array([-pad, pad])
    parts: list[pa.Table] = []
    for file in source.files:
        held = np.array(file.group_spans, dtype=np.int64).reshape(-1, 1, 2)
        is_near = (held[:, :, 0] <= wanted[:, 1]) & (held[:, :, 1] >= wanted[:, 0])
        groups = np.flatnonzero(is_near.any(axis=1)).tolist()
        if groups:
            parts.append(read_groups(store, file.path, groups, _POSE_COLUMNS))
    if not parts:
        empty = np.zeros(0, np.int64)
        return Trajectory(source.world, empty, np.zeros((0, 3)), np.zeros((0, 4)), max_gap_s)
    rows = pa.concat_tables(parts)
    epochs = rows.column("epoch_gps_ns").to_numpy()
    rows = rows.filter((epochs >= wanted[:, 0].min()) & (epochs <= wanted[:, 1].max()))  # row groups hold minutes
    column = {name: rows.column(name).to_numpy() for name in _POSE_COLUMNS}
    return Trajectory.of(
        source.world,
        column["epoch_gps_ns"],
        np.stack([column[f"{a}_world_m"] for a in "xyz"], axis=-1),
        np.stack([column[a] for a in ("qw", "qx", "qy", "qz")], axis=-1),
        max_gap_s,
        np.stack([column[a] for a in _SIGMA_COLUMNS], axis=-1).astype(np.float64),
    )


def load_corrections(store: Store, run: str) -> Corrections | None:
    """Load corrections of a run's trajectory, None where no adjustment wrote any."""
    rows = read_small(store, "corrections")
    return None if rows is None else _corrections(rows, run)


def load_all_corrections(store: Store) -> dict[str, Corrections]:
    """Load corrections of the trajectories of all runs that have any."""
    rows = read_small(store, "corrections")
    runs = [] if rows is None else sorted(pc.unique(rows.column("run")).to_pylist())
    return {run: found for run in runs if (found := _corrections(rows, run)) is not None}


def _corrections(rows: pa.Table, run: str) -> Corrections | None:
    rows = rows.filter(pc.equal(rows.column("run"), run))
    if rows.num_rows == 0:
        return None
    return Corrections(
        rows.column("epoch_gps_ns").to_numpy(),
        np.stack([rows.column(c).to_numpy() for c in ("north_m", "east_m", "down_m")], axis=-1),
        np.stack([rows.column(c).to_numpy() for c in ("roll_rad", "pitch_rad", "heading_rad")], axis=-1),
        _sigma(rows),
    )


def _sigma(rows: pa.Table) -> npt.NDArray[np.float64] | None:
    """Return 1 σ (k, 6) of corrected poses; None in tables that state none."""
    if any(name not in rows.column_names for name in CORRECTION_SIGMAS):
        return None
    return np.stack([pc.fill_null(rows.column(c), np.nan).to_numpy() for c in CORRECTION_SIGMAS], axis=-1)


_SIGMAS: Final = (
    "sigma_north_m", "sigma_east_m", "sigma_down_m", "sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg",
)  # fmt: skip


_STEP_NS: Final = 100_000_000
"""Interval at which σ of poses are kept: they change over seconds."""


def pose_sigma(
    store: Store,
    records: Sequence[LogRecord],
    source: TrajectorySource,
    epochs: Int64,
    settings: CalibrationSettings,
) -> Float64:
    """Return 1 σ (n, 6) of poses at epochs (n,): north, east, down (m), roll, pitch, heading (rad).

    Where the run's logs state none, that of the settings.
    """
    assumed = np.array([*settings.traverse_sigma_m, *settings.traverse_sigma_deg])
    sigma = np.full((epochs.size, 6), np.nan)
    for known_epochs, values in _stated(store, records, source):
        for k in range(6):
            known = np.isfinite(values[:, k])
            if known.any() and np.isnan(sigma[:, k]).any():
                since = (known_epochs[known] - epochs[0]).astype(np.float64)
                sigma[:, k] = np.interp((epochs - epochs[0]).astype(np.float64), since, values[known, k])
    return _in_radians(np.where(np.isnan(sigma), assumed, sigma))


def usual_pose_sigma(
    store: Store, records: Sequence[LogRecord], source: TrajectorySource, settings: CalibrationSettings
) -> Float64:
    """Return 1 σ (6,) of a run's poses, the median over the run."""
    usual = median_pose_sigma(store, records, source)
    assumed = np.array([*settings.traverse_sigma_m, *settings.traverse_sigma_deg])
    return _in_radians(np.where(np.isnan(usual), assumed, usual))


def median_pose_sigma(store: Store, records: Sequence[LogRecord], source: TrajectorySource) -> Float64:
    """Return 1 σ (6,) of a run's poses as stated in its logs, the median over the run (m, degrees); NaN where not."""
    usual = np.full(6, np.nan)
    for _, values in _stated(store, records, source):
        for k in range(6):
            if np.isnan(usual[k]) and np.isfinite(values[:, k]).any():
                usual[k] = np.nanmedian(values[:, k])
    return usual


def stated_pose_sigma(
    store: Store, records: Sequence[LogRecord], source: TrajectorySource
) -> tuple[Int64, Float64]:  # fmt: skip
    """Return epochs (k,) and 1 σ (k, 6; m, radians) of a run's poses as stated, at most one each tenth of a second.

    Of each component those of the poses themselves, else those of an accuracy log; NaN of components that neither
    states. What is not above 0 is no σ.
    """
    found: list[tuple[Int64, Float64] | None] = [None] * 6
    for epochs, values in _stated(store, records, source):
        for k in range(6):
            known = np.isfinite(values[:, k]) & (values[:, k] > 0.0)
            if found[k] is None and known.any():
                found[k] = _thinned(epochs[known], values[known, k])
    parts = [one[0] for one in found if one is not None]
    every = np.unique(np.concatenate(parts)) if parts else np.zeros(0, np.int64)
    sigma = np.full((every.size, 6), np.nan)
    for k, one in enumerate(found):
        if one is not None:
            since, known_since = ((e - every[0]).astype(np.float64) for e in (every, one[0]))
            sigma[:, k] = np.interp(since, known_since, one[1])
    return every, _in_radians(sigma)


def _thinned(epochs_gps_ns: Int64, sigma: Float64) -> tuple[Int64, Float64]:
    """Return the largest σ of each tenth of a second, with its epoch."""
    steps, of_row = np.unique(epochs_gps_ns // _STEP_NS, return_inverse=True)
    order = np.lexsort((epochs_gps_ns, -sigma, of_row))
    first = order[np.searchsorted(of_row[order], np.arange(steps.size))]
    return epochs_gps_ns[first], sigma[first]


def _stated(store: Store, records: Sequence[LogRecord], source: TrajectorySource) -> list[tuple[Int64, Float64]]:
    """Yield epochs and σ (n, 6; m and degrees) of the poses themselves, then of the run's accuracy logs."""
    accuracy = [f for r in records if r.run == source.run for f in r.tables.get("trajectory_accuracy", ())]
    found: list[tuple[Int64, Float64]] = []
    for files in (source.files, accuracy):
        parts = [read_groups(store, f.path, range(len(f.group_rows)), ["epoch_gps_ns", *_SIGMAS]) for f in files]
        if parts:
            rows = pa.concat_tables(parts).sort_by("epoch_gps_ns")
            values = [pc.fill_null(rows.column(n).cast(pa.float64()), np.nan).to_numpy() for n in _SIGMAS]
            found.append((rows.column("epoch_gps_ns").to_numpy(), np.stack(values, axis=-1)))
    return found


def _in_radians(sigma: Float64) -> Float64:
    """Convert σ of m and degrees to m and radians; none is smaller than what makes the estimate regular."""
    out = np.asarray(sigma, dtype=np.float64).copy()
    out[..., 3:] = np.radians(out[..., 3:])
    return out


@dataclass(frozen=True)
class ClockEstimate:
    """One row of the table ``clocks``, with its residuals."""

    run: str
    sensor: str
    method: str
    applied: str
    """'epochs' or 'ingest', as in ``schemas/clocks.toml``."""
    correction: ClockCorrection
    residuals: Residuals | None
    """Residuals; None for a sensor that shares the clock of another."""
    used: int
    refused: int
    rms_s: float
    key: str
    estimated_at: str


def clock_unit(run: str, sensor: str, applied: str) -> str:
    """Return the name of the picture of a clock's residuals, without suffix."""
    return f"{run}_{sensor}{'_pairs' if applied == 'ingest' else ''}"


def clock_picture_path(unit: str) -> str:
    """Return its path, relative to the survey's root."""
    return f"products/clocks/{unit}.png"


def load_clocks(store: Store) -> dict[tuple[str, str], ClockCorrection]:
    """Read corrections of ingested epochs by run ('*' for all) and sensor; empty where nothing was estimated."""
    return {
        (e.run, e.sensor): e.correction
        for e in kept_estimates(store, with_residuals=False)
        if e.applied == "epochs"
    }  # fmt: skip


def kept_estimates(store: Store, *, with_residuals: bool = True) -> list[ClockEstimate]:
    """Read the estimates of the tables."""
    rows = _read(store, "clocks")
    left = _read(store, "clock_residuals") if with_residuals else []
    return [
        ClockEstimate(
            run=row["run"],
            sensor=row["sensor"],
            method=row["method"],
            applied=row["applied"],
            correction=ClockCorrection(
                offset_s=row["offset_s"],
                drift=row["drift_ppm"] * 1e-6,
                reference_gps_ns=row["reference_gps_ns"],
                sigma_offset_s=row["sigma_offset_s"],
                sigma_drift=row["sigma_drift_ppm"] * 1e-6,
                correlation=row["correlation"],
                first_gps_ns=row["first_gps_ns"],
                last_gps_ns=row["last_gps_ns"],
            ),
            residuals=_residuals([one for one in left if _owner(one) == _owner(row)]),
            used=row["residuals"],
            refused=row["refused"],
            rms_s=row["rms_s"],
            key=row["estimate"],
            estimated_at=row["estimated_at"],
        )
        for row in rows
    ]


def _owner(row: dict[str, Any]) -> tuple[str, str, str]:
    return row["run"], row["sensor"], row["applied"]


def _residuals(rows: list[dict[str, Any]]) -> Residuals | None:
    if not rows:
        return None
    return Residuals(
        np.array([r["epoch_gps_ns"] for r in rows], dtype=np.int64),
        np.array([r["residual_s"] for r in rows]),
        np.array([r["sigma_s"] for r in rows]),
        np.array([r["used"] == 1 for r in rows]),
    )


def _read(store: Store, name: str) -> list[dict[str, Any]]:
    table = read_small(store, name)
    return [] if table is None else list(table.to_pylist())


def set_damaged_clocks_aside(store: Store) -> list[str]:
    """Move unreadable tables aside, so that the clocks are estimated again; return what was done."""
    done: list[str] = []
    for name in ("clocks", "clock_residuals"):
        try:
            _read(store, name)
        except DamagedError as error:
            aside = store.set_aside(small_path(name))
            done.append(f"the table `{name}` is damaged ({error.arrived}) and was set aside ({aside}): it is made anew")
    return done


def keep_estimates(store: Store, estimates: Sequence[ClockEstimate]) -> None:
    """Replace both tables: residuals first, so that no clock is visible without its residuals."""
    residuals = [
        {
            "run": e.run,
            "sensor": e.sensor,
            "applied": e.applied,
            "epoch_gps_ns": int(e.residuals.epochs_gps_ns[i]),
            "residual_s": float(e.residuals.residual_s[i]),
            "sigma_s": float(e.residuals.sigma_s[i]),
            "weight": float(weight),
            "used": int(e.residuals.used[i]),
        }
        for e in estimates
        if e.residuals is not None
        for i, weight in enumerate(e.residuals.weights)
    ]
    clocks = [
        {
            "run": e.run,
            "sensor": e.sensor,
            "applied": e.applied,
            "offset_s": e.correction.offset_s,
            "drift_ppm": e.correction.drift * 1e6,
            "reference_gps_ns": e.correction.reference_gps_ns,
            "sigma_offset_s": e.correction.sigma_offset_s,
            "sigma_drift_ppm": e.correction.sigma_drift * 1e6,
            "correlation": e.correction.correlation,
            "method": e.method,
            "residuals": e.used,
            "refused": e.refused,
            "rms_s": e.rms_s,
            "first_gps_ns": e.correction.first_gps_ns,
            "last_gps_ns": e.correction.last_gps_ns,
            "estimated_at": e.estimated_at,
            "estimate": e.key,
        }
        for e in estimates
    ]
    write_small(store, "clock_residuals", residuals)
    write_small(store, "clocks", clocks)
