"""Reads time stamps in a column of a Parquet or Arrow table: GPS time, numbers of a clock, or Arrow timestamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.errors import ConfigError, FormatError
from roadscan.core.gpstime import EARLIEST_GPS_NS, LATEST_GPS_NS, Clock, TimeSystem
from roadscan.ingest.reading.column_table import is_number
from roadscan.ingest.reading.columns import Found, need_stamp_unit
from roadscan.ingest.reading.format import LogSource
from roadscan.ingest.reading.records import Sieve
from roadscan.ingest.reading.stamps import calendar_clock

EPOCH: Final = "epoch_gps_ns"
"""Column of GPS time (int64, ns since 1980-01-06): such a table needs no clock."""


@dataclass(frozen=True)
class TableStamps:
    """The column of a table with the log's stamps."""

    column: str
    clock: Clock
    """Clock of the numbers that :meth:`stamps` returns."""

    @classmethod
    def of(cls, source: LogSource, schema: pa.Schema, time: Found | None) -> Self:
        """Find how the stamps are written, and check the stated clock against that.

        Parameters
        ----------
        time : the column of stamps in the log's clock; None for a table with the column `epoch_gps_ns`.

        Raises
        ------
        ConfigError, FormatError, TimeSystemError
            if a clock is stated that is not needed, the column holds no stamps, or the clock is missing or another.
        """
        if time is None:
            refuse_clock(source)
            need_type(schema, EPOCH, pa.types.is_int64(schema.field(EPOCH).type), "int64", source)
            return cls(EPOCH, Clock(TimeSystem.GPS, unit="ns"))
        kind = schema.field(time.column).type
        if pa.types.is_timestamp(kind):
            shown = "2026-05-04T09:30:00" + ("Z" if kind.tz else "")
            stated = source.clock if kind.tz else source.any_clock
            return cls(time.column, calendar_clock(stated, shown, source.path, zoned=bool(kind.tz)))
        need_type(schema, time.column, is_number(kind), "numbers in the unit of the log's clock, or timestamps", source)
        clock = source.need_clock("gps", unit="s")
        need_stamp_unit(time, clock, source.path)
        return cls(time.column, clock)

    def stamps(self, batch: pa.RecordBatch, sieve: Sieve) -> npt.NDArray[np.generic]:
        """Return stamps (n,) of a batch, float64 or int64, in `clock`'s unit; missing ones are dropped from `sieve`."""
        return column_stamps(batch.column(self.column), sieve, is_epoch=self.column == EPOCH)


def column_stamps(stamps: pa.Array, sieve: Sieve, *, is_epoch: bool) -> npt.NDArray[np.generic]:
    """Return values (n,) of a column of stamps, 0 where missing; GPS epochs outside 1980–2080 are dropped."""
    sieve.drop(np.asarray(stamps.is_null()), "the time stamp is missing")
    if pa.types.is_timestamp(stamps.type):
        stamps = stamps.cast(pa.timestamp("ns", stamps.type.tz), safe=False).cast(pa.int64())
    values = np.asarray(stamps.fill_null(0).to_numpy(zero_copy_only=False))
    if values.dtype.kind in "iu":
        values = values.astype(np.int64, copy=False)
    if is_epoch:
        sieve.drop((values < EARLIEST_GPS_NS) | (values > LATEST_GPS_NS), f"{EPOCH} is outside 1980–2080")
    return values


def refuse_clock(source: LogSource) -> None:
    """Raise :class:`ConfigError` where a clock is stated for a table of GPS epochs."""
    if source.clock is not None:
        raise ConfigError(
            f"a clock is stated, and the column '{EPOCH}' is GPS time already",
            expected="no clock, or the stamps in a column 'time'",
            file=source.path,
        )


def need_type(schema: pa.Schema, column: str, fits: bool, expected: str, source: LogSource) -> None:
    """Raise :class:`FormatError` unless a column's type `fits`."""
    if not fits:
        raise FormatError(f"column '{column}' is {schema.field(column).type}", expected=expected, file=source.path)
