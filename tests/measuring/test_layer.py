"""The layer of pictures, read by geopandas, pyogrio and GDAL, against the simulator's true poses."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import geopandas
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from PIL import Image
from scipy.spatial.transform import Rotation

import roadscan as rs
from roadscan.core.survey import Survey
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.survey.run import run_stages
from tests.measuring.drive import FOCAL, HEIGHT, WIDTH, Drive
from tests.surface.test_surfaces import TwoThreads
from tests.surveys import Lines

pytestmark = pytest.mark.slow

FOLDER = "store/survey=demo/products/pictures"


def true_axes(drive: Drive, file: str) -> np.ndarray:
    """Columns: the camera's forward, right and down on the map (east, north, up), by PROJ over a metre."""
    eye, turn = drive.camera(file)
    to_map = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS(drive.known.scene.map.crs).to_3d(), always_xy=True)
    ends = np.stack(to_map.transform(*np.vstack([eye, eye + turn.as_matrix().T]).T), axis=-1)
    axes = (ends[1:] - ends[0]).T
    return axes / np.linalg.norm(axes, axis=0)


@pytest.fixture(scope="module")
def layer(measured_drive: Drive) -> geopandas.GeoDataFrame:
    (file,) = (measured_drive.survey_file.parent / FOLDER).glob("*.parquet")
    return geopandas.read_parquet(file)


def test_places_and_orientations_are_the_true_ones(measured_drive: Drive, layer: geopandas.GeoDataFrame) -> None:
    assert set(layer["focal_x_px"]) == {FOCAL} and set(layer["width_px"]) == {WIDTH}
    assert list(layer["file"]) == list(measured_drive.poses) and layer["without_pose"].isna().all()
    to_degrees = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    for row in layer.itertuples():
        eye, turn = measured_drive.camera(row.file)
        place = np.array([row.easting_m, row.northing_m, row.height_m])
        assert np.linalg.norm(measured_drive.world(place)[0] - eye) < 1e-3
        assert np.allclose([row.geometry.x, row.geometry.y, row.geometry.z], place, atol=1e-9)
        lon_lat = to_degrees.transform(*eye)
        assert np.allclose([row.longitude_deg, row.latitude_deg], lon_lat[:2], atol=1e-9)
        assert row.ellipsoidal_height_m == pytest.approx(lon_lat[2], abs=1e-3)
        axes = true_axes(measured_drive, row.file)
        opencv = axes[:, [1, 2, 0]]  # right, down, ahead
        by_quaternion = Rotation.from_quat([row.qx, row.qy, row.qz, row.qw]).as_matrix()
        by_angles = Rotation.from_euler("XYZ", [row.omega_deg, row.phi_deg, row.kappa_deg], degrees=True).as_matrix()
        assert np.abs(by_quaternion - opencv).max() < 1e-5
        assert np.abs(by_angles @ np.diag([1.0, -1.0, -1.0]) - opencv).max() < 1e-5
        north = np.radians(lon_lat[:2])
        ned = np.array([
            [-np.sin(north[1]) * np.cos(north[0]), -np.sin(north[1]) * np.sin(north[0]), np.cos(north[1])],
            [-np.sin(north[0]), np.cos(north[0]), 0.0],
            [-np.cos(north[1]) * np.cos(north[0]), -np.cos(north[1]) * np.sin(north[0]), -np.sin(north[1])],
        ])  # fmt: skip
        yaw, pitch, roll = Rotation.from_matrix(ned @ turn.as_matrix()).as_euler("ZYX", degrees=True)
        assert np.allclose([row.yaw_deg, row.pitch_deg, row.roll_deg], [yaw % 360.0, pitch, roll], atol=1e-6)
        moment = dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(microseconds=row.epoch_gps_ns / 1e3 - 18e6)
        assert abs((dt.datetime.fromisoformat(row.utc) - moment).total_seconds()) < 2e-6


def test_sigma_is_what_trajectory_and_mounting_state(measured_drive: Drive, layer: geopandas.GeoDataFrame) -> None:
    """The simulator's logs state 1 mm and 0.0005°, 0.001° of heading; the rig file states none of its mounting."""
    row = layer.iloc[1]
    lever = np.linalg.norm(measured_drive.known.scene.camera.mount.lever_arm_body_m)
    assert 1e-3 <= row["sigma_easting_m"] < 1e-3 + lever * 2e-5
    assert row["sigma_pitch_deg"] == pytest.approx(5e-4, rel=0.05)
    assert row["sigma_yaw_deg"] == pytest.approx(1e-3, rel=0.1)
    assert row["sigma_assumed"] == "mounting without σ, taken as 0"
    assert 0.0 < row["sigma_phi_deg"] < 0.01 and 0.0 < row["sigma_kappa_deg"] < 0.01


def test_footprints_hold_what_the_pictures_show(measured_drive: Drive, layer: geopandas.GeoDataFrame) -> None:
    corners, count = measured_drive.corners(), np.zeros(2, int)
    for row in layer.itertuples():
        assert row.footprint.is_valid and row.footprint.area == pytest.approx(row.footprint_m2)
        pixel = measured_drive.pixels(row.file, corners)
        own = measured_drive.seen(row.file, corners)
        seen = np.isfinite(pixel).all(axis=1)
        inside = shapely.contains_xy(row.footprint.buffer(0.1), corners[:, 0], corners[:, 1])
        assert inside[seen].all()
        outside = ~shapely.contains_xy(row.footprint.buffer(-0.3), corners[:, 0], corners[:, 1])
        unseen = (own[:, 2] < 0.5) | ~seen
        assert outside[unseen].mean() > 0.97  # the picture's border is left out by 2 pixels
        count += [seen.sum(), unseen.sum()]
        far = shapely.get_coordinates(row.footprint) - [row.easting_m, row.northing_m]
        assert np.hypot(*far.T).max() < 30.1
    assert count.min() > 30
    assert layer["footprint_on_ground"].between(0.0, 1.0).all() and layer["footprint_on_ground"].max() > 0.3


def test_the_geopackage_holds_the_same(measured_drive: Drive, layer: geopandas.GeoDataFrame) -> None:
    file = measured_drive.survey_file.parent / FOLDER / "pictures.gpkg"
    assert dict(pyogrio.list_layers(file)) == {
        "pictures": "Point Z", "footprints": "Polygon Z",
    }  # fmt: skip
    rows, prints = (pyogrio.read_dataframe(file, layer=name) for name in ("pictures", "footprints"))
    assert rows.crs == layer.crs and len(rows) == len(layer) == len(prints)
    assert np.allclose(rows["kappa_deg"], layer["kappa_deg"])
    for one, same in zip(prints.geometry, layer["footprint"], strict=True):
        assert one.equals_exact(shapely.from_wkb(shapely.to_wkb(same)), 1e-6)
    table = rs.open_survey(measured_drive.survey_file).table("pictures")
    assert len(table) == len(layer) and table.geometry.iloc[0].has_z and table["footprint"].iloc[0].area > 1.0


def test_workers_and_files_change_no_byte(
    measured_drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = sorted((measured_drive.survey_file.parent / FOLDER).iterdir())
    before = {file.name: file.read_bytes() for file in files}
    one = Drive(measured_drive.copy_with_store_to(tmp_path / "survey").survey_file)
    session = Session(Survey.load(one.survey_file), one.store(), TwoThreads(), reporter=Lines())
    session.manifest.remove(list(session.manifest.of("pictures").values()))
    run_stages(session, [stage_named("pictures")])
    folder = one.survey_file.parent / FOLDER
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    monkeypatch.setattr("roadscan.measuring.work._IN_A_FILE", 2)
    again = Session(Survey.load(one.survey_file), one.store(), TwoThreads(), reporter=Lines())
    run_stages(again, [stage_named("pictures")])
    parts = sorted(folder.glob("*.parquet"))
    assert len(parts) == 3
    joined = np.concatenate([geopandas.read_parquet(part)["kappa_deg"].to_numpy() for part in parts])
    (whole,) = (name for name in before if name.endswith(".parquet"))
    (tmp_path / "whole.parquet").write_bytes(before[whole])
    assert np.array_equal(joined, geopandas.read_parquet(tmp_path / "whole.parquet")["kappa_deg"].to_numpy())


def test_pictures_without_a_pose_say_why(measured_drive: Drive, tmp_path: Path) -> None:
    one = Drive(measured_drive.copy_with_store_to(tmp_path / "survey").survey_file)
    folder = one.survey_file.parent / "raw" / "run-1" / "camera"
    stamps = folder / "stamps.csv"
    lines = stamps.read_text().splitlines()
    last = int(lines[-1].split(",")[1])
    for name, size, stamp in (("late.jpg", (WIDTH, HEIGHT), last + 60 * 10**9), ("small.jpg", (320, 200), last - 5)):
        Image.new("L", size, 90).save(folder / name)
        lines.append(f"{name},{stamp}")
    Image.new("L", (WIDTH, HEIGHT)).save(folder / "black.jpg")  # black is no reason
    lines.append(f"black.jpg,{last - 7}")
    stamps.write_text("\n".join(lines) + "\n")
    survey, compute = Survey.load(one.survey_file), Lines()
    session = Session(survey, one.store(), reporter=compute)
    run_stages(session, [stage_named(name) for name in ("ingest", "pictures")])
    rows = geopandas.GeoDataFrame(rs.open_survey(one.survey_file).table("pictures"))
    without = rows[rows["without_pose"].notna()].set_index("file")
    assert set(without.index) == {"late.jpg", "small.jpg"} and without["easting_m"].isna().all()
    assert "after the trajectory ends" in without.loc["late.jpg", "without_pose"]
    assert without.loc["small.jpg", "without_pose"].startswith("320 × 200 pixels, and the interior orientation is for")
    assert without.geometry.isna().all() and len(rows) == len(measured_drive.poses) + 3
    assert sum("without a pose" in line for line in compute.lines) == 2
    again = Session(Survey.load(one.survey_file), one.store(), reporter=Lines())
    assert stage_named("pictures").state(again).stale == 0
    package = pyogrio.read_dataframe(one.survey_file.parent / FOLDER / "pictures.gpkg", layer="pictures")
    assert len(package) == len(rows) and package["without_pose"].notna().sum() == 2
