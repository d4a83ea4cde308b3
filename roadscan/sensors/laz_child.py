"""Decompresses LAZ points in a process of its own, started by :mod:`roadscan.sensors.laz`.

Damaged bytes can make lazrs (0.8) read outside its tables and crash its process. Here that costs the chunk,
not the run. The file is run as a script and imports nothing of roadscan.

Called with the LAZ file, the byte at which its points start, and the LASzip record in hexadecimal. A
request on standard input is two little-endian int64, first point and number of points (0: the chunk
table); the reply is an int64, the number of bytes that follow, or minus that for the text of an error.
"""

from __future__ import annotations

import struct
import sys
from typing import Any, BinaryIO

import lazrs

REQUEST = struct.Struct("<qq")
REPLY = struct.Struct("<q")


class Decompressor:
    """Points and chunk table of one LAZ file."""

    def __init__(self, stream: BinaryIO, offset: int, laszip: bytes) -> None:
        self._stream = stream
        self._offset = offset
        self._laszip = laszip
        self._decompressor: Any = None
        self._at = 0

    def table(self) -> bytes:
        """(n, 2) int64: points and bytes of each chunk."""
        self._stream.seek(self._offset)
        table = lazrs.read_chunk_table(self._stream, lazrs.LazVlr(self._laszip))
        return b"".join(struct.pack("<qq", min(points, 2**62), min(size, 2**62)) for points, size in table)

    def points(self, first: int, count: int) -> bytes:
        """Records of points as they would stand in a LAS file."""
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


def main(file: str, offset: str, laszip: str) -> None:
    """Answer requests until standard input ends."""
    with open(file, "rb") as stream:  # noqa: PTH123 — nothing but lazrs is imported, to start fast
        decompressor = Decompressor(stream, int(offset), bytes.fromhex(laszip))
        while len(request := sys.stdin.buffer.read(REQUEST.size)) == REQUEST.size:
            first, count = REQUEST.unpack(request)
            try:
                payload = decompressor.points(first, count) if count else decompressor.table()
                sign = 1
            except BaseException as error:  # noqa: BLE001 — a panic of lazrs is no Exception
                payload, sign = (str(error) or type(error).__name__).encode(), -1
            sys.stdout.buffer.write(REPLY.pack(sign * len(payload)) + payload)
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
