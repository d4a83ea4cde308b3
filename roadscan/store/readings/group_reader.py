"""Reads row groups of ingested readings, from roadscan's pages or by Arrow, and reports damage.

Reads bytes of a file of the store, some of them ahead of their use.

A folder's files are announced to the system, which reads them into its cache while kernels compute. Spans of an
object are fetched by threads, several at a time, because each request waits for the network.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import StoreError
from roadscan.store.codecs.parquet.page_file import DamageError, PageFile, read_footer
from roadscan.store.codecs.zlib_stream import LIBRARY
from roadscan.store.digest import ROWS_CHANGE, UNREADABLE, unread
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
