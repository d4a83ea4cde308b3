"""Writes E57 files byte by byte as ASTM E2807 lays them out, apart from the reader and from any library."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

PAGE = 1024
PAYLOAD = PAGE - 4


def crc32c(data: bytes) -> int:
    """CRC-32C bit by bit (RFC 3720, appendix B.4: 32 bytes of zeros give 0x8A9136AA)."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (0x82F63B78 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def paged(logical: bytes) -> bytes:
    """Pages with their checksums (big-endian, behind 1,020 bytes)."""
    logical += bytes(-len(logical) % PAYLOAD)
    parts = [logical[at : at + PAYLOAD] for at in range(0, len(logical), PAYLOAD)]
    return b"".join(part + struct.pack(">I", crc32c(part)) for part in parts)


def physical(logical: int) -> int:
    return logical // PAYLOAD * PAGE + logical % PAYLOAD


@dataclass
class Column:
    """A field of the prototype: its XML attributes, and its raw numbers (or floats) packed lowest bit first."""

    name: str
    attributes: str
    values: Sequence[float]
    bits: int
    low: int = 0
    form: str = ""

    def packed(self, first: int, end: int) -> bytes:
        if self.form:
            return struct.pack(f"<{end - first}{self.form}", *self.values[first:end])
        number = 0
        for k, value in enumerate(self.values[first:end]):
            number |= (int(value) - self.low) << (k * self.bits)
        return number.to_bytes(-(-(end - first) * self.bits // 8), "little")


def double(name: str, values: Sequence[float]) -> Column:
    return Column(name, 'type="Float"', values, 64, form="d")


def single(name: str, values: Sequence[float]) -> Column:
    return Column(name, 'type="Float" precision="single"', values, 32, form="f")


def integer(name: str, values: Sequence[float], low: int, high: int, more: str = "") -> Column:
    kind = "ScaledInteger" if more else "Integer"
    bits = (high - low).bit_length()
    return Column(name, f'type="{kind}" minimum="{low}" maximum="{high}" {more}', values, bits, low)


@dataclass
class ScanSpec:
    columns: list[Column]
    more: str = ""
    """Further XML of the scan (pose, limits, start)."""
    per_packet: int = 80
    """Points a packet; a multiple of 8, so that no packet ends inside a byte."""
    claimed: int | None = None
    lengths: list[int] = field(default_factory=list)
    """Logical bytes at which its packets start, once written."""

    @property
    def count(self) -> int:
        return len(self.columns[0].values)


def e57(*scans: ScanSpec, root: str = "") -> bytes:
    """The whole file."""
    body = bytes(48)
    xml = []
    for number, scan in enumerate(scans, 1):
        body += bytes(-len(body) % 4)
        section = len(body)
        packets = b""
        scan.lengths.clear()
        for first in range(0, scan.count, scan.per_packet):
            end = min(first + scan.per_packet, scan.count)
            streams = [c.packed(first, end) for c in scan.columns]
            data = struct.pack(f"<{len(streams)}H", *map(len, streams)) + b"".join(streams)
            data += bytes(-(6 + len(data)) % 4)
            scan.lengths.append(section + 32 + len(packets))
            packets += struct.pack("<BBHH", 1, 0, 6 + len(data) - 1, len(streams)) + data
        packets += struct.pack("<BBHH10x", 0, 0, 15, 0)  # an index packet without entries
        body += struct.pack("<B7xQQQ", 1, 32 + len(packets), physical(section + 32), 0) + packets
        fields = "".join(f"<{c.name} {c.attributes}/>" for c in scan.columns)
        claimed = scan.count if scan.claimed is None else scan.claimed
        xml.append(
            f'<vectorChild type="Structure"><guid type="String">{number}</guid><name type="String">scan {number}</name>'
            f'<points type="CompressedVector" fileOffset="{physical(section)}" recordCount="{claimed}">'
            f'<prototype type="Structure">{fields}</prototype><codecs type="Vector"/></points>{scan.more}</vectorChild>'
        )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><e57Root type="Structure" '
        'xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0" xmlns:nor="http://www.libe57.org/E57_NOR_surface_normals.txt">'
        f'{root}<data3D type="Vector">{"".join(xml)}</data3D></e57Root>'
    ).encode()
    start = len(body)
    size = -(-(start + len(text)) // PAYLOAD) * PAGE
    head = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, size, physical(start), len(text), PAGE)
    return paged(head + body[48:] + text)


def pose(w: float, x: float, y: float, z: float, *shift: float) -> str:
    rotation = "".join(f'<{n} type="Float">{v!r}</{n}>' for n, v in zip("wxyz", (w, x, y, z), strict=True))
    moved = "".join(f'<{n} type="Float">{v!r}</{n}>' for n, v in zip("xyz", shift, strict=True))
    return (
        f'<pose type="Structure"><rotation type="Structure">{rotation}</rotation>'
        f'<translation type="Structure">{moved}</translation></pose>'
    )


def start(gps_s: float) -> str:
    return (
        f'<acquisitionStart type="Structure"><dateTimeValue type="Float">{gps_s!r}</dateTimeValue>'
        '<isAtomicClockReferenced type="Integer">1</isAtomicClockReferenced></acquisitionStart>'
    )


def limits(group: str, **named: tuple[float, float]) -> str:
    inner = "".join(
        f'<{n}Minimum type="Float">{a}</{n}Minimum><{n}Maximum type="Float">{b}</{n}Maximum>'
        for n, (a, b) in named.items()
    )
    return f'<{group} type="Structure">{inner}</{group}>'


def small_e57() -> bytes:
    """A sound file of two scans and 640 points, for damaging."""
    k = range(400)
    colour = [integer(f"color{c}", [v % 256 for v in k], 0, 255) for c in ("Red", "Green", "Blue")]
    one = ScanSpec(
        [
            double("cartesianX", [0.5 * v for v in k]),
            integer("cartesianY", [v - 200 for v in k], -200, 199, 'scale="0.001" offset="5"'),
            single("cartesianZ", [2.0] * 400),
            integer("intensity", [v % 1000 for v in k], 0, 999),
            integer("cartesianInvalidState", [2 * (v == 7) for v in k], 0, 2),
            single("timeStamp", [v / 64 for v in k]),
            *colour,
        ],
        pose(0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0) + start(1.4e9) + limits("intensityLimits", intensity=(0, 999)),
    )
    two = ScanSpec([double(f"cartesian{a}", [float(v) for v in range(240)]) for a in "XYZ"], start(1.4e9 + 60))
    return e57(one, two)
