"""Reads E57 files (ASTM E2807-11): pages with checksums, the XML section, and packets of points.

Read without a library: those there are (libE57Format) give up a file at its first wrong checksum, trust the
counts of its XML, and crash on some damaged bytes. Here a damaged page costs the points that lie in it.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, Self
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import FormatError
from roadscan.formats.clouds.reference_scan import CHUNK_POINTS
from roadscan.ingest.reading.format import Reject
from roadscan.ingest.reading.records import Sieve

SIGNATURE: Final = b"ASTM-E57"
NAMESPACE: Final = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
XML_BYTES_MAX: Final = 64 << 20  # larger XML sections are refused
CARTESIAN: Final = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL: Final = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")

_MOST_RECORDS: Final = 2**62  # larger counts of points are cut to this

_HEADER: Final = struct.Struct("<8sIIQQQQ")
_CHECKSUM_BYTES: Final = 4  # CRC-32C at the end of a page
_PAGE_BYTES: Final = range(64, (1 << 20) + 1, 4)  # accepted page sizes
_BLOCK_BYTES: Final = 1 << 20  # bytes of pages that are read at once
_SECTION: Final = struct.Struct("<B7xQQQ")
_SECTION_ID: Final = 1  # first byte of a section of points (E2807)
_FILL_POINTS: Final = 8
"""Numbers of one bit in a byte."""
_INDEX_PACKET, _DATA_PACKET, _EMPTY_PACKET = 0, 1, 2  # types of packets (E2807)
_REVERSED_CASTAGNOLI: Final = 0x82F63B78  # CRC-32C polynomial, lowest bit first
_INTEGER_MIN, _INTEGER_MAX = -(2**63), 2**63 - 1  # limits of an integer that states none


# --- pages -------------------------------------------------------------------------------------------


@functools.cache
def _crc_table() -> npt.NDArray[np.uint32]:
    """Return (65,536,) CRC-32C registers after 16 zero bits, by the register's lower half before."""
    table = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        table = (table >> np.uint32(1)) ^ (np.uint32(_REVERSED_CASTAGNOLI) * (table & np.uint32(1)))
    return table


def page_checksums(pages: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Return the CRC-32C (n,) of pages (n, bytes) without their checksums; all pages advance together."""
    table = _crc_table()
    words = np.ascontiguousarray(np.ascontiguousarray(pages).view("<u2").T).astype(np.uint32)
    register = np.full(pages.shape[0], 0xFFFFFFFF, dtype=np.uint32)
    for word in words:
        register = table[(register ^ word) & np.uint32(0xFFFF)] ^ (register >> np.uint32(16))
    return register ^ np.uint32(0xFFFFFFFF)


class Pages:
    """The logical bytes of an E57 file: its pages without their checksums, which are verified."""

    def __init__(self, stream: BinaryIO, page_bytes: int, verify: bool) -> None:
        self._stream = stream
        self._page = page_bytes
        self._payload = page_bytes - _CHECKSUM_BYTES
        self._verify = verify
        self._per_block = max(_BLOCK_BYTES // page_bytes, 1)
        self._blocks: dict[int, tuple[bytes, npt.NDArray[np.bool_]]] = {}
        self.size = stream.seek(0, 2) // page_bytes * self._payload
        """Number of logical bytes in whole pages."""

    def logical(self, physical: int) -> int:
        """Return the logical offset of a physical one."""
        return physical // self._page * self._payload + min(physical % self._page, self._payload)

    def physical(self, logical: int) -> int:
        """Return the physical offset of a logical one."""
        return logical // self._payload * self._page + logical % self._payload

    def read(self, at: int, count: int) -> bytes:
        """Return logical bytes [at, at + count), fewer at the end of the file."""
        end = min(at + count, self.size)
        block_bytes = self._per_block * self._payload
        parts: list[bytes] = []
        while at < end:
            block, start = divmod(at, block_bytes)
            data = self._block(block)[0][start : start + end - at]
            parts.append(data)
            at += len(data)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def damaged(self, at: int, count: int) -> list[tuple[int, int]]:
        """Return the parts [start, end) of logical bytes [at, at + count) in pages with a wrong checksum."""
        found: list[tuple[int, int]] = []
        for page in range(at // self._payload, (at + max(count, 1) - 1) // self._payload + 1):
            block, index = divmod(page, self._per_block)
            bad = self._block(block)[1]
            if index < bad.size and bad[index]:
                found.append((max(at, page * self._payload), min(at + count, (page + 1) * self._payload)))
        return found

    def _block(self, number: int) -> tuple[bytes, npt.NDArray[np.bool_]]:
        if number not in self._blocks:
            while len(self._blocks) > 1:
                del self._blocks[next(iter(self._blocks))]
            self._stream.seek(number * self._per_block * self._page)
            raw = self._stream.read(self._per_block * self._page)
            pages = np.frombuffer(raw, np.uint8, len(raw) // self._page * self._page).reshape(-1, self._page)
            body, stated = pages[:, : self._payload], pages[:, self._payload :]
            bad = np.zeros(pages.shape[0], dtype=bool)
            if self._verify:
                bad = page_checksums(body) != np.ascontiguousarray(stated).view(">u4")[:, 0]
            self._blocks[number] = (body.tobytes(), bad)
        return self._blocks[number]


# --- XML ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """One field of a scan's points, with the packing of its values."""

    name: str
    kind: Literal["float", "integer", "text"]
    bits: int
    """Bits of a value; 0 for integers with one possible value, and for text."""
    low: int = 0
    """Value of the raw number 0."""
    span: int = 0
    """Highest valid raw number of an integer."""
    scale: float = 1.0
    offset: float = 0.0
    """Offset of a scaled integer: value = integer · scale + offset."""

    def values(self, raw: npt.NDArray[np.uint64]) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
        """Return values (n,) of raw numbers (n,), and which of these are invalid."""
        if self.kind == "float":
            own = raw.astype(np.uint32).view(np.float32) if self.bits == 32 else raw.view(np.float64)
            return own, np.zeros(raw.size, dtype=bool)
        integer = (raw + np.uint64(self.low % 2**64)).view(np.int64)
        wrong = raw > np.uint64(self.span)
        if self.scale == 1.0 and self.offset == 0.0:
            return integer, wrong
        return integer * self.scale + self.offset, wrong


@dataclass(frozen=True)
class Scan:
    """One scan as the XML section describes it."""

    name: str
    section: int
    """Physical byte of its points."""
    claimed: int
    """Points that the XML claims, limited by the file's bits."""
    fields: tuple[Field, ...]
    rotation: Float64
    """(3, 3) file's frame from scanner's."""
    translation_m: Float64
    """(3,)."""
    start_gps_s: float | None
    """GPS seconds at its start."""
    limits: dict[str, tuple[float, float]]
    """Limits of intensity and colours: intensity, colorRed, colorGreen, colorBlue."""
    fault: str = ""
    """Reason why its points cannot be read; "" where they can."""

    def field(self, name: str) -> Field | None:
        """Return a field by name."""
        return next((f for f in self.fields if f.name == name), None)


@dataclass(frozen=True)
class E57:
    """An open E57 file."""

    path: Path
    pages: Pages
    crs: str
    """WKT of the file's CRS, "" where it states none."""
    scans: tuple[Scan, ...]

    @classmethod
    def open(cls, path: Path, stream: BinaryIO, *, verify: bool) -> Self:
        """Read the header and the XML section.

        Raises
        ------
        FormatError
            if either cannot be read: without them no point has a place.
        """
        head = stream.read(_HEADER.size)
        if len(head) < _HEADER.size or not head.startswith(SIGNATURE):
            raise FormatError("the file is not E57", expected="an E57 header", file=path)
        _, major, minor, _, xml_at, xml_bytes, page = _HEADER.unpack(head)
        if major != 1:
            raise FormatError(f"the file is E57 {major}.{minor}", expected="E57 1.x", file=path)
        if page not in _PAGE_BYTES:
            raise FormatError(f"pages of {page:,} bytes", expected="1,024 as a rule, a multiple of 4", file=path)
        pages = Pages(stream, page, verify)
        start = pages.logical(xml_at)
        if start + xml_bytes > pages.size or xml_bytes > XML_BYTES_MAX:
            raise FormatError(
                f"the header puts {xml_bytes:,} bytes of XML at byte {xml_at:,}",
                expected=f"at most {XML_BYTES_MAX:,} bytes inside the file, which has {pages.size:,}",
                change="the file is damaged or cut off: fetch it again",
                file=path,
            )
        damaged = pages.damaged(start, xml_bytes)
        if damaged:
            raise FormatError(
                f"the XML section is damaged: wrong checksum of the page at byte {pages.physical(damaged[0][0]):,}",
                expected="CRC-32C as the page states it",
                change="fetch the file again, or set options.check_pages = false if its writer made none",
                file=path,
            )
        root = _parsed(pages.read(start, xml_bytes), path)
        scans = [_scan(one) for one in _children(_child(root, "data3D"))]
        room = 8 * pages.size  # a point takes at least a bit
        held = tuple(replace(scan, claimed=min(scan.claimed, room)) for scan in scans)
        return cls(path, pages, _text(root, "coordinateMetadata"), held)


def _parsed(xml: bytes, path: Path) -> ElementTree.Element:
    try:
        if b"<!DOCTYPE" in xml:
            raise ValueError("it has a document type, which E57 has not")
        root = ElementTree.fromstring(xml)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FormatError(f"the XML section cannot be read: {error}", expected="an E57 root", file=path) from error
    if root.tag != f"{NAMESPACE}e57Root":
        raise FormatError(f"the XML section holds '{root.tag[:80]}'", expected="e57Root of E57 1.0", file=path)
    return root


def _child(element: ElementTree.Element | None, *names: str) -> ElementTree.Element | None:
    for name in names:
        if element is None:
            return None
        element = element.find(f"{NAMESPACE}{name}")
    return element


def _children(element: ElementTree.Element | None) -> list[ElementTree.Element]:
    return [] if element is None else list(element)


def _text(element: ElementTree.Element | None, *names: str) -> str:
    found = _child(element, *names)
    return "" if found is None else (found.text or "").strip()


def _number(element: ElementTree.Element | None, *names: str) -> float | None:
    """Return an element's number (0 where it is empty, by the standard); None where there is no such element."""
    found = _child(element, *names)
    return None if found is None else float(found.text or 0)


def _scan(element: ElementTree.Element) -> Scan:
    points = _child(element, "points")
    try:
        if points is None or points.get("type") != "CompressedVector":
            raise ValueError("it has no points")
        if any(
            "bitPackCodec" not in one.tag for codec in _children(_child(points, "codecs")) for one in _leaves(codec)
        ):
            raise ValueError("its points are packed by an unknown codec")
        rotation, translation = _pose(_child(element, "pose"))
        start = _number(element, "acquisitionStart", "dateTimeValue")
        return Scan(
            name=_text(element, "name"),
            section=_whole(points.get("fileOffset")),
            claimed=min(_whole(points.get("recordCount")), _MOST_RECORDS),
            fields=tuple(_field(leaf) for leaf in _leaves(_child(points, "prototype"))),
            rotation=rotation,
            translation_m=translation,
            start_gps_s=start or None,
            limits=_limits(element),
        )
    except (ValueError, OverflowError) as error:
        claimed = 1 if points is None else _claim(points)
        return Scan(_text(element, "name"), 0, claimed, (), np.eye(3), np.zeros(3), None, {}, str(error))


def _claim(points: ElementTree.Element) -> int:
    try:
        return max(1, min(_whole(points.get("recordCount")), _MOST_RECORDS))
    except ValueError:
        return 1


def _leaves(element: ElementTree.Element | None) -> Iterator[ElementTree.Element]:
    """Yield elements without children in their order, which is that of the byte streams."""
    stack = _children(element)[::-1]
    while stack:
        one = stack.pop()
        if len(one):
            stack += list(one)[::-1]
        else:
            yield one


def _field(leaf: ElementTree.Element) -> Field:
    name = leaf.tag.removeprefix(NAMESPACE)
    kind = leaf.get("type")
    if kind == "Float":
        return Field(name, "float", 32 if leaf.get("precision") == "single" else 64)
    if kind == "String":
        return Field(name, "text", 0)
    if kind not in {"Integer", "ScaledInteger"}:
        raise ValueError(f"field '{name[:60]}' is of the type {kind}")
    low = _whole(leaf.get("minimum", str(_INTEGER_MIN)), signed=True)
    high = _whole(leaf.get("maximum", str(_INTEGER_MAX)), signed=True)
    if not _INTEGER_MIN <= low <= high <= _INTEGER_MAX:
        raise ValueError(f"field '{name[:60]}' goes from {low} to {high}")
    scale, offset = (
        (float(leaf.get("scale", 1)), float(leaf.get("offset", 0))) if kind == "ScaledInteger" else (1.0, 0.0)
    )
    if not (np.isfinite(scale) and np.isfinite(offset)):
        raise ValueError(f"scale or offset of field '{name[:60]}' is no number")
    return Field(name, "integer", (high - low).bit_length(), low, high - low, scale, offset)


def _whole(text: str | None, *, signed: bool = False) -> int:
    digits = (text or "").strip()
    if not digits.removeprefix("-" if signed else "").isascii() or not 0 < len(digits) <= 20:
        raise ValueError(f"'{digits[:40]}' is no whole number")
    value = int(digits)
    if value < 0 and not signed:
        raise ValueError(f"{value} is negative")
    return value


def _pose(pose: ElementTree.Element | None) -> tuple[Float64, Float64]:
    """Return rotation (3, 3) and translation (3,) of a scan: p_file = R · p_scanner + t (E2807, 8.4.9)."""
    if pose is None:
        return np.eye(3), np.zeros(3)
    shift = np.array([_number(pose, "translation", axis) or 0.0 for axis in "xyz"])
    parts = [_number(pose, "rotation", part) for part in "wxyz"]
    if _child(pose, "rotation") is None:
        return np.eye(3), shift
    w, x, y, z = (part or 0.0 for part in parts)
    norm = float(np.sqrt(w * w + x * x + y * y + z * z))
    if not (np.isfinite(shift).all() and abs(norm - 1) < 1e-3):
        raise ValueError("its pose is no rotation and translation")
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rotation), shift


def _limits(element: ElementTree.Element) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for group, names in (("intensityLimits", ("intensity",)), ("colorLimits", ("colorRed", "colorGreen", "colorBlue"))):
        for name in names:
            low = _number(element, group, f"{name}Minimum")
            high = _number(element, group, f"{name}Maximum")
            if low is not None and high is not None:
                found[name] = (low, high)
    return found


# --- points ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Points:
    """Consecutive points of a scan."""

    first: int
    """Number of the first in its scan."""
    columns: dict[str, npt.NDArray[Any]]
    """(n,) by field."""
    sieve: Sieve
    """Sieve from which points in damaged pages, or with values outside their fields' limits, are dropped."""
    offsets: Int64
    """(n,) byte of the damaged page; −1 for sound points, whose values lie in several places."""


def unpacked(data: bytes | bytearray, first_bit: int, bits: int, count: int) -> npt.NDArray[np.uint64]:
    """Return numbers (n,) of `bits` each, packed from `first_bit` on, lowest bit first."""
    if bits == 0:
        return np.zeros(count, dtype=np.uint64)
    if first_bit % 8 == 0 and bits in (8, 16, 32, 64):
        return np.frombuffer(data, f"<u{bits // 8}", count, first_bit // 8).astype(np.uint64)
    if bits > 57:  # a number may span nine bytes: two halves
        starts = first_bit + bits * np.arange(count)
        low = _gathered(data, starts, 32)
        return low | _gathered(data, starts + 32, bits - 32) << np.uint64(32)
    return _gathered(data, first_bit + bits * np.arange(count), bits)


def _gathered(data: bytes | bytearray, starts: Int64, bits: int) -> npt.NDArray[np.uint64]:
    padded = np.frombuffer(bytes(data) + bytes(8), dtype=np.uint8)
    words = np.ndarray((padded.size - 7,), "<u8", padded, strides=(1,))  # one word per byte
    shifted: npt.NDArray[np.uint64] = words[starts >> 3] >> (starts & 7).astype(np.uint64)
    return shifted & np.uint64((1 << bits) - 1)


@dataclass
class _Stream:
    """Bytes of one field, collected from its packets."""

    packed: Field
    data: bytearray = field(default_factory=bytearray)
    first_bit: int = 0
    """Consumed bits of `data`."""
    first: int = 0
    """Number of the next point."""
    damaged: list[tuple[int, int, int]] = field(default_factory=list)
    """First and last point in a damaged page, and the page's byte."""

    @property
    def ready(self) -> int:
        """Return the number of complete points."""
        return (8 * len(self.data) - self.first_bit) // self.packed.bits if self.packed.bits else _MOST_RECORDS

    def add(self, data: bytes, bad: Sequence[tuple[int, int, int]]) -> None:
        """Add bytes; `bad` lists the parts (start, end) of them in damaged pages, with these pages' bytes."""
        before = 8 * len(self.data) - self.first_bit
        for start, end, page in bad if self.packed.bits else ():
            first = (before + 8 * start) // self.packed.bits
            last = (before + 8 * end - 1) // self.packed.bits
            self.damaged.append((self.first + first, self.first + last, page))
        self.data += data

    def take(self, count: int, sieve: Sieve, offsets: Int64) -> npt.NDArray[Any]:
        """Return the values of the next `count` points."""
        raw = unpacked(self.data, self.first_bit, self.packed.bits, count)
        values, wrong = self.packed.values(raw)
        lost = np.zeros(count, dtype=bool)
        while self.damaged and self.damaged[0][0] < self.first + count:
            first, last, page = self.damaged[0]
            part = slice(max(first - self.first, 0), last - self.first + 1)
            lost[part] = True
            offsets[part] = page
            if last >= self.first + count:
                break
            del self.damaged[0]
        sieve.drop(lost, "the checksum of its page is wrong")
        sieve.drop(wrong, f"{self.packed.name} is outside the limits that the file states")
        used = self.first_bit + count * self.packed.bits
        del self.data[: used // 8]
        self.first_bit = used % 8
        self.first += count
        return values


def points_of(file: E57, scan: Scan, names: Sequence[str]) -> Iterator[Points | Reject]:
    """Yield the fields `names` of a scan's points in batches; unreadable points are rejects.

    Record numbers of the rejects count from the scan's first point.
    """
    streams = {f.name: _Stream(f) for f in scan.fields if f.name in names and f.kind != "text"}
    fault = scan.fault
    if not fault and not _has_places(streams):
        fault = "its points have no coordinates"
    if fault:
        yield Reject(f"scan '{scan.name[:40]}' cannot be read: {fault}", 0, -1, scan.claimed)
        return
    end = yield from _streamed(file.pages, scan, streams)
    seen = min(s.first for s in streams.values())
    if seen < scan.claimed:
        yield Reject(end or "the file holds fewer points than its XML claims", seen, -1, scan.claimed - seen)
    elif end:
        yield Reject(end, seen)


def _has_places(streams: dict[str, _Stream]) -> bool:
    """Return True where a triple of coordinates is complete and takes space in the file."""
    triples = ([streams.get(name) for name in names] for names in (CARTESIAN, SPHERICAL))
    return any(all(triple) and any(s.packed.bits for s in triple if s) for triple in triples)


def _streamed(pages: Pages, scan: Scan, streams: dict[str, _Stream]) -> Generator[Points, None, str]:
    """Yield batches of points; return why they end early, if they do."""
    at, end = _section(pages, scan)
    order = [streams.get(f.name) for f in scan.fields]
    done = 0
    fault = "" if at else "the section of the scan's points is missing or damaged"
    while not fault and done < scan.claimed:
        step = _packet(pages, at, end, order)
        ready = min(*(s.ready for s in streams.values()), scan.claimed - done)
        last = not step or done + ready == scan.claimed
        while ready >= CHUNK_POINTS or (last and ready):
            count = min(ready, CHUNK_POINTS)
            yield _taken(streams, done, count)
            done, ready = done + count, ready - count
        if not step and done < scan.claimed:
            return "" if at >= end else f"the packet at byte {pages.physical(at):,} is damaged"
        at += step
    return fault or _left_over(pages, at, end, order, streams)


def _left_over(pages: Pages, at: int, end: int, order: Sequence[_Stream | None], streams: dict[str, _Stream]) -> str:
    """Return a message if points follow all those that the XML claims; packed numbers may fill up their last byte."""
    while step := _packet(pages, at, end, order):
        at += step
        if min(s.ready for s in streams.values()) >= _FILL_POINTS:
            break
    held = min(s.ready for s in streams.values())
    return "the file holds more points than its XML claims" if held >= _FILL_POINTS else ""


def _taken(streams: dict[str, _Stream], first: int, count: int) -> Points:
    sieve = Sieve(count)
    offsets = np.full(count, -1, dtype=np.int64)
    return Points(first, {n: s.take(count, sieve, offsets) for n, s in streams.items()}, sieve, offsets)


def _section(pages: Pages, scan: Scan) -> tuple[int, int]:
    """Return the logical bytes of a scan's first packet and after its last; (0, 0) where the section is damaged."""
    at = pages.logical(scan.section)
    head = pages.read(at, _SECTION.size)
    if len(head) < _SECTION.size or pages.damaged(at, _SECTION.size):
        return 0, 0
    kind, length, data, _ = _SECTION.unpack(head)
    first = pages.logical(data)
    if kind != _SECTION_ID or not at < first <= pages.size:
        return 0, 0
    return first, min(at + length, pages.size)


def _packet(pages: Pages, at: int, end: int, order: Sequence[_Stream | None]) -> int:
    """Pass a packet's bytes to the streams; return its length, 0 at the end or where its header is damaged."""
    head = pages.read(at, 6)
    if at + 4 > end or len(head) < 4:
        return 0
    kind, length = head[0], int.from_bytes(head[2:4], "little") + 1
    if kind not in {_INDEX_PACKET, _DATA_PACKET, _EMPTY_PACKET} or length % 4 or at + length > end:
        return 0
    lengths_end = 6 + 2 * len(order)
    if pages.damaged(at, lengths_end if kind == _DATA_PACKET else 4):
        return 0
    if kind != _DATA_PACKET:
        return length
    body = pages.read(at, length)
    if int.from_bytes(body[4:6], "little") != len(order) or lengths_end > length:
        return 0
    lengths = np.frombuffer(body, "<u2", len(order), 6).tolist()
    if lengths_end + sum(lengths) > length:
        return 0
    damaged = pages.damaged(at, length)
    start = lengths_end
    for stream, size in zip(order, lengths, strict=True):
        if stream is not None and size:
            bad = [
                (max(a - at - start, 0), min(b - at - start, size), pages.physical(a))
                for a, b in damaged
                if a - at < start + size and b - at > start
            ]
            stream.add(body[start : start + size], bad)
        start += size
    return length
