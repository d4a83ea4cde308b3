"""Evidence for the clocks of sensors: pairs of stamps, or motion that two sensors share (``[[clocks]]``)."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.gpstime import TimeSystem, check_week
from roadscan.core.strict import Strict

Drift = Literal["auto", "none", "estimate"]
"""Whether the rate of a clock is estimated."""
Unit = Literal["s", "ms", "us", "ns"]

USUAL_DRIFT: Final = 1e-4
"""1 σ of the rate error of a clock of which nothing is known: quartz without compensation keeps within 100 ppm."""
_NO_PAIR_SYSTEMS: Final = (TimeSystem.FREE, TimeSystem.UTC_HOUR)


class MotionEvidence(Strict):
    """The clock of a sensor from motion that it shares with one whose clock is right."""

    sensor: str
    """Sensor whose clock is estimated: an IMU or an encoder of the rig."""
    runs: list[str] = []
    """Runs, each with a separate clock; all where left out."""
    against: str = "trajectory"
    """What feels the same motion on GPS time: "trajectory", or an IMU of the rig."""
    also: list[str] = []
    """Sensors that share this clock (the profiler head an IMU sits in)."""
    search_s: float = Field(default=5.0, gt=0.0, le=3600.0)
    """Largest offset looked for, to both sides (s)."""
    drift: Drift = "auto"
    """Whether the rate of the clock is estimated; "auto": as far as the data determine it, kept within the 100 ppm
    (1 σ) of a usual quartz where they do not."""
    delay_s: float = Field(default=0.0, ge=-1.0, le=1.0)
    """How late the sensor stamps what it feels, beside its clock (s): half the interval where a sample is the mean
    over the interval that ends at its stamp, the delay of its filter by the data sheet. Positive: the stamp is late."""


class ClockPair(Strict):
    """One instant on two clocks."""

    stamp: int | float | dt.datetime | str
    """What the log's clock showed: a number in `clock.unit` of `clock.system`, or (unix_utc, unix_gps, unix_tai) a
    calendar time."""
    time: int | float | dt.datetime | str
    """What GPS time it was: a number in the pairs' `unit` of their `system`, or a calendar time with its zone
    ("2026-05-04T09:30:00.2Z"; UTC counts leap seconds)."""
    sigma_s: float | None = Field(default=None, gt=0.0)
    """1 σ of this pair (s); that of the pairs where left out."""


class PairEvidence(Strict):
    """Pairs of (stamp of the log, GPS time): two devices compared, or a photographed screen of a GNSS receiver.

    One pair gives the offset, several a straight line. They are applied at ingest, as a stated `offset_s` is.
    """

    typed: list[ClockPair] = []
    """The pairs, typed."""
    table: Path | None = None
    """Or a text table (CSV) with columns `stamp` and `time`, relative to the survey file."""
    system: TimeSystem | None = None
    """System of `time` where it is a number: gps, gps_week_seconds, gps_adjusted, unix_gps, unix_utc or unix_tai."""
    unit: Unit = "s"
    """Unit of `time` where it is a number."""
    week: int | None = Field(default=None, ge=0, le=5000)
    """GPS week of `time` in gps_week_seconds, as the screen shows it (not modulo 1024)."""
    date: dt.date | None = None
    """UTC date of the first pair, in place of `week`."""
    sigma_s: float = Field(gt=0.0)
    """1 σ of a pair (s): how well screen or device is read. For arrivals: the smallest error that is believed."""
    arrivals: bool = False
    """`time` is when the record arrived at the host, whose clock keeps GPS time: never early, often late. The line is
    laid below all of them."""
    least_latency_s: float = Field(default=0.0, ge=0.0)
    """For arrivals: the least time from stamp to arrival (s). What is not stated stays in the offset: epochs are late
    by as much."""
    drift: Drift = "auto"
    """Whether the rate is estimated; "auto": as far as the pairs determine it, kept within the 100 ppm (1 σ) of a
    usual quartz where they do not."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if bool(self.typed) == (self.table is not None):
            raise ValueError("give either typed, the pairs themselves, or table, a file of them")
        if self.system in _NO_PAIR_SYSTEMS:
            raise ValueError(f"system '{self.system}' is not GPS time")
        if self.system is None and any(isinstance(p.time, int | float) for p in self.typed):
            raise ValueError('state system of the pairs, such as "gps_week_seconds": time is a number')
        if self.system is TimeSystem.GPS_WEEK and (self.week is None) == (self.date is None):
            raise ValueError("gps_week_seconds needs either week or date")
        if self.week is not None:
            check_week(self.week)
        if self.least_latency_s and not self.arrivals:
            raise ValueError("least_latency_s belongs to arrivals = true")
        return self
