"""The orthophoto of a painted street: where the ends of dashes lie, against the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.judge_imagery import corner_shifts_m
from benchmarks.painted_objects import photographed_street
from roadscan.colours.ground import ground_of
from roadscan.core.grid import Bounds, TileId
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import simulate, truth
from roadscan.survey.run import run_stages
from roadscan.tiles.cells import TileCells


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Session:
    scene = photographed_street(
        7.0, camera={"every_m": 2.5, "width_px": 720, "height_px": 480, "focal_px": 640.0},
        vehicle={"standstill_s": 0.0}, lidar={"range_max_m": 15.0},
    )  # fmt: skip
    file = simulate(scene, tmp_path_factory.mktemp("photo") / "survey").survey_file
    with file.open("a") as stream:
        stream.write("\n[colours]\npoints = false\n[colours.orthophoto]\n")
    session = Session.open(file)
    run_stages(session, [stage_named(n) for n in ("ingest", "navigate", "footprints", "tiles", "colours")])
    assert not session.failures
    return session


@pytest.mark.slow
def test_painted_corners_lie_where_they_are(photographed: Session) -> None:
    photo = Path(photographed.store.path("products/orthophoto/orthophoto.vrt"))
    shifts = corner_shifts_m(photo, truth.load(photographed.survey.folder))
    away = np.hypot(*shifts.T)
    assert away.size >= 6
    assert np.median(away) <= 0.005
    assert np.mean(away <= 0.01) >= 0.8  # pixels of these small pictures are 1 to 3 cm long on the road


def test_ground_is_the_plane_under_cars_and_holes() -> None:
    """A tilted plane with noise, a car's roof and a hole: planes fitted around each place are the plane."""
    rng = np.random.default_rng(2)
    edge, cell = 200, 0.1
    column, row = (a.ravel() for a in np.meshgrid(np.arange(edge), np.arange(edge)))
    kept = ~((np.abs(column - 60) < 4) & (np.abs(row - 60) < 4)) & (rng.random(column.size) < 0.7)
    column, row = column[kept].astype(np.uint16), row[kept].astype(np.uint16)
    true = 400.0 + 0.03 * column * cell - 0.02 * row * cell
    height = true + 0.008 * rng.standard_normal(column.size)
    car = (np.abs(column.astype(int) - 120) < 20) & (np.abs(row.astype(int) - 120) < 9)
    height[car] += 1.4
    n = column.size
    nothing = np.zeros(n, np.float32)
    cells = TileCells(
        TileId(0, 0), edge, column, row, np.ones(n, np.uint32), height, height, height, height, nothing, nothing,
        np.ones(n, np.uint16), np.arange(n + 1, dtype=np.int32), np.ones(n, np.uint16),
    )  # fmt: skip
    ground = ground_of([(cells, Bounds(0.0, 0.0, 20.0, 20.0))], Bounds(4.0, 4.0, 16.0, 16.0), 0.25)
    assert ground is not None
    east, north = (a.ravel() for a in np.meshgrid(np.arange(4.0, 16.0, 0.05), np.arange(4.0, 16.0, 0.05)))
    found, normal = ground.at(east, north)
    off = found - (400.0 + 0.03 * (east - cell / 2) - 0.02 * (north - cell / 2))
    under = (np.abs(east - 12.05) < 1.0) & (np.abs(north - 12.05) < 0.2)
    assert np.nanmax(np.abs(off[under])) < 0.02  # its roof is no ground; that beside it goes on below
    assert np.isnan(off).mean() < 0.1
    assert np.nanpercentile(np.abs(off), 99) < 0.01
    assert np.abs(normal[~np.isnan(off)] - np.array([-0.03, 0.02, 1.0]) / np.sqrt(1.0013)).max() < 0.05


def test_nothing_to_see_is_no_ground() -> None:
    assert ground_of([], Bounds(0.0, 0.0, 10.0, 10.0), 0.25) is None
