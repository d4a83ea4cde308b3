"""Page headers of Parquet files, held against the counts in the file's footer before a row group is read.

Arrow passes over a page whose type it does not know. Damage in that one number makes a column shorter, and its later
rows move up beside those of other columns. Here every page has to be of a known type, and the pages of a column have
to hold as many values as the footer says. (Apache Parquet format, *parquet.thrift*, PageHeader; Thrift's compact
protocol.)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO, Final

_HEADER_BYTES: Final = 1 << 16
"""A page's header, with its statistics, is shorter."""
_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
_TYPE, _COMPRESSED_SIZE = 1, 3
_VALUES_IN: Final = {_DATA: 5, _DATA_V2: 8}
"""Field of the header of a data page by type of page; its field 1 is the number of values."""
_MOST_NESTED: Final = 8

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12


def pages_fault(path: Path, row_group: Any, columns: list[str]) -> str:
    """What is wrong with the pages of the columns of a row group, "" where nothing is.

    Parameters
    ----------
    row_group : its metadata (:class:`pyarrow.parquet.RowGroupMetaData`).
    columns : names of top-level columns; others are not looked at.
    """
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        for number in range(row_group.num_columns):
            chunk = row_group.column(number)
            if chunk.path_in_schema.split(".")[0] in columns:
                try:
                    fault = _chunk_fault(stream, chunk, size)
                except (IndexError, ValueError):
                    fault = "a page's header is damaged"
                if fault:
                    return f"column '{chunk.path_in_schema}': {fault}"
    return ""


def _chunk_fault(stream: BinaryIO, chunk: Any, size: int) -> str:
    starts = [offset for offset in (chunk.dictionary_page_offset, chunk.data_page_offset) if offset]
    at = min(starts, default=0)
    end = at + chunk.total_compressed_size
    if not 0 <= at <= end <= size:
        return "its pages lie outside the file"
    values = 0
    while at < end:
        stream.seek(at)
        header = _Compact(stream.read(min(_HEADER_BYTES, end - at)))
        fields = header.struct()
        kind, length = fields.get(_TYPE), fields.get(_COMPRESSED_SIZE)
        at += header.at + (length if isinstance(length, int) else -1)
        if kind not in (_DATA, _DICTIONARY, _DATA_V2) or not isinstance(length, int) or length < 0 or at > end:
            return "a page's header is damaged"
        if kind in _VALUES_IN:
            values += _count(fields.get(_VALUES_IN[kind]))
    return "" if values == chunk.num_values else f"its pages hold {values} values of {chunk.num_values}"


def _count(page: Any) -> int:
    held = page.get(1) if isinstance(page, dict) else None
    if not isinstance(held, int) or held < 0:
        raise ValueError("no number of values")
    return held


class _Compact:
    """Reads Thrift's compact protocol.

    Raises
    ------
    IndexError, ValueError
        at damage.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0
        """Bytes read."""

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """Fields by number: numbers and structs; of anything else None."""
        if depth > _MOST_NESTED:
            raise ValueError("nested too deeply")
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._number()
            fields[number] = self._value(head & 15, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (_I16, _I32, _I64):
            return self._number()
        if kind == _STRUCT:
            return self.struct(depth + 1)
        if kind in (_LIST, _SET):
            head = self._byte()
            for _ in range(head >> 4 if head >> 4 < 15 else self._varint()):
                if head & 15 in (_TRUE, _FALSE):
                    self._byte()
                else:
                    self._value(head & 15, depth + 1)
        elif kind in (_BYTE, _DOUBLE, _BINARY):
            self._skip({_BYTE: 1, _DOUBLE: 8}.get(kind) or self._varint())
        elif kind not in (_TRUE, _FALSE):
            raise ValueError("unknown type")
        return None

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self._data):
            raise IndexError

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
