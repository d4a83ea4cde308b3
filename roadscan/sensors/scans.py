"""Line scanners: roadscan's own ``scans`` table as Parquet or Arrow IPC (Feather).

The open way in for profilers whose own files only the vendor's library reads: whoever can call that
library writes one row a profile from it, and this reader takes it from there.

========================================  ==============================================================
column                                    content
========================================  ==============================================================
``epoch_gps_ns`` (int64)                  GPS time of the profile's first reading, ns since 1980-01-06;
or ``time`` (integer or float)            or the stamp in the clock that the survey file states
``range`` (list of uint16)                raw ranges, all of one length; 0 is no return
``intensity`` (list of uint8, optional)   raw intensities, as many as ranges
``encoder_ticks`` (integer, optional)     wheel encoder
========================================  ==============================================================

Other columns are ignored. Lists may be fixed-size or not. The geometry of the readings
(:class:`roadscan.points.readings.ScanGeometry`) stands as JSON in the file's schema metadata under
``roadscan.scan_geometry``, or in the log's options.

A capture program that has to keep up with a line-rate head writes Arrow IPC without compression, lists of fixed
size without nulls, some hundred profiles a record batch: no byte of it is changed on the way to the disk, and it
is read without a copy (shorter batches cost one). Compressed IPC and Parquet are read as well, for logs that are to
be kept or sent; reading them takes many times as long.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from roadscan.model.errors import ConfigError, FormatError
from roadscan.model.gpstime import EARLIEST_GPS_NS, LATEST_GPS_NS, Clock, TimeSystem
from roadscan.model.strict import Strict
from roadscan.points.readings import ScanGeometry
from roadscan.sensors.arrow_batches import MappedBatches, unlisted_batches, unlisted_reason
from roadscan.sensors.base import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.sensors.parquet_pages import ParquetPages
from roadscan.sensors.records import EpochReader, Sieve, options_of

GEOMETRY_KEY: Final = "roadscan.scan_geometry"
"""Key of the schema metadata that holds the geometry as JSON."""

_EPOCH: Final = "epoch_gps_ns"
_STAMP: Final = "time"
_CHUNK_BYTES: Final = 8 << 20
_MAPPED_CHUNKS: Final = 8
"""Chunks of a mapped file after which its pages are given back."""
_LARGE_FILE_BYTES: Final = 32 << 20
_BUFFER_BYTES: Final = 1 << 20
_SUFFIXES: Final = (".parquet", ".arrow", ".feather", ".ipc")
_UNREADABLE: Final = (pa.ArrowException, OSError, ValueError, KeyError, TypeError, OverflowError, MemoryError)
"""What Arrow raises on damaged bytes."""


class ScansOptions(Strict):
    """Settings of a ``scans`` log."""

    scan_geometry: ScanGeometry | None = None
    """Geometry of the readings, where the file's schema metadata (`roadscan.scan_geometry`) does not state it."""


class Scans(LogFormat):
    """Profiles as Parquet or Arrow IPC, one file or a folder of them."""

    name: ClassVar[str] = "scans"
    title: ClassVar[str] = "roadscan's own profiles table (Parquet or Arrow IPC) for line scanners of any maker"
    yields: ClassVar[tuple[str, ...]] = ("scans",)
    time: ClassVar[str] = (
        "column epoch_gps_ns is GPS time and needs no clock; column time is in the clock that the survey file states"
    )
    options: ClassVar[type[Strict]] = ScansOptions

    def sniff(self, path: Path) -> bool:
        """True for a file (or a folder whose first file) that has a stamp column and lists of ranges."""
        try:
            files = self.files(path)
            return bool(files) and _is_scans(_open(files[0]).schema)
        except (*_UNREADABLE, FormatError):
            return False

    def files(self, path: Path) -> list[Path]:
        """The file, or all Parquet and Arrow files of the folder by name."""
        if not path.is_dir():
            return [path]
        return sorted(p for p in path.rglob("*") if p.suffix.lower() in _SUFFIXES and p.is_file())

    def header(self, source: LogSource) -> LogHeader:
        """Geometry and time column; all files of a folder must agree."""
        files = self.files(source.path)
        schemas = [(file, schema) for file in files if (schema := _schema_or_none(file)) is not None]
        if not schemas:
            raise FormatError(
                "no file can be read" if files else "the folder holds no table",
                expected="Parquet or Arrow IPC files with one profile a row",
                file=source.path,
            )
        for file, schema in schemas:
            _check_columns(schema, file)
        _check_clock(source, schemas[0][1])
        geometry = _geometry(source, schemas)
        return LogHeader({"scan_geometry": geometry.model_dump(mode="json")}, list_size=geometry.readings)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream profiles file by file."""
        readings = header.list_size
        if readings is None:
            raise FormatError("the log's header has no list size", file=source.path)
        rows = max(1, _CHUNK_BYTES // (3 * readings + 16))
        clock = Clock(TimeSystem.GPS, unit="ns") if source.clock is None else source.clock
        epochs = EpochReader(clock, source.path)
        for file in self.files(source.path):
            name = file.relative_to(source.path).as_posix() if file != source.path else ""
            for first, part in _parts(file, rows):
                if isinstance(part, pa.RecordBatch):
                    yield from _profiles(part, readings, epochs, name, first)
                elif part.whole and not name:
                    raise FormatError(part.reason, expected="a Parquet or Arrow IPC file", file=source.path)
                else:
                    yield Reject(part.reason, first, -1, max(part.records, 1), name)


@dataclass(frozen=True)
class _Lost:
    """Rows of a table that could not be read."""

    reason: str
    records: int
    whole: bool = False
    """True where the whole file is meant."""


class _Table(Protocol):
    """A table file that is read a few rows at a time."""

    schema: pa.Schema

    def parts(self, rows: int) -> Iterator[tuple[int, pa.RecordBatch | _Lost]]:
        """(number of the first row, at most `rows` rows or what was lost)."""


class _Parquet:
    def __init__(self, file: Path) -> None:
        # Reading through a buffer bounds memory, but trusts the page sizes that a damaged file claims.
        large = file.stat().st_size > _LARGE_FILE_BYTES
        self._file = pq.ParquetFile(
            file, buffer_size=_BUFFER_BYTES if large else 0, pre_buffer=False, page_checksum_verification=True
        )
        self._path = file
        self.schema = self._file.schema_arrow

    def parts(self, rows: int) -> Iterator[tuple[int, pa.RecordBatch | _Lost]]:
        columns = [n for n in self.schema.names if n in (_EPOCH, _STAMP, "range", "intensity", "encoder_ticks")]
        metadata, pages = self._file.metadata, ParquetPages(self._path)
        first = 0
        for number in range(metadata.num_row_groups):
            count, done = metadata.row_group(number).num_rows, 0
            reason = pages.fault(number, columns)
            try:
                for batch in [] if reason else self._file.iter_batches(rows, row_groups=[number], columns=columns):
                    yield first + done, batch
                    done += batch.num_rows
            except _UNREADABLE as error:
                reason = _brief(error)
            if reason or done < count:
                yield first + done, _Lost(f"row group is damaged: {reason or 'rows are missing'}", max(1, count - done))
            first += max(count, done)


class _Arrow:
    def __init__(self, file: Path) -> None:
        self._path = file
        self._mapped = MappedBatches(file)
        self._reader = self._mapped.reader
        self.schema = self._reader.schema

    def parts(self, rows: int) -> Iterator[tuple[int, pa.RecordBatch | _Lost]]:
        first, passed = 0, 0
        for batch in self._joined(rows):
            if isinstance(batch, _Lost):
                yield first, batch
                continue
            for start in range(0, batch.num_rows, rows):
                yield first + start, batch.slice(start, rows)
                passed += 1
                if passed % _MAPPED_CHUNKS == 0:
                    self._mapped.release()
            first += batch.num_rows
        unlisted = unlisted_batches(self._path, self._reader.num_record_batches)
        if unlisted:
            yield first, _Lost(unlisted_reason(unlisted), unlisted)

    def _joined(self, rows: int) -> Iterator[pa.RecordBatch | _Lost]:
        """Batches in their order; short ones are copied into one of at most `rows` rows: each costs some calls."""
        short: list[pa.RecordBatch] = []
        held = 0
        for number in range(self._reader.num_record_batches):
            batch = self._batch(number)
            if short and (isinstance(batch, _Lost) or held + batch.num_rows > rows):
                yield short[0] if len(short) == 1 else pa.concat_batches(short)
                short, held = [], 0
            if isinstance(batch, _Lost):
                yield batch
            else:
                short.append(batch)
                held += batch.num_rows
        if short:
            yield short[0] if len(short) == 1 else pa.concat_batches(short)

    def _batch(self, number: int) -> pa.RecordBatch | _Lost:
        try:
            batch = self._reader.get_batch(number)
            batch.validate(full=True)
        except _UNREADABLE as error:
            return _Lost(f"record batch is damaged: {_brief(error)}", 1)
        return batch


def _open(file: Path) -> _Table:
    with file.open("rb") as stream:
        magic = stream.read(6)
    if magic[:4] == b"PAR1":
        table: _Table = _Parquet(file)
    elif magic == b"ARROW1":
        table = _Arrow(file)
    else:
        raise FormatError("the file is neither Parquet nor Arrow IPC", expected="its first bytes to be PAR1 or ARROW1")
    table.schema.names  # noqa: B018 — damaged names show themselves here
    return table


def _parts(file: Path, rows: int) -> Iterator[tuple[int, pa.RecordBatch | _Lost]]:
    try:
        table = _open(file)
        _check_columns(table.schema, file)
    except (*_UNREADABLE, FormatError) as error:
        yield 0, _Lost(f"the file cannot be read: {_brief(error)}", 1, whole=True)
        return
    yield from table.parts(rows)


def _schema_or_none(file: Path) -> pa.Schema | None:
    try:
        return _open(file).schema
    except (*_UNREADABLE, FormatError):
        return None


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _is_scans(schema: pa.Schema) -> bool:
    names = schema.names
    return "range" in names and (_EPOCH in names or _STAMP in names) and _is_list(schema.field("range").type)


def _check_columns(schema: pa.Schema, file: Path) -> None:
    if not _is_scans(schema):
        raise FormatError(
            "the table has the columns " + ", ".join(schema.names),
            expected=f"'{_EPOCH}' (or '{_STAMP}') and 'range', a list of uint16",
            file=file,
        )
    for name, inner in (("range", pa.uint16()), ("intensity", pa.uint8())):
        if name in schema.names:
            kind = schema.field(name).type
            if not _is_list(kind) or kind.value_type != inner:
                raise FormatError(f"column '{name}' is {kind}", expected=f"a list of {inner}", file=file)
    integer, floating = pa.types.is_integer, pa.types.is_floating
    stamp = _EPOCH if _EPOCH in schema.names else _STAMP
    kind = schema.field(stamp).type
    if not (kind == pa.int64() if stamp == _EPOCH else integer(kind) or floating(kind)):
        raise FormatError(
            f"column '{stamp}' is {kind}",
            expected="int64" if stamp == _EPOCH else "a number in the unit of the log's clock",
            file=file,
        )
    if "encoder_ticks" in schema.names and not integer(schema.field("encoder_ticks").type):
        raise FormatError(
            f"column 'encoder_ticks' is {schema.field('encoder_ticks').type}", expected="int64", file=file
        )


def _check_clock(source: LogSource, schema: pa.Schema) -> None:
    if _EPOCH not in schema.names:
        source.need_clock('{ system = "gps", unit = "s" }')
    elif source.clock is not None:
        raise ConfigError(
            f"a clock is stated, and the column '{_EPOCH}' is GPS time already",
            expected=f"no clock, or the stamps in a column '{_STAMP}'",
            file=source.path,
        )


def _geometry(source: LogSource, schemas: list[tuple[Path, pa.Schema]]) -> ScanGeometry:
    """The one geometry that options and files state."""
    options = options_of(source, ScansOptions)
    stated: list[tuple[str | Path, ScanGeometry]] = []
    if options.scan_geometry is not None:
        stated.append(("the log's options", options.scan_geometry))
    for file, schema in schemas:
        text = (schema.metadata or {}).get(GEOMETRY_KEY.encode())
        if text is not None:
            stated.append((file, ScanGeometry.parse(_json(text, file), file=file)))
    if not stated:
        raise ConfigError(
            "the geometry of the readings is not stated",
            expected=f"schema metadata '{GEOMETRY_KEY}' (JSON), or options.scan_geometry",
            change='for example options.scan_geometry = { kind = "cartesian", readings = 4000, first = -2.0, '
            "step = 0.001, range_offset_m = 1.7, range_step_m = 0.0001 }",
            file=source.path,
        )
    for where, other in stated[1:]:
        if other != stated[0][1]:
            raise ConfigError(
                f"{where} states another scan geometry than {stated[0][0]}",
                expected="one geometry a log",
                change="split the log, or correct the one that is wrong",
                file=source.path,
            )
    return stated[0][1]


def _json(text: bytes, file: Path) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"schema metadata '{GEOMETRY_KEY}' is not JSON: {error}", file=file) from error
    if not isinstance(values, dict):
        raise ConfigError(f"schema metadata '{GEOMETRY_KEY}' is not a JSON object", file=file)
    return values


def _profiles(batch: pa.RecordBatch, readings: int, epochs: EpochReader, name: str, first: int) -> Iterator[Item]:
    """Check a batch's rows and bring them to the schema's columns."""
    lists = [n for n in ("range", "intensity") if n in batch.schema.names]
    sieve = Sieve(batch.num_rows)
    for column in lists:
        lengths = pc.list_value_length(batch.column(column))
        sieve.drop(np.asarray(lengths.is_null()), f"{column} is missing")
        wrong = lengths.fill_null(readings).to_numpy(zero_copy_only=False) != readings
        sieve.drop(wrong, f"{column} does not hold {readings} readings")
    stamp = batch.column(_EPOCH if _EPOCH in batch.schema.names else _STAMP)
    sieve.drop(np.asarray(stamp.is_null()), "the time stamp is missing")
    records = first + np.arange(batch.num_rows)
    stamps = stamp.fill_null(0).to_numpy(zero_copy_only=False)
    if _EPOCH in batch.schema.names:
        sieve.drop((stamps < EARLIEST_GPS_NS) | (stamps > LATEST_GPS_NS), f"{_EPOCH} is outside 1980–2080")
    epochs_gps_ns = epochs.epochs(stamps, sieve, records) if sieve.good.any() else np.empty(0)
    for reject in sieve.rejects(records, np.full(batch.num_rows, -1)):
        yield dataclasses.replace(reject, file=name)
    if not sieve.good.any():
        return
    kept = batch if sieve.good.all() else batch.filter(pa.array(sieve.good))
    columns = {_EPOCH: pa.array(epochs_gps_ns[sieve.kept])} | {n: _fixed(kept.column(n), readings) for n in lists}
    if "encoder_ticks" in kept.schema.names:
        columns["encoder_ticks"] = kept.column("encoder_ticks").cast(pa.int64(), safe=False)
    yield Rows("scans", pa.RecordBatch.from_pydict(columns), name, int(records[np.argmax(sieve.good)]))


def _fixed(column: pa.Array, readings: int) -> pa.Array:
    """Lists of `readings` values as a fixed-size list; a null reading is 0, no return."""
    values = column.flatten()
    return pa.FixedSizeListArray.from_arrays(values.fill_null(0) if values.null_count else values, readings)


def _brief(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return text[0][:200] if text else type(error).__name__
