"""NMEA 0183 sentences from values: what :mod:`roadscan.formats.motion.nmea` reads."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError, nearest
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, leap_seconds_at_gps

_KNOT_M_PER_S: Final = 1852 / 3600
_QUALITY: Final = {
    "none": 0,
    "single": 1,
    "dgps": 2,
    "sbas": 2,
    "pps": 3,
    "fixed": 4,
    "float": 5,
    "ppp": 5,
    "dead_reckoning": 6,
    "manual": 7,
    "simulated": 8,
}
"""Quality of GGA; the standard has no number of its own for SBAS and PPP."""


@dataclass(frozen=True)
class Fix:
    """What a receiver knows at one epoch; None where it does not."""

    epoch_gps_ns: int
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    """Height above the geoid."""
    undulation_m: float | None = None
    """Height of the geoid above the ellipsoid."""
    quality: str = "single"
    """As in the column `quality` of the table `gnss`."""
    satellites: int | None = None
    hdop: float | None = None
    age_s: float | None = None
    sigma_ned_m: tuple[float, float, float] | None = None
    speed_m_per_s: float | None = None
    course_deg: float | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    """Right side down positive."""
    pitch_deg: float | None = None
    """Nose up positive."""
    sigma_rph_deg: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class NmeaForm:
    """How sentences are written."""

    talker: str = "GN"
    """Two letters: GN for several systems, GP for GPS alone."""
    time_decimals: int = 2
    minute_decimals: int = 7
    """Of minutes of latitude and longitude; 7 are 0.2 mm."""
    metre_decimals: int = 4
    angle_decimals: int = 3
    speed_decimals: int = 4


def sentence(address: str, fields: Iterable[str]) -> str:
    """A sentence with its checksum and line end; `address` is talker and kind, such as ``GPGGA``."""
    body = ",".join([address, *fields])
    return f"${body}*{reduce(xor, body.encode('ascii'), 0):02X}\r\n"


def sentences(fix: Fix, kinds: Sequence[str] = ("GGA", "RMC"), form: NmeaForm | None = None) -> str:
    """Sentences of one epoch: GGA, RMC, VTG, GST, ZDA, HDT, PASHR, in the order asked for.

    Raises
    ------
    ConfigError
        for a kind that is not among these.
    """
    form = form or NmeaForm()
    return "".join(_writer(kind)(fix, form) for kind in kinds)


def write_nmea(
    path: Path, fixes: Iterable[Fix], kinds: Sequence[str] = ("GGA", "RMC"), form: NmeaForm | None = None
) -> None:
    """Write a log: for each fix its sentences. Raises as :func:`sentences`."""
    with path.open("w", encoding="ascii", newline="") as stream:
        stream.writelines(sentences(fix, kinds, form) for fix in fixes)


def _writer(kind: str) -> Callable[[Fix, NmeaForm], str]:
    if kind not in _WRITERS:
        raise ConfigError(
            f"sentence '{kind}' cannot be written{nearest(kind, _WRITERS)}",
            expected="one of: " + ", ".join(_WRITERS),
        )
    return _WRITERS[kind]


def _gga(fix: Fix, form: NmeaForm) -> str:
    time, _ = _time_and_date(fix, form)
    satellites = "" if fix.satellites is None else f"{fix.satellites:02d}"
    fields = [time, *_place(fix, form), str(_QUALITY[fix.quality]), satellites, _number(fix.hdop, 2)]
    fields += [_number(fix.altitude_m, form.metre_decimals), "M"]
    fields += [_number(fix.undulation_m, form.metre_decimals), "M", _number(fix.age_s, 1), ""]
    return sentence(f"{form.talker}GGA", fields)


def _rmc(fix: Fix, form: NmeaForm) -> str:
    time, date = _time_and_date(fix, form)
    active = "V" if fix.quality == "none" else "A"
    motion = [_number(_knots(fix), form.speed_decimals), _number(fix.course_deg, form.angle_decimals)]
    return sentence(f"{form.talker}RMC", [time, active, *_place(fix, form), *motion, f"{date:%d%m%y}", "", ""])


def _vtg(fix: Fix, form: NmeaForm) -> str:
    kmh = None if fix.speed_m_per_s is None else fix.speed_m_per_s * 3.6
    fields = [_number(fix.course_deg, form.angle_decimals), "T", "", "M"]
    fields += [_number(_knots(fix), form.speed_decimals), "N", _number(kmh, form.speed_decimals), "K"]
    return sentence(f"{form.talker}VTG", fields)


def _gst(fix: Fix, form: NmeaForm) -> str:
    time, _ = _time_and_date(fix, form)
    sigmas = fix.sigma_ned_m or (None, None, None)
    return sentence(f"{form.talker}GST", [time, "", "", "", "", *(_number(s, form.metre_decimals) for s in sigmas)])


def _zda(fix: Fix, form: NmeaForm) -> str:
    time, date = _time_and_date(fix, form)
    return sentence(f"{form.talker}ZDA", [time, f"{date:%d}", f"{date:%m}", f"{date:%Y}", "00", "00"])


def _hdt(fix: Fix, form: NmeaForm) -> str:
    return sentence(f"{form.talker}HDT", [_number(fix.heading_deg, form.angle_decimals), "T"])


def _pashr(fix: Fix, form: NmeaForm) -> str:
    time, _ = _time_and_date(fix, form)
    digits = form.angle_decimals
    tilt = ["" if v is None else f"{v:+.{digits}f}" for v in (fix.roll_deg, fix.pitch_deg)]
    sigmas = [_number(s, 3) for s in fix.sigma_rph_deg or (None, None, None)]
    state = {"none": "0", "fixed": "2"}.get(fix.quality, "1")
    return sentence("PASHR", [time, _number(fix.heading_deg, digits), "T", *tilt, "", *sigmas, state, "1"])


_WRITERS: Final[dict[str, Callable[[Fix, NmeaForm], str]]] = {
    "GGA": _gga,
    "RMC": _rmc,
    "VTG": _vtg,
    "GST": _gst,
    "ZDA": _zda,
    "HDT": _hdt,
    "PASHR": _pashr,
}


def _number(value: float | None, decimals: int) -> str:
    return "" if value is None else f"{value:.{decimals}f}"


def _knots(fix: Fix) -> float | None:
    return None if fix.speed_m_per_s is None else fix.speed_m_per_s / _KNOT_M_PER_S


def _place(fix: Fix, form: NmeaForm) -> list[str]:
    """Latitude, its letter, longitude, its letter."""
    if fix.latitude_deg is None or fix.longitude_deg is None:
        return ["", "", "", ""]
    north, east = "S" if fix.latitude_deg < 0 else "N", "W" if fix.longitude_deg < 0 else "E"
    return [_minutes(fix.latitude_deg, 2, form), north, _minutes(fix.longitude_deg, 3, form), east]


def _minutes(degrees: float, digits: int, form: NmeaForm) -> str:
    """Degrees and minutes, dddmm.mmm, rounded as a whole: there are no sixty minutes."""
    unit = 10**form.minute_decimals
    whole, rest = divmod(round(abs(degrees) * 60 * unit), 60 * unit)
    width = form.minute_decimals + 3 if form.minute_decimals else 2
    return f"{whole:0{digits}d}{rest / unit:0{width}.{form.minute_decimals}f}"


def _time_and_date(fix: Fix, form: NmeaForm) -> tuple[str, dt.date]:
    """UTC time of the day (hhmmss.sss) and date; a leap second is 23:59:60."""
    step = 10 ** (9 - form.time_decimals)
    epoch = (int(fix.epoch_gps_ns) + step // 2) // step * step
    gps_s, rest = divmod(epoch, NS_PER_S)
    leap = int(leap_seconds_at_gps(gps_s))
    extra = int(leap_seconds_at_gps(gps_s + 1)) - leap  # 1 within a leap second
    moment = dt.datetime(1970, 1, 1) + dt.timedelta(seconds=gps_s - extra + GPS_EPOCH_UNIX_S - leap)
    fraction = f".{rest // step:0{form.time_decimals}d}" if form.time_decimals else ""
    return f"{moment:%H%M}{moment.second + extra:02d}{fraction}", moment.date()
