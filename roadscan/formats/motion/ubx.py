"""UBX, the binary log of u-blox receivers: its navigation solutions (NAV-PVT)."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError
from roadscan.core.gpstime import Clock
from roadscan.formats.motion.nmea import Nmea
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, GnssReader, RawSolutions, utc_clock
from roadscan.ingest.reading.poses import GeodeticPlacement
from roadscan.ingest.reading.records import EpochReader, Sieve
from roadscan.ingest.reading.text_table import head_of

HEADER: Final = b"\xb5\x62\x01\x07\x5c\x00"
"""Sync characters, class, identifier and length of a NAV-PVT with a payload of 92 bytes (protocol 15 and later)."""
SOLUTION: Final = np.dtype(
    [
        ("sync", "V6"), ("itow_ms", "<u4"), ("year", "<u2"), ("month", "u1"), ("day", "u1"), ("hour", "u1"),
        ("minute", "u1"), ("second", "u1"), ("valid", "u1"), ("sigma_time_ns", "<u4"), ("nano", "<i4"), ("fix", "u1"),
        ("flags", "u1"), ("flags2", "u1"), ("satellites", "u1"), ("longitude", "<i4"), ("latitude", "<i4"),
        ("height_mm", "<i4"), ("above_sea_mm", "<i4"), ("sigma_horizontal_mm", "<u4"), ("sigma_vertical_mm", "<u4"),
        ("velocity_mm_per_s", "<i4", 3), ("speed_mm_per_s", "<i4"), ("course", "<i4"), ("sigma_speed_mm_per_s", "<u4"),
        ("sigma_course", "<u4"), ("pdop", "<u2"), ("flags3", "<u2"), ("rest", "V12"), ("checksum", "u1", 2),
    ]
)  # fmt: skip
"""NAV-PVT in u-blox's interface description (UBX-18010854, 5.14.19), with the checksum of its frame."""
_DATED: Final = 0b011
"""Bits of `valid`: date and time of day are known."""
_FIXED_OK: Final = 1  # bit of `flags`: the fix is valid
_INVALID_PLACE: Final = 1  # bit of `flags3` (invalidLlh): longitude, latitude and height are not valid
_FIX_KINDS: Final = {1: "dead_reckoning", 2: "none", 3: "single", 4: "single", 0: "none", 5: "none"}
"""Quality by `fix`: a 2D fix has no height, and a time-only fix no position."""
_CARRIER: Final = {1: "float", 2: "fixed"}  # quality by the carrier solution in `flags`
_UNIX_DAY: Final = dt.date(1970, 1, 1).toordinal()  # ordinal of 1970-01-01
_SNIFF_BYTES: Final = 1 << 16  # bytes from which the format is recognised
_BLOCK_BYTES: Final = 4 << 20  # bytes that are read at once
RAW: Final = b"\xb5\x62\x02\x15"
"""Sync characters, class and identifier of RXM-RAWX, the raw measurements."""
RAW_WAY: Final = "raw measurements (RXM-RAWX), of which `roadscan ppk` computes positions"
_NMEA: Final = re.compile(rb"\$G[A-Z]GGA,")


class Ubx(LogFormat):
    """Frames of UBX, between which sentences of NMEA and other bytes may stand.

    NAV-PVT gives UTC, position with its ellipsoidal height, velocity, σ of both, kind of the solution and satellites.
    Other messages are passed over, and so is NMEA: NAV-PVT states the same with more decimals. Raw measurements
    (RXM-RAWX) are named: `roadscan ppk` computes positions of them. A log whose beginning holds sentences of NMEA
    that state positions is read as `nmea` unless format = "ubx" is stated. A record is a NAV-PVT.
    σ of the plane is divided between north and east. The datum is the receiver's or its corrections': state it as crs.
    """

    name = "ubx"
    title = "u-blox recording (UBX): navigation solutions of NAV-PVT"
    version = 2
    yields = ("gnss",)
    time = "UTC by its nature, with its date"

    def sniff(self, path: Path) -> bool:
        """True if the beginning holds a sound NAV-PVT, and no NMEA log."""
        head = head_of(path, _SNIFF_BYTES) if path.is_file() else b""
        found = _frames(head, _starts(head))
        return bool(found.size and _sound(found).any()) and not Nmea().sniff(path)

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and say what stands beside the solutions."""
        source.need_file()
        placement = _placement(source)
        _clock(source)
        head = head_of(source.path, _SNIFF_BYTES)
        if HEADER[:2] not in head:
            raise FormatError("the beginning holds no UBX message", expected="bytes b5 62", file=source.path)
        attributes = {"world_frame": placement.world, "read": "UBX NAV-PVT"}
        others = {"NMEA sentences between the UBX messages": bool(_NMEA.search(head)), RAW_WAY: RAW in head}
        if any(others.values()):
            attributes["not_read"] = "; ".join(words for words, is_there in others.items() if is_there)
        return LogHeader(attributes)

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream solutions; one that is damaged, has no date and time or an invalid position is rejected."""
        reader, epochs = GnssReader(source, _placement(source)), EpochReader(_clock(source), source.path)
        number = 0
        for offsets, frames in _blocks(source.path):
            records = number + np.arange(frames.size, dtype=np.int64)
            number += frames.size
            sieve = Sieve(frames.size)
            sieve.drop(~_sound(frames), "the checksum of the NAV-PVT is wrong")
            sieve.drop((frames["valid"] & _DATED) != _DATED, "the receiver did not know date and time yet")
            quality = _quality(frames)
            is_void = (quality != NO_POSITION) & ((frames["flags3"] & _INVALID_PLACE) > 0)
            sieve.drop(is_void, "the receiver says that its position is not valid (flags3, invalidLlh)")
            unix_ns = _unix_ns(frames, sieve)
            raw = RawSolutions(
                records, offsets, epochs.epochs(unix_ns, sieve, records), _position(frames), quality,
                _columns(frames),
            )  # fmt: skip
            yield from reader.items(raw, sieve)
        if not number:
            raise FormatError(
                "the recording holds no navigation solution (NAV-PVT)",
                expected="UBX-NAV-PVT",
                change=f"it holds {RAW_WAY}" if _holds_raw(source.path) else "let the receiver write NAV-PVT",
                file=source.path,
            )


def _holds_raw(path: Path) -> bool:
    return RAW in head_of(path, _SNIFF_BYTES)


def _blocks(path: Path) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]]:
    """Yield byte offsets (n,) and frames (n,) of a file's NAV-PVT, block by block; a cut-off frame is ignored."""
    with path.open("rb") as stream:
        held, at = b"", 0
        while block := stream.read(_BLOCK_BYTES):
            held += block
            starts = _starts(held)
            if starts.size:
                yield at + starts, _frames(held, starts)
            keep = max(len(held) - SOLUTION.itemsize + 1, 0)
            held, at = held[keep:], at + keep


def _starts(content: bytes) -> npt.NDArray[np.int64]:
    """Return the starts of whole NAV-PVT frames."""
    found = (one.start() for one in re.finditer(re.escape(HEADER), content))
    return np.array([at for at in found if at + SOLUTION.itemsize <= len(content)], dtype=np.int64)


def _frames(content: bytes, starts: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    own = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(SOLUTION.itemsize)]
    return np.ascontiguousarray(own).view(SOLUTION).ravel()


def _sound(frames: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Return which frames (n,) have a valid checksum (8-bit Fletcher, from the class on)."""
    covered = frames.view(np.uint8).reshape(frames.size, SOLUTION.itemsize)[:, 2:-2].astype(np.int64)
    weights = np.arange(covered.shape[1], 0, -1)
    first, second = covered.sum(axis=1) % 256, (covered @ weights) % 256
    return np.asarray((frames["checksum"][:, 0] == first) & (frames["checksum"][:, 1] == second))


def _unix_ns(frames: npt.NDArray[np.void], sieve: Sieve) -> npt.NDArray[np.int64]:
    """Return UTC since 1970 (ns); records with an impossible date are dropped."""
    days = np.zeros(frames.size, np.int64)
    dates = np.stack([frames[name] for name in ("year", "month", "day")], axis=-1)
    for date in np.unique(dates, axis=0):
        own = (dates == date).all(axis=1)
        try:
            days[own] = dt.date(*(int(value) for value in date)).toordinal() - _UNIX_DAY
        except ValueError:
            sieve.drop(own, "the date of the NAV-PVT is none")
    seconds = days * 86_400 + frames["hour"] * np.int64(3600) + frames["minute"] * np.int64(60) + frames["second"]
    return np.asarray(seconds * 1_000_000_000 + frames["nano"], dtype=np.int64)


def _position(frames: npt.NDArray[np.void]) -> npt.NDArray[np.float64]:
    """Return (3, n) longitude and latitude (rad), ellipsoidal height (m)."""
    degrees = [np.radians(frames[name] * 1e-7) for name in ("longitude", "latitude")]
    return np.stack([*degrees, frames["height_mm"] * 1e-3])


def _quality(frames: npt.NDArray[np.void]) -> npt.NDArray[np.int64]:
    """Return (n,) indices of `QUALITIES`."""
    by_fix = np.array([QUALITIES.index(_FIX_KINDS.get(fix, "none")) for fix in range(256)])
    quality = by_fix[frames["fix"]]
    placed = (quality != NO_POSITION) & ((frames["flags"] & _FIXED_OK) > 0)
    quality = np.where((frames["flags"] & 2) > 0, QUALITIES.index("dgps"), quality)
    for solution, name in _CARRIER.items():
        quality = np.where(frames["flags"] >> 6 == solution, QUALITIES.index(name), quality)
    return np.where(placed, quality, NO_POSITION).astype(np.int64)


def _columns(frames: npt.NDArray[np.void]) -> dict[str, npt.NDArray[np.float64]]:
    level = frames["sigma_horizontal_mm"] * (1e-3 / np.sqrt(2.0))
    columns = {
        "satellites": frames["satellites"].astype(np.float64),
        "sigma_north_m": level,
        "sigma_east_m": level,
        "sigma_down_m": frames["sigma_vertical_mm"] * 1e-3,
        "speed_m_per_s": frames["speed_mm_per_s"] * 1e-3,
    }
    for axis, name in enumerate(("north", "east", "down")):
        columns[f"velocity_{name}_m_per_s"] = frames["velocity_mm_per_s"][:, axis] * 1e-3
        columns[f"sigma_velocity_{name}_m_per_s"] = frames["sigma_speed_mm_per_s"] * 1e-3
    return columns


def _clock(source: LogSource) -> Clock:
    return replace(utc_clock(source, "UBX-NAV-PVT states UTC"), date=None)


def _placement(source: LogSource) -> GeodeticPlacement:
    placement = GeodeticPlacement(source.need_crs(), "ellipsoidal", None, source.path)
    source.need_height("ellipsoidal", "the definition of UBX-NAV-PVT")
    return placement
