"""Data pages (version 1) of integers and of fixed-size lists of them.

A page is a header, then repetition levels (0 begins a list, 1 continues it), then definition levels (how much of
the value's path is there), then the values. Lists of a fixed size have levels that can be stated without looking at the
values, so a page's levels are compared with those that it has to have, instead of being decoded.

(Apache Parquet format, *parquet.thrift*, and *Encodings.md*, "RLE / bit-packing hybrid".)

Encoder of Thrift's compact protocol, as far as Parquet's headers and footers use it.

(Apache Thrift, *Thrift Compact protocol encoding*.)
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _BINARY, _LIST, _STRUCT = 1, 2, 3, 4, 5, 6, 8, 9, 12  # type codes
_LONGEST_DELTA: Final = 15  # longer sizes and field deltas need a separate number
_SHORT: Final = [bytes([number]) for number in range(128)]  # varints of the numbers below 128


class Value(NamedTuple):
    """A value with its type."""

    kind: int
    content: bytes


def varint(number: int) -> bytes:
    """Return the varint of a non-negative number, seven bits per byte."""
    if number <= 127:
        return _SHORT[number]
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)


def zigzag(number: int) -> bytes:
    """Return the varint of a signed number."""
    return varint(2 * number if number >= 0 else -2 * number - 1)


def boolean(value: bool) -> Value:
    """Return a boolean as a field of a struct."""
    return Value(_TRUE if value else _FALSE, b"")


def i8(number: int) -> Value:
    """Return an 8-bit number."""
    return Value(_BYTE, number.to_bytes(1, "little", signed=True))


def i16(number: int) -> Value:
    """Return a 16-bit number."""
    return Value(_I16, zigzag(number))


def i32(number: int) -> Value:
    """Return a 32-bit number."""
    return Value(_I32, zigzag(number))


def i64(number: int) -> Value:
    """Return a 64-bit number."""
    return Value(_I64, zigzag(number))


def binary(content: bytes | str) -> Value:
    """Return bytes, or text in UTF-8."""
    raw = content.encode() if isinstance(content, str) else content
    return Value(_BINARY, varint(len(raw)) + raw)


def listed(values: Sequence[Value]) -> Value:
    """Return a list of values of one type."""
    kind, count = values[0].kind if values else _STRUCT, len(values)
    head = bytes([count << 4 | kind]) if count < _LONGEST_DELTA else bytes([0xF0 | kind]) + varint(count)
    return Value(_LIST, head + b"".join(v.content for v in values))


def struct(fields: Mapping[int, Value]) -> Value:
    """Return a struct of fields by number, ascending."""
    out, before = bytearray(), 0
    for number, value in fields.items():
        delta = number - before
        out += bytes([delta << 4 | value.kind]) if delta <= _LONGEST_DELTA else bytes([value.kind]) + zigzag(number)
        out += value.content
        before = number
    return Value(_STRUCT, bytes(out) + b"\0")


PLAIN, RLE, DELTA_BINARY_PACKED, RLE_DICTIONARY, BYTE_STREAM_SPLIT = 0, 3, 5, 8, 9  # encodings (parquet.thrift)
_NUMBER: Final = b"\x15"
"""Compact-protocol header of the next field, if that is a 32-bit number."""
_DATA_PAGE: Final = _NUMBER + b"\x00"
"""First field of a page's header: its type, a data page."""
_DICTIONARY_PAGE: Final = _NUMBER + b"\x04"
"""First field of the header of a page with a dictionary."""
_LENGTH_BYTES: Final = 4  # bytes of the length before encoded levels
_SIZES_AND_CRC: Final = re.compile(
    rb"\x15[\x00\x04]" + 3 * rb"\x15((?:[\x80-\xFF]{0,3}[\x80-\xFF](?=[^\x00]))?[\x00-\x7F])", re.DOTALL
)
"""A page's type, its uncompressed and compressed bytes, its CRC, each after the byte that names the field."""
_LONGEST_HEADER: Final = 64  # bytes in which the header of a page has to end
_LIMIT: Final = 1 << 31
"""Exclusive limit of a 32-bit number."""

Bools = np.ndarray[Any, np.dtype[np.bool_]]


def flat_levels(valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Return the encoded levels of (n,) values; None for a column without nulls, which has none."""
    if valid is None:
        return b""
    if valid.all():
        return _section(_run(valid.size, 1) if valid.size else b"")
    return _section(b"".join(_run(len(list(same)), int(there)) for there, same in groupby(valid.tolist())))


def list_levels(rows: int, size: int, valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Return the levels of non-null lists of `size` (1 or more) values; `valid` is None where no value is null."""
    own = _run(1, 0) + (_run(size - 1, 1) if size > 1 else b"")
    if valid is None or valid.all():
        repetition = own * rows if size > 1 else _run(rows, 0)
        return _section(repetition) + _section(_run(rows * size, 1 if valid is None else 2))
    repetition = b"".join(own if there else _run(1, 0) for there in valid.tolist())
    runs = ((there, len(list(same))) for there, same in groupby(valid.tolist()))
    return _section(repetition) + _section(b"".join(_run(n * size, 2) if there else _run(n, 0) for there, n in runs))


def varied_list_levels(sizes: npt.NDArray[np.int64]) -> tuple[bytes, int]:
    """Return the encoded levels of non-null lists of so many (n,) non-null values each, and the number of levels."""
    slots = np.maximum(sizes, 1)
    starts = np.cumsum(slots) - slots
    total = int(slots.sum())
    continues, filled = np.ones(total, np.bool_), np.ones(total, np.bool_)
    continues[starts] = False
    filled[starts[sizes == 0]] = False
    return _section(_bits(continues)) + _section(_bits(filled)), total


def bit_packed(values: int) -> bytes:
    """Return what precedes one group of bit-packed dictionary indices, which come in eights."""
    return varint(-(-values // 8) << 1 | 1)


def page_header(size: int, crc: int, values: int, encoding: int, raw: int | None = None) -> bytes:
    """Return the header of a page of `size` bytes (`raw` before compression) and `values` levels.

    The CRC-32 is over levels and values as they are stored.
    """
    return _DATA_PAGE + _sizes(size, crc, raw) + _about(values, encoding)


def dictionary_header(size: int, crc: int, values: int, raw: int) -> bytes:
    """Return the same of a page with the dictionary of a column, PLAIN."""
    return _DICTIONARY_PAGE + _sizes(size, crc, raw) + _about_dictionary(values)


def _sizes(size: int, crc: int, raw: int | None) -> bytes:
    signed = crc - (1 << 32) if crc >> 31 else crc
    sizes = _NUMBER + zigzag(size if raw is None else raw) + _NUMBER + zigzag(size)
    return sizes + _NUMBER + zigzag(signed)


def _about_dictionary(values: int) -> bytes:
    """Return the end of a dictionary's header: the seventh field, a struct, and the stop mark."""
    return struct({3: struct({1: i32(values), 2: i32(PLAIN)})}).content


@functools.lru_cache(maxsize=64)
def _about(values: int, encoding: int) -> bytes:
    """Return the end of a page's header: its fifth field, a struct, and the stop mark."""
    own = struct({k: i32(v) for k, v in {1: values, 2: encoding, 3: RLE, 4: RLE}.items()})
    return struct({1: own}).content


class PageHeader(NamedTuple):
    """Fields of the header of a page."""

    length: int
    """Bytes of the header."""
    crc: int
    size: int
    """Bytes of the page."""
    raw: int
    """Bytes of the page before compression."""


def read_page_header(chunk: npt.NDArray[np.uint8], values: int, encoding: int) -> PageHeader | None:
    """Return the header of the one page of a column chunk; None if it is not as `page_header` writes it."""
    found = _read(chunk, _DATA_PAGE, lambda _: _about(values, encoding))
    return found if found is not None and found.length + found.size == chunk.size else None


def read_dictionary_header(chunk: npt.NDArray[np.uint8], width: int) -> PageHeader | None:
    """Return the header of a column chunk's first page, a dictionary of numbers of `width` bytes; None if it is not."""
    return _read(chunk, _DICTIONARY_PAGE, lambda raw: _about_dictionary(raw // width))


def _read(chunk: npt.NDArray[np.uint8], kind: bytes, rest_of: Callable[[int], bytes]) -> PageHeader | None:
    """Return the header of a page of a kind; its end follows from the bytes before compression."""
    head = chunk[:_LONGEST_HEADER].tobytes()
    found = _SIZES_AND_CRC.match(head)
    if found is None or not head.startswith(kind):
        return None
    raw, size, crc = (_number(varint) for varint in found.groups())
    if not (0 <= raw < _LIMIT and 0 <= size < _LIMIT and -_LIMIT <= crc < _LIMIT):
        return None
    rest = rest_of(raw)
    length = found.end() + len(rest)
    if length + size > chunk.size or head[found.end() : length] != rest:
        return None
    return PageHeader(length, crc % (1 << 32), size, raw)


def _number(varint: bytes) -> int:
    """Return the signed number of a varint."""
    value = 0
    for byte in reversed(varint):
        value = value << 7 | byte & 127
    return (value >> 1) ^ -(value & 1)


def _section(runs: bytes) -> bytes:
    return len(runs).to_bytes(_LENGTH_BYTES, "little") + runs


def _bits(levels: Bools) -> bytes:
    """Return levels (n,) of one bit: a run where all are equal."""
    if not levels.size or (levels == levels[0]).all():
        return _run(levels.size, int(levels[0])) if levels.size else b""
    return bit_packed(levels.size) + np.packbits(levels, bitorder="little").tobytes()


def _run(count: int, level: int) -> bytes:
    """Return a level repeated `count` times, for a column whose levels fit in a byte."""
    return varint(count << 1) + bytes([level])
