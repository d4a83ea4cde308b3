"""Logs of NovAtel receivers: their messages, positions (BESTPOS) and poses (INSPVA)."""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64
from roadscan.core.errors import FormatError
from roadscan.core.gpstime import NS_PER_S, WEEK_S
from roadscan.core.strict import Strict
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, UNKNOWN_QUALITY, GnssReader, RawSolutions, gps_clock
from roadscan.ingest.reading.poses import GeodeticPlacement, PoseReader, RawPoses, check_rph, ned_from_rph
from roadscan.ingest.reading.records import EpochReader, Sieve, few_rejects, options_of
from roadscan.ingest.reading.text_table import Kind, TextBlock, TextLayout, head_of, line_blocks, parse_lines

# `#NAME,port,sequence,idle,time status,week,seconds,…;fields*crc`; a short header is `%NAME,week,seconds;`. The CRC-32
# has the polynomial 0xEDB88320, starts at 0, is not inverted at its end, and covers what stands between the `#` or `%`
# and the `*` (NovAtel, OEM7 documentation, "32-bit CRC").
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


_QUALITIES: Final = {
    "NONE": "none", "FIXEDPOS": "manual", "FIXEDHEIGHT": "manual", "SINGLE": "single", "PSRDIFF": "dgps",
    "WAAS": "sbas", "PROPAGATED": "dead_reckoning", "OMNISTAR": "dgps", "CDGPS": "dgps", "L1_FLOAT": "float",
    "IONOFREE_FLOAT": "float", "NARROW_FLOAT": "float", "L1_INT": "fixed", "WIDE_INT": "fixed", "NARROW_INT": "fixed",
    "RTK_DIRECT_INS": "fixed", "INS_SBAS": "sbas", "INS_PSRSP": "single", "INS_PSRDIFF": "dgps",
    "INS_RTKFLOAT": "float", "INS_RTKFIXED": "fixed", "PPP_CONVERGING": "ppp", "PPP": "ppp", "OPERATIONAL": "single",
    "WARNING": "single", "OUT_OF_BOUNDS": "none", "INS_PPP_CONVERGING": "ppp", "INS_PPP": "ppp",
    "PPP_BASIC_CONVERGING": "ppp", "PPP_BASIC": "ppp", "INS_PPP_BASIC_CONVERGING": "ppp", "INS_PPP_BASIC": "ppp",
}  # fmt: skip
"""Quality by position type (NovAtel, OEM7 documentation, "Position or Velocity Type")."""


class NovatelBestpos(LogFormat):
    """A BESTPOS message a position; anything else may stand between them.

    Latitude, longitude, height above the geoid and the geoid's undulation, whose sum is the ellipsoidal height, σ, age
    of corrections and satellites. The CRC-32 of each message is checked. A message without a computed solution has
    quality 'none'. The datum is the receiver's or its corrections': state it as crs.
    """

    name = "novatel_bestpos"
    title = "NovAtel log (ASCII): positions of BESTPOS"
    yields = ("gnss",)
    time = "GPS week and seconds, in each message"

    def sniff(self, path: Path) -> bool:
        """True if the beginning holds a sound BESTPOS, and no pose of an INS."""
        counts = counted_messages(path)
        return counts["BESTPOSA"] > 0 and not any(name.startswith("INSPVA") for name in counts)

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights."""
        source.need_file()
        gps_clock(source, "NovAtel's messages state")
        if not counted_messages(source.path)["BESTPOSA"]:
            raise FormatError("the beginning holds no sound BESTPOSA message", expected="one", file=source.path)
        return LogHeader({"world_frame": _placement(source, _BY_BESTPOS).world, "read": "BESTPOSA"})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a damaged message is rejected."""
        reader = GnssReader(source, _placement(source, _BY_BESTPOS))
        epochs = EpochReader(gps_clock(source, "NovAtel's messages state"), source.path)
        for block in message_blocks(source.path, "BESTPOSA"):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = epochs.epochs(epochs_ns(block, sieve), sieve, block.records)
            yield from reader.items(_solutions(block, stamps, sieve), sieve)


_BY_BESTPOS: Final = "BESTPOS, whose height and undulation are added"
_BY_DEFINITION: Final = "the definition of NovAtel's messages"


def _placement(source: LogSource, by: str) -> GeodeticPlacement:
    """Return the placement of ellipsoidal heights, which `by` (what defines them, in words) states."""
    placement = GeodeticPlacement(source.need_crs(), "ellipsoidal", None, source.path)
    source.need_height("ellipsoidal", by)
    return placement


def _solutions(block: TextBlock, epochs: npt.NDArray[np.int64], sieve: Sieve) -> RawSolutions:
    codes = {word: QUALITIES.index(name) for word, name in _QUALITIES.items()}
    solved = [word == "SOL_COMPUTED" for word in block.text("status")]
    quality = np.where(solved, [codes.get(word, UNKNOWN_QUALITY) for word in block.text("type")], 0).astype(np.int64)
    sieve.drop(quality == UNKNOWN_QUALITY, "the type of the position is unknown")
    quality[quality == UNKNOWN_QUALITY] = NO_POSITION
    with np.errstate(over="ignore"):  # of damaged records, which their limits drop
        height = block.number("above_sea") + block.number("undulation")
    position = np.stack([*(np.radians(block.number(name)) for name in ("longitude", "latitude")), height])
    columns = {
        "satellites": block.number("used"),
        "sigma_north_m": block.number("sigma_latitude"),
        "sigma_east_m": block.number("sigma_longitude"),
        "sigma_down_m": block.number("sigma_height"),
        "age_s": block.number("differential_age"),
    }
    return RawSolutions(block.records, block.offsets, epochs, position, quality, columns)


SOLVED: Final = frozenset({"INS_SOLUTION_GOOD", "INS_ALIGNMENT_COMPLETE", "INS_SOLUTION_FREE", "INS_HIGH_VARIANCE"})
"""Inertial solution status of poses: before, the INS aligns."""
_SIGMAS: Final = {
    "sigma_north_m": "sigma_latitude", "sigma_east_m": "sigma_longitude", "sigma_down_m": "sigma_height",
    "sigma_roll_deg": "sigma_roll", "sigma_pitch_deg": "sigma_pitch", "sigma_heading_deg": "sigma_azimuth",
}  # fmt: skip


class NovatelInsOptions(Strict):
    """Settings of `novatel_ins`."""

    message: Literal["INSPVAXA", "INSPVAA", "INSPVASA"] | None = None
    """Message that the poses come from, where a log holds several; the one that its beginning holds most often where
    left out, INSPVAXA before others of the same number, for it states σ."""


class NovatelIns(LogFormat):
    """A message a pose; anything else may stand between them.

    INSPVAX states position, velocity and attitude with their σ, its height above the geoid with the geoid's undulation,
    whose sum is the ellipsoidal height; INSPVA and INSPVAS state the ellipsoidal height and no σ. Roll turns about the
    forward axis, pitch about the right one, azimuth counts clockwise from true north, in degrees. The CRC-32 of each
    message is checked. Poses of an INS that still aligns are rejected; INS_HIGH_VARIANCE and INS_SOLUTION_FREE are
    poses. The datum is the receiver's or its corrections': state it as crs. GNSS positions in the same log (BESTPOS)
    are read with format = "novatel_bestpos".
    """

    name = "novatel_ins"
    title = "NovAtel SPAN log (ASCII): position, velocity and attitude of INSPVAX, INSPVA or INSPVAS"
    yields = ("trajectory",)
    time = "GPS week and seconds, in each message; of INSPVA and INSPVAS those of the pose, not of the header"
    options = NovatelInsOptions

    def sniff(self, path: Path) -> bool:
        """True if the beginning holds a sound message with a pose."""
        return any(name.startswith("INSPVA") for name in counted_messages(path))

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and choose the message."""
        source.need_file()
        counts = counted_messages(source.path)
        message = _message(source)
        gps_clock(source, "NovAtel's messages state")
        others = ", ".join(name for name in counts if name != message)
        attributes = {"world_frame": _placement(source, _BY_DEFINITION).world, "read": message}
        return LogHeader(attributes | ({"not_read": others} if others else {}))

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a damaged message, and one without a solution, is rejected."""
        reader = PoseReader(source, gps_clock(source, "NovAtel's messages state"), _placement(source, _BY_DEFINITION))
        for block in message_blocks(source.path, _message(source)):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            yield from reader.items(_poses(block, sieve), sieve)


def _message(source: LogSource) -> str:
    stated = options_of(source, NovatelInsOptions).message
    counts = counted_messages(source.path)
    found = [name for name in (*FIELDS, *FIELDS_OF_SHORT) if name.startswith("INSPVA") and counts[name]]
    if stated is None and not found:
        raise FormatError(
            "the beginning holds no sound INSPVAXA, INSPVAA or INSPVASA message",
            expected="one, with its right CRC-32",
            change="log INSPVAXA, or convert a binary log with NovAtel Convert",
            file=source.path,
        )
    return stated or max(found, key=lambda name: counts[name])


def _poses(block: TextBlock, sieve: Sieve) -> RawPoses:
    columns = block.columns
    status = np.array(block.text("status"))
    for word in np.unique(status[~np.isin(status, list(SOLVED))]):
        sieve.drop(status == word, f"no solution yet: {word[:40]}")
    roll, pitch, azimuth = (np.radians(block.number(name)) for name in ("roll", "pitch", "azimuth"))
    check_rph(roll, pitch, azimuth, sieve)
    with np.errstate(invalid="ignore", over="ignore"):  # of damaged records, dropped above or below
        attitude = ned_from_rph(roll, pitch, azimuth)
        position = np.stack([*(np.radians(block.number(name)) for name in ("longitude", "latitude")), height_m(block)])
    sigmas = {name: block.number(field) for name, field in _SIGMAS.items() if field in columns}
    velocity = np.stack([block.number("north"), block.number("east"), -block.number("up")])
    return RawPoses(block.records, block.offsets, epochs_ns(block, sieve), position, attitude, sigmas, velocity)


def height_m(block: TextBlock) -> npt.NDArray[np.float64]:
    """Return the ellipsoidal height (m, (n,)): as stated, or the height above the geoid and its undulation."""
    if "height" in block.columns:
        return block.number("height")
    return block.number("above_sea") + block.number("undulation")
