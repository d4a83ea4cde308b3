"""Reads profiles of a line scanner from the store into reused arrays.

Files with roadscan's pages are decoded by `codecs/parquet`; those of other writers, and of older stores, by Arrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.store.codecs.parquet.page_file import DamageError, ListTableFile
from roadscan.store.readings.group_reader import Footer, GroupReader
from roadscan.store.store import Store

_COLUMNS: Final = ["epoch_gps_ns", "range", "intensity"]

Int64 = np.ndarray[Any, np.dtype[np.int64]]
UInt16 = np.ndarray[Any, np.dtype[np.uint16]]
UInt8 = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True)
class Profiles:
    """Readings of n profiles of m readings, as stored."""

    epoch_gps_ns: Int64
    """(n,) GPS time of each profile's first reading."""
    range: UInt16
    """(n, m) raw ranges, contiguous; 0 is no return."""
    intensity: UInt8 | None
    """(n, m) raw intensities, contiguous; None where a profile has none."""


class ProfileReader(GroupReader[Profiles, ListTableFile]):
    """Reads row groups of a file of scans; errors as of :class:`GroupReader`."""

    what = "profiles"
    columns = _COLUMNS

    def __init__(self, store: Store, file: str, footer: Footer | None = None) -> None:
        """`footer` : the file, where it is open."""
        self._epochs: Int64 = np.empty(0, np.int64)
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
            packed.load(group, _COLUMNS)
            packed.flat("epoch_gps_ns", epochs[own])
            if not packed.lists("range", ranges[own]):
                raise DamageError("a profile has no ranges")
            bright &= packed.lists("intensity", intensities[own])
            first += n
        return Profiles(epochs, ranges, intensities if bright else None)

    def _from_table(self, rows: pa.Table) -> Profiles:
        epochs, ranges, intensities = (rows.column(name) for name in _COLUMNS)
        if epochs.null_count or ranges.null_count:
            raise DamageError("a profile has no epoch or no ranges")
        return Profiles(
            epochs.cast(pa.int64()).to_numpy(),
            _readings(ranges, pa.uint16()),
            None if intensities.null_count else _readings(intensities, pa.uint8()),
        )


def _list_size(schema: pa.Schema) -> int | None:
    """Return the readings per profile of a table of the stored types; None for other, convertible types."""
    for name in _COLUMNS:
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
