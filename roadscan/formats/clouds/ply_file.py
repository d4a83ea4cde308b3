"""Reads PLY files (Turk 1994) in bounded memory, whatever their headers claim.

A header lists elements and their properties; records follow, one element after another, as text or in
binary of either byte order. Lists have a length a record, so records with lists are read in runs of equal
layout.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError, FormatError
from roadscan.formats.clouds.reference_scan import CHUNK_POINTS
from roadscan.ingest.reading.format import Reject
from roadscan.ingest.reading.text_table import LINE_BYTES_MAX, TextBlock, TextLayout, text_blocks

Coding: TypeAlias = Literal["ascii", "binary_little_endian", "binary_big_endian"]

HEADER_BYTES_MAX: Final = 1 << 16  # bytes in which the header has to end
RECORD_BYTES_MAX: Final = 1 << 20
"""Records that their lists make longer count as damaged."""

_BLOCK_BYTES: Final = 4 << 20  # bytes of a block
_FIRST_RUN: Final = 16  # records of the first run of equal layout; longer ones follow while layouts agree
_TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy type by PLY's name, without the byte order."""
TYPE_NAMES: Final = {kind: name for name, kind in reversed(_TYPES.items())}
"""PLY's name by NumPy type, such as uchar for u1."""


@dataclass(frozen=True)
class Property:
    """One property of an element."""

    name: str
    type: str
    """NumPy type without byte order."""
    count_type: str = ""
    """Type of a list's length; "" for a single value."""


@dataclass(frozen=True)
class Element:
    """One element: the number of its records, and their properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Return True where records differ in length."""
        return any(p.count_type for p in self.properties)

    def dtype(self, order: str, counts: Sequence[int] = ()) -> np.dtype[Any]:
        """Return the layout of a binary record with the given list lengths; ``order`` is "<" or ">"."""
        lengths = iter(counts)
        fields: list[tuple[Any, ...]] = []
        for p in self.properties:
            if p.count_type:
                fields.append((f"#{p.name}", order + p.count_type))
                fields.append((p.name, order + p.type, (next(lengths),)))
            else:
                fields.append((p.name, order + p.type))
        return np.dtype(fields)


@dataclass(frozen=True)
class PlyHeader:
    """Parsed content of a PLY header."""

    coding: Coding
    elements: tuple[Element, ...]
    body: int
    """Byte after the header."""

    @property
    def vertex(self) -> Element | None:
        """Return the element of the points."""
        return next((e for e in self.elements if e.name == "vertex"), None)

    @property
    def before(self) -> tuple[Element, ...]:
        """Return the elements whose records precede the points."""
        return self.elements[: self.elements.index(self.vertex)] if self.vertex else ()

    @property
    def order(self) -> str:
        """Return NumPy's sign of the byte order."""
        return ">" if self.coding == "binary_big_endian" else "<"


@dataclass(frozen=True)
class Vertices:
    """Consecutive points."""

    columns: dict[str, npt.NDArray[Any]]
    """(n,) by property."""
    records: Int64
    """(n,) number of each point."""
    offsets: Int64
    """(n,) byte of each point."""


def read_header(path: Path) -> PlyHeader:
    """Read and check the header.

    Raises
    ------
    FormatError
        if it is no PLY header, or one with types, elements or names that PLY does not have.
    """
    with path.open("rb") as stream:
        head = stream.read(HEADER_BYTES_MAX)
    found = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", head)
    if found is None or end is None:
        raise FormatError(
            "the file has no PLY header",
            expected=f"ply … end_header within {HEADER_BYTES_MAX:,} bytes",
            file=path,
        )
    lines = [line.split() for line in head[: end.start()].decode("latin-1").splitlines()[1:]]
    coding: Coding | None = None
    elements: list[Element] = []
    for number, words in enumerate(lines, 2):
        if not words or words[0] in {"comment", "obj_info"}:
            continue
        try:
            if words[0] == "format":
                coding = _coding(words)
            elif words[0] == "element":
                elements.append(_element(words, elements))
            elif words[0] == "property":
                elements[-1] = _with_property(elements[-1], words)
            else:
                raise ValueError(f"'{words[0][:40]}' is no keyword of PLY")
        except (ValueError, IndexError) as error:
            raise FormatError(
                f"the header cannot be understood: {error}", expected="PLY 1.0", file=path, record=f"line {number}"
            ) from error
    if coding is None:
        raise FormatError("the header states no format", expected="format ascii or binary_… 1.0", file=path)
    return PlyHeader(coding, tuple(elements), end.end())


def _coding(words: list[str]) -> Coding:
    known: dict[str, Coding] = {k: k for k in ("ascii", "binary_little_endian", "binary_big_endian")}
    if len(words) != 3 or words[1] not in known or words[2] != "1.0":
        raise ValueError(f"format '{' '.join(words[1:])[:60]}'")
    return known[words[1]]


def _element(words: list[str], before: list[Element]) -> Element:
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit() and len(words[2]) < 20):
        raise ValueError(f"element '{' '.join(words[1:])[:60]}'")
    if any(e.name == words[1] for e in before):
        raise ValueError(f"two elements are called '{words[1][:40]}'")
    return Element(words[1], int(words[2]), ())


def _with_property(element: Element, words: list[str]) -> Element:
    one = words[1:]
    if len(one) == 4 and one[0] == "list" and one[1] in _TYPES and one[2] in _TYPES:
        if _TYPES[one[1]][0] == "f":
            raise ValueError(f"the length of list '{one[3][:40]}' is no whole number")
        made = Property(one[3], _TYPES[one[2]], _TYPES[one[1]])
    elif len(one) == 2 and one[0] in _TYPES:
        made = Property(one[1], _TYPES[one[0]])
    else:
        raise ValueError(f"property '{' '.join(one)[:60]}'")
    if made.name.startswith("#") or any(p.name == made.name for p in element.properties):
        raise ValueError(f"two properties are called '{made.name[:40]}'")
    return Element(element.name, element.count, (*element.properties, made))


def vertices(path: Path, header: PlyHeader, names: Sequence[str]) -> Iterator[Vertices | Reject]:
    """Yield the points' properties `names` (single values) in batches; unreadable points are rejects."""
    vertex = header.vertex
    if vertex is None:
        raise FormatError("the file has no element 'vertex'", expected="points", file=path)
    missing = [n for n in names if not any(p.name == n and not p.count_type for p in vertex.properties)]
    if missing:
        raise ConfigError(f"the points have no property '{missing[0]}'", file=path)
    seen = 0
    for item in (
        _text(path, header, vertex, names) if header.coding == "ascii" else _binary(path, header, vertex, names)
    ):
        seen += item.records.size if isinstance(item, Vertices) else item.records
        yield item
    if seen < vertex.count:
        yield Reject("the header claims points that the file does not hold", seen, -1, vertex.count - seen)
    elif header.elements[-1] is vertex and (more := _left_over(path, header, vertex)):
        yield Reject("the file holds points that the header does not claim", vertex.count, -1, more)


def _left_over(path: Path, header: PlyHeader, vertex: Element) -> int:
    """Return the points after all that the header claims: non-blank lines, or whole records of a binary file."""
    if header.coding == "ascii":
        start = _line_offset(path, header.body, sum(e.count for e in header.elements))
        return 0 if start is None else sum(1 for _ in _lines(path, start))
    with path.open("rb") as stream:
        at: int | None = header.body
        for element in header.elements:
            at = None if at is None else _behind(stream, element, header.order, at)
        shortest = vertex.dtype(header.order, [0] * len(vertex.properties)).itemsize
        return 0 if at is None else (stream.seek(0, 2) - at) // shortest


def _lines(path: Path, at: int) -> Iterator[bytes]:
    """Yield the non-blank lines from a byte on."""
    with path.open("rb") as stream:
        stream.seek(at)
        while line := stream.readline(LINE_BYTES_MAX):
            if line.strip():
                yield line


# --- binary ------------------------------------------------------------------------------------------


def _binary(path: Path, header: PlyHeader, vertex: Element, names: Sequence[str]) -> Iterator[Vertices | Reject]:
    with path.open("rb") as stream:
        at = header.body
        for element in header.before:
            behind = _behind(stream, element, header.order, at)
            if behind is None:
                yield Reject(
                    f"the records of element '{element.name}' before the points are damaged", 0, at, vertex.count
                )
                return
            at = behind
        yield from _batches(_runs(stream, vertex, header.order, at), names)


def _behind(stream: BinaryIO, element: Element, order: str, at: int) -> int | None:
    """Return the byte after an element's records, None where they are damaged or cut off."""
    if not element.has_lists:
        behind = at + element.count * element.dtype(order).itemsize
        return behind if behind <= stream.seek(0, 2) else None
    seen = 0
    for run in _runs(stream, element, order, at):
        if isinstance(run, Reject):
            return None
        seen, at = run.first + run.values.size, run.offset + run.values.size * run.values.itemsize
    return at if seen == element.count else None


@dataclass(frozen=True)
class _Run:
    """Consecutive records of one layout."""

    first: int
    offset: int
    values: npt.NDArray[np.void]


def _runs(stream: BinaryIO, element: Element, order: str, at: int) -> Iterator[_Run | Reject]:
    """Yield runs of records of equal layout, up to the end of the file or an impossible list."""
    size = stream.seek(0, 2)
    layout = functools.lru_cache(maxsize=256)(lambda counts: element.dtype(order, counts))
    lists = [p.name for p in element.properties if p.count_type]
    first, start, block = 0, at, b""
    longest = _FIRST_RUN if lists else CHUNK_POINTS
    while first < element.count and at < size:
        if start + len(block) < min(at + 2 * RECORD_BYTES_MAX, size):
            stream.seek(at)
            start, block = at, stream.read(_BLOCK_BYTES)
        counts = _counts(block, at - start, element, order) if lists else ()
        if counts is None:
            yield Reject("a list is damaged: the points from here on are lost", first, at, element.count - first)
            return
        dtype = layout(counts)
        fit = (len(block) - (at - start)) // max(dtype.itemsize, 1)
        if fit == 0:
            return  # cut off
        run = np.frombuffer(block, dtype, min(fit, longest, element.count - first), at - start)
        same = np.ones(run.size, dtype=bool)
        for name, count in zip(lists, counts, strict=True):
            same &= run[f"#{name}"] == count
        whole = bool(same.all())
        run = run if whole else run[: int(np.argmin(same))]
        yield _Run(first, at, run)
        first, at = first + run.size, at + run.size * dtype.itemsize
        longest = min(2 * longest, CHUNK_POINTS) if whole else _FIRST_RUN


def _counts(block: bytes, at: int, element: Element, order: str) -> tuple[int, ...] | None:
    """Return the list lengths of the record at `at`; None where one is negative or too long."""
    end = at + RECORD_BYTES_MAX
    counts: list[int] = []
    for p in element.properties:
        if p.count_type:
            kind = np.dtype(order + p.count_type)
            if at + kind.itemsize > len(block):
                return (*counts, *[0] * (sum(bool(q.count_type) for q in element.properties) - len(counts)))
            count = int(np.frombuffer(block, kind, 1, at)[0])
            at += kind.itemsize + count * np.dtype(p.type).itemsize
            if count < 0 or at > end:
                return None
            counts.append(count)
        else:
            at += np.dtype(p.type).itemsize
    return tuple(counts)


def _batches(runs: Iterator[_Run | Reject], names: Sequence[str]) -> Iterator[Vertices | Reject]:
    """Yield the points of short runs merged into batches."""
    held: list[_Run] = []
    points = 0
    for run in runs:
        if isinstance(run, Reject):
            if held:
                yield _joined(held, names)
            yield run
            return
        held.append(run)
        points += run.values.size
        if points >= CHUNK_POINTS:
            yield _joined(held, names)
            held, points = [], 0
    if held:
        yield _joined(held, names)


def _joined(runs: list[_Run], names: Sequence[str]) -> Vertices:
    size = sum(run.values.size for run in runs)
    offsets = [run.offset + run.values.itemsize * np.arange(run.values.size) for run in runs]
    columns = {}
    for name in names:
        own = np.concatenate([run.values[name] for run in runs])
        columns[name] = own.astype(own.dtype.newbyteorder("="))
    return Vertices(columns, runs[0].first + np.arange(size), np.concatenate(offsets))


# --- text --------------------------------------------------------------------------------------------


def _text(path: Path, header: PlyHeader, vertex: Element, names: Sequence[str]) -> Iterator[Vertices | Reject]:
    start = _line_offset(path, header.body, sum(e.count for e in header.before))
    if start is None or not vertex.count:
        return
    if vertex.has_lists:
        yield from _lines_with_lists(path, start, vertex, names)
        return
    layout = TextLayout(tuple(p.name for p in vertex.properties), " ", "", start)
    for block in text_blocks(path, layout, dict.fromkeys(names, "number")):
        if isinstance(block, Reject):
            if block.record < vertex.count:
                yield block
            continue
        own = block.records < vertex.count
        if own.any():
            yield from _split(_of_block(block, names, own))
        if not own.all() or block.records[-1] == vertex.count - 1:
            return


def _of_block(block: TextBlock, names: Sequence[str], own: npt.NDArray[np.bool_]) -> Vertices:
    return Vertices({n: block.number(n)[own] for n in names}, block.records[own], block.offsets[own])


def _split(points: Vertices) -> Iterator[Vertices]:
    for at in range(0, points.records.size, CHUNK_POINTS):
        part = slice(at, at + CHUNK_POINTS)
        yield Vertices({n: v[part] for n, v in points.columns.items()}, points.records[part], points.offsets[part])


def _line_offset(path: Path, at: int, lines: int) -> int | None:
    """Return the byte after `lines` non-blank lines, None where the file has fewer."""
    with path.open("rb") as stream:
        stream.seek(at)
        while lines > 0:
            line = stream.readline(LINE_BYTES_MAX)
            if not line:
                return None
            at += len(line)
            lines -= bool(line.strip())
    return at


def _lines_with_lists(path: Path, at: int, vertex: Element, names: Sequence[str]) -> Iterator[Vertices | Reject]:
    """Yield points as text with a list among their properties, line by line."""
    record = 0
    rows: list[list[float]] = []
    records: list[int] = []
    offsets: list[int] = []
    with path.open("rb") as stream:
        stream.seek(at)
        while record < vertex.count and (line := stream.readline(LINE_BYTES_MAX)):
            if words := line.split():
                try:
                    values = _values(words, vertex)
                    rows.append([values[n] for n in names])
                    records.append(record)
                    offsets.append(at)
                except (ValueError, IndexError):
                    yield Reject("the line does not hold the point's properties", record, at)
                record += 1
            at += len(line)
            if len(rows) == CHUNK_POINTS:
                yield _of_lines(rows, records, offsets, names)
                rows, records, offsets = [], [], []
    if rows:
        yield _of_lines(rows, records, offsets, names)


def _of_lines(rows: list[list[float]], records: list[int], offsets: list[int], names: Sequence[str]) -> Vertices:
    table = np.array(rows, dtype=np.float64)
    columns = {name: table[:, k] for k, name in enumerate(names)}
    return Vertices(columns, np.array(records, dtype=np.int64), np.array(offsets, dtype=np.int64))


def _values(words: list[bytes], vertex: Element) -> dict[str, float]:
    """Return the single values of a line; IndexError or ValueError where it does not fit the properties."""
    values: dict[str, float] = {}
    at = 0
    for p in vertex.properties:
        if p.count_type:
            count = int(words[at])
            if count < 0:
                raise ValueError("a negative length")
            at += 1 + count
        else:
            values[p.name] = float(words[at])
            at += 1
    if at != len(words):
        raise ValueError("too many words")
    return values
