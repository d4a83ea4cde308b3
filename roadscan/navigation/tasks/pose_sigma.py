"""σ of poses as stated in a run's logs: beside the poses, or in a separate accuracy log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.settings.calibration import CalibrationSettings
from roadscan.navigation.tasks.trajectories import TrajectorySource
from roadscan.store.logs import LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

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
