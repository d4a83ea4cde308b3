"""Finds ASCII messages of NovAtel's receivers, checks their CRC-32, and converts their fields to numbers.

``#NAME,port,sequence,idle,time status,week,seconds,…;fields*crc`` or, with a short header,
``%NAME,week,seconds;fields*crc``. The CRC has the polynomial 0xEDB88320, starts at 0, is not inverted at its end, and
covers what stands between the ``#`` or ``%`` and the ``*`` (NovAtel, OEM7 documentation, "32-bit CRC").
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.gpstime import NS_PER_S, WEEK_S
from roadscan.ingest.reading.format import Reject
from roadscan.ingest.reading.records import Sieve, few_rejects
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, head_of, line_blocks, parse_lines

FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    "INSPVAXA": (
        "status", "type", "latitude", "longitude", "above_sea", "undulation", "north", "east", "up", "roll", "pitch",
        "azimuth", "sigma_latitude", "sigma_longitude", "sigma_height", "sigma_north", "sigma_east", "sigma_up",
        "sigma_roll", "sigma_pitch", "sigma_azimuth", "extended", "age",
    ),
    "INSPVAA": (
        "pose_week", "pose_seconds", "latitude", "longitude", "height", "north", "east", "up", "roll", "pitch",
        "azimuth", "status",
    ),
    "BESTPOSA": (
        "status", "type", "latitude", "longitude", "above_sea", "undulation", "datum", "sigma_latitude",
        "sigma_longitude", "sigma_height", "station", "differential_age", "age", "tracked", "used", "used_l1",
        "used_multi", "reserved", "extended", "galileo", "gps",
    ),
}  # fmt: skip
"""Fields of each message in their order (NovAtel, OEM7 documentation, page of the message)."""
FIELDS_OF_SHORT: Final = {"INSPVASA": "INSPVAA"}
"""Messages with a short header, and those with the same fields."""
WORDS: Final = frozenset({"status", "type", "datum", "station", "extended", "reserved", "galileo", "gps"})
"""Fields that are no numbers."""
_MESSAGE: Final = re.compile(rb"([#%])([A-Z0-9]+),([^;*#%\r\n]*);([^*#%\r\n]*)\*([0-9a-fA-F]{8})")
_NO_CRC_END: Final = 0xFFFFFFFF  # makes of zlib's CRC, which starts and ends inverted, NovAtel's
_KNOWN_TIMES: Final = frozenset(
    {b"FINE", b"FINEADJUSTING", b"FINESTEERING", b"FINEBACKUPSTEERING", b"FREEWHEELING", b"SATTIME"}
)
"""Time status of a clock that is good to a microsecond or so. Short headers state none."""
_OTHERS: Final = re.compile(rb"\$[^*]*\*[0-9A-Fa-f]{2}\s*$|[<\[]")
"""NMEA, and a receiver's answers and prompts."""
HEAD_BYTES: Final = 1 << 20  # bytes from which the messages of a log are counted


def counted_messages(path: Path) -> Counter[str]:
    """Return how many sound messages of each kind that is read the beginning of a file holds."""
    head = head_of(path, HEAD_BYTES) if path.is_file() else b""
    known = {*FIELDS, *FIELDS_OF_SHORT}
    return Counter(name for m in _MESSAGE.finditer(head) if (name := m[2].decode("ascii")) in known and _is_sound(m))


def message_blocks(path: Path, name: str) -> Iterator[TextBlock | Reject]:
    """Yield the fields of all messages of a name, block by block.

    Besides the fields, a block has the columns `week` and `seconds` of the messages' headers. A record is a line. A
    message with a wrong CRC, or written before the time was known, becomes a reject, and so does a line of anything but
    sound messages, NMEA and the receiver's answers.
    """
    fields = ("week", "seconds", *FIELDS[FIELDS_OF_SHORT.get(name, name)])
    layout = TextLayout(fields, ",", "", 0)
    kinds: dict[str, Kind] = {field: "text" if field in WORDS else "number" for field in fields}
    first = 0
    for offset, data in line_blocks(path):
        if isinstance(data, Reject):
            yield Reject(data.reason, first, offset)
            first += 1
            continue
        lines = data.splitlines(keepends=True)
        found = list(_found(lines, name.encode(), first, offset))
        first += len(lines)
        yield from few_rejects([one for one in found if isinstance(one, Reject)])
        rows = [one for one in found if not isinstance(one, Reject)]
        if rows:
            ends = np.cumsum([len(line) for line, *_ in rows], dtype=np.int64)
            numbers, offsets = np.array([place for _, *place in rows], dtype=np.int64).T
            starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
            yield from parse_lines(b"".join(line for line, *_ in rows), starts, ends, layout, kinds, numbers, offsets)


def _found(lines: Sequence[bytes], name: bytes, first: int, offset: int) -> Iterator[tuple[bytes, int, int] | Reject]:
    """Yield week, seconds and fields of each message of a name as a line of a table, with its record and offset."""
    for record, line in enumerate(lines, first):
        messages = [message for message in _MESSAGE.finditer(line) if message[2] == name or _is_sound(message)]
        for message in messages:
            if message[2] == name:
                reason, row = _row(message)
                place = record, offset + message.start()
                yield Reject(reason, *place) if reason else (row, *place)
        if not messages and line.strip() and not _OTHERS.match(line):
            yield Reject("the line holds no sound message", record, offset)
        offset += len(line)


def _is_sound(message: re.Match[bytes]) -> bool:
    body = message.string[message.start(2) : message.start(5) - 1]
    return zlib.crc32(body, _NO_CRC_END) ^ _NO_CRC_END == int(message[5], 16)


def _row(message: re.Match[bytes]) -> tuple[str, bytes]:
    """Return why a message is not used, or its week, seconds and fields."""
    if not _is_sound(message):
        return "the CRC-32 of the message is wrong", b""
    header = message[3].split(b",")
    is_short = message[1] == b"%"
    if len(header) < (2 if is_short else 6):
        return "the header of the message lacks the time", b""
    if not is_short and header[3] not in _KNOWN_TIMES:
        return f"the receiver did not know its time well yet: {header[3][:20].decode('ascii', 'replace')}", b""
    time = header[:2] if is_short else header[4:6]
    return "", b",".join([*time, message[4].replace(b'"', b"")]) + b"\n"


def epochs_ns(block: TextBlock, sieve: Sieve) -> Int64:
    """Return GPS time (ns since 1980, (n,)) of a block's messages; those with an impossible one are dropped.

    INSPVA states the time of its pose to the nanosecond beside that of its header, which is rounded to milliseconds.
    """
    names = ("pose_week", "pose_seconds") if "pose_week" in block.columns else ("week", "seconds")
    week, seconds = (block.number(name) for name in names)
    sieve.require("week", week, 0.0, 8191.0, "weeks")
    sieve.require("seconds", seconds, 0.0, float(WEEK_S), "s")
    whole = np.where(sieve.good, week, 0.0).astype(np.int64) * (WEEK_S * NS_PER_S)
    return np.asarray(whole + np.rint(np.where(sieve.good, seconds, 0.0) * NS_PER_S).astype(np.int64), np.int64)
