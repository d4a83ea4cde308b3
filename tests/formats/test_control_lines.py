"""Surveyed lines as GeoPackage, GeoJSON and text, written by GeoPandas and by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import shapely

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, CrsError, FormatError
from tests.formats.log_reading import Log
from tests.formats.log_reading import read_ellipsoidal as read_log
from tests.formats.test_control_vector import write

UTM32 = MapFrame(crs="EPSG:25832")
ENH = np.array([[571600.125, 5539000.5, 312.75], [571610.5, 5539001.25, 313.5], [571620.0, 5539002.0, 314.0]])
TEXT = "line,kind,easting_m,northing_m,height_m\n" + "".join(f"edge,paint,{e},{n},{h}\n" for e, n, h in ENH)


def layer(**changed: Any) -> geopandas.GeoDataFrame:
    columns: dict[str, Any] = {"name": ["edge", None], "kind": ["paint", "kerb"], "sigma_horizontal_m": [0.01, None]}
    shapes = changed.pop("geometry", [shapely.LineString(ENH), shapely.LineString(ENH + np.array([0.0, 5.0, 0.0]))])
    crs = changed.pop("crs", "EPSG:25832")
    return geopandas.GeoDataFrame(columns | changed, geometry=shapes, crs=crs)


def vertices(log: Log, row: int = 0) -> np.ndarray:
    one = log.table.to_pylist()[row]
    return np.stack([one[name] for name in ("easting_m", "northing_m", "height_m")], axis=-1)


def test_a_geopackage_of_lines(tmp_path: Path) -> None:
    path = write(tmp_path / "lines.gpkg", layer())
    log = read_log("control_lines", path, crs="EPSG:25832", map=UTM32)
    assert log.rejects == []
    np.testing.assert_allclose(vertices(log), ENH, atol=1e-6)
    rows = log.table.to_pylist()
    assert [(r["name"], r["kind"], r["role"], r["sigma_horizontal_m"]) for r in rows] == [
        ("edge", "paint", "gcp", 0.01), ("lines 1", "kerb", "gcp", None),
    ]  # fmt: skip


def test_geojson_in_degrees_and_lines_without_heights(tmp_path: Path) -> None:
    flat = layer(geometry=[shapely.LineString(ENH[:, :2]), shapely.LineString(ENH[::-1, :2])]).to_crs("EPSG:4258")
    path = write(tmp_path / "lines.geojson", flat.set_crs("EPSG:4326", allow_override=True))
    log = read_log("control_lines", path, crs="EPSG:4979", map=MapFrame(crs="EPSG:32632"))
    rows = log.table.to_pylist()
    np.testing.assert_allclose(rows[0]["easting_m"], ENH[:, 0], atol=0.02)  # seven decimals of a degree
    assert [row["height_m"] for row in rows] == [[], []]


def test_text_has_a_line_a_vertex(tmp_path: Path) -> None:
    path = tmp_path / "lines.csv"
    path.write_text(TEXT + "kerb,kerb,1.0,2.0,3.0\n")
    log = read_log("control_lines", path, crs="EPSG:25832", map=UTM32)
    np.testing.assert_allclose(vertices(log), ENH, atol=1e-6)
    assert [one.reason for one in log.rejects] == ["the line has fewer than two vertices"]


def test_what_is_no_line_or_not_said_is_refused(tmp_path: Path) -> None:
    points = write(tmp_path / "points.gpkg", layer(geometry=shapely.points(ENH[:2])))
    log = read_log("control_lines", points, crs="EPSG:25832", map=UTM32)
    assert [one.reason for one in log.rejects] == ["the feature has no line"] * 2
    bare = write(tmp_path / "bare.gpkg", layer().drop(columns="kind"))
    with pytest.raises(ConfigError, match="paint or kerbs"):
        read_log("control_lines", bare, crs="EPSG:25832", map=UTM32)
    read_log("control_lines", bare, {"kind": "kerb"}, crs="EPSG:25832", map=UTM32)
    with pytest.raises(CrsError, match="states 'EPSG:25833'"):
        read_log("control_lines", bare, {"kind": "kerb"}, crs="EPSG:25833", map=UTM32)
    table = tmp_path / "table.csv"
    table.write_text("line,kind,easting_m,\0ght_m\n1,kerb,571600.0,312.0\n")
    with pytest.raises(FormatError, match="layer 'table' has no geometry"):
        read_log("control_lines", table, crs="EPSG:25832", map=UTM32)
    empty = tmp_path / "empty.csv"
    empty.write_text(TEXT.splitlines()[0] + "\n")
    with pytest.raises((FormatError, ConfigError)):
        read_log("control_lines", empty, crs="EPSG:25832", map=UTM32)
