"""Decompresses points of LAZ files in a separate process, which damaged bytes may crash without harm.

A decompressor allocates what the file claims; so the chunk table and the sizes inside the chunks are first checked
against the file's size (LASzip 2.2).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.store.codecs.child import Child, ChildError

_REQUEST: Final = struct.Struct("<qq")
_LONGEST_S: Final = 120.0  # longest time for one request (s)
_LASZIP_HEAD: Final = 34  # bytes of the LASzip record before its items
_MOST_CHUNK_POINTS: Final = 1 << 32  # larger chunks count as damage (points)
_LAYERS: Final = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of a chunk by type of LASzip item: point, RGB, RGB and near infrared, wave packet of formats 6–10."""
_EXTRA_BYTES_ITEM: Final = 14  # type of the LASzip item of extra bytes, which has one layer per byte


LazError = ChildError
"""Points or chunk table cannot be decompressed."""


class Laz(Child):
    """An open LAZ file; a context manager.

    Parameters
    ----------
    offset : byte at which the points start.
    laszip : content of the LASzip record.
    """

    def __init__(self, path: Path, offset: int, laszip: bytes) -> None:
        super().__init__("laz_worker", str(path), str(offset), laszip.hex())

    def table(self) -> Int64:
        """Return (n, 2) int64: points and bytes of each chunk; LazError if the table is damaged."""
        return np.frombuffer(self.points(0, 0), dtype="<i8").reshape(-1, 2)

    def points(self, first: int, count: int) -> bytes:
        """Return the records of `count` > 0 points from `first` on, as in a LAS file.

        Raises
        ------
        LazError
            if they are damaged; other points can be asked for.
        """
        return self.ask(_REQUEST.pack(first, count), _LONGEST_S)


@dataclass(frozen=True)
class LazChunks:
    """Chunks of a LAZ file: damage in one affects no other."""

    ends: Int64
    """(n,) number of the first point after each chunk."""
    sound: npt.NDArray[np.bool_]
    """(n,) whether the sizes inside a chunk fit into it; other chunks are not decompressed."""
    least: int
    """Least number of points in the chunks: for point formats 0 to 5, the table counts too many in the last one."""

    @classmethod
    def of(cls, laz: Laz, stream: BinaryIO, offset: int, record_bytes: int, laszip: bytes) -> Self:
        """Read and check the chunk table.

        Parameters
        ----------
        stream : the LAZ file; `offset`, `laszip` as in :class:`Laz`.
        record_bytes : bytes of an uncompressed point.

        Raises
        ------
        LazError
            if there is no sound table.
        """
        items = [struct.unpack_from("<HH", laszip, at) for at in range(_LASZIP_HEAD, len(laszip) - 5, 6)]
        if not items or sum(length for _, length in items) != record_bytes:
            raise LazError("the LASzip record does not fit the points")
        size = stream.seek(0, 2)
        table_at, claimed = _table_claim(stream, offset, size)
        # Each chunk has at least its first point; a table that claims more would be allocated before it is read.
        if not 0 < claimed <= (table_at - offset) // max(1, record_bytes):
            raise LazError("the table of LAZ chunks is missing or damaged")
        points, lengths = laz.table().T
        if not points.size or not ((points >= 0) & (points <= _MOST_CHUNK_POINTS) & (lengths >= 0)).all():
            raise LazError("the table of LAZ chunks is damaged")
        layers = sum(_LAYERS.get(kind, length if kind == _EXTRA_BYTES_ITEM else 0) for kind, length in items)
        starts = offset + 8 + np.concatenate([[0], np.cumsum(np.minimum(lengths, size))])
        sound = [
            end <= table_at and _layers_fit(stream, start + record_bytes, end, layers)
            for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)
        ]
        if layers and sound[-1]:  # such a chunk states its number of points; the table states the most it may have
            points = np.append(points[:-1], min(_points_of_chunk(stream, int(starts[-2]) + record_bytes), points[-1]))
        ends = np.cumsum(points)
        return cls(ends, np.array(sound), int(ends[-1] if layers else ends[-1] - points[-1] + 1))


def _table_claim(stream: BinaryIO, offset: int, size: int) -> tuple[int, int]:
    """Return the place of the chunk table and its claimed number of chunks, 0 where there is none."""
    stream.seek(offset)
    table_at = int.from_bytes(stream.read(8), "little", signed=True)
    if table_at == -1:
        stream.seek(max(0, size - 8))
        table_at = int.from_bytes(stream.read(8), "little", signed=True)
    if not offset < table_at < size:
        return table_at, 0
    stream.seek(table_at)
    return table_at, int.from_bytes(stream.read(8)[4:8], "little")


def _points_of_chunk(stream: BinaryIO, at: int) -> int:
    """Return the points of a chunk with layers, as it states them; 1 where it does not."""
    stream.seek(at)
    return max(1, int.from_bytes(stream.read(4), "little"))


def _layers_fit(stream: BinaryIO, at: int, end: int, layers: int) -> bool:
    """Return True if a chunk's layers (point formats 6 and up) fit into it: at `at` stand their count and sizes."""
    if not layers:
        return True
    stream.seek(at + 4)
    sizes = stream.read(4 * layers)
    if len(sizes) < 4 * layers:
        return False
    held = sum(struct.unpack(f"<{layers}I", sizes))
    return bool(at + 4 + 4 * layers + held <= end)
