"""The container MCAP, as ROS 2 and Foxglove write it.

Source: "MCAP Format Specification" (mcap.dev). A record is a byte that says its kind, eight bytes with its length, and
its content; all numbers are little-endian.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO, Final

from roadscan.formats.ros.storage import (
    BROKEN,
    Chunk,
    ChunkedContainer,
    Connection,
    MessageSpan,
    Raw,
    exactly,
    unpacked,
)
from roadscan.ingest.reading.format import Reject

MAGIC: Final = b"\x89MCAP0\r\n"

_HEADER: Final = 1  # kinds of records
_FOOTER: Final = 2  # ends the file
_SCHEMA: Final = 3  # a type of messages
_CHANNEL: Final = 4  # a topic
_MESSAGE: Final = 5  # outside chunks
_CHUNK: Final = 6  # packed records
_MESSAGE_INDEX: Final = 7  # of one topic in one chunk
_CHUNK_INDEX: Final = 8  # in the summary
_STATISTICS: Final = 11  # counts, in the summary
_DATA_END: Final = 15  # before the summary
_LAST_KIND: Final = 0x7F  # kinds from 0x80 on are private
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEAD: Final = struct.Struct("<QQQI")  # first and last time, bytes unpacked, CRC of these
_SEGMENT_BYTES: Final = 4 << 20  # messages outside chunks are read in runs of so many bytes


class McapFile(ChunkedContainer):
    """An MCAP file."""

    def open(self, stream: BinaryIO) -> None:
        """Take channels and chunks from the summary at the end, or from the records where it is missing."""
        self._schemas: dict[int, tuple[str, str, str]] = {}
        if stream.read(len(MAGIC)) != MAGIC:
            raise self.damaged("the file is no MCAP")
        if self.size == len(MAGIC):
            raise self.damaged("the MCAP file ends after its first 8 bytes: it holds no message")
        if self._summarised(stream):
            return
        self.connections.clear()
        self.chunks.clear()
        self._walked(stream)
        self.complete(stream)

    def within(self, stream: BinaryIO, chunk: Chunk) -> Iterator[Raw | Connection]:
        """Yield messages and channels of a chunk, or of a run of records outside chunks."""
        stream.seek(chunk.offset)
        content = memoryview(exactly(stream, chunk.length))  # parts of it are not copied
        if content[0] == _CHUNK:
            content = memoryview(_unpacked(content[_RECORD.size :]))
        at = 0
        while at < len(content):
            kind, length = _RECORD.unpack_from(content, at)
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if at > len(content):
                raise ValueError("a record reaches beyond it")
            if kind == _MESSAGE:
                channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content, start)
                yield Raw(channel, chunk.offset, log_ns, content[start + _MESSAGE_HEAD.size : at])
            elif kind == _CHANNEL:
                yield self._channel(bytes(content[start:at]))
            elif kind == _SCHEMA:
                self._schema(bytes(content[start:at]))

    def _summarised(self, stream: BinaryIO) -> bool:
        """Take what the summary says; False where there is none, or it does not list all messages."""
        footer = _RECORD.size + 20  # two offsets and a CRC
        if self.size < len(MAGIC) + footer + len(MAGIC):
            return False
        try:
            stream.seek(self.size - len(MAGIC) - footer)
            kind, _ = _RECORD.unpack(exactly(stream, _RECORD.size))
            start = struct.unpack("<QQI", exactly(stream, 20))[0]
            if kind != _FOOTER or not start or exactly(stream, len(MAGIC)) != MAGIC:
                return False
            chunked = stated = -1
            counts: dict[int, int] = {}
            indexes: dict[int, dict[int, int]] = {}
            stream.seek(start)
            for kind, content, _ in _records(stream, self.size):
                if kind == _SCHEMA:
                    self._schema(content)
                elif kind == _CHANNEL:
                    channel = self._channel(content)
                    self.connections[channel.id] = channel
                elif kind == _CHUNK_INDEX:
                    chunk, offsets = _chunk_index(content)
                    self.chunks.append(chunk)
                    indexes[chunk.offset] = offsets
                elif kind == _STATISTICS:
                    stated, _, _, _, _, chunked = struct.unpack_from("<QHIIII", content)
                    counts = dict(struct.iter_unpack("<HQ", content[46:]))
            if chunked != len(self.chunks) or sum(counts.values()) != stated or (stated and not self.chunks):
                return False
            if not self.connections.keys() >= counts.keys() or any(not chunk.spans for chunk in self.chunks):
                return False
            self._sharpen(stream, indexes, counts)
        except BROKEN:
            return False
        return True

    def _sharpen(self, stream: BinaryIO, indexes: dict[int, dict[int, int]], counts: dict[int, int]) -> None:
        """Give each channel its count, and the times of its first and last messages by the chunks' indexes."""
        self.chunks.sort(key=lambda chunk: chunk.offset)
        ends: dict[int, tuple[Chunk, Chunk]] = {}
        for chunk in self.chunks:
            for channel in chunk.spans:
                ends[channel] = ends.get(channel, (chunk, chunk))[0], chunk
        for channel, (first, last) in ends.items():
            for chunk in (first, last):
                stream.seek(indexes[chunk.offset][channel])
                exactly(stream, _RECORD.size + 2)
                times = _index_times(_sized(stream))
                chunk.spans[channel] = MessageSpan(0, min(times), max(times))
            first.spans[channel] = replace(first.spans[channel], count=counts.get(channel, 0))

    def _walked(self, stream: BinaryIO) -> None:
        """Find chunks and messages outside chunks by going from record to record."""
        at, loose = len(MAGIC), 0
        stream.seek(at)
        while at < self.size:
            head = stream.read(_RECORD.size)
            kind, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            end = at + _RECORD.size + length
            if not 0 < kind <= _LAST_KIND or end > self.size:
                what = "the file ends inside this record" if kind else "no record, nor the rest of the file"
                self.faults.append(Reject(what, -1, at))
                return
            if kind in {_FOOTER, _DATA_END}:
                return
            if kind == _CHUNK:
                self.chunks.append(Chunk(at, end - at))
            elif kind == _MESSAGE_INDEX and self.chunks:
                self._take_index(exactly(stream, length))
            elif kind in {_SCHEMA, _CHANNEL, _MESSAGE}:
                if loose != at or self.chunks[-1].length > _SEGMENT_BYTES:
                    self.chunks.append(Chunk(at, 0))
                self.chunks[-1].length += end - at
                loose = end
            stream.seek(end)
            at = end

    def _take_index(self, content: bytes) -> None:
        channel = struct.unpack_from("<H", content)[0]
        times = _index_times(content[6:])
        if times:
            self.chunks[-1].spans[channel] = MessageSpan(len(times), min(times), max(times))

    def _schema(self, content: bytes) -> None:
        number = struct.unpack_from("<H", content)[0]
        name, encoding, text = _strings(content[2:], 3)
        self._schemas[number] = name, encoding, text

    def _channel(self, content: bytes) -> Connection:
        number, schema = struct.unpack_from("<HH", content)
        topic, encoding = _strings(content[4:], 2)
        name, language, text = self._schemas.get(schema, ("", "", ""))
        return Connection(number, topic, name, encoding, text, "idl" if "idl" in language else "msg")


def _unpacked(content: memoryview) -> bytes | memoryview:
    _, _, size, crc = _CHUNK_HEAD.unpack_from(content)
    at = _CHUNK_HEAD.size
    length = struct.unpack_from("<I", content, at)[0]
    method = bytes(content[at + 4 : at + 4 + length]).decode()
    at += 4 + length
    packed = struct.unpack_from("<Q", content, at)[0]
    records = unpacked(content[at + 8 : at + 8 + packed], method, size)
    if crc and zlib.crc32(records) != crc:
        raise ValueError("its checksum does not fit its content")
    return records


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes, int]]:
    """Yield kind, content and offset of the records up to the footer."""
    while True:
        at = stream.tell()
        kind, length = _RECORD.unpack(exactly(stream, _RECORD.size))
        if kind == _FOOTER:
            return
        if length > size:
            raise ValueError("no record")
        yield kind, exactly(stream, length), at


def _chunk_index(content: bytes) -> tuple[Chunk, dict[int, int]]:
    """A chunk, and where the index of each of its channels stands."""
    first, last, offset, length, bytes_of_map = struct.unpack_from("<QQQQI", content)
    offsets = dict(struct.iter_unpack("<HQ", content[36 : 36 + bytes_of_map]))
    return Chunk(offset, length, {channel: MessageSpan(0, first, last) for channel in offsets}), offsets


def _sized(stream: BinaryIO) -> bytes:
    return exactly(stream, struct.unpack("<I", exactly(stream, 4))[0])


def _index_times(entries: bytes) -> list[int]:
    return [time for time, _ in struct.iter_unpack("<QQ", entries)]


def _strings(content: bytes, count: int) -> list[str]:
    found, at = [], 0
    for _ in range(count):
        end = at + 4 + struct.unpack_from("<I", content, at)[0]
        if end > len(content):
            raise ValueError("a text reaches beyond its record")
        found.append(content[at + 4 : end].decode(errors="replace"))
        at = end
    return found
