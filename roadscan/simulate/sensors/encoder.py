"""Simulates the wheel encoder, which counts the path of one wheel."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.gpstime import NS_PER_S
from roadscan.simulate.drive import Drive
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors.clock import SensorClock

CHUNK: Final = 65_536  # records of a chunk
_GRID_NS: Final = 20_000_000  # step of the path's table
_SCHEMA: Final = pa.schema([("time_ns", pa.int64()), ("ticks", pa.int64())])


class WheelEncoder:
    """Ticks of the encoder at any epoch of a pass, 0 at the first profile."""

    def __init__(self, scene: Scene, drive: Drive) -> None:
        self._drive = drive
        self._ticks_per_m = scene.encoder.ticks_per_m * (1.0 + scene.encoder.scale_error)
        self._side_m = scene.encoder.side_m
        if self._side_m != 0.0:
            first, last = drive.recorded_span_gps_ns
            self._grid = np.arange(first, last + _GRID_NS, _GRID_NS)
            self._turned = np.unwrap(_heading(drive, self._grid))
            self._turned -= np.interp(drive.start_gps_ns, self._grid, self._turned)

    def ticks(self, epoch_gps_ns: Int64) -> Int64:
        """Return the count (n,) at epochs (n,), increasing in both directions of travel.

        In a right turn forwards the right wheel drives less than the middle of the vehicle, backwards more.
        """
        path = self._drive.driven_m(epoch_gps_ns)
        if self._side_m != 0.0:
            path = path - self._drive.sign * self._side_m * np.interp(epoch_gps_ns, self._grid, self._turned)
        return np.floor(path * self._ticks_per_m + 0.5).astype(np.int64)


def write_encoder(scene: Scene, drive: Drive, clock: SensorClock, file: Path) -> Iterator[int]:
    """Write the counts of one pass as CSV, a chunk a step; yields the records of each."""
    encoder = WheelEncoder(scene, drive)
    step = round(NS_PER_S / scene.encoder.rate_hz)
    first, last = drive.recorded_span_gps_ns
    with pa_csv.CSVWriter(file, _SCHEMA, write_options=pa_csv.WriteOptions(quoting_style="none")) as writer:
        for begin in range(first, last + 1, step * CHUNK):
            epochs = np.arange(begin, min(begin + step * CHUNK, last + 1), step)
            columns = [clock.stamps_ns(epochs), encoder.ticks(epochs)]
            writer.write_batch(pa.RecordBatch.from_arrays([pa.array(c) for c in columns], schema=_SCHEMA))
            yield epochs.size


def _heading(drive: Drive, epochs: Int64) -> Float64:
    """Return headings (n,) clockwise from north (rad)."""
    poses = drive.poses(epochs)
    level = drive.earth.ecef_from_level(poses.position_ecef_m)
    angles: Float64 = (level.inv() * poses.ecef_from_body).as_euler("ZYX")[:, 0]
    return angles
