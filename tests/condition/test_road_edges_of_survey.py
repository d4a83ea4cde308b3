"""Edges of a simulated road through the stage `condition`: table, polygons, the index of widths, and keys."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas
import numpy as np
import pytest
import shapely

from benchmarks.bench_lanes import RoughSurvey, rough_scene, run
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.tasks import road_edges
from roadscan.condition.tasks.values import GroupTask, load_lane
from roadscan.condition.tasks.work import plan_condition
from roadscan.core.errors import RoadscanError
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate.surface import Surface
from roadscan.store.query.sql import query
from roadscan.tiles.tasks.wanted_products import product_context

HALF_M = 3.5
KERB_M = 0.1


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> RoughSurvey:
    """30 m of two lanes, a kerb on the right and a brighter verge on the left, seen by wide profilers."""
    scene = rough_scene(
        2.0, 30.0, passes=[{"lane": 2, "speed_m_per_s": 22.2}, {"lane": 1, "speed_m_per_s": 22.2}],
        road={"kerbs": [{"side": "right", "height_m": KERB_M}]},
        profilers={"spacing_m": 0.1, "readings": 120, "width_m": 5.0},
    )  # fmt: skip
    made = RoughSurvey.made(scene, tmp_path_factory.mktemp("edges") / "survey")
    run(session_of(made))
    return made


def session_of(made: RoughSurvey, **edges: object) -> Session:
    """A session whose survey asks for edges."""
    return made.session("store", section_m=10.0, road_edges={"reach_m": 1.5, **edges})


@pytest.mark.slow
def test_the_table_of_edges_and_the_surface_are_those_of_the_road(surveyed: RoughSurvey) -> None:
    store = session_of(surveyed).store
    rows = query(store, "SELECT * FROM road_edge_offsets WHERE station_m BETWEEN 12 AND 38").to_pandas()
    for side, sign, kind in (("left", -1.0, "intensity"), ("right", 1.0, "kerb")):
        own = rows[rows["side"] == side]
        assert len(own) >= 50
        error = sign * own["offset_m"] - HALF_M
        assert np.abs(error).max() <= 0.06
        assert np.sqrt(np.mean((error / own["sigma_offset_m"]) ** 2)) <= 1.5
        assert (own["told_by"] == kind).mean() > 0.9
    kerb = rows[rows["side"] == "right"]
    assert kerb["drop_m"].median() == pytest.approx(-KERB_M, abs=0.005)
    files = [r.path for r in session_of(surveyed).manifest.of("road_surface").values() if r.path]
    (file,) = files
    layer = geopandas.read_parquet(surveyed.file.parent / "store" / "survey=rough" / file)
    assert layer.crs.to_epsg() == 32632
    assert layer.geometry.is_valid.all()
    assert layer["width_mean_m"].iloc[0] == pytest.approx(2.0 * HALF_M, abs=0.08)
    assert layer.area.to_numpy() == pytest.approx(layer["area_m2"].to_numpy())


@pytest.mark.slow
def test_widths_and_drops_are_values_of_sections(surveyed: RoughSurvey) -> None:
    store = session_of(surveyed).store
    found = query(
        store,
        "SELECT lane, quantity, value, sigma FROM condition_values WHERE index = 'road_width' AND extent = 'section' "
        "AND station_from_m = 20",
    ).to_pandas()
    value = {(row.lane, row.quantity): (row.value, row.sigma) for row in found.itertuples()}
    for lane in ("1", "2"):
        assert value[lane, "road_width_mean_m"][0] == pytest.approx(2.0 * HALF_M, abs=0.08)
        assert 0.01 < value[lane, "road_width_mean_m"][1] < 0.1
    assert value["2", "shoulder_mean_right_m"][0] == pytest.approx(0.0, abs=0.05)
    assert value["2", "edge_drop_mean_right_mm"][0] == pytest.approx(-1e3 * KERB_M, abs=5.0)
    assert ("2", "shoulder_mean_left_m") not in value  # lane 1 lies there
    assert ("1", "shoulder_mean_right_m") not in value
    table = store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    assert table["road_width_mean_m"].notna().sum() >= 4


@pytest.mark.slow
def test_heights_beyond_an_edge_are_no_part_of_a_cross_section(surveyed: RoughSurvey) -> None:
    """A lane that is stated 0.4 m wider than the road: what lies behind the kerb is left out."""
    values = {"lanes": [{"name": "2", "offset_m": 1.95, "width_m": 3.9}], "road_edges": {"reach_m": 1.5}}
    with_edges = surveyed.session("wide", section_m=10.0, **values)
    run(with_edges)
    config = ConditionConfig.stated(with_edges.survey)
    assert config is not None
    (group,) = plan_condition(with_edges).groups
    lane = load_lane(GroupTask(with_edges.store, config.sections(), 0.05, product_context(plan_of(with_edges)), group))
    c = lane.cross_sections
    inner = (c.station_m > 12.0) & (c.station_m < 38.0)
    assert np.isnan(c.height_m[inner][:, c.offset_m > 1.62]).all()
    assert np.isfinite(c.height_m[inner][:, np.abs(c.offset_m) < 1.4]).mean() > 0.99


@pytest.mark.slow
def test_the_same_bits_again_and_nothing_to_do_the_second_time(
    surveyed: RoughSurvey, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = session_of(surveyed)
    stage = stage_named("condition")
    assert stage.state(session).stale == 0
    made = ("road_edge_offsets", "road_surface")
    before = {(r.product, r.unit): r.digest for name in made for r in session.manifest.of(name).values()}
    session.manifest.remove([r for name in made for r in session.manifest.of(name).values()])
    assert len(plan_condition(session).due_edges) == len(before) / 2
    stage.run(session)
    after = {(r.product, r.unit): r.digest for name in made for r in session.manifest.of(name).values()}
    assert after == before
    assert session.failures == []
    assert {name for g in plan_condition(session).due_groups for name, _ in g.indices} == set()


@pytest.mark.slow
def test_polygons_of_the_survey_file_are_the_edges(surveyed: RoughSurvey, tmp_path: Path) -> None:
    from roadscan.simulate import truth

    surface: Surface = truth.load(surveyed.file.parent).surface
    station = np.arange(-9.0, 40.0, 0.5)
    sides = [np.column_stack(surface.place(station, offset)[:2]) for offset in (3.2, -3.0)]
    ring = np.concatenate([sides[0], sides[1][::-1], sides[0][:1]]).tolist()
    crs = {"type": "name", "properties": {"name": "EPSG:32632"}}
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    layer = {"type": "FeatureCollection", "crs": crs, "features": [feature]}
    file = tmp_path / "surface.geojson"
    file.write_text(json.dumps(layer))
    session = session_of(surveyed, polygons=str(file))
    assert stage_named("condition").check(session.survey) == []
    work = plan_condition(session)
    assert work.due_edges
    grid = plan_of(session).ground.grid
    config = ConditionConfig.stated(session.survey)
    assert config is not None and config.road_edges is not None
    task = road_edges.EdgeTask(
        session.store, grid, product_context(plan_of(session)), config.road_edges, tuple(work.due_edges)
    )
    found = road_edges._edges(task, work.due_edges[0])
    inner = (found.station_m > 12.0) & (found.station_m < 38.0)
    assert found.sides["right"].offset_m[inner] == pytest.approx(np.full(inner.sum(), 3.2), abs=0.01)
    assert found.sides["left"].offset_m[inner] == pytest.approx(np.full(inner.sum(), -3.0), abs=0.01)
    feature["geometry"] = {"type": "LineString", "coordinates": ring}
    file.write_text(json.dumps(layer))
    with pytest.raises(RoadscanError, match="a feature that is no polygon"):
        plan_condition(session_of(surveyed, polygons=str(file)))
    (error,) = stage_named("condition").check(session_of(surveyed, polygons="nowhere.gpkg").survey)
    assert "the layer does not exist" in str(error)
    assert shapely.Polygon(ring).is_valid
