"""The KITTI drive: 6.3 million returns to LAS, GeoTIFF and hillshade, and how well its sweeps agree on the road."""

from __future__ import annotations

from pathlib import Path

import duckdb
import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
import road_cells
from las_points import read_points

from roadscan.core.survey import Survey
from roadscan.run.session import Session
from roadscan.survey.status import survey_status
from tests.real_data.conftest import Place

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drive(place: Place) -> road_cells.Drive:
    return road_cells.Drive(place.recordings / "kitti_drive", place.unpacked / "kitti_drive/velodyne_points/data")


@pytest.fixture(scope="module")
def points(place: Place, kitti: Path, drive: road_cells.Drive) -> pd.DataFrame:
    """All points of the written tiles, located and labelled by the recording's own poses and boxes."""
    return road_cells.label(road_cells.locate(read_points(place.products(kitti)), drive), drive)


def test_every_return_is_accounted_for(place: Place, kitti: Path, points: pd.DataFrame) -> None:
    recorded = sum(f.stat().st_size for f in place.unpacked.glob("kitti_drive/velodyne_points/data/*.bin")) // 16
    (lidar,) = (r for r in place.records(kitti) if r.sensor == "velodyne")
    assert lidar.rows + lidar.rejected == recorded == 6_317_433
    assert lidar.reject_reasons == {"0, 0, 0 is no return": 52}
    status = survey_status(Session(Survey.load(kitti), place.store(kitti)))
    assert status.is_complete
    assert sum(status.readings.values()) == lidar.rows
    assert status.readings["kept"] == len(points)
    # Half a turn before the first pose, half a turn behind the last: no pose is made up for them.
    assert status.readings["no_pose"] < 0.02 * recorded


def test_the_sweeps_agree_on_the_road(points: pd.DataFrame) -> None:
    """Published poses give 0.027 m (population) before any adjustment."""
    beside = road_cells.beside_car(points)
    road = road_cells.cell_spread(road_cells.cell_heights(points[road_cells.is_road(points)]))
    assert len(road) > 15_000
    assert road.sweeps.min() == 3
    assert road.std_m.median() <= 0.03
    assert road.std_population_m.median() <= 0.027
    any_height = road_cells.cell_spread(road_cells.cell_heights(points[beside & (points.box < 0)]))
    assert any_height.std_population_m.median() <= 0.03


def test_the_spread_is_the_poses_drift_in_height(points: pd.DataFrame) -> None:
    """One constant height a sweep, and the road agrees to 1 cm: neither mounting nor georeferencing blurs it."""
    heights = road_cells.cell_heights(points[road_cells.is_road(points)])
    drift = road_cells.height_drift(heights)
    assert drift.max() - drift.min() > 0.4
    cells = road_cells.cell_spread(heights.assign(z=heights.z - heights.frame.map(drift)))
    assert cells.std_m.median() < 0.011


def test_returns_in_labelled_boxes_are_counted(points: pd.DataFrame, drive: road_cells.Drive) -> None:
    raw = road_cells.recorded_in_boxes(drive)
    near = raw[(raw.frame % 15 == 0) & (raw.distance_m < 40)].returns
    assert round(100 * (near > 20).mean()) == 98
    assert near.median() == 334
    whole = drive.frames[1:-1]  # the first and the last sweep lack poses for half of their turn
    recorded = raw[raw.frame.isin(whole)].returns.sum()
    written = (points.frame.isin(whole) & (points.box >= 0)).sum()
    assert recorded > 150_000
    assert abs(written - recorded) < 0.001 * recorded
    beside = road_cells.beside_car(points)
    assert (beside & (points.box >= 0)).sum() > 0.05 * beside.sum()  # traffic really is where road is sought


def test_geotiff_counts_the_points_of_the_las(place: Place, kitti: Path) -> None:
    folder = place.products(kitti) / "tiles"
    las = laspy.read(folder / "las" / "2_1.laz")
    with rasterio.open(folder / "geotiff" / "2_1.tif") as raster:
        assert raster.bounds == (20, 10, 30, 20)
        assert raster.descriptions == ("height", "intensity", "count")
        height, _, count = raster.read()
    column, row = (np.floor(np.asarray(v) / 0.2).astype(int) for v in (las.x, las.y))
    expected = np.zeros((50, 50))
    np.add.at(expected, (99 - row, column - 100), 1)
    # A point on the edge of a cell is rounded to 0.1 mm in the LAS file, to 0.01 mm in the cells.
    assert np.abs(expected - np.nan_to_num(count)).sum() < 0.002 * len(las)
    assert np.nansum(count) == len(las) > 50_000
    assert np.nanmax(height) <= las.z.max() + 1e-4
    assert np.nanmin(height) >= las.z.min() - 1e-4


def test_products_of_the_whole_drive(place: Place, kitti: Path, points: pd.DataFrame) -> None:
    products = place.products(kitti) / "products"
    with (
        rasterio.open(products / "hillshade" / "hillshade.tif") as shade,
        rasterio.open(products / "mosaic" / "height.tif") as height,
    ):
        assert shade.bounds == height.bounds
        assert shade.crs == height.crs
        shades, heights = shade.read(1), height.read(1)
    assert np.array_equal(shades > 0, np.isfinite(heights))
    assert np.isfinite(heights).sum() > 100_000
    assert len(np.unique(shades)) > 200
    table = products / "tile_table" / "tiles.parquet"
    assert duckdb.sql(f"SELECT sum(points) FROM '{table}'").fetchall() == [(len(points),)]
