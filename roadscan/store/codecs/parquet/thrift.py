"""Encoder of Thrift's compact protocol, as far as Parquet's headers and footers use it.

(Apache Thrift, *Thrift Compact protocol encoding*.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

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
