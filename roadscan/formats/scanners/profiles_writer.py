"""Writes profiles in arrays as `scans`: heights become integers in units of a quantum."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.core.scan_geometry import ScanGeometry
from roadscan.formats.scanners.scans import GEOMETRY_KEY
from roadscan.ingest.array_files import (
    ClockLike,
    WrittenLog,
    epochs_gps_ns,
    float_array,
    parquet_file,
    whole_array,
)

STEPS: Final = 65_534
"""Steps between the lowest and the highest raw value of a reading: 1 and 65,535."""

_ACROSS_TOLERANCE_M: Final = 1e-5  # largest deviation from even spacing
_FINEST_M: Final = 1e-6
"""Finest quantum (m): readings are placed in multiples of 10 µm."""
_GROUP_READINGS: Final = 1 << 20  # readings of a row group


@dataclass(frozen=True)
class WrittenProfiles(WrittenLog):
    """Profiles that were written."""

    geometry: ScanGeometry
    """Geometry of the readings; pass it as `quantum` to write more files of the same log."""
    quantum_m: float
    """Height of one raw unit (m)."""
    largest_error_m: float
    """Largest difference between a height and its written value (m): at most half a quantum."""
    missing: int
    """Readings that are NaN, written as no return."""


def write_profiles(
    path: str | Path,
    epochs: Any,
    heights_m: Any,
    across_m: Any,
    *,
    intensity: Any = None,
    clock: ClockLike = None,
    sensor_height_m: float = 0.0,
    quantum: float | ScanGeometry | None = None,
) -> WrittenProfiles:
    """Write a profiler's readings as a Parquet log that `roadscan` reads as `scans`; return what was written.

    A reading lies in the sensor's y-z plane: y is its position across (positive to the right where the rig file
    states no other axes than ``frd``), z points down, away from its height.

    Parameters
    ----------
    epochs : (n,) GPS nanoseconds (int64), or stamps of `clock`, or calendar times; all readings of a profile are
        measured at once.
    heights_m : (n, m) heights, positive upwards, on the scale on which the sensor's origin is at `sensor_height_m`;
        with its 0, heights of a road below the sensor are negative. NaN is no reading.
    across_m : (m,) positions of the readings across, evenly spaced to 10 µm.
    intensity : (n, m) whole numbers from 0 to 255.
    clock : time system of the epochs, keys as in the survey file; None for GPS nanoseconds.
    sensor_height_m : height of the sensor's origin on the scale of the heights; no reading may lie above it.
    quantum : height of one raw unit (m); left out, the finest of 1, 2, 5 times a power of ten in which the heights
        fit into 65,535 steps. The geometry of a file of the same log, so that several make one log.

    Raises
    ------
    ConfigError, TimeSystemError
        if shapes differ, positions are not evenly spaced, a reading lies above the sensor or the heights do not fit
        into 65,535 steps of the quantum, or if epochs say no time system.
    """
    target = Path(path)
    epoch_gps_ns = epochs_gps_ns(epochs, clock, "epochs")
    across = float_array(across_m, np.shape(across_m), "across_m")
    heights = float_array(heights_m, (epoch_gps_ns.size, across.size), "heights_m")
    light = None if intensity is None else whole_array(intensity, heights.shape, np.uint8, "intensity")
    geometry = _geometry(across, _span(heights, sensor_height_m), quantum)
    metadata = {GEOMETRY_KEY: json.dumps(geometry.model_dump(mode="json"))}
    fields = [("epoch_gps_ns", pa.int64()), ("range", pa.list_(pa.uint16(), across.size))]
    fields += [] if light is None else [("intensity", pa.list_(pa.uint8(), across.size))]
    schema = pa.schema(fields, metadata=metadata)
    largest, rows = 0.0, max(1, _GROUP_READINGS // across.size)
    with parquet_file(target, schema) as writer:
        for first in range(0, epoch_gps_ns.size, rows):
            part = slice(first, first + rows)
            ranges = sensor_height_m - heights[part]
            raw = _raw(ranges, geometry)
            largest = max(largest, _largest_error(ranges, raw, geometry))
            columns = [pa.array(epoch_gps_ns[part]), _lists(raw)] + ([] if light is None else [_lists(light[part])])
            writer.write_table(pa.table(columns, schema=schema))
    missing = int(np.count_nonzero(np.isnan(heights)))
    first_epoch, last_epoch = int(epoch_gps_ns.min()), int(epoch_gps_ns.max())
    return WrittenProfiles(
        target, epoch_gps_ns.size, first_epoch, last_epoch, geometry, geometry.range_step_m, largest, missing
    )


def _span(heights: Float64, sensor_height_m: float) -> tuple[float, float]:
    """Return the least and greatest range (m) of the readings."""
    if np.isinf(heights).any():
        raise ConfigError("heights_m holds an infinite height", expected="metres, or NaN for no reading")
    if np.isnan(heights).all():
        raise ConfigError("heights_m holds no reading, NaN alone", expected="one or more heights")
    nearest, farthest = sensor_height_m - float(np.nanmax(heights)), sensor_height_m - float(np.nanmin(heights))
    if nearest < 0:
        raise ConfigError(
            f"a reading lies {-nearest:g} m above the sensor's origin (height {sensor_height_m:g} m)",
            expected="heights below it: a profiler looks down",
            change="state sensor_height_m, the height of the origin on the scale of heights_m; the lever arm of the "
            "rig file leads to that point",
        )
    return nearest, farthest


def _geometry(across: Float64, span: tuple[float, float], quantum: float | ScanGeometry | None) -> ScanGeometry:
    first, step = _even(across)
    if isinstance(quantum, ScanGeometry):
        _check_same(quantum, first, step, across.size)
        _check_fits(span, quantum)
        return quantum
    nearest, farthest = span
    unit = _fitting_quantum(farthest - nearest) if quantum is None else float(quantum)
    if not (math.isfinite(unit) and unit > 0):
        raise ConfigError(f"quantum is {unit:g} m", expected="a height above 0")
    middle = round((nearest + farthest) / 2 / unit)
    offset = (middle - (STEPS // 2 + 1)) * unit  # leaves room on both sides for more files of the log
    found = ScanGeometry(
        kind="cartesian", readings=across.size, first=first, step=step, range_offset_m=offset, range_step_m=unit
    )
    _check_fits(span, found)
    return found


def _even(across: Float64) -> tuple[float, float]:
    """Return the first position and the step of evenly spaced positions (m)."""
    if across.ndim != 1 or across.size < 2 or not np.isfinite(across).all():
        raise ConfigError(f"across_m has the shape {across.shape}", expected="(m,), two or more positions in metres")
    first, step = float(across[0]), float(across[-1] - across[0]) / (across.size - 1)
    error = float(np.abs(first + step * np.arange(across.size) - across).max())
    if step == 0.0 or error > _ACROSS_TOLERANCE_M:
        raise ConfigError(
            f"across_m is not evenly spaced: a position is {error:.3g} m off",
            expected=f"steps of one size, to {_ACROSS_TOLERANCE_M:g} m",
            change="interpolate the heights at evenly spaced positions, with NaN where there is no reading near",
        )
    return first, step


def _fitting_quantum(span_m: float) -> float:
    """Return the finest 1, 2 or 5 times a power of ten that covers a span with two steps to spare."""
    least = max(span_m / (STEPS - 2), _FINEST_M)
    power = math.floor(math.log10(least))
    tens = (float(f"{digit}e{power + more}") for more in (0, 1) for digit in (1, 2, 5))
    return next(unit for unit in tens if unit >= least * (1 - 1e-12))


def _check_fits(span: tuple[float, float], geometry: ScanGeometry) -> None:
    low, high = (_raw_number(limit, geometry) for limit in span)
    if low < 1 or high > STEPS + 1:
        least = (span[1] - span[0]) / STEPS
        raise ConfigError(
            f"ranges from {span[0]:g} to {span[1]:g} m do not fit into {STEPS + 1:,} steps of "
            f"{geometry.range_step_m:g} m",
            expected=f"a quantum of {least:.3g} m or more, or heights nearer to one another",
            change="state another quantum, or set far readings to NaN",
        )


def _check_same(geometry: ScanGeometry, first: float, step: float, readings: int) -> None:
    off = abs(first - geometry.first) + readings * abs(step - geometry.step)
    if geometry.kind != "cartesian" or geometry.readings != readings or off > _ACROSS_TOLERANCE_M:
        raise ConfigError(
            "across_m differs from the geometry that is handed on", expected="the same positions in all files of a log"
        )


def _raw_number(range_m: Any, geometry: ScanGeometry) -> Any:
    return np.rint((range_m - geometry.range_offset_m) / geometry.range_step_m)


def _raw(ranges: Float64, geometry: ScanGeometry) -> npt.NDArray[np.uint16]:
    number = _raw_number(ranges, geometry)
    return np.where(np.isnan(number), 0, number).astype(np.uint16)


def _largest_error(ranges: Float64, raw: npt.NDArray[np.uint16], geometry: ScanGeometry) -> float:
    known = raw > 0
    if not known.any():
        return 0.0
    return float(np.abs(geometry.range_offset_m + geometry.range_step_m * raw - ranges)[known].max())


def _lists(values: npt.NDArray[Any]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).ravel()), values.shape[1])
