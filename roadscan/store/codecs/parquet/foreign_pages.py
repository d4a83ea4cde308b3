"""Checks page headers of Parquet files against the counts in the file's footer before a row group is read.

Arrow skips a page whose type it does not know. Damage in that one number makes a column shorter, and its later
rows move up beside those of other columns. Here every page has to be of a known type, and the pages of a column have
to hold as many values as the footer says. The footer is read here too: pyarrow (26) ends the process when it is asked
for a column chunk with damaged statistics.

(Apache Parquet format, *parquet.thrift*; Thrift's compact protocol.)
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

_HEADER_BYTES: Final = 1 << 16
"""Most bytes of a page's header with its statistics."""
_LARGEST_FOOTER: Final = 1 << 25  # larger footers count as damage (bytes)
_LONGEST_WORD: Final = 1 << 10
"""Longer texts are no names and are skipped (bytes)."""
_MOST_NESTED: Final = 12  # deeper nesting of structs counts as damage

_FILE_ROW_GROUPS, _GROUP_COLUMNS, _CHUNK_METADATA = 4, 1, 3  # field numbers (parquet.thrift)
_PATH, _VALUES, _BYTES, _DATA_OFFSET, _DICTIONARY_OFFSET = 3, 5, 7, 9, 11
"""Fields of a column's metadata."""

_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3  # page types (parquet.thrift)
_PAGE_TYPE, _PAGE_BYTES = 1, 3  # fields of a page header (parquet.thrift)
_VALUES_IN: Final = {_DATA: 5, _DATA_V2: 8}
"""By type of page, the header's field that describes its data; field 1 of that is the number of values."""

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(1, 13)  # Thrift types

_DAMAGE: Final = (LookupError, ValueError, TypeError)


@dataclass(frozen=True)
class _Chunk:
    """Pages of one column in one row group."""

    name: str
    """Name of the top-level column."""
    values: int
    start: int
    size: int


class ParquetPages:
    """Pages of a Parquet file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._groups: list[list[_Chunk]] = []
        with suppress(*_DAMAGE):  # without them, each row group is faulty
            self._groups = _row_groups(path)

    def fault(self, row_group: int, columns: list[str]) -> str:
        """Return what is wrong with the pages of top-level columns of a row group, "" where nothing is."""
        if row_group >= len(self._groups):
            return "the footer is damaged"
        with self._path.open("rb") as stream:
            for chunk in self._groups[row_group]:
                if chunk.name not in columns:
                    continue
                try:
                    fault = _chunk_fault(stream, chunk)
                except _DAMAGE:
                    fault = "a page's header is damaged"
                if fault:
                    return f"column '{chunk.name}': {fault}"
        return ""


def _row_groups(path: Path) -> list[list[_Chunk]]:
    """Return the column chunks of each row group; raises one of `_DAMAGE` where the footer is damaged."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 8))
        length = int.from_bytes(stream.read(4), "little")
        if not 0 < length <= min(size - 8, _LARGEST_FOOTER):
            raise ValueError("no footer")
        stream.seek(size - 8 - length)
        footer = _Compact(stream.read(length)).struct()
    groups = _listed(footer.get(_FILE_ROW_GROUPS))
    return [
        [_chunk(_struct(column), size) for column in _listed(_struct(group).get(_GROUP_COLUMNS))] for group in groups
    ]


def _listed(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError("not a list")
    return value


def _struct(value: Any) -> dict[int, Any]:
    if not isinstance(value, dict):
        raise TypeError("not a struct")
    return value


def _chunk(column: dict[int, Any], file_bytes: int) -> _Chunk:
    about = _struct(column.get(_CHUNK_METADATA))
    word = _listed(about.get(_PATH))[0]
    if not isinstance(word, bytes):
        raise TypeError("not a name")
    starts = [offset for offset in (about.get(_DICTIONARY_OFFSET), about.get(_DATA_OFFSET)) if offset]
    start, size, values = min(starts), about.get(_BYTES), about.get(_VALUES)
    if not (isinstance(values, int) and isinstance(size, int) and 0 <= start <= start + size <= file_bytes):
        raise ValueError("pages outside the file")
    return _Chunk(word.decode("utf-8"), values, start, size)


def _chunk_fault(stream: BinaryIO, chunk: _Chunk) -> str:
    at, end, values = chunk.start, chunk.start + chunk.size, 0
    while at < end:
        stream.seek(at)
        header = _Compact(stream.read(min(_HEADER_BYTES, end - at)))
        fields = header.struct()
        kind, length = fields.get(_PAGE_TYPE), fields.get(_PAGE_BYTES)
        if kind not in (_DATA, _DICTIONARY, _DATA_V2) or not isinstance(length, int) or length < 0:
            return "a page's header is damaged"
        at += header.at + length
        if kind in _VALUES_IN:
            values += _count(fields.get(_VALUES_IN[kind]))
    if at != end:
        return "a page's length is damaged"
    return "" if values == chunk.values else f"its pages hold {values} values of {chunk.values}"


def _count(page: Any) -> int:
    held = _struct(page).get(1)
    if not isinstance(held, int) or held < 0:
        raise ValueError("no number of values")
    return held


class _Compact:
    """Decoder of Thrift's compact protocol; raises one of `_DAMAGE` at damage."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0
        """Position in bytes."""

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """Return fields by number: integers, structs, lists and texts; None for anything else."""
        if depth > _MOST_NESTED:
            raise ValueError("nested too deeply")
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._number()
            kind = head & 15
            fields[number] = None if kind in (_TRUE, _FALSE) else self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (_I16, _I32, _I64):
            return self._number()
        if kind == _STRUCT:
            return self.struct(depth + 1)
        if kind in (_LIST, _SET):
            return self._list(depth)
        if kind == _BINARY:
            return self._text(self._varint())
        if kind in (_TRUE, _FALSE, _BYTE, _DOUBLE):
            self._text(8 if kind == _DOUBLE else 1)
            return None
        raise ValueError("a type that Parquet does not use")

    def _list(self, depth: int) -> list[Any]:
        head = self._byte()
        count = head >> 4 if head >> 4 < 15 else self._varint()
        if count > len(self._data) - self.at:  # each element takes a byte or more
            raise ValueError("a list longer than the data")
        return [self._value(head & 15, depth) for _ in range(count)]

    def _text(self, size: int) -> bytes | None:
        self.at += size
        if self.at > len(self._data):
            raise IndexError
        return self._data[self.at - size : self.at] if size <= _LONGEST_WORD else None

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("a number without end")

    def _number(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
