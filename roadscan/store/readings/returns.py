"""Reads returns of a lidar from the store into reused arrays, from files of ``returns`` and of ``packed_returns``.

Files with roadscan's pages are decoded by `codecs/parquet`; those of other writers, and of older stores, by Arrow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.store.codecs.parquet.page_file import DamageError, NumberFile
from roadscan.store.readings.group_reader import Footer, GroupReader
from roadscan.store.readings.kernels.firings import Packed
from roadscan.store.readings.packed_returns import EIGHT_TO_SIXTEEN_BITS, Beams, as_returns, is_packed
from roadscan.store.store import Store

_EPOCH, _POSE_EPOCH = "epoch_gps_ns", "pose_epoch_gps_ns"
_LASER, _SWEEP = "laser", "sweep"
_MORE_KINDS: Final = {_LASER: np.uint8, _SWEEP: np.int32}
_KINDS: Final[dict[str, np.dtype[Any]]] = {
    _EPOCH: np.dtype(np.int64), _POSE_EPOCH: np.dtype(np.int64),
    "x_sensor_m": np.dtype(np.float32), "y_sensor_m": np.dtype(np.float32), "z_sensor_m": np.dtype(np.float32),
    "intensity": np.dtype(np.uint16),
}  # fmt: skip
_COLUMNS: Final = list(_KINDS)
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
    columns = _COLUMNS

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
        rows = as_returns(rows, _COLUMNS)
        if any(rows.column(name).null_count for name in _COLUMNS):
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
