"""The tables ``clocks`` and ``clock_residuals``, which contain the estimated clocks of sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from roadscan.core.errors import DamagedError
from roadscan.ingest.clock_correction import ClockCorrection, Residuals
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store


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
