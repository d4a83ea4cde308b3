"""Line scanners: roadscan's own ``scans`` table as Parquet or Arrow IPC (Feather).

The open way in for profilers whose files only the vendor's library reads: whoever can call that
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
(:class:`roadscan.core.rig.ScanGeometry`) stands as JSON in the file's schema metadata under
``roadscan.scan_geometry``, or in the log's options.

A capture program that has to keep up with a line-rate head writes Arrow IPC without compression, lists of fixed
size without nulls, some hundred profiles a record batch: no byte of it is changed on the way to the disk, and it
is read without a copy (shorter batches cost one). Compressed IPC and Parquet are read as well, for logs that are to
be kept or sent; reading them takes many times as long.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError, FormatError, Missing, brief
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import ScanGeometry
from roadscan.core.strict import Strict
from roadscan.ingest.array_files import ClockLike, WrittenLog, epochs_gps_ns, float_array, parquet_file, whole_array
from roadscan.ingest.reading.column_table import Lost, open_table, schema_or_none, table_files
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import EpochReader, Sieve, options_of
from roadscan.ingest.reading.stamps import EPOCH, column_stamps, refuse_clock
from roadscan.store.digest import UNREADABLE

GEOMETRY_KEY: Final = "roadscan.scan_geometry"
"""Key of the schema metadata with the geometry as JSON."""

_STAMP: Final = "time"
_CHUNK_BYTES: Final = 8 << 20  # bytes of a chunk of rows
_COLUMNS: Final = (EPOCH, _STAMP, "range", "intensity", "encoder_ticks")


class ScansOptions(Strict):
    """Settings of a ``scans`` log."""

    scan_geometry: ScanGeometry | None = None
    """Geometry of the readings, where the file's schema metadata (`roadscan.scan_geometry`) does not state it."""


class Scans(LogFormat):
    """Profiles as Parquet or Arrow IPC, one file or a folder of them."""

    axes_on_sensor: ClassVar[str] = "y runs across the profile as its geometry counts, z along the ranges"
    usual_axes: ClassVar[Mapping[str, str]] = {
        "frd": "it looks down at the road, with growing y to the right",
        "bld": "it looks down at the road, with growing y to the left",
        "urf": "it stands upright and looks ahead",
    }
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
            return bool(files) and _is_scans(open_table(files[0]).schema)
        except (*UNREADABLE, FormatError):
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the file, or all Parquet and Arrow files of the folder by name."""
        return table_files(path)

    def header(self, source: LogSource) -> LogHeader:
        """Return geometry and time column; all files of a folder must agree."""
        files = self.files(source.path)
        schemas = [(file, schema) for file in files if (schema := schema_or_none(file)) is not None]
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
        epochs = EpochReader(_clock(source, self.files(source.path)), source.path)
        for file in self.files(source.path):
            name = file.relative_to(source.path).as_posix() if file != source.path else ""
            for first, part in _parts(file, rows):
                if isinstance(part, pa.RecordBatch):
                    yield from _profiles(part, readings, epochs, name, first)
                elif part.whole and not name:
                    raise FormatError(part.reason, expected="a Parquet or Arrow IPC file", file=source.path)
                else:
                    yield Reject(part.reason, first, -1, max(part.records, 1), name)

    def ending(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield the epochs of the last profiles, after one of the first, from which the GPS week is counted."""
        files = self.files(source.path)
        epochs = EpochReader(_clock(source, files), source.path)
        try:
            first, last = open_table(files[0]), open_table(files[-1])
            stamp = EPOCH if EPOCH in first.schema.names else _STAMP
            ends = [next((part for _, part in first.parts(1, [stamp])), None), last.ending(stamp)]
        except (*UNREADABLE, FormatError):
            return
        batches = [batch for batch in ends if isinstance(batch, pa.RecordBatch)]
        for batch in batches if len(batches) == len(ends) else ():
            sieve = Sieve(batch.num_rows)
            stamps = column_stamps(batch.column(stamp), sieve, is_epoch=stamp == EPOCH)
            found = epochs.epochs(stamps, sieve, np.arange(batch.num_rows)) if sieve.good.any() else np.empty(0)
            if sieve.good.any():
                yield Rows("scans", pa.RecordBatch.from_pydict({EPOCH: pa.array(found[sieve.kept])}))


def _parts(file: Path, rows: int) -> Iterator[tuple[int, pa.RecordBatch | Lost]]:
    try:
        table = open_table(file)
        _check_columns(table.schema, file)
    except (*UNREADABLE, FormatError) as error:
        yield 0, Lost(f"the file cannot be read: {brief(error)}", 1, whole=True)
        return
    yield from table.parts(rows, _COLUMNS)


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _is_scans(schema: pa.Schema) -> bool:
    names = schema.names
    return "range" in names and (EPOCH in names or _STAMP in names) and _is_list(schema.field("range").type)


def _check_columns(schema: pa.Schema, file: Path) -> None:
    if not _is_scans(schema):
        raise FormatError(
            "the table has the columns " + ", ".join(schema.names),
            expected=f"'{EPOCH}' (or '{_STAMP}') and 'range', a list of uint16",
            file=file,
        )
    for name, inner in (("range", pa.uint16()), ("intensity", pa.uint8())):
        if name in schema.names:
            kind = schema.field(name).type
            if not _is_list(kind) or kind.value_type != inner:
                raise FormatError(f"column '{name}' is {kind}", expected=f"a list of {inner}", file=file)
    integer, floating = pa.types.is_integer, pa.types.is_floating
    stamp = EPOCH if EPOCH in schema.names else _STAMP
    kind = schema.field(stamp).type
    if not (kind == pa.int64() if stamp == EPOCH else integer(kind) or floating(kind)):
        raise FormatError(
            f"column '{stamp}' is {kind}",
            expected="int64" if stamp == EPOCH else "a number in the unit of the log's clock",
            file=file,
        )
    if "encoder_ticks" in schema.names and not integer(schema.field("encoder_ticks").type):
        raise FormatError(
            f"column 'encoder_ticks' is {schema.field('encoder_ticks').type}", expected="int64", file=file
        )


def _clock(source: LogSource, files: list[Path]) -> Clock:
    """Return the clock of the stamps, by the first readable file."""
    schema = next((schema for file in files if (schema := schema_or_none(file)) is not None), None)
    stamped = schema is not None and EPOCH not in schema.names
    return (source.any_clock if stamped else None) or Clock(TimeSystem.GPS, unit="ns")


def _check_clock(source: LogSource, schema: pa.Schema) -> None:
    if EPOCH in schema.names:
        refuse_clock(source)
    else:
        source.need_clock("gps", unit="s")


def _geometry(source: LogSource, schemas: list[tuple[Path, pa.Schema]]) -> ScanGeometry:
    """Return the one geometry that options and files state."""
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
            missing=Missing("options.scan_geometry"),
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
    """Check a batch's rows and convert them to the schema's columns."""
    lists = [n for n in ("range", "intensity") if n in batch.schema.names]
    sieve = Sieve(batch.num_rows)
    for column in lists:
        lengths = pc.list_value_length(batch.column(column))
        sieve.drop(np.asarray(lengths.is_null()), f"{column} is missing")
        wrong = lengths.fill_null(readings).to_numpy(zero_copy_only=False) != readings
        sieve.drop(wrong, f"{column} does not hold {readings} readings")
    stamp = EPOCH if EPOCH in batch.schema.names else _STAMP
    records = first + np.arange(batch.num_rows)
    stamps = column_stamps(batch.column(stamp), sieve, is_epoch=stamp == EPOCH)
    epochs_gps_ns = epochs.epochs(stamps, sieve, records) if sieve.good.any() else np.empty(0)
    for reject in sieve.rejects(records, np.full(batch.num_rows, -1)):
        yield dataclasses.replace(reject, file=name)
    if not sieve.good.any():
        return
    kept = batch if sieve.good.all() else batch.filter(pa.array(sieve.good))
    columns = {EPOCH: pa.array(epochs_gps_ns[sieve.kept])} | {n: _fixed(kept.column(n), readings) for n in lists}
    if "encoder_ticks" in kept.schema.names:
        columns["encoder_ticks"] = kept.column("encoder_ticks").cast(pa.int64(), safe=False)
    yield Rows("scans", pa.RecordBatch.from_pydict(columns), name, int(records[np.argmax(sieve.good)]))


def _fixed(column: pa.Array, readings: int) -> pa.Array:
    """Return lists of `readings` values as a fixed-size list; a null reading is 0, no return."""
    values = column.flatten()
    return pa.FixedSizeListArray.from_arrays(values.fill_null(0) if values.null_count else values, readings)


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
    geometry = _written_geometry(across, _span(heights, sensor_height_m), quantum)
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


def _written_geometry(across: Float64, span: tuple[float, float], quantum: float | ScanGeometry | None) -> ScanGeometry:
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
