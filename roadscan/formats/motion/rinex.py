"""RINEX: what header lines and epoch lines of observation files say (RINEX 2.11, table A1; RINEX 3.05, table A2)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S
from roadscan.ingest.reading.text_table import head_of, open_text

HEAD_BYTES: Final = 1 << 18
"""The header of an observation file with all systems and comments of its splicing is shorter (bytes)."""
_LABEL: Final = slice(60, 80)
"""Columns of a header line's label."""
_EPOCH: Final = re.compile(
    rb"^(?:> (\d{4})| (\d\d| \d)) ([ \d]\d) ([ \d]\d) ([ \d]\d) ([ \d]\d)([ \d]{2}\d\.\d{6})\d  [01]", re.MULTILINE
)
"""Line of an epoch with observations: RINEX 3 begins it with ">" and four digits of the year, RINEX 2 with two."""
_BLOCK_BYTES: Final = 4 << 20  # bytes that are read at once
_TWO_DIGITS: Final = 80  # years 80 to 99 of RINEX 2 are of the 20th century


@dataclass(frozen=True)
class RinexHeader:
    """What the header of an observation file says of its station."""

    rinex: str
    """Version of the format."""
    approximate_m: tuple[float, ...] | None
    """Approximate geocentric position (m), often a code solution of the receiver; None where it is not said, or 0."""
    antenna_height_m: float | None
    """Height of the antenna's reference point above the mark (m)."""
    antenna: str
    """Type of the antenna."""


def rinex_kind(path: Path) -> str:
    """Return the letter of a RINEX file's kind: O observations, N navigation, C clocks, …; "" for other files.

    "crinex" for observations in Hatanaka's compression.
    """
    first = head_of(path, 80).split(b"\n")[0].decode("ascii", "replace") if path.is_file() else ""
    if first[_LABEL].startswith("CRINEX VERS"):
        return "crinex"
    return first[20:21] if first[_LABEL].startswith("RINEX VERSION") else ""


def rinex_header(path: Path) -> RinexHeader:
    """Return what an observation file says of its station; what cannot be read counts as not said."""
    head = head_of(path, HEAD_BYTES).decode("ascii", "replace")
    said: dict[str, str] = {}
    for line in head.splitlines():
        label = line[_LABEL].strip()
        if label == "END OF HEADER":
            break
        said.setdefault(label, line[:60])
    position = _numbers(said.get("APPROX POSITION XYZ", ""), 3)
    height = _numbers(said.get("ANTENNA: DELTA H/E/N", ""), 1)
    return RinexHeader(
        said.get("RINEX VERSION / TYPE", "")[:9].strip(),
        position if position and any(position) else None,
        height[0] if height else None,
        said.get("ANT # / TYPE", "")[20:40].strip(),
    )


def observed_epochs(path: Path) -> npt.NDArray[np.int64]:
    """Return the epochs (n,) of an observation file, in the order of its lines.

    They are nanoseconds since 1980-01-06 in the file's time system (that of GPS, with few exceptions).
    """
    parts: list[npt.NDArray[np.int64]] = []
    with open_text(path) as stream:
        pending = b""
        while block := stream.read(_BLOCK_BYTES):
            pending += block
            end = pending.rfind(b"\n") + 1
            parts.append(_epochs(pending[:end]))
            pending = pending[max(end, len(pending) - _BLOCK_BYTES) :]
    parts.append(_epochs(pending))
    return np.concatenate(parts)


def _epochs(lines: bytes) -> npt.NDArray[np.int64]:
    found = [m for m in _EPOCH.findall(lines) if 1 <= int(m[2]) <= 12 and int(m[3]) > 0]
    if not found:
        return np.zeros(0, np.int64)
    text = np.array(found, dtype="S12")
    years = np.array([int(long) if long else _year(int(short)) for long, short in text[:, :2].tolist()])
    month, day, hour, minute = (text[:, k].astype(np.int64) for k in range(2, 6))
    months = (years - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1).astype("timedelta64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    whole_s = days * 86_400 + hour * 3600 + minute * 60 - GPS_EPOCH_UNIX_S
    return np.asarray(whole_s * NS_PER_S + np.rint(text[:, 6].astype(np.float64) * NS_PER_S).astype(np.int64))


def _year(two_digits: int) -> int:
    return two_digits + (1900 if two_digits >= _TWO_DIGITS else 2000)


def _numbers(text: str, count: int) -> tuple[float, ...] | None:
    try:
        found = tuple(float(text[14 * k : 14 * (k + 1)]) for k in range(count))
    except ValueError:
        return None
    return found if np.all(np.isfinite(found)) else None
