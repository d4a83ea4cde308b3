"""Profiles of a line scanner out of the store, into arrays that are used again.

Files as `list_table` writes them are decoded here; those of other writers, and of older stores, by Arrow.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.model.errors import StoreError
from roadscan.tables.byte_source import opened
from roadscan.tables.list_table_reader import ListTableFile
from roadscan.tables.page_file import DamageError, read_footer
from roadscan.tables.store import Store

_COLUMNS: Final = ["epoch_gps_ns", "range", "intensity"]
_DAMAGE: Final = (OSError, ValueError, pa.ArrowException, DamageError)

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


class ProfileReader:
    """Row groups of a file of scans, into buffers that are reused; one a thread.

    Raises
    ------
    StoreError
        naming file and row groups, where the file is missing, damaged or does not hold scans.
    """

    def __init__(self, store: Store, file: str) -> None:
        self._file = file
        self._epochs: Int64 = np.empty(0, np.int64)
        self._ranges: UInt16 = np.empty(0, np.uint16)
        self._intensities: UInt8 = np.empty(0, np.uint8)
        self._packed: ListTableFile | None = None
        try:
            self._source = opened(store, store.path(file))
            self._metadata, ours = read_footer(self._source.stream)
            self._list_size = _list_size(self._metadata.schema.to_arrow_schema())
        except _DAMAGE as error:
            raise self._error(error) from error
        if ours and self._list_size is not None:
            self._packed = ListTableFile(self._source, self._metadata)

    def expect(self, groups: Sequence[int]) -> None:
        """Let row groups be on their way that will be read soon; what is wrong with them is said when they are read."""
        if self._packed is not None:
            with contextlib.suppress(*_DAMAGE):
                self._packed.expect([k for k in groups if 0 <= k < self._metadata.num_row_groups], _COLUMNS)

    def read(self, groups: Sequence[int]) -> Profiles:
        """Profiles of row groups, in the order given; the arrays are valid until the next read of this reader."""
        outside = [k for k in groups if not 0 <= k < self._metadata.num_row_groups]
        try:
            if outside:
                raise DamageError(f"it has {self._metadata.num_row_groups} row groups")
            if self._packed is None or self._list_size is None:
                return self._arrow(list(groups))
            return self._decoded(self._packed, groups, self._list_size)
        except _DAMAGE as error:
            raise self._error(error, groups) from error

    def _decoded(self, packed: ListTableFile, groups: Sequence[int], size: int) -> Profiles:
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

    def _arrow(self, groups: list[int]) -> Profiles:
        file = pq.ParquetFile(self._source.stream, metadata=self._metadata, page_checksum_verification=True)
        rows = file.read_row_groups(groups, columns=_COLUMNS, use_threads=False)
        epochs, ranges, intensities = (rows.column(name) for name in _COLUMNS)
        if epochs.null_count or ranges.null_count:
            raise DamageError("a profile has no epoch or no ranges")
        return Profiles(
            epochs.cast(pa.int64()).to_numpy(),
            _readings(ranges, pa.uint16()),
            None if intensities.null_count else _readings(intensities, pa.uint8()),
        )

    def _error(self, error: Exception, groups: Sequence[int] = ()) -> StoreError:
        return StoreError(
            f"ingested profiles cannot be read ({error})",
            change="`roadscan verify` names damaged files; remove the log's record to ingest it again",
            file=self._file,
            record=f"row groups {', '.join(map(str, groups))}" if groups else None,
        )


def _list_size(schema: pa.Schema) -> int | None:
    """Readings a profile in a table of the stored types; None for other types that may serve."""
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
    """(n, m) values of lists without nulls."""
    sizes = pa.compute.list_value_length(lists).unique()
    if len(sizes) > 1:
        raise DamageError("its profiles differ in their numbers of readings")
    flat = pa.compute.list_flatten(lists)
    if flat.null_count:
        raise DamageError("readings are missing")
    return np.ascontiguousarray(flat.cast(kind).to_numpy()).reshape(len(lists), -1 if len(lists) else 0)
