"""Reads UDP packets of a network capture (PCAP), as lidar makers' recorders write it.

The file is read a few megabytes at a time. A record that is cut off or that is no record costs itself:
reading goes on at the next record that looks like one of the sensor's data packets.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeAlias

from roadscan.core.errors import FormatError, Missing
from roadscan.core.gpstime import NS_PER_S
from roadscan.ingest.reading.format import Reject

PCAPNG: Final = b"\x0a\x0d\x0d\x0a"
MAGICS: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""Byte order, and ns per unit of the records' fractional seconds, by the file's first four bytes."""

_LINK_HEADERS: Final = {0: 4, 1: 14, 101: 0, 113: 16, 228: 0, 276: 20}
"""Bytes before the IP header by link type: BSD loopback, Ethernet, raw IP, Linux cooked, IPv4, Linux cooked 2."""
_ETHERNET: Final = 1  # link type of Ethernet
_VLAN_TAGS: Final = (b"\x81\x00", b"\x88\xa8")
_UDP: Final = 17  # IP protocol number of UDP
_IPV6_FRAGMENT: Final = 44  # IP protocol number of a fragment (RFC 8200)
_MOST_OPEN: Final = 64  # packets whose fragments are waited for: a sensor sends one after another
_IPV4_WITHOUT_OPTIONS: Final = b"\x45"
_MOST_ROUTES: Final = 4096  # routes that are remembered
_READ_BYTES: Final = 4 << 20  # bytes that are read at once
_LARGEST_RECORD: Final = 262_144  # larger records count as damage (bytes)
_RECORD_HEADER: Final = 16  # bytes of a record's header
_FILE_HEADER: Final = 24  # bytes of the file header
_YEAR_S: Final = 365 * 86_400  # a record whose time differs more from the last one's (s) counts as damage


class Datagram(NamedTuple):
    """A UDP packet of the capture."""

    number: int
    """Number of the record, from 0."""
    offset: int
    """Byte at which the record starts."""
    capture_ns: int
    """Time by the recording computer's clock, POSIX ns."""
    sender: str
    """IP address."""
    port: int
    """Port to which it was sent."""
    payload: bytes


_SNIFFED: Final = 1 << 20  # bytes of a file's start that are searched


def capture_start(path: Path) -> bytes:
    """Return the first bytes of a capture (PCAP or PCAPNG); none of any other file."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as stream:
            start = stream.read(_SNIFFED)
    except OSError:
        return b""
    return start if start[:4] in {*MAGICS, PCAPNG} else b""


def need_one_sender(senders: Collection[str], port: int, file: Path) -> None:
    """Raise FormatError where several sensors sent to a port."""
    if len(senders) > 1:
        names = sorted(senders)
        raise FormatError(
            f"{len(names)} sensors sent to port {port}: {', '.join(names)}",
            expected="one sensor a log",
            change="list the capture once a sensor, each with its address as options.sender",
            file=file,
            missing=Missing("options.sender", choices=tuple(names)),
        )


def batches(items: Iterable[Datagram | Reject], size: int) -> Iterator[list[Datagram] | Reject]:
    """Yield lists of `size` packets, the last one shorter, and rejects where they stand between them."""
    pending: list[Datagram] = []
    for item in items:
        if isinstance(item, Reject):
            yield item
            continue
        pending.append(item)
        if len(pending) == size:
            yield pending
            pending = []
    if pending:
        yield pending


_Record: TypeAlias = tuple[int, int, int, bytes]
"""Number, byte offset, capture time (POSIX ns), frame as captured."""
_Route: TypeAlias = tuple[str, int, int, int]
"""Sender, port, and where the payload starts and ends in the frame."""


@dataclass(frozen=True)
class Wanted:
    """Selection of a log's packets in a capture."""

    port: int
    """Port of the data packets."""
    data_bytes: int
    """Length of a sound data packet (bytes)."""
    other_port: int
    """Port of the sensor's other packets."""
    sender: str | None
    """The sensor's IP address; None for any."""
    sole: bool = False
    """True where no other sensor is expected: damaged packets that look like its own are rejected."""


def datagrams(path: Path, wanted: Wanted) -> Iterator[Datagram | Reject]:
    """Yield the wanted packets in file order, and rejects for damaged ones; other traffic is ignored.

    Raises
    ------
    FormatError
        if the file is no capture that can be read.
    """
    try:
        with path.open("rb") as stream:
            yield from _wanted_of(_Capture.of(stream, path), wanted)
    except OSError as error:
        raise FormatError(f"the capture cannot be read: {error.strerror or error}", file=path) from error


def _wanted_of(capture: _Capture, wanted: Wanted) -> Iterator[Datagram | Reject]:
    route_of = _Routes(capture.link).of
    for item in capture.records():
        if isinstance(item, Reject):
            yield item
            continue
        number, offset, capture_ns, frame = item
        route = route_of(frame)
        if route is None:
            if len(frame) == capture.usual_bytes:
                yield Reject("as long as a data packet, and not a UDP packet", number, offset)
            continue
        sender, port, start, end = route
        payload = frame[start:end]
        if wanted.sender is not None and sender != wanted.sender:
            if wanted.sole and port == wanted.port and len(payload) == wanted.data_bytes:
                yield Reject("a data packet came from another sender", number, offset)
            continue
        if port == wanted.port and len(payload) == wanted.data_bytes:
            capture.usual_bytes = len(frame)
        elif port == wanted.port:
            yield Reject(f"a data packet is not {wanted.data_bytes:,} bytes long", number, offset)
            continue
        elif port != wanted.other_port:
            if wanted.sender is not None and len(payload) == wanted.data_bytes:
                yield Reject("a data packet was sent to another port", number, offset)
            continue
        yield Datagram(number, offset, capture_ns, sender, port, payload)


def datagrams_of_sizes(
    path: Path, sizes: Collection[int] | None, port: int | None = None, sender: str | None = None
) -> Iterator[Datagram | Reject]:
    """Yield the packets of some lengths to a port from a sender, in file order; None stands for any.

    Packets in several fragments are put together (RFC 791, RFC 8200): they count as their first one. A record that is
    none, and a packet whose fragments do not all arrive, are rejected; other traffic is ignored.

    Raises
    ------
    FormatError
        if the file is no capture that can be read.
    """
    try:
        with path.open("rb") as stream:
            capture = _Capture.of(stream, path)
            fragments = _Fragments(capture.link)
            for item in capture.records():
                whole = item if isinstance(item, Reject) else fragments.whole(item)
                if isinstance(whole, Reject):
                    yield whole
                elif whole is not None and (found := _route(whole[3], capture.link)) is not None:
                    sent_by, sent_to, start, end = found
                    number, offset, capture_ns, frame = whole
                    wanted = (port in {None, sent_to}) and (sender in {None, sent_by})
                    if not wanted or (sizes is not None and end - start not in sizes):
                        continue
                    if len(frame) < end:
                        yield Reject("the packet is cut off", number, offset)
                        continue
                    if not isinstance(item, Reject):
                        capture.usual_bytes = len(item[3])
                    yield Datagram(number, offset, capture_ns, sent_by, sent_to, frame[start:end])
            yield from fragments.rejects()
    except OSError as error:
        raise FormatError(f"the capture cannot be read: {error.strerror or error}", file=path) from error


@dataclass
class _Fragments:
    """Puts packets together that were sent in fragments."""

    link: int
    _open: dict[bytes, dict[int, tuple[bytes, bool]]] = field(default_factory=dict)
    """Bytes by their offset, and whether more follow, of each packet that is not complete."""
    _first: dict[bytes, _Record] = field(default_factory=dict)
    """The record of each packet's first fragment to arrive."""
    _lost: list[Reject] = field(default_factory=list)

    def whole(self, record: _Record) -> _Record | None:
        """Return the record with its whole packet; None for a fragment while others are missing."""
        frame = record[3]
        ip = _ip_start(frame, self.link)
        if len(frame) < ip + 28:
            return record
        if frame[ip] >> 4 == 4:
            word = int.from_bytes(frame[ip + 6 : ip + 8], "big")
            start, more, head = (word & 0x1FFF) * 8, bool(word & 0x2000), ip + 4 * (frame[ip] & 0x0F)
            end = ip + int.from_bytes(frame[ip + 2 : ip + 4], "big")
            key, protocol = frame[ip + 4 : ip + 6] + frame[ip + 9 : ip + 10] + frame[ip + 12 : ip + 20], frame[ip + 9]
        elif frame[ip] >> 4 == 6 and frame[ip + 6] == _IPV6_FRAGMENT and len(frame) >= ip + 48:
            word = int.from_bytes(frame[ip + 42 : ip + 44], "big")
            start, more, head, protocol = word & 0xFFF8, bool(word & 1), ip + 48, frame[ip + 40]
            end = ip + 40 + int.from_bytes(frame[ip + 4 : ip + 6], "big")
            key = frame[ip + 44 : ip + 48] + frame[ip + 8 : ip + 40]
        else:
            return record
        if protocol != _UDP or (start == 0 and not more and frame[ip] >> 4 == 4):
            return record
        parts = self._open.setdefault(key, {})
        parts[start] = frame[head:end], more
        first = self._first.setdefault(key, record)
        body = _body(parts)
        if body is None:
            self._forget()
            return None
        del self._open[key], self._first[key]
        # As one packet without options: a link header, then IPv4 or IPv6 with the addresses, then UDP.
        header = bytearray(first[3][: ip + (20 if frame[ip] >> 4 == 4 else 40)])
        if frame[ip] >> 4 == 4:
            header[ip], header[ip + 6 : ip + 8] = 0x45, b"\0\0"
        else:
            header[ip + 6] = _UDP
        return (*first[:3], bytes(header) + body)

    def _forget(self) -> None:
        """Give up the oldest packet where too many are open."""
        if len(self._open) > _MOST_OPEN:
            key = next(iter(self._open))
            number, offset, _, _ = self._first.pop(key)
            self._lost.append(Reject("fragments of the packet are missing", number, offset, len(self._open.pop(key))))

    def rejects(self) -> Iterator[Reject]:
        """Yield the packets that were not completed."""
        yield from self._lost
        for key, (number, offset, _, _) in self._first.items():
            yield Reject("fragments of the packet are missing", number, offset, len(self._open[key]))


def _body(parts: dict[int, tuple[bytes, bool]]) -> bytes | None:
    """Return the bytes of fragments that follow one another up to the last; None where some are missing."""
    out, at = [], 0
    while at in parts:
        content, more = parts[at]
        out.append(content)
        if not more:
            return b"".join(out)
        at += max(len(content), 1)
    return None


def _ip_start(frame: bytes, link: int) -> int:
    """Return where the IP header begins."""
    at = _LINK_HEADERS[link]
    if link == _ETHERNET:
        while frame[at - 2 : at] in _VLAN_TAGS:
            at += 4
    return at


@dataclass
class _Capture:
    """Records of a PCAP file (IETF draft-ietf-opsawg-pcap)."""

    stream: BinaryIO
    order: str
    tick_ns: int
    link: int
    usual_bytes: int = 0
    """Captured length of a data packet, once known: reading resumes at such a record after damage."""
    _seconds: int = -1
    """Capture time of the last sound record (POSIX s)."""
    _buffer: bytes = b""
    _at: int = 0
    """Position in the buffer."""
    _whole: int = 0
    """Position before which a record that begins is in the buffer as a whole."""
    _base: int = _FILE_HEADER
    """File offset of the buffer."""

    @classmethod
    def of(cls, stream: BinaryIO, path: Path) -> _Capture:
        """Read the file header."""
        head = stream.read(_FILE_HEADER)
        if head[:4] == PCAPNG:
            raise FormatError(
                "the capture is PCAPNG",
                expected="PCAP",
                change="convert it: editcap -F pcap in.pcapng out.pcap",
                file=path,
            )
        if head[:4] not in MAGICS or len(head) < _FILE_HEADER:
            raise FormatError("the file is not a PCAP capture", expected="a PCAP file header", file=path)
        order, tick_ns = MAGICS[head[:4]]
        link = struct.unpack(order + "I", head[20:24])[0] & 0xFFFF
        if link not in _LINK_HEADERS:
            raise FormatError(
                f"the capture's link type is {link}",
                expected="Ethernet (1), raw IP (101, 228), Linux cooked (113, 276) or loopback (0)",
                file=path,
            )
        return cls(stream, order, tick_ns, link)

    def records(self) -> Iterator[_Record | Reject]:
        """Yield all records in file order; bytes that are no record are skipped to the next data packet."""
        unpack = struct.Struct(self.order + "IIII").unpack_from
        number = 0
        while self._at < self._whole or self._fill():
            at, start = self._at, self._base + self._at
            if len(self._buffer) - at < _RECORD_HEADER:
                yield Reject("the record is cut off", number, start)
                return
            seconds, ticks, kept, whole = unpack(self._buffer, at)
            body = at + _RECORD_HEADER
            if kept > whole or kept > _LARGEST_RECORD or ticks * self.tick_ns >= NS_PER_S:
                self._resynchronise()
                yield Reject("no packet record; bytes skipped to the next data packet", number, start)
            elif body + kept > len(self._buffer):
                yield Reject("the record is cut off", number, start)
                return
            else:
                self._seconds, self._at = seconds, body + kept
                yield number, start, seconds * NS_PER_S + ticks * self.tick_ns, self._buffer[body : self._at]
            number += 1

    def _fill(self) -> bool:
        """Read the next record into the buffer; return False at the file's end."""
        if len(self._buffer) - self._at < _RECORD_HEADER + _LARGEST_RECORD:
            more = self.stream.read(_READ_BYTES)
            if more:
                self._drop(self._at)
                self._buffer += more
            self._whole = len(self._buffer) - _RECORD_HEADER - _LARGEST_RECORD
        return self._at < len(self._buffer)

    def _drop(self, count: int) -> None:
        """Discard the buffer's first `count` bytes."""
        self._buffer = self._buffer[count:]
        self._whole = 0
        self._base += count
        self._at -= count

    def _resynchronise(self) -> None:
        """Skip to the next record of a data packet, or to the file's end."""
        self._at += 1
        if not self.usual_bytes:
            self._at = len(self._buffer)  # the usual length is not known yet: the buffer is lost
            return
        lengths = struct.pack(self.order + "II", self.usual_bytes, self.usual_bytes)
        while True:
            found = self._buffer.find(lengths, self._at + 8)
            if found >= 0:
                self._at = found - 8
                seconds = struct.unpack_from(self.order + "I", self._buffer, self._at)[0]
                if abs(seconds - self._seconds) < _YEAR_S:
                    return
                self._at += 1
                continue
            self._at = max(self._at, len(self._buffer) - _RECORD_HEADER)
            more = self.stream.read(_READ_BYTES)
            if not more:
                self._at = len(self._buffer)
                return
            self._drop(self._at)
            self._buffer += more


@dataclass
class _Routes:
    """Finds UDP payloads in frames; frames that only differ in their payload are parsed once."""

    link: int
    _known: dict[tuple[int, bytes, bytes, bytes], _Route | None] = field(default_factory=dict)

    def of(self, frame: bytes) -> _Route | None:
        """Return the route of a frame, None for anything but UDP."""
        ip = _LINK_HEADERS[self.link]
        # Link header and version; protocol; addresses, ports and length: all that determines the route.
        key = (len(frame), frame[: ip + 1], frame[ip + 9 : ip + 10], frame[ip + 12 : ip + 26])
        if key in self._known:
            return self._known[key]
        route = _route(frame, self.link)
        plain = frame[ip : ip + 1] == _IPV4_WITHOUT_OPTIONS and frame[max(0, ip - 2) : ip] not in _VLAN_TAGS
        if plain and len(self._known) < _MOST_ROUTES:
            self._known[key] = route
        return route


def _route(frame: bytes, link: int) -> _Route | None:
    at = _ip_start(frame, link)
    if len(frame) < at + 28:
        return None
    version = frame[at] >> 4
    if version == 4 and frame[at + 9] == _UDP:
        sender = ".".join(map(str, frame[at + 12 : at + 16]))
        at += 4 * (frame[at] & 0x0F)
    elif version == 6 and frame[at + 6] == _UDP:
        sender = frame[at + 8 : at + 24].hex(":", 2)
        at += 40
    else:
        return None
    if len(frame) < at + 8:
        return None
    port, length = struct.unpack_from(">HH", frame, at + 2)
    return sender, port, at + 8, at + max(8, length)
