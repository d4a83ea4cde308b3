"""GPS time against published instants."""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.errors import ConfigError, TimeSystemError
from roadscan.core.gpstime import (
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
from roadscan.core.survey import ClockConfig

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


# Every leap second since 1972 as the IERS announced it: the UTC day that had a 61st second in its last minute, and
# TAI − UTC from the next day on (IERS Bulletin C 1 to 70; bulletin C 52 for 2016-12-31). Those of 1972 to 1979 stand
# before GPS time and must not count.
IERS = [
    ("1972-06-30", 11), ("1972-12-31", 12), ("1973-12-31", 13), ("1974-12-31", 14), ("1975-12-31", 15),
    ("1976-12-31", 16), ("1977-12-31", 17), ("1978-12-31", 18), ("1979-12-31", 19), ("1981-06-30", 20),
    ("1982-06-30", 21), ("1983-06-30", 22), ("1985-06-30", 23), ("1987-12-31", 24), ("1989-12-31", 25),
    ("1990-12-31", 26), ("1992-06-30", 27), ("1993-06-30", 28), ("1994-06-30", 29), ("1995-12-31", 30),
    ("1997-06-30", 31), ("1998-12-31", 32), ("2005-12-31", 33), ("2008-12-31", 34), ("2012-06-30", 35),
    ("2015-06-30", 36), ("2016-12-31", 37),
]  # fmt: skip
SINCE_GPS = [(dt.date.fromisoformat(day), tai - 19) for day, tai in IERS if day >= "1980-01-06"]


def gps_second(moment: dt.datetime, gps_minus_utc: int) -> int:
    """GPS seconds by counting days since 1980-01-06 and adding GPS − UTC: no table of roadscan takes part."""
    since = moment - dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
    return since.days * 86_400 + since.seconds + gps_minus_utc


def test_there_are_eighteen_leap_seconds_of_gps_time() -> None:
    assert len(SINCE_GPS) == 18
    assert [after for _, after in SINCE_GPS] == list(range(1, 19))
    assert leap_seconds_at_unix(0) == leap_seconds_at_gps(0) == 0
    late = dt.datetime(2026, 12, 31, tzinfo=dt.UTC)
    assert leap_seconds_at_unix(late.timestamp()) == 18


@pytest.mark.parametrize(("day", "after"), SINCE_GPS)
def test_every_leap_second(day: dt.date, after: int) -> None:
    """The second before, the second itself (23:59:60), and the second after; both ways, and through a log's clock."""
    midnight = dt.datetime(day.year, day.month, day.day, tzinfo=dt.UTC) + dt.timedelta(days=1)
    last = midnight - dt.timedelta(seconds=1)  # 23:59:59
    before_gps, next_gps = gps_second(last, after - 1), gps_second(midnight, after)
    assert next_gps - before_gps == 2  # 23:59:60 lies between
    assert gps_ns_from_utc(last) == before_gps * NS_PER_S
    assert gps_ns_from_utc(midnight) == next_gps * NS_PER_S
    assert utc_from_gps_ns(before_gps * NS_PER_S) == last
    assert utc_from_gps_ns(next_gps * NS_PER_S) == midnight
    unix = int(midnight.timestamp())
    assert leap_seconds_at_unix([unix - 1, unix, unix + 1]).tolist() == [after - 1, after, after]
    # GPS − UTC steps when 23:59:60 begins plus one: in it, GPS time is already one second on, UTC has not yet stepped.
    assert leap_seconds_at_gps([before_gps, before_gps + 1, next_gps]).tolist() == [after - 1, after - 1, after]
    stamps = np.array([unix - 1, unix], dtype=np.int64)
    epochs = Clock(TimeSystem.UNIX_UTC).to_epoch_gps_ns(stamps)
    assert epochs.tolist() == [before_gps * NS_PER_S, next_gps * NS_PER_S]
    tai = Clock(TimeSystem.UNIX_TAI).to_epoch_gps_ns(stamps + 19 + np.array([after - 1, after]))
    assert tai.tolist() == epochs.tolist()


@pytest.mark.parametrize("day", [d.isoformat() for d, _ in SINCE_GPS])
def test_days_without_a_leap_second_have_86400(day: str) -> None:
    """The half-years beside each announced one: June and December were always candidates."""
    announced = {d for d, _ in SINCE_GPS}
    year = int(day[:4])
    for date in (dt.date(year, 6, 30), dt.date(year, 12, 31)):
        noon = dt.datetime(date.year, date.month, date.day, 12, tzinfo=dt.UTC)
        day_s = (gps_ns_from_utc(noon + dt.timedelta(days=1)) - gps_ns_from_utc(noon)) // NS_PER_S
        assert day_s == (86_401 if date in announced else 86_400)


def test_23_59_60_of_posix_time_is_the_second_after() -> None:
    """POSIX has no 61st second: a stamp that repeats 00:00:00 is read as that, never as an hour or week off."""
    unix = int(dt.datetime(2017, 1, 1, tzinfo=dt.UTC).timestamp())
    epochs = Clock(TimeSystem.UNIX_UTC).to_epoch_gps_ns(np.array([unix - 1, unix, unix + 1], dtype=np.int64))
    assert (np.diff(epochs) // NS_PER_S).tolist() == [2, 1]


@pytest.mark.parametrize("week", [0, 357, 1023])
def test_a_week_modulo_1024_is_refused_and_the_date_resolves_it(week: int) -> None:
    """A receiver shows the ten bits of the signal (IS-GPS-200): 357 for 2405, the week from 2026-02-08."""
    stated = {"system": "gps_week_seconds", "week": week}
    with pytest.raises(
        ConfigError, match=rf"week {week} began on .*modulo 1024 means {week + 1024} .* or {week + 2048} "
    ):
        ClockConfig.parse(stated)
    date = dt.date(1980, 1, 6) + dt.timedelta(weeks=week + 2048, days=3)
    by_date = ClockConfig.parse({"system": "gps_week_seconds", "date": date}).clock()
    full = ClockConfig.parse({"system": "gps_week_seconds", "week": week + 2048}).clock()
    stamps = np.array([0.0, 3.5 * 86_400])
    assert by_date.to_epoch_gps_ns(stamps).tolist() == full.to_epoch_gps_ns(stamps).tolist()
    assert full.to_epoch_gps_ns(stamps)[0] == (week + 2048) * WEEK_S * NS_PER_S


def test_a_log_that_is_really_of_the_nineties_states_its_date() -> None:
    clock = ClockConfig.parse({"system": "gps_week_seconds", "date": dt.date(1999, 8, 20)}).clock()
    assert clock.to_epoch_gps_ns(np.array([0.0]))[0] == 1023 * WEEK_S * NS_PER_S


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
