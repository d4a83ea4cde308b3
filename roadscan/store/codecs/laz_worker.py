"""Decompresses LAZ points for `roadscan.store.codecs.laz`: damaged bytes make lazrs (0.8) read outside its tables.

A request is two little-endian int64, first point and number of points (0: the chunk table).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, BinaryIO

import lazrs

REQUEST = struct.Struct("<qq")


class Decompressor:
    """Decompresses points and chunk table of one LAZ file."""

    def __init__(self, stream: BinaryIO, offset: int, laszip: bytes) -> None:
        self._stream = stream
        self._offset = offset
        self._laszip = laszip
        self._decompressor: Any = None
        self._at = 0

    def answer(self, request: bytes) -> bytes:
        """Return the reply to a request."""
        first, count = REQUEST.unpack(request)
        return self.points(first, count) if count else self.table()

    def table(self) -> bytes:
        """Return (n, 2) int64: points and bytes of each chunk."""
        self._stream.seek(self._offset)
        table = lazrs.read_chunk_table(self._stream, lazrs.LazVlr(self._laszip))
        return b"".join(struct.pack("<qq", min(points, 2**62), min(size, 2**62)) for points, size in table)

    def points(self, first: int, count: int) -> bytes:
        """Return records of points as in a LAS file."""
        if self._decompressor is None:
            self._stream.seek(self._offset)
            self._decompressor = lazrs.LasZipDecompressor(self._stream, self._laszip)
            self._at = 0
        if first != self._at:
            self._decompressor.seek(first)
        out = bytearray(count * lazrs.LazVlr(self._laszip).item_size())
        try:
            self._decompressor.decompress_many(out)
        except BaseException:
            self._decompressor = None  # its state is that of the damaged chunk
            raise
        self._at = first + count
        return bytes(out)


def opened(file: str, offset: str, laszip: str) -> Callable[[bytes], bytes]:
    """Return the answers of a LAZ file, given the byte at which its points start and the LASzip record (hex)."""
    return Decompressor(open(file, "rb"), int(offset), bytes.fromhex(laszip)).answer  # noqa: PTH123
