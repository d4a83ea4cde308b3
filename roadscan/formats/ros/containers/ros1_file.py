"""The container of ROS 1: a bag file of version 2.0.

Source: "Bag File Format 2.0" of the ROS wiki. A record is the length of its header, the header's fields
(`name=value`), the length of its data, and its data; all numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, Final

from roadscan.core.gpstime import NS_PER_S
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

MAGIC: Final = b"#ROSBAG V2.0\n"
OLDER: Final = b"#ROSBAG V"  # first bytes of bags of all versions

_MESSAGE: Final = 2  # kinds of records, by their field `op`
_INDEX: Final = 4  # of one connection in one chunk
_CHUNK: Final = 5  # packed records
_CHUNK_INFO: Final = 6  # at the file's end
_CONNECTION: Final = 7  # a topic
_MOST_HEADER_BYTES: Final = 1 << 20  # longer headers count as damage (bytes)
_INDEX_ENTRY: Final = struct.Struct("<III")  # seconds, nanoseconds, offset in the chunk
_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")

_Fields = dict[bytes, bytes]


class Ros1File(ChunkedContainer):
    """A bag of ROS 1."""

    def open(self, stream: BinaryIO) -> None:
        """Take connections and chunks from the index at the end, or from the records where it is missing."""
        if stream.read(len(MAGIC)) != MAGIC:
            raise self.damaged("the bag is not of version 2.0")
        try:
            fields = _header(stream)
            index, connections, chunks = struct.unpack(
                "<QII", fields[b"index_pos"] + fields[b"conn_count"] + fields[b"chunk_count"]
            )
            _skip_data(stream)
        except BROKEN as error:
            raise self.damaged(f"the bag's header is damaged: {error}") from error
        if fields.get(b"encryptor"):
            raise self.damaged("the bag is encrypted")
        first = stream.tell()
        if index and self._indexed(stream, index, connections, chunks):
            return
        self.connections.clear()
        self.chunks.clear()
        self._walked(stream, first)
        self.complete(stream)

    def within(self, stream: BinaryIO, chunk: Chunk) -> Iterator[Raw | Connection]:
        """Yield messages and connections of a chunk."""
        stream.seek(chunk.offset)
        fields = _header(stream)
        data = exactly(stream, _LENGTH.unpack(exactly(stream, 4))[0])
        content = memoryview(unpacked(data, fields[b"compression"].decode(), _LENGTH.unpack(fields[b"size"])[0]))
        at = 0
        while at < len(content):
            fields, at = _fields_at(content, at)
            end = at + 4 + _LENGTH.unpack_from(content, at)[0]
            if end > len(content):
                raise ValueError("a record reaches beyond it")
            kind = fields[b"op"][0]
            if kind == _MESSAGE:
                number, seconds, ns = struct.unpack("<III", fields[b"conn"] + fields[b"time"])
                yield Raw(number, chunk.offset, seconds * NS_PER_S + ns, content[at + 4 : end])
            elif kind == _CONNECTION:
                yield _connection(fields, bytes(content[at + 4 : end]))
            at = end

    def _indexed(self, stream: BinaryIO, index: int, connections: int, chunks: int) -> bool:
        """Take what the index at the end says; False where it is damaged or not all there."""
        try:
            stream.seek(index)
            for _ in range(connections):
                connection = _connection(_header(stream), _data(stream))
                self.connections[connection.id] = connection
            for _ in range(chunks):
                self.chunks.append(_chunk_info(_header(stream), _data(stream)))
            self._sharpen(stream)
        except BROKEN:
            return False
        return True

    def _sharpen(self, stream: BinaryIO) -> None:
        """Replace the spans of the first and last chunk of each connection, which are those of the whole chunk."""
        ends = {c: chunk for chunk in reversed(self.chunks) for c in chunk.spans}.values()
        later = {c: chunk for chunk in self.chunks for c in chunk.spans}.values()
        for chunk in {id(chunk): chunk for chunk in (*ends, *later)}.values():
            stream.seek(chunk.offset)
            if _header(stream)[b"op"][0] != _CHUNK:
                raise ValueError("the index points to no chunk")
            _skip_data(stream)
            chunk.spans |= self._index_of(stream, len(chunk.spans))

    def _index_of(self, stream: BinaryIO, most: int | None = None) -> dict[int, MessageSpan]:
        """What the index records at the stream's place say; the stream stands behind them."""
        spans: dict[int, MessageSpan] = {}
        at = stream.tell()
        while (most is None or len(spans) < most) and at < self.size:
            try:
                fields = _header(stream)
                if fields[b"op"][0] != _INDEX:
                    break
                times = [s * NS_PER_S + ns for s, ns, _ in _INDEX_ENTRY.iter_unpack(_data(stream))]
            except BROKEN:
                break
            if times:
                spans[_LENGTH.unpack(fields[b"conn"])[0]] = MessageSpan(len(times), min(times), max(times))
            at = stream.tell()
        stream.seek(at)
        return spans

    def _walked(self, stream: BinaryIO, at: int) -> None:
        """Find the chunks by going from record to record."""
        stream.seek(at)
        while at < self.size:
            try:
                fields = _header(stream)
                _skip_data(stream)
                kind = fields[b"op"][0]
            except BROKEN:
                kind = -1
            end = stream.tell()
            if kind not in {_MESSAGE, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION} or end > self.size:
                what = "the file ends inside this record" if end >= self.size else "no record, nor the rest of the file"
                self.faults.append(Reject(what, -1, at))
                return
            if kind == _CHUNK:
                self.chunks.append(Chunk(at, end - at, self._index_of(stream)))
            elif kind in {_CONNECTION, _CHUNK_INFO}:
                return  # the index at the end, which could not be used
            at = stream.tell()


def _header(stream: BinaryIO) -> _Fields:
    length = _LENGTH.unpack(exactly(stream, 4))[0]
    if length > _MOST_HEADER_BYTES:
        raise ValueError("no header of a record")
    return _fields(exactly(stream, length))


def _data(stream: BinaryIO) -> bytes:
    length = _LENGTH.unpack(exactly(stream, 4))[0]
    return exactly(stream, length)


def _skip_data(stream: BinaryIO) -> None:
    stream.seek(_LENGTH.unpack(exactly(stream, 4))[0], 1)


def _fields_at(content: memoryview, at: int) -> tuple[_Fields, int]:
    """The header at a place of a chunk, and where it ends."""
    end = at + 4 + _LENGTH.unpack_from(content, at)[0]
    if end > len(content):
        raise ValueError("a record reaches beyond it")
    return _fields(bytes(content[at + 4 : end])), end


def _fields(header: bytes) -> _Fields:
    found: _Fields = {}
    at = 0
    while at < len(header):
        end = at + 4 + _LENGTH.unpack_from(header, at)[0]
        name, equals, value = header[at + 4 : end].partition(b"=")
        if not equals or end > len(header):
            raise ValueError("no header of a record")
        found[name] = value
        at = end
    return found


def _connection(fields: _Fields, data: bytes) -> Connection:
    about = _fields(data)
    return Connection(
        _LENGTH.unpack(fields[b"conn"])[0],
        fields[b"topic"].decode(),
        about[b"type"].decode(),
        "ros1",
        about.get(b"message_definition", b"").decode(errors="replace"),
    )


def _chunk_info(fields: _Fields, data: bytes) -> Chunk:
    first, last = (
        s * NS_PER_S + ns for s, ns in (_TIME.unpack(fields[b"start_time"]), _TIME.unpack(fields[b"end_time"]))
    )
    spans = {number: MessageSpan(count, first, last) for number, count in struct.iter_unpack("<II", data)}
    return Chunk(struct.unpack("<Q", fields[b"chunk_pos"])[0], 0, spans)
