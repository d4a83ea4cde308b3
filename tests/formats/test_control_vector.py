"""Control points as GeoJSON and GeoPackage, written by GeoPandas."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import shapely

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, CrsError, FormatError
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import Log
from tests.formats.log_reading import read_ellipsoidal as read_log

UTM32 = MapFrame(crs="EPSG:25832")
ENH = np.array([[571600.125, 5539000.5, 312.75], [571610.5, 5539001.25, 313.5], [571620.0, 5539002.0, 314.0]])


def layer(**changed: Any) -> geopandas.GeoDataFrame:
    columns: dict[str, Any] = {
        "name": ["P1", "P2", "P3"],
        "code": ["NAIL", None, "KERB"],
        "role": ["gcp", "check", "gcp"],
        "sigma_height_m": [0.01, None, 0.02],
        "level": ENH[:, 2] * 1000,
    }
    shapes = changed.pop("geometry", shapely.points(ENH))
    crs = changed.pop("crs", "EPSG:25832")
    return geopandas.GeoDataFrame(columns | changed, geometry=shapes, crs=crs)


def write(path: Path, frame: geopandas.GeoDataFrame, name: str | None = None) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a layer without a CRS may be of little use
        frame.to_file(path, layer=name)
    return path


def coordinates(log: Log) -> np.ndarray:
    return np.stack([log.column(k) for k in ("easting_m", "northing_m", "height_m")], axis=-1)


def test_a_geopackage(tmp_path: Path) -> None:
    path = write(tmp_path / "control.gpkg", layer())
    assert format_of(path).name == "control_vector"
    log = read_log("control_vector", path, crs="EPSG:25832", map=UTM32)
    assert log.rejects == []
    np.testing.assert_allclose(coordinates(log), ENH, atol=1e-6)
    rows = log.table.to_pylist()
    assert [(r["name"], r["code"], r["role"]) for r in rows] == [
        ("P1", "NAIL", "gcp"),
        ("P2", None, "check"),
        ("P3", "KERB", "gcp"),
    ]
    assert [r["sigma_height_m"] for r in rows] == [0.01, None, 0.02]
    assert log.table["sigma_horizontal_m"].null_count == 3


def test_geojson_is_in_longitude_and_latitude(tmp_path: Path) -> None:
    degrees = layer().to_crs("EPSG:4258").set_crs("EPSG:4326", allow_override=True)
    path = write(tmp_path / "control.geojson", degrees)
    assert format_of(path).name == "control_vector"
    log = read_log("control_vector", path, crs="EPSG:4979", map=MapFrame(crs="EPSG:32632"))
    np.testing.assert_allclose(coordinates(log), ENH, atol=2e-3)  # GeoJSON is written with 7 decimals
    with pytest.raises(CrsError, match="the layer's CRS is WGS 84, the survey file states 'EPSG:25832'"):
        read_log("control_vector", path, crs="EPSG:25832", map=UTM32)


def test_the_stated_crs_has_to_be_the_layers(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", layer())
    for stated in ("EPSG:25833", "EPSG:32632", "EPSG:4979", "local"):
        with pytest.raises(CrsError, match="expected one CRS"):
            read_log("control_vector", path, crs=stated, map=UTM32)
    unknown = write(tmp_path / "b.gpkg", layer(crs=None))
    np.testing.assert_allclose(
        coordinates(read_log("control_vector", unknown, crs="EPSG:25832", map=UTM32)), ENH, atol=1e-6
    )
    local = read_log("control_vector", unknown, crs="local", map=MapFrame(crs=None))
    np.testing.assert_array_equal(coordinates(local), ENH)


def test_height_from_an_attribute_in_its_unit(tmp_path: Path) -> None:
    flat = layer(geometry=shapely.points(ENH[:, :2]))
    path = write(tmp_path / "a.gpkg", flat)
    log = read_log("control_vector", path, {"height": "level", "height_unit": "mm"}, crs="EPSG:25832", map=UTM32)
    np.testing.assert_allclose(coordinates(log), ENH, atol=1e-6)
    none = read_log("control_vector", path, crs="EPSG:25832", map=UTM32)
    assert none.table.num_rows == 0
    assert [(r.record, r.records, r.reason) for r in none.rejects] == [(0, 3, "height is missing or not a number")]


def test_damage(tmp_path: Path) -> None:
    shapes = [shapely.Point(*ENH[0]), shapely.LineString(ENH[:2]), None]
    path = write(tmp_path / "a.gpkg", layer(geometry=shapes))
    log = read_log("control_vector", path, crs="EPSG:25832", map=UTM32)
    assert log.column("name").tolist() == ["P1"]
    assert [(r.record, r.records, r.offset) for r in log.rejects] == [(1, 2, -1)]
    twice = read_log(
        "control_vector", write(tmp_path / "b.gpkg", layer(name=["A", "A", None])), crs="EPSG:25832", map=UTM32
    )
    assert [r.reason for r in twice.rejects] == ["the point has no name", "a point of this name came before"]


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", layer(name=["P1", "P2", "P3"]).to_crs("EPSG:4326"))
    path.write_bytes(path.read_bytes().replace(b'"P2"', b'"P\xde"'))
    log = read_log("control_vector", path, crs="EPSG:4979", map=MapFrame(crs="EPSG:32632"))
    assert log.column("name").tolist() == ["P1", "P3"]
    assert [(r.record, r.reason) for r in log.rejects] == [(1, "name or code is not UTF-8 text")]


def test_layers_and_roles(tmp_path: Path) -> None:
    path = write(tmp_path / "a.gpkg", layer(), "first")
    write(path, layer(name=["X", "Y", "Z"]), "second")
    stated: dict[str, Any] = {"crs": "EPSG:25832", "map": UTM32}
    with pytest.raises(ConfigError, match=r'has 2 layers; expected options\.layer = "first" or "second"'):
        read_log("control_vector", path, **stated)
    with pytest.raises(ConfigError, match="did you mean 'second'"):
        read_log("control_vector", path, {"layer": "secnd"}, **stated)
    assert read_log("control_vector", path, {"layer": "second"}, **stated).column("name").tolist() == ["X", "Y", "Z"]
    without = write(tmp_path / "b.gpkg", layer().drop(columns=["role"]))
    with pytest.raises(ConfigError, match="ground control or check points"):
        read_log("control_vector", without, **stated)
    assert set(read_log("control_vector", without, {"role": "check"}, **stated).column("role")) == {"check"}
    with pytest.raises(FormatError, match=r"no attribute 'nam'.*did you mean 'name'"):
        read_log("control_vector", path, {"layer": "first", "name": "nam"}, **stated)


def test_a_file_gdal_cannot_read(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_text('{"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": {"type": "Point"')
    with pytest.raises(FormatError, match="GDAL cannot read the file"):
        read_log("control_vector", path, {"role": "gcp"}, crs="EPSG:4979", map=UTM32)


def test_sniffing(tmp_path: Path, recordings: Path) -> None:
    sniff = format_named("control_vector").sniff
    lines = {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": {"type": "LineString"}}]}
    path = tmp_path / "lines.geojson"
    path.write_text(json.dumps(lines))
    assert not sniff(path)
    assert not sniff(tmp_path)
    assert [p for p in recordings.rglob("*") if sniff(p)] == []


def test_empty_points_and_layers_without_geometry(tmp_path: Path) -> None:
    shapes = shapely.points(ENH).tolist()
    path = write(tmp_path / "a.gpkg", layer(geometry=[shapes[0], shapely.Point(), shapes[2]]))
    log = read_log("control_vector", path, crs="EPSG:25832", map=UTM32)
    assert log.table.num_rows == 2
    assert [r.record for r in log.rejects] == [1]
    (tmp_path / "a.csv").write_text("name,role\nA,gcp\n")
    with pytest.raises(FormatError, match="has no geometry"):
        read_log("control_vector", tmp_path / "a.csv", crs="EPSG:25832", map=UTM32)


def test_a_member_that_is_no_feature_is_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", layer().to_crs("EPSG:4326"))
    text = path.read_text()
    at = text.index('"Feature",', text.index("P1"))
    path.write_text(text[:at] + '"Peature",' + text[at + 10 :])
    log = read_log("control_vector", path, crs="EPSG:4979", map=MapFrame(crs="EPSG:32632"))
    assert log.table.num_rows == 2
    assert [(r.reason, r.records) for r in log.rejects] == [("the file lists features that cannot be read", 1)]


def test_an_attribute_without_a_name_is_not_taken_for_the_geometry(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", layer().to_crs("EPSG:4326"))
    path.write_text(path.read_text().replace('"level"', '""'))
    log = read_log("control_vector", path, crs="EPSG:4979", map=MapFrame(crs="EPSG:32632"))
    assert log.table.num_rows == 3
