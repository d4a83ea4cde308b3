"""Raw profiles of a pavement, made as fast as they can be written: one patch of texture, shifted and repeated."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.ndimage import gaussian_filter

from benchmarks.course import START_GPS_NS

UInt16 = npt.NDArray[np.uint16]
UInt8 = npt.NDArray[np.uint8]
Int64 = npt.NDArray[np.int64]

BATCH_PROFILES = 512
RANGE_STEP_M = 5e-5
_PATCH_PROFILES = 1024
_NO_RETURN = 0.004
_OUTLIERS = 0.001


@dataclass(frozen=True)
class Patch:
    """Readings over a piece of road, profiles × readings across the lane; 0 is no return."""

    ranges: UInt16
    intensity: UInt8


def patch(readings: int, profiles: int, middle: int, seed: int = 5) -> Patch:
    """Texture of 0.3 mm, cracks, loose stones, no-returns and outliers about the raw range `middle`.

    profiles : of the whole road; a short one needs no larger patch.
    """
    rng = np.random.default_rng(seed)
    shape = (min(profiles, _PATCH_PROFILES), readings)
    grain = gaussian_filter(rng.standard_normal(shape, np.float32), 2.0, mode="wrap")
    down_m = 3e-4 * (0.95 * grain / grain.std() + 0.3 * rng.standard_normal(shape, np.float32))
    light = 95 + 25 * grain / grain.std() + 4 * rng.standard_normal(shape, np.float32)
    for _ in range(6):  # cracks of 4 mm, 8 mm deep, that wander across the lane
        walk = np.cumsum(rng.integers(-2, 3, shape[0])) + rng.integers(100, readings - 100)
        for wide in range(4):
            at = np.clip(walk + wide, 0, readings - 1)
            down_m[np.arange(shape[0]), at] += 8e-3
            light[np.arange(shape[0]), at] *= 0.4
    for _ in range(30):  # stones of 8 mm
        i, j = rng.integers(0, shape[0] - 9), rng.integers(0, readings - 9)
        down_m[i : i + 8, j : j + 8] -= 8e-3
    wrong = rng.random(shape) < _OUTLIERS
    down_m[wrong] += rng.uniform(-0.03, 0.03, int(wrong.sum()))
    ranges = np.round(middle + down_m / RANGE_STEP_M).astype(np.uint16)
    ranges[rng.random(shape) < _NO_RETURN] = 0
    intensity = np.clip(light, 1, 255).astype(np.uint8)
    intensity[ranges == 0] = 0
    return Patch(ranges, intensity)


@numba.njit(cache=True, nogil=True)
def repeat(ranges, intensity, rows, shifts, out_ranges, out_intensity):
    """Profile i is row rows[i] of the patch, its ranges longer by shifts[i]; no-returns stay."""
    for i in range(rows.size):
        source, light, target, bright = ranges[rows[i]], intensity[rows[i]], out_ranges[i], out_intensity[i]
        shift = np.uint16(shifts[i])
        for j in range(source.size):
            target[j] = np.uint16(source[j] + shift) if source[j] != 0 else np.uint16(0)
            bright[j] = light[j]


def write_scans(
    file: Path,
    geometry: dict[str, object],
    epochs: Callable[[int, int], Int64],
    batches: Iterator[tuple[UInt16, UInt8]],
) -> int:
    """Write an Arrow IPC log of `scans`; returns the readings.

    epochs : (first, end) profile → epochs of those profiles. batches : (p, n) ranges and intensities, in order.
    """
    readings = int(str(geometry["readings"]))
    lists = {"range": pa.list_(pa.uint16(), readings), "intensity": pa.list_(pa.uint8(), readings)}
    schema = pa.schema({"epoch_gps_ns": pa.int64(), **lists}, {"roadscan.scan_geometry": json.dumps(geometry)})
    done = 0
    with pa.OSFile(str(file), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        for ranges, intensity in batches:
            count = len(ranges)
            columns = [
                pa.array(epochs(done, done + count)),
                *(pa.FixedSizeListArray.from_arrays(pa.array(v.ravel()), readings) for v in (ranges, intensity)),
            ]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))
            done += count
    return done * readings


def paved(patch: Patch, profiles: int, shift: Callable[[Int64], Int64], seed: int) -> Iterator[tuple[UInt16, UInt8]]:
    """Batches of `profiles` profiles of a road paved with the patch; `shift` states each profile's longer range.

    The arrays are used again for the next batch.
    """
    rng = np.random.default_rng(seed)
    ranges = np.empty((BATCH_PROFILES, patch.ranges.shape[1]), np.uint16)
    intensity = np.empty(ranges.shape, np.uint8)
    for first in range(0, profiles, BATCH_PROFILES):
        count = min(BATCH_PROFILES, profiles - first)
        numbers = np.arange(first, first + count)
        rows = (numbers + rng.integers(0, len(patch.ranges))) % len(patch.ranges)
        repeat(patch.ranges, patch.intensity, rows, shift(numbers), ranges[:count], intensity[:count])
        yield ranges[:count], intensity[:count]


def even_epochs(period_s: float) -> Callable[[int, int], Int64]:
    """Epochs of profiles `period_s` apart, the first at station 0."""

    def epochs(first: int, end: int) -> Int64:
        out: Int64 = START_GPS_NS + np.round(np.arange(first, end) * (period_s * 1e9)).astype(np.int64)
        return out

    return epochs
