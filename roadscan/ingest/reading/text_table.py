"""Reads tables in text files (CSV and similar) in blocks; a damaged line costs only that line.

A record is one line. Blocks are parsed by Arrow; only a block in which Arrow stumbles is parsed
line by line, which finds the lines at fault. Files compressed with gzip, bzip2 or xz are read as
they are; offsets then count bytes of the text. A text of UTF-16 with its byte order mark, or of lines
that end with a carriage return alone, is read, too; offsets then count bytes of the same text in UTF-8.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import itertools
import lzma
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, ClassVar, Final, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.strict import Strict
from roadscan.core.witness import Witness
from roadscan.ingest.reading.format import Reject
from roadscan.ingest.reading.text_files import AGAIN, Headers, NameLines, is_unpacked, open_unpacked

BLOCK_BYTES: Final = 1 << 20  # bytes of a block of text
LINE_BYTES_MAX: Final = 1 << 16
"""Longest line (bytes): text without a line end for longer is no table."""
SEARCHED_BYTES: Final = 16 << 20
"""A text whose first bytes, this many, contain nothing of a format is not of that format."""
HEAD_BYTES: Final = 1 << 16
"""Bytes in which the column names have to occur."""

Kind: TypeAlias = Literal["number", "integer", "text"]
"""Type of a column: float64, int64 or text. An empty number is NaN, an empty whole number is a fault."""

_ARROW_TYPES: Final[dict[Kind, pa.DataType]] = {"number": pa.float64(), "integer": pa.int64(), "text": pa.string()}
_REMARKS: Final = (b"//", b"; ", b"% ", b"! ")
"""Other starts of remarks that programs write above the line of names."""
_LETTERS: Final = frozenset(b"abcdfghijklmopqrstuvwxyzABCDFGHIJKLMOPQRSTUVWXYZ_")
"""Letters of names that occur in no number (1e5, nan)."""
_DELIMITERS: Final = (",", ";", "\t", "|")
_UTF8: Final = "utf-8"
_MARKED: Final = {
    codecs.BOM_UTF32_LE: "utf-32-le",  # a UTF-16 mark is the start of this one
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
"""Encodings by the byte order mark at a text's start."""
_UNMARKED: Final = {"utf-16-le": (1, 2), "utf-16-be": (0, 2)}
"""Encodings in which every other byte is zero for Latin letters: the positions of these bytes, and of the others."""
_ZEROS: Final = 0.9
"""Least share of zeros among these bytes, and of others among the rest."""
_DECIMAL_LINES: Final = 200
"""Lines of records from which the decimal mark is found."""
_COMMA_NUMBER: Final = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_MAY_BE_THOUSANDS: Final = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number whose comma may also separate thousands: 648,500."""
_DAMAGE: Final = (EOFError, gzip.BadGzipFile, zlib.error, lzma.LZMAError, OSError)


DECIMAL_MARK: Final = Witness(
    "decimal_mark",
    "any text",
    "The commas of numbers are decimal marks, or part thousands.",
    "all numbers of the first records: one that cannot have thousands tells the mark",
    "decimal commas are read; where each comma may be either, the log is refused until options.decimal states it",
    ("error",),
)
ENCODING: Final = Witness(
    "text_encoding",
    "any text",
    "The text is neither UTF-8 nor UTF-16 or UTF-32 with its byte order mark.",
    "the bytes of the line of names, and of each line",
    "a log whose names are not UTF-8 is refused until options.encoding states another; other such lines are left out",
    ("error", "rejects"),
)


class TextOptions(Strict):
    """Settings of a text file with columns."""

    later: ClassVar[frozenset[str]] = frozenset({"decimal", "encoding"})

    delimiter: str | None = None
    """Character between columns: "," ";" "|", a tabulator, or " " for any run of blanks. Found from
    the line of column names where left out."""
    comment: str = "#"
    """Lines that start with this character are skipped; "" for none."""
    skip_lines: int = 0
    """Lines above the line of column names."""
    names: list[str] | None = None
    """Names of the columns, for a file without a line of names."""
    decimal: Literal[".", ","] | None = None
    """Decimal mark of the numbers. Found from the first records where left out; it has to be stated where their commas
    may part thousands as well."""
    encoding: str | None = None
    """Encoding of the text, such as "cp1252" (Windows, western Europe) or "latin-1". UTF-8, or UTF-16 or UTF-32
    with its byte order mark, where left out."""


@dataclass(frozen=True)
class TextCoding:
    """How a text file's bytes are converted to lines of UTF-8."""

    encoding: str = _UTF8
    """Name of the Python codec."""
    ends_with_return: bool = False
    """Lines end with a carriage return alone, as on old Macintosh systems."""

    @classmethod
    def of(cls, head: bytes, encoding: str | None = None) -> TextCoding:
        """Return the coding of the text that begins with `head`: by its byte order mark, or as stated."""
        marked = next((name for mark, name in _MARKED.items() if head.startswith(mark)), None)
        found = cls(encoding or marked or _UTF8)
        text = found.decoded(head)
        return replace(found, ends_with_return=b"\r" in text and b"\n" not in text)

    def decoded(self, head: bytes) -> bytes:
        """Return the first bytes of a text as UTF-8 with line feeds, without an incomplete last character."""
        return b"".join(self.pieces([head]))

    def pieces(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        """Yield the file's bytes as UTF-8 with line feeds. Invalid bytes become U+FFFD."""
        decode = None if self.encoding == _UTF8 else codecs.getincrementaldecoder(self.encoding)("replace").decode
        for number, piece in enumerate(pieces):
            data = piece if decode is None else decode(piece).encode("utf-8")
            if number == 0 and decode is not None:
                data = data.removeprefix(codecs.BOM_UTF8)
            yield data.replace(b"\r", b"\n") if self.ends_with_return else data


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text table."""

    names: tuple[str, ...]
    delimiter: str
    """One character; a blank stands for any run of blanks."""
    comment: str
    data_offset: int
    """Byte at which the first line after the names starts."""
    decimal: str = "."
    """Decimal mark of the numbers."""
    coding: TextCoding = TextCoding()
    """Conversion of the file's bytes to lines of UTF-8."""


@dataclass(frozen=True)
class TextBlock:
    """Sound lines of a block."""

    columns: dict[str, pa.Array]
    """Columns asked for, by name."""
    records: Int64
    """(n,) record numbers; the first line after the names is 0, comments and blank lines do not count."""
    offsets: Int64
    """(n,) byte offset of each line in the text."""

    def number(self, name: str) -> Float64:
        """Column of kind "number" as float64 (n,), NaN where empty."""
        return np.asarray(self.columns[name].to_numpy(zero_copy_only=False), dtype=np.float64)

    def stamps(self, name: str) -> npt.NDArray[np.generic]:
        """Column of kind "number" (float64) or "integer" (int64), (n,)."""
        return np.asarray(self.columns[name].to_numpy(zero_copy_only=False))

    def text(self, name: str) -> list[str]:
        """Column of kind "text", blanks around the words removed."""
        return [str(word).strip() for word in self.columns[name].to_pylist()]


def open_text(path: Path) -> IO[bytes]:
    """Open a text file, decompressing gzip, bzip2 and xz (identified by their first bytes) within bounds."""
    raw = path.open("rb")
    magic = raw.read(6)
    raw.close()
    if magic.startswith(b"\x1f\x8b"):
        return open_unpacked(path, "gzip")
    if magic.startswith(b"BZh"):
        return open_unpacked(path, "bzip2")
    if magic == b"\xfd7zXZ\x00":
        return open_unpacked(path, "xz")
    return path.open("rb")


def head_of(path: Path, size: int = HEAD_BYTES) -> bytes:
    """Return the first bytes of a text file (decompressed, up to any damage); b"" where it cannot be read."""
    head = b""
    try:
        with open_text(path) as stream:
            while len(head) < size and (part := cast(Any, stream).read1(size - len(head))):
                head += part
    except _DAMAGE:
        pass  # the reader will report damage after the head
    return head


def sniff_layout(path: Path) -> TextLayout | None:
    """Return the layout of a plain file with column names, or None where it is none. Never raises."""
    try:
        return text_layout(path, TextOptions())
    except (FormatError, ConfigError):
        return None


def text_layout(path: Path, options: TextOptions) -> TextLayout:
    """Find the delimiter, the column names and the first data line.

    Raises
    ------
    FormatError
        where no line of column names is found.
    ConfigError
        where an option is no single character.
    """
    start = _start_of(path, options)
    names = start.names if options.names is None else options.names
    names = [name.strip() for name in names]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        places = [str(k) for k, name in enumerate(names, 1) if name == twice]
        raise FormatError(
            f"two columns are called '{twice}': the {places[0]}. and the {places[1]}.",
            expected="a name of its own for each column",
            change="rename one, or state options.names",
            file=path,
            missing=Missing("options.names", [f"column_{k}" for k in range(1, len(names) + 1)], is_example=True),
        )
    offset = start.data_offset if options.names is None else start.offset
    layout = TextLayout(tuple(names), start.delimiter, options.comment, offset, coding=start.coding)
    return replace(layout, decimal=options.decimal or _decimal_of(path, layout))


def first_words(path: Path, options: TextOptions) -> tuple[str, list[str]]:
    """Return the delimiter and the fields of the line of names, or of the first record where no line has names.

    Raises as :func:`text_layout`.
    """
    start = _start_of(path, options)
    return start.delimiter, start.names


def first_record(path: Path, options: TextOptions) -> list[str]:
    """Return the fields of the first line that is no comment, names or not. Raises as :func:`text_layout`."""
    return _start_of(path, options).fields


@dataclass(frozen=True)
class _Start:
    """The first relevant line of a table."""

    fields: list[str]
    names: list[str]
    """Its fields, or those of the comment above it that names the columns."""
    delimiter: str
    offset: int
    """Byte at which it starts."""
    data_offset: int
    """Byte at which the first record starts, if `names` are names."""
    coding: TextCoding


def _start_of(path: Path, options: TextOptions) -> _Start:
    """Return the first line that is not skipped, blank or a comment, and the comment above it with column names."""
    for name, value in (("delimiter", options.delimiter), ("comment", options.comment)):
        if value and (len(value) > 1 or not value.isascii() or value in '"\r\n'):
            raise ConfigError(f"{name} = {value!r}", expected="one character, no quote or line end", file=path)
    coding = _coding_of(path, options.encoding)
    head = coding.decoded(head_of(path))
    offset = 3 if head.startswith(codecs.BOM_UTF8) else 0
    skip, above = options.skip_lines, ""
    for raw in head[offset:].splitlines(keepends=True) or [b"\x00"]:
        if b"\x00" in raw:
            raise _no_text(head, path)
        line = raw.strip()
        comment = bool(options.comment) and line.startswith((options.comment.encode(), *_REMARKS))
        if skip <= 0 and line and not comment:
            behind = offset + len(raw)
            if behind >= HEAD_BYTES and not raw.endswith((b"\n", b"\r")):
                raise FormatError(
                    f"the line of column names does not end within {HEAD_BYTES:,} bytes", expected="names", file=path
                )
            text = _decoded_names(line, path)
            delimiter = options.delimiter or _delimiter_of(text)
            fields = _fields(text, delimiter)
            named = _named_by_comment(above, fields, delimiter)
            if named is not None:
                return _Start(fields, named, delimiter, offset, offset, coding)
            return _Start(fields, fields, delimiter, offset, behind, coding)
        if comment and skip <= 0:
            above = line.decode("utf-8", errors="replace").lstrip(options.comment)
        skip -= 1
        offset += len(raw)
    raise FormatError("the file holds no line of column names", expected="names, then records", file=path)


def _no_text(head: bytes, path: Path) -> FormatError:
    """Return the error for bytes with zeros among them: no text, or an encoding of two bytes per letter."""
    for encoding, (zero, step) in _UNMARKED.items():
        own, others = head[zero::step], head[1 - zero :: step]
        if own and own.count(0) >= _ZEROS * len(own) and others.count(0) <= (1 - _ZEROS) * len(others):
            return FormatError(
                f"the text seems to be {encoding.upper()}, and has no byte order mark",
                expected="UTF-8, or the encoding in options.encoding",
                change=f'state options.encoding = "{encoding}"',
                file=path,
                missing=Missing("options.encoding", encoding),
            )
    return FormatError("the file holds no text", expected="lines with columns", file=path)


def _coding_of(path: Path, encoding: str | None) -> TextCoding:
    try:
        "".encode(encoding or _UTF8)  # knows encodings of text only
        return TextCoding.of(head_of(path), encoding)
    except LookupError as error:
        raise ConfigError(
            f"options.encoding = {encoding!r} is no known encoding", expected='such as "cp1252"', file=path
        ) from error


def _decoded_names(line: bytes, path: Path) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FormatError(
            f"byte {line[error.start]:#04x} of the line of column names is not UTF-8",
            expected="UTF-8, or the encoding in options.encoding",
            change='state options.encoding = "cp1252" if a Windows program of western Europe wrote it',
            file=path,
            missing=Missing("options.encoding", "cp1252"),
        ) from error


def _named_by_comment(comment: str, fields: list[str], delimiter: str) -> list[str] | None:
    """Return column names in the comment above the first record, if it has one word for each field; else None."""
    numbers = sum(not math.isnan(_number(field.strip().replace(",", "."))) for field in fields)
    names = [name.strip() for name in _fields(comment.strip(), delimiter)]
    if len(names) != len(fields) or len(names) < 2 or 2 * numbers < len(fields):
        return None
    is_named = all(names) and len(set(names)) == len(names) and all(math.isnan(_number(name)) for name in names)
    return names if is_named else None


def _decimal_of(path: Path, layout: TextLayout) -> str:
    """Return the decimal mark of the first records' numbers.

    Raises
    ------
    FormatError
        where a comma in each of them may be a decimal mark, or part the thousands.
    """
    if layout.delimiter == ",":
        return "."
    words = [word.strip() for fields in first_fields(path, layout, _DECIMAL_LINES) for word in fields]
    commas = [word for word in words if _COMMA_NUMBER.fullmatch(word)]
    points = any("." in word and not math.isnan(_number(word)) for word in words)
    if not commas or points:
        return "."
    if all(_MAY_BE_THOUSANDS.fullmatch(word) for word in commas):
        raise FormatError(
            f"the comma of '{commas[0]}' is a decimal mark, or parts the thousands: no number of the file tells which",
            expected="options.decimal",
            change='state options.decimal = "," if it is the decimal mark; export without it otherwise',
            file=path,
            missing=Missing("options.decimal", ",", (",", ".")),
        )
    return ","


def _delimiter_of(line: str) -> str:
    counts = {delimiter: line.count(delimiter) for delimiter in _DELIMITERS}
    if any(counts[one] for one in _DELIMITERS if one != ","):
        counts[","] -= len(re.findall(r"(?<=\d),(?=\d)", line))  # decimal commas with another delimiter
    most = max(_DELIMITERS, key=lambda delimiter: counts[delimiter])
    return most if counts[most] else " "


def first_fields(path: Path, layout: TextLayout, lines: int = 1) -> list[list[str]]:
    """Return the fields of the first `lines` lines that have as many fields as there are names."""
    found: list[list[str]] = []
    head = layout.coding.decoded(head_of(path, 2 * layout.data_offset + HEAD_BYTES))
    for raw in head[layout.data_offset :].splitlines():
        if len(found) == lines:
            break
        text = raw.decode("utf-8", errors="replace").strip()
        fields = _fields(text, layout.delimiter)
        if len(fields) == len(layout.names) and not (layout.comment and text.startswith(layout.comment)):
            found.append([_with_point(field, layout.decimal) for field in fields])
    return found


def stamp_kind(path: Path, layout: TextLayout, name: str, unit: str) -> Kind:
    """Return the kind of a column of time stamps, from most of its first sound values: number, text or integer.

    Only nanoseconds are read as integers: they alone have more digits than float64 holds. Stamps in another
    `unit` may be whole at first and decimal later.
    """
    column = layout.names.index(name)
    words = [fields[column].strip() for fields in first_fields(path, layout, 20)]
    kinds = [_kind_of(word) for word in words if word]
    if unit != "ns":
        kinds = ["number" if kind == "integer" else kind for kind in kinds]
    return max(kinds, key=kinds.count, default="number")


def _kind_of(word: str) -> Kind:
    if word.lstrip("+-").isdigit():
        return "integer"
    return "text" if math.isnan(_number(word)) else "number"


def number_stamp_kind(path: Path, layout: TextLayout, name: str, unit: str) -> Kind:
    """As :func:`stamp_kind`, for formats whose stamps are numbers."""
    kind = stamp_kind(path, layout, name, unit)
    if kind == "text":
        raise FormatError(f"time stamps in column '{name}' are text", expected="numbers", file=path)
    return kind


def text_blocks(
    path: Path, layout: TextLayout, kinds: Mapping[str, Kind], headers: Headers | None = None
) -> Iterator[TextBlock | Reject]:
    """Read the columns `kinds` in blocks of whole lines; faulty lines become rejects.

    A truncated compressed stream costs what follows the break. Memory is bounded by
    a block of some 1 MB of text. Lines after a header that differs from the first are not read.

    Parameters
    ----------
    headers : what knows the headers of the format; lines of column names by default.
    """
    record = 0
    reader = _Lines(layout, kinds, headers or _name_lines(path, layout, kinds))
    for offset, data in line_blocks(path, layout.data_offset, coding=layout.coding):
        if isinstance(data, Reject):
            yield Reject(data.reason, record, offset)
            record += 1
            continue
        starts, ends = _lines(data, layout.comment)
        if starts.size == 0:
            continue
        records = record + np.arange(starts.size, dtype=np.int64)
        record += starts.size
        yield from reader.items(data, starts, ends, records, offset + starts)


@dataclass
class _Lines:
    """Reads lines of a file block by block, and checks headers among them."""

    layout: TextLayout
    kinds: Mapping[str, Kind]
    headers: Headers
    _foreign: bool = False
    """The last header differs from the first."""

    def items(
        self, data: bytes, starts: Int64, ends: Int64, records: Int64, offsets: Int64
    ) -> Iterator[TextBlock | Reject]:
        """Yield rows and rejects of the data lines of a block (see :func:`parse_lines`)."""
        marks = self._comments(data, starts, ends)
        whole = None if marks or self._foreign else _parsed(data, starts, ends, self.layout, self.kinds)
        if whole is not None:
            yield TextBlock(whole, records, offsets)
            return
        marks |= self._rows(data, starts, ends)
        bounds = sorted({0, starts.size, *(k for k, _ in marks), *(k + 1 for k, is_row in marks if is_row)})
        for a, b in itertools.pairwise(bounds):
            own = slice(a, b)
            if (a, True) in marks:
                self._foreign = not marks[a, True]
                reason = self.headers.other if self._foreign else AGAIN
                yield Reject(reason, int(records[a]), int(offsets[a]))
                continue
            if (a, False) in marks:
                self._foreign = not marks[a, False]
            if self._foreign:
                yield Reject(self.headers.other, int(records[a]), int(offsets[a]), b - a)
            else:
                yield from parse_lines(
                    data, starts[own], ends[own], self.layout, self.kinds, records[own], offsets[own]
                )
        if (starts.size, False) in marks:
            self._foreign = not marks[starts.size, False]

    def _comments(self, data: bytes, starts: Int64, ends: Int64) -> dict[tuple[int, bool], bool]:
        """Return headers among the comments: the line each precedes, and whether it agrees with the first."""
        comment = self.layout.comment.encode()
        found: dict[tuple[int, bool], bool] = {}
        if not comment or comment not in data:
            return found
        letters = np.frombuffer(data, dtype=np.uint8)
        begins = np.concatenate([[0], np.flatnonzero(letters == ord("\n")) + 1])
        begins = begins[begins < letters.size]
        for begin in begins[letters[begins] == comment[0]].tolist():
            end = data.find(b"\n", begin)
            said = self.headers.comment(data[begin : end if end >= 0 else None].decode("utf-8", errors="replace"))
            if said is not None:
                found[int(np.searchsorted(starts, begin)), False] = said
        return found

    def _rows(self, data: bytes, starts: Int64, ends: Int64) -> dict[tuple[int, bool], bool]:
        """Return headers among the data lines."""
        found: dict[tuple[int, bool], bool] = {}
        for k, (a, b) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            line = data[a:b]
            if line.isascii() and not any(c in _LETTERS for c in line):
                continue
            try:
                said = self.headers.row(_fields(line.decode("utf-8").strip(), self.layout.delimiter))
            except UnicodeDecodeError:
                continue
            if said is not None:
                found[k, True] = said
        return found


def _name_lines(path: Path, layout: TextLayout, kinds: Mapping[str, Kind]) -> NameLines:
    """Return the lines of column names of a file: the last line above its records, where names are stated."""
    numbers = tuple(k for k, name in enumerate(layout.names) if kinds.get(name, "text") != "text")
    head = layout.coding.decoded(head_of(path, 2 * layout.data_offset)) if layout.data_offset else b""
    above = head[: layout.data_offset]
    last = next((line for line in reversed(above.splitlines()) if line.strip()), b"")
    own = _fields(last.decode("utf-8", errors="replace").strip(), layout.delimiter)
    return NameLines(layout.names, numbers, tuple(own) if len(own) > 1 else ())


def parse_lines(
    data: bytes,
    starts: Int64,
    ends: Int64,
    layout: TextLayout,
    kinds: Mapping[str, Kind],
    records: Int64,
    offsets: Int64,
) -> Iterator[TextBlock | Reject]:
    """Read the columns `kinds` of lines in memory; a faulty line becomes a reject.

    Parameters
    ----------
    starts, ends : (n,) bytes of `data` where each line starts, and ends after its line feed.
    layout : `data_offset` and `comment` are ignored.
    records, offsets : (n,) record number and byte offset of each line, as blocks and rejects state them.
    """
    table = _parsed(data, starts, ends, layout, kinds)
    if table is not None:
        yield TextBlock(table, records, offsets)
    else:
        yield from _parse_singly(data, starts, ends, layout, kinds, records, offsets)


def _parsed(
    data: bytes, starts: Int64, ends: Int64, layout: TextLayout, kinds: Mapping[str, Kind]
) -> dict[str, pa.Array] | None:
    """Return the columns of lines without faults; None where a line is faulty."""
    whole = int((ends - starts).sum()) == len(data)
    return _parse(data if whole else _joined(data, starts, ends), layout, kinds, starts.size)


def line_blocks(
    path: Path, start: int = 0, limit: int | None = None, coding: TextCoding | None = None
) -> Iterator[tuple[int, bytes | Reject]]:
    """Yield pieces of whole lines from byte `start` of the text on, each with its offset.

    A reject replaces a line without end, or everything after the break of a compressed stream.

    Parameters
    ----------
    limit : bytes of the text after which no more is read.
    coding : how the bytes become UTF-8; as they are where left out.
    """
    carry, offset, skipping = b"", 0, False
    for chunk in byte_pieces(path) if coding is None else _coded_pieces(path, coding):
        if isinstance(chunk, Reject):
            yield offset, chunk
            return
        data = carry + chunk
        if offset < start:
            cut = min(start - offset, len(data))
            data, offset = data[cut:], offset + cut
        if skipping:
            end = data.find(b"\n") + 1
            offset += end or len(data)
            data, skipping = data[end:] if end else b"", not end
        end = data.rfind(b"\n") + 1
        if end:
            yield offset, data[:end]
        carry, offset = data[end:], offset + end
        if len(carry) > LINE_BYTES_MAX:
            yield offset, Reject(f"a line longer than {LINE_BYTES_MAX} bytes")
            offset, carry, skipping = offset + len(carry), b"", True
        if limit is not None and offset >= limit:
            return
    if carry:
        yield offset, carry


def byte_pieces(path: Path) -> Iterator[bytes | Reject]:
    """Yield pieces of a file (decompressed) of up to some 1 MB; last a reject where a compressed stream breaks off."""
    with open_text(path) as stream:
        packed = is_unpacked(stream)
        parts: list[bytes] = []
        broken: Reject | None = None
        while True:
            try:
                part = cast(Any, stream).read1(BLOCK_BYTES)
            except _DAMAGE as error:
                if not packed:
                    raise FormatError(f"the file cannot be read: {error}", file=path) from error
                part, broken = b"", Reject(f"the compressed file is damaged from here on: {error}")
            parts.append(part)
            if not part or sum(map(len, parts)) >= BLOCK_BYTES:
                yield b"".join(parts)
                parts = []
            if not part:
                break
        if broken is not None:
            yield broken


def _coded_pieces(path: Path, coding: TextCoding) -> Iterator[bytes | Reject]:
    broken: list[Reject] = []

    def sound() -> Iterator[bytes]:
        for piece in byte_pieces(path):
            if isinstance(piece, Reject):
                broken.append(piece)
                return
            yield piece

    yield from coding.pieces(sound())
    yield from broken


def _lines(data: bytes, comment: str) -> tuple[Int64, Int64]:
    """Return start and end (n,) of each line that is neither blank nor a comment."""
    letters = np.frombuffer(data, dtype=np.uint8)
    ends = np.flatnonzero(letters == ord("\n")) + 1
    if ends.size == 0 or ends[-1] < letters.size:
        ends = np.append(ends, letters.size)
    starts = np.concatenate([[0], ends[:-1]])
    first = letters[starts]
    passed_over = (first == ord("\n")) | (first == ord("\r"))
    if comment:
        passed_over |= first == ord(comment)
    keep = ~passed_over | _with_inner_return(letters, starts, ends)
    return starts[keep].astype(np.int64), ends[keep].astype(np.int64)


def _with_inner_return(letters: npt.NDArray[np.uint8], starts: Int64, ends: Int64) -> npt.NDArray[np.bool_]:
    """Return which lines (n,) have a carriage return before their end, which would hide lines that end with it."""
    found = np.zeros(starts.size, dtype=bool)
    returns = np.flatnonzero(letters[:-1] == ord("\r"))
    inner = returns[letters[returns + 1] != ord("\n")]
    if inner.size:
        lines = np.searchsorted(ends, inner, side="right")
        found[lines[inner + 1 < ends[lines]]] = True
    return found


def _joined(data: bytes, starts: Int64, ends: Int64) -> bytes:
    return b"".join(data[a:b] for a, b in zip(starts, ends, strict=True))


def _parse(data: bytes, layout: TextLayout, kinds: Mapping[str, Kind], lines: int) -> dict[str, pa.Array] | None:
    """Return the columns of a block, parsed by Arrow; None where a line is faulty."""
    if b'"' in data:
        return None  # a stray quote must not swallow the following lines
    if layout.delimiter == " ":
        data = b"\n".join(b" ".join(line.split()) for line in data.splitlines())
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(data),
            read_options=pa_csv.ReadOptions(
                column_names=list(layout.names), use_threads=False, block_size=len(data) + 1
            ),
            parse_options=pa_csv.ParseOptions(delimiter=layout.delimiter, quote_char=False, ignore_empty_lines=False),
            convert_options=pa_csv.ConvertOptions(
                include_columns=list(kinds),
                column_types={name: _ARROW_TYPES[kind] for name, kind in kinds.items()},
                null_values=[""],
                decimal_point=layout.decimal,
                strings_can_be_null=False,
            ),
        )
    except pa.ArrowInvalid:
        return None
    columns = {name: table.column(name).combine_chunks() for name in kinds}
    missing = any(columns[name].null_count for name, kind in kinds.items() if kind == "integer")
    return None if table.num_rows != lines or missing else columns


def _parse_singly(
    data: bytes,
    starts: Int64,
    ends: Int64,
    layout: TextLayout,
    kinds: Mapping[str, Kind],
    records: Int64,
    offsets: Int64,
) -> Iterator[TextBlock | Reject]:
    """Parse a block with faults line by line."""
    where = {name: layout.names.index(name) for name in kinds}
    kept: list[int] = []
    values: dict[str, list[Any]] = {name: [] for name in kinds}
    for i, (a, b) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        try:
            fields = _fields(data[a:b].decode("utf-8").rstrip("\r\n"), layout.delimiter)
            if len(fields) != len(layout.names):
                raise ValueError(f"{len(fields)} fields, expected {len(layout.names)}")
            row = {name: _value(name, fields[where[name]], kind, layout.decimal) for name, kind in kinds.items()}
        except UnicodeDecodeError:
            yield Reject(
                "the line is not UTF-8 text, and options.encoding states no other", int(records[i]), int(offsets[i])
            )
            continue
        except ValueError as error:
            yield Reject(str(error), int(records[i]), int(offsets[i]))
            continue
        kept.append(i)
        for name, value in row.items():
            values[name].append(value)
    if kept:
        columns = {name: pa.array(values[name], type=_ARROW_TYPES[kind]) for name, kind in kinds.items()}
        yield TextBlock(columns, records[kept], offsets[kept])


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        rows = list(csv.reader([line], delimiter=delimiter))
    except csv.Error:  # a carriage return in the middle, or an unclosed field
        return []
    return rows[0] if len(rows) == 1 else []


def _with_point(word: str, decimal: str) -> str:
    """Return a number with a point in place of its decimal comma; any other word unchanged."""
    return word.replace(",", ".") if decimal == "," and _COMMA_NUMBER.fullmatch(word.strip()) else word


def _value(name: str, word: str, kind: Kind, decimal: str) -> float | int | str | None:
    """Return the value of one field, or raise ValueError saying what is wrong with it."""
    if kind == "text":
        return word
    word = _with_point(word.strip(), decimal)
    if kind == "number":
        if not word:
            return None
        value = _number(word)
        if math.isnan(value) and word.lower().lstrip("+-") != "nan":
            raise ValueError(f"{name} '{word[:40]}' is not a number")
        return value
    if not (word.isascii() and word.lstrip("+-").isdigit() and len(word) < 20 and -(2**63) <= int(word) < 2**63):
        raise ValueError(f"{name} '{word[:40]}' is not a whole number")
    return int(word)


def is_number(word: str) -> bool:
    """Return True for a number as written in data files."""
    return math.isfinite(_number(word))


def _number(word: str) -> float:
    """Return the number of a word as written in data files, NaN for anything else."""
    try:
        return float(word) if "_" not in word and word.isascii() else math.nan
    except ValueError:
        return math.nan
