"""The stage `surfaces`: the same surface in every tile that sees it, made once, and nearer to the truth than cells."""

from __future__ import annotations

import dataclasses
import json
import pickle
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
import shapely

from roadscan.core.errors import ConfigError
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute, Done, Inline
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stages
from roadscan.simulate import simulate
from roadscan.simulate.truth import load
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.surface.reconstruction import patch_of_cells, surface_of
from roadscan.surface.regions import FILLED, INTERPOLATED, MEASURED
from roadscan.surface.stage import plan_surface_work
from roadscan.surface.tasks.surface_plan import SURFACE, SurfacePlan, SurfaceTask, bridged_tiles
from roadscan.surface.tasks.surfaces import _Cells, source_of
from roadscan.surface.tile import EMPTY, SurfaceTile
from roadscan.survey.run import run_stages
from roadscan.survey.status import verify_store
from roadscan.tiles.tasks.tile_plan import TILE
from tests.surveys import Lines, Simulated, changed, outputs, small_scene

SURFACES = tuple(s for s in stages() if s.name == "surfaces")
CELLS: dict[str, object] = {"method": "cells", "sigma_m": 0.004}
POINTS: dict[str, object] = {"method": "points", "sigma_m": 0.006, "cell_m": (0.03, 0.04)}
POTHOLE = {"station_m": 3.9, "offset_m": 2.5, "radius_m": 0.3, "depth_m": 0.05}
MADE = {"make": ["surface", "surface_pictures"], "options": {}}


class TwoThreads:
    """Two tasks at the same time, each sent as bytes, as a cluster sends them."""

    workers = 2

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        def called(task: bytes) -> bytes:
            return pickle.dumps(function(pickle.loads(task)))

        with ThreadPoolExecutor(2) as pool:
            for task, result in zip(tasks, pool.map(called, map(pickle.dumps, tasks)), strict=True):
                yield Done(task, pickle.loads(result), None)


class Reconstructed:
    """A finished survey whose stage `surfaces` can be run again and again."""

    def __init__(self, simulated: Simulated, store: Store) -> None:
        self.simulated, self.store = simulated, store

    def survey(self, surface: dict[str, object] | None, products: dict[str, object] = MADE) -> Survey:
        return changed(Survey.load(self.simulated.survey_file), {"surface": surface, "products": products})

    def run(
        self, survey: Survey, compute: Compute | None = None, selection: Selection | None = None
    ) -> tuple[list[str], dict[str, bytes]]:
        """Tiles whose surface was made, and all files of surfaces."""
        before = Manifest(self.store).of(SURFACE)
        run = Session(survey, self.store, compute or Inline(), selection, Lines())
        run_stages(run, SURFACES)
        after = Manifest(self.store).of(SURFACE)
        files = {p: data for p, data in outputs(self.store).items() if p.startswith("tiles/surface")}
        return sorted(u for u in after if after[u] != before.get(u)), files

    def forget(self) -> None:
        manifest = Manifest(self.store)
        manifest.forget(SURFACE, list(manifest.of(SURFACE)))

    def plan(self, survey: Survey) -> SurfacePlan:
        planned = plan_surface_work(Session(survey, self.store)).planned
        assert planned is not None
        return planned

    @cache  # noqa: B019  as long as the module's tests
    def surfaces(self, **settings: object) -> dict[TileId, SurfaceTile]:
        """Surfaces of the six tiles with most cells, each made by a task of its own."""
        planned = self.plan(self.survey({k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}))
        held = {t: r.figures()["cells"] for t, r in planned.cells.items()}
        fullest = sorted(planned.keys, key=lambda t: -held.get(t, 0))[:6]
        return {t: s for task in planned.singly(fullest) for t, s in _surfaces(task)}


def _surfaces(task: SurfaceTask) -> Iterator[tuple[TileId, SurfaceTile]]:
    source = source_of(task)
    for tile in task.block.tiles:
        wanted = None if task.regions is None else task.regions.holds(task.grid.window(tile))
        yield tile, surface_of(tile, source.patch(tile, wanted), task.grid, wanted)


def assert_seamless(found: dict[TileId, SurfaceTile], least: int = 1000) -> None:
    """Where two tiles see the same cell, both hold the same bits of it."""
    shared = 0
    for a, b in combinations(found.values(), 2):
        cuts = [_cut(a, b), _cut(b, a)]
        if cuts[0] is None or cuts[1] is None:
            continue
        for name in ("raw_m", "height_m", "origin", "intensity"):
            one, other = getattr(a, name)[cuts[0]], getattr(b, name)[cuts[1]]
            assert one.tobytes() == other.tobytes(), (a.tile, b.tile, name)
        if a.lowest is not None and b.lowest is not None:
            for own, others in zip(
                *((part.drop_m, part.count) for part in (a.lowest.part(*cuts[0]), b.lowest.part(*cuts[1]))), strict=True
            ):
                assert own.tobytes() == others.tobytes()
        shared += int(np.count_nonzero(a.origin[cuts[0]]))
    assert shared > least


def _cut(a: SurfaceTile, b: SurfaceTile) -> tuple[slice, slice] | None:
    """Rows and columns of `a` that `b` holds as well."""
    spans = []
    for first, own, other, size in (
        (a.window.first_row, a.window.rows, b.window.first_row, b.window.rows),
        (a.window.first_column, a.window.columns, b.window.first_column, b.window.columns),
    ):
        low, high = max(first, other), min(first + own, other + size)
        if low >= high:
            return None
        spans.append(slice(low - first, high - first))
    return spans[0], spans[1]


@pytest.fixture(scope="module")
def cells(finished: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Reconstructed:
    """The small survey of profilers and lidar, its tiles made; of its own, because the stage writes into it."""
    root = tmp_path_factory.mktemp("cells")
    source = finished.store()
    shutil.copytree(source.url, root / "store")
    return Reconstructed(finished, Store(str(root / "store"), source.survey_id))


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Reconstructed:
    """A SICK's profiles over 14 m of road, its tiles made."""
    folder = tmp_path_factory.mktemp("points") / "survey"
    scene = small_scene(
        length_m=10.0, passes=[{"lane": 2, "speed_m_per_s": 4.0}], noise={"sick_range_m": 0.006},
        sick={"on": True}, profilers={"on": False}, lidar={"on": False},
        road={"potholes": [POTHOLE]},
    )  # fmt: skip
    simulated = Simulated(simulate(scene, folder).survey_file)
    simulated.run(segmentation={}, products={"make": [], "options": {}})
    return Reconstructed(simulated, simulated.store())


def test_cells_are_seamless_and_keep_to_their_tile(cells: Reconstructed) -> None:
    found = cells.surfaces(**CELLS)
    assert_seamless(found)
    one = found[max(found, key=lambda t: np.count_nonzero(found[t].origin[found[t].inner]))]
    assert one.height_m[one.inner].shape == (200, 200)
    assert one.halo * one.cell_m[0] >= 1.0
    assert (np.isnan(one.height_m) == (one.origin == EMPTY)).all()
    assert set(np.unique(one.origin)) == {EMPTY, MEASURED, FILLED}
    assert np.array_equal(np.isnan(one.raw_m), (one.origin == EMPTY) | (one.origin == FILLED))
    assert not np.isnan(one.intensity[one.origin == FILLED]).any()


def test_lowest_readings_are_those_of_the_cells(cells: Reconstructed) -> None:
    one = max(cells.surfaces(**CELLS).values(), key=lambda s: np.count_nonzero(s.origin[s.inner]))
    rows = pq.read_table(cells.store.path(f"tiles/cells/{one.tile}.parquet")).to_pandas()
    assert one.lowest is not None and len(rows) > 1000 and rows["count"].max() > 1
    own = one.lowest.part(*one.inner)
    at = rows["row"], rows["column"]
    np.testing.assert_allclose(own.drop_m[at], rows["height_robust_m"] - rows["height_min_m"], rtol=1e-6, atol=1e-9)
    assert (own.count[at] == rows["count"]).all()
    assert np.count_nonzero(~np.isnan(own.drop_m)) == np.count_nonzero(own.count) == len(rows)


def test_files_of_cells_without_lowest_readings_say_so(cells: Reconstructed) -> None:
    survey = cells.survey(CELLS)
    planned = cells.plan(survey)
    tile = next(iter(planned.cells))
    source = source_of(planned.task((tile,)))
    assert isinstance(source, _Cells)
    kept = source._read(tile)
    without = dataclasses.replace(kept, height_min_m=np.full(len(kept), np.nan))
    patch = patch_of_cells(planned.grid.window(tile), [without])
    assert patch.lowest is None and patch_of_cells(planned.grid.window(tile), [kept]).lowest is not None
    assert surface_of(tile, patch, planned.grid).lowest is None


@pytest.mark.slow
def test_workers_and_blocks_change_no_byte(cells: Reconstructed, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = cells.survey(CELLS)
    made, files = cells.run(survey)
    assert len(made) > 10 and len(files) == 2 * len(made)
    assert cells.run(survey) == ([], files)  # nothing is done twice
    record = next(iter(Manifest(cells.store).of(SURFACE).values()))
    figures = json.loads(record.detail)
    assert record.path == "" and figures["cells"] == sum(figures[k] for k in ("measured", "interpolated", "filled")) > 0
    assert figures["lowest_known"] == figures["measured"]
    cells.forget()
    monkeypatch.setattr("roadscan.surface.tasks.surface_plan._BLOCK_TILES", 1)
    monkeypatch.setattr("roadscan.surface.tasks.surfaces._CELLS_KEPT", 0)
    assert cells.run(survey, TwoThreads())[1] == files
    assert verify_store(cells.store) == []


def test_what_is_stale_is_made_again(cells: Reconstructed) -> None:
    survey = cells.survey(CELLS)
    _, files = cells.run(survey)
    manifest = Manifest(cells.store)
    changed_tile = next(iter(manifest.of(SURFACE)))
    tile = manifest.get("tile", changed_tile)
    assert tile is not None
    manifest.add([tile._replace(digest="another")])
    column, row = map(int, changed_tile.split("_"))
    around = {f"{column + c}_{row + r}" for c in (-1, 0, 1) for r in (-1, 0, 1)} & set(manifest.of(SURFACE))
    assert set(map(str, cells.plan(survey).stale(Manifest(cells.store)))) == around
    manifest.add([tile])
    one = TileId.parse(changed_tile)
    assert cells.run(survey, selection=Selection(named=(one,)))[1] == files
    cells.store.remove(f"tiles/surface/{changed_tile}.tif")
    assert [str(t) for t in cells.plan(survey).stale(Manifest(cells.store))] == [changed_tile]
    assert cells.run(survey)[1] == files
    fewer = cells.run(cells.survey(CELLS, {"make": ["surface"], "options": {}}))[1]
    assert sorted(fewer) == sorted(p for p in files if p.startswith("tiles/surface/"))
    assert cells.run(cells.survey(None, {"make": [], "options": {}})) == ([], {})


@pytest.mark.slow
def test_a_damaged_file_of_cells_costs_the_tiles_that_see_it(cells: Reconstructed) -> None:
    cells.forget()
    survey = cells.survey(CELLS, {"make": ["surface"], "options": {}})
    due = set(map(str, cells.plan(survey).keys))
    tile = str(next(iter(cells.plan(survey).keys)))
    record = Manifest(cells.store).of(TILE)[tile]
    path = Path(cells.store.path(record.path))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(Exception, match="surfaces"):
        cells.run(survey)
    column, row = map(int, tile.split("_"))
    lost = due - set(Manifest(cells.store).of(SURFACE))
    assert tile in lost and all(
        abs(int(u.split("_")[0]) - column) < 2 and abs(int(u.split("_")[1]) - row) < 2 for u in lost
    )
    work = plan_surface_work(Session(survey, cells.store))
    assert "run `roadscan tiles`" in work.note and not lost & set(map(str, work.chosen))
    path.write_bytes(content)
    Manifest(cells.store).add([record])  # as the tiles stage makes it again
    assert set(cells.run(survey)[0]) == lost


@pytest.mark.slow
def test_surfaces_wait_for_cells_of_the_survey_as_it_is(cells: Reconstructed) -> None:
    survey = cells.survey(CELLS)
    _, files = cells.run(survey)
    coarser = changed(survey, {"tiles__cell_m": 2 * survey.config.tiles.cell_m})
    work = plan_surface_work(Session(coarser, cells.store))
    assert "run `roadscan tiles`" in work.note and work.planned is not None
    assert set(map(str, work.planned.waiting)) >= set(Manifest(cells.store).of(SURFACE))
    assert cells.run(coarser) == ([], files)  # cells of the other grid are not taken for those of this one


def test_a_tile_that_failed_keeps_its_surface(cells: Reconstructed) -> None:
    survey = cells.survey(CELLS)
    _, files = cells.run(survey)
    manifest = Manifest(cells.store)
    unit = next(iter(manifest.of(SURFACE)))
    record = manifest.get("tile", unit)
    assert record is not None
    manifest.forget("tile", [unit])
    assert cells.run(survey) == ([], files)
    manifest.add([record])
    assert cells.run(survey) == ([], files)


def test_smoothed_cells_are_nearer_to_the_truth(cells: Reconstructed) -> None:
    truth = load(cells.simulated.survey_file.parent)
    raw, smooth = _errors(cells.surfaces(**CELLS), truth)
    assert np.sqrt(np.mean(smooth**2)) < 0.75 * np.sqrt(np.mean(raw**2))


@pytest.mark.slow
def test_points_are_seamless_and_nearer_to_the_truth(points: Reconstructed) -> None:
    found = points.surfaces(**POINTS)
    assert_seamless(found)
    assert {EMPTY, MEASURED, INTERPOLATED} <= set(np.unique(np.concatenate([s.origin.ravel() for s in found.values()])))
    raw, smooth = _errors(found, load(points.simulated.survey_file.parent))
    assert np.sqrt(np.mean(smooth**2)) < 0.8 * np.sqrt(np.mean(raw**2))


def _errors(found: dict[TileId, SurfaceTile], truth: object) -> tuple[np.ndarray, np.ndarray]:
    """Raw and smoothed heights less the truth (m), on the carriageway, of all tiles' own cells."""
    parts = []
    for one in found.values():
        easting, northing = np.meshgrid(*one.window.nodes_m())
        station, offset = truth.station_offset_m(easting, northing)
        own = np.zeros(one.origin.shape, bool)
        own[one.inner] = True
        own &= (one.origin != EMPTY) & (np.abs(offset) < 3.2) & (station > 1.0) & (station < truth.scene.length_m - 1.0)
        true_m = truth.height_m(easting[own], northing[own])
        parts.append(np.stack([one.raw_m[own] - true_m, one.height_m[own] - true_m]))
    raw, smooth = np.concatenate(parts, axis=1)
    usual = np.abs(raw) < 0.05  # cells of things that stand on the road are no error of its surface
    assert usual.sum() > 1000
    return raw[usual], smooth[usual]


@pytest.mark.slow
def test_blocks_of_points_change_no_bit(points: Reconstructed) -> None:
    singly = points.surfaces(**POINTS)
    pair = sorted(singly, key=lambda t: -np.count_nonzero(singly[t].origin))[:2]
    together = dict(_surfaces(points.plan(points.survey(POINTS)).task(tuple(pair))))
    for tile in pair:
        for name in ("raw_m", "height_m", "origin", "intensity"):
            assert getattr(together[tile], name).tobytes() == getattr(singly[tile], name).tobytes()


@pytest.mark.slow
def test_polygons_bound_the_surface(points: Reconstructed, tmp_path: Path) -> None:
    whole = points.surfaces(**POINTS)
    tile, seen = max(whole.items(), key=lambda one: np.count_nonzero(one[1].origin[one[1].inner]))
    box = points.plan(points.survey(POINTS)).grid.tiles.bounds(tile)
    ring = shapely.Point(box.easting_min_m + 5.0, box.northing_min_m + 5.0).buffer(2.5)
    layer = tmp_path / "regions.gpkg"
    geopandas.GeoDataFrame(geometry=[ring], crs=Survey.load(points.simulated.survey_file).config.map.crs).to_file(layer)
    survey = points.survey({**POINTS, "regions": "polygons", "polygons": str(layer)})
    found = dict(_surfaces(points.plan(survey).singly(list(points.plan(survey).keys))[0]))
    assert list(found) == list(points.plan(survey).keys) == [tile]
    east, north = np.meshgrid(*seen.window.nodes_m())
    inside = shapely.contains_xy(ring, east, north)
    assert np.array_equal(found[tile].height_m, np.where(inside, seen.height_m, np.nan), equal_nan=True)
    assert inside.sum() > 100 and (found[tile].origin[~inside] == EMPTY).all()
    made, files = points.run(survey)
    assert made == [str(tile)] and {Path(p).stem for p in files} == {str(tile)}
    with rasterio.open(points.store.path(f"tiles/surface/{tile}.tif")) as raster:
        assert np.isfinite(raster.read(1)).sum() == np.count_nonzero(found[tile].origin[found[tile].inner])


UNSMOOTHED: dict[str, object] = {**POINTS, "smooth": False, "max_gap_m": 0.15}
FOUND: dict[str, object] = {**UNSMOOTHED, "regions": "found"}


@pytest.mark.slow
def test_found_regions_bound_the_surface(points: Reconstructed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadscan.surface.tasks.found_regions._LONGEST_S", 1)  # several pieces of the drive
    survey = points.survey(FOUND, {"make": ["surface"], "options": {}})
    before = points.plan(survey)
    assert before.waiting and not before.keys  # nobody looked for regions yet
    _, files = points.run(survey)
    rows = query(points.store, "SELECT * FROM regions").to_pylist()
    truth = load(points.simulated.survey_file.parent)
    shapes = shapely.from_wkb([row["outline"] for row in rows])
    on_road = shapely.transform(shapes, lambda xy: np.stack(truth.station_offset_m(*xy.T), axis=-1))
    assert shapely.contains_xy(shapely.union_all(on_road), POTHOLE["station_m"], POTHOLE["offset_m"])
    assert all(row["roughness_m"] > 0.0015 and row["area_m2"] > 0.3 for row in rows)
    told = shapely.contains_xy(on_road, POTHOLE["station_m"], POTHOLE["offset_m"])
    assert told.sum() <= 2  # all pieces see it in their margins: those tell of it whose span it lies in
    planned = points.plan(survey)
    found = dict(_surfaces(planned.task(tuple(planned.keys))))
    assert_seamless(found, 100)
    tile = max(found, key=lambda t: np.count_nonzero(found[t].origin))
    everywhere = points.plan(points.survey(UNSMOOTHED)).task((tile,))
    ((_, whole),) = _surfaces(everywhere)
    inside = shapely.contains_xy(shapely.union_all(shapes), *np.meshgrid(*whole.window.nodes_m()))
    assert np.array_equal(found[tile].height_m, np.where(inside, whole.height_m, np.nan), equal_nan=True)

    tables = {p: points.store.read_bytes(p) for p in points.store.files("tables/regions")}
    manifest = Manifest(points.store)
    pieces = list(manifest.of("regions"))
    assert len(pieces) > 3
    manifest.forget("regions", pieces)
    points.forget()
    monkeypatch.setattr("roadscan.surface.tasks.found_regions._CHUNK_ROWS", 7)
    assert points.run(survey, TwoThreads())[1] == files  # neither workers nor chunks matter
    assert {p: points.store.read_bytes(p) for p in points.store.files("tables/regions")} == tables
    assert points.run(survey) == ([], files)
    assert verify_store(points.store) == []
    assert points.run(points.survey(None, {"make": [], "options": {}})) == ([], {})
    assert not points.store.files("tables/regions")


@pytest.mark.slow
def test_workers_change_no_byte_of_a_pothole_on_the_border_of_tiles(points: Reconstructed, tmp_path: Path) -> None:
    scene = load(points.simulated.survey_file.parent).scene
    place, azimuth = scene.map, np.radians(scene.map.azimuth_deg)
    station, offset = POTHOLE["station_m"], POTHOLE["offset_m"]  # on the border of two tiles
    east = place.easting_m + station * np.sin(azimuth) + offset * np.cos(azimuth)
    north = place.northing_m + station * np.cos(azimuth) - offset * np.sin(azimuth)
    layer = tmp_path / "hole.gpkg"
    geopandas.GeoDataFrame(geometry=[shapely.Point(east, north).buffer(0.9)], crs=place.crs).to_file(layer)
    finely = {**UNSMOOTHED, "cell_m": [0.007, 0.007], "regions": "polygons", "polygons": str(layer)}
    options = {"crack_pieces": {"max_width_m": 0.018, "spur_m": 0.0}}
    survey = points.survey(finely, {"make": ["cracks", "potholes"], "options": options})
    chosen = [s for s in stages() if s.name in ("surfaces", "products")]
    made = []
    for compute in (Inline(), TwoThreads()):
        points.forget()
        manifest = Manifest(points.store)
        for name in ("cracks", "potholes"):
            manifest.forget(name, list(manifest.of(name)))
        run_stages(Session(survey, points.store, compute, None, Lines()), chosen)
        made.append({p: b for p, b in outputs(points.store).items() if "pieces" in p or p.startswith("products/")})
    assert made[0] == made[1] and len(made[0]) > 4
    (hole,) = query(points.store, "SELECT * FROM potholes").to_pylist()
    assert np.hypot(hole["easting_m"] - east, hole["northing_m"] - north) < 0.1
    assert len(hole["tiles"].split()) == 2


def test_polygons_beside_the_survey_are_an_error(points: Reconstructed, tmp_path: Path) -> None:
    box = points.plan(points.survey(POINTS)).grid.tiles.bounds(next(iter(points.plan(points.survey(POINTS)).keys)))
    swapped = shapely.Point(box.northing_min_m, box.easting_min_m).buffer(2.5)
    crs = Survey.load(points.simulated.survey_file).config.map.crs
    layer = tmp_path / "swapped.gpkg"
    geopandas.GeoDataFrame(geometry=[swapped, None], crs=crs).to_file(layer)
    survey = points.survey({**POINTS, "regions": "polygons", "polygons": str(layer)})
    with pytest.raises(ConfigError, match="touch no tile"):
        points.run(survey)
    geopandas.GeoDataFrame(geometry=[None], crs=crs).to_file(tmp_path / "nothing.gpkg")
    with pytest.raises(ConfigError, match="no polygon"):
        points.run(points.survey({**POINTS, "regions": "polygons", "polygons": str(tmp_path / "nothing.gpkg")}))


@pytest.mark.slow
def test_a_tile_without_a_reading_has_the_surface_that_reaches_into_it(points: Reconstructed) -> None:
    survey = points.survey(POINTS)
    planned = points.plan(survey)
    tile = next(t for t in planned.keys if t in bridged_tiles(set(planned.cells) - {t}))
    expected = dict(_surfaces(planned.task((tile,))))[tile]
    manifest = Manifest(points.store)
    record = manifest.get("tile", str(tile))
    assert record is not None
    manifest.add([record._replace(path="", bytes=0)])  # as if all its readings had been left out
    without = points.plan(survey)
    found = dict(_surfaces(without.task((tile,))))[tile]
    assert tile not in without.cells and found.height_m.tobytes() == expected.height_m.tobytes()
    manifest.add([record])


def test_bridged_tiles_lie_between_two_sides() -> None:
    stairs = {TileId(0, 0), TileId(1, 0), TileId(1, 1), TileId(2, 1)}
    assert bridged_tiles(stairs) == {TileId(0, 1), TileId(2, 0)}
    assert bridged_tiles({TileId(c, 5) for c in range(4)}) == set()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "points", "sigma_m": 0.001, "max_gap_m": 9.0}, "bridges more than half a tile"),
        ({"method": "cells", "sigma_m": 0.001, "smoothing": {"curvature_weight": 10_000}}, "smoothing depends on"),
    ],
)
def test_settings_that_do_not_fit_the_tiles_stop_a_run_before_them(
    cells: Reconstructed, settings: dict[str, object], message: str
) -> None:
    run = Session(cells.survey(settings), cells.store, Inline(), None, Lines())
    with pytest.raises(ConfigError, match=message):
        run_stages(run, [s for s in stages() if s.name == "tiles"])


def test_cells_too_coarse_for_cracks_stop_a_run_before_them(cells: Reconstructed) -> None:
    survey = cells.survey(CELLS, {"make": ["surface", "cracks"], "options": {}})
    run = Session(survey, cells.store, Inline(), None, Lines())
    with pytest.raises(ConfigError, match=r"'crack_pieces' got cells of 0\.05 × 0\.05 m"):
        run_stages(run, [s for s in stages() if s.name == "tiles"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "cells", "sigma_m": 0.001, "cell_m": [0.01, 0.03]}, "cell_m is a setting of method"),
        ({"method": "cells", "sigma_m": 0.001, "smoothing": {"sigma_m": 0.0005}}, "smoothing.sigma_m"),
        ({"method": "points", "sigma_m": 0.001, "smooth": False, "smoothing": {"detail_sigmas": 5}}, "smooth = false"),
        ({"method": "points", "sigma_m": 0.001, "regions": "polygons"}, "belong together"),
        ({"method": "points", "sigma_m": 0.001, "search": {"factor": 3.0}}, "is not asked for"),
        ({"method": "points", "sigma_m": 0.001, "cell_m": [0.01, 3.0]}, "edges from"),
        ({"method": "cells"}, "sigma_m"),
        ({"method": "cell", "sigma_m": 0.001}, "method"),
    ],
)
def test_settings_that_do_not_fit(cells: Reconstructed, settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        cells.survey(settings)


def test_a_product_of_the_surface_needs_one(cells: Reconstructed) -> None:
    run = Session(cells.survey(None, {"make": ["surface_mesh"], "options": {}}), cells.store, Inline(), None, Lines())
    with pytest.raises(ConfigError, match=r"add the section \[surface\]"):
        run_stages(run, [s for s in stages() if s.name == "tiles"])
