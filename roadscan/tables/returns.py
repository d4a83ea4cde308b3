"""Returns of a lidar out of the store, into arrays that are used again.

Files as `number_table` writes them are decoded here; those of other writers, and of older stores, by Arrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.kernels.byte_planes import join, join_low
from roadscan.kernels.delta_packing import FAULTS, SLACK_BYTES, WHOLE, decode
from roadscan.tables import pages
from roadscan.tables.group_reader import GroupReader
from roadscan.tables.page_file import DamageError, PageFile
from roadscan.tables.store import Store

_EPOCH, _POSE_EPOCH = "epoch_gps_ns", "pose_epoch_gps_ns"
_KINDS: Final[dict[str, np.dtype[Any]]] = {
    _EPOCH: np.dtype(np.int64), _POSE_EPOCH: np.dtype(np.int64),
    "x_sensor_m": np.dtype(np.float32), "y_sensor_m": np.dtype(np.float32), "z_sensor_m": np.dtype(np.float32),
    "intensity": np.dtype(np.uint16),
}  # fmt: skip
_COLUMNS: Final = list(_KINDS)
_PLANES: Final = 4
_WORD: Final = 8

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]
Int64 = npt.NDArray[np.int64]
Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Returns:
    """Returns as stored, (n,) each."""

    epoch_gps_ns: Int64
    """GPS time at which each was measured."""
    pose_epoch_gps_ns: Int64
    """GPS time of the pose that places it; the very same array where the two are equal."""
    x_sensor_m: Float32
    y_sensor_m: Float32
    z_sensor_m: Float32
    intensity: npt.NDArray[np.uint16]


class _NumberFile(PageFile):
    """Columns of row groups as `number_table` writes them."""

    def __init__(self, source: Any, metadata: pq.FileMetaData) -> None:
        super().__init__(source, metadata)
        self._codec = pa.Codec("lz4_raw")
        self._unpacked = np.empty(0, np.uint64)

    def same(self, name: str, other: str) -> bool:
        """True if two loaded columns are stored in the same bytes."""
        return np.array_equal(self.content(name), self.content(other))

    def numbers(self, name: str, values: Array) -> None:
        """Write a loaded column to (n,) `values`, of the column's type."""
        encoding = _ENCODINGS.get(self.encoding(name), -1)
        data, at, end, size = self.page(name, encoding)
        if not 0 <= size <= _most_bytes(values.size):
            raise DamageError(f"column '{name}' does not hold {values.size} values")
        page = np.frombuffer(self._codec.decompress(data[at:end], size), np.uint8)
        if encoding == pages.DELTA_BINARY_PACKED and values.dtype == np.int64:
            self._differences(name, page, values)
        elif encoding == pages.PLAIN and values.dtype == np.int64 and size == values.nbytes:
            values[:] = page.view("<i8")
        elif encoding == pages.BYTE_STREAM_SPLIT and size == _PLANES * values.size and values.itemsize in (2, 4):
            planes = [page[k * values.size : (k + 1) * values.size] for k in range(_PLANES)]
            if values.itemsize == _PLANES:
                join(*planes, values.view(np.uint32))
            else:
                join_low(*planes[:2], values)
        else:
            raise DamageError(f"column '{name}' does not hold {values.size} values")

    def _differences(self, name: str, page: Bytes, values: Array) -> None:
        words = -(-(page.size + SLACK_BYTES) // _WORD)
        if self._unpacked.size < words:
            self._unpacked = np.empty(words, np.uint64)
        room = self._unpacked.view(np.uint8)
        room[: page.size] = page
        fault = decode(room, self._unpacked, 0, page.size, values)
        if fault != WHOLE:
            raise DamageError(f"column '{name}': {FAULTS[fault]}")


class ReturnsReader(GroupReader[Returns, _NumberFile]):
    """Row groups of a file of returns; errors as of :class:`GroupReader`."""

    what = "returns"
    columns = _COLUMNS

    def __init__(self, store: Store, file: str) -> None:
        self._arrays = {name: np.empty(0, kind) for name, kind in _KINDS.items()}
        super().__init__(store, file)

    def _suits(self, schema: pa.Schema) -> bool:
        missing = set(_COLUMNS).difference(schema.names)
        if missing:
            raise DamageError(f"it has no column '{min(missing)}'")
        return _as_stored(schema)

    def _pages(self) -> _NumberFile:
        return _NumberFile(self._source, self._metadata)

    def _decoded(self, packed: _NumberFile, groups: Sequence[int]) -> Returns:
        rows = [self._metadata.row_group(k).num_rows for k in groups]
        total = sum(rows)
        if self._arrays[_EPOCH].size < total:
            self._arrays = {name: np.empty(total, kind) for name, kind in _KINDS.items()}
        columns = {name: values[:total] for name, values in self._arrays.items()}
        first, one_epoch = 0, True
        for group, n in zip(groups, rows, strict=True):
            packed.load(group, _COLUMNS)
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
        return Returns(*(columns[name] for name in _COLUMNS))

    def _from_table(self, rows: pa.Table) -> Returns:
        if any(rows.column(name).null_count for name in _COLUMNS):
            raise DamageError("a return is not whole")
        return Returns(*(np.array(rows.column(name).to_numpy(), kind) for name, kind in _KINDS.items()))


_ENCODINGS: Final = {
    "PLAIN": pages.PLAIN,
    "DELTA_BINARY_PACKED": pages.DELTA_BINARY_PACKED,
    "BYTE_STREAM_SPLIT": pages.BYTE_STREAM_SPLIT,
}


def _most_bytes(count: int) -> int:
    """Bytes that an unpacked page of so many numbers may take."""
    return _WORD * count + count // 4 + 1024


def _as_stored(schema: pa.Schema) -> bool:
    """True if the columns have the types that are stored today."""
    kinds = (schema.field(name) for name in _COLUMNS)
    return all(f.type == pa.from_numpy_dtype(_KINDS[f.name]) and not f.nullable for f in kinds)
