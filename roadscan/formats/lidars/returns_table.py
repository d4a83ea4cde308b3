"""Lidar returns as roadscan's own ``returns`` table in Parquet or Arrow IPC (Feather).

The open way in for lidars whose files only the vendor's library reads: whoever can call that library writes one
row a return from it, and this reader takes it from there.

==============================================  ===========================================================
column                                          content
==============================================  ===========================================================
``epoch_gps_ns`` (int64)                        GPS time of the return, ns since 1980-01-06;
or ``time`` (number)                            or the stamp in the clock that the survey file states
``x_sensor_m``, ``y_sensor_m``, ``z_sensor_m``  position in the sensor's frame (m)
``pose_epoch_gps_ns`` (int64, optional)         GPS time of the pose that places it, where the sweep is compensated
``intensity`` (0 to 65,535, optional)           intensity
``laser`` (0 to 255, optional)                  number of the laser
``sweep`` (integer, optional)                   number of the sweep, from 0
==============================================  ===========================================================

Other columns are ignored. Returns that are in the vehicle's frame already have a sensor in the rig file without lever
arm, whose axes say where x, y, z point.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.errors import ConfigError, FormatError, brief
from roadscan.ingest.array_files import ClockLike, WrittenLog, epochs_gps_ns, float_array, parquet_file, whole_array
from roadscan.ingest.reading.column_table import Lost, is_number, open_table, schema_or_none, table_files
from roadscan.ingest.reading.columns import Found
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve
from roadscan.ingest.reading.stamps import EPOCH, TableStamps, column_stamps, need_type
from roadscan.store.digest import UNREADABLE

AXES: Final = ("x_sensor_m", "y_sensor_m", "z_sensor_m")

_STAMP: Final = "time"
_POSE_EPOCH: Final = "pose_epoch_gps_ns"
_WHOLE: Final = {"intensity": np.uint16, "laser": np.uint8, "sweep": np.int32}
"""Types of the integer columns, which are 0 where they are left out."""
_COLUMNS: Final = (EPOCH, _STAMP, _POSE_EPOCH, *AXES, *_WHOLE)
_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_CHUNK_ROWS: Final = 1 << 17  # rows of a chunk


class ReturnsTable(LogFormat):
    """Returns as Parquet or Arrow IPC, one file or a folder of them."""

    name: ClassVar[str] = "returns_table"
    title: ClassVar[str] = "roadscan's own returns table (Parquet or Arrow IPC) for lidars of any maker"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    time: ClassVar[str] = (
        "column epoch_gps_ns is GPS time and needs no clock; column time is in the clock that the survey file states"
    )

    def sniff(self, path: Path) -> bool:
        """True for a file (or a folder whose first file) that has a stamp column and x, y, z of the sensor."""
        try:
            files = self.files(path)
            return bool(files) and _is_returns(open_table(files[0]).schema)
        except (*UNREADABLE, FormatError):
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the file, or all Parquet and Arrow files of the folder by name."""
        return table_files(path)

    def header(self, source: LogSource) -> LogHeader:
        """Check the columns; all files of a folder must have the same column of time."""
        files = self.files(source.path)
        schemas = {file: schema for file in files if (schema := schema_or_none(file)) is not None}
        if not schemas:
            raise FormatError(
                "no file can be read" if files else "the folder holds no table",
                expected="Parquet or Arrow IPC files with one return a row",
                file=source.path,
            )
        for file, schema in schemas.items():
            _check_columns(schema, dataclasses.replace(source, path=file))
        if len({_stamps(source, schema) for schema in schemas.values()}) > 1:
            raise ConfigError(
                "the files differ in their column of time",
                expected="one for all files of a log",
                change="split the log",
                file=source.path,
            )
        return LogHeader({"frame": "sensor"})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream returns file by file; one without a possible stamp or place is rejected."""
        stamps: TableStamps | None = None
        for file in self.files(source.path):
            name = file.relative_to(source.path).as_posix() if file != source.path else ""
            try:
                table = open_table(file)
                _check_columns(table.schema, dataclasses.replace(source, path=file))
            except (*UNREADABLE, FormatError) as error:
                if not name:
                    raise FormatError(f"the file cannot be read: {brief(error)}", file=file) from error
                yield Reject(f"the file cannot be read: {brief(error)}", 0, -1, 1, name)
                continue
            if stamps is None:
                stamps = _stamps(source, table.schema)
                epochs = EpochReader(stamps.clock, source.path)
            for first, part in table.parts(_CHUNK_ROWS, _COLUMNS):
                if isinstance(part, Lost):
                    yield Reject(part.reason, first, -1, max(part.records, 1), name)
                else:
                    yield from _returns(part, stamps, epochs, name, first)


def _is_returns(schema: pa.Schema) -> bool:
    return set(AXES) <= set(schema.names) and bool({EPOCH, _STAMP} & set(schema.names))


def _check_columns(schema: pa.Schema, source: LogSource) -> None:
    if not _is_returns(schema):
        raise FormatError(
            "the table has the columns " + ", ".join(schema.names),
            expected=f"'{EPOCH}' (or '{_STAMP}') and " + ", ".join(AXES),
            file=source.path,
        )
    for name in (n for n in (*AXES, *_WHOLE, _POSE_EPOCH) if n in schema.names):
        kind = schema.field(name).type
        fits = is_number(kind) if name in AXES else pa.types.is_integer(kind)
        need_type(schema, name, fits, "numbers" if name in AXES else "whole numbers", source)


def _stamps(source: LogSource, schema: pa.Schema) -> TableStamps:
    return TableStamps.of(source, schema, None if EPOCH in schema.names else Found(_STAMP, 1.0, ""))


def _returns(batch: pa.RecordBatch, stamps: TableStamps, epochs: EpochReader, name: str, first: int) -> Iterator[Item]:
    """Check a batch's rows and convert them to the schema's columns."""
    sieve = Sieve(batch.num_rows)
    records = first + np.arange(batch.num_rows)
    columns: dict[str, npt.NDArray[np.generic]] = {}
    for axis in AXES:
        place = _number(batch.column(axis))
        sieve.require(axis, place, -_FARTHEST_M, _FARTHEST_M, "m")
        columns[axis] = place
    for column, kind in _WHOLE.items():
        columns[column] = _whole(batch, column, np.dtype(kind), sieve)
    values = stamps.stamps(batch, sieve)
    epoch = epochs.epochs(values, sieve, records) if sieve.good.any() else np.zeros(batch.num_rows, np.int64)
    columns[EPOCH] = columns[_POSE_EPOCH] = epoch
    if _POSE_EPOCH in batch.schema.names:
        columns[_POSE_EPOCH] = column_stamps(batch.column(_POSE_EPOCH), sieve, is_epoch=True)
    for reject in sieve.rejects(records, np.full(batch.num_rows, -1)):
        yield dataclasses.replace(reject, file=name)
    if sieve.good.any():
        rows = pa.RecordBatch.from_pydict({n: _as_stored(n, v[sieve.kept]) for n, v in columns.items()})
        yield Rows("returns", rows, name, int(records[np.argmax(sieve.good)]))


def _number(column: pa.Array) -> npt.NDArray[np.float64]:
    values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(values, dtype=np.float64)


def _whole(batch: pa.RecordBatch, column: str, kind: np.dtype, sieve: Sieve) -> npt.NDArray[np.int64]:
    if column not in batch.schema.names:
        return np.zeros(batch.num_rows, np.int64)
    values = batch.column(column).fill_null(0).cast(pa.int64(), safe=False).to_numpy(zero_copy_only=False)
    limits = np.iinfo(kind)
    low = max(0, int(limits.min))
    sieve.drop((values < low) | (values > limits.max), f"{column} is outside {low} to {limits.max:,}")
    return np.asarray(values)


def _as_stored(name: str, values: npt.NDArray[np.generic]) -> pa.Array:
    kind = np.float32 if name in AXES else _WHOLE.get(name, np.int64)
    return pa.array(values.astype(kind))


_FLOAT_M: Final = 1_000.0
"""Farthest position (m) that single precision represents to 0.06 mm."""
_GROUP_ROWS: Final = 1 << 17  # rows of a row group


def write_returns(
    path: str | Path,
    epochs: Any,
    xyz_m: Any,
    *,
    intensity: Any = None,
    laser: Any = None,
    sweep: Any = None,
    clock: ClockLike = None,
) -> WrittenLog:
    """Write lidar returns as a Parquet log that `roadscan` reads as `returns_table`; return what was written.

    Parameters
    ----------
    epochs : (n,) GPS nanoseconds (int64) at which each return was measured, or stamps of `clock`, or calendar times.
    xyz_m : (n, 3) positions in the axes of the sensor, which the rig file states. They are kept in single precision
        (0.03 mm at 500 m). A return with NaN is left out.
    intensity, laser, sweep : (n,) whole numbers: from 0 to 65,535, from 0 to 255, from 0 on.
    clock : time system of the epochs, keys as in the survey file; None for GPS nanoseconds.

    Raises
    ------
    ConfigError, TimeSystemError
        if shapes differ, numbers do not fit, or epochs say no time system.
    """
    target = Path(path)
    epoch_gps_ns = epochs_gps_ns(epochs, clock, "epochs")
    places = float_array(xyz_m, (epoch_gps_ns.size, 3), "xyz_m")
    kept = ~np.isnan(places).any(axis=1)
    if not kept.any():
        raise ConfigError("xyz_m holds no whole return", expected="one or more without NaN")
    if np.abs(places[kept]).max() > _FLOAT_M:
        raise ConfigError(
            f"a return lies {np.abs(places[kept]).max():,.0f} m from the sensor",
            expected=f"positions in the sensor's own axes, within {_FLOAT_M:,.0f} m",
            change="points that are on a map already are a cloud: write them as LAS",
        )
    columns: dict[str, Any] = {EPOCH: epoch_gps_ns[kept]}
    columns |= {axis: places[kept, k].astype(np.float32) for k, axis in enumerate(AXES)}
    for name, values, kind in (
        ("intensity", intensity, np.uint16),
        ("laser", laser, np.uint8),
        ("sweep", sweep, np.int32),
    ):
        if values is not None:
            columns[name] = whole_array(values, epoch_gps_ns.shape, kind, name)[kept]
    table = pa.table(columns)
    with parquet_file(target, table.schema) as writer:
        writer.write_table(table, row_group_size=_GROUP_ROWS)
    return WrittenLog(target, table.num_rows, int(columns[EPOCH].min()), int(columns[EPOCH].max()))
