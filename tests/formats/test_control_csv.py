"""Control points as CSV, against pyproj."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from roadscan.core.crs import Anchor, Geoid, MapFrame
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import read_ellipsoidal as read_log

UTM32 = MapFrame(crs="EPSG:25832")
LOCAL = MapFrame(crs=None, local_name="site")


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def geoid(folder: Path, undulation_m: float) -> Geoid:
    """A constant geoid over Germany as GTX: big-endian origin, steps, rows, columns, float32."""
    with (folder / f"{undulation_m:g}.gtx").open("wb") as stream:
        np.array([45.0, 5.0, 1.0, 1.0], dtype=">f8").tofile(stream)
        np.array([11, 11], dtype=">i4").tofile(stream)
        np.full(121, undulation_m, dtype=">f4").tofile(stream)
    return Geoid.found(stream.name)


def test_points_of_the_maps_own_crs_stay_where_they_are(tmp_path: Path) -> None:
    path = write(
        tmp_path / "control.csv",
        "name,code,role,easting,northing,height_m,sigma_horizontal_m,sigma_height_mm",
        "P1,NAIL,gcp,571600.123,5539000.456,312.789,0.008,12",
        '"P2, kerb",,Check,571610.5,5539001.5,313.5,,',
    )
    assert format_of(path).name == "control_csv"
    log = read_log("control_csv", path, crs="EPSG:25832", map=UTM32)
    assert log.rejects == []
    rows = log.table.to_pylist()
    assert [r["name"] for r in rows] == ["P1", "P2, kerb"]
    assert [r["role"] for r in rows] == ["gcp", "check"]
    assert [r["code"] for r in rows] == ["NAIL", None]
    np.testing.assert_allclose([rows[0][k] for k in ("easting_m", "northing_m", "height_m")], [571600.123, 5539000.456, 312.789], atol=1e-6)  # fmt: skip  # noqa: E501
    assert (rows[0]["sigma_horizontal_m"], rows[1]["sigma_horizontal_m"]) == (0.008, None)
    assert (rows[0]["sigma_height_m"], rows[1]["sigma_height_m"]) == (pytest.approx(0.012), None)


def test_longitude_and_latitude_are_projected(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "id;lat;lon;height_m", "7;50.0;10.0;300")
    log = read_log("control_csv", path, {"role": "check"}, crs="EPSG:4258", map=UTM32)
    expected = pyproj.Transformer.from_crs("EPSG:4258", "EPSG:25832", always_xy=True).transform(10.0, 50.0)
    found = [log.column(k)[0] for k in ("easting_m", "northing_m", "height_m")]
    np.testing.assert_allclose(found, [*expected, 300.0], atol=1e-5)


def test_units_of_the_crs_and_of_names(tmp_path: Path) -> None:
    """Coordinates under plain names are in the CRS's unit, here US survey feet; the map is in metres."""
    foot = 1200 / 3937
    path = write(tmp_path / "a.csv", "name,easting,northing,height_ft_us", "A,1000000,200000,100")
    own = MapFrame(crs="EPSG:2263")
    log = read_log("control_csv", path, {"role": "gcp"}, crs="EPSG:2263", map=own)
    found = [log.column(k)[0] for k in ("easting_m", "northing_m", "height_m")]
    np.testing.assert_allclose(found, [1_000_000 * foot, 200_000 * foot, 100 * foot], atol=1e-5)


@pytest.mark.parametrize(
    ("log_height", "map_height", "expected"),
    [
        ("ellipsoidal", "ellipsoidal", 300.0),
        ("orthometric", "ellipsoidal", 345.0),
        ("ellipsoidal", "orthometric", 252.5),
        ("orthometric", "orthometric", 297.5),  # two geoids, 2.5 m apart
    ],
)
def test_heights_change_by_named_geoids(tmp_path: Path, log_height: Any, map_height: Any, expected: float) -> None:
    of_log, of_map = geoid(tmp_path, 45.0), geoid(tmp_path, 47.5)
    path = write(tmp_path / "a.csv", "name,easting,northing,height_m", "A,571600,5539000,300")
    frame = MapFrame(crs="EPSG:25832", height=map_height, geoid=of_map if map_height == "orthometric" else None)
    log = read_log("control_csv", path, {"role": "gcp"}, crs="EPSG:25832", height=log_height, geoid=of_log, map=frame)
    assert log.column("height_m")[0] == pytest.approx(expected, abs=1e-6)


def test_orthometric_heights_need_a_geoid_unless_the_map_has_them_too(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "name,easting,northing,height_m", "A,571600,5539000,300")
    stated: dict[str, Any] = {"crs": "EPSG:25832", "height": "orthometric"}
    with pytest.raises(CrsError, match="orthometric, the map's are ellipsoidal, and no geoid is named"):
        read_log("control_csv", path, {"role": "gcp"}, **stated, map=UTM32)
    own = MapFrame(crs="EPSG:25832", height="orthometric", geoid=geoid(tmp_path, 47.5))
    log = read_log("control_csv", path, {"role": "gcp"}, **stated, map=own)
    assert log.column("height_m")[0] == pytest.approx(300.0, abs=1e-6)


def test_a_point_off_the_geoid_grid_is_rejected(tmp_path: Path) -> None:
    lines = ("A,10.0,50.0,300", "B,10.0,20.0,300", "C,10.001,50.0,300")
    path = write(tmp_path / "a.csv", "name,lon,lat,height_m", *lines)
    stated: dict[str, Any] = {"crs": "EPSG:4979", "height": "orthometric", "geoid": geoid(tmp_path, 45.0)}
    log = read_log("control_csv", path, {"role": "gcp"}, **stated, map=MapFrame(crs="EPSG:32632"))
    assert log.column("name").tolist() == ["A", "C"]
    assert [(r.record, "does not cover" in r.reason) for r in log.rejects] == [(1, True)]


def test_local_points_pass_into_a_local_map(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "name,x,y,z", "A,1.5,2.5,-0.5")
    log = read_log("control_csv", path, {"role": "gcp"}, crs="local", map=LOCAL)
    assert [log.column(k)[0] for k in ("easting_m", "northing_m", "height_m")] == [1.5, 2.5, -0.5]
    with pytest.raises(CrsError, match=r"map\.local\.anchor"):
        read_log("control_csv", path, {"role": "gcp"}, crs="local", map=UTM32)
    anchored = MapFrame(crs=None, anchor=Anchor(50.0, 10.0, 300.0))
    earth = write(tmp_path / "b.csv", "name,lon,lat,height_m", "A,10.0,50.0,301.0")
    log = read_log("control_csv", earth, {"role": "gcp"}, crs="EPSG:4979", map=anchored)
    np.testing.assert_allclose(
        [log.column(k)[0] for k in ("easting_m", "northing_m", "height_m")], [0, 0, 1], atol=1e-8
    )


def test_damage(tmp_path: Path) -> None:
    lines = [
        "A,gcp,571600,5539000,300,0.01",
        "B,gcp,571600,5539000,,0.01",
        "C,gcp,five,5539000,300,0.01",
        ",gcp,571600,5539000,300,0.01",
        "A,gcp,571601,5539000,300,0.01",
        "D,base,571600,5539000,300,0.01",
        "E,gcp,571600,5539000,300,-0.01",
        "F,gcp,571600,5539000",
        "G,gcp,571600,1e9,300,0.01",
        "H,,571600,5539000,300,",
    ]
    path = write(tmp_path / "a.csv", "name,role,easting,northing,height_m,sigma_height_m", *lines)
    log = read_log("control_csv", path, {"role": "check"}, crs="EPSG:25832", map=UTM32)
    assert log.column("name").tolist() == ["A", "H"]
    assert log.column("role").tolist() == ["gcp", "check"]
    assert {r.record: r.reason for r in log.rejects} == {
        1: "height is missing or not a number",
        2: "easting 'five' is not a number",
        3: "the point has no name",
        4: "a point of this name came before",
        5: "role is neither 'gcp' nor 'check'",
        6: "σ of the height is outside 0 to 1000 m",
        7: "4 fields, expected 6",
        8: "northing is outside -2.1e+07 to 2.1e+07 m",
    }
    for reject in log.rejects:
        assert path.read_text()[reject.offset :].startswith(lines[reject.record])


@pytest.mark.parametrize(
    ("names", "options", "stated", "error", "says"),
    [
        ("name,easting,northing,height", {"role": "gcp"}, {"crs": "EPSG:25832"}, FormatError, "height_unit"),
        ("name,easting,northing,height_m", {}, {"crs": "EPSG:25832"}, ConfigError, "ground control or check points"),
        ("name,easting,northing,height_m", {"role": "gcp"}, {}, ConfigError, "CRS of the log's positions"),
        (
            "name,easting,northing,height_m",
            {"role": "gcp"},
            {"crs": "EPSG:4979"},
            FormatError,
            "no column holds the lon",
        ),
        ("name,easting,northing,height_m", {"role": "gcp"}, {"crs": "EPSG:9518"}, CrsError, "heights are stated apart"),
        (
            "name,easting,northing,height_m",
            {"role": "gpc"},
            {"crs": "EPSG:25832"},
            ConfigError,
            "expected one of: gcp, check",
        ),
    ],
)
def test_nothing_is_guessed(tmp_path: Path, names: str, options: dict, stated: dict, error: type, says: str) -> None:
    path = write(tmp_path / "a.csv", names, "A,571600,5539000,300")
    with pytest.raises(error, match=says):
        read_log("control_csv", path, options, **stated, map=UTM32)


def test_the_map_is_needed(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "name,easting,northing,height_m", "A,571600,5539000,300")
    with pytest.raises(ConfigError, match="survey's map"):
        read_log("control_csv", path, {"role": "gcp"}, crs="EPSG:25832")


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    sniff = format_named("control_csv").sniff
    assert sniff(write(tmp_path / "a.csv", "Name,Easting,Northing,Height", "A,1,2,3"))
    assert not sniff(write(tmp_path / "b.csv", "Easting,Northing,Height", "1,2,3"))
    assert not sniff(write(tmp_path / "c.csv", "name,easting_m,northing_m,height_m,roll_deg", "A,1,2,3,4"))
    assert [p for p in recordings.rglob("*") if sniff(p)] == []


def test_the_files_of_surveyors_give_the_right_points(faults: Path) -> None:
    """Elevation and Höhe in a unit that the survey file states; the names of columns that no line names."""
    stated: dict[str, Any] = {"crs": "EPSG:25832", "height": "ellipsoidal", "map": UTM32}
    for file, options, points in (
        ("pnezd_named.csv", {"height_unit": "m"}, {"1": (500001.234, 4100001.567, 50.123)}),
        (
            "german_semicolon_decimal_comma_bom.csv", {"height_unit": "m"},
            {"P1": (500001.234, 4100001.567, 50.123), "P3": (500004.234, 4100001.067, 50.323)},
        ),
        ("pnezd_named.csv", {"height_unit": "ft"}, {"2": (500002.234, 4100002.567, 50.223 * 0.3048)}),
        (
            "pnezd_no_header.csv", {"names": ["point", "northing", "easting", "elevation_m", "description"]},
            {"1": (673450.25, 2736120.40, 648.5), "3": (673470.25, 2736140.40, 648.7)},
        ),
    ):  # fmt: skip
        log = read_log("control_csv", faults / file, {"role": "gcp", **options}, **stated)
        found = {row["name"]: (row["easting_m"], row["northing_m"], row["height_m"]) for row in log.table.to_pylist()}
        for name, place in points.items():
            assert found[name] == pytest.approx(place, abs=1e-6)


def test_a_unit_of_heights_that_the_file_contradicts_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "name,easting,northing,height_m", "A,571600,5539000,300")
    stated: dict[str, Any] = {"height": "ellipsoidal", "map": UTM32}
    assert read_log("control_csv", path, {"role": "gcp", "height_unit": "m"}, crs="EPSG:25832", **stated).rejects == []
    with pytest.raises(ConfigError, match="'height_m' says another unit"):
        read_log("control_csv", path, {"role": "gcp", "height_unit": "ft"}, crs="EPSG:25832", **stated)
    plain = write(tmp_path / "b.csv", "name,longitude,latitude,height", "A,10,50,300")
    with pytest.raises(ConfigError, match="the CRS 'EPSG:4979' says another unit"):
        read_log("control_csv", plain, {"role": "gcp", "height_unit": "ft"}, crs="EPSG:4979", **stated)


def test_degrees_minutes_and_seconds(tmp_path: Path) -> None:
    rows = (
        "A,52°31'09.37\"N,13°24'02.5\"E,30", "B,52 31 09.37,-13 24 02.5,30", "C,N52-31-09.37,W13-24-02.5,30",
        "D,52°31'09.37\"E,13°24'02.5\"E,30", "E,52°61'09.37\"N,13°24'02.5\"E,30", "F,52° 31′ 9,5″ S,0° 0′ 1″ W,30",
    )  # fmt: skip
    path = write(tmp_path / "b.csv", "name;latitude;longitude;height_m", *(";".join(_cells(row)) for row in rows))
    log = read_log("control_csv", path, {"role": "gcp"}, crs="EPSG:4979", map=MapFrame(crs="EPSG:32633"))
    assert log.column("name").tolist() == ["A", "B", "C", "F"]
    assert [(r.record, r.records) for r in log.rejects] == [(3, 2)]
    latitude, longitude = 52 + 31 / 60 + 9.37 / 3600, 13 + 24 / 60 + 2.5 / 3600
    to_map = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32633", always_xy=True)
    places = ((longitude, latitude), (-longitude, latitude), (-longitude, latitude), (-1 / 3600, -52.51930555555))
    for row, place in zip(log.table.to_pylist(), places, strict=True):
        assert (row["easting_m"], row["northing_m"]) == pytest.approx(to_map.transform(*place), abs=1e-3)


def _cells(row: str) -> list[str]:
    """Name, latitude, longitude and height of a line whose latitude may hold a decimal comma."""
    name, rest = row.split(",", 1)
    head, height = rest.rsplit(",", 1)
    latitude, longitude = head.rsplit(",", 1)
    return [name, latitude, longitude, height]


POINTS = [("P1", 571_600.123, 5_539_000.456, 312.789), ("P2", 571_610.5, 5_539_001.5, 313.5)]


@pytest.mark.parametrize(
    ("names", "row", "how"),
    [
        ("ID,E [m],N [m],H [m]", "{p},{e},{n},{h}", {}),
        (
            '"Point ID","Grid Northing (m)","Grid Easting (m)","Elevation (m)","Code"',
            '"{p}","{n}","{e}","{h}","MH"',
            {},
        ),
        ("Punkt;Ostwert;Nordwert;Höhe", "{p};{e};{n};{h}", {"comma": True, "encoding": "utf-16", "end": "\r\n"}),
        ("Punto\tEste\tNorte\tCota", "{p}\t{e}\t{n}\t{h}", {"end": "\r"}),
        ("# control of job 7\n; surveyor: x\n\nname,EASTING,NORTHING,HEIGHT\n", "{p},{e},{n},{h}\n", {}),
        ("Point Name;North;East;Elev;Desc", "{p};{n};{e};{h};nail, in kerb", {}),
        ("Point,Northing (usft),Easting (usft),Elevation (usft)", "{p},{n},{e},{h}", {"unit": 3937 / 1200}),
    ],
)
def test_names_and_units_as_programs_write_them(tmp_path: Path, names: str, row: str, how: dict[str, Any]) -> None:
    """A unit in brackets is the column's; US survey feet have their own: a foot is 3 m off at 5,500 km."""
    scale = how.get("unit", 1.0)
    rows = [row.format(p=p, e=f"{e * scale:.4f}", n=f"{n * scale:.4f}", h=f"{h * scale:.4f}") for p, e, n, h in POINTS]
    rows = [one.replace(".", ",") for one in rows] if how.get("comma") else rows
    path = tmp_path / "control.csv"
    path.write_bytes(how.get("end", "\n").join([names, *rows, ""]).encode(how.get("encoding", "utf-8")))
    assert format_of(path).name == "control_csv"
    options = {"role": "gcp"} if "(" in names or "[" in names else {"role": "gcp", "height_unit": "m"}
    log = read_log("control_csv", path, options, crs="EPSG:25832", map=UTM32)
    assert log.rejects == []
    assert log.column("name").tolist() == ["P1", "P2"]
    found = np.stack([log.column(k) for k in ("easting_m", "northing_m", "height_m")], axis=1)
    np.testing.assert_allclose(found, [p[1:] for p in POINTS], atol=1e-3)


def test_feet_without_their_kind_are_asked_for(tmp_path: Path) -> None:
    """Which foot "(ft)" is, no one knows: it is not read without options.columns."""
    path = write(
        tmp_path / "a.csv", "Point,Northing (ft),Easting (ft),Elevation (ft)", "P1,18172900.0,1875328.0,1026.0"
    )
    with pytest.raises(FormatError):
        format_of(path)
    with pytest.raises(FormatError, match="no column holds the easting"):
        read_log("control_csv", path, {"role": "gcp"}, crs="EPSG:25832", map=UTM32)
