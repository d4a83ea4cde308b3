"""Products of maps with awkward axes and units open at the right place in other programs."""

from __future__ import annotations

from pathlib import Path

import geopandas
import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app

FIRST_GPS_S = 1_461_922_218
PLACES = {
    "EPSG:5514": (15.0, 49.8, "EPSG:4156"),
    "EPSG:2225": (-122.0, 41.0, "EPSG:4269"),
    "EPSG:6559": (-121.0, 45.0, "EPSG:6318"),
    "EPSG:2048": (19.3, -32.0, "EPSG:4148"),
    "EPSG:22275": (15.3, -28.0, "EPSG:4222"),
    "EPSG:31467": (9.2, 50.0, "EPSG:4314"),
    "EPSG:2193": (172.0, -43.0, "EPSG:4167"),
    "EPSG:27700": (-2.0, 53.0, "EPSG:4277"),
}
"""Longitude and latitude (°) within the area of each map, and the geographic CRS of the drive."""
HEIGHT_M = 250.0
LEVER_M = 2.0
"""All returns lie so far below the poses."""


@pytest.mark.parametrize("crs", PLACES)
def test_products_open_where_the_road_is(tmp_path: Path, crs: str) -> None:
    root = made(tmp_path, crs)
    files = sorted((root / "tiles/las").glob("*.laz"))
    assert files
    for points in files:
        with laspy.open(points) as reader:
            cloud, written = reader.read(), reader.header.parse_crs()
        to_degrees = pyproj.Transformer.from_crs(written, pyproj.CRS(PLACES[crs][2]).to_3d(), always_xy=True)
        lon, lat, height = to_degrees.transform(*(np.asarray(cloud[axis]) for axis in "xyz"))
        check_place(crs, lon, lat, 1e-3)
        np.testing.assert_allclose(height, HEIGHT_M - LEVER_M, atol=2e-3)

    unit_m = pyproj.CRS(crs).axis_info[0].unit_conversion_factor
    for raster in sorted((root / "tiles/geotiff").glob("*.tif")):
        with rasterio.open(raster) as image:
            heights = image.read(image.descriptions.index("height") + 1)
            rows, columns = np.nonzero(np.isfinite(heights))
            x, y = (np.array(v) for v in rasterio.transform.xy(image.transform, rows, columns))
            written = pyproj.CRS.from_wkt(image.crs.to_wkt())
        check_place(crs, *degrees(written, crs, x, y), 0.15)
        np.testing.assert_allclose(heights[rows, columns] * unit_m, HEIGHT_M - LEVER_M, atol=2e-3)

    tiles = geopandas.read_parquet(root / "products/tile_table/tiles.parquet")
    middle = tiles.geometry.centroid
    check_place(crs, *degrees(pyproj.CRS(tiles.crs), crs, middle.x.to_numpy(), middle.y.to_numpy()), 40.0)


@pytest.mark.parametrize(("crs", "twin"), [("EPSG:5513", "EPSG:5514"), ("EPSG:2065", "EPSG:5221")])
def test_a_map_on_which_left_is_right_is_refused(tmp_path: Path, crs: str, twin: str) -> None:
    """Krovak's southing and westing: roughness of the left wheel path would be that of the right one."""
    survey = survey_in(tmp_path, crs, *PLACES["EPSG:5514"])
    done = CliRunner().invoke(app, ["run", str(survey), "--workers", "0"])
    assert done.exit_code != 0
    assert "left and right are exchanged" in str(done.exception) and f'map.crs = "{twin}"' in str(done.exception)


def degrees(written: pyproj.CRS, crs: str, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude by the CRS that a product names."""
    return pyproj.Transformer.from_crs(written.to_2d(), PLACES[crs][2], always_xy=True).transform(x, y)


def check_place(crs: str, lon: np.ndarray, lat: np.ndarray, within_m: float) -> None:
    """Each place is within some metres of the road, which runs north for a metre from the place of the map."""
    assert len(lon) > 0
    geod = pyproj.CRS(crs).get_geod()
    east, north, _ = PLACES[crs]
    _, _, across_m = geod.inv(np.full_like(lon, east), lat, lon, lat)
    along_m = (np.asarray(lat) - north) * 111_000
    assert np.abs(across_m).max() < within_m
    assert along_m.min() > -within_m - 0.1
    assert along_m.max() < 1.2 + within_m


def survey_in(folder: Path, crs: str, lon: float, lat: float, geographic: str) -> Path:
    """The survey file of a metre's drive."""
    n = 101
    header = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
    lines = [f"{FIRST_GPS_S + 0.01 * k:.2f},{lat + 9e-8 * k:.10f},{lon:.10f},{HEIGHT_M},0,0,0" for k in range(n)]
    (folder / "poses.csv").write_text("\n".join([header, *lines, ""]))
    epochs = (FIRST_GPS_S * 10**9 + np.arange(400) * 2_400_000 + 10_000_000).astype(np.int64)
    rs.write_returns(folder / "returns.parquet", epochs, np.tile([0.0, 0.0, LEVER_M], (400, 1)))
    (folder / "SURVEY.toml").write_text(
        f"""id = "s"
map = {{ crs = "{crs}" }}
rig.sensors.roof = {{ kind = "lidar", axes = "frd", lever_arm_body_m = [0.0, 0.0, 0.0] }}
tiles = {{ cell_m = 0.1 }}
adjust = {{ on = false }}
products = {{ make = ["las", "geotiff", "tile_table"] }}
[[runs]]
id = "r"
[[runs.logs]]
path = "poses.csv"
crs = "{geographic}"
height = "ellipsoidal"
clock = {{ system = "gps" }}
[[runs.logs]]
path = "returns.parquet"
sensor = "roof"
""",
        encoding="utf-8",
    )
    return folder / "SURVEY.toml"


def made(folder: Path, crs: str) -> Path:
    """The store of a survey of a metre's drive, through the command line."""
    result = CliRunner().invoke(app, ["run", str(survey_in(folder, crs, *PLACES[crs])), "--workers", "0"])
    assert result.exit_code == 0, f"{result.output}{result.exception}"
    return folder / "store/survey=s"
