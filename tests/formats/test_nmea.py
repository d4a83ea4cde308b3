"""NMEA 0183: hand-made sentences, round trips, another library's reading, dates, damage."""

from __future__ import annotations

import datetime as dt
import gzip
import random
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pynmea2
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.crs import Geoid
from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.ingest.reading import text_table
from roadscan.ingest.reading.format import SourceDefaults, format_named, format_of
from tests.formats.log_reading import Log, read_log, source_of
from tests.formats.nmea_files import Fix, NmeaForm, sentences, write_nmea
from tests.formats.test_rtklib_pos import ecef, flat_geoid

GEODETIC = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
STATED: dict[str, Any] = {"crs": "EPSG:4979"}
KNOT = 1852 / 3600

# Published sentences: the GGA and RMC of the format's best-known description, GST and ZDA of Trimble's help,
# PASHR of NovAtel's.
GGA = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"
RMC = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
GST = "$GPGST,172814.0,0.006,0.023,0.020,273.6,0.023,0.020,0.031*6A"
PASHR = "$PASHR,163029.000,158.09,T,-0.30,+0.31,+0.01,0.029,0.029,0.059,1,1*3B"
MARCH_1994 = gps_ns_from_utc(dt.datetime(1994, 3, 23, 12, 35, 19, tzinfo=dt.UTC))


def checked(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def write(path: Path, *lines: str) -> Path:
    path.write_bytes("\r\n".join([*lines, ""]).encode("latin-1"))
    return path


def only(log: Log) -> dict[str, Any]:
    assert log.rejects == []
    (row,) = log.table.to_pylist()
    return row


def at(moment: str) -> int:
    return gps_ns_from_utc(dt.datetime.fromisoformat(moment).replace(tzinfo=dt.UTC))


def gga(time: str, *, quality: int = 4, altitude: str = "100.0", separation: str = "40.0") -> str:
    unit = "M" if separation else ""
    return checked(f"GNGGA,{time},5000.0,N,01000.0,E,{quality},12,0.8,{altitude},M,{separation},{unit},1.0,0000")


def rmc(time: str, date: str, status: str = "A") -> str:
    return checked(f"GNRMC,{time},{status},5000.0,N,01000.0,E,10.0,90.0,{date},,,R")


def sample() -> bytes:
    """A small valid log."""
    start = at("2026-05-04T09:30:00")
    fixes = (Fix(start + i * 10**9, 50.0, 10.0, 100.0, 45.0, "fixed", 12, 0.7) for i in range(6))
    return "".join(sentences(fix) for fix in fixes).encode()


# --- single sentences --------------------------------------------------------------------------------


def test_published_sentences(tmp_path: Path) -> None:
    path = write(tmp_path / "a.nmea", GGA, RMC)
    assert format_of(path).name == "nmea"
    log = read_log("nmea", path, **STATED)
    assert log.attributes == {"world_frame": "EPSG:4978", "date": "1994-03-23"}
    row = only(log)
    assert row["epoch_gps_ns"] == MARCH_1994
    np.testing.assert_allclose(log.positions[0], ecef(11 + 31 / 60, 48 + 7.038 / 60, 545.4 + 46.9), atol=1e-8)
    assert (row["quality"], row["satellites"]) == ("single", 8)
    assert (row["hdop"], row["undulation_m"]) == pytest.approx((0.9, 46.9))
    assert row["course_deg"] == 84.4
    speed = 22.4 * KNOT
    assert row["velocity_north_m_per_s"] == pytest.approx(speed * np.cos(np.radians(84.4)))
    assert row["velocity_east_m_per_s"] == pytest.approx(speed * np.sin(np.radians(84.4)))
    assert row["velocity_down_m_per_s"] is row["age_s"] is row["heading_deg"] is row["sigma_north_m"] is None


def test_attitude_and_sigmas(tmp_path: Path) -> None:
    clock = Clock(TimeSystem.UNIX_UTC, date=dt.date(2026, 5, 4))
    row = only(read_log("nmea", write(tmp_path / "a.nmea", PASHR), clock=clock, **STATED))
    assert row["epoch_gps_ns"] == at("2026-05-04T16:30:29")
    assert [row[f"{a}_deg"] for a in ("heading", "roll", "pitch")] == [158.09, -0.30, 0.31]
    assert [row[f"sigma_{a}_deg"] for a in ("roll", "pitch", "heading")] == pytest.approx([0.029, 0.029, 0.059])
    assert (row["quality"], row["x_world_m"]) == ("none", None)

    row = only(read_log("nmea", write(tmp_path / "b.nmea", GST), clock=clock, **STATED))
    assert [row[f"sigma_{a}_m"] for a in ("north", "east", "down")] == pytest.approx([0.023, 0.020, 0.031])
    angle = np.radians(273.6)
    ellipse = (0.023**2 - 0.020**2) * np.sin(angle) * np.cos(angle)
    assert row["covariance_ne_m2"] == pytest.approx(ellipse, rel=1e-5)


def test_a_rotated_error_ellipse_gives_the_covariance(tmp_path: Path) -> None:
    """A long axis to the north-east: north and east err together."""
    line = checked("GPGST,000000,,0.05,0.01,45.0,0.036,0.036,0.1")
    clock = Clock(TimeSystem.UNIX_UTC, date=dt.date(2026, 5, 4))
    row = only(read_log("nmea", write(tmp_path / "a.nmea", line), clock=clock, **STATED))
    assert row["covariance_ne_m2"] == pytest.approx((0.05**2 - 0.01**2) / 2)


def test_sentences_of_one_epoch_are_one_row(tmp_path: Path) -> None:
    lines = [
        gga("093000.00"),
        checked("GNVTG,45.0,T,,M,,N,36.0,K,D"),
        checked("GNHDT,123.456,T"),
        checked("GNZDA,093000.00,04,05,2026,00,00"),
        checked("GNGSV,1,1,00,0"),
        checked("PUBX,00,1"),
        checked("PASHR,POS,0,08,093000.00"),
        checked("PASHR,093000.00,123.4,T,+1.00,-2.00,,0.1,0.2,0.3,2,1"),
    ]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    row = only(log)
    assert row["epoch_gps_ns"] == at("2026-05-04T09:30:00")
    assert row["quality"] == "fixed"
    assert row["course_deg"] == 45.0
    assert row["velocity_north_m_per_s"] == pytest.approx(10 * np.sqrt(0.5))
    assert (row["heading_deg"], row["roll_deg"], row["pitch_deg"]) == (123.4, 1.0, -2.0)  # PASHR before HDT
    assert row["age_s"] == 1.0
    assert log.rows[0].first_record == 0


def test_speed_without_a_course_is_kept(tmp_path: Path) -> None:
    """A receiver at rest states a little speed and no course."""
    still = checked("GNRMC,093000.00,A,5000.0,N,01000.0,E,0.05,,040526,,,R")
    vtg = checked("GNVTG,,T,,M,,N,0.18,K,D")
    lines = [still, gga("093000.00"), rmc("093001.00", "040526"), gga("093001.00"), gga("093002.00"), vtg]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.rejects == []
    np.testing.assert_allclose(log.column("speed_m_per_s"), [0.05 * KNOT, 10 * KNOT, 0.05])
    for axis, moving in (("north", 0.0), ("east", 10 * KNOT)):
        values = log.table.column(f"velocity_{axis}_m_per_s").to_pylist()
        assert values == [None, pytest.approx(moving, abs=1e-12), None]


@pytest.mark.parametrize(("untimed", "headings"), [("before", [10.0, 20.0, None]), ("after", [None, 10.0, 20.0])])
@pytest.mark.parametrize("block", [1 << 20, 90])
def test_whose_time_an_untimed_sentence_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, untimed: str, headings: list[float], block: int
) -> None:
    monkeypatch.setattr(text_table, "BLOCK_BYTES", block)
    lines = [gga("093000.00"), checked("GNHDT,10.0,T"), gga("093001.00"), checked("GNHDT,20.0,T")]
    path = write(tmp_path / "a.nmea", *lines, rmc("093002.00", "040526"), gga("093002.00"))
    log = read_log("nmea", path, {"untimed": untimed}, **STATED)
    assert log.rejects == []
    assert log.table.column("heading_deg").to_pylist() == headings


def test_untimed_sentences_without_a_neighbour(tmp_path: Path) -> None:
    lines = [checked("GNHDT,10.0,T"), rmc("093002.00", "040526"), gga("093002.00"), checked("GNHDT,20.0,T")]
    path = write(tmp_path / "a.nmea", *lines)
    (first,) = read_log("nmea", path, **STATED).rejects
    assert (first.record, first.reason) == (0, "the sentence has no time, and none to share")
    (last,) = read_log("nmea", path, {"untimed": "after"}, **STATED).rejects
    assert (last.record, last.reason) == (3, "the sentence has no time, and none follows to share")


def test_late_sentences_find_their_epoch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GGA comes 0.2 s behind the fast attitude, and blocks end anywhere."""
    monkeypatch.setattr(text_table, "BLOCK_BYTES", 150)
    lines = []
    for i in range(100):
        lines.append(checked(f"PASHR,0930{i // 20:02d}.{i % 20 * 5:02d},{i}.0,T,+0.0,+0.0,,0.1,0.1,0.1,2,1"))
        if i % 20 == 4:
            lines += [gga(f"0930{i // 20:02d}.00"), rmc(f"0930{i // 20:02d}.00", "040526")]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.rejects == []
    np.testing.assert_array_equal(log.epochs, at("2026-05-04T09:30:00") + np.arange(100) * 50_000_000)
    quality = log.table.column("quality").to_pylist()
    assert [i for i, q in enumerate(quality) if q == "fixed"] == [0, 20, 40, 60, 80]
    np.testing.assert_array_equal(log.column("heading_deg"), np.arange(100.0))


@pytest.mark.parametrize(
    ("number", "quality"),
    list(
        enumerate(["none", "single", "dgps", "pps", "fixed", "float", "dead_reckoning", "manual", "simulated", "sbas"])
    ),
)
def test_quality(tmp_path: Path, number: int, quality: str) -> None:
    path = write(tmp_path / "a.nmea", gga("093000.00", quality=number), rmc("093000.00", "040526"))
    row = only(read_log("nmea", path, **STATED))
    assert row["quality"] == quality
    assert (row["x_world_m"] is None) == (quality == "none")


# --- height and datum --------------------------------------------------------------------------------


def test_heights_without_a_separation(tmp_path: Path) -> None:
    path = write(tmp_path / "a.nmea", gga("093000.00", separation=""), rmc("093000.00", "040526"))
    with pytest.raises(CrsError, match=r"a\.nmea, record 0: GGA states no geoid separation"):
        read_log("nmea", path, **STATED)
    flat = Geoid.found(str(flat_geoid(tmp_path / "flat.gtx", 35.0)))
    log = read_log("nmea", path, height="orthometric", geoid=flat, **STATED)
    np.testing.assert_allclose(log.positions[0], ecef(10, 50, 135.0), atol=1e-6)
    assert only(log)["undulation_m"] is None
    log = read_log("nmea", path, {"altitude": "ellipsoidal"}, **STATED)
    np.testing.assert_allclose(log.positions[0], ecef(10, 50, 100.0), atol=1e-8)


def test_the_separation_of_the_log_goes_before_the_geoid(tmp_path: Path) -> None:
    """The receiver subtracted its own; only epochs without one need the survey's."""
    lines = [gga("093000.00"), rmc("093000.00", "040526"), gga("093001.00", separation="")]
    path = write(tmp_path / "a.nmea", *lines)
    flat = Geoid.found(str(flat_geoid(tmp_path / "flat.gtx", 35.0)))
    log = read_log("nmea", path, height="orthometric", geoid=flat, **STATED)
    np.testing.assert_allclose(log.positions, [ecef(10, 50, 140.0), ecef(10, 50, 135.0)], atol=1e-6)
    log = read_log("nmea", path, **STATED)
    assert [(r.record, r.reason) for r in log.rejects] == [(2, "the altitude comes without a geoid separation")]
    assert log.table.num_rows == 1


def test_a_geoid_that_does_not_cover_the_place(tmp_path: Path) -> None:
    away = gga("093001.00", separation="").split("*")[0][1:].replace("5000.0", "1000.0")
    lines = [gga("093000.00", separation=""), rmc("093000.00", "040526"), checked(away)]
    flat = Geoid.found(str(flat_geoid(tmp_path / "flat.gtx", 35.0)))
    stated = {"height": "orthometric", "geoid": flat} | STATED
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **stated)
    assert log.table.num_rows == 1
    (reject,) = log.rejects
    assert reject.record == 2
    assert "does not cover" in reject.reason
    path = write(tmp_path / "b.nmea", lines[2], rmc("093000.00", "040526"))
    with pytest.raises(CrsError, match="does not cover"):
        read_log("nmea", path, **stated)
    missing = STATED | {"height": "orthometric", "geoid": Geoid.found("absent.gtx")}
    with pytest.raises(CrsError, match=r"'absent\.gtx' was not found"):
        format_named("nmea").header(source_of("nmea", path, **missing))


@pytest.mark.parametrize(
    ("options", "stated", "error", "says"),
    [
        ({}, {}, ConfigError, "CRS of the log's positions is not stated"),
        ({}, {"crs": "local"}, ConfigError, "positions are latitude and longitude"),
        ({}, {"crs": "EPSG:25832"}, CrsError, "no geographic CRS"),
        ({}, STATED | {"clock": Clock(TimeSystem.GPS)}, TimeSystemError, "NMEA times are UTC, the clock says gps"),
        (
            {},
            STATED | {"clock": Clock(TimeSystem.UNIX_UTC, date=dt.date(2026, 5, 5))},
            TimeSystemError,
            "the log starts on 2026-05-04, the clock says 2026-05-05",
        ),
        ({"altitude": "ellipsoidal"}, STATED | {"height": "orthometric"}, ConfigError, "one kind of heights"),
    ],
)
def test_what_is_stated_wrongly(tmp_path: Path, options: dict, stated: dict, error: type, says: str) -> None:
    path = write(tmp_path / "a.nmea", gga("093000.00"), rmc("093000.00", "040526"))
    with pytest.raises(error, match=says):
        format_named("nmea").header(source_of("nmea", path, options, **stated))


# --- dates -------------------------------------------------------------------------------------------


def test_the_date_of_all_logs_is_for_a_log_without_one(tmp_path: Path) -> None:
    defaults = SourceDefaults(week=Clock(TimeSystem.GPS_WEEK, date=dt.date(2026, 5, 3)))
    undated = write(tmp_path / "a.nmea", gga("093000.00"))
    dated = write(tmp_path / "b.nmea", gga("093000.00"), rmc("093000.00", "040526"))
    epochs = [read_log("nmea", file, **STATED, defaults=defaults).epochs[0] for file in (undated, dated)]
    assert epochs == [gps_ns_from_utc(dt.datetime(2026, 5, day, 9, 30, tzinfo=dt.UTC)) for day in (3, 4)]


def test_a_log_without_a_date_asks_for_it(tmp_path: Path) -> None:
    path = write(tmp_path / "a.nmea", gga("235959.00"), gga("000000.50"), rmc("000000.50", "040526", status="V"))
    with pytest.raises(TimeSystemError, match="no sentence states a date"):
        format_named("nmea").header(source_of("nmea", path, **STATED))
    clock = Clock(TimeSystem.UNIX_UTC, date=dt.date(2026, 12, 31), offset_s=0.25)
    log = read_log("nmea", path, clock=clock, **STATED)
    start = at("2026-12-31T23:59:59") + 250_000_000
    np.testing.assert_array_equal(log.epochs, [start, start + 1_500_000_000])


@pytest.mark.parametrize("block", [1 << 20, 100])
def test_midnight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    """The one date comes hours into the log, and behind a midnight; another midnight follows."""
    monkeypatch.setattr(text_table, "BLOCK_BYTES", block)
    hours = [20, 21, 22, 23, 0, 1, 2, *range(3, 24), 0, 1]
    lines = [gga(f"{hour:02d}3000.00") for hour in hours]
    lines.insert(6, rmc("013000.00", "050526"))
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.attributes["date"] == "2026-05-04"
    assert log.rejects == []
    start = at("2026-05-04T20:30:00")
    np.testing.assert_array_equal(log.epochs, start + np.arange(len(hours)) * 3600 * 10**9)


def test_days_that_are_missing_from_a_log(tmp_path: Path) -> None:
    """GGA stands before RMC, and takes the date of its own epoch; one without a date between is refused."""
    lines = [gga("093000.00"), rmc("093000.00", "040526"), gga("093500.00"), gga("094000.00")]
    lines += [rmc("094000.00", "070526")]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.epochs.tolist() == [at("2026-05-04T09:30:00"), at("2026-05-07T09:40:00")]
    assert [(r.record, r.reason) for r in log.rejects] == [
        (2, "its date is not known: the dates before and after it do not follow")
    ]


@pytest.mark.parametrize("order", [(gga, rmc), (rmc, gga)])
def test_the_same_time_of_a_later_day(tmp_path: Path, order: tuple[Any, Any]) -> None:
    """Whole days are missing between two epochs: the stated dates tell them apart, whichever sentence comes first."""
    dates = ["040526", "050526", "090526"]
    lines = [make("093000.00", *([date] if make is rmc else [])) for date in dates for make in order]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.rejects == []
    assert log.epochs.tolist() == [at(f"2026-05-{day}T09:30:00") for day in ("04", "05", "09")]
    assert log.column("quality").tolist() == ["fixed"] * 3
    np.testing.assert_allclose(log.column("speed_m_per_s"), 10 * KNOT)


def test_the_first_date_of_an_epoch_stands(tmp_path: Path) -> None:
    """RMC and ZDA that contradict each other are one epoch all the same."""
    zda = checked("GNZDA,093000.00,05,05,2026,00,00")
    row = only(
        read_log("nmea", write(tmp_path / "a.nmea", rmc("093000.00", "040526"), zda, gga("093000.00")), **STATED)
    )
    assert (row["epoch_gps_ns"], row["quality"]) == (at("2026-05-04T09:30:00"), "fixed")


def test_a_leap_second(tmp_path: Path) -> None:
    lines = [rmc("235959.50", "311216"), gga("235960.00"), gga("235960.50"), gga("000000.00"), gga("000000.50")]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    assert log.rejects == []
    start = at("2016-12-31T23:59:59") + 500_000_000
    np.testing.assert_array_equal(log.epochs, start + np.arange(5) * 500_000_000)
    no_leap = write(tmp_path / "b.nmea", rmc("235959.50", "311217"), gga("235960.00"))
    (reject,) = read_log("nmea", no_leap, **STATED).rejects
    assert reject.reason == "time is 23:59:60 on a day without a leap second"


# --- writer, and another library -----------------------------------------------------------------------

KINDS = ("GGA", "RMC", "GST", "PASHR", "HDT", "VTG", "ZDA")


def drive(count: int = 200) -> list[Fix]:
    rng = np.random.default_rng(5)
    start = at("2026-05-04T23:59:00")
    t = np.arange(count) * 0.5
    return [
        Fix(
            start + round(s * 1e9),
            latitude_deg=-33.9 + 1e-5 * s,
            longitude_deg=-70.5 + 2e-5 * s,
            altitude_m=520.0 + 0.01 * s,
            undulation_m=27.5,
            quality=("fixed", "float", "dgps", "single")[int(rng.integers(4))],
            satellites=int(rng.integers(4, 30)),
            hdop=0.75,
            age_s=1.5,
            sigma_ned_m=(0.011, 0.012, 0.023),
            speed_m_per_s=float(rng.uniform(0.1, 30)),
            course_deg=float(rng.uniform(0, 360)),
            heading_deg=float(rng.uniform(0, 360)),
            roll_deg=float(rng.uniform(-9, 9)),
            pitch_deg=float(rng.uniform(-9, 9)),
            sigma_rph_deg=(0.02, 0.03, 0.15),
        )
        for s in t
    ]


def test_round_trip(tmp_path: Path) -> None:
    fixes = drive()
    write_nmea(tmp_path / "a.nmea", fixes, KINDS)
    log = read_log("nmea", tmp_path / "a.nmea", **STATED)
    assert log.rejects == []
    np.testing.assert_array_equal(log.epochs, [f.epoch_gps_ns for f in fixes])
    place = np.stack(GEODETIC.transform(*log.positions.T), axis=-1)
    expected = [(f.longitude_deg, f.latitude_deg, f.altitude_m + f.undulation_m) for f in fixes]
    np.testing.assert_allclose(place, expected, atol=1.1e-4)
    np.testing.assert_allclose(place[:, :2], np.array(expected)[:, :2], atol=1e-9)
    assert log.table.column("quality").to_pylist() == [f.quality for f in fixes]
    for name in ("satellites", "hdop", "age_s", "undulation_m"):
        np.testing.assert_allclose(log.column(name), [getattr(f, name) for f in fixes], rtol=1e-6)
    for name in ("course_deg", "heading_deg", "roll_deg", "pitch_deg"):
        np.testing.assert_allclose(log.column(name), [getattr(f, name) for f in fixes], atol=0.51e-3)
    speed = np.hypot(log.column("velocity_north_m_per_s"), log.column("velocity_east_m_per_s"))
    np.testing.assert_allclose(speed, [f.speed_m_per_s for f in fixes], atol=0.3e-4)
    for i, name in enumerate(("sigma_north_m", "sigma_east_m", "sigma_down_m")):
        np.testing.assert_allclose(log.column(name), fixes[0].sigma_ned_m[i], rtol=1e-6)
    for i, name in enumerate(("sigma_roll_deg", "sigma_pitch_deg", "sigma_heading_deg")):
        np.testing.assert_allclose(log.column(name), fixes[0].sigma_rph_deg[i], rtol=1e-6)


def test_another_library_reads_what_is_written() -> None:
    for fix in drive(40):
        text = sentences(fix, ("GGA", "RMC", "GST", "HDT", "VTG", "ZDA")).splitlines()
        first, second, third, heading, course, date = (pynmea2.parse(line, check=True) for line in text)
        assert first.latitude == pytest.approx(fix.latitude_deg, abs=1e-9)
        assert first.longitude == pytest.approx(fix.longitude_deg, abs=1e-9)
        assert float(first.altitude) == pytest.approx(fix.altitude_m, abs=1e-4)
        assert float(first.geo_sep) == fix.undulation_m
        assert gps_ns_from_utc(second.datetime.replace(tzinfo=dt.UTC)) == fix.epoch_gps_ns
        assert gps_ns_from_utc(dt.datetime.combine(date.datestamp, date.timestamp, dt.UTC)) == fix.epoch_gps_ns
        assert second.spd_over_grnd * KNOT == pytest.approx(fix.speed_m_per_s, abs=1e-4)
        assert float(third.std_dev_altitude) == fix.sigma_ned_m[2]
        assert float(heading.heading) == pytest.approx(fix.heading_deg, abs=1e-3)
        assert float(course.spd_over_grnd_kmph) == pytest.approx(fix.speed_m_per_s * 3.6, abs=1e-3)


def test_what_another_library_writes_is_read(tmp_path: Path) -> None:
    fields = ("101530.25", "3342.6618", "S", "07033.0015", "W", "2", "17", "0.61", "710.123", "M", "24.7", "M", "3", "")
    date = ("101530.25", "A", "3342.6618", "S", "07033.0015", "W", "12.5", "271.3", "010203", "", "", "D")
    lines = [str(pynmea2.GGA("GL", "GGA", fields)), str(pynmea2.RMC("GL", "RMC", date))]
    log = read_log("nmea", write(tmp_path / "a.nmea", *lines), **STATED)
    parsed = pynmea2.parse(lines[0])
    expected = ecef(parsed.longitude, parsed.latitude, 710.123 + 24.7)
    np.testing.assert_allclose(log.positions[0], expected, atol=1e-6)
    assert log.epochs[0] == at("2003-02-01T10:15:30") + 250_000_000


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    latitude=st.floats(-90, 90),
    longitude=st.floats(-180, 180),
    epoch=st.integers(at("1999-01-01T00:00:00"), at("2040-01-01T00:00:00")),
)
def test_any_place_and_time(
    tmp_path_factory: pytest.TempPathFactory, latitude: float, longitude: float, epoch: int
) -> None:
    """Minutes never round up to sixty, nor seconds."""
    path = tmp_path_factory.getbasetemp() / "any.nmea"
    write_nmea(path, [Fix(epoch, latitude, longitude, 0.0, 0.0)], form=NmeaForm(time_decimals=9, minute_decimals=9))
    log = read_log("nmea", path, **STATED)
    assert log.rejects == []
    assert log.epochs[0] == epoch
    np.testing.assert_allclose(log.positions[0], ecef(longitude, latitude, 0.0), atol=1e-4)


def test_leap_seconds_and_roundings_are_written() -> None:
    leap = at("2017-01-01T00:00:00") - 10**9
    assert "235960.00," in sentences(Fix(leap), ("ZDA",))
    assert ",31,12,2016," in sentences(Fix(leap), ("ZDA",))
    nearly = at("2026-05-04T23:59:59") + 999_999_999
    assert sentences(Fix(nearly), ("ZDA",)).startswith("$GNZDA,000000.00,05,05,2026,")
    with pytest.raises(ConfigError, match=r"sentence 'GGB' cannot be written \(did you mean 'GGA'\?\)"):
        sentences(Fix(nearly), ("GGB",))


# --- damage ------------------------------------------------------------------------------------------


def test_each_damaged_sentence_costs_itself(tmp_path: Path) -> None:
    lines = ["# logger 7", "", rmc("093000.00", "040526")]
    lines += [f"[12:00:0{i}] rx> " + gga(f"0930{i:02d}.00") for i in range(1, 10)]
    lines[4] = lines[4].replace("5000.0", "5001.0")
    lines[5] = lines[5].split("*")[0]
    lines[6] = "[12:00:04] rx> " + checked(gga("093004.00").split("*")[0][1:].replace("5000.0", "5060.0"))
    lines[7] = lines[7][:50] + lines[8]  # a sentence breaks off, another follows in its line
    lines[8] = "\x00\x01\x02\xff"
    lines[9] = "[12:00:07] rx> " + checked("GNGGA,0930x7.00,5000.0,N,01000.0,E,4,12,0.8,100.0,M,40.0,M,,")
    path = write(tmp_path / "a.nmea", *lines, gga("093009.00"), "$GNGGA,0930")
    text = path.read_bytes()
    log = read_log("nmea", path, **STATED)
    offsets = [text.index(line.encode("latin-1")) if line else -1 for line in lines]

    def dollar(line: int) -> int:
        return text.index(b"$", offsets[line])

    assert {(r.record, r.offset): r.reason for r in log.rejects} == {
        (0, 0): "there is no sentence ($…) in the line",
        (4, dollar(4)): "the sentence does not fit its checksum",
        (5, dollar(5)): "the sentence breaks off before its checksum",
        (6, dollar(6)): "latitude is not degrees and minutes",
        (7, dollar(7)): "the sentence breaks off before its checksum",
        (8, offsets[8]): "there is no sentence ($…) in the line",
        (9, dollar(9)): "time '0930x7.00' is not a number",
        (12, text.rindex(b"$GNGGA,093009")): "a second GGA sentence of one epoch: the first stands",
        (13, text.rindex(b"$")): "the sentence breaks off before its checksum",
    }
    seconds = (log.epochs - at("2026-05-04T09:30:00")) / 1e9
    assert seconds.tolist() == [0, 1, 6, 8, 9]


def ubx(rng: random.Random, size: int) -> bytes:
    """A frame of u-blox: two sync bytes, class, length, anything, two of checksum."""
    return b"\xb5\x62\x02\x15" + size.to_bytes(2, "little") + rng.randbytes(size + 2)


def mixed(frames: int = 8, seconds: int = 20) -> tuple[bytes, list[int]]:
    """A log with binary frames between the epochs, and where each stretch of them starts."""
    rng = random.Random("roadscan mixed")
    data, stretches = b"", []
    for i in range(seconds):
        stretches.append(len(data))
        data += b"".join(ubx(rng, 400) for _ in range(frames))
        data += f"{rmc(f'0930{i:02d}.00', '040526')}\r\n{gga(f'0930{i:02d}.00')}\r\n".encode()
    return data, stretches


def test_binary_messages_between_the_sentences(tmp_path: Path) -> None:
    data, stretches = mixed()
    path = tmp_path / "a.ubx"
    path.write_bytes(data)
    assert format_of(path).name == "nmea"
    log = read_log("nmea", path, **STATED)
    assert log.epochs.tolist() == [at(f"2026-05-04T09:30:{i:02d}") for i in range(20)]
    assert log.column("quality").tolist() == ["fixed"] * 20
    assert {r.reason for r in log.rejects} == {"binary data between the sentences"}
    places = [int(np.searchsorted(stretches, r.offset, side="right")) for r in log.rejects]
    assert len(places) == len(set(places)), "a stretch is rejected twice"
    assert b"$" in data[stretches[0] : stretches[0] + 3000], "nothing in the data looks like a sentence"


def test_a_damaged_sentence_in_binary_data_keeps_its_reason(tmp_path: Path) -> None:
    data, stretches = mixed(seconds=3)
    damaged = gga("093000.50").replace("5000.0", "5000.1").encode() + b"\r\n"
    cut = stretches[1] + 1000
    path = tmp_path / "a.ubx"
    path.write_bytes(data[:cut] + b"\n" + damaged + data[cut:])
    log = read_log("nmea", path, **STATED)
    assert log.table.num_rows == 3
    assert [r.offset for r in log.rejects if r.reason == "the sentence does not fit its checksum"] == [cut + 1]
    assert len(log.rejects) <= 4, "three stretches and the sentence"


def test_faulty_fields(tmp_path: Path) -> None:
    bodies = {
        "GNGGA,093001,5000.0,N,01000.0,E,X,12,0.8,100.0,M,40.0,M,,": "quality 'X' is not a number",
        "GNGGA,093002,5000.0,Q,01000.0,E,4,12,0.8,100.0,M,40.0,M,,": "latitude_side is not N or S",
        "GNGGA,093003,5000.0,N,01000.0,E,4,12,0.8,100.0,F,40.0,M,,": "altitude_unit is not M",
        "GNGGA,093004,,,,,4,12,0.8,100.0,M,40.0,M,,": "the sentence states a fix and no position",
        "GNGGA,093005,5000.0,N,01000.0,E,4,12,0.8,,M,40.0,M,,": "the sentence states a fix and no altitude",
        "GNGGA,,5000.0,N,01000.0,E,4,12,0.8,100.0,M,40.0,M,,": "the sentence states no time",
        "GNGGA,246000,5000.0,N,01000.0,E,4,12,0.8,100.0,M,40.0,M,,": "time is not a time of the day (hhmmss)",
        "GNGGA,093008,5000.0": "the sentence has 2 fields, expected 12",
        "GNRMC,093009,A,,,,,1.0,2.0,310226,,,A": "there is no such date",
        "GNHDT,12.0,M": "heading_side is not T",
        "GNGGA,093010,9100.0,N,01000.0,E,4,12,0.8,100.0,M,40.0,M,,": "latitude is outside 0 to 90 degrees",
        "GNGGA,093011,5000.0,N,01000.0,E,4,1e9,0.8,100.0,M,40.0,M,,": (
            "number of satellites is not a whole number from 0 to 255"
        ),
    }
    path = write(tmp_path / "a.nmea", rmc("093000.00", "040526"), *map(checked, bodies), gga("093012.00"))
    log = read_log("nmea", path, **STATED)
    assert {r.record: r.reason for r in log.rejects} == dict(enumerate(bodies.values(), 1))
    assert log.table.num_rows == 2


def test_positions_without_heights(tmp_path: Path) -> None:
    path = write(tmp_path / "a.nmea", rmc("093000.00", "040526"), rmc("093001.00", "040526"))
    with pytest.raises(FormatError, match=r"a\.nmea: 2 RMC sentences state a position, and no GGA"):
        read_log("nmea", path, **STATED)


def test_a_truncated_packed_log(tmp_path: Path) -> None:
    path = tmp_path / "a.nmea.gz"
    fixes = [replace(f, heading_deg=float(i)) for i, f in enumerate(drive(300))]
    whole = gzip.compress("".join(sentences(f, KINDS) for f in fixes).encode())
    path.write_bytes(whole[: len(whole) // 2])
    log = read_log("nmea", path, **STATED)
    assert 50 < log.table.num_rows < 300
    assert any("damaged from here on" in r.reason for r in log.rejects)


def test_a_clock_that_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sentences are not held for ever."""
    monkeypatch.setattr(text_table, "BLOCK_BYTES", 5000)
    monkeypatch.setattr("roadscan.formats.motion.nmea.HELD_MAX", 100)
    path = write(tmp_path / "a.nmea", rmc("093000.00", "040526"), *[gga("093000.00")] * 1000)
    log = read_log("nmea", path, **STATED)
    assert log.table.num_rows + sum(r.records for r in log.rejects) >= 1000
    assert log.table.num_rows > 1


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    is_nmea = format_named("nmea").sniff
    path = tmp_path / "a"
    path.write_bytes(sample())
    assert format_of(path).name == "nmea"
    assert is_nmea(write(tmp_path / "b", "logger", "x " + GGA, "y " + RMC, GGA[:30]))
    assert not is_nmea(write(tmp_path / "c", GGA[:30], RMC[:30]))
    assert not is_nmea(write(tmp_path / "d", "a,b,c", "1,$5,3"))
    assert not is_nmea(write(tmp_path / "e", "\x00" + GGA))
    capture = b"\xd4\xc3\xb2\xa1" + b"\x00" * 20 + mixed()[0]  # position packets of a lidar hold sentences too
    (tmp_path / "f").write_bytes(capture)
    assert not is_nmea(tmp_path / "f")
    (tmp_path / "g").write_bytes(random.Random(5).randbytes(40_000))
    assert not is_nmea(tmp_path / "g")
    assert not is_nmea(tmp_path)
    assert not is_nmea(tmp_path / "absent")
    assert [p for p in recordings.rglob("*") if p.is_file() and is_nmea(p)] == []
