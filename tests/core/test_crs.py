"""Map frames against PROJ's own transformations; heights against a grid written here."""

from __future__ import annotations

import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pyproj.network
import pytest

from roadscan.core.crs import (
    LOCAL_WORLD,
    WGS84_WORLD,
    Anchor,
    Geoid,
    MapFrame,
    crs_from_text,
    geodetic_from_world,
    grid_convergence_rad,
    world_frame_of,
    world_from_geodetic,
)
from roadscan.core.errors import CrsError

US_SURVEY_FOOT_M = 1200 / 3937


def world_points(geographic: str, geocentric: str, lon: float, lat: float) -> tuple[np.ndarray, np.ndarray]:
    """Longitude, latitude, height (n, 3) around a place, and the same as ECEF."""
    rng = np.random.default_rng(3)
    llh = np.array([lon, lat, 60.0]) + rng.uniform(-1, 1, (50, 3)) * [0.05, 0.05, 40.0]
    to_ecef = pyproj.Transformer.from_crs(geographic, geocentric, always_xy=True)
    return llh, np.stack(to_ecef.transform(*llh.T), axis=-1)


def test_network_is_off() -> None:
    assert not pyproj.network.is_network_enabled()
    with ThreadPoolExecutor(1) as pool:
        assert not pool.submit(pyproj.network.is_network_enabled).result()


# EPSG:6319/6317 are NAD83(2011), EPSG:4937/4936 ETRS89: longitude-latitude-height and geocentric.
@pytest.mark.parametrize(
    ("crs", "geographic", "geocentric", "lon", "lat", "unit_m"),
    [
        ("EPSG:32632", "EPSG:4979", "EPSG:4978", 9.5, 47.2, 1.0),
        ("EPSG:32756", "EPSG:4979", "EPSG:4978", 151.2, -33.9, 1.0),
        ("EPSG:25832", "EPSG:4937", "EPSG:4936", 9.5, 52.2, 1.0),
        ("EPSG:6539", "EPSG:6319", "EPSG:6317", -73.6, 40.8, US_SURVEY_FOOT_M),
    ],
)
def test_map_coordinates_agree_with_proj_and_return(
    crs: str, geographic: str, geocentric: str, lon: float, lat: float, unit_m: float
) -> None:
    llh, xyz = world_points(geographic, geocentric, lon, lat)
    frame = MapFrame(crs=crs)
    two_d = pyproj.Transformer.from_crs(crs_from_text(geographic).to_2d(), crs, always_xy=True)
    expected = np.stack([*two_d.transform(llh[:, 0], llh[:, 1])], axis=-1) * unit_m
    for world in (world_frame_of(crs), world_frame_of(geocentric)):
        enh = frame.map_from_world(world, xyz)
        np.testing.assert_allclose(enh[:, :2], expected, atol=1e-6)
        np.testing.assert_allclose(enh[:, 2], llh[:, 2], atol=1e-6)
        np.testing.assert_allclose(frame.world_from_map(world, enh), xyz, atol=1e-6)
    assert frame.horizontal_unit_m == pytest.approx(unit_m, rel=1e-12)
    assert frame.vertical_unit_m == frame.horizontal_unit_m


def test_geodetic_positions_return() -> None:
    llh, xyz = world_points("EPSG:4979", "EPSG:4978", 9.5, 47.2)
    np.testing.assert_allclose(geodetic_from_world(WGS84_WORLD, xyz), llh, atol=1e-8)
    np.testing.assert_allclose(world_from_geodetic(WGS84_WORLD, llh), xyz, atol=1e-8)


@pytest.mark.parametrize(
    ("stated", "datum"),
    [
        ("EPSG:4326", "World Geodetic System 1984 ensemble"),
        ("EPSG:4979", "World Geodetic System 1984 ensemble"),
        ("EPSG:32632", "World Geodetic System 1984 ensemble"),
        ("EPSG:4978", "World Geodetic System 1984 ensemble"),
        ("EPSG:6539", "NAD83 (National Spatial Reference System 2011)"),
        ("EPSG:7844", "Geocentric Datum of Australia 2020"),
        ("EPSG:9988", "International Terrestrial Reference Frame 2020"),
    ],
)
def test_world_frame_keeps_the_datum(stated: str, datum: str) -> None:
    world = crs_from_text(world_frame_of(stated))
    assert world.is_geocentric
    assert world.datum is not None
    assert world.datum.name == datum


def test_a_coarse_change_of_datum_is_refused_unless_allowed() -> None:
    _, xyz = world_points("EPSG:4979", "EPSG:4978", 9.5, 52.2)
    with pytest.raises(CrsError, match=r"WGS 84 to ETRS89.*known to 1 m only.*max_datum_error_m = 0\.05"):
        MapFrame(crs="EPSG:25832").map_from_world(WGS84_WORLD, xyz)
    allowed = MapFrame(crs="EPSG:25832", max_datum_error_m=1.0).map_from_world(WGS84_WORLD, xyz)
    # Within a metre the two datums are one and the same, so the UTM grids agree.
    np.testing.assert_allclose(allowed, MapFrame(crs="EPSG:32632").map_from_world(WGS84_WORLD, xyz), atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"crs": "EPSG:4326"}, "not projected"),
        ({"crs": "EPSG:25832+7837"}, "compound.*map.vertical_crs"),
        ({"crs": "EPSG:999999"}, "not known to PROJ"),
        ({"crs": "EPSG:25832", "vertical_crs": "EPSG:7837"}, "is of orthometric heights, map.height is ellipsoidal"),
    ],
)
def test_map_frames_that_make_no_sense(arguments: dict[str, str], words: str) -> None:
    with pytest.raises(CrsError, match=words):
        MapFrame(**arguments)  # type: ignore[arg-type]


def test_orthometric_heights_need_a_geoid_where_poses_come_into_the_map() -> None:
    with pytest.raises(CrsError, match=r"no geoid is named.*geoid = "):
        MapFrame(crs="EPSG:25832", height="orthometric").check_world(WGS84_WORLD)


def test_a_position_outside_the_projection() -> None:
    with pytest.raises(CrsError, match="cannot be projected"):
        MapFrame(crs="EPSG:32632").map_from_world(WGS84_WORLD, np.array([[np.inf, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("crs", "lon", "lat"), [("EPSG:32632", 11.9, 47.2), ("EPSG:32756", 151.2, -33.9), ("EPSG:6539", -73.0, 40.8)]
)
def test_convergence_by_a_step_to_the_north(crs: str, lon: float, lat: float) -> None:
    project = pyproj.Transformer.from_crs(crs_from_text(crs).geodetic_crs, crs, always_xy=True)
    south, north = (np.array(project.transform(lon, lat + d)) for d in (-1e-5, 1e-5))
    bearing_of_true_north = np.arctan2(*(north - south))
    assert abs(bearing_of_true_north) > 1e-3
    convergence = grid_convergence_rad(crs, np.array([[lon, lat, 0.0]]))
    np.testing.assert_allclose(convergence, [-bearing_of_true_north], atol=1e-7)


# --- local frames -------------------------------------------------------------------------------

ANCHOR = Anchor(latitude_deg=52.2, longitude_deg=9.5, height_m=80.0, heading_deg=30.0)


def test_local_poses_on_a_local_map_stay_as_they_are() -> None:
    points = np.array([[1.0, 2.0, 3.0]])
    frame = MapFrame(crs=None, local_name="yard")
    np.testing.assert_array_equal(frame.map_from_world(LOCAL_WORLD, points), points)
    np.testing.assert_array_equal(frame.world_from_map(LOCAL_WORLD, points), points)
    assert frame.is_local
    assert pyproj.CRS(frame.wkt()).name == "yard"
    assert frame.wkt("WKT1_GDAL").startswith('LOCAL_CS["yard"')


def test_the_anchor_points_y_along_its_heading() -> None:
    local = np.array([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [100.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    geodesic = pyproj.Geod(ellps="WGS84")
    ecef = MapFrame(crs=None, anchor=ANCHOR).world_from_map(WGS84_WORLD, local)
    lon, lat, height = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)
    assert (lon[0], lat[0], height[0]) == pytest.approx((9.5, 52.2, 80.0), abs=1e-9)
    bearing_y, _, length_y = geodesic.inv(lon[0], lat[0], lon[1], lat[1])
    bearing_x, _, _ = geodesic.inv(lon[0], lat[0], lon[2], lat[2])
    assert bearing_y == pytest.approx(30.0, abs=1e-3)
    assert length_y == pytest.approx(100.0, abs=2e-3)
    assert bearing_x == pytest.approx(120.0, abs=1e-3)
    assert height[3] == pytest.approx(85.0, abs=1e-9)


def test_local_map_with_earth_bound_poses_returns() -> None:
    _, xyz = world_points("EPSG:4979", "EPSG:4978", 9.5, 52.2)
    frame = MapFrame(crs=None, anchor=ANCHOR)
    np.testing.assert_allclose(
        frame.world_from_map(WGS84_WORLD, frame.map_from_world(WGS84_WORLD, xyz)), xyz, atol=1e-8
    )


def test_local_poses_on_a_projected_map() -> None:
    local = np.array([[0.0, 0.0, 0.0], [3.0, 40.0, -1.5]])
    frame = MapFrame(crs="EPSG:32632", anchor=ANCHOR)
    by_hand = frame.map_from_world(WGS84_WORLD, MapFrame(crs=None, anchor=ANCHOR).world_from_map(WGS84_WORLD, local))
    enh = frame.map_from_world(LOCAL_WORLD, local)
    np.testing.assert_allclose(enh, by_hand, atol=1e-9)
    np.testing.assert_allclose(frame.world_from_map(LOCAL_WORLD, enh), local, atol=1e-8)


@pytest.mark.parametrize(("crs", "world"), [("EPSG:32632", LOCAL_WORLD), (None, WGS84_WORLD)])
def test_without_an_anchor_nothing_is_mixed(crs: str | None, world: str) -> None:
    with pytest.raises(CrsError, match=r"map\.local\.anchor"):
        MapFrame(crs=crs).map_from_world(world, np.zeros((1, 3)))


# --- heights ------------------------------------------------------------------------------------

SOUTH, WEST, STEP = 45.0, 5.0, 0.5


def undulation(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """A plane, so that bilinear interpolation of the grid is exact."""
    return 47.0 + 0.8 * (lat - 47.0) - 0.5 * (lon - 9.0)


@pytest.fixture
def plane_geoid(tmp_path: Path) -> Geoid:
    """A GTX grid (NOAA's format: big-endian header, rows from the south) that holds the plane."""
    lat = SOUTH + STEP * np.arange(12)
    lon = WEST + STEP * np.arange(16)
    header = struct.pack(">4d2i", SOUTH, WEST, STEP, STEP, lat.size, lon.size)
    values = undulation(lon[None, :], lat[:, None]).astype(">f4")
    name = f"plane {tmp_path.name}.gtx"
    (tmp_path / name).write_bytes(header + values.tobytes())
    return Geoid.found(name, tmp_path)


def test_undulation_is_interpolated(plane_geoid: Geoid) -> None:
    lon, lat = np.array([9.13, 7.0, 11.99]), np.array([47.31, 46.2, 45.01])
    np.testing.assert_allclose(plane_geoid.undulation_m(lon, lat), undulation(lon, lat), atol=1e-5)


def test_orthometric_is_ellipsoidal_minus_undulation(plane_geoid: Geoid) -> None:
    llh, xyz = world_points("EPSG:4979", "EPSG:4978", 9.5, 47.2)
    frame = MapFrame(crs="EPSG:32632", height="orthometric", geoid=plane_geoid)
    enh = frame.map_from_world(WGS84_WORLD, xyz)
    np.testing.assert_allclose(enh[:, 2], llh[:, 2] - undulation(llh[:, 0], llh[:, 1]), atol=1e-5)
    np.testing.assert_allclose(frame.world_from_map(WGS84_WORLD, enh), xyz, atol=1e-6)


def test_a_folder_of_grids_serves_threads_that_already_used_proj(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    with ThreadPoolExecutor(1) as pool:
        pool.submit(lambda: pyproj.Transformer.from_crs(4979, 4978).transform(47.0, 9.0, 0.0)).result()
        geoid = request.getfixturevalue("plane_geoid")
        assert pool.submit(geoid.undulation_m, 9.0, 47.0).result() == pytest.approx([47.0], abs=1e-5)


def test_a_missing_grid_is_named_with_the_place_to_put_it(tmp_path: Path) -> None:
    with pytest.raises(CrsError) as caught:
        Geoid.found("us_noaa_g2018u0.tif", tmp_path).undulation_m(-74.0, 40.7)
    assert "geoid grid 'us_noaa_g2018u0.tif' was not found" in str(caught.value)
    assert str(tmp_path.resolve()) in str(caught.value)


def test_outside_the_grid(plane_geoid: Geoid) -> None:
    with pytest.raises(CrsError, match=r"does not cover longitude 99\.0000°, latitude 46"):
        plane_geoid.undulation_m([9.0, 99.0], [47.0, 46.0])


def test_a_vertical_crs_is_named_and_changes_no_number(plane_geoid: Geoid) -> None:
    _, xyz = world_points("EPSG:4979", "EPSG:4978", 9.5, 47.2)
    plain = MapFrame(crs="EPSG:32632", height="orthometric", geoid=plane_geoid)
    named = replace(plain, vertical_crs="EPSG:7837")
    np.testing.assert_array_equal(plain.map_from_world(WGS84_WORLD, xyz), named.map_from_world(WGS84_WORLD, xyz))
    named = MapFrame(crs="EPSG:6539", height="orthometric", geoid=plane_geoid, vertical_crs="EPSG:6360")
    compound = pyproj.CRS(named.wkt())
    assert compound.is_compound
    assert [c.to_authority() for c in compound.sub_crs_list] == [("EPSG", "6539"), ("EPSG", "6360")]
    assert named.vertical_unit_m == pytest.approx(US_SURVEY_FOOT_M)
    assert pyproj.CRS(named.wkt("WKT1_GDAL")).is_compound
