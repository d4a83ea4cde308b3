"""Trajectories that offices export, in lines as the programs write them, against pyproj and SciPy's rotations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, CrsError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import Log, read_log

WEEK_NS, S = 604_800 * 10**9, 10**9
EXPLORER = """Project:     drive
Program:     Inertial Explorer Version 8.90.6611
Source:      GNSS/INS Epochs(Smoothed TC Combined)
Datum:       WGS84, (processing datum)
SD Scaling Settings:
  Position: 2.0000
  Velocity: 1.0000
  Attitude: 1.0000

      UTCTime       Week   GPSTime         Latitude        Longitude        H-Ell VelBdyX SDNorth  SDEast SDHeight           Roll          Pitch        Heading  HdngSD Q
        (sec)    (weeks)     (sec)       (+/-D M S)       (+/-D M S)          (m)   (m/s)     (m)     (m)      (m)          (deg)          (deg)          (deg)   (deg)
"""  # noqa: E501
POSE = "{utc:.2f} 2158.00000 {t:.2f}   22 18 05.61075  -0 11 25.11071        2.894  -0.004   0.020   0.040    0.060  -0.2074966655  -0.6303452479 -59.3645242579   0.050 1\n"  # noqa: E501
COLUMNS = "TIME, DISTANCE, EASTING, NORTHING, ELLIPSOID HEIGHT, LATITUDE, LONGITUDE, ELLIPSOID HEIGHT, ROLL, PITCH, HEADING, EAST VELOCITY, NORTH VELOCITY, UP VELOCITY, EAST SD, NORTH SD, HEIGHT SD, ROLL SD, PITCH SD, HEADING SD"  # noqa: E501
POSPAC = f""" POS Export Utility
 Copyright (C) 1997-2018 by Applanix Corporation      [May 17 2018]
 Mission Start Time:
   Date of Mission: 2018-08-07
   Start Time: 06:38:26
 Mapping frame datum: WGS84  ; Mapping frame projection : TM;
 Boresight values: tx =        0.0000 arc min, ty =        0.0000 arc min, tz =        0.0000 arc min.
 {COLUMNS}

  (time in Sec, distance in Meters, position in Meters, lat, long in Degrees, orientation angles and SD in Degrees, velocity in Meter/Sec, position SD in Meters)
"""  # noqa: E501
QINERTIA = """Qinertia 4.0
Project: drive
UTC Date\tUTC Time\tLongitude\tLongitude Std.\tLatitude\tLatitude Std.\tAltitude Ellipsoid\tAltitude Std.\tRoll\tPitch\tYaw\tYaw Std.\tEast Velocity\tNorth Velocity\tDown Velocity
(yyyy-mm-dd)\t(hh:mm:ss)\t(deg)\t(m)\t(deg)\t(m)\t(m)\t(m)\t(deg)\t(deg)\t(deg)\t(deg)\t(m/s)\t(m/s)\t(m/s)
"""  # noqa: E501


def explorer(count: int = 12) -> str:
    return EXPLORER + "".join(POSE.format(utc=1_621_578_524 + k, t=455_342 + k) for k in range(count))


def pospac(count: int = 12) -> str:
    easting, northing = pyproj.Proj("EPSG:32632")(11.5, 48.1)
    place = f"{easting:.4f} {northing:.4f} 512.25 48.1 11.5 512.25"
    rest = "1.5 -2.25 200.5 3.0 -4.0 0.5 0.01 0.02 0.03 0.004 0.005 0.006"
    return POSPAC + "".join(f"  {196_706 + k}.005 {k}.0 {place} {rest}\n" for k in range(count))


def qinertia(count: int = 12) -> str:
    rest = "11.5\t0.01\t48.1\t0.02\t512.25\t0.03\t1.5\t-2.25\t200.5\t0.05\t3.0\t-4.0\t-0.5"
    return QINERTIA + "".join(f"2026-05-04\t09:30:{k:02d}.005\t{rest}\n" for k in range(count))


def read(folder: Path, name: str, text: str, options: dict[str, Any] | None = None, **stated: Any) -> Log:
    path = folder / "export.txt"
    path.write_text(text)
    assert format_of(path).name == name
    return read_log(name, path, options, **{"crs": "EPSG:4979"} | stated)


def body(longitude: float, latitude: float, rph: tuple[float, float, float]) -> Rotation:
    """World from body (forward, right, down) by SciPy: Earth from north-east-down, heading, pitch, roll."""
    ned = Rotation.from_euler("ZY", [longitude, -latitude - 90], degrees=True)
    return ned * Rotation.from_euler("ZYX", rph[::-1], degrees=True)


def test_inertial_explorer_in_degrees_minutes_and_seconds(tmp_path: Path) -> None:
    log = read(tmp_path, "inertial_explorer", explorer())
    latitude, longitude = 22 + 18 / 60 + 5.61075 / 3600, -(11 / 60 + 25.11071 / 3600)  # a negative zero has its sign
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(latitude, longitude, 2.894)
    np.testing.assert_allclose(log.positions[0], place, atol=1e-6)
    np.testing.assert_array_equal(log.epochs, 2158 * WEEK_NS + (455_342 + np.arange(12)) * S)
    turned = log.attitudes[0] * body(longitude, latitude, (-0.2074966655, -0.6303452479, -59.3645242579)).inv()
    assert turned.magnitude() < 1e-12
    assert log.attributes["says"]["Datum"] == "WGS84, (processing datum)"
    sigmas = [log.column(f"sigma_{name}")[0] for name in ("north_m", "east_m", "down_m", "heading_deg")]
    np.testing.assert_allclose(sigmas, [0.01, 0.02, 0.03, 0.05], rtol=1e-6)  # written as two σ of position


def test_inertial_explorer_without_its_preamble_and_with_commas(tmp_path: Path) -> None:
    whole = read(tmp_path, "inertial_explorer", explorer())
    bare = "\n".join(explorer().splitlines()[9:]) + "\n"
    assert read(tmp_path, "inertial_explorer", bare).epochs.tolist() == whole.epochs.tolist()
    names = "Week,GPSTime,Latitude,Longitude,H-Ell,Roll,Pitch,Heading,Q"
    units = "(weeks),(sec),(deg),(deg),(m),(deg),(deg),(deg),"
    pose = "2158,455342.00,22.301558541667,-0.190308530556,2.894,-0.2074966655,-0.6303452479,-59.3645242579,1"
    commas = read(tmp_path, "inertial_explorer", f"{names}\n{units}\n{pose}\n")
    np.testing.assert_allclose(commas.positions[0], whole.positions[0], atol=1e-4)
    assert commas.epochs[0] == whole.epochs[0]


def test_inertial_explorer_by_date(tmp_path: Path) -> None:
    names = "   CorrTime       Date         Latitude        Longitude    H-MSL        Heading      Pitch       Roll\n"
    units = "     (sec)      (MDY)       (+/-D M S)       (+/-D M S)      (m)          (Deg)      (Deg)      (Deg)\n"
    poses = [
        f"{time}  {date}  -79 28 10.85149 -112 03 17.05073  1765.359  51.23  -1.28  0.02\n"
        for time, date in (
            ("598861.01", "1/02/2010"), ("80461.51", "1/02/2010"), ("598862.01", "1/02/2010"),
            ("598863.01", "1/03/2010"), ("598864.01", "13/02/2010"),
        )
    ]  # fmt: skip
    text = "Program:     Inertial Explorer Version 8.30.0623\n\n" + names + units + "".join(poses)
    with pytest.raises(CrsError, match="orthometric"):
        read(tmp_path, "inertial_explorer", text, height="ellipsoidal")
    with pytest.raises(CrsError, match="geoid"):
        read(tmp_path, "inertial_explorer", text)
    ellipsoidal = text.replace("H-MSL", "H-Ell")
    log = read(tmp_path, "inertial_explorer", ellipsoidal)
    # 2 January 2010 is the Saturday of week 1564: seconds of the week and of the day, as either is exported
    expected = 1564 * WEEK_NS + np.array([598_861_010, 6 * 86_400_000 + 80_461_510, 598_862_010]) * 10**6
    np.testing.assert_array_equal(log.epochs, expected)
    assert {r.record: r.reason for r in log.rejects} == {
        3: "the seconds of the week are of another day than the date", 4: "the date is none",
    }  # fmt: skip


def test_years_of_two_digits(tmp_path: Path) -> None:
    """GPS time began in 1980: 26 is 2026. Where the order is not stated, 05/04/26 may be three dates, and is none."""
    names = "Date,GPSTime,Latitude,Longitude,H-Ell,Roll,Pitch,Heading\n"
    pose = "{date},122418.000,48.0,11.0,500.0,0.1,0.2,90.0\n"
    for unit, dates, sound in (
        ("(MDY)", ("05/04/2026", "05/04/26", "05/04/0026", "05/04/6"), 2),
        ("(YMD)", ("2026/05/04", "26/05/04", "026/05/04"), 2),
        ("", ("2026/05/04", "26/05/04", "05/04/26"), 1),
    ):
        units = f"{unit},(sec),(deg),(deg),(m),(deg),(deg),(deg)\n"
        lines = "".join(pose.format(date=date) for date in dates)
        log = read(
            tmp_path, "inertial_explorer", "Program:     Inertial Explorer Version 8.90\n\n" + names + units + lines
        )
        assert log.epochs.tolist() == [2417 * WEEK_NS + 122_418 * S] * sound  # 4 May 2026 is the Monday of week 2417
        assert {one.reason for one in log.rejects} == {"the date is none"}


def test_pospac_by_degrees_and_by_grid(tmp_path: Path) -> None:
    clock = Clock(TimeSystem.GPS_WEEK, week=2013)
    log = read(tmp_path, "pospac_text", pospac(), clock=clock)
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(48.1, 11.5, 512.25)
    np.testing.assert_allclose(log.positions[0], place, atol=1e-6)
    assert log.epochs[0] == 2013 * WEEK_NS + 196_706_005 * 10**6
    assert (log.attitudes[0] * body(11.5, 48.1, (1.5, -2.25, 200.5)).inv()).magnitude() < 1e-12
    np.testing.assert_allclose(log.rows[0].velocity_level_m_per_s[0], [-4, 3, -0.5])
    assert log.column("sigma_down_m")[0] == pytest.approx(0.03)
    grid = read(tmp_path, "pospac_text", pospac(), {"heading": "true"}, clock=clock, crs="EPSG:32632")
    np.testing.assert_allclose(grid.positions, log.positions, atol=2e-4)
    assert (grid.attitudes[0] * log.attitudes[0].inv()).magnitude() < 1e-9


def test_qinertia_in_utc(tmp_path: Path) -> None:
    log = read(tmp_path, "qinertia", qinertia())
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(48.1, 11.5, 512.25)
    np.testing.assert_allclose(log.positions[0], place, atol=1e-6)
    assert log.epochs[0] == 2417 * WEEK_NS + (1 * 86_400 + 9 * 3600 + 30 * 60 + 18) * S + 5_000_000  # a Monday
    assert (log.attitudes[0] * body(11.5, 48.1, (1.5, -2.25, 200.5)).inv()).magnitude() < 1e-12
    np.testing.assert_allclose(log.rows[0].velocity_level_m_per_s[0], [-4, 3, -0.5])
    assert [log.column(f"sigma_{axis}_m")[0] for axis in ("north", "east")] == pytest.approx([0.02, 0.01])


@pytest.mark.parametrize(
    ("name", "text", "stated", "error", "says"),
    [
        ("inertial_explorer", explorer(), {"crs": None}, ConfigError, "CRS"),
        ("inertial_explorer", explorer(), {"clock": Clock(TimeSystem.UNIX_UTC)}, TimeSystemError, "GPS time"),
        ("inertial_explorer", explorer(), {"clock": Clock(TimeSystem.GPS_WEEK, week=2157)}, TimeSystemError, "2158"),
        ("inertial_explorer", explorer(), {"crs": "EPSG:25832"}, ConfigError, "easting"),
        ("inertial_explorer", explorer().replace("(m)", "(ft)"), {}, FormatError, "'ft'"),
        ("inertial_explorer", explorer(0) + "1 2 3\n4 5 6\n", {}, FormatError, "names 19 columns.*has 3"),
        ("pospac_text", pospac(), {}, TimeSystemError, "time system"),
        ("pospac_text", pospac(), {"clock": Clock(TimeSystem.GPS_WEEK, week=2014)}, TimeSystemError, "08-07.*2013"),
        ("pospac_text", pospac().replace("long in Degrees", "long in Gons"), {}, RoadscanError, "Gons"),
        ("qinertia", qinertia().replace("(deg)", ""), {}, FormatError, "no unit"),
    ],
)  # fmt: skip
def test_nothing_is_guessed(
    tmp_path: Path, name: str, text: str, stated: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        read(tmp_path, name, text, **stated)


def test_the_date_of_the_mission_is_proposed(tmp_path: Path) -> None:
    with pytest.raises(TimeSystemError) as raised:
        read(tmp_path, "pospac_text", pospac())
    assert "2018-08-07" in str(raised.value)


def test_damage_costs_its_line(tmp_path: Path) -> None:
    lines = explorer().splitlines(keepends=True)
    lines[13] = lines[13].replace("22 18 05", "22 78 05")
    lines[15] = "unreadable\n"
    log = read(tmp_path, "inertial_explorer", "".join(lines) + "\nFooter lines of the export\n")
    assert log.epochs.size == 10
    assert {r.reason.split(" is ")[0] for r in log.rejects if r.record < 12} >= {"Latitude"}


# --- positions without attitude -----------------------------------------------------------------------

GRAFNAV = """Project:     drive
Program:     GrafNav Version 8.90.2124
Source:      GNSS Epochs(Smoothed)
Datum:       ETRS89
SD Scaling Settings:
  Position: 2.0000

     Date      GPSTime       Latitude        Longitude        H-Ell   SDNorth  SDEast SDHeight Q
    (MDY)        (sec)          (deg)            (deg)          (m)       (m)     (m)      (m)
"""


def grafnav(count: int = 12) -> str:
    rows = (f" 5/04/2025 {32_418 + k}.00 50.1{k:02d}0000 7.3{k:02d}0000 160.{k:03d} 0.010 0.012 0.020 {1 + k % 2}\n"
            for k in range(count))  # fmt: skip
    return GRAFNAV + "".join(rows)


def test_grafnav_positions_without_attitude_are_a_log_of_gnss(tmp_path: Path) -> None:
    path = tmp_path / "grafnav.txt"
    path.write_text(grafnav(4))
    assert format_of(path).name == "grafnav"
    log = read_log("grafnav", path, crs="EPSG:4937")
    places = np.array([[7.3 + 1e-3 * k, 50.1 + 1e-3 * k, 160 + 1e-3 * k] for k in range(4)])
    ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*places.T)
    np.testing.assert_allclose(log.positions, np.stack(ecef, axis=1), atol=1e-3)
    assert log.epochs[0] == 1_430_384_418 * S  # 2025-05-04, a Sunday: 32,418 s into the week
    assert log.column("quality").tolist() == ["fixed", "float"] * 2
    np.testing.assert_allclose(log.column("sigma_east_m"), 0.006)  # the preamble says 2 σ
    path.write_text(grafnav(4).replace(" Q\n", "\n").replace(" 1\n", "\n").replace(" 2\n", "\n"))
    with pytest.raises(ConfigError, match="kind of solution"):
        read_log("grafnav", path, crs="EPSG:4937")
    assert set(read_log("grafnav", path, {"quality": "fixed"}, crs="EPSG:4937").column("quality")) == {"fixed"}
