"""Texts as other programs write them: calendar times, decimal commas, other encodings and line ends, commented names.

Each is read where it can be understood without a guess, and named with the way out where it cannot. The epochs are
those of `faults/README.md`: 2026-05-04T09:30:00Z is GPS ns 1461922218000000000.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

import roadscan as rs
from tests.answers import roadscan

FIRST_GPS_NS = 1_461_922_218_000_000_000
NAMES = "time,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
SURVEY = """
id = "x"
map = {{ crs = "EPSG:32632" }}
[[runs]]
id = "one"
[[runs.logs]]
path = "{name}"
format = "trajectory_csv"
crs = "EPSG:4979"
{clock}
"""


def poses(stamp: Callable[[int], str], names: str = NAMES) -> str:
    rows = [f"{stamp(k)},48.{k:06d},9.0,300.{k},0.5,0,10" for k in range(20)]
    return "\n".join([names, *rows, ""])


def utc(k: int) -> str:
    return f"2026-05-04T09:30:{k / 10:04.1f}Z"


CSV = poses(utc)
DATED = poses(lambda k: f"2026-05-04,09:30:{k / 10:04.1f}", NAMES.replace("time", "date,time_utc"))

READ: dict[str, bytes] = {
    "time": CSV.encode(),
    "timestamp": CSV.replace("time", "timestamp", 1).encode(),
    "datetime": CSV.replace("time", "DateTime", 1).encode(),
    "time_s": CSV.replace("time", "time_s", 1).encode(),
    "offset from UTC": poses(lambda k: utc(k).replace("T09", "T11").replace("Z", "+02:00")).encode(),
    "date and time_utc": DATED.encode(),
    "a byte order mark": b"\xef\xbb\xbf" + CSV.encode(),
    "UTF-16 LE": b"\xff\xfe" + CSV.encode("utf-16-le"),
    "UTF-16 BE": b"\xfe\xff" + CSV.encode("utf-16-be"),
    "UTF-32": CSV.encode("utf-32"),
    "carriage returns": CSV.replace("\n", "\r").encode(),
    "carriage returns and line feeds": CSV.replace("\n", "\r\n").encode(),
    "names behind a #": ("# exported by a program\n# " + CSV).encode(),
    "decimal commas": CSV.replace(",", ";").replace(".", ",").encode(),
}


@pytest.mark.parametrize("content", READ.values(), ids=READ)
def test_a_survey_reads_what_other_programs_write(tmp_path: Path, content: bytes) -> None:
    """The file is claimed by its content, asks for its CRS alone, and its poses have the times that it states."""
    (tmp_path / "t.csv").write_bytes(content)
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="t.csv", clock=""))
    (looked,) = json.loads(roadscan("inspect", tmp_path / "t.csv", "--json").stdout)
    assert looked["formats"] == ["trajectory_csv"]
    assert [need["key"] for need in looked["log"]["to_state"]] == ["crs"]
    assert looked["faults"] == []
    done = roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0")
    assert done.exit_code == 0, done.output
    table = rs.open_survey(tmp_path / "SURVEY.toml").table("trajectory")
    assert table.epoch_gps_ns.tolist() == [FIRST_GPS_NS + 100_000_000 * k for k in range(20)]
    assert np.allclose(np.ptp(table.z_world_m), 19e-6 * 111e3 * np.cos(np.radians(48)), atol=0.8)


def test_files_of_the_faults(faults: Path) -> None:
    for name, step_ns in (("iso_time", 100_000_000), ("iso_timestamp", 500_000_000), ("iso_z", 100_000_000)):
        (found,) = json.loads(roadscan("inspect", faults / "iso_time_message" / f"{name}.csv", "--json").stdout)
        time = found["log"]["time"]
        assert (time["first_gps_ns"], time["last_gps_ns"]) == (FIRST_GPS_NS, FIRST_GPS_NS + step_ns), name


def words_of(*arguments: str | Path) -> str:
    return " ".join(roadscan("inspect", *arguments).output.split())


@pytest.mark.witness("scale_of_calendar_times")
def test_a_calendar_time_without_a_zone_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(CSV.replace("Z", ""))
    assert "clock = { system = \"unix_utc\" } time '2026-05-04T09:30:00.0' has no zone" in words_of(path)
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="t.csv", clock='clock = { system = "unix_gps" }'))
    assert roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0").exit_code == 0
    table = rs.open_survey(tmp_path / "SURVEY.toml").table("trajectory")
    assert table.epoch_gps_ns.min() == FIRST_GPS_NS - 18_000_000_000  # 18 leap seconds lie between UTC and GPS time


def test_a_leap_second_is_read(tmp_path: Path) -> None:
    """That of the end of 2016 (IERS Bulletin C 52): UTC counts 23:59:60, and GPS − UTC grows from 17 s to 18 s."""
    seconds = [f"2016-12-31T23:59:{k / 2:04.1f}Z" for k in range(100, 122)]
    path = tmp_path / "t.csv"
    path.write_text(poses(lambda k: seconds[k + 2] if k < 20 else "").replace("\n\n", "\n"))
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="t.csv", clock=""))
    assert roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0").exit_code == 0
    table = rs.open_survey(tmp_path / "SURVEY.toml").table("trajectory")
    epochs = np.sort(table.epoch_gps_ns.to_numpy())
    assert np.diff(epochs).tolist() == [500_000_000] * 19
    assert epochs[-1] == (1_483_228_800 - 315_964_800 + 17) * 10**9 + 500_000_000  # 23:59:60.5, 17 s before the leap


POINTS = "name;easting;northing;height\n"
NAMED: dict[str, tuple[bytes, list[str]]] = {
    "a time of day alone": (
        poses(lambda k: utc(k)[11:]).encode(),
        ["column 'time' holds times of day such as '09:30:00.0Z', and no column holds the date"],
    ),
    "commas that may part thousands": (
        (POINTS + "a;500,100;600,200;300,100\nb;501,100;600,200;300,000\n").encode(),
        ["the comma of '500,100' is a decimal mark, or parts the thousands", 'options.decimal = ","'],
    ),
    "names in CP1252": (
        "Punkt;Höhe_m\na;1,5\n".encode("cp1252"),
        ["byte 0xf6 of the line of column names is not UTF-8", 'options.encoding = "cp1252"'],
    ),
    "UTF-16 without its mark": (
        CSV.encode("utf-16-le"),
        ["the text seems to be UTF-16-LE, and has no byte order mark", 'options.encoding = "utf-16-le"'],
    ),
    "one name twice": (
        CSV.replace("pitch_deg", "roll_deg").encode(),
        ["two columns are called 'roll_deg': the 5. and the 6.", "state options.names"],
    ),
    "German dates": (
        poses(lambda k: f"04.05.2026 09:30:{k / 10:04.1f}").encode(),
        ["'04.05.2026 09:30:00.0' is neither a number nor ISO 8601 text: day, month and year", "2026-05-04T09:30"],
    ),
    "AM": (poses(lambda k: f"2026-05-04 09:30:{k:02d} AM").encode(), ["hours of 12 with AM and PM"]),
    "a fraction behind a colon": (poses(lambda k: f"09:30:00:{k:03d}").encode(), ["stands behind a colon"]),
    "a leap second that there was not": (
        poses(lambda k: "2026-05-04T23:59:60Z" if k == 9 else utc(k)).encode(),
        ["1 × time is 23:59:60 on a day without a leap second"],
    ),
    "two columns of time": (
        CSV.replace("time,", "time,stamp,", 1).replace("Z,", "Z,1,").encode(),
        ["columns 'time' and 'stamp' both hold the time", 'columns = { time = { name = "time" } }'],
    ),
}


@pytest.mark.witness("decimal_mark")
@pytest.mark.parametrize(("content", "said"), NAMED.values(), ids=NAMED)
def test_what_cannot_be_understood_is_named_with_the_way_out(tmp_path: Path, content: bytes, said: list[str]) -> None:
    (tmp_path / "t.csv").write_bytes(content)
    words = words_of(tmp_path / "t.csv")
    assert [part for part in said if part not in words] == [], words
    assert "but ;" not in words
    assert "such as ;" not in words


def test_x_and_y_of_a_stated_crs_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("name,x_m,y_m,z_m\n1,5335013.45,691015.11,560.32\n2,5335008.33,691018.43,560.33\n")
    assert "can be read as control_csv" in words_of(path)
    words = words_of(path, "--crs", "EPSG:32632", "--height", "ellipsoidal")
    assert "can be read as control_csv, but not in the CRS" in words and "no column holds the easting" in words
    path.write_text(
        "name,easting_m,northing_m,height_m\n1,691015.11,5335013.45,560.32\n2,691018.43,5335008.33,560.33\n"
    )
    assert "560.320 to 560.330 m as written" in words_of(path)


@pytest.mark.witness("week_column")
def test_a_week_that_the_log_contradicts_is_refused(tmp_path: Path) -> None:
    """The log says week 2417, the survey file 2400; receivers that count weeks modulo 1024 say 369."""
    for week in (2417, 369):
        (tmp_path / "t.csv").write_text(poses(lambda k, w=week: f"{w},{120_618 + k / 10:.1f}", f"gps_week,{NAMES}"))  # type: ignore[misc]
        clock = 'clock = {{ system = "gps_week_seconds", week = {} }}'
        (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="t.csv", clock=clock.format(2400)))
        refused = roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0")
        said = " ".join(f"{refused.output} {refused.exception}".split())
        assert f"column 'gps_week' begins with week {week}" in said and "says week 2400" in said
        (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="t.csv", clock=clock.format(2417)))
        assert roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0").exit_code == 0


@pytest.mark.witness("text_encoding")
def test_an_umlaut_of_windows_is_read_once_its_encoding_is_stated(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(
        (
            POINTS.replace("height", "height_m") + "Mühle;3500100,25;5400200,5;300,125\nb;3501100,1;5600200,5;300\n"
        ).encode("cp1252")
    )
    assert "the line is not UTF-8 text, and options.encoding states no other" in words_of(path)
    stated = ("--crs", "EPSG:25832", "--option", "role=gcp", "--option", "encoding=cp1252", "--json")
    (found,) = json.loads(roadscan("inspect", path, *stated).stdout)
    assert (found["error"], found["faults"]) == (None, [])
    assert found["log"]["tables"]["control_points"]["rows"] == 2


TUM = "\n".join(f"{1_305_031_102.175304 + k * 0.01:.6f} {k * 0.1:.4f} 0 0 0 0 0 1" for k in range(30)) + "\n"
STAMPS: dict[str, tuple[str, str]] = {
    "TUM in seconds": (TUM, "s"),
    "TUM with a line of names": ("# ground truth\n# timestamp tx ty tz qx qy qz qw\n" + TUM, "s"),
    "TUM in nanoseconds": (
        "\n".join(f"{1_305_031_102_175_304_001 + k * 10**7} {k} 0 0 0 0 0 1" for k in range(9)),
        "ns",
    ),
    "TUM from 0": ("\n".join(f"{k * 0.01:.2f} {k * 0.1:.4f} 0 0 0 0 0 1" for k in range(30)), "s"),
    "milliseconds of a week": (poses(lambda k: f"{32_018_000 + 100 * k}"), "ms"),
    "seconds of a Sunday": (poses(lambda k: f"{32_018 + k / 10:.1f}"), "s"),
}


@pytest.mark.parametrize(("content", "unit"), STAMPS.values(), ids=STAMPS)
def test_the_unit_of_stamps_is_proposed_by_what_they_are(tmp_path: Path, content: str, unit: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(content)
    (found,) = json.loads(roadscan("inspect", path, "--json").stdout)
    needs = {need["key"]: need["line"] for need in found["log"]["to_state"]}
    assert needs["clock"] == f'clock = {{ system = "????", unit = "{unit}" }}'
    assert found["faults"] == []
    rate_hz = next(iter(found["log"]["tables"].values()))["rate_hz"]
    assert 9 < rate_hz < 101
    if "Sunday" in str(found["log"]["time"]["would_be"]):
        assert found["log"]["time"]["would_be"]["gps_week_seconds"] == "Sunday 08:53:38 GPS time" or unit == "s"


@pytest.mark.slow
def test_stamps_of_a_sunday_are_times(faults: Path) -> None:
    """LAS keeps seconds of the GPS week; below 86,400 they are a Sunday's."""
    (found,) = json.loads(roadscan("inspect", faults / "plane_week_seconds_sunday.laz", "--json").stdout)
    assert found["faults"] == []
    assert found["log"]["tables"]["cloud"]["rows"] == 28_185
    assert found["log"]["time"]["would_be"]["gps_week_seconds"] == "Sunday 12:06:59 GPS time"


def test_no_statement_is_blamed_that_nobody_made(faults: Path) -> None:
    for name in ("autzen_dd_epsg4326.las", "mississippi_navd88_feet_keys.las"):
        words = words_of(faults / name)
        assert "the survey file says the points are in local" not in words
        assert "neither the file nor the survey file says" not in words


def pictures(folder: Path, taken: str = "") -> Path:
    folder.mkdir()
    for k in range(3):
        path = folder / f"DSC_{k:04d}.jpg"
        cv2.imwrite(str(path), np.full((48, 64, 3), 20 * k, np.uint8))
        if taken:
            exif = Image.Exif()
            exif[ExifTags.Base.DateTime] = taken
            Image.open(path).save(path, exif=exif)
    return folder


def test_a_folder_of_pictures_says_which_stamps_it_needs(tmp_path: Path) -> None:
    words = words_of(pictures(tmp_path / "plain"))
    assert "the folder holds 3 images, and the images' stamps are not stated" in words
    assert "options.stamps" in words
    assert "options.pattern" in words
    assert "2026:05:04 11:30:00 on the camera's own clock" in words_of(
        pictures(tmp_path / "dated", "2026:05:04 11:30:00")
    )
    assert "one picture is no log" in words_of(tmp_path / "plain" / "DSC_0000.jpg")


def test_control_points_of_surveyors_are_recognised(faults: Path) -> None:
    """Words, decimal commas and a byte order mark; the survey file has to state no more than CRS and role."""
    for name, points, east in (("german_semicolon_decimal_comma_bom", 3, 500_001.234), ("pnezd_named", 2, 500_001.234)):
        (found,) = json.loads(roadscan("inspect", faults / f"{name}.csv", "--json").stdout)
        assert found["formats"] == ["control_csv"]
        assert {need["key"] for need in found["log"]["to_state"]} == {"crs", "options.role"}
        table = found["log"]["tables"]["control_points"]
        assert table["rows"] == points
        assert table["extent"]["low"][0] == pytest.approx(east, abs=1e-6)


@pytest.mark.parametrize(
    ("first", "order"),
    [
        ("2736120.40,673450.25", ["point", "northing", "easting", "elevation_m", "description"]),
        ("673450.25,2736120.40", ["point", "easting", "northing", "elevation_m", "description"]),
        ("5736120.40,3473450.25", None),
    ],
)
def test_points_that_no_line_names_are_read_in_the_order_that_their_size_tells(
    faults: Path, tmp_path: Path, first: str, order: list[str] | None
) -> None:
    """PNEZD. Where both numbers may be either, as in Gauss-Krüger coordinates, the order is asked for."""
    file = tmp_path / "points.csv"
    file.write_text((faults / "pnezd_no_header.csv").read_text().replace("2736120.40,673450.25", first, 1))
    (found,) = json.loads(roadscan("inspect", file, "--json").stdout)
    assert found["formats"] == ["control_csv"]
    lines = {need["key"]: need["line"] for need in found["log"]["to_state"]}
    assert set(lines) == {"crs", "options.names", "options.role"}
    words = "????" if order is None else ", ".join(f'"{name}"' for name in order)
    assert words in lines["options.names"]
    if order is not None:
        (tmp_path / "t.csv").write_text(poses(utc).replace("48.000", "24.730").replace(",9.0,", ",76.717,"))
        (tmp_path / "SURVEY.toml").write_text(
            'id = "s"\nruns = [{ id = "r", logs = [{ path = "t.csv", crs = "EPSG:4979" }] }]\n'
            '[map]\ncrs = "EPSG:32643"\n[[control]]\npath = "points.csv"\ncrs = "EPSG:32643"\nheight = "ellipsoidal"\n'
            f'options.role = "gcp"\n{lines["options.names"]}\n'
        )
        assert roadscan("ingest", tmp_path / "SURVEY.toml").exit_code == 0
        points = rs.open_survey(tmp_path / "SURVEY.toml").table("control_points")
        own = points[points.name == "1"].iloc[0]
        assert (own.easting_m, own.northing_m, own.height_m) == pytest.approx((673450.25, 2736120.40, 648.5), abs=1e-6)
        assert own.code == "Corner"


def test_other_files_say_what_to_do(faults: Path, tmp_path: Path) -> None:
    words = words_of(faults / "ublox_ubx_nmea_mixed.log")
    assert "u-blox" in words and "NMEA" in words
    (tmp_path / "route.gpx").write_text('<?xml version="1.0"?><gpx><rte><rtept lat="1" lon="2"/></rte></gpx>')
    assert "no track point with a time" in words_of(tmp_path / "route.gpx")
    (tmp_path / "raw.ubx").write_bytes(b"\xb5\x62\x02\x15" + bytes(300))
    assert "raw GNSS observations (RINEX, UBX)" in words_of(tmp_path / "raw.ubx")
