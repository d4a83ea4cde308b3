"""Data pages (version 1, not compressed) of whole numbers and of fixed-size lists of them.

A page is a header, then repetition levels (0 begins a list, 1 goes on with it), then definition levels (how much of
the value's path is there), then the values. Lists of a fixed size have levels that can be stated without looking at the
values, so a page's levels are compared with those that it has to have, instead of being decoded.

(Apache Parquet format, *parquet.thrift*, and *Encodings.md*, "RLE / bit-packing hybrid".)
"""

from __future__ import annotations

from itertools import groupby
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.tables import thrift

PLAIN, RLE, DELTA_BINARY_PACKED = 0, 3, 5
_DATA_PAGE: Final = 0
_LENGTH_BYTES: Final = 4
_CRC_FIELD: Final = 4
"""The field that stands after two numbers and the page's type."""
_LONGEST_HEADER: Final = 64

Bools = np.ndarray[Any, np.dtype[np.bool_]]


def flat_levels(valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Levels of (n,) values; None for a column without nulls, which has none."""
    if valid is None:
        return b""
    return _section(b"".join(_run(len(list(same)), int(there)) for there, same in groupby(valid.tolist())))


def list_levels(rows: int, size: int, valid: npt.NDArray[np.bool_] | None) -> bytes:
    """Levels of lists of `size` (1 or more) values, which are never null; `valid` is None for lists that never are."""
    own = _run(1, 0) + (_run(size - 1, 1) if size > 1 else b"")
    if valid is None or valid.all():
        repetition = own * rows if size > 1 else _run(rows, 0)
        return _section(repetition) + _section(_run(rows * size, 1 if valid is None else 2))
    repetition = b"".join(own if there else _run(1, 0) for there in valid.tolist())
    runs = ((there, len(list(same))) for there, same in groupby(valid.tolist()))
    return _section(repetition) + _section(b"".join(_run(n * size, 2) if there else _run(n, 0) for there, n in runs))


def page_header(size: int, crc: int, values: int, encoding: int) -> bytes:
    """Header of a page of `size` bytes and of `values` levels; the CRC-32 is over levels and values."""
    about = {1: values, 2: encoding, 3: RLE, 4: RLE}
    fields = {
        1: thrift.i32(_DATA_PAGE),
        2: thrift.i32(size),
        3: thrift.i32(size),
        _CRC_FIELD: thrift.i32(crc - (1 << 32) if crc >> 31 else crc),
        5: thrift.struct({k: thrift.i32(v) for k, v in about.items()}),
    }
    return thrift.struct(fields).content


def read_page_header(chunk: npt.NDArray[np.uint8], values: int, encoding: int) -> tuple[int, int] | None:
    """Bytes of the header, and CRC, of the one page of a column chunk; None if it is not as `page_header` writes it."""
    head = chunk[:_LONGEST_HEADER].tobytes()
    at, numbers = 0, []
    for _ in range(_CRC_FIELD):
        number, at = _numbered(head, at + 1)
        numbers.append(number)
    size, crc = numbers[1], numbers[3] % (1 << 32)
    length = chunk.size - size
    if size < 0 or not 0 < length <= len(head) or head[:length] != page_header(size, crc, values, encoding):
        return None
    return length, crc


def _numbered(data: bytes, at: int) -> tuple[int, int]:
    """A signed number, and where it ends; at damage, any."""
    value = 0
    for shift in range(0, 35, 7):
        byte = data[at] if at < len(data) else 0
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            break
    return (value >> 1) ^ -(value & 1), at


def _section(runs: bytes) -> bytes:
    return len(runs).to_bytes(_LENGTH_BYTES, "little") + runs


def _run(count: int, level: int) -> bytes:
    """A level `count` times, of a column whose levels fit in a byte."""
    return thrift.varint(count << 1) + bytes([level])
