"""Reads named columns of Parquet or Arrow IPC (Feather) files a few rows at a time; damage costs what it hits.

Reads record batches of mapped Arrow IPC files (Feather), and checks them against the list in the file's footer.

Arrow reads what the footer lists. A damaged or truncated list would silently leave out readings.
"""

from __future__ import annotations

import itertools
import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import FormatError, brief
from roadscan.store.codecs.parquet.foreign_pages import ParquetPages
from roadscan.store.digest import UNREADABLE

_SUFFIXES: Final = (".parquet", ".arrow", ".feather", ".ipc")
_MAPPED_CHUNKS: Final = 8
"""Chunks of a mapped file after which its pages are released."""
_LARGE_FILE_BYTES: Final = 32 << 20  # larger files are read through a buffer
_BUFFER_BYTES: Final = 1 << 20  # bytes of that buffer


@dataclass(frozen=True)
class Lost:
    """Rows of a table that could not be read."""

    reason: str
    records: int
    whole: bool = False
    """True where the whole file is lost."""


class ColumnTable(Protocol):
    """A table file that is read a few rows at a time."""

    schema: pa.Schema

    def parts(self, rows: int, columns: Sequence[str]) -> Iterator[tuple[int, pa.RecordBatch | Lost]]:
        """Yield the number of the first row and at most `rows` rows of `columns`, or what was lost."""

    def ending(self, column: str) -> pa.RecordBatch | None:
        """Return the last rows of one column; None where they cannot be read."""


class _Parquet:
    def __init__(self, file: Path) -> None:
        # Reading through a buffer bounds memory, but trusts the page sizes that a damaged file claims.
        large = file.stat().st_size > _LARGE_FILE_BYTES
        self._file = pq.ParquetFile(
            file, buffer_size=_BUFFER_BYTES if large else 0, pre_buffer=False, page_checksum_verification=True
        )
        self._path = file
        self.schema = self._file.schema_arrow

    def parts(self, rows: int, columns: Sequence[str]) -> Iterator[tuple[int, pa.RecordBatch | Lost]]:
        names = [n for n in self.schema.names if n in columns]
        metadata, pages = self._file.metadata, ParquetPages(self._path)
        first = 0
        for number in range(metadata.num_row_groups):
            count, done = metadata.row_group(number).num_rows, 0
            reason = pages.fault(number, names)
            try:
                for batch in [] if reason else self._file.iter_batches(rows, row_groups=[number], columns=names):
                    yield first + done, batch
                    done += batch.num_rows
            except UNREADABLE as error:
                reason = brief(error)
            if reason or done < count:
                yield first + done, Lost(f"row group is damaged: {reason or 'rows are missing'}", max(1, count - done))
            first += max(count, done)

    def ending(self, column: str) -> pa.RecordBatch | None:
        last = self._file.metadata.num_row_groups - 1
        if last < 0 or ParquetPages(self._path).fault(last, [column]):
            return None
        try:
            (batch,) = self._file.read_row_group(last, [column], use_threads=False).combine_chunks().to_batches()
        except UNREADABLE:
            return None
        return batch


class _Arrow:
    def __init__(self, file: Path) -> None:
        self._path = file
        self.schema = MappedBatches(file).reader.schema

    def parts(self, rows: int, columns: Sequence[str]) -> Iterator[tuple[int, pa.RecordBatch | Lost]]:
        fields = [k for k, name in enumerate(self.schema.names) if name in columns]
        mapped = MappedBatches(self._path, fields)
        first, passed = 0, 0
        for batch in _joined(mapped.reader, rows):
            if isinstance(batch, Lost):
                yield first, batch
                continue
            for start in range(0, batch.num_rows, rows):
                yield first + start, batch.slice(start, rows)
                passed += 1
                if passed % _MAPPED_CHUNKS == 0:
                    mapped.release()
            first += batch.num_rows
        unlisted = unlisted_batches(self._path, mapped.reader.num_record_batches)
        if unlisted:
            yield first, Lost(unlisted_reason(unlisted), unlisted)

    def ending(self, column: str) -> pa.RecordBatch | None:
        reader = MappedBatches(self._path, [self.schema.names.index(column)]).reader
        batch = _batch(reader, reader.num_record_batches - 1) if reader.num_record_batches else None
        return batch if isinstance(batch, pa.RecordBatch) else None


def _joined(reader: pa.ipc.RecordBatchFileReader, rows: int) -> Iterator[pa.RecordBatch | Lost]:
    """Yield batches in their order, short ones merged into one of at most `rows` rows: each batch costs some calls."""
    short: list[pa.RecordBatch] = []
    held = 0
    for number in range(reader.num_record_batches):
        batch = _batch(reader, number)
        if short and (isinstance(batch, Lost) or held + batch.num_rows > rows):
            yield short[0] if len(short) == 1 else pa.concat_batches(short)
            short, held = [], 0
        if isinstance(batch, Lost):
            yield batch
        else:
            short.append(batch)
            held += batch.num_rows
    if short:
        yield short[0] if len(short) == 1 else pa.concat_batches(short)


def _batch(reader: pa.ipc.RecordBatchFileReader, number: int) -> pa.RecordBatch | Lost:
    try:
        batch = reader.get_batch(number)
        batch.validate(full=True)
    except UNREADABLE as error:
        return Lost(f"record batch is damaged: {brief(error)}", 1)
    return batch


def open_table(file: Path) -> ColumnTable:
    """Return the table of a file, identified by its first bytes.

    Raises
    ------
    FormatError
        if it is neither Parquet nor Arrow IPC.
    UNREADABLE
        if it is damaged.
    """
    with file.open("rb") as stream:
        magic = stream.read(6)
    if magic[:4] == b"PAR1":
        table: ColumnTable = _Parquet(file)
    elif magic == b"ARROW1":
        table = _Arrow(file)
    else:
        raise FormatError("the file is neither Parquet nor Arrow IPC", expected="its first bytes to be PAR1 or ARROW1")
    table.schema.names  # noqa: B018 — damaged names show themselves here
    return table


def need_table(file: Path) -> ColumnTable:
    """Return the table of a file, or raise :class:`FormatError` with its name where it cannot be opened."""
    try:
        return open_table(file)
    except FormatError as error:
        raise FormatError(error.arrived, expected=error.expected, file=file) from error
    except UNREADABLE as error:
        raise FormatError(f"the file is damaged: {brief(error)}", expected="Arrow IPC or Parquet", file=file) from error


def table_files(path: Path) -> list[Path]:
    """Return the file, or all Parquet and Arrow files of the folder by name."""
    if not path.is_dir():
        return [path]
    return sorted(p for p in path.rglob("*") if p.suffix.lower() in _SUFFIXES and p.is_file())


def schema_or_none(file: Path) -> pa.Schema | None:
    """Return the schema of a file, None where it cannot be read."""
    try:
        return open_table(file).schema
    except (*UNREADABLE, FormatError):
        return None


def is_number(kind: pa.DataType) -> bool:
    """Return True for a column of integers or floating-point numbers."""
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


_FIRST_MESSAGE = 8
"""Byte of the first message, after the file's magic number."""
_MESSAGES = 16
"""Messages that are read before their pages are released."""


class MappedBatches:
    """Record batches of a file as views of its mapped pages: nothing is copied, whatever the size of a batch.

    Parameters
    ----------
    fields : numbers of the columns that are wanted; all where left out.

    Raises
    ------
    pa.ArrowException, OSError, ValueError
        where the file is no whole Arrow IPC file.
    """

    def __init__(self, path: Path, fields: list[int] | None = None) -> None:
        self._pages = _mapped(path)
        chosen = pa.ipc.IpcReadOptions(included_fields=fields)
        self.reader = pa.ipc.open_file(pa.BufferReader(pa.py_buffer(self._pages)), options=chosen)

    def release(self) -> None:
        """Release the pages read so far; views stay valid, because a page is mapped again when it is accessed."""
        _give_back(self._pages)


def unlisted_batches(path: Path, listed: int) -> int:
    """Return how many record batches of the file its footer does not list, beyond `listed`; bodies are not read."""
    found = 0
    try:
        pages = _mapped(path)
        stream = pa.BufferReader(pa.py_buffer(pages))
        stream.seek(_FIRST_MESSAGE)
        reader = pa.ipc.MessageReader.open_stream(stream)
        for number in itertools.count():
            found += reader.read_next_message().type == "record batch"
            if number % _MESSAGES == 0:
                _give_back(pages)
    except (StopIteration, pa.ArrowException, OSError, ValueError):  # the end, or damage
        pass
    return max(0, found - listed)


def _mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def _give_back(pages: mmap.mmap) -> None:
    """Release the pages touched so far: else the process would seem to occupy all of the log that it has read."""
    if hasattr(mmap, "MADV_DONTNEED"):
        pages.madvise(mmap.MADV_DONTNEED)


def unlisted_reason(count: int) -> str:
    """Return the reason of the reject for them."""
    return f"{count} record batches stand in the file, but not in its footer"
