"""Kinds and units of heights: asked for where nothing states them, and never against what a log says."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

from roadscan.cli import app

SURVEY = """id = "s"
map = {{ {map} }}
tiles = {{ cell_m = 1.0, size_m = 500.0 }}
products = {{ make = ["las"] }}
{defaults}
[[runs]]
id = "r"
[[runs.logs]]
path = "{path}"
format = "las"
clock = {{ system = "gps_week_seconds", date = 2010-05-05 }}
{log}
"""


def run(folder: Path, path: Path, map_: str, log: str = "", defaults: str = "", clock: bool = True) -> tuple[int, str]:
    text = SURVEY.format(map=map_, path=path, log=log, defaults=defaults)
    if not clock:
        text = "\n".join(line for line in text.splitlines() if not line.startswith("clock"))
    (folder / "SURVEY.toml").write_text(text, encoding="utf-8")
    result = CliRunner().invoke(app, ["run", str(folder / "SURVEY.toml"), "--workers", "0", "--json"])
    return result.exit_code, f"{result.output}{result.exception or ''}"


def points(folder: Path) -> np.ndarray:
    """Easting, northing, height (n, 3) of the LAS products, sorted, in their own units."""
    files = sorted((folder / "store/survey=s/tiles/las").glob("*.laz"))
    read = [laspy.read(file) for file in files]
    xyz = np.concatenate([np.column_stack([one.x, one.y, one.z]) for one in read])
    return xyz[np.lexsort(xyz.T)]


def written(folder: Path) -> pyproj.CRS:
    with laspy.open(next((folder / "store/survey=s/tiles/las").glob("*.laz"))) as reader:
        return reader.header.parse_crs()


def sorted_points(file: Path) -> np.ndarray:
    cloud = laspy.read(file)
    xyz = np.column_stack([cloud.x, cloud.y, cloud.z])
    return xyz[np.lexsort(xyz.T)]


@pytest.mark.slow
@pytest.mark.witness("height_not_stated")
@pytest.mark.parametrize(("log", "defaults"), [('height = "ellipsoidal"', ""), ("", 'defaults.height = "ellipsoidal"')])
def test_a_cloud_that_states_no_height_is_asked(faults: Path, tmp_path: Path, log: str, defaults: str) -> None:
    """Keys that define a Lambert projection in feet by parameters are EPSG:2992; the file's own WKT says so too."""
    file = faults / "oregon_lambert_feet_user_defined_keys.las"
    unit = '\noptions = { vertical_unit = "foot" }'
    code, said = run(tmp_path, file, 'crs = "EPSG:2992"', unit)
    assert code != 0
    assert "the kind of the log's heights is not stated" in said
    code, said = run(tmp_path, file, 'crs = "EPSG:2992"', log + unit, defaults)
    assert code == 0, said
    np.testing.assert_allclose(points(tmp_path), sorted_points(file), atol=1e-3)
    crs = written(tmp_path)
    assert [axis.unit_name for axis in crs.axis_info] == ["foot"] * 3
    lon_lat = pyproj.Transformer.from_crs(crs.to_2d(), 4269, always_xy=True).transform(*points(tmp_path)[0, :2])
    assert lon_lat == pytest.approx((-123.07, 44.06), abs=0.02)  # Autzen stadium, Eugene


@pytest.mark.slow
@pytest.mark.witness("height_contradicted")
def test_geotiff_keys_state_orthometric_feet(faults: Path, tmp_path: Path) -> None:
    file = faults / "mississippi_navd88_feet_keys.las"
    code, said = run(tmp_path, file, 'crs = "EPSG:2255"')
    assert code != 0
    assert "orthometric heights" in said
    code, said = run(tmp_path, file, 'crs = "EPSG:2255"', 'height = "ellipsoidal"')
    assert code != 0
    assert (
        "heights are orthometric by their CRS (NAVD88 height (ftUS)), height in the survey file says ellipsoidal"
        in said
    )
    code, said = run(tmp_path, file, 'crs = "EPSG:2255", height = "orthometric", vertical_crs = "EPSG:6360"')
    assert code == 0, said
    np.testing.assert_allclose(points(tmp_path), sorted_points(file), atol=1e-3)
    assert [part.to_epsg() for part in written(tmp_path).sub_crs_list] == [2255, 6360]


def test_a_vertical_crs_inside_a_horizontal_one(faults: Path, tmp_path: Path) -> None:
    """Its unit is named a foot and has the factor of a metre: which one is asked for."""
    file = faults / "navd88_ftus_wkt.las"
    map_ = 'crs = "EPSG:2903", height = "orthometric", vertical_crs = "EPSG:6360"'
    code, said = run(tmp_path, file, map_, clock=False)
    assert code != 0
    assert "the file states two units of z" in said
    code, said = run(tmp_path, file, map_, 'options = { vertical_unit = "us_survey_foot" }', clock=False)
    assert code == 0, said
    np.testing.assert_allclose(points(tmp_path), sorted_points(file), atol=1e-3)
    code, said = run(
        tmp_path, file, 'crs = "EPSG:2903"', 'height = "ellipsoidal"\noptions = { vertical_unit = "foot" }', clock=False
    )
    assert code != 0
    assert "North American Vertical Datum of 1988" in said


def test_a_cloud_in_degrees_is_one_message(faults: Path, tmp_path: Path) -> None:
    code, said = run(tmp_path, faults / "autzen_dd_epsg4326.las", 'crs = "EPSG:2992"')
    assert code != 0
    assert "'WGS 84', not a projected one: x and y are longitude and latitude in degrees" in said
    assert "export the cloud in a projected CRS" in said


def test_a_vertical_crs_of_another_kind_than_the_maps_heights(faults: Path, tmp_path: Path) -> None:
    code, said = run(tmp_path, faults / "navd88_ftus_wkt.las", 'crs = "EPSG:2903", vertical_crs = "EPSG:6360"')
    assert code != 0
    assert (
        "map.vertical_crs 'EPSG:6360' (NAVD88 height (ftUS)) is of orthometric heights, map.height is ellipsoidal"
        in said
    )


@pytest.mark.slow
def test_seconds_of_a_sunday_are_times(faults: Path, tmp_path: Path) -> None:
    """Seconds of the week below 86,400."""
    file = faults / "plane_week_seconds_sunday.laz"
    with laspy.open(file) as reader:
        assert reader.header.point_count == 28_185
    code, said = run(
        tmp_path,
        file,
        'crs = "EPSG:3945", max_datum_error_m = 5',
        'crs = "EPSG:3945"\nheight = "ellipsoidal"\noptions = { ignore_file_crs = true }',
    )
    assert code == 0, said
    found = json.loads(said[said.index("{\n") : said.rindex("}") + 1])
    assert found["logs"]["rows"] == 28_185
    looked = CliRunner().invoke(app, ["inspect", str(file), "--json"])
    assert "no possible time" not in looked.output
