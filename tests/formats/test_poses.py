"""Geometry of poses, against pyproj's geodesics and projections and SciPy's rotations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roadscan.core.crs import Geoid
from roadscan.core.errors import ConfigError, CrsError
from roadscan.ingest.reading.format import LogSource, NoOptions
from roadscan.ingest.reading.poses import (
    GeodeticPlacement,
    WorldPlacement,
    body_quaternion,
    level_placement,
    ned_from_rph,
    quaternion_product,
)

GEOD = pyproj.Geod(ellps="WGS84")
ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LOG = Path("log")

angles = st.floats(-math.pi, math.pi)


def rotation(quaternion: np.ndarray) -> Rotation:
    """SciPy's rotations of quaternions (4, n), scalar first."""
    return Rotation.from_quat(np.roll(quaternion, -1, axis=0).T)


def source(crs: str | None, **stated: object) -> LogSource:
    return LogSource(LOG, NoOptions(), crs=crs, **stated)


@settings(max_examples=50)
@given(angles, angles, angles)
def test_roll_pitch_heading_turn_in_the_order_z_y_x(roll: float, pitch: float, heading: float) -> None:
    ours = rotation(ned_from_rph(*(np.array([a]) for a in (roll, pitch, heading))))
    theirs = Rotation.from_euler("ZYX", [[heading, pitch, roll]])
    assert (ours * theirs.inv()).magnitude()[0] < 1e-12


@settings(max_examples=50)
@given(st.lists(angles, min_size=6, max_size=6))
def test_a_product_turns_by_the_right_factor_first(six: list[float]) -> None:
    a, b = (ned_from_rph(*(np.array([x]) for x in three)) for three in (six[:3], six[3:]))
    assert (rotation(quaternion_product(a, b)).inv() * rotation(a) * rotation(b)).magnitude()[0] < 1e-12


@settings(max_examples=50)
@given(st.floats(-180, 180), st.floats(-89, 89), st.floats(-100, 9000), st.floats(-180, 180), st.floats(-1, 1))
def test_a_vehicle_on_the_ellipsoid_points_along_the_geodesic(
    longitude: float, latitude: float, height: float, heading: float, roll: float
) -> None:
    placement = GeodeticPlacement("EPSG:4979", "ellipsoidal", None, LOG)
    position = np.array([[math.radians(longitude)], [math.radians(latitude)], [height]])
    attitude = ned_from_rph(np.array([roll]), np.array([0.0]), np.array([math.radians(heading)]))
    xyz, quaternion = placement.place(position, attitude)

    here = np.array(ECEF.transform(longitude, latitude, height))
    np.testing.assert_allclose(xyz[:, 0], here, rtol=0, atol=2e-8)
    ground = np.array(ECEF.transform(longitude, latitude, 0.0))
    ahead = np.array(ECEF.transform(*GEOD.fwd(longitude, latitude, heading, 1.0)[:2], 0.0))
    forward = (ahead - ground) / np.linalg.norm(ahead - ground)
    np.testing.assert_allclose(rotation(quaternion).apply([1.0, 0.0, 0.0])[0], forward, atol=1e-6)
    up = np.array(ECEF.transform(longitude, latitude, height + 1.0)) - here
    down = rotation(quaternion).apply([0.0, 0.0, 1.0])[0]  # leans left as the right side goes down
    assert down @ -up == pytest.approx(math.cos(roll), abs=1e-8)


@pytest.mark.parametrize(
    ("crs", "easting", "northing"),
    [
        ("EPSG:25832", 607_000.0, 5_540_000.0),  # east of the central meridian: convergence +1.1°
        ("EPSG:25832", 320_000.0, 5_540_000.0),  # west: −1.9°
        ("EPSG:32755", 690_000.0, 5_900_000.0),  # southern hemisphere
        ("EPSG:2263", 300_000.0, 60_000.0),  # New York Long Island, a Lambert cone; metres here, feet in the CRS
    ],
)
@pytest.mark.parametrize("heading_deg", [0.0, 77.0, 213.0])
def test_grid_and_true_headings(crs: str, easting: float, northing: float, heading_deg: float) -> None:
    """The vehicle's forward axis has the stated heading, on the grid or on the ellipsoid."""
    unit_m = pyproj.CRS(crs).axis_info[0].unit_conversion_factor
    position = np.array([[easting], [northing], [40.0]])
    attitude = ned_from_rph(np.array([0.0]), np.array([0.0]), np.array([math.radians(heading_deg)]))
    geographic = pyproj.Transformer.from_crs(crs, pyproj.CRS(crs).geodetic_crs, always_xy=True)

    def to_grid(placement_world: str, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        geodetic = pyproj.CRS(crs).geodetic_crs.to_3d()
        lon, lat, _ = pyproj.Transformer.from_crs(placement_world, geodetic, always_xy=True).transform(*xyz)
        return np.array([lon, lat]), np.array(geographic.transform(lon, lat, direction="INVERSE")) * unit_m

    for north in ("grid", "true"):
        placement = level_placement(source(crs, height="ellipsoidal"), north)
        xyz, quaternion = placement.place(position, attitude)
        ahead = xyz[:, 0] + 5.0 * rotation(quaternion).apply([1.0, 0.0, 0.0])[0]
        degrees, grid = to_grid(placement.world, xyz[:, 0])
        degrees_ahead, grid_ahead = to_grid(placement.world, ahead)
        np.testing.assert_allclose(grid, [easting, northing], atol=1e-5)
        if north == "grid":
            step = grid_ahead - grid
            found = math.degrees(math.atan2(step[0], step[1]))
        else:
            geod = pyproj.CRS(crs).get_geod()
            found = geod.inv(*degrees, *degrees_ahead)[0]
        assert (found - heading_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=2e-4), north


def test_heading_in_a_local_frame_is_clockwise_from_y() -> None:
    attitude = ned_from_rph(np.array([0.0]), np.array([0.1]), np.array([math.radians(30)]))
    xyz, quaternion = level_placement(source("local"), None).place(np.array([[1.0], [2.0], [3.0]]), attitude)
    assert xyz[:, 0].tolist() == [1.0, 2.0, 3.0]
    forward = rotation(quaternion).apply([1.0, 0.0, 0.0])[0]
    np.testing.assert_allclose(forward, [math.cos(0.1) * 0.5, math.cos(0.1) * math.sqrt(0.75), math.sin(0.1)])


def write_geoid(file: Path, undulation_m: float) -> None:
    """A constant geoid over Germany as GTX: big-endian origin, steps, rows, columns, float32."""
    with file.open("wb") as stream:
        np.array([45.0, 5.0, 1.0, 1.0], dtype=">f8").tofile(stream)
        np.array([11, 11], dtype=">i4").tofile(stream)
        np.full(121, undulation_m, dtype=">f4").tofile(stream)


@pytest.mark.parametrize(
    ("crs", "position"),
    [
        ("EPSG:4979", [math.radians(10), math.radians(50), 100.0]),
        ("EPSG:25832", [571_600.0, 5_539_000.0, 100.0]),
    ],
)
def test_orthometric_heights_are_raised_by_the_named_geoid(tmp_path: Path, crs: str, position: list[float]) -> None:
    grid = tmp_path / "constant.gtx"
    write_geoid(grid, 47.5)
    attitude = ned_from_rph(np.zeros(1), np.zeros(1), np.zeros(1))
    column = np.array(position)[:, None]
    north = "true"
    ellipsoidal, _ = level_placement(source(crs, height="ellipsoidal"), north).place(column, attitude)
    raised, _ = level_placement(source(crs, height="orthometric", geoid=Geoid.found(str(grid))), north).place(
        column, attitude
    )
    assert np.linalg.norm(raised - ellipsoidal) == pytest.approx(47.5, abs=1e-5)
    assert np.linalg.norm(raised) > np.linalg.norm(ellipsoidal)


@pytest.mark.parametrize(
    ("stated", "north", "error", "says"),
    [
        ({"crs": None}, None, ConfigError, "CRS of the log's positions is not stated"),
        ({"crs": "EPSG:25832"}, None, ConfigError, "north that the log's heading is counted from"),
        ({"crs": "EPSG:25832"}, "grid", ConfigError, "kind of the log's heights is not stated"),
        ({"crs": "EPSG:4326"}, None, ConfigError, "kind of the log's heights is not stated"),
        ({"crs": "local"}, "true", ConfigError, "no true north"),
        ({"crs": "EPSG:4979"}, "grid", ConfigError, "has no grid"),
        ({"crs": "EPSG:4978"}, None, CrsError, "no geographic CRS"),
        ({"crs": "EPSG:9518"}, None, CrsError, "heights are stated apart"),
        ({"crs": "EPSG:4979", "height": "orthometric"}, None, CrsError, "no geoid is named"),
        ({"crs": "EPSG:25832", "height": "orthometric"}, "grid", CrsError, "no geoid is named"),
        ({"crs": "EPSG:4807"}, None, CrsError, "expected Greenwich"),
        ({"crs": "EPSG:0"}, None, CrsError, "not known to PROJ"),
    ],
)
def test_nothing_is_guessed(stated: dict[str, object], north: str | None, error: type, says: str) -> None:
    with pytest.raises(error, match=says):
        level_placement(LogSource(LOG, NoOptions(), **stated), north)


def test_cartesian_poses_need_a_cartesian_frame() -> None:
    assert WorldPlacement("local", LOG).world == "local"
    assert WorldPlacement("EPSG:4978", LOG).world == "EPSG:4978"
    with pytest.raises(CrsError, match="Cartesian"):
        WorldPlacement("EPSG:25832", LOG)


def test_axes_are_stated() -> None:
    with pytest.raises(ConfigError, match="axes of the poses are not stated"):
        body_quaternion(None, LOG)
    with pytest.raises(ConfigError, match="one of frd"):
        body_quaternion("xyz", LOG)
    # The body's right is the negative y of a forward-left-up frame.
    flu_from_body = rotation(body_quaternion("flu", LOG)[:, None])
    np.testing.assert_allclose(flu_from_body.apply([[0, 1, 0], [0, 0, 1]]), [[0, -1, 0], [0, 0, -1]], atol=1e-15)
