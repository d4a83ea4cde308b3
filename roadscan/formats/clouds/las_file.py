"""Reads LAS and LAZ files in bounded memory, even where their headers claim too much.

laspy trusts what a header claims; so the header block and the variable-length records are first checked
against the file's size (ASPRS LAS 1.4 R15).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, Self, TypeAlias

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.errors import FormatError, brief
from roadscan.ingest.reading.format import Reject
from roadscan.store.codecs.laz import Laz, LazChunks, LazError

if TYPE_CHECKING:
    import laspy


_CHUNK_POINTS: Final = 120_000  # points of a batch
_OLDEST_HEADER_BYTES: Final = 227  # bytes of a header block of LAS 1.0 to 1.2
_HEADER_1_4_BYTES: Final = 375  # bytes of a header block of LAS 1.4
_RECORD_HEAD: Final = 54  # bytes of a variable-length record's header
_LONG_RECORD_HEAD: Final = 60  # bytes of an extended record's header
_LONGEST_WKT: Final = 1 << 20  # bytes of WKT that are read
_WKT_RECORD: Final = 2112  # record id of OGC WKT (LAS 1.4)
_NO_POINT_BYTES: Final = 64
"""Most bytes that may follow the headers of an empty file: a table of no chunks."""
_MOST_POINTS: Final = 1 << 62
"""Limit of counts, which are stored as signed 64-bit numbers."""
_TIME_OFFSET_BIT: Final = 0x40  # bit of the global encoding in LAS 1.5
_FORMATS_WITH_TIME: Final = frozenset({1, 3, 4, 5, 6, 7, 8, 9, 10})  # point formats with gps_time

Points: TypeAlias = "tuple[int, laspy.ScaleAwarePointRecord]"
"""Number of the first point, and points."""


def unreadable(*more: type[Exception]) -> tuple[type[Exception], ...]:
    """Return the errors of laspy and the decompressor on damaged bytes, and `more`."""
    import laspy

    return (
        *more, laspy.LaspyException, LazError, OSError, ValueError, KeyError, IndexError, TypeError, AttributeError,
        OverflowError, MemoryError, AssertionError, struct.error,
    )  # fmt: skip


@dataclass(frozen=True)
class Head:
    """Claims of the public header block, checked against the file's size before use."""

    version: tuple[int, int]
    encoding: int
    point_format: int
    compressed: bool
    offset: int
    record_bytes: int
    claimed: int
    """Number of points that the header claims."""
    room: int
    """Number of points that fit into a LAS file."""
    point_bytes: int
    """Bytes from the first point to the end of the points, compressed or not."""
    laszip: bytes
    """Content of the LASzip record, empty for LAS."""
    wkt: str | None
    """WKT of an extended record, if any."""

    @property
    def record_bytes_in_file(self) -> int:
        """Return the bytes from one point to the next, 0 where compressed."""
        return 0 if self.compressed else self.record_bytes

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read and check the header block and the lengths of all variable-length records."""
        size = path.stat().st_size
        with path.open("rb") as stream:
            block = stream.read(_HEADER_1_4_BYTES)
            if block[:4] == b"LASF" and len(block) < _OLDEST_HEADER_BYTES:
                raise FormatError(
                    f"the file is cut off: it ends inside its header, after {len(block)} bytes",
                    expected=f"a LAS header block of at least {_OLDEST_HEADER_BYTES} bytes",
                    change="fetch it again from where it was recorded",
                    file=path,
                )
            if block[:4] != b"LASF":
                raise FormatError("the file is not LAS", expected="a LAS header block", file=path)
            encoding, major, minor = struct.unpack_from("<H16xBB", block, 6)
            head_bytes, offset, records, code, record_bytes, claimed = struct.unpack_from("<HIIBHI", block, 94)
            if (major, minor) not in {(1, n) for n in range(6)}:
                raise FormatError(f"the file is LAS {major}.{minor}", expected="LAS 1.0 to 1.4", file=path)
            evlr_at, evlrs = 0, 0
            if minor >= 4:
                if len(block) < _HEADER_1_4_BYTES or head_bytes < _HEADER_1_4_BYTES:
                    raise FormatError("the header block is cut off", expected="375 bytes or more", file=path)
                evlr_at, evlrs, claimed = struct.unpack_from("<QIQ", block, 235)
            if not _OLDEST_HEADER_BYTES <= head_bytes <= offset <= size:
                raise FormatError(
                    f"the header puts the points at byte {offset:,} of {size:,}",
                    expected="the points after the header and inside the file",
                    change="the file is damaged or cut off: fetch it again",
                    file=path,
                )
            scales = struct.unpack_from("<6d", block, 131)
            if not np.isfinite(scales).all() or 0.0 in scales[:3]:
                raise FormatError("scale or offset of the coordinates is no number", expected="numbers", file=path)
            compressed = code >= 128
            point_format = code & 0x3F
            wkt, laszip = _walk_records(stream, head_bytes, offset, records, evlr_at, evlrs, size, path)
            waves_at = int.from_bytes(block[227:235], "little") if minor >= 3 else 0
            ends = [at for at, present in ((evlr_at, evlrs), (waves_at, True)) if present and offset < at <= size]
            end = min(ends, default=size)
            room = (end - offset) // max(1, record_bytes)
        version = (major, minor)
        claimed = min(claimed, _MOST_POINTS)
        return cls(
            version, encoding, point_format, compressed, offset, record_bytes, claimed, room, end - offset, laszip, wkt
        )  # fmt: skip


def _walk_records(
    stream: BinaryIO, head_bytes: int, offset: int, records: int, evlr_at: int, evlrs: int, size: int, path: Path
) -> tuple[str | None, bytes]:
    """Check that all variable-length records lie in the file; return an extended one's WKT, and the LASzip record."""
    laszip = b""
    at = head_bytes
    for _ in range(records):
        stream.seek(at)
        head = stream.read(_RECORD_HEAD)
        length = int.from_bytes(head[20:22], "little")
        if len(head) < _RECORD_HEAD or at + _RECORD_HEAD + length > offset:
            raise FormatError(
                f"the header claims {records:,} variable-length records, more than there is room for",
                expected="all of them before the points",
                change="the file is damaged: fetch it again",
                file=path,
            )
        if head[2:18].rstrip(b"\0") == b"laszip encoded":
            laszip = stream.read(length)
        at += _RECORD_HEAD + length
    wkt = None
    at = evlr_at
    for _ in range(evlrs):
        if not offset <= at <= size - _LONG_RECORD_HEAD:
            break  # a damaged extended record costs no point
        stream.seek(at)
        head = stream.read(_LONG_RECORD_HEAD)
        length = int.from_bytes(head[20:28], "little")
        if head[2:18].rstrip(b"\0") == b"LASF_Projection" and head[18:20] == _WKT_RECORD.to_bytes(2, "little"):
            wkt = stream.read(min(length, _LONGEST_WKT)).split(b"\0")[0].decode("utf-8", errors="replace")
        at += _LONG_RECORD_HEAD + length
    return wkt, laszip


@dataclass(frozen=True)
class Cloud:
    """An open LAS or LAZ file."""

    path: Path
    head: Head
    reader: laspy.LasReader
    """Header and uncompressed points."""
    laz: Laz | None
    """Compressed points."""
    chunks: LazChunks | None
    """Chunks of a LAZ file."""
    count: int
    """Number of points that the header claims and the file can contain."""

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Cloud]:
        """Open a file whose header does not claim more than the file can contain."""
        head = Head.read(path)
        if head.point_format not in _FORMATS_WITH_TIME:
            raise FormatError(
                f"point format {head.point_format} has no gps_time",
                expected="point format 1, 3–10: without a time a point belongs to no run and no pass",
                change="export the cloud with GPS time",
                file=path,
            )
        if head.version >= (1, 5) and head.encoding & _TIME_OFFSET_BIT:
            raise FormatError("gps_time has a LAS 1.5 time offset", expected="LAS 1.4 or older times", file=path)
        with path.open("rb") as stream, ExitStack() as stack:
            reader = _reader(stream, head, path)
            if head.compressed and head.claimed:
                laz = stack.enter_context(Laz(path, head.offset, head.laszip))
                chunks = _chunks(laz, stream, head, path)
                count = min(head.claimed, int(chunks.ends[-1]))
                yield cls(path, head, reader, laz, chunks, count)
            else:
                yield cls(path, head, reader, None, None, min(head.claimed, head.room))

    @property
    def wkt(self) -> str:
        """Return the WKT of the points' CRS; "" where the file has none."""
        from laspy.vlrs.known import WktCoordinateSystemVlr

        if self.head.wkt:
            return self.head.wkt
        texts = (getattr(r, "string", "") for r in self.reader.header.vlrs if isinstance(r, WktCoordinateSystemVlr))
        return next((text.split("\0")[0] for text in texts if text), "")

    @property
    def names(self) -> frozenset[str]:
        """Return the names of the point format's fields."""
        return frozenset(self.reader.header.point_format.dimension_names)

    def offsets(self, records: Int64) -> Int64:
        """Return byte offsets (n,) of points by number (n,), −1 where compressed."""
        if self.head.compressed:
            return np.full(records.size, -1)
        return self.head.offset + records * self.head.record_bytes

    def batches(self) -> Iterator[Points | Reject]:
        """Yield points in file order; unreadable ones as rejects."""
        at = 0
        while at < self.count:
            end, end_of_loss, sound = self._batch(at)
            points, fault = self._read(at, end - at) if sound else (None, "sizes inside the chunk do not fit")
            if points is None:
                offset = int(self.offsets(np.array([at]))[0])
                yield Reject(f"points cannot be read: {fault}", at, offset, end_of_loss - at)
                at = end_of_loss
            else:
                yield at, points
                at = end
        if self.head.claimed > self.count:
            missing = self.head.claimed - self.count
            yield Reject("the header claims points that the file does not hold", self.count, -1, missing)
        elif (held := self._held()) > self.count:
            offset = int(self.offsets(np.array([self.count]))[0])
            yield Reject("the file holds points that the header does not claim", self.count, offset, held - self.count)

    def _held(self) -> int:
        """Return the number of points by the file's size or its chunks; at least the claimed number."""
        if not self.head.claimed and self.head.point_bytes > _NO_POINT_BYTES:
            return max(1, 0 if self.head.compressed else self.head.room)
        if not self.head.compressed:
            return self.head.room
        return self.count if self.chunks is None else self.chunks.least

    def _batch(self, at: int) -> tuple[int, int, bool]:
        """Return the end of the batch from point `at`, the end of the loss if it is damaged, and whether to try it."""
        end = min(at + _CHUNK_POINTS, self.count)
        if self.chunks is None:
            return end, self.count, True
        chunk = int(np.searchsorted(self.chunks.ends, at, side="right"))
        end_of_chunk = min(self.count, int(self.chunks.ends[chunk]))
        return min(end, end_of_chunk), end_of_chunk, bool(self.chunks.sound[chunk])

    def _read(self, first: int, count: int) -> tuple[laspy.ScaleAwarePointRecord | None, str]:
        import laspy

        header = self.reader.header
        try:
            if self.laz is None:
                self.reader.seek(first)
                points = self.reader.read_points(count)
            else:
                data = bytearray(self.laz.points(first, count))
                packed = laspy.PackedPointRecord.from_buffer(data, header.point_format)
                points = laspy.ScaleAwarePointRecord(packed.array, header.point_format, header.scales, header.offsets)
        except unreadable() as error:
            return None, brief(error)
        return (points, "") if len(points) == count else (None, "they are cut off")


def _reader(stream: BinaryIO, head: Head, path: Path) -> laspy.LasReader:
    import laspy

    try:
        reader = laspy.LasReader(stream, closefd=False, read_evlrs=False)
        if head.record_bytes != reader.header.point_format.size:
            raise ValueError("point length and extra bytes disagree")
    except unreadable() as error:
        raise FormatError(f"the header cannot be read: {brief(error)}", file=path) from error
    return reader


def _chunks(laz: Laz, stream: BinaryIO, head: Head, path: Path) -> LazChunks:
    try:
        return LazChunks.of(laz, stream, head.offset, head.record_bytes, head.laszip)
    except LazError as error:
        raise FormatError(
            str(error),
            expected="a complete LAZ file",
            change="fetch the file again, or recover it with the program that wrote it",
            file=path,
        ) from error
