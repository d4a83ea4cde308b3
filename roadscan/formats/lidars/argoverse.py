"""Argoverse 2 sensor logs: spinning-lidar sweeps as Feather files, with an epoch for every return.

``sensors/lidar/<stamp in ns>.feather`` holds x, y, z (float16, m), intensity (0–255), laser_number and
offset_ns (Wilson et al. 2021, section 3.1, and the dataset's user guide). Coordinates are in the
**ego-vehicle** frame (x forward, y left, z up) and already compensated for motion to the sweep's stamp,
so a return's epoch is stamp + offset_ns and the epoch of its pose is the stamp. With the poses of
``city_SE3_egovehicle.feather`` as trajectory the rig file's sensor needs neither axes nor a lever arm, and those that
it states are refused unless `mounts_vehicle_frame` confirms them. Intensity is scaled to 16 bits: 255 becomes 65,535.

The publisher moved all stamps, so they tell no true date; any clock that counts nanoseconds will do as
long as it is stated the same for the poses and the sweeps.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.core.errors import FormatError, Missing, TimeSystemError, brief
from roadscan.core.toml_text import toml
from roadscan.formats.lidars.packet_returns import returns_batch
from roadscan.ingest.reading.column_table import unlisted_batches, unlisted_reason
from roadscan.ingest.reading.format import NO_LEVER_ARM, Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import Sieve
from roadscan.store.digest import UNREADABLE
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS

_COLUMNS: Final = ("x", "y", "z", "intensity", "laser_number", "offset_ns")
_CHUNK_RETURNS: Final = 1 << 18  # returns of a chunk
_FARTHEST_M: Final = 10_000.0  # farther positions count as damage
_LONGEST_OFFSET_NS: Final = 1_000_000_000  # larger offsets count as damage
_SWEEP: Final = re.compile(r"^\d{10,19}\.feather$")
_CLOCK: Final = {"system": "unix_gps", "unit": "ns"}


class Argoverse(LogFormat):
    """Argoverse 2 lidar sweeps."""

    name: ClassVar[str] = "argoverse"
    title: ClassVar[str] = "Argoverse 2 sensor log: sensors/lidar/<stamp>.feather, a stamp per return"
    yields: ClassVar[tuple[str, ...]] = ("returns",)
    version: ClassVar[int] = 2
    vehicle_axes: ClassVar[str] = "flu"
    time: ClassVar[str] = (
        "stamps count nanoseconds on a scale that the publisher moved: "
        f"state clock = {toml(_CLOCK)}, the same for the poses"
    )

    def sniff(self, path: Path) -> bool:
        """True for a log folder, its lidar folder or one sweep, judged by a sweep's columns."""
        try:
            first = next(iter(sorted(_sweeps(path))), None)
            return first is not None and _has_columns(_open(first).schema)
        except UNREADABLE:
            return False

    def files(self, path: Path) -> list[Path]:
        """Return the sweeps, in order of time."""
        return sorted(_sweeps(path), key=lambda p: (len(p.name), p.name))

    def header(self, source: LogSource) -> LogHeader:
        """Check the clock."""
        files = self.files(source.path)
        if not files:
            raise FormatError("there is no sweep", expected="sensors/lidar/<stamp>.feather", file=source.path)
        _stamp_gps_ns(source, files[len(files) // 2])
        if files == [source.path] and not _readable(source.path):
            raise FormatError("the sweep cannot be read", expected=_EXPECTED, file=source.path)
        return LogHeader(
            {
                "frame": "body",
                "mounting": {"axes": self.vehicle_axes, "lever_arm_body_m": NO_LEVER_ARM},
                "compensated": "to the sweep's stamp, in the ego-vehicle frame",
            }
        )

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream sweep by sweep."""
        for number, file in enumerate(self.files(source.path)):
            name = file.relative_to(source.path).as_posix() if file != source.path else ""
            try:
                stamp = _stamp_gps_ns(source, file)
                sweep = _open(file)
                if not _has_columns(sweep.schema):
                    raise ValueError(f"its columns are {', '.join(sweep.schema.names)}")
            except (*UNREADABLE, TimeSystemError) as error:
                yield Reject(f"the sweep cannot be read: {brief(error)}", 0, -1, 1, name)
                continue
            yield from _items(sweep, name, stamp, number)
            unlisted = unlisted_batches(file, sweep.num_record_batches)
            if unlisted:
                yield Reject(unlisted_reason(unlisted), -1, -1, unlisted, name)


_EXPECTED: Final = "a Feather file with the columns " + ", ".join(_COLUMNS)


def _sweeps(path: Path) -> Iterator[Path]:
    """Yield the sweep files, in no order."""
    if path.is_file():
        if _SWEEP.match(path.name):
            yield path
        return
    inner = path / "sensors" / "lidar"
    folder = inner if inner.is_dir() else path
    if folder.is_dir():
        yield from (p for p in folder.iterdir() if _SWEEP.match(p.name) and p.is_file())


def _open(file: Path) -> Any:
    return pa.ipc.open_file(pa.memory_map(str(file)))


def _readable(file: Path) -> bool:
    try:
        return _has_columns(_open(file).schema)
    except UNREADABLE:
        return False


def _has_columns(schema: pa.Schema) -> bool:
    return all(
        name in schema.names
        and (pa.types.is_floating if name in "xyz" else pa.types.is_integer)(schema.field(name).type)
        for name in _COLUMNS
    )


def _stamp_gps_ns(source: LogSource, file: Path) -> int:
    clock = source.need_clock(**_CLOCK)
    if clock.unit != "ns":
        raise TimeSystemError(
            f"clock.unit is '{clock.unit}', and the sweeps' names count nanoseconds",
            change='set clock.unit = "ns"',
            file=file,
            missing=Missing("clock", _CLOCK),
        )
    try:
        return int(clock.to_epoch_gps_ns(np.array([int(file.stem)]))[0])
    except (TimeSystemError, OverflowError) as error:
        if isinstance(error, TimeSystemError):
            raise error.at(file) from error
        raise TimeSystemError("the file's name is no stamp", expected="nanoseconds", file=file) from error


def _items(sweep: Any, name: str, stamp_gps_ns: int, number: int) -> Iterator[Item]:
    first = 0
    for index in range(sweep.num_record_batches):
        try:
            batch = sweep.get_batch(index).select(list(_COLUMNS))
            batch.validate(full=True)
        except UNREADABLE as error:
            yield Reject(f"the sweep's record batch is damaged: {brief(error)}", first, -1, 1, name)
            continue
        for start in range(0, batch.num_rows, _CHUNK_RETURNS):
            chunk = batch.slice(start, _CHUNK_RETURNS)
            yield from _chunk(chunk, stamp_gps_ns, number, name, first + start)
        first += batch.num_rows


def _chunk(batch: pa.RecordBatch, stamp_gps_ns: int, number: int, name: str, first: int) -> Iterator[Item]:
    xyz = np.stack([_numpy(batch, axis).astype(np.float32) for axis in "xyz"])
    intensity, laser = _numpy(batch, "intensity"), _numpy(batch, "laser_number")
    offset = _numpy(batch, "offset_ns").astype(np.int64)
    sieve = Sieve(batch.num_rows)
    for column in _COLUMNS:
        if batch.column(column).null_count:
            sieve.drop(np.asarray(batch.column(column).is_null()), f"{column} is missing")
    sieve.drop(np.asarray(~(np.abs(xyz) <= _FARTHEST_M).all(axis=0)), "the position is not a number or beyond 10 km")
    sieve.drop(np.asarray((intensity < 0) | (intensity > 255)), "the intensity is outside 0–255")
    sieve.drop(np.asarray((laser < 0) | (laser > 255)), "the laser number is outside 0–255")
    sieve.drop(np.abs(offset) > _LONGEST_OFFSET_NS, "offset_ns is more than 1 s")
    records = first + np.arange(batch.num_rows)
    for reject in sieve.rejects(records, np.full(batch.num_rows, -1)):
        yield dataclasses.replace(reject, file=name)
    good = sieve.kept
    offset = offset[good]
    if not offset.size:
        return
    rows = returns_batch(
        stamp_gps_ns + offset,
        list(xyz[:, good]),
        intensity[good].astype(np.uint16) * EIGHT_TO_SIXTEEN_BITS,
        laser[good].astype(np.uint8),
        np.full(offset.size, number, dtype=np.int32),
        np.full(offset.size, stamp_gps_ns, dtype=np.int64),
    )
    yield Rows("returns", rows, name, int(records[np.argmax(sieve.good)]))


def _numpy(batch: pa.RecordBatch, name: str) -> npt.NDArray[Any]:
    column = batch.column(name)
    values: npt.NDArray[Any] = (
        column.fill_null(0) if column.null_count and not pa.types.is_float16(column.type) else column
    ).to_numpy(zero_copy_only=False)
    return values
