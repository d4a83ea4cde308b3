"""Road centre lines: layers written by GDAL, widths, CRS, sniffing, damage."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyproj
import pytest
import shapely

from roadscan.core.crs import Anchor, MapFrame
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.formats.vectors.road_lines import TIGER_ROADS
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import Log, read_log

UTM17 = MapFrame(crs="EPSG:26917")
MIAMI = np.array([[-80.19, 25.77], [-80.189, 25.77], [-80.189, 25.772]])
"""Longitude and latitude (NAD 83)."""


def tiger(**changed: Any) -> geopandas.GeoDataFrame:
    """Roads as TIGER/Line lists them: LINEARID, FULLNAME, RTTYP, MTFCC in NAD 83."""
    columns: dict[str, Any] = {
        "LINEARID": ["110", "111", "112", "113"],
        "FULLNAME": ["I- 95", "NW 1st St", None, "Riverwalk"],
        "RTTYP": ["I", "M", None, "M"],
        "MTFCC": ["S1100", "S1400", "S1630", "S9999"],
    }
    shapes = [
        shapely.LineString(MIAMI),
        shapely.MultiLineString([MIAMI[:2], MIAMI[1:] + 0.001]),
        shapely.LineString(MIAMI[:2] + 0.002),
        shapely.LineString(MIAMI[:2] + 0.003),
    ]
    given = changed.pop("geometry", shapes)
    return geopandas.GeoDataFrame(columns | changed, geometry=given, crs=changed.pop("crs", "EPSG:4269"))


def write(path: Path, frame: geopandas.GeoDataFrame, **more: Any) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame.to_file(path, **more)
    return path


def zipped(folder: Path, name: str = "tl_2023_12086_roads") -> Path:
    inner = folder / "inner"
    inner.mkdir()
    write(inner / f"{name}.shp", tiger())
    path = folder / f"{name}.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(inner.iterdir()):
            archive.write(file, file.name)
    return path


def vertices(log: Log, row: int) -> np.ndarray:
    return np.column_stack([log.table.column(f"{a}_m")[row].as_py() for a in ("easting", "northing")])


def in_utm17(lon_lat: np.ndarray) -> np.ndarray:
    """Projected on WGS 84's ellipsoid, whose flattening moves these points by 0.08 mm."""
    return np.column_stack(pyproj.Proj("EPSG:26917")(*lon_lat.T))


# --- what a layer holds ------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".shp", ".gpkg", ".geojson", ".zip"])
def test_tiger_line_roads(tmp_path: Path, suffix: str) -> None:
    if suffix == ".zip":
        path = zipped(tmp_path)
    else:
        frame = tiger() if suffix != ".geojson" else tiger().to_crs("EPSG:4326")
        path = write(tmp_path / f"roads{suffix}", frame)
    assert format_of(path).name == "road_lines"
    log = read_log("road_lines", path, map=UTM17)
    assert log.rejects == []
    rows = log.table.to_pylist()
    assert [(r["line_id"], r["part"], r["name"], r["class"]) for r in rows] == [
        ("110", 0, "I- 95", "S1100"),
        ("111", 0, "NW 1st St", "S1400"),
        ("111", 1, "NW 1st St", "S1400"),
        ("112", 0, None, "S1630"),
        ("113", 0, "Riverwalk", "S9999"),
    ]
    # 3 × 3.6 + 1.2 + 3.0; 2 × 3.6 + 2 × 0.6; 3.6 + 1.2 + 2.4: lanes and shoulders of FHWA-SA-07-011, chapter 3.
    assert [r["width_m"] for r in rows] == [15.0, 8.4, 8.4, 7.2, None]
    assert [r["width_from"] for r in rows] == ["class"] * 4 + [None]
    # PROJ's own projection of the same datum; WGS 84 and NAD 83 differ by a metre or two at most.
    apart = 2e-4 if suffix != ".geojson" else 3.0
    assert np.abs(vertices(log, 0) - in_utm17(MIAMI)).max() < apart
    assert np.abs(vertices(log, 2) - in_utm17(MIAMI[1:] + 0.001)).max() < apart


def test_the_classes_are_those_of_the_census_bureau() -> None:
    assert set(TIGER_ROADS) >= {f"S{n}" for n in (1100, 1200, 1400, 1500, 1630, 1640, 1710, 1730, 1740, 1780)}
    assert all(1.0 <= road.width_m <= 25.0 for road in TIGER_ROADS.values())
    assert TIGER_ROADS["S1200"].width_m == pytest.approx(4 * 3.6 + 2 * 2.4)


def test_widths_from_an_attribute_lanes_and_classes(tmp_path: Path) -> None:
    frame = tiger(broad=[100.0, None, None, None], lanes=[6, 3, None, 0])
    path = write(tmp_path / "a.gpkg", frame)
    options = {"width_column": "broad", "width_unit": "ft", "lane_width_m": 3.5, "class_widths_m": {"S1630": 9.0}}
    log = read_log("road_lines", path, options, map=UTM17)
    rows = {(r["line_id"], r["part"]): r for r in log.table.to_pylist()}
    assert rows["110", 0]["width_m"] == pytest.approx(30.48)
    assert (rows["111", 1]["width_m"], rows["111", 1]["lanes"]) == (10.5, 3)
    assert (rows["112", 0]["width_m"], rows["112", 0]["width_from"]) == (9.0, "class")
    assert (rows["113", 0]["width_m"], rows["113", 0]["lanes"]) == (None, None)
    assert [rows[k]["width_from"] for k in (("110", 0), ("111", 0))] == ["width", "lanes"]


def test_a_layer_without_known_attributes(tmp_path: Path) -> None:
    shapes = [shapely.LineString([[0, 0], [1, 1]]), shapely.LineString([[5, 5, 3], [6, 6, 3]])]
    path = write(tmp_path / "a.gpkg", geopandas.GeoDataFrame({"x": [1, 2]}, geometry=shapes, crs="EPSG:26917"))
    log = read_log("road_lines", path, map=UTM17)
    assert log.column("line_id").tolist() == ["0", "1"]
    assert log.table.column("width_m").null_count == 2
    assert vertices(log, 1).tolist() == [[5, 5], [6, 6]]


# --- where the lines are -----------------------------------------------------------------------------


def test_the_layers_crs(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", tiger())
    assert len(read_log("road_lines", path, crs="EPSG:4269", map=UTM17).rows) == 1
    with pytest.raises(CrsError, match="layer's CRS is NAD83, the survey file states 'EPSG:4326'"):
        read_log("road_lines", path, crs="EPSG:4326", map=UTM17)
    bare = write(tmp_path / "b.gpkg", tiger().set_crs(None, allow_override=True))
    with pytest.raises(CrsError, match=r"neither the layer nor the survey file.*EPSG:4269"):
        read_log("road_lines", bare, map=UTM17)
    log = read_log("road_lines", bare, crs="EPSG:4269", map=UTM17)
    assert np.abs(vertices(log, 0) - in_utm17(MIAMI)).max() < 2e-4
    with pytest.raises(ConfigError, match="survey's map"):
        read_log("road_lines", path)


def test_maps_in_feet_and_local_maps(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", tiger())
    feet = read_log("road_lines", path, map=MapFrame(crs="EPSG:2236"))  # Florida East, US survey feet
    expected = np.column_stack(pyproj.Proj("EPSG:2236", preserve_units=False)(*MIAMI.T))
    assert np.abs(vertices(feet, 0) - expected).max() < 2e-4
    with pytest.raises(CrsError, match="local frame without an anchor"):
        read_log("road_lines", path, map=MapFrame(crs=None))
    anchor = Anchor(MIAMI[0, 1], MIAMI[0, 0], 12.0, crs="EPSG:4269")
    local = vertices(read_log("road_lines", path, map=MapFrame(crs=None, anchor=anchor)), 0)
    _, _, along = pyproj.Geod(ellps="GRS80").inv(*MIAMI[0], *MIAMI[1])
    assert local[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert local[1] == pytest.approx([along, 0.0], abs=0.01)
    own = write(tmp_path / "b.gpkg", tiger().set_crs(None, allow_override=True))
    assert vertices(read_log("road_lines", own, crs="local", map=MapFrame(crs=None)), 0).tolist() == MIAMI.tolist()


def test_layers_and_attributes_that_are_none(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", tiger(), layer="one")
    write(path, tiger(), layer="two")
    with pytest.raises(ConfigError, match=r"has 2 layers; expected options\.layer"):
        read_log("road_lines", path, map=UTM17)
    assert read_log("road_lines", path, {"layer": "two"}, map=UTM17).table.num_rows == 5
    with pytest.raises(ConfigError, match=r"no attribute 'MTFC'.*did you mean 'MTFCC'"):
        read_log("road_lines", path, {"layer": "one", "class_column": "MTFC"}, map=UTM17)
    with pytest.raises(ConfigError, match="width_unit 'yards'"):
        read_log("road_lines", path, {"layer": "one", "width_unit": "yards"}, map=UTM17)


# --- sniffing ----------------------------------------------------------------------------------------


def test_points_and_lines_are_told_apart(tmp_path: Path, recordings: Path) -> None:
    points = geopandas.GeoDataFrame({"name": ["P"]}, geometry=[shapely.Point(1, 2, 3)], crs="EPSG:25832")
    assert format_of(write(tmp_path / "points.gpkg", points)).name == "control_vector"
    assert format_of(write(tmp_path / "points.geojson", points.to_crs("EPSG:4326"))).name == "control_vector"
    both = write(tmp_path / "both.gpkg", tiger(), layer="roads")
    write(both, points, layer="points")
    with pytest.raises(FormatError, match="fits control_vector and road_lines; expected one format"):
        format_of(both)
    sniff = format_named("road_lines").sniff
    assert not sniff(write(tmp_path / "points.shp", points))
    assert not sniff(tmp_path)
    empty = tmp_path / "empty.zip"
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    assert not sniff(empty)
    assert [p.name for p in recordings.rglob("*") if sniff(p)] == ["sidewalk_segments.gpkg"]  # the one layer of lines


def test_the_files_of_a_shapefile_belong_together(tmp_path: Path) -> None:
    path = write(tmp_path / "roads [1].shp", tiger())
    write(tmp_path / "roads 1.shp", tiger())
    log_format = format_named("road_lines")
    names = [p.name for p in log_format.companions(path, log_format.options())]
    assert names == ["roads [1].shx", "roads [1].dbf", "roads [1].prj", "roads [1].cpg"]
    assert log_format.companions(tmp_path / "a.gpkg", log_format.options()) == []


# --- damage ------------------------------------------------------------------------------------------


def test_features_that_are_no_lines(tmp_path: Path) -> None:
    shapes = [shapely.LineString(MIAMI), None, shapely.Point(MIAMI[0]), shapely.LineString(MIAMI[:2])]
    path = write(tmp_path / "a.gpkg", tiger(geometry=shapes, broad=[1.0, 1.0, 1.0, -4.0]))
    log = read_log("road_lines", path, {"width_column": "broad"}, map=UTM17)
    assert log.column("line_id").tolist() == ["110"]
    assert [(r.record, r.records, r.reason) for r in log.rejects] == [
        (1, 2, "the feature has no line"),
        (3, 1, "the width is outside 0 to 500 m"),
    ]


def test_vertices_without_a_place(tmp_path: Path) -> None:
    far = shapely.LineString([[400.0, 95.0], [-80.0, 25.0]])
    shapes = [far, *(shapely.LineString(MIAMI) for _ in range(3))]
    log = read_log("road_lines", write(tmp_path / "a.gpkg", tiger(geometry=shapes)), map=UTM17)
    assert log.column("line_id").tolist() == ["111", "112", "113"]
    assert [(r.record, r.reason) for r in log.rejects] == [(0, "a vertex has no place in the map")]


def test_cut_off(tmp_path: Path) -> None:
    path = write(tmp_path / "a.shp", tiger())
    path.write_bytes(path.read_bytes()[:200])
    log = read_log("road_lines", path, map=UTM17)
    assert log.table.num_rows + sum(r.records for r in log.rejects) >= 4
    (tmp_path / "a.shx").unlink()
    with pytest.raises(FormatError, match="GDAL cannot read the file"):
        read_log("road_lines", path, map=UTM17)
    with pytest.raises(FormatError, match="does not exist"):
        read_log("road_lines", tmp_path / "none.shp", map=UTM17)


def test_vertices_that_are_no_numbers_and_doubled_attributes(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", tiger().to_crs("EPSG:4326"))
    text = path.read_text()
    at = text.index("25.77", text.index("Riverwalk"))
    (tmp_path / "b.geojson").write_text(f"{text[:at]}nan{text[text.index(' ', at) :]}")
    log = read_log("road_lines", tmp_path / "b.geojson", map=UTM17)
    assert [(r.record, r.reason) for r in log.rejects] == [(3, "a vertex has no place in the map")]
    (tmp_path / "c.geojson").write_text(text.replace('"FULLNAME": "Riverwalk"', '"FULlNAME": "Riverwalk"'))
    with pytest.raises(FormatError, match="attribute 'FULLNAME' cannot be read"):
        read_log("road_lines", tmp_path / "c.geojson", map=UTM17)


def test_damage_in_an_archive_is_seen_by_its_checksum(tmp_path: Path) -> None:
    path = zipped(tmp_path)
    with zipfile.ZipFile(path) as archive:
        member = next(m for m in archive.infolist() if m.filename.endswith(".shp"))
    data = bytearray(path.read_bytes())
    at = member.header_offset + 30 + len(member.filename) + member.compress_size // 2
    data[at] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"archive.*damaged"):
        read_log("road_lines", path, map=UTM17)
    path.write_bytes(data[: len(data) - 30])
    with pytest.raises(FormatError, match="archive is damaged"):
        read_log("road_lines", path, map=UTM17)


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_features_that_the_attribute_table_does_not_count_are_told(tmp_path: Path, rows: int) -> None:
    path = write(tmp_path / "a.shp", tiger())
    table = bytearray(path.with_suffix(".dbf").read_bytes())
    table[4:8] = rows.to_bytes(4, "little")
    path.with_suffix(".dbf").write_bytes(table)
    log = read_log("road_lines", path, map=UTM17)
    assert [(r.reason, r.records) for r in log.rejects] == [("the file lists features that cannot be read", 4 - rows)]
