"""Points cut to a layer of centre lines, as the survey file states it; road lines as a table of the store."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pytest
import shapely

from roadscan.core.errors import ConfigError, CrsError
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.georeference.plan.road import CentreLineBuffer, centre_lines_of, load_buffer
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

NORTH = np.arange(-39.5, 60.0)
"""Northings of the points, a metre apart; the road's centre line runs at 5 m."""


def write_points(path: Path) -> None:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.full(NORTH.size, 5.0), NORTH, np.full(NORTH.size, 50.0)
    las.gps_time = np.full(NORTH.size, 200_000_000.0)
    las.write(path)


def write_layer(path: Path, crs: str | None = "EPSG:32632", **columns: Any) -> None:
    line = shapely.LineString([[-100, 5], [100, 5]])
    frame = geopandas.GeoDataFrame({"LINEARID": ["7"]} | {k: [v] for k, v in columns.items()}, geometry=[line], crs=crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame.to_file(path)


def survey_of(folder: Path, **filters: Any) -> Survey:
    logs = [
        {"path": "points.las", "format": "las", "crs": "EPSG:32632", "height": "ellipsoidal"},
        {"path": "roads.shp", "crs": "EPSG:32632"},
    ]
    values = {
        "id": "cut",
        "map": {"crs": "EPSG:32632"},
        "tiles": {"cell_m": 0.5},
        "runs": [{"id": "r", "logs": logs}],
        "filters": {"centre_line": "roads.shp"} | filters,
    }
    return Survey.parse(values, folder=folder)


def kept(survey: Survey) -> tuple[float, float]:
    """Lowest and highest northing that stays."""
    store = Store(survey.store_url, "cut")
    run_stages(Session(survey, store, Inline()), stages())
    north = np.concatenate([np.array(laspy.read(store.path(p)).y) for p in store.files("tiles/las")])
    return float(north.min()), float(north.max())


@pytest.mark.parametrize(
    ("filters", "half_width_m"),
    [
        ({}, 15.0),
        ({"centre_line_buffer_m": 20.0}, 20.0),
        ({"centre_line_width": "class"}, 8.4 / 2 + 8.0),
        ({"centre_line_width": "class", "centre_line_margin_m": 1.0}, 8.4 / 2 + 1.0),
        ({"centre_line_width": "class", "centre_line_options": {"class_widths_m": {"S1400": 30.0}}}, 15.0 + 8.0),
        ({"centre_line_width": "broad", "centre_line_options": {"width_unit": "ft"}}, 20 * 0.3048 / 2 + 8.0),
        ({"centre_line_width": "blank"}, 8.4 / 2 + 8.0),
        (
            {
                "centre_line_width": "blank",
                "centre_line_buffer_m": 9.0,
                "centre_line_options": {"class_column": "LINEARID"},
            },
            9.0,
        ),
    ],
)
def test_how_far_beside_a_line_points_are_kept(tmp_path: Path, filters: dict[str, Any], half_width_m: float) -> None:
    write_points(tmp_path / "points.las")
    write_layer(tmp_path / "roads.shp", MTFCC="S1400", broad=20.0, blank=float("nan"))
    inside = NORTH[np.abs(NORTH - 5.0) <= half_width_m]
    assert kept(survey_of(tmp_path, **filters)) == (inside.min(), inside.max())


def test_attributes_belong_to_the_layers_fingerprint(tmp_path: Path) -> None:
    write_points(tmp_path / "points.las")
    survey = survey_of(tmp_path, centre_line_width="class")
    write_layer(tmp_path / "roads.shp", MTFCC="S1400")
    shape = (tmp_path / "roads.shp").read_bytes()
    narrow = kept(survey)
    write_layer(tmp_path / "roads.shp", MTFCC="S1200")
    assert (tmp_path / "roads.shp").read_bytes() == shape
    assert kept(survey)[1] > narrow[1]


def test_road_lines_are_a_table(tmp_path: Path) -> None:
    write_points(tmp_path / "points.las")
    write_layer(tmp_path / "roads.shp", MTFCC="S1400", FULLNAME="Main St")
    survey = survey_of(tmp_path)
    kept(survey)
    plan = plan_survey(survey, Store(survey.store_url, "cut"))
    keys = [record.key for record in plan.records]
    rows = query(plan.store, "SELECT * FROM road_lines", keys).to_pylist()
    assert [(r["line_id"], r["name"], r["class"], r["width_m"]) for r in rows] == [("7", "Main St", "S1400", 8.4)]
    assert (rows[0]["easting_m"], rows[0]["northing_m"]) == ([-100.0, 100.0], [5.0, 5.0])


def test_what_the_survey_file_has_to_say(tmp_path: Path) -> None:
    survey = survey_of(tmp_path)
    with pytest.raises(ConfigError, match="layer does not exist"):
        centre_lines_of(survey)
    write_layer(tmp_path / "roads.shp", crs=None)

    def load(**filters: Any) -> object:
        changed = survey_of(tmp_path, **filters)
        stated = centre_lines_of(changed)
        assert stated is not None
        return load_buffer(stated, changed.frame())

    with pytest.raises(CrsError, match="neither the layer nor the survey file"):
        load()
    assert load(centre_line_crs="EPSG:32632")
    with pytest.raises(ConfigError, match="no attribute with the road's class"):
        load(centre_line_crs="EPSG:32632", centre_line_width="class")
    with pytest.raises(ConfigError, match="no attribute 'breadth'"):
        load(centre_line_crs="EPSG:32632", centre_line_width="breadth")
    with pytest.raises(ConfigError, match="unknown key 'class_width_m'"):
        load(centre_line_options={"class_width_m": {}})


def buffer_of(folder: Path, **filters: Any) -> CentreLineBuffer:
    survey = survey_of(folder, **filters)
    stated = centre_lines_of(survey)
    assert stated is not None
    return load_buffer(stated, survey.frame())


@pytest.mark.parametrize("width", [900.0, -3.0, float("inf")])
def test_a_line_with_an_impossible_width_is_kept_with_the_buffer(tmp_path: Path, width: float) -> None:
    lines = [shapely.LineString([[-100, y], [100, y]]) for y in (5, 500)]
    frame = geopandas.GeoDataFrame({"broad": [20.0, width], "MTFCC": ["S1400"] * 2}, geometry=lines, crs="EPSG:32632")
    frame.to_file(tmp_path / "roads.gpkg")
    found = buffer_of(tmp_path, centre_line="roads.gpkg", centre_line_width="broad", centre_line_buffer_m=12.0)
    inside = found.keeps(np.zeros(4), np.array([511.9, 512.1, 22.9, 23.1]), (-10.0, 0.0, 10.0, 600.0))
    assert inside.tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    "broken",
    ["null", '{"type": "Point", "coordinates": [0, 0]}', '{"type": "LineString", "coordinates": [[0, 0], [1e30, 0]]}'],
)
def test_a_feature_that_cannot_be_used_is_refused_by_its_number(tmp_path: Path, broken: str) -> None:
    sound = '{"type": "LineString", "coordinates": [[0, 0], [9, 0]]}'
    features = ", ".join(f'{{"type": "Feature", "properties": {{}}, "geometry": {g}}}' for g in (sound, broken, sound))
    crs = '{"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}'
    (tmp_path / "roads.geojson").write_text(
        f'{{"type": "FeatureCollection", "crs": {crs}, "features": [{features}]}}', encoding="utf-8"
    )
    with pytest.raises(ConfigError, match=r"roads\.geojson: feature 1 of the centre lines .* cannot be used"):
        buffer_of(tmp_path, centre_line="roads.geojson")


def test_a_name_that_is_no_text_does_not_matter(tmp_path: Path) -> None:
    write_layer(tmp_path / "roads.gpkg", FULLNAME="Main St", MTFCC="S1400")
    data = (tmp_path / "roads.gpkg").read_bytes()
    (tmp_path / "roads.gpkg").write_bytes(data.replace(b"Main St", b"Ma\xffn St"))
    assert buffer_of(tmp_path, centre_line="roads.gpkg", centre_line_width="class")


@pytest.mark.parametrize("width", [-1.0, 0.0, float("nan"), 1e9])
def test_class_widths_are_widths(tmp_path: Path, width: float) -> None:
    write_layer(tmp_path / "roads.shp", MTFCC="S1400")
    options = {"class_widths_m": {"S1400": width}}
    with pytest.raises(ConfigError, match="class_widths_m"):
        buffer_of(tmp_path, centre_line_width="class", centre_line_options=options)
