"""Text files: compressed ones opened, and headers that stand between rows found.

Detects headers in the middle of a text file, as in files that were appended to one another.

What follows it is read by the first header only where it says the same; other columns, units, time systems or kinds of
height would be taken for those of the first.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Final, Protocol, cast

import pyarrow as pa

from roadscan.core.errors import FormatError
from roadscan.core.witness import Witness

SECOND_HEADER: Final = Witness(
    "second_header",
    input="any log of text lines",
    fault="Files were appended to one another, and the second one's header says other columns, units, time system or "
    "kind of height.",
    asks="every header line of the file, against the first",
    does="rows behind a header that says the same are read; those behind another are left out",
    told=("rejects",),
)

AGAIN: Final = "the line of column names stands again (files that were appended to one another)"
OTHER: Final = "a second line of column names stands before it, which differs from the first"

_WORD_STARTS: Final = "_%$\"'\ufeff"


class Headers(Protocol):
    """Recognises the headers of a format."""

    @property
    def other(self) -> str:
        """Return the reason to leave out a row that follows a header which differs from the first."""

    def comment(self, line: str) -> bool | None:
        """Return whether rows after this comment have the first header's layout; None if it says nothing about it."""

    def row(self, fields: Sequence[str]) -> bool | None:
        """Return the same for a line that is no comment."""


@dataclass(frozen=True)
class NameLines:
    """Lines of column names, like the one at a file's start."""

    names: tuple[str, ...]
    numbers: tuple[int, ...]
    """Columns of numbers."""
    first: tuple[str, ...] = ()
    """Fields of the file's first header, where `names` are stated instead."""
    other: str = OTHER

    def comment(self, line: str) -> bool | None:
        """Return False for a comment with the same names in another order: it is the header of another file."""
        words = [_plain(word) for word in line.lstrip("#%/; ").replace(",", " ").split()]
        if len(words) < 2 or sorted(words) != sorted(map(_plain, self.names)):
            return None
        return words == [_plain(name) for name in self.names]

    def row(self, fields: Sequence[str]) -> bool | None:
        """Check a line of words in columns of numbers; a last line without a line end may precede the words."""
        words = [_plain(field) for field in fields]
        for own in (self.names, self.first):
            plain = [_plain(name) for name in own]
            if plain and (words == plain or _is_behind_a_row(words, plain)):
                return True
        if sorted(words) == sorted(_plain(name) for name in self.names):
            return False
        extra = len(words) - len(self.names)
        held = [words[k] for k in self.numbers if k < len(words)] if extra <= 0 else words[-len(self.names) + 1 :]
        return False if len(held) > 1 and all(map(_is_word, held)) else None


def _is_behind_a_row(words: Sequence[str], names: Sequence[str]) -> bool:
    """Return True where a row without a line end precedes the names."""
    many = len(names)
    return (
        many > 1
        and len(words) == 2 * many - 1
        and list(words[many:]) == list(names[1:])
        and words[many - 1].endswith(names[0])
    )


def _plain(word: str) -> str:
    return word.strip().strip("\ufeff\"'").lower()


def _is_word(word: str) -> bool:
    """Return True for a name; numbers, empty fields and words for missing values are none."""
    return (
        len(word) > 1
        and (word[0].isalpha() or word[0] in _WORD_STARTS)
        and word not in ("nan", "inf", "infinity", "none", "null", "na", "n/a")
        and all(c.isprintable() for c in word)
    )


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
