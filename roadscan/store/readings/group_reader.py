"""Reads row groups of ingested readings, from roadscan's pages or by Arrow, and reports damage."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeAlias, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import StoreError
from roadscan.store.codecs.choice import LIBRARY
from roadscan.store.codecs.parquet.page_file import DamageError, PageFile, read_footer
from roadscan.store.damage import ROWS_CHANGE, UNREADABLE, unread
from roadscan.store.readings.byte_source import HeldBytes, opened
from roadscan.store.store import Store

Footer: TypeAlias = tuple[HeldBytes, pq.FileMetaData, bool]
"""An open file, its footer, and whether roadscan's writer wrote it."""
Rows = TypeVar("Rows")
Pages = TypeVar("Pages", bound=PageFile)


def opened_footer(store: Store, file: str) -> Footer:
    """Open a file of the store and read its footer; raises what `store.damage.UNREADABLE` names."""
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
