"""Reads row groups of ingested readings, as roadscan itself writes them or by Arrow, and says what is damaged."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final, Generic, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import StoreError
from roadscan.store.codecs.choice import LIBRARY
from roadscan.store.codecs.parquet.page_file import DamageError, PageFile, read_footer
from roadscan.store.readings.byte_source import opened
from roadscan.store.store import Store

Rows = TypeVar("Rows")
Pages = TypeVar("Pages", bound=PageFile)

_DAMAGE: Final = (OSError, ValueError, pa.ArrowException, DamageError)


class GroupReader(ABC, Generic[Rows, Pages]):
    """Row groups of a file, into buffers that are reused; one a thread.

    Raises
    ------
    StoreError
        naming file and row groups, where the file is missing, damaged or does not hold such readings.
    """

    what: ClassVar[str]
    """Its readings, as errors name them."""
    columns: ClassVar[Sequence[str]]
    """Those that are read."""

    def __init__(self, store: Store, file: str) -> None:
        self._file = file
        self._packed: Pages | None = None
        try:
            self._source = opened(store, store.path(file))
            self._metadata, ours = read_footer(self._source.stream)
            suits = self._suits(self._metadata.schema.to_arrow_schema())
            if ours and suits and not LIBRARY:
                self._packed = self._pages()
        except _DAMAGE as error:
            raise self._error(error) from error

    def expect(self, groups: Sequence[int]) -> None:
        """Let row groups be on their way that will be read soon; what is wrong with them is said when they are read."""
        if self._packed is not None:
            with contextlib.suppress(*_DAMAGE):
                self._packed.expect([k for k in groups if 0 <= k < self._metadata.num_row_groups], self.columns)

    def read(self, groups: Sequence[int]) -> Rows:
        """Readings of row groups, in the order given; the arrays are valid until the next read of this reader."""
        try:
            if any(not 0 <= k < self._metadata.num_row_groups for k in groups):
                raise DamageError(f"it has {self._metadata.num_row_groups} row groups")
            if self._packed is not None:
                return self._decoded(self._packed, groups)
            return self._from_table(self._arrow(groups))
        except _DAMAGE as error:
            raise self._error(error, groups) from error

    @abstractmethod
    def _suits(self, schema: pa.Schema) -> bool:
        """True if the columns have the types that are stored today; DamageError where one is missing."""

    @abstractmethod
    def _pages(self) -> Pages:
        """The file's pages, which roadscan wrote."""

    @abstractmethod
    def _decoded(self, packed: Pages, groups: Sequence[int]) -> Rows:
        """Row groups out of roadscan's own pages."""

    @abstractmethod
    def _from_table(self, rows: pa.Table) -> Rows:
        """Row groups as Arrow reads them."""

    def _arrow(self, groups: Sequence[int]) -> pa.Table:
        file = pq.ParquetFile(self._source.stream, metadata=self._metadata, page_checksum_verification=True)
        return file.read_row_groups(list(groups), columns=list(self.columns), use_threads=False)

    def _error(self, error: Exception, groups: Sequence[int] = ()) -> StoreError:
        return StoreError(
            f"ingested {self.what} cannot be read ({error})",
            change="`roadscan verify` names damaged files; remove the log's record to ingest it again",
            file=self._file,
            record=f"row groups {', '.join(map(str, groups))}" if groups else None,
        )
