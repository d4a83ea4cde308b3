"""Shared parts of terrestrial reference scans (E57, PLY): CRS, epochs, rows of the table ``cloud``.

A reference scan belongs to no drive: its points are not checked against the run's trajectory, and where its
file says no time, the survey file states the one epoch that all its points get.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj

from roadscan.compute.array_types import Int64
from roadscan.core.crs import LOCAL_WORLD, NO_HEIGHTS, HeightKind, crs_from_text, heights_of
from roadscan.core.errors import ConfigError, CrsError, Missing, TimeSystemError
from roadscan.core.gpstime import LATEST_GPS_NS, gps_ns_from_utc
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import Item, LogSource, Rows, height_in
from roadscan.ingest.reading.records import Sieve, few_rejects

Columns = dict[str, npt.NDArray[Any]]

CHUNK_POINTS: Final = 65_536
"""Points of a batch."""
SIXTEEN_BITS: Final = 65_535  # largest 16-bit value

_MISSING: Final[dict[str, tuple[type[np.generic], int]]] = {
    "intensity": (np.uint16, 0),
    "classification": (np.uint8, 1),
    "return_number": (np.uint8, 1),
    "number_of_returns": (np.uint8, 1),
    "point_source_id": (np.uint16, 1),
    "scan_angle_deg": (np.float32, 0),
    "flags": (np.uint8, 0),
    "user_data": (np.uint8, 0),
}
"""Types of columns of ``cloud``, with the value for scans that do not record them (class 1: unclassified)."""


class ReferenceOptions(Strict):
    """Settings of a reference scan."""

    epoch: dt.datetime | None = None
    """Instant of the scan, with zone (2026-05-04T09:30:00Z), where its points say none; stands above what they say."""
    intensity: bool = True
    """Read the intensities; otherwise they are 0."""
    intensity_range: tuple[float, float] | None = None
    """Recorded intensities that become 0 and 65,535 (those between in proportion, those outside cut off), where the
    file does not state them."""


def reference_crs(source: LogSource) -> str:
    """Return the stated CRS of the points: a projected one, or "local".

    Raises
    ------
    ConfigError, CrsError
        if none is stated, or if eastings and northings cannot be in it.
    """
    stated = source.need_crs("EPSG:25832")
    if stated == LOCAL_WORLD:
        return stated
    crs = crs_from_text(stated)
    if crs.is_compound or not crs.is_projected:
        raise CrsError(
            f"the scan's CRS is '{crs.name}', not a projected one",
            expected='easting and northing ("EPSG:25832", heights are stated apart), or "local"',
            file=source.path,
        )
    return stated


def reference_height(source: LogSource, crs: str, written: pyproj.CRS | None = None) -> HeightKind:
    """Return the kind of the points' heights; ellipsoidal in a local frame, whose z has none, unless stated.

    Parameters
    ----------
    written : CRS that the file itself names, if any.

    Raises
    ------
    ConfigError, CrsError
        see :meth:`LogSource.need_height`.
    """
    if crs == LOCAL_WORLD:
        return source.any_height or "ellipsoidal"
    said = NO_HEIGHTS if written is None else heights_of(written)
    if said.kind is None:
        return height_in(source, crs)
    return source.need_height(
        said.kind, f"the file's CRS ({said.name})", "options.ignore_file_crs = true if the file is wrong"
    )


def stated_epoch_gps_ns(options: ReferenceOptions, file: Path) -> int | None:
    """Return the epoch that the survey file states for all points, if any."""
    if options.epoch is None:
        return None
    epoch = gps_ns_from_utc(options.epoch)
    if not 0 <= epoch <= LATEST_GPS_NS:
        raise ConfigError(f"options.epoch is {options.epoch.isoformat()}", expected="1980 to 2080", file=file)
    return epoch


def no_epoch(arrived: str, file: Path, also: str = "") -> TimeSystemError:
    """Return the error for a scan without any time: without one, a point belongs to no run and no pass."""
    return TimeSystemError(
        arrived,
        expected="the instant of the scan" + also,
        file=file,
        missing=Missing("options.epoch", dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)),
    )


@dataclass(frozen=True)
class Brightness:
    """Scale of recorded values to 16 bits: ⌊(value − low) / (high − low) · 65,535 + ½⌋, limited to 0 and 65,535."""

    low: float
    high: float

    def check(self, file: Path) -> Brightness:
        """Return the scale, or refuse one without extent."""
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise ConfigError(
                f"intensities or colours from {self.low:g} to {self.high:g}",
                expected="a lower and a higher limit",
                change="state options.intensity_range = [lowest, highest], or intensity = false",
                file=file,
            )
        return self

    def sixteen_bits(self, values: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
        """Return values (n,) scaled to 16 bits; NaN becomes 0."""
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = (np.asarray(values, dtype=np.float64) - self.low) * (SIXTEEN_BITS / (self.high - self.low))
        return np.floor(np.clip(np.nan_to_num(scaled, nan=0.0), 0, SIXTEEN_BITS) + 0.5).astype(np.uint16)


def whole_numbers(name: str, values: npt.NDArray[Any], column: str, sieve: Sieve) -> npt.NDArray[Any]:
    """Return values (n,) as integers of a column of ``cloud``; others are dropped from the sieve."""
    kind = np.dtype(_MISSING[column][0])
    if values.dtype == kind:
        return values
    highest = np.iinfo(kind).max
    fits = (values >= 0) & (values <= highest)
    if values.dtype.kind == "f":
        fits &= np.floor(values) == values
    sieve.drop(~fits, f"{name} is no whole number from 0 to {highest}")
    return np.where(fits, values, 0).astype(kind)


def cloud_items(
    columns: Columns, sieve: Sieve, records: Int64, offsets: Int64, record_bytes: int = 0
) -> Iterator[Item]:
    """Yield rejects, then rows of ``cloud``.

    Parameters
    ----------
    columns : columns (n,) by name; x_m, y_m, z_m and epoch_gps_ns are needed, others get what `cloud` means by nothing.
    sieve : faults found so far; points whose coordinates are no numbers join them.
    records, offsets : (n,) number and byte of each point, −1 for none.
    record_bytes : bytes from one point to the next, 0 where it varies.
    """
    for axis in "xyz":
        sieve.drop(~np.isfinite(columns[f"{axis}_m"]), "a coordinate is no number")
    yield from few_rejects(list(sieve.rejects(records, offsets)))
    kept = sieve.kept
    if not sieve.good.any():
        return
    size = int(np.count_nonzero(sieve.good))
    full = {name: np.full(size, value, kind) for name, (kind, value) in _MISSING.items() if name not in columns}
    full |= {name: np.ascontiguousarray(values[kept]) for name, values in columns.items()}
    first = int(np.argmax(sieve.good))
    batch = pa.RecordBatch.from_pydict({name: pa.array(values) for name, values in full.items()})
    own = None if sieve.good.all() else records[kept]
    yield Rows("cloud", batch, "", int(records[first]), int(offsets[first]), record_bytes, own)
