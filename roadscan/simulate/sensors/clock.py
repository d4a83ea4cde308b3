"""A sensor's clock: converts true epochs to stamps, and gives the clock's entry in the survey file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import (
    GPS_EPOCH_UNIX_S,
    NS_PER_S,
    WEEK_S,
    TimeSystem,
    gps_ns_from_utc,
    leap_seconds_at_gps,
    utc_from_gps_ns,
)
from roadscan.simulate.drive import Drive
from roadscan.simulate.scene import ClockError, Scene

_NOTHING_S: Final = 1e-9
"""Offset that stands for none where the survey file has to state one (s)."""


@dataclass(frozen=True)
class SensorClock:
    """Stamps of one sensor's log."""

    error: ClockError
    system: TimeSystem
    """Time system of the stamps."""
    start_gps_ns: int
    """Epoch from which the drift counts: the first profile of the first pass."""

    @classmethod
    def of(cls, scene: Scene, error: ClockError, usual: TimeSystem) -> SensorClock:
        """Return the clock of a sensor whose log usually has stamps of `usual`."""
        return cls(error, error.system or usual, gps_ns_from_utc(scene.start))

    def shown_gps_ns(self, epoch_gps_ns: Int64) -> Int64:
        """Return GPS time (ns, (n,)) that the clock shows at true epochs (n,)."""
        if self.error.is_right:
            return epoch_gps_ns
        elapsed_s = (epoch_gps_ns - self.start_gps_ns).astype(np.float64) / NS_PER_S
        wrong = self.error.offset_s + self.error.drift_ppm * 1e-6 * elapsed_s
        shown: Int64 = epoch_gps_ns + np.rint(wrong * NS_PER_S).astype(np.int64)
        return shown

    def stamps_ns(self, epoch_gps_ns: Int64) -> Int64:
        """Return stamps (ns of the system's count, (n,)) at true epochs (n,)."""
        shown = self.shown_gps_ns(epoch_gps_ns)
        match self.system:
            case TimeSystem.GPS | TimeSystem.FREE:
                return shown
            case TimeSystem.GPS_WEEK:
                return shown % (WEEK_S * NS_PER_S)
            case TimeSystem.UNIX_GPS:
                return shown + GPS_EPOCH_UNIX_S * NS_PER_S
            case TimeSystem.UNIX_UTC:
                return shown + (GPS_EPOCH_UNIX_S - leap_seconds_at_gps(shown // NS_PER_S)) * NS_PER_S
        raise ConfigError(
            f"the simulator does not write stamps of the system '{self.system}'",
            expected="gps, gps_week_seconds, unix_gps, unix_utc or free",
        )

    def toml(self, unit: str | None, first_gps_ns: int) -> str:
        """Return the survey file's ``clock = …`` for a log whose first stamp is at `first_gps_ns`, in `unit`.

        Week and date are those that the clock shows then.
        """
        parts = [f'system = "{self.system}"']
        if unit is not None:
            parts.append(f'unit = "{unit}"')
        shown = self.shown_gps_ns(np.array([first_gps_ns]))
        if self.system is TimeSystem.GPS_WEEK:
            parts.append(f"week = {int(shown[0]) // (WEEK_S * NS_PER_S)}")
        if self.system is TimeSystem.UTC_HOUR:
            parts.append(f"date = {utc_from_gps_ns(int(shown[0])):%Y-%m-%d}")
        if self.error.known:
            parts += self._correction()
        elif self.system is TimeSystem.FREE:
            parts.append(f"offset_s = {_NOTHING_S!r}")
        return "{ " + ", ".join(parts) + " }"

    def _correction(self) -> list[str]:
        """Return the inverse of the stamp's formula. A clock that restarts each hour counts as one of POSIX seconds."""
        rate = self.error.drift_ppm * 1e-6
        system = TimeSystem.UNIX_UTC if self.system is TimeSystem.UTC_HOUR else self.system
        counting = SensorClock(self.error, system, self.start_gps_ns)
        reference_s = int(counting.stamps_ns(np.array([self.start_gps_ns]))[0]) / NS_PER_S
        offset_s = -self.error.offset_s or (_NOTHING_S if self.system is TimeSystem.FREE else 0.0)
        return [
            f"offset_s = {offset_s!r}",
            f"drift_ppm = {-rate / (1.0 + rate) * 1e6!r}",
            f"reference_s = {reference_s!r}",
        ]


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
