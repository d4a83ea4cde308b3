"""Files packed with gzip, bzip2, xz or Zstandard as streams of their content, which is bounded by their size."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Final, cast

import pyarrow as pa

from roadscan.core.errors import FormatError

_FREE_BYTES: Final = 64 << 20
"""So much content is unpacked whatever the file's size is (bytes): it takes less than a second."""
_MOST_RATIO: Final[Mapping[str, int]] = MappingProxyType({"gzip": 200, "bzip2": 1000, "xz": 4000, "Zstandard": 1000})
"""Bytes of content for a byte that was packed, at most. The most regular log that can be, 100 poses a second of a
vehicle that stands and hears no noise, packs 36, 162, 1,441 and 81 times; recordings pack 3 to 10 times. Zeros, or one
repeated line, pack 1,000 times with gzip, 7,000 with xz, a million with bzip2."""
_BUFFER_BYTES: Final = 1 << 20  # bytes that are unpacked at once

_OPENERS: Final[Mapping[str, Callable[[IO[bytes]], Any]]] = MappingProxyType(
    {
        "gzip": lambda raw: gzip.GzipFile(fileobj=raw, mode="rb"),
        "bzip2": bz2.BZ2File,
        "xz": lzma.LZMAFile,
        "Zstandard": lambda raw: pa.CompressedInputStream(pa.PythonFile(raw, mode="r"), "zstd"),
    }
)
"""What unpacks each compression."""


class Unpacked(io.RawIOBase):
    """The content of a packed file, from its beginning to its end; what decompression raises is passed on.

    Raises
    ------
    FormatError
        in reading, where there is more content than a log of this size can have.
    """

    def __init__(self, path: Path, packing: str) -> None:
        self._path = path
        self._most_ratio = _MOST_RATIO[packing]
        self._raw = path.open("rb")
        self._stream = _OPENERS[packing](self._raw)
        self._read = getattr(self._stream, "read1", self._stream.read)  # also gives the bytes before a damage
        self._count = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Unpack the next bytes; 0 at the end."""
        view = memoryview(buffer).cast("B")
        part = self._read(len(view))
        view[: len(part)] = part
        self._count += len(part)
        packed = self._raw.tell()
        if self._count > max(_FREE_BYTES, self._most_ratio * packed):
            raise FormatError(
                f"the first {packed:,} bytes of the packed file hold {self._count:,} bytes and more",
                expected=f"a log: at most {self._most_ratio} bytes of it for a byte of the packed file",
                change="unpack it and look at what it holds; list the unpacked file if it is a log",
                file=self._path,
            )
        return len(part)

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            super().close()
            self._stream.close()
            self._raw.close()


def open_unpacked(path: Path, packing: str) -> IO[bytes]:
    """Return a buffered stream of :class:`Unpacked`; packing : gzip, bzip2, xz or Zstandard."""
    return cast(IO[bytes], io.BufferedReader(Unpacked(path, packing), _BUFFER_BYTES))


def is_unpacked(stream: Any) -> bool:
    """Return whether a stream is one of :func:`open_unpacked`."""
    return isinstance(getattr(stream, "raw", None), Unpacked)
