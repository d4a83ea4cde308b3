"""The door for Python: what it hands out is what the store holds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
import rasterio
from scipy.spatial.transform import Rotation

import roadscan as rs
from roadscan.simulate import truth
from tests.surveys import Simulated


@pytest.fixture(scope="module")
def survey(finished: Simulated) -> rs.OpenSurvey:
    return rs.open_survey(finished.survey_file)


def test_nothing_heavy_is_imported_with_it() -> None:
    code = (
        "import sys, time; t = time.perf_counter(); import roadscan; "
        "print(time.perf_counter() - t, len({'numpy', 'pandas', 'pyarrow', 'pydantic', 'numba'} & set(sys.modules)))"
    )
    took = []
    for _ in range(3):
        told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
        took.append(float(told[0]))
        assert told[1] == "0"
    assert min(took) < 0.15


def test_every_public_name_is_there() -> None:
    assert all(getattr(rs, name) is not None for name in rs.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        rs.no_such_name  # noqa: B018


def test_a_table_is_a_frame_of_its_rows(survey: rs.OpenSurvey) -> None:
    run = survey.runs[0]
    trajectory = survey.table("trajectory", run=run)
    rows = survey.sql(f"SELECT count(*) FROM trajectory WHERE run = '{run}'").fetchall()
    assert len(trajectory) == rows[0][0] > 0
    middle = int(trajectory.epoch_gps_ns.median())
    before = survey.table("trajectory", run=run, end=middle)
    after = survey.table("trajectory", run=run, start=middle)
    assert len(before) + len(after) == len(trajectory)
    assert before.epoch_gps_ns.max() < middle <= after.epoch_gps_ns.min()


def test_tables_with_a_geometry_lie_on_the_map(survey: rs.OpenSurvey) -> None:
    tiles = survey.table("tiles")
    assert isinstance(tiles, geopandas.GeoDataFrame)
    assert tiles.crs == survey.crs
    file = pq.read_table(survey.products["tile_table"].paths()[0])
    assert sorted(tiles.tile) == sorted(file.column("tile").to_pylist())
    with rasterio.open(survey.products["mosaic"].paths()[0]) as mosaic:
        assert tiles.total_bounds == pytest.approx(mosaic.bounds)


def test_an_unknown_table_names_the_nearest(survey: rs.OpenSurvey) -> None:
    with pytest.raises(rs.RoadscanError, match=r"there is no table 'trajectry'.*trajectory"):
        survey.table("trajectry")


def test_a_table_that_is_not_made_yet_says_what_makes_it(survey: rs.OpenSurvey) -> None:
    for ask in (lambda: survey.table("cracks"), lambda: survey.sql("SELECT * FROM cracks")):
        with pytest.raises(rs.RoadscanError, match=r"'cracks' is not made yet; add \"cracks\" to \[products\] make"):
            ask()


def test_rows_of_what_is_not_there_are_refused(survey: rs.OpenSurvey) -> None:
    run = survey.runs[0]
    for wanted, told in (
        ({"run": run + "x"}, f"unknown run '{run}x'.*did you mean '{run}'"),
        ({"sensor": "trajektory"}, "unknown sensor 'trajektory'.*did you mean 'trajectory'"),
        ({"start": 5, "end": 3}, "before it starts"),
        ({"start": 5.5}, "5.5 is no instant"),
        ({"start": "monday"}, "'monday' is no instant"),
    ):
        with pytest.raises(rs.RoadscanError, match=told):
            survey.table("trajectory", **wanted)
    assert survey.table("trajectory", run=run, end=5).empty


def test_an_answer_of_a_damaged_file_is_refused(survey: rs.OpenSurvey) -> None:
    root = Path(survey.store.path("tables"))
    file = next(root.glob("trajectory/**/*.parquet"))
    whole, before = file.read_bytes(), file.stat()
    try:
        file.write_bytes(whole[:400] + bytes(b ^ 0x41 for b in whole[400:420]) + whole[420:])
        with pytest.raises(rs.RoadscanError, match="content has changed"):
            survey.table("trajectory")
    finally:
        file.write_bytes(whole)
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert len(survey.table("trajectory"))


def test_sql_reaches_other_files_where_it_is_told_to(survey: rs.OpenSurvey) -> None:
    statement = f"SELECT count(*) FROM read_text('{survey.file}')"
    with pytest.raises(rs.RoadscanError, match="disabled by configuration"):
        survey.sql(statement)
    assert survey.sql(statement, unconfined=True).fetchall() == [(1,)]


def test_a_box_costs_what_it_holds(survey: rs.OpenSurvey) -> None:
    whole = survey.cells()
    assert survey.cells(bbox=(0.0, 0.0, 1e9, 1e9)).equals(whole)
    for box in ((5.0, 0.0, 3.0, 1.0), (np.nan, 0.0, 3.0, 1.0)):
        with pytest.raises(rs.RoadscanError, match="west, south, east, north"):
            survey.cells(bbox=box)


def test_cells_are_those_of_the_geotiff(survey: rs.OpenSurvey) -> None:
    path = survey.products["geotiff"].paths()[0]
    tile = Path(path).name.split(".")[0]
    cells = survey.cells(tile=tile)
    with rasterio.open(path) as file:
        heights = file.read(1, masked=True).filled(np.nan)
        west, north = file.bounds.left, file.bounds.top
    assert np.allclose(cells.height_m.to_numpy()[::-1], heights, atol=1e-3, equal_nan=True)
    assert cells.x[0] - 0.5 * cells.cell_m == pytest.approx(west)
    assert cells.y[-1] + 0.5 * cells.cell_m == pytest.approx(north)
    half = survey.cells(bbox=(west, north - 5.0, west + 5.0, north))
    assert half.sizes["x"] == pytest.approx(5.0 / cells.cell_m, abs=1)


def test_points_are_those_that_the_cells_were_made_of(survey: rs.OpenSurvey) -> None:
    tile = str(survey.table("tiles").sort_values("points").tile.iloc[-1])
    points, cells = survey.points(tile), survey.cells(tile=tile)
    assert len(points) == int(cells["count"].sum())
    assert points.height_m.min() >= float(cells.height_m.min()) - 0.2


def test_poses_are_those_of_the_truth(survey: rs.OpenSurvey) -> None:
    run = survey.runs[0]
    poses, known = (
        survey.trajectory(run),
        pq.read_table(truth.load(survey.file.parent).trajectory_file(run)).to_pandas(),
    )
    world = known[["x_world_m", "y_world_m", "z_world_m"]].to_numpy().T
    to_map = pyproj.Transformer.from_crs("EPSG:4978", survey.crs, always_xy=True)
    lon, lat, _ = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*world)
    level_from_world = Rotation.from_euler("ZY", np.stack([lon, -lat - 90.0], axis=-1), degrees=True).inv()
    body = level_from_world * Rotation.from_quat(known[["qx", "qy", "qz", "qw"]].to_numpy())
    heading, pitch, roll = np.unwrap(body.as_euler("ZYX"), axis=0).T
    since = (poses.index.to_numpy() - known.epoch_gps_ns[0]) * 1e-9
    epochs = (known.epoch_gps_ns.to_numpy() - known.epoch_gps_ns[0]) * 1e-9
    inside = (since >= 0.0) & (since <= epochs[-1])
    easting, northing, _ = to_map.transform(*world)
    for name, values, most in (
        ("easting_m", easting, 0.01),
        ("northing_m", northing, 0.01),
        ("roll_deg", np.degrees(roll), 0.05),
        ("pitch_deg", np.degrees(pitch), 0.05),
        ("heading_deg", np.degrees(heading), 0.05),
    ):
        apart = poses[name].to_numpy()[inside] - np.interp(since[inside], epochs, values)
        if name.endswith("deg"):
            apart = (apart + 180.0) % 360.0 - 180.0
        assert np.abs(apart).max() < most, name


def test_a_log_is_read_without_a_survey(recordings: Path) -> None:
    log = rs.read_log(recordings / "formats" / "two_points.sbet", crs="EPSG:4979", clock="gps_week_seconds,week=1500")
    assert log.format == "sbet"
    assert log["trajectory"].num_rows == 2
    with pytest.raises(KeyError, match="trajectory"):
        log["scans"]
    with pytest.raises(rs.RoadscanError, match="clock"):
        rs.read_log(recordings / "formats" / "two_points.sbet", crs="EPSG:4979")
