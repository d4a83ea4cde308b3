"""The clock of lidars whose packets hold date and time: UTC where the recording computer agrees."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from roadscan.core.errors import Missing, TimeSystemError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, Clock, TimeSystem, ahead_of_utc_s
from roadscan.core.witness import Witness
from roadscan.ingest.reading.format import LogSource

_AGREE_S: Final = 5.0
"""Largest difference of the clocks of sensor and computer; other time scales differ by more: GPS by 18 s, TAI by 37."""
_NEAR_S: Final = 2.0  # within this of 18 s or 37 s, the sensor's clock is proposed to be on GPS time or TAI
_STAMPED: Final = (TimeSystem.UNIX_UTC, TimeSystem.UNIX_TAI, TimeSystem.UNIX_GPS, TimeSystem.FREE)

OTHER_CLOCK: Final = Witness(
    "lidar_clock_unset",
    input="lidar",
    fault="A lidar's clock is not UTC: nothing set it, or PTP set it to TAI.",
    asks="the recording computer's clock",
    does="a log whose clock the survey file does not state is refused; the message proposes one",
    told=("error",),
)


TIME: Final = (
    "date and time in UTC where GPS sets the sensor, and whatever the master sends under PTP; a log without a stated "
    "clock is UTC where the recording computer's clock agrees"
)
"""`LogFormat.time` of such lidars."""


def clock_of(source: LogSource, system: str) -> Clock:
    """Return the clock by which rows are read, in microseconds, of the system that :func:`dated_clock` found."""
    return replace(source.any_clock or Clock(TimeSystem.UNIX_UTC), system=TimeSystem(system), unit="us")


def dated_clock(source: LogSource, stamp_s: float, ahead_s: float) -> Clock:
    """Return the stated clock, or UTC where the recording computer's clock agrees.

    Parameters
    ----------
    stamp_s : the first packet's time by the sensor's clock (s since 1970).
    ahead_s : the recording computer's clock less the sensor's (s).
    """
    stated = source.any_clock
    if stated is not None:
        if stated.system not in _STAMPED:
            raise TimeSystemError(
                f"clock.system is '{stated.system}', and the packets have date and time",
                expected=", ".join(_STAMPED),
                file=source.path,
                missing=Missing("clock", {"system": "unix_utc"}),
            )
        return stated
    if abs(ahead_s) <= _AGREE_S:
        return Clock(TimeSystem.UNIX_UTC)
    scales = ahead_of_utc_s(stamp_s + ahead_s)
    offset_s = ahead_s + scales[TimeSystem.UNIX_GPS] - GPS_EPOCH_UNIX_S
    proposed: dict[str, object] = {"system": "free", "offset_s": round(offset_s, 3)}
    for system, early_s in scales.items():
        if abs(ahead_s + early_s) < _NEAR_S:
            proposed = {"system": str(system)}
    raise TimeSystemError(
        f"the sensor's date and time are {-ahead_s:+,.3f} s from the recording computer's clock: they are not UTC, or "
        "that clock is wrong",
        expected='clock = { system = "unix_utc" } where GPS set the sensor, "unix_tai" for a PTP master on TAI, or '
        '"free" with a measured offset_s where nothing set it',
        file=source.path,
        missing=Missing("clock", proposed, is_example=proposed["system"] == "free"),
    )
