"""Reads row groups of ingested readings: profiles and returns into reused arrays, or Arrow tables; reports damage.

Profiles are those of a line scanner, returns those of a lidar, from files of ``returns`` and of ``packed_returns``.
Files with roadscan's pages are decoded by `codecs/parquet`; those of other writers, and of older stores, by Arrow.

Some bytes of a file of the store are read ahead of their use. A folder's files are announced to the system, which reads
them into its cache while kernels compute. Spans of an object are fetched by threads, several at a time, because each
request waits for the network.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.core.errors import StoreError
from roadscan.store.codecs.parquet.page_file import DamageError, ListTableFile, NumberFile, PageFile, read_footer
from roadscan.store.codecs.zlib_stream import LIBRARY
from roadscan.store.digest import ROWS_CHANGE, UNREADABLE, damage_named, unread
from roadscan.store.readings.kernels.firings import Packed
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS, Beams, as_returns, is_packed, stored_columns
from roadscan.store.schema import table_schema
from roadscan.store.store import Store


class HeldBytes:
    """An object that is in memory, because it is small."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        weakref.finalize(self, stream.close)

    def expect(self, start: int, end: int) -> None:
        """Announce bytes `start` to `end`: here they are at hand."""

    def read_into(self, start: int, room: memoryview) -> bool:
        """Fill `room` with the bytes from `start` on; return False where the file is too short."""
        return _filled(self.stream, start, room)


class LocalBytes(HeldBytes):
    """A file of a folder."""

    def expect(self, start: int, end: int) -> None:
        """Announce bytes `start` to `end`, so that the system reads them into its cache."""
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self.stream.fileno(), start, end - start, os.POSIX_FADV_WILLNEED)


class RemoteBytes(HeldBytes):
    """An object of any fsspec file system. Announced bytes that are not read yet stay in memory."""

    def __init__(self, store: Store, path: str) -> None:
        super().__init__(store.fs.open(path, "rb"))
        self._fetch = functools.partial(store.fs.cat_file, path)
        self._ahead: ReadAhead[bytes] = ReadAhead()
        self._expected: list[tuple[int, int]] = []
        self._start, self._held = 0, b""

    def expect(self, start: int, end: int) -> None:
        """Start to fetch bytes `start` to `end` in one request."""
        if (start, end) not in self._expected:
            self._expected.append((start, end))
            self._ahead.begin((start, end), functools.partial(self._fetch, start=start, end=end))

    def read_into(self, start: int, room: memoryview) -> bool:
        """Fill `room` with the bytes from `start` on; return False where the object is too short."""
        end = start + len(room)
        for span in self._expected:
            if span[0] <= start and end <= span[1]:
                self._expected.remove(span)
                self._start, self._held = span[0], self._ahead.take(span)
                break
        if not self._start <= start <= end <= self._start + len(self._held):
            return _filled(self.stream, start, room)
        room[:] = memoryview(self._held)[start - self._start : end - self._start]
        return True


def opened(store: Store, file: str) -> HeldBytes:
    """Open a file of a store by its path in it; an object that is known to be small comes by one request."""
    if store.is_folder:
        return LocalBytes(io.FileIO(store.path(file)))
    if store.is_small(file):
        return HeldBytes(io.BytesIO(store.read_bytes(file)))
    return RemoteBytes(store, store.path(file))


def _filled(stream: Any, start: int, room: memoryview) -> bool:
    stream.seek(start)
    while room:
        count = stream.readinto(room)
        if not count:
            return False
        room = room[count:]
    return True


T = TypeVar("T")


class ReadAhead(Generic[T]):
    """Results by key. Each read has a temporary thread; its exceptions are raised where its result is taken.

    Nothing is read twice, and memory holds what was begun and not taken: who begins reads bounds it. Objects are used
    by one thread.
    """

    def __init__(self) -> None:
        self._begun: dict[Hashable, Future[T]] = {}

    def begin(self, key: Hashable, read: Callable[[], T]) -> None:
        """Start a read, unless one with this key is pending."""
        if key not in self._begun:
            thread = ThreadPoolExecutor(1, thread_name_prefix="read ahead")
            self._begun[key] = thread.submit(read)
            thread.shutdown(wait=False)

    def take(self, key: Hashable) -> T:
        """Wait for a started read and return its result."""
        return self._begun.pop(key).result()


Footer: TypeAlias = tuple[HeldBytes, pq.FileMetaData, bool]
"""An open file, its footer, and whether roadscan's writer wrote it."""
Rows = TypeVar("Rows")
Pages = TypeVar("Pages", bound=PageFile)


def opened_footer(store: Store, file: str) -> Footer:
    """Open a file of the store and read its footer; raises what `store.digest.UNREADABLE` names."""
    source = opened(store, file)
    return source, *read_footer(source.stream)


class GroupReader(ABC, Generic[Rows, Pages]):
    """Reads row groups of a file into reused buffers; use one per thread.

    Raises
    ------
    DamagedError
        naming file and row groups, where the file is missing, damaged or does not hold such readings.
    """

    what: ClassVar[str]
    """Name of its readings in errors."""
    columns: Sequence[str]
    """Columns that are read."""

    def __init__(self, store: Store, file: str, footer: Footer | None = None) -> None:
        """`footer` : the file, where it is open."""
        self._file = file
        self._packed: Pages | None = None
        try:
            self._source, self._metadata, ours = footer or opened_footer(store, file)
            suits = self._suits(self._metadata.schema.to_arrow_schema())
            if ours and suits and not LIBRARY:
                self._packed = self._pages()
        except UNREADABLE as error:
            raise self._error(error) from error

    def expect(self, groups: Sequence[int]) -> None:
        """Start to read row groups ahead; their faults are reported when they are read."""
        if self._packed is not None:
            with contextlib.suppress(*UNREADABLE):
                self._packed.expect([k for k in groups if 0 <= k < self._metadata.num_row_groups], self.columns)

    def read(self, groups: Sequence[int]) -> Rows:
        """Return the readings of row groups, in the given order; the arrays are valid until the next read."""
        try:
            if any(not 0 <= k < self._metadata.num_row_groups for k in groups):
                raise DamageError(f"it has {self._metadata.num_row_groups} row groups")
            if self._packed is not None:
                return self._decoded(self._packed, groups)
            return self._from_table(self._arrow(groups))
        except UNREADABLE as error:
            raise self._error(error, groups) from error

    @abstractmethod
    def _suits(self, schema: pa.Schema) -> bool:
        """Return True if the columns have the current storage types; DamageError where one is missing."""

    @abstractmethod
    def _pages(self) -> Pages:
        """Return the file's pages, which roadscan wrote."""

    @abstractmethod
    def _decoded(self, packed: Pages, groups: Sequence[int]) -> Rows:
        """Return row groups from roadscan's pages."""

    @abstractmethod
    def _from_table(self, rows: pa.Table) -> Rows:
        """Return row groups as Arrow reads them."""

    def _arrow(self, groups: Sequence[int]) -> pa.Table:
        file = pq.ParquetFile(self._source.stream, metadata=self._metadata, page_checksum_verification=True)
        return file.read_row_groups(list(groups), columns=list(self.columns), use_threads=False)

    def _error(self, error: Exception, groups: Sequence[int] = ()) -> StoreError:
        record = f"row groups {', '.join(map(str, groups))}" if groups else None
        return unread(f"ingested {self.what} cannot be read", error, self._file, ROWS_CHANGE, record)


_PROFILE_COLUMNS: Final = ["epoch_gps_ns", "range", "intensity"]

Epochs = np.ndarray[Any, np.dtype[np.int64]]
UInt16 = np.ndarray[Any, np.dtype[np.uint16]]
UInt8 = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True)
class Profiles:
    """Readings of n profiles of m readings, as stored."""

    epoch_gps_ns: Epochs
    """(n,) GPS time of each profile's first reading."""
    range: UInt16
    """(n, m) raw ranges, contiguous; 0 is no return."""
    intensity: UInt8 | None
    """(n, m) raw intensities, contiguous; None where a profile has none."""


class ProfileReader(GroupReader[Profiles, ListTableFile]):
    """Reads row groups of a file of scans; errors as of :class:`GroupReader`."""

    what = "profiles"
    columns = _PROFILE_COLUMNS

    def __init__(self, store: Store, file: str, footer: Footer | None = None) -> None:
        """`footer` : the file, where it is open."""
        self._epochs: Epochs = np.empty(0, np.int64)
        self._ranges: UInt16 = np.empty(0, np.uint16)
        self._intensities: UInt8 = np.empty(0, np.uint8)
        self._size = 0
        super().__init__(store, file, footer)

    def _suits(self, schema: pa.Schema) -> bool:
        size = _list_size(schema)
        self._size = size or 0
        return size is not None

    def _pages(self) -> ListTableFile:
        return ListTableFile(self._source, self._metadata)

    def _decoded(self, packed: ListTableFile, groups: Sequence[int]) -> Profiles:
        size = self._size
        rows = [self._metadata.row_group(k).num_rows for k in groups]
        total = sum(rows)
        if self._epochs.size < total:
            self._epochs = np.empty(total, np.int64)
            self._ranges, self._intensities = np.empty(total * size, np.uint16), np.empty(total * size, np.uint8)
        epochs = self._epochs[:total]
        ranges = self._ranges[: total * size].reshape(total, size)
        intensities = self._intensities[: total * size].reshape(total, size)
        first, bright = 0, True
        for group, n in zip(groups, rows, strict=True):
            own = slice(first, first + n)
            packed.load(group, _PROFILE_COLUMNS)
            packed.flat("epoch_gps_ns", epochs[own])
            if not packed.lists("range", ranges[own]):
                raise DamageError("a profile has no ranges")
            bright &= packed.lists("intensity", intensities[own])
            first += n
        return Profiles(epochs, ranges, intensities if bright else None)

    def _from_table(self, rows: pa.Table) -> Profiles:
        epochs, ranges, intensities = (rows.column(name) for name in _PROFILE_COLUMNS)
        if epochs.null_count or ranges.null_count:
            raise DamageError("a profile has no epoch or no ranges")
        return Profiles(
            epochs.cast(pa.int64()).to_numpy(),
            _readings(ranges, pa.uint16()),
            None if intensities.null_count else _readings(intensities, pa.uint8()),
        )


def _list_size(schema: pa.Schema) -> int | None:
    """Return the readings per profile of a table of the stored types; None for other, convertible types."""
    for name in _PROFILE_COLUMNS:
        if schema.get_field_index(name) < 0:
            raise DamageError(f"it has no column '{name}'")
    ranges, intensities = schema.field("range").type, schema.field("intensity").type
    if not (pa.types.is_fixed_size_list(ranges) and pa.types.is_fixed_size_list(intensities)):
        return None
    types = (schema.field("epoch_gps_ns").type, ranges.value_type, intensities.value_type)
    same = ranges.list_size == intensities.list_size and types == (pa.int64(), pa.uint16(), pa.uint8())
    return int(ranges.list_size) if same else None


def _readings(lists: pa.ChunkedArray, kind: pa.DataType) -> npt.NDArray[Any]:
    """Return (n, m) values of lists without nulls."""
    sizes = pa.compute.list_value_length(lists).unique()
    if len(sizes) > 1:
        raise DamageError("its profiles differ in their numbers of readings")
    flat = pa.compute.list_flatten(lists)
    if flat.null_count:
        raise DamageError("readings are missing")
    none = lists.type.list_size if pa.types.is_fixed_size_list(lists.type) else 0
    return np.ascontiguousarray(flat.cast(kind).to_numpy()).reshape(len(lists), -1 if len(lists) else none)


_EPOCH, _POSE_EPOCH = "epoch_gps_ns", "pose_epoch_gps_ns"
_LASER, _SWEEP = "laser", "sweep"
_MORE_KINDS: Final = {_LASER: np.uint8, _SWEEP: np.int32}
_KINDS: Final[dict[str, np.dtype[Any]]] = {
    _EPOCH: np.dtype(np.int64), _POSE_EPOCH: np.dtype(np.int64),
    "x_sensor_m": np.dtype(np.float32), "y_sensor_m": np.dtype(np.float32), "z_sensor_m": np.dtype(np.float32),
    "intensity": np.dtype(np.uint16),
}  # fmt: skip
_RETURN_COLUMNS: Final = list(_KINDS)
_PACKED_KINDS: Final[dict[str, np.dtype[Any]]] = {
    _EPOCH: np.dtype(np.int64), "distance": np.dtype(np.uint16), "slot": np.dtype(np.uint8),
    "intensity": np.dtype(np.uint8), "head": np.dtype(np.uint16), "rate_rad_per_ns": np.dtype(np.float64),
}  # fmt: skip

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Returns:
    """Returns as stored, (n,) each."""

    epoch_gps_ns: Int64
    """GPS time of each measurement."""
    pose_epoch_gps_ns: Int64
    """GPS time of the pose that places it; the same array object where the two are equal."""
    x_sensor_m: Float32
    y_sensor_m: Float32
    z_sensor_m: Float32
    intensity: npt.NDArray[np.uint16]
    laser: npt.NDArray[np.uint8] | None = None
    """As `sweep`, only of packed returns, and where asked for."""
    sweep: npt.NDArray[np.int32] | None = None


class ReturnsReader(GroupReader[Returns, NumberFile]):
    """Reads row groups of a file of returns; errors as of :class:`GroupReader`."""

    what = "returns"
    columns = _RETURN_COLUMNS

    def __init__(self, store: Store, file: str, footer: Footer | None = None, *, more: Set[str] = frozenset()) -> None:
        """`footer` : the file, where it is open; more : whether `laser` and `sweep` of packed returns are read, too."""
        self._more = more
        self._arrays = {name: np.empty(0, kind) for name, kind in _KINDS.items()}
        self._distance = np.empty(0, np.uint16)
        self._beams: Beams | None = None
        """Beams of the sensor; None in a file of ``returns``."""
        super().__init__(store, file, footer)

    def _suits(self, schema: pa.Schema) -> bool:
        if is_packed(schema.names):
            self._beams = Beams.of(self._metadata.metadata)
            self.columns = [*_PACKED_KINDS, *([_SWEEP] if _SWEEP in self._more else [])]
        missing = set(self.columns).difference(schema.names)
        if missing:
            raise DamageError(f"it has no column '{min(missing)}'")
        return _as_stored(schema, _KINDS if self._beams is None else _PACKED_KINDS)

    def _pages(self) -> NumberFile:
        return NumberFile(self._source, self._metadata)

    def _decoded(self, packed: NumberFile, groups: Sequence[int]) -> Returns:
        rows = [self._metadata.row_group(k).num_rows for k in groups]
        total = sum(rows)
        if self._beams is not None:
            return self._unpacked(packed, groups, rows, self._beams)
        if self._arrays[_EPOCH].size < total:
            self._arrays = {name: np.empty(total, kind) for name, kind in _KINDS.items()}
        columns = {name: values[:total] for name, values in self._arrays.items()}
        first, one_epoch = 0, True
        for group, n in zip(groups, rows, strict=True):
            packed.load(group, _RETURN_COLUMNS)
            own = {name: values[first : first + n] for name, values in columns.items()}
            same = packed.same(_EPOCH, _POSE_EPOCH)
            for name, values in own.items():
                if not (same and name == _POSE_EPOCH):
                    packed.numbers(name, values)
            if one_epoch and not same:
                columns[_POSE_EPOCH][:first] = columns[_EPOCH][:first]
            one_epoch &= same
            if same and not one_epoch:
                own[_POSE_EPOCH][:] = own[_EPOCH]
            first += n
        if one_epoch:
            columns[_POSE_EPOCH] = columns[_EPOCH]
        return Returns(*(columns[name] for name in _RETURN_COLUMNS))

    def _unpacked(self, packed: NumberFile, groups: Sequence[int], rows: Sequence[int], beams: Beams) -> Returns:
        total, first = sum(rows), 0
        if self._arrays[_EPOCH].size < total:
            self._arrays = {name: np.empty(total, kind) for name, kind in _KINDS.items()}
            self._distance = np.empty(total, np.uint16)
        columns = {name: values[:total] for name, values in self._arrays.items()}
        columns[_POSE_EPOCH] = columns[_EPOCH]
        columns |= {name: np.empty(total, kind) for name, kind in _MORE_KINDS.items() if name in self._more}
        for group, n in zip(groups, rows, strict=True):
            packed.load(group, self.columns)
            own = slice(first, first + n)
            packed.numbers(_EPOCH, columns[_EPOCH][own])
            np.multiply(packed.bytes("intensity", n), EIGHT_TO_SIXTEEN_BITS, out=columns["intensity"][own])
            packed.numbers("distance", self._distance[:n])
            head_end, head = packed.runs("head", n, _PACKED_KINDS["head"])
            rate_end, rate = packed.runs("rate_rad_per_ns", n, _PACKED_KINDS["rate_rad_per_ns"])
            slot = packed.bytes("slot", n)
            polar = Packed(head, head_end, rate, rate_end, self._distance[:n], slot)
            beams.places(polar, [columns[f"{axis}_sensor_m"][own] for axis in "xyz"])
            if _LASER in self._more:
                columns[_LASER][own] = beams.lasers[slot]
            if _SWEEP in self._more:
                end, sweep = packed.runs(_SWEEP, n, columns[_SWEEP].dtype)
                columns[_SWEEP][own] = np.repeat(sweep, np.diff(end, prepend=0))
            first += n
        return Returns(**columns)

    def _from_table(self, rows: pa.Table) -> Returns:
        rows = as_returns(rows, _RETURN_COLUMNS)
        if any(rows.column(name).null_count for name in _RETURN_COLUMNS):
            raise DamageError("a return is not whole")
        return Returns(*(np.array(rows.column(name).to_numpy(), kind) for name, kind in _KINDS.items()))


def sensor_xyz_m(batch: pa.RecordBatch) -> list[Float64]:
    """Return x, y and z (n,) in the sensor's frame of a batch of ``returns``; missing coordinates are NaN."""
    return [batch.column(f"{axis}_sensor_m").to_numpy(zero_copy_only=False).astype(np.float64) for axis in "xyz"]


def distances_m(batch: pa.RecordBatch) -> Float64:
    """Return distances (n,) from the sensor of a batch of ``returns``; NaN where a coordinate is missing."""
    x, y, z = sensor_xyz_m(batch)
    return np.sqrt(x * x + y * y + z * z)


def _as_stored(schema: pa.Schema, kinds: Mapping[str, np.dtype[Any]]) -> bool:
    """Return True if the columns have the current storage types."""
    fields = (schema.field(name) for name in kinds)
    return all(f.type == pa.from_numpy_dtype(kinds[f.name]) and not f.nullable for f in fields)


_OF_ARROW: Final = b"ARROW:schema"  # Entry of a footer that Arrow leaves out of the schema that it reads.

Columns: TypeAlias = dict[str, pa.Array | pa.ChunkedArray]


def read_groups(store: Store, file: str, groups: Sequence[int], columns: list[str] | None = None) -> pa.Table:
    """Return row groups of a data file; those of packed returns as rows of ``returns``."""
    what, record = "ingested rows cannot be read", f"row groups {groups[0]}–{groups[-1]}"
    with damage_named(what, file, ROWS_CHANGE, record):
        footer = source, metadata, ours = opened_footer(store, file)
        schema = _schema(metadata, columns)
        found = _decoded(store, file, footer, groups, schema) if ours and not LIBRARY else {}
        rest = [name for name in schema.names if name not in found]
        if rest:
            source.stream.seek(0)
            table = pq.ParquetFile(source.stream, metadata=metadata, page_checksum_verification=True)
            own = stored_columns(rest if found else columns, table.schema_arrow.names)
            rows = as_returns(table.read_row_groups(list(groups), columns=own, use_threads=False), columns)
            if not found:
                return rows
            found |= {name: rows.column(name) for name in rest}
        return pa.Table.from_arrays([found[name] for name in schema.names], schema=schema)


def _schema(metadata: pq.FileMetaData, columns: list[str] | None) -> pa.Schema:
    """Return the schema of the wanted columns of a file."""
    held = metadata.schema.to_arrow_schema()
    about = {name: value for name, value in (metadata.metadata or {}).items() if name != _OF_ARROW}
    if is_packed(held.names):
        held, about = table_schema("returns").arrow(), {}
    return pa.schema([field for field in held if columns is None or field.name in columns], about or None)


def _decoded(store: Store, file: str, footer: Footer, groups: Sequence[int], schema: pa.Schema) -> Columns:
    """Return those of the wanted columns that kernels decode, of a file with roadscan's pages."""
    if "x_sensor_m" in schema.names:
        more = {"laser", "sweep"}.intersection(schema.names)
        returns = vars(ReturnsReader(store, file, footer, more=more).read(groups))
        return {
            name: pa.array(values) for name, values in returns.items() if name in schema.names and values is not None
        }
    if {"range", "intensity"} <= set(schema.names):
        profiles = ProfileReader(store, file, footer).read(groups)
        epochs = {"epoch_gps_ns": pa.array(profiles.epoch_gps_ns)} if "epoch_gps_ns" in schema.names else {}
        return epochs | _lists(schema, range=profiles.range, intensity=profiles.intensity)
    return {}


def _lists(schema: pa.Schema, **columns: np.ndarray | None) -> Columns:
    """Return lists of one size of (n, m) numbers; those that some rows do not have are left out."""
    return {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), type=schema.field(name).type)
        for name, values in columns.items()
        if values is not None and pa.types.is_fixed_size_list(schema.field(name).type)
    }
