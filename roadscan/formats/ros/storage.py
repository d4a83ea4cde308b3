"""What the containers of a bag have in common: connections, messages, chunks and how these are unpacked.

A connection is a stream of messages of one topic, one type and one definition. A chunk is a run of records that is
compressed as a whole; the records after it say how many messages of each connection it holds.
"""

from __future__ import annotations

import bz2
import shutil
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeAlias

from roadscan.core.errors import FormatError
from roadscan.core.extras import needed
from roadscan.ingest.reading.format import Reject

MOST_CHUNK_BYTES: Final = 1 << 30  # larger chunks count as damage (bytes); recorders write 768 KiB to some MB
BROKEN: Final = (struct.error, ValueError, IndexError, KeyError, EOFError, OverflowError, MemoryError)
"""What reading damaged bytes raises."""


@dataclass
class Connection:
    """A stream of messages of one topic and one type."""

    id: int
    topic: str
    type: str
    """Name of the type as recorded, such as `sensor_msgs/Imu` or `sensor_msgs/msg/Imu`."""
    encoding: str
    """How messages are serialised: `ros1`, `cdr` (ROS 2), or another word of the container."""
    definition: str = ""
    """Text of the type's definition; '' where the bag holds none."""
    definition_language: str = "msg"
    """Language of the definition: msg or idl."""
    span: MessageSpan | None = None
    """What the file holds of it; None where it holds no message."""


@dataclass(frozen=True)
class MessageSpan:
    """Number of messages, and their first and last receive stamp (POSIX ns)."""

    count: int
    first_ns: int
    last_ns: int

    def joined(self, other: MessageSpan | None) -> MessageSpan:
        """Figures of two parts of one connection together."""
        if other is None:
            return self
        return MessageSpan(
            self.count + other.count, min(self.first_ns, other.first_ns), max(self.last_ns, other.last_ns)
        )


class Raw(NamedTuple):
    """A serialised message."""

    connection: int
    offset: int
    """Byte of the file at which the message, or its chunk, starts; −1 where the file has no such place."""
    receive_ns: int
    """Time at which the recording computer received it (POSIX ns by its clock)."""
    data: bytes | memoryview


RawItem: TypeAlias = Raw | Reject


class Container(ABC):
    """One file of a bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: dict[int, Connection] = {}
        self.faults: list[Reject] = []
        """What is damaged of the container itself."""

    @abstractmethod
    def messages(self, wanted: Set[int]) -> Iterator[RawItem]:
        """Yield the messages of some connections in the order of the file, and a reject for what is damaged."""

    def damaged(self, what: str) -> FormatError:
        """The error of a file of which nothing can be read."""
        return FormatError(
            what, change="record it again, or look into it with the recorder's own tools", file=self.path
        )


@dataclass
class Chunk:
    """Records that stand together in a file."""

    offset: int
    """Byte at which the chunk's record starts."""
    length: int
    """Bytes up to the end of the chunk's record."""
    spans: dict[int, MessageSpan] = field(default_factory=dict)
    """What it holds of each connection; empty where that is not known."""


class ChunkedContainer(Container):
    """A file of chunks, known from its index or, where it has none, found by going from record to record."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.chunks: list[Chunk] = []
        self.size = path.stat().st_size
        with path.open("rb") as stream:
            self.open(stream)
        for chunk in self.chunks:
            for number, span in chunk.spans.items():
                connection = self.connections.get(number)
                if connection is not None:
                    connection.span = span.joined(connection.span)

    @abstractmethod
    def open(self, stream: BinaryIO) -> None:
        """Find connections and chunks."""

    @abstractmethod
    def within(self, stream: BinaryIO, chunk: Chunk) -> Iterator[Raw | Connection]:
        """Yield messages and connections of a chunk in their order; raises one of `BROKEN` where it is damaged."""

    def messages(self, wanted: Set[int]) -> Iterator[RawItem]:
        """Yield the messages of some connections, chunk by chunk; a damaged chunk costs its messages."""
        with self.path.open("rb") as stream:
            for chunk in self.chunks:
                if chunk.spans and not wanted & chunk.spans.keys():
                    continue
                found = 0
                try:
                    for item in self.within(stream, chunk):
                        if isinstance(item, Raw) and item.connection in wanted:
                            found += 1
                            yield item
                except BROKEN as error:
                    stated = sum(span.count for number, span in chunk.spans.items() if number in wanted)
                    lost = max(1, stated - found)
                    yield Reject(f"the chunk is damaged: {error}", -1, chunk.offset, lost)
        yield from self.faults

    def count(self, stream: BinaryIO, chunk: Chunk) -> bool:
        """Find what a chunk holds by reading it; False where it is damaged before its first message."""
        try:
            for item in self.within(stream, chunk):
                if isinstance(item, Connection):
                    self.connections.setdefault(item.id, item)
                else:
                    span = MessageSpan(1, item.receive_ns, item.receive_ns)
                    chunk.spans[item.connection] = span.joined(chunk.spans.get(item.connection))
        except BROKEN:
            return bool(chunk.spans)
        return True

    def complete(self, stream: BinaryIO) -> None:
        """Read the chunks whose content is not stated, or that hold connections not yet known."""
        for chunk in self.chunks:
            if not chunk.spans or not chunk.spans.keys() <= self.connections.keys():
                stated = dict(chunk.spans)
                chunk.spans.clear()
                self.count(stream, chunk)
                chunk.spans = stated or chunk.spans


def exactly(stream: BinaryIO, count: int) -> bytes:
    """Read so many bytes; EOFError where there are fewer."""
    data = stream.read(count)
    if len(data) != count:
        raise EOFError("the file ends here")
    return data


WHAT: Final = "a compressed bag"  # as the error of a missing package names it
ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a Zstandard frame (RFC 8878, 3.1.1)


def unpacked(data: bytes | memoryview, method: str, size: int | None = None) -> bytes | memoryview:
    """Unpacked bytes; `size` where the bag states their number.

    Raises
    ------
    ValueError
        where the bytes are damaged, or more than stated.
    """
    most = MOST_CHUNK_BYTES if size is None else size
    if most > MOST_CHUNK_BYTES:
        raise ValueError(f"it states {most:,} bytes unpacked")
    if method in {"", "none"}:
        content: bytes | memoryview = data
    elif method == "bz2":
        content = _bz2(data, most)
    elif method == "lz4":
        content = _lz4(data, most)
    elif method == "zstd":
        content = _zstd(data, most)
    else:
        raise ValueError(f"its compression '{method}' is not known")
    if size is not None and len(content) != size:
        raise ValueError(f"{len(content):,} bytes unpacked, {size:,} stated")
    return content


def unpack_file(packed: Path, to: Path) -> str:
    """Unpack a Zstandard file; return why it ended early ("" if it did not)."""
    zstandard = needed("zstandard", WHAT)
    with packed.open("rb") as source, to.open("wb") as sink:
        try:
            with zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True) as reader:
                shutil.copyfileobj(reader, sink, 1 << 20)
        except zstandard.ZstdError as error:
            return f"the compressed file is damaged: {error}"
    return ""


def _bz2(data: bytes | memoryview, most: int) -> bytes:
    try:
        return bz2.BZ2Decompressor().decompress(data, most + 1)
    except OSError as error:
        raise ValueError(str(error)) from error


def _lz4(data: bytes | memoryview, most: int) -> bytes:
    frame = needed("lz4.frame", WHAT)
    try:
        return bytes(frame.LZ4FrameDecompressor().decompress(data, most + 1))
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def _zstd(data: bytes | memoryview, most: int) -> bytes:
    zstandard = needed("zstandard", WHAT)
    try:
        if zstandard.frame_content_size(data) > most:
            raise ValueError("more bytes unpacked than stated")
        return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=most))
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
