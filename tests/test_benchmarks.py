"""The benchmarks' surveys, and the work that they do by hand, are what they claim: roadscan finds the same."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio

import benchmarks
from benchmarks import bench_ingest, skilled_user, surveys
from benchmarks.by_hand import CELL_M, ByHand, from_store
from benchmarks.course import HOUR_UTC
from benchmarks.lidar_drive import PACKETS_PER_S, cut_capture, street
from benchmarks.pipeline import FROM_LOGS
from benchmarks.roofline import Roofline
from benchmarks.same_grid import difference_m, pdal_pipeline, with_numpy, with_roadscan, write_points
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.strict import load_toml
from roadscan.core.survey import Survey
from roadscan.ingest.reading.format import LogSource, format_named, log_formats
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate.surface import Surface
from roadscan.simulate.truth import Truth
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.tiles.cells import read_cells
from roadscan.tiles.tasks.tile_plan import TILE

PROFILES = 60


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> surveys.BenchSurvey:
    return surveys.pair(tmp_path_factory.mktemp("pair"), (PROFILES + 0.5) * surveys.LINE_SPACING_M)


@pytest.fixture(scope="module")
def store(pair: surveys.BenchSurvey) -> Store:
    make = {"products": {"make": ["las"], "options": {"las": {"scale_m": 1e-5, "compress": False}}}}
    survey = Survey.parse(load_toml(pair.file) | make, folder=pair.file.parent)
    store = Store(str(pair.file.parent / "store"), "bench")
    run_stages(Session(survey, store, Inline()))
    return store


@pytest.fixture(scope="module")
def done(pair: surveys.BenchSurvey, store: Store, tmp_path_factory: pytest.TempPathFactory) -> tuple[ByHand, Path]:
    out = tmp_path_factory.mktemp("by_hand")
    return from_store(Survey.load(pair.file), store, out), out


def cells_of_roadscan(store: Store) -> skilled_user.Cells:
    """All tiles' cells as the skilled user numbers them."""
    tiles = [read_cells(store, r, 2000) for r in Manifest(store).of(TILE).values() if r.path]
    column = np.concatenate([t.column + np.int64(2000 * t.tile.column) for t in tiles])
    row = np.concatenate([t.row + np.int64(2000 * t.tile.row) for t in tiles])
    order = np.lexsort((column, row))
    names = ("count", "height_mean_m", "height_robust_m", "intensity_mean")
    rest = [np.concatenate([getattr(t, name) for t in tiles])[order] for name in names]
    return skilled_user.Cells(column[order], row[order], *rest)


def test_the_pair_is_dense_as_at_line_rate(pair: surveys.BenchSurvey, store: Store) -> None:
    cells = cells_of_roadscan(store)
    assert pair.readings == PROFILES * 4000
    assert pair.readings / pair.recorded_s == pytest.approx(112e6)
    assert 0.99 * pair.readings < cells.count.sum() < pair.readings  # some are no returns
    assert np.percentile(cells.count, 60) == pytest.approx(25, abs=2)


def test_work_by_hand_gives_the_same_cells(store: Store, done: tuple[ByHand, Path]) -> None:
    ours, theirs = cells_of_roadscan(store), done[0].cells
    assert theirs is not None
    np.testing.assert_array_equal(ours.column, theirs.column)
    np.testing.assert_array_equal(ours.row, theirs.row)
    np.testing.assert_allclose(ours.height_robust_m, theirs.height_robust_m, atol=1e-4)
    # Poses differ by less than a micrometre: of readings rounded to 10 µm, few change their cell.
    assert np.mean(ours.count != theirs.count) < 0.01
    same = ours.count == theirs.count
    np.testing.assert_allclose(ours.intensity_mean[same], theirs.intensity_mean[same], atol=257.0)


def test_exported_points_give_the_same_cells(store: Store) -> None:
    files = [laspy.read(Path(store.path("tiles/las")) / f) for f in Path(store.path("tiles/las")).glob("*.las")]
    axes = [np.concatenate([np.asarray(f[a]) for f in files]) for a in ("x", "y", "z", "intensity")]
    ours = cells_of_roadscan(store)
    for packed in (True, False):
        theirs = skilled_user.to_cells(skilled_user.Points(*axes), CELL_M, packed)
        np.testing.assert_array_equal(ours.column, theirs.column)
        np.testing.assert_array_equal(ours.row, theirs.row)
        np.testing.assert_array_equal(ours.count, theirs.count)
        np.testing.assert_allclose(ours.height_robust_m, theirs.height_robust_m, atol=1e-7)
        np.testing.assert_allclose(ours.height_mean_m, theirs.height_mean_m, atol=1e-7)


def test_files_made_by_hand_hold_the_cells(done: tuple[ByHand, Path]) -> None:
    work, out = done
    assert work.cells is not None
    counts = 0
    for file in out.glob("*.tif"):
        with rasterio.open(file) as image:
            counts += np.nansum(image.read(3))
    assert counts == work.cells.count.sum()
    thinned = laspy.read(out / "thinned.laz")
    squares = np.unique(np.stack([work.cells.column // 20, work.cells.row // 20]), axis=1)
    assert len(thinned) == squares.shape[1]


def test_same_points_same_grid(tmp_path: Path) -> None:
    file = write_points(tmp_path / "a.las", 200_000)
    assert difference_m(with_roadscan(file), with_numpy(file, packed=True)) < 1e-6
    reader, writer = pdal_pipeline(file, tmp_path / "a.tif")
    with laspy.open(file) as las:
        corner = [float(str(writer[name])) for name in ("origin_x", "origin_y")]
        assert np.all(las.header.mins[:2] >= corner)
        assert np.all(las.header.maxs[:2] < np.add(corner, 500 * float(str(writer["resolution"]))))
    assert reader["filename"] == str(file)


def test_a_capture_is_cut_to_its_first_seconds(recordings: Path, tmp_path: Path) -> None:
    whole, file = recordings / "velodyne" / "hdl32e.pcap", tmp_path / "lidar.pcap"
    returns = cut_capture(whole, file, 0.1)
    first, every = epochs_of(file), epochs_of(whole)
    np.testing.assert_array_equal(first, every[:returns])
    assert np.ptp(first) == pytest.approx(0.1e9, abs=2e9 / PACKETS_PER_S)
    with pytest.raises(ValueError, match="too few for 60 s"):
        cut_capture(whole, file, 60.0)


def epochs_of(capture: Path) -> np.ndarray:
    log = format_named("velodyne_pcap")
    clock = Clock(TimeSystem.UTC_HOUR, date=np.datetime64("2026-02-09").item())
    source = LogSource(capture, log.options.parse({"hour": HOUR_UTC}), clock=clock)
    return np.concatenate([item.batch["epoch_gps_ns"] for item in log.read(source, log.header(source))])


def test_a_lidar_drives_through_one_street(tmp_path: Path) -> None:
    """Cells of the lane lie where the scene says, as well as the poses: what was seen again was still there."""
    drive, scene = surveys.hdl32e(tmp_path, 2.0), street(2.0)
    store = Store(str(tmp_path / "store"), "bench")
    wanted = [one for one in stages() if one.name in FROM_LOGS]
    run_stages(Session(Survey.load(drive.file), store, Inline()), wanted)
    assert epochs_of(drive.file.parent / "lidar.pcap").size == drive.readings
    tiles = [read_cells(store, r, 1000) for r in Manifest(store).of(TILE).values() if r.path]
    east = np.concatenate([(t.column + 1000.0 * t.tile.column + 0.5) * 0.05 for t in tiles])
    north = np.concatenate([(t.row + 1000.0 * t.tile.row + 0.5) * 0.05 for t in tiles])
    height, count = (np.concatenate([getattr(t, name) for t in tiles]) for name in ("height_robust_m", "count"))
    known = Truth(scene, Surface(scene), tmp_path)
    station, offset = known.station_offset_m(east, north)
    lane = (count >= 5) & (station > 0.0) & (station < 20.0) & (np.abs(offset - 1.6) < 1.5)
    away = height[lane] - known.height_m(east[lane], north[lane])
    assert lane.sum() > 1000
    assert np.percentile(np.abs(away), 90) < 0.1


def test_roofline() -> None:
    line = Roofline(bytes_per_reading=10, readings_per_s=1e9, bandwidth_bytes_per_s=40e9)
    assert line.limit_readings_per_s == 4e9
    assert line.fraction == 0.25


@pytest.mark.parametrize("name", sorted(m.name for m in pkgutil.iter_modules(benchmarks.__path__)))
def test_every_module_finds_what_it_imports(name: str) -> None:
    importlib.import_module(f"benchmarks.{name}")


def test_each_format_of_logs_has_a_benchmark_or_is_named_as_untimed() -> None:
    timed = {name.split(" ", 1)[0] for name in bench_ingest.makers()}
    assert timed | bench_ingest.UNTIMED == set(log_formats()) and not timed & bench_ingest.UNTIMED
