"""The stage `assets` on a simulated street with posts: objects beside the truth, keys, and what is said of settings."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
import shapely
from scipy.spatial import cKDTree

import roadscan
from roadscan.assets.classes import GROUND, POLE, ROAD
from roadscan.assets.kind import Evidence
from roadscan.assets.scene import Scene
from roadscan.assets.stage import Assets
from roadscan.assets.tasks.evidence import EVIDENCE
from roadscan.assets.tasks.objects import OBJECTS
from roadscan.assets.tasks.work import MADE, due_joins, plan_evidence
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.grid import TileId
from roadscan.georeference.plan.plan import plan_of
from roadscan.inventory.of_survey import truth_of
from roadscan.report.blocks import Drawing, Picture, Table
from roadscan.report.page import report_page
from roadscan.report.section import Material
from roadscan.report.sections.assets import Assets as AssetsSection
from roadscan.run.engine.compute import Done, Inline
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene as Street
from roadscan.simulate import simulate
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.assets.posts import Posts, only_kinds
from tests.surveys import Lines, Simulated, changed

SETTINGS = {"tile_m": 5.0, "cross_sections": {"spacing_m": 4.0, "half_width_m": 4.0}}
STAGES = ("ingest", "navigate", "footprints", "assets")


def session(street: Simulated, name: str = "store", selection: Selection | None = None, **assets: object) -> Session:
    survey = changed(
        roadscan.open_survey(street.survey_file).survey, {"assets": {**SETTINGS, **assets}, "tiles__size_m": 5.0}
    )
    return Session(survey, Store(str(street.survey_file.parent / name), survey.config.id), Inline(), selection, Lines())


def run(of: Session, stages: Sequence[str] = STAGES) -> Session:
    run_stages(of, [stage_named(name) for name in stages])
    return of


@pytest.fixture(scope="module")
def registry() -> Iterator[None]:
    with only_kinds(Posts):
        yield


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory, registry: None) -> Simulated:
    """12 m of a street with a post at its begin, one at its end and one on the other side, run once."""
    post = {"height_m": 2.6, "diameter_m": 0.2}
    scene = Street.load("demo").changed(
        length_m=12.0, passes=[{"lane": 2, "direction": "forward"}], profilers={"on": False},
        lidar={"range_max_m": 8.0}, vehicle={"speed_m_per_s": 16.0},
        roadside={"poles": [{"station_m": -1.0, "offset_m": 5.0, "every_m": 14.0, "count": 2, **post},
                            {"station_m": 6.0, "offset_m": -4.6, **post}]},
    )  # fmt: skip
    made = Simulated(simulate(scene, tmp_path_factory.mktemp("street") / "survey").survey_file)
    run(session(made))
    return made


def files(of: Session) -> dict[str, bytes]:
    """All that the stage made."""
    folders = stage_named("assets").folders()
    return {path: of.store.read_bytes(path) for folder in folders for path in of.store.files(folder)}


def again(street: Simulated, folder: Path, **assets: object) -> Session:
    """A session on a copy of the street and its store."""
    copy = folder / "survey"
    shutil.copytree(street.survey_file.parent, copy)
    return session(Simulated(copy / street.survey_file.name), **assets)


def true_posts(street: Simulated) -> pd.DataFrame:
    return pd.read_parquet(street.survey_file.parent / "truth" / "objects.parquet")


@pytest.mark.slow
def test_the_inventory_learns_which_places_the_pass_had_in_sight(street: Simulated) -> None:
    own = session(street)
    sight = truth_of(own).rules.visibility
    true = true_posts(street)[["easting_m", "northing_m", "height_m"]].to_numpy(float)
    assert sight.expected_passes("pole", true).tolist() == [1, 1, 1]
    assert sight.expected_passes("pole", true + np.array([0.0, 40.0, 0.0])).tolist() == [0, 0, 0]
    cells = query(own.store, "SELECT max(passes_low) AS most FROM asset_visibility")
    assert cells.to_pylist() == [{"most": 1}]
    unasked = Session(changed(own.survey, {"assets": None}), own.store)
    assert truth_of(unasked).rules.visibility.expected_passes("pole", true).tolist() == [-1, -1, -1]


@pytest.mark.slow
@pytest.mark.parametrize("tile_m", [10.0, 15.0, 60.0])
def test_objects_and_classes_are_the_same_for_any_cut(street: Simulated, tile_m: float, tmp_path: Path) -> None:
    own, other = session(street), run(again(street, tmp_path, tile_m=tile_m), ["assets"])
    posts = [geopandas.read_parquet(one.store.path("products/assets/poles.parquet")) for one in (own, other)]
    assert len(posts[0]) == len(posts[1]) == 3
    assert shapely.distance(posts[0].geometry.values, posts[1].geometry.values).max() <= 1e-3
    classes = [classified(one) for one in (own, other)]
    np.testing.assert_array_equal(classes[0][:, :3], classes[1][:, :3])
    assert np.mean(classes[0][:, 3] != classes[1][:, 3]) <= 1e-4


def classified(of: Session) -> np.ndarray:
    """Place (mm) and class of all returns, sorted."""
    read = [laspy.read(of.store.path(path)) for path in of.store.files("products/classified_points")]
    rows = [np.column_stack([*(np.rint(1e3 * np.asarray(v)) for v in (r.x, r.y, r.z)), r.classification]) for r in read]
    joined = np.concatenate(rows).astype(np.int64)
    return joined[np.lexsort(joined.T[::-1])]


@pytest.mark.slow
def test_posts_stand_where_the_truth_has_them(street: Simulated) -> None:
    own = session(street)
    found = geopandas.read_parquet(own.store.path("products/assets/poles.parquet"))
    true = true_posts(street)
    assert len(found) == len(true) == 3
    away = np.hypot(
        found["easting_m"].to_numpy()[:, None] - true["easting_m"].to_numpy(),
        found["northing_m"].to_numpy()[:, None] - true["northing_m"].to_numpy(),
    )
    assert sorted(away.argmin(axis=1).tolist()) == [0, 1, 2]
    assert away.min(axis=1).max() <= 0.15  # the side that was seen, of posts of 20 cm
    beside = true["height_m"].to_numpy()[away.argmin(axis=1)]
    assert found["height_m"].to_numpy() == pytest.approx(beside, abs=0.15)
    assert found.geometry.get_coordinates(include_z=True).to_numpy() == pytest.approx(
        found[["easting_m", "northing_m", "height_m"]].to_numpy()
    )
    assert found["asset_height_m"].to_numpy() == pytest.approx(2.6, abs=0.25)
    assert found["road"].dropna().unique().tolist() == ["road1"]
    middle = found.loc[found["station_m"].idxmin() :].dropna(subset=["station_m"])
    assert (np.diff(found["station_m"].dropna()) > 0).all() and len(middle)
    known = found.dropna(subset=["station_m"])
    side = np.sign(true["offset_m"].to_numpy()[away.argmin(axis=1)][known.index])
    assert (np.sign(known["offset_m"]) == side).all()
    assert found["object"].is_unique
    assert found["pictures"].isna().all()


@pytest.mark.slow
def test_every_file_holds_the_same_posts(street: Simulated) -> None:
    own = session(street)
    folder = Path(own.store.path("products/assets"))
    table = geopandas.read_parquet(folder / "poles.parquet")
    layer = geopandas.read_file(folder / "assets.gpkg", layer="poles")
    assert layer.crs == table.crs
    assert layer["object"].tolist() == table["object"].tolist()
    assert layer.geometry.geom_equals_exact(table.geometry, 1e-9).all()
    degrees = geopandas.read_file(folder / "poles.geojson")
    assert degrees.crs.name == "WGS 84"
    back = degrees.set_crs(4326, allow_override=True).to_crs(table.crs)
    assert back.geometry.distance(table.geometry).max() < 1e-3
    drawing = pyogrio.read_dataframe(folder / "assets.dxf")
    assert drawing["Layer"].tolist() == ["poles"] * 3
    assert drawing.geometry.get_coordinates(include_z=True).to_numpy() == pytest.approx(
        table.geometry.get_coordinates(include_z=True).to_numpy(), abs=1e-6
    )
    with sqlite3.connect(folder / "assets.gpkg") as file:
        assert file.execute("SELECT last_change FROM gpkg_contents").fetchall() == [("2000-01-01T00:00:00.000Z",)]
    asked = query(own.store, "SELECT object, asset_height_m FROM poles ORDER BY station_m NULLS LAST")
    assert sorted(asked["object"].to_pylist()) == sorted(table["object"])


@pytest.mark.slow
def test_points_have_classes_and_files_say_what_these_are(street: Simulated) -> None:
    own = session(street)
    codes: dict[int, int] = {}
    for path in own.store.files("products/classified_points"):
        with laspy.open(own.store.path(path)) as reader:
            points = reader.read()
            names = next(v for v in reader.header.vlrs if v.user_id == "LASF_Spec" and v.record_id == 0)
        assert names.lookups[POLE] == "pole"
        assert names.lookups[69] == "vehicle"
        for code, count in zip(*np.unique(points.classification, return_counts=True), strict=True):
            codes[int(code)] = codes.get(int(code), 0) + int(count)
    loaded = query(own.store, "SELECT count(*) AS n FROM returns")
    assert codes[GROUND] + codes[ROAD] > 20_000
    posts = geopandas.read_parquet(own.store.path("products/assets/poles.parquet"))
    assert 0.5 * posts["returns"].sum() <= codes[POLE] <= posts["returns"].sum()
    assert sum(codes.values()) == loaded["n"][0].as_py()


@pytest.mark.slow
def test_bare_earth_is_the_ground_and_has_holes(street: Simulated) -> None:
    own = session(street)
    largest = max(own.store.files("products/classified_points"), key=own.store.size)
    with laspy.open(own.store.path(largest)) as reader:
        points = reader.read()
    ground = np.isin(points.classification, (GROUND, ROAD))
    with rasterio.open(
        own.store.path(largest.replace("classified_points", "bare_earth").replace(".laz", ".tif"))
    ) as raster:
        seen, bridged, sigma = raster.read()
        assert raster.descriptions == ("bare earth, seen", "bare earth, holes bridged", "bare earth, 1 sigma")
        assert raster.bounds == pytest.approx([*np.floor(raster.bounds[:2]), *np.floor(raster.bounds[:2]) + 5.0])
        place = rasterio.transform.rowcol(raster.transform, points.x[ground], points.y[ground])
    rows, columns = np.clip(place, 0, 19)  # coordinates are rounded to 1 mm, to the border at the most
    above = np.asarray(points.z[ground]) - bridged[rows, columns]
    assert np.nanpercentile(np.abs(above), 90) <= 0.03
    assert not np.isnan(bridged[rows, columns]).any()
    assert (seen == bridged)[~np.isnan(seen)].all()
    assert 0.0 < np.nanmedian(sigma) < 0.05
    holes = 0
    for path in own.store.files("products/bare_earth"):
        with rasterio.open(own.store.path(path)) as raster:
            seen, bridged, sigma = raster.read()
        assert not (np.isnan(bridged) & ~np.isnan(seen)).any()
        holes += np.count_nonzero(np.isnan(seen) & ~np.isnan(bridged))
    assert holes > 0


@pytest.mark.slow
def test_cross_sections_cross_the_road_on_bare_earth(street: Simulated) -> None:
    own = session(street)
    rows = pd.read_csv(own.store.path("products/ground_sections/road1.csv"))
    assert (rows["station_m"] % 4.0 == 0.0).all() and rows["station_m"].nunique() >= 5
    assert rows["offset_m"].abs().max() <= 4.0
    drawn = pyogrio.read_dataframe(own.store.path("products/ground_sections/road1.dxf"))
    assert drawn["Layer"].unique().tolist() == ["ground_sections"]
    lines = shapely.get_coordinates(drawn.geometry.to_numpy(), include_z=True)
    assert len(lines) == pytest.approx(len(rows), abs=5)
    assert lines[:, 2].min() == pytest.approx(rows["height_m"].min(), abs=1e-3)
    trees = []
    for path in own.store.files("products/classified_points"):
        with laspy.open(own.store.path(path)) as reader:
            points = reader.read()
        trees.append(points.xyz[np.isin(points.classification, (GROUND, ROAD))])
    ground = np.concatenate(trees)
    away, near = cKDTree(ground[:, :2]).query(rows[["easting_m", "northing_m"]].to_numpy())
    close = (away < 0.05) & (rows["seen"].to_numpy() == 1)
    assert close.sum() > 100
    error = rows["height_m"].to_numpy()[close] - ground[near[close], 2]
    assert np.percentile(np.abs(error), 90) <= 0.04  # a return errs by 15 mm
    assert 0.0 < rows["sigma_height_m"].median() < 0.05


@pytest.mark.slow
def test_cross_sections_that_are_asked_for_later_are_due(street: Simulated) -> None:
    own = session(street)
    assert Assets().state(own).stale == 0
    assert Assets().state(session(street, cross_sections={"spacing_m": 2.0, "half_width_m": 4.0})).stale == 2


class Backwards(Inline):
    """Tasks from last to first."""

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        return super().map(function, list(tasks)[::-1])


@pytest.mark.slow
def test_blocks_and_their_order_change_no_byte(street: Simulated, tmp_path: Path) -> None:
    whole = files(session(street))
    other = again(street, tmp_path, max_block_returns=1)
    other.manifest.remove([r for r in other.manifest.all() if r.product in MADE])
    assert not files(other)
    other.compute = Backwards()
    run(other, ("assets",))
    assert files(other) == whole


@pytest.mark.slow
def test_a_second_run_does_nothing(street: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    own = session(street)
    assert Assets().state(own).stale == 0
    monkeypatch.setattr(Posts, "evidence", None)
    monkeypatch.setattr(Posts, "objects", None)
    run(own, ("assets",))


@pytest.mark.slow
def test_reprocessing_a_tile_redoes_what_it_touches(
    street: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = again(street, tmp_path)
    before = files(own)
    post = true_posts(street).iloc[0]
    tile = plan_of(own).ground.grid.tile_at(post["easting_m"], post["northing_m"])
    searched: list[tuple[float, float]] = []
    evidence = Posts.evidence

    def watched(self: Posts, scene: Scene, options: Any) -> Evidence:
        east, north = scene.returns.corner_m
        searched.append((east + scene.tile.x_min_m, north + scene.tile.y_min_m))
        return evidence(self, scene, options)

    monkeypatch.setattr(Posts, "evidence", watched)
    monkeypatch.setattr(Posts, "objects", None)  # the evidence is what it was, so nothing is joined
    own.selection = Selection((tile,))
    run(own, ("assets",))
    assert searched == [(tile.column * 5.0, tile.row * 5.0)]
    assert files(own) == before


@pytest.mark.slow
def test_changed_evidence_joins_the_objects_near_it_and_no_other(street: Simulated, tmp_path: Path) -> None:
    own = again(street, tmp_path)
    manifest, post = own.manifest, true_posts(street).iloc[0]
    tile = plan_of(own).ground.grid.tile_at(post["easting_m"], post["northing_m"])
    near = {f"pole/{TileId(tile.column + c, tile.row + r)}" for c in (-1, 0, 1) for r in (-1, 0, 1)}
    held = next(r for unit, r in manifest.of(EVIDENCE).items() if r.path and unit in near)
    assert len(manifest.of(OBJECTS)) == 3
    manifest.add([held._replace(digest="0" * 32)])
    work = plan_evidence(own)
    assert work.plan is not None
    assert [task.pieces for task in due_joins(work.plan, manifest)] == [(held._replace(digest="0" * 32),)]


@pytest.mark.slow
def test_a_run_that_is_stopped_before_the_join_goes_on(
    street: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = files(session(street))
    own = again(street, tmp_path)
    own.manifest.remove([r for r in own.manifest.all() if r.product in ("assets", OBJECTS, EVIDENCE)])
    with monkeypatch.context() as patch:
        patch.setattr(Assets, "_join", lambda *_: pytest.fail("stopped"))
        with pytest.raises(pytest.fail.Exception):
            run(own, ("assets",))
    other = again(Simulated(own.survey.folder / "SURVEY.toml"), tmp_path / "next")
    monkeypatch.setattr(Posts, "evidence", None)  # all evidence is there
    run(other, ("assets",))
    assert files(other) == whole


class Broken(Posts):
    """Posts that nobody can find."""

    name = "wall"

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        raise RuntimeError("no such luck")


@pytest.mark.slow
def test_a_kind_at_fault_costs_no_other(street: Simulated, tmp_path: Path) -> None:
    whole = files(session(street))
    with only_kinds(Posts, Broken):
        own = again(street, tmp_path, classified=False)
        with pytest.raises(RunError, match="no such luck"):
            run(own, ("assets",))
        assert {unit.partition("/")[0] for _, unit, _ in own.failures} == {"wall"}
    poles = "products/assets/poles.parquet"
    assert files(own)[poles] == whole[poles]


@pytest.mark.slow
def test_without_the_section_nothing_stays(street: Simulated, tmp_path: Path) -> None:
    own = again(street, tmp_path)
    own.survey = changed(own.survey, {"assets": None})
    run(own, ("assets",))
    assert not files(own)
    assert Assets().state(own).stale == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"kinds": ["pol"]}, r"unknown kind 'pol' \(did you mean 'pole'"),
        ({"options": {"pole": {"least_heigt_m": 1.0}}}, r"\[assets.options.pole\] .*least_heigt_m.*least_height_m"),
        ({"sensors": ["lider"]}, r"unknown sensor 'lider' \(did you mean 'lidar'"),
    ],
)
def test_settings_are_checked_before_work(street: Simulated, settings: dict[str, object], words: str) -> None:
    own = session(street, **settings)
    (fault,) = Assets().check(own.survey)
    with pytest.raises(ConfigError, match=words):
        raise fault


@pytest.mark.slow
def test_python_gets_a_geodataframe(street: Simulated) -> None:
    survey = roadscan.open_survey(street.survey_file)
    found = survey.assets("pole")
    assert isinstance(found, geopandas.GeoDataFrame)
    assert found.crs.to_epsg() == 32632
    assert found.has_z.all() and len(found) == 3
    detail = json.loads(session(street).manifest.of("assets")["poles.parquet"].detail)
    assert detail == {"objects": 3}


@pytest.mark.slow
def test_the_report_shows_the_posts(street: Simulated) -> None:
    own = session(street)
    blocks = list(AssetsSection().blocks(Material(own)))
    counts, drawing, thumbnails, table = blocks
    assert isinstance(counts, Table) and counts.rows[0][:2] == ("Pole", "3")
    assert isinstance(drawing, Drawing) and len(drawing.lines) == 6
    assert isinstance(thumbnails, Picture) and thumbnails.content[:4] == b"\x89PNG"
    assert isinstance(table, Table) and len(table.rows) == 3
    assert table.full_table == "poles"
    assert "Pole" in report_page(own)
