"""Shared parts of the array writers: epochs of stamps, arrays of numbers, and Parquet files written atomically."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, TimeSystemError
from roadscan.core.gpstime import EARLIEST_GPS_NS, LATEST_GPS_NS, UNIT_NS, Clock, TimeSystem, unroll_week
from roadscan.core.survey import ClockConfig

ClockLike = Clock | Mapping[str, Any] | None
"""A clock, its keys as in the survey file, or None: the stamps are GPS nanoseconds, or calendar times with a zone."""

_CALENDAR: Final = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_GPS, TimeSystem.UNIX_TAI)


@dataclass(frozen=True)
class WrittenLog:
    """The result of writing a log."""

    path: Path
    rows: int
    """Number of poses, profiles or returns."""
    first_epoch_gps_ns: int
    last_epoch_gps_ns: int


def epochs_gps_ns(stamps: Any, clock: ClockLike, name: str) -> Int64:
    """Return the GPS time (n,) in ns since 1980-01-06 of `stamps` (n,).

    Parameters
    ----------
    stamps : whole numbers, GPS nanoseconds where `clock` is None; numbers of the clock's unit and system; or calendar
        times (numpy datetime64, pandas with or without a zone), those without a zone on the scale of the clock.
    name : what to call them in an error.

    Raises
    ------
    ConfigError, TimeSystemError
        if they are no stamps, if the time system is not stated, or if an epoch lies outside 1980–2080.
    """
    stated = _clock(clock)
    zoned = getattr(getattr(stamps, "dtype", None), "tz", None) is not None
    values = stamps.to_numpy(dtype="datetime64[ns]") if zoned else np.asarray(stamps)
    if values.ndim != 1 or not values.size:
        raise ConfigError(f"{name} has the shape {values.shape}", expected="(n,), one stamp a row")
    if values.dtype.kind == "M":
        return _of_calendar(values, stated, zoned, name)
    if values.dtype.kind not in "iuf":
        raise ConfigError(f"{name} is of type {values.dtype}", expected="numbers, or datetime64")
    if stated is None:
        return _checked(values, name)
    if stated.system is not TimeSystem.GPS_WEEK:
        return stated.to_epoch_gps_ns(values)
    seconds = unroll_week(values.astype(np.float64) * (UNIT_NS[stated.unit] / UNIT_NS["s"]))
    return replace(stated, unit="s").to_epoch_gps_ns(seconds)


def _clock(clock: ClockLike) -> Clock | None:
    if clock is None or isinstance(clock, Clock):
        return clock
    return ClockConfig.parse(dict(clock)).clock()


def _of_calendar(values: npt.NDArray[Any], clock: Clock | None, zoned: bool, name: str) -> Int64:
    if np.isnat(values).any():
        raise ConfigError(f"{name} lacks a time in row {int(np.argmax(np.isnat(values)))}", expected="a time a row")
    if zoned and clock is not None and clock.system is not TimeSystem.UNIX_UTC:
        raise TimeSystemError(f"{name} has a zone, so it is UTC, the clock says {clock.system}", expected="no clock")
    if not zoned and (clock is None or clock.system not in _CALENDAR):
        raise TimeSystemError(
            f"{name} holds calendar times without a zone",
            expected="clock.system = unix_utc, unix_gps or unix_tai: the scale they are written in",
            change='state clock={"system": "unix_utc"} if they are UTC',
        )
    scale = replace(clock or Clock(TimeSystem.UNIX_UTC), unit="ns")
    return scale.to_epoch_gps_ns(values.astype("datetime64[ns]").astype(np.int64))


def _checked(values: npt.NDArray[Any], name: str) -> Int64:
    if values.dtype.kind == "f":
        raise TimeSystemError(
            f"{name} holds numbers with decimals, and their time system is not stated",
            expected="whole GPS nanoseconds (int64), or a clock",
            change='state clock={"system": "gps"} for seconds of GPS time since 1980-01-06, or another system and unit',
        )
    low, high = int(values.min()), int(values.max())
    if low < EARLIEST_GPS_NS or high > LATEST_GPS_NS or high < UNIT_NS["s"] * 10_000_000:
        raise TimeSystemError(
            f"{name} runs from {low} to {high}, which are no GPS nanoseconds of 1980–2080",
            expected="nanoseconds of GPS time since 1980-01-06, or a clock",
            change='state the clock, such as clock={"system": "unix_utc", "unit": "s"}',
        )
    return values.astype(np.int64)


def float_array(values: Any, shape: tuple[int, ...], name: str) -> Float64:
    """Return `values` as float64 of `shape`, or raise :class:`ConfigError`."""
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name} holds no numbers: {error}", expected="floating-point numbers") from error
    if found.shape != shape:
        raise ConfigError(f"{name} has the shape {found.shape}", expected=f"{shape}")
    return found


def whole_array(values: Any, shape: tuple[int, ...], kind: npt.DTypeLike, name: str) -> npt.NDArray[Any]:
    """Return `values` as integers of a type and `shape`, or raise :class:`ConfigError` where one does not fit."""
    found, limits = float_array(values, shape, name), np.iinfo(kind)
    wrong = ~((found >= max(limits.min, 0)) & (found <= limits.max) & (found == np.rint(found)))
    if wrong.any():
        raise ConfigError(
            f"{name} holds {found[wrong][0]:g}",
            expected=f"whole numbers from 0 to {limits.max:,}",
            change="scale and round them first",
        )
    return found.astype(kind)


@contextmanager
def parquet_file(path: Path, schema: pa.Schema) -> Iterator[pq.ParquetWriter]:
    """Open a Parquet file for writing; it appears under its name only when it is complete."""
    scratch = path.with_name(path.name + ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with pq.ParquetWriter(
            scratch, schema, compression="zstd", use_dictionary=False, write_page_checksum=True
        ) as writer:
            yield writer
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)
