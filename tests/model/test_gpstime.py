"""GPS time against published instants."""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.model.errors import TimeSystemError
from roadscan.model.gpstime import (
    NS_PER_S,
    WEEK_S,
    Clock,
    TimeSystem,
    gps_ns_from_utc,
    gps_week_of_date,
    iso_from_gps_ns,
    leap_seconds_at_gps,
    leap_seconds_at_unix,
    unroll_week,
    utc_from_gps_ns,
)

# (GPS seconds, UTC). The gravitational-wave catalogue GWTC-1 prints both scales for its events;
# GPS 1e9 and the leap second of 2017 are in the IGS and LIGO time tables.
PUBLISHED = [
    (0, "1980-01-06T00:00:00Z"),
    (1_126_259_462.4, "2015-09-14T09:50:45.4Z"),  # GW150914
    (1_187_008_882.4, "2017-08-17T12:41:04.4Z"),  # GW170817
    (1_000_000_000, "2011-09-14T01:46:25Z"),
    (1_167_264_018, "2017-01-01T00:00:00Z"),
    (1_167_264_016, "2016-12-31T23:59:59Z"),
]


@pytest.mark.parametrize(("gps_s", "utc"), PUBLISHED)
def test_published_instants(gps_s: float, utc: str) -> None:
    moment = dt.datetime.fromisoformat(utc)
    epoch = round(gps_s * 10) * NS_PER_S // 10
    assert gps_ns_from_utc(moment) == epoch
    assert utc_from_gps_ns(epoch) == moment
    assert dt.datetime.fromisoformat(iso_from_gps_ns(epoch)) == moment


# GPS − UTC from a day on: TAI − UTC as IERS Bulletin C announces it, minus 19 s.
@pytest.mark.parametrize(
    ("day", "seconds"),
    [
        ("1980-01-06", 0),
        ("1981-06-30", 0),
        ("1981-07-01", 1),
        ("1990-01-01", 6),
        ("1999-01-01", 13),
        ("2005-12-31", 13),
        ("2006-01-01", 14),
        ("2009-01-01", 15),
        ("2012-07-01", 16),
        ("2015-06-30", 16),
        ("2015-07-01", 17),
        ("2016-12-31", 17),
        ("2017-01-01", 18),
        ("2026-05-04", 18),
    ],
)
def test_leap_seconds(day: str, seconds: int) -> None:
    moment = dt.datetime.fromisoformat(day).replace(tzinfo=dt.UTC)
    assert leap_seconds_at_unix(moment.timestamp()) == seconds
    assert leap_seconds_at_gps(gps_ns_from_utc(moment) // NS_PER_S) == seconds


# Weeks 1024 and 2048 began when the broadcast ten-bit week number rolled over.
@pytest.mark.parametrize(
    ("day", "week"),
    [
        ("1980-01-06", 0),
        ("1999-08-21", 1023),
        ("1999-08-22", 1024),
        ("2019-04-06", 2047),
        ("2019-04-07", 2048),
        ("2021-09-15", 2175),
    ],
)
def test_week_numbers(day: str, week: int) -> None:
    assert gps_week_of_date(dt.date.fromisoformat(day)) == week


GW150914_NS = 11_262_594_624 * (NS_PER_S // 10)


@pytest.mark.parametrize(
    ("clock", "stamp"),
    [
        (Clock(TimeSystem.GPS), 1_126_259_462.4),
        (Clock(TimeSystem.GPS_WEEK, week=1862), 121_862.4),
        (Clock(TimeSystem.GPS_WEEK, date=dt.date(2015, 9, 14)), 121_862.4),
        (Clock(TimeSystem.GPS_ADJUSTED), 126_259_462.4),
        (Clock(TimeSystem.UNIX_UTC), 1_442_224_245.4),
        (Clock(TimeSystem.UNIX_GPS), 1_442_224_245.4 + 17),
        (Clock(TimeSystem.UNIX_TAI), 1_442_224_245.4 + 17 + 19),
        (Clock(TimeSystem.FREE, offset_s=1_126_259_000.0), 462.4),
    ],
)
def test_one_instant_on_every_scale(clock: Clock, stamp: float) -> None:
    epoch = clock.to_epoch_gps_ns(np.array([stamp]))
    assert epoch.dtype == np.int64
    assert abs(int(epoch[0]) - GW150914_NS) < 500  # a float64 of 1.4e9 s resolves 238 ns


@pytest.mark.parametrize(("unit", "scale"), [("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
def test_integer_stamps_are_exact_in_every_unit(unit: str, scale: int) -> None:
    stamp = 14_422_242_454 * scale // 10
    epoch = Clock(TimeSystem.UNIX_UTC, unit=unit).to_epoch_gps_ns(np.array([stamp]))
    assert int(epoch[0]) == GW150914_NS


def test_posix_time_steps_over_a_leap_second() -> None:
    before, after = dt.datetime(2016, 12, 31, 23, 59, 59, tzinfo=dt.UTC), dt.datetime(2017, 1, 1, tzinfo=dt.UTC)
    stamps = np.array([before.timestamp(), after.timestamp()])
    epochs = Clock(TimeSystem.UNIX_UTC).to_epoch_gps_ns(stamps)
    assert int(np.diff(epochs)[0]) == 2 * NS_PER_S


def test_offset_and_drift() -> None:
    clock = Clock(TimeSystem.GPS, offset_s=-0.125, drift_ppm=2.0, reference_s=1_000_000_000.0)
    epochs = clock.to_epoch_gps_ns(np.array([1_000_000_000, 1_000_003_600], dtype=np.int64))
    late = epochs - np.array([1_000_000_000, 1_000_003_600]) * NS_PER_S
    assert late.tolist() == [-125_000_000, -125_000_000 + 7_200_000]  # 3600 s at 2 ppm are 7.2 ms


def test_a_wrong_unit_is_named() -> None:
    microseconds = np.array([1_606_417_097_528_152], dtype=np.int64)
    with pytest.raises(TimeSystemError, match=r"read as s of 'unix_utc'.*1980–2080.*clock\.unit = \"us\""):
        Clock(TimeSystem.UNIX_UTC).to_epoch_gps_ns(microseconds)
    with pytest.raises(TimeSystemError, match=r"read as us of 'unix_utc'.*clock\.unit = \"ns\""):
        Clock(TimeSystem.UNIX_UTC, unit="us").to_epoch_gps_ns(microseconds * 1000)
    with pytest.raises(TimeSystemError, match=r"clock\.unit = \"us\""):
        Clock(TimeSystem.UNIX_UTC).to_epoch_gps_ns(microseconds.astype(np.float64))


@pytest.mark.parametrize(
    ("clock", "stamps", "words"),
    [
        (Clock(TimeSystem.GPS), [np.nan], "not a number"),
        (Clock(TimeSystem.GPS_WEEK), [1.0], "week is not known.*week = "),
        (Clock(TimeSystem.UTC_HOUR), [1.0], "hour is not resolved"),
        (Clock(TimeSystem.GPS), [-1.0], "outside 1980–2080"),
    ],
)
def test_refusals(clock: Clock, stamps: list[float], words: str) -> None:
    with pytest.raises(TimeSystemError, match=words):
        clock.to_epoch_gps_ns(np.array(stamps))


def test_a_time_without_zone_is_refused() -> None:
    with pytest.raises(TimeSystemError, match=r"no time zone.*trailing Z"):
        gps_ns_from_utc(dt.datetime(2026, 5, 4, 9, 30))


@given(
    start=st.floats(0, WEEK_S - 1),
    steps=st.lists(st.floats(-2.0, 40_000.0), min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 40), max_size=4),
)
@settings(max_examples=60, deadline=None)
def test_unrolled_weeks_do_not_depend_on_chunks(start: float, steps: list[float], cuts: list[int]) -> None:
    truth = np.maximum(start + np.concatenate([[0.0], np.cumsum(steps)]), 0.0)
    logged = np.mod(truth, WEEK_S)
    unrolled, previous = [], None
    for chunk in np.split(logged, sorted(min(c, logged.size) for c in cuts)):
        unrolled.append(unroll_week(chunk, previous))
        previous = float(unrolled[-1][-1]) if chunk.size else previous
    np.testing.assert_allclose(np.concatenate(unrolled), truth, atol=1e-6)
