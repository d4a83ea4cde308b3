"""The stage `condition` on a simulated road: values beside the truth, keys, and what is said where data lack."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import geopandas
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import shapely

from benchmarks.bench_lanes import RoughSurvey, driven, rough_scene, run
from roadscan.condition.index import ConditionIndex, Quantity, Value, condition_indices
from roadscan.condition.indices.faulting import Faulting
from roadscan.condition.indices.ride import Iri
from roadscan.condition.lane_data import LaneData
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.survey_lane import survey_lane
from roadscan.condition.tasks import stretches
from roadscan.condition.tasks.compare import compare_surveys, compared_values, true_lane
from roadscan.condition.tasks.stretches import cell_table
from roadscan.condition.tasks.values import GroupTask, load_lane
from roadscan.condition.tasks.work import MADE, plan_condition
from roadscan.core.errors import ConfigError
from roadscan.distress.products.cracks import COLUMNS as CRACKS
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.keys import name_of
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.query.sql import query
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import parquet_bytes
from roadscan.tiles.cells import read_cells
from roadscan.tiles.products.geo_table import write_geo_table
from roadscan.tiles.tasks.tile_plan import TILE
from roadscan.tiles.tasks.wanted_products import product_context

STEP_MM = 5.0
LINES = [{"offset_m": 0.1, "dash_m": 3.0, "gap_m": 6.0}, {"offset_m": 3.4}]


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> RoughSurvey:
    """160 m of lane 2 at 80 km/h, with ruts of 12 and 25 mm, lines and a slab that is sunk by 5 mm, run once."""
    slab = {"station_m": 60.0, "offset_m": 1.75, "length_m": 12.0, "width_m": 3.5, "height_m": -1e-3 * STEP_MM}
    scene = rough_scene(
        2.0, 160.0, passes=[{"lane": 2, "speed_m_per_s": 22.2}], road={"patches": [slab], "markings": LINES},
        profilers={"spacing_m": 0.05, "readings": 200},
    )  # fmt: skip
    made = RoughSurvey.made(scene, tmp_path_factory.mktemp("rough") / "survey")
    run(made.session("store", section_m=50.0))
    return made


def again(surveyed: RoughSurvey, folder: Path) -> Session:
    """A session on a copy of the store."""
    copy = folder / "survey"
    shutil.copytree(surveyed.file.parent, copy)
    return RoughSurvey(copy / surveyed.file.name).session("store", section_m=50.0)


@pytest.mark.slow
def test_values_are_those_of_the_truth(surveyed: RoughSurvey) -> None:
    session = surveyed.session("store", section_m=50.0)
    held, long = (
        driven(list(compared_values(one, surveyed.height_at)), ("2",))
        for one in (session, surveyed.session("store", section_m=100.0))
    )
    for side in ("left", "right"):
        iri = held["section", f"iri_{side}_m_per_km"]
        known = iri[np.isfinite(iri[:, 0])]
        assert len(known) >= 3
        assert (np.abs(known[:, 0] - known[:, 1]) <= 4.0 * known[:, 2]).all()
        assert (known[:, 2] <= 0.05).all()  # also of the path in a rut of 25 mm
        found, true, _ = long["section", f"iri_{side}_m_per_km"][0]  # of 90 m; the next ends with the road
        assert found == pytest.approx(true, rel=0.02)
        rut = held["cross_section", f"rut_depth_{side}_mm"]
        error = (rut[:, 0] - rut[:, 1])[np.isfinite(rut[:, 0])]
        assert error.size > 200
        assert abs(error.mean()) <= 0.3
        assert error.std() <= 1.0
    for side in ("left", "right"):
        found, true, sigma = held["cross_section", f"rut_area_{side}_m2"].T
        known = np.isfinite(found)
        assert 0.3 < np.median(np.abs(found - true)[known] / sigma[known]) / 0.6745 < 1.3
        found, true, sigma = held["cross_section", f"rut_width_{side}_m"].T
        # Some end elsewhere: a depth beside the rut crosses a tenth of the greatest, or does not.
        assert np.mean(np.abs(found - true)[known] <= 2.0 * sigma[known]) >= 0.7
    for name in ("hri_m_per_km", "iri_local_max_m_per_km", "grade_percent", "ride_number", "straightedge_3m_max_mm",
                 "straightedge_16ft_max_mm"):  # fmt: skip
        found, true, sigma = held["section", name].T
        known = np.isfinite(found)
        assert known.sum() >= 3
        assert (np.abs(found - true)[known] <= 4.0 * sigma[known]).all()
    for side in ("left", "right"):
        found, true, sigma = held["section", f"psd_{side}_cm3"][1:3].T  # the first is measured from 10 m on
        assert (np.abs(found - true) <= 3.0 * sigma).all()
    slope = held["section", "cross_slope_mean_percent"]
    assert np.nanmax(np.abs(slope[:, 0] - slope[:, 1])) <= 0.05
    assert held["section", "grade_percent"][:, 0] == pytest.approx(held["section", "grade_percent"][:, 1], abs=0.02)


@pytest.mark.slow
def test_steps_are_as_high_as_those_of_the_truth(surveyed: RoughSurvey) -> None:
    session = surveyed.session("store", section_m=50.0)
    config = ConditionConfig.stated(session.survey)
    assert config is not None
    group = next(g for g in plan_condition(session).groups if g.lane.name == "2")
    lane = load_lane(GroupTask(session.store, config.sections(), 0.05, product_context(plan_of(session)), group))
    true = true_lane(group, lane, surveyed.height_at)
    for side in ("left", "right"):
        found, right = (
            [(v.from_m, v.value) for v in Faulting().values(one) if v.quantity == f"step_{side}_mm"]
            for one in (lane, true)
        )
        # Unevenness may make another one, in the true heights as well.
        assert [at for at, _ in found] == pytest.approx([at for at, _ in right], abs=0.2)
        assert [height for _, height in found] == pytest.approx([height for _, height in right], abs=0.5)
        assert [at for at, _ in found[:2]] == pytest.approx([64.0, 76.0], abs=0.2)  # the line begins at station −10
        assert [height for _, height in found[:2]] == pytest.approx([STEP_MM, -STEP_MM], abs=1.0)  # so may heights


@pytest.mark.slow
def test_sections_of_ten_metres_have_a_roughness(surveyed: RoughSurvey) -> None:
    """Their mean is that of the section which they part."""
    session = surveyed.session("store", section_m=50.0)
    config = ConditionConfig.stated(session.survey)
    assert config is not None
    group = next(g for g in plan_condition(session).groups if g.lane.name == "2")
    lane = load_lane(GroupTask(session.store, config.sections(), 0.05, product_context(plan_of(session)), group))
    short = lane.config.model_copy(update={"section_m": 10.0})
    tens = tuple((at, at + 10.0) for at in np.arange(50.0, 100.0, 10.0).tolist())
    found = {}
    for part in (replace(lane, sections_m=((50.0, 100.0),)), replace(lane, sections_m=tens, config=short)):
        values = [v.value for v in Iri().values(part) if v.quantity == "iri_left_m_per_km"]
        found[len(values)] = np.mean(values)
    assert found[5] == pytest.approx(found[1], rel=2e-3)


@pytest.mark.slow
def test_the_section_table_is_filed_in_three_forms(surveyed: RoughSurvey) -> None:
    folder = surveyed.file.parent / "store" / "survey=rough" / "products" / "condition_sections"
    table = geopandas.read_parquet(folder / "condition_sections.parquet")
    text = pd.read_csv(folder / "condition_sections.csv")
    layer = geopandas.read_file(folder / "condition_sections.gpkg")
    assert len(table) == len(text) == len(layer) == 2 * 4  # the stated lane 1 was not driven
    assert table.crs.to_epsg() == layer.crs.to_epsg() == 32632
    own = table[table["lane"] == "2"].reset_index(drop=True)
    other = table[table["lane"] == "1"]
    assert own["name"].unique().tolist() == ["Test road"]
    assert own["station_from_m"].tolist()[1:] == [50.0, 100.0, 150.0]
    assert own["measure_from"].tolist()[1:] == pytest.approx([12.05, 12.10, 12.15], abs=1e-3)
    assert own["rut_depth_mean_left_mm"][1] == pytest.approx(12.0, abs=1.0)
    assert own["rut_depth_mean_right_mm"][1] == pytest.approx(25.0, abs=1.5)
    assert own["joints"].tolist()[1] == 2
    assert own.length[1] == pytest.approx(50.0, rel=0.02)
    np.testing.assert_allclose(own["mri_m_per_km"][:3], text[text["lane"] == 2]["mri_m_per_km"][:3])
    assert other["mri_m_per_km"].isna().all()
    assert other["reason"].str.contains("of the wheel path were measured").tolist() == [True, True, True, False]
    assert "m long; roughness takes 20 m or more" in other["reason"].iloc[3]
    assert own["reason"].str.contains("mpd_mean_mm: cells have 50 mm; a mean profile depth takes 10 mm or less").all()
    assert own["lane_width_from"].tolist() == ["markings"] * 4
    assert (np.abs(own["lane_width_m"] - 3.3) <= 3.0 * own["sigma_lane_width_m"]).all()
    assert (own["sigma_lane_width_m"] < 0.03).all()
    assert other["lane_width_from"].tolist() == ["stated"] * 4
    assert other["lane_width_m"].tolist() == [3.5] * 4
    assert own["reason"].str.contains("there is no table of cracks").all()
    assert own["reason"].str.contains("the profile begins in it").tolist() == [True, False, False, False]
    assert own["share_measured"].iloc[1] == 1.0


@pytest.mark.slow
def test_tiles_hold_what_lies_in_them(surveyed: RoughSurvey) -> None:
    store = surveyed.session("store").store
    tiles = geopandas.read_parquet(store.path("products/condition_tiles/condition_tiles.parquet"))
    size = 10.0
    assert (tiles.area == size * size).all()
    assert not tiles["tile"].duplicated().any()
    lanes = query(store, "SELECT sum(station_to_m - station_from_m) FROM lanes")[0][0].as_py()
    assert tiles["lane_length_m"].sum() == pytest.approx(lanes, abs=1.0)
    names = "('rut_depth_left_mm', 'rut_depth_right_mm')"
    (deepest,) = query(store, f"SELECT max(value) AS d FROM condition_values WHERE quantity IN {names}")[
        "d"
    ].to_pylist()
    assert tiles["rut_depth_max_mm"].max() == deepest
    assert tiles["rut_depth_mean_mm"].median() == pytest.approx(18.5, abs=1.0)  # ruts of 12 and 25 mm
    rough = query(store, "SELECT min(mri_m_per_km) AS a, max(mri_m_per_km) AS b FROM condition_sections")
    assert tiles["mri_m_per_km"].min() >= rough["a"][0].as_py() - 1e-9
    assert tiles["mri_max_m_per_km"].max() == rough["b"][0].as_py()


@pytest.mark.slow
def test_sql_sees_the_tables(surveyed: RoughSurvey) -> None:
    store = surveyed.session("store").store
    worst = query(store, "SELECT lane, max(mri_m_per_km) AS worst FROM condition_sections GROUP BY lane ORDER BY lane")
    assert worst["lane"].to_pylist() == ["1", "2"]
    paths = query(
        store, "SELECT path, count(*) AS n FROM profiles_longitudinal WHERE lane = '2' GROUP BY path ORDER BY path"
    )
    assert paths["path"].to_pylist() == ["left", "right"]
    crossings = query(store, "SELECT count(*) FROM cross_sections WHERE lane = '2'")[0][0].as_py()
    assert paths["n"].to_pylist() == pytest.approx([10 * crossings] * 2, abs=10)
    assert query(store, "SELECT DISTINCT direction FROM lanes")[0].to_pylist() == ["forward"]


def digests(session: Session) -> dict[str, str]:
    """Content of all values and of the section table."""
    own = ("condition_values", "condition_sections")
    return {r.unit: r.digest for r in session.manifest.all() if r.product in own}


@pytest.mark.slow
def test_the_ten_questions_have_answers(surveyed: RoughSurvey) -> None:
    page = (Path(__file__).parents[2] / "docs" / "queries.md").read_text(encoding="utf-8")
    asked = re.findall(r"^```sql\n(.*?)^```\n\n```\n(.*?)\n", page, flags=re.MULTILINE | re.DOTALL)
    assert len(asked) == 10
    store = surveyed.session("store").store
    for statement, heading in asked:
        assert query(store, statement).column_names == heading.split(), statement


@pytest.mark.slow
def test_a_second_run_does_nothing_and_stretches_change_no_bit(
    surveyed: RoughSurvey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = again(surveyed, tmp_path)
    stage = stage_named("condition")
    assert stage.state(session).stale == 0
    before = {
        r.unit: r.digest for r in session.manifest.all() if r.product in ("condition_values", "condition_sections")
    }
    session.manifest.remove([r for name in MADE for r in session.manifest.of(name).values()])
    assert stage.state(session).stale == 1  # what waits for the lines is not known yet
    monkeypatch.setattr(stretches, "STRETCH_M", 20)
    monkeypatch.setattr("roadscan.condition.tasks.values.STRETCH_M", 20)
    stage.run(session)
    assert session.failures == []
    after = {
        r.unit: r.digest for r in session.manifest.all() if r.product in ("condition_values", "condition_sections")
    }
    assert after == before


@pytest.mark.slow
def test_heights_do_not_depend_on_the_stretch(surveyed: RoughSurvey) -> None:
    session = surveyed.session("store", section_m=50.0)
    config = ConditionConfig.stated(session.survey)
    assert config is not None
    one = next(s for s in plan_condition(session).stretches if s.unit.startswith("A1/2/") and s.from_m == 50.0)
    edge = plan_of(session).ground.grid.cells_per_edge
    table = cell_table([read_cells(session.store, r, edge) for r in one.cells], 0.05)
    whole = survey_lane(table, one.line, one.lane, (one.from_m, one.to_m), config.sections())
    part = survey_lane(table, one.line, one.lane, (61.3, 72.0), config.sections())
    own = (whole.paths["left"].station_m > 61.29) & (whole.paths["left"].station_m < 71.99)
    np.testing.assert_array_equal(whole.paths["left"].values[own], part.paths["left"].values)


@pytest.mark.slow
def test_only_what_depends_on_a_tile_is_computed_again(surveyed: RoughSurvey, tmp_path: Path) -> None:
    session = again(surveyed, tmp_path)
    work = plan_condition(session)
    first = next(s for s in work.stretches if s.unit == "A1/2/000000")
    place = first.line.places(np.array([30.0]), first.lane.offsets(np.array([30.0])))[0]
    record = session.manifest.of(TILE)[str(plan_of(session).ground.grid.tile_at(place[0], place[1]))]
    session.manifest.add([record._replace(digest="another")])
    due = {s.unit for s in plan_condition(session).due_stretches}
    assert first.unit in due
    assert due <= {"A1/1/000000", "A1/2/000000"}
    session.manifest.remove([record])  # a hole in the road
    stage = stage_named("condition")
    stage.run(session)
    assert session.failures == []
    rows = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    broken = rows[(rows["lane"] == "2") & (rows["station_from_m"] < 50.0)].iloc[0]
    assert np.isnan(broken["mri_m_per_km"])
    assert "gaps wider than 0.5 m" in broken["reason"] or "were measured" in broken["reason"]
    assert stage.state(session).stale == 0


class Highest(ConditionIndex):
    """An index of another package."""

    name: ClassVar[str] = "highest"
    title: ClassVar[str] = "highest height of a section"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("highest_m", "m", "Highest height of a wheel path"),)

    def values(self, lane: LaneData) -> Iterator[Value]:
        """The left path's."""
        for a, b in lane.sections_m:
            height = lane.profiles["left"].between(a, b).height_m
            known = height[~np.isnan(height)]
            yield Value("highest_m", "section", a, b, float(known.max()) if known.size else np.nan, np.nan, 1.0)


@pytest.mark.slow
def test_a_new_index_leaves_the_others_current(
    surveyed: RoughSurvey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = again(surveyed, tmp_path)
    known = {**condition_indices(), "highest": Highest()}
    for module in ("values", "pictures"):
        monkeypatch.setattr(f"roadscan.condition.tasks.{module}.condition_indices", lambda: known)
    monkeypatch.setattr("roadscan.condition.tasks.values.name_of", entry_of)
    work = plan_condition(session)
    assert not work.due_stretches
    assert {name for one in work.due_groups for name, _ in one.indices} == {"highest"}
    stage_named("condition").run(session)
    rows = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    assert rows["highest_m"].notna().sum() == 4
    assert stage_named("condition").state(session).stale == 0


def entry_of(kind: type) -> str:
    """Code of an index; that of this test's is the contract."""
    return "roadscan.condition.index:ConditionIndex" if kind is Highest else name_of(kind)


@pytest.mark.slow
def test_cracks_are_counted_by_section(surveyed: RoughSurvey, tmp_path: Path) -> None:
    session = again(surveyed, tmp_path)
    group = next(g for g in plan_condition(session).groups if g.lane.name == "2")
    along, across = np.arange(60.0, 70.1, 0.5), np.arange(-3.0, 3.1, 0.5)
    places = [
        group.line.places(along, group.lane.offsets(along, 0.85))[:, :2],  # in the right wheel path
        group.line.places(np.full(across.size, 120.25), group.lane.offsets(np.full(across.size, 120.25), across))[
            :, :2
        ],
    ]
    lines = np.array([shapely.MultiLineString([line]) for line in places], object)
    rows = [{f.name: "" if f.type == "string" else 0 for f in CRACKS} for _ in lines]
    rows[0] |= {"type": "longitudinal", "width_mean_m": 0.004}
    rows[1] |= {"type": "transverse", "width_mean_m": 0.010}
    context, file = product_context(plan_of(session)), tmp_path / "cracks.parquet"
    write_geo_table(file, pa.Table.from_pylist(rows, CRACKS), "line", lines, ["MultiLineString"], context)
    session.store.publish(file, "products/cracks/cracks.parquet")
    content = session.store.read_bytes("products/cracks/cracks.parquet")
    record = OutputRecord(
        "cracks", "cracks.parquet", "k", "products/cracks/cracks.parquet", len(content), bytes_digest(content)
    )
    session.manifest.add([record])
    assert {name for g in plan_condition(session).due_groups for name, _ in g.indices} == {"cracking", "faulting"}
    stage_named("condition").run(session)
    table = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    own = table[table["lane"] == "2"]
    assert own["crack_longitudinal_m"].tolist() == pytest.approx([0.0, 10.0, 0.0, 0.0], rel=0.01)
    assert own["crack_transverse_m"].tolist() == pytest.approx([0.0, 0.0, 3.5, 0.0], rel=0.03)  # as wide as the lane
    assert own["crack_moderate_severity_m"].tolist() == pytest.approx([0.0, 0.0, 3.5, 0.0], rel=0.03)
    other = table[table["lane"] == "1"]  # was not driven
    assert other[["crack_length_m", "cracked_wheel_path_percent"]].isna().all().all()
    assert other["reason"].str.contains("crack_length_m, .*: 0 % of the wheel paths were measured").any()
    wanted = [0.0, 100 * 20 / 200, 100 * 2 / 200, 0.0]  # of 100 pieces of 0.5 m in each of two wheel paths
    assert own["cracked_wheel_path_percent"].tolist() == pytest.approx(wanted, abs=0.6)


@pytest.mark.slow
def test_heights_of_the_reconstructed_surface(surveyed: RoughSurvey, tmp_path: Path) -> None:
    session = again(surveyed, tmp_path)
    values = session.survey.config.model_dump() | {"surface": {"method": "cells", "sigma_m": 0.0005, "smooth": False}}
    values["rig"] = session.survey.rig.model_dump()
    values["condition"]["heights"] = "surface"
    with_surface = Session(type(session.survey).parse(values, folder=session.survey.folder), session.store)
    (error,) = stage_named("condition").check(with_surface.survey)
    assert "does not make the product" in str(error)
    values["products"] = {"make": ["surface"]}
    with_surface = Session(type(session.survey).parse(values, folder=session.survey.folder), session.store)
    assert stage_named("condition").check(with_surface.survey) == []
    stage_named("surfaces").run(with_surface)
    stage_named("condition").run(with_surface)
    assert with_surface.failures == []
    held = driven(list(compared_values(with_surface, surveyed.height_at)), ("2",))
    iri = held["section", "mri_m_per_km"]
    known = iri[np.isfinite(iri[:, 0])]
    assert len(known) >= 3
    assert (np.abs(known[:, 0] - known[:, 1]) <= np.maximum(0.02 * known[:, 1], 0.03)).all()
    assert np.isnan(known[:, 2]).all()  # how a smoothed surface scatters is not how it errs


@pytest.mark.slow
def test_a_layer_that_is_not_there_is_told_before_the_run(surveyed: RoughSurvey) -> None:
    session = surveyed.session("store", layer="lines.gpkg")
    (error,) = stage_named("condition").check(session.survey)
    assert "the layer does not exist" in str(error)
    assert stage_named("condition").check(surveyed.session("store").survey) == []


@pytest.mark.slow
def test_without_its_section_there_is_no_condition(surveyed: RoughSurvey, tmp_path: Path) -> None:
    session = again(surveyed, tmp_path)
    values = session.survey.config.model_dump()
    values["condition"] = None
    values["rig"] = session.survey.rig.model_dump()
    bare = Session(type(session.survey).parse(values, folder=session.survey.folder), session.store)
    stage_named("condition").run(bare)
    assert not any(bare.manifest.of(name) for name in MADE)
    assert not session.store.files("tables/profiles_longitudinal")


@pytest.mark.slow
def test_a_second_survey_tells_what_changed_and_what_did_not(surveyed: RoughSurvey, tmp_path: Path) -> None:
    """Ruts 6 mm deeper, the same unevenness, driven slower: against the truth of both scenes."""
    slab = {"station_m": 60.0, "offset_m": 1.75, "length_m": 12.0, "width_m": 3.5, "height_m": -1e-3 * STEP_MM}
    plain = rough_scene(2.0, 160.0)
    deeper = [rut.model_dump() | {"depth_m": rut.depth_m + 0.006} for rut in plain.road.ruts]
    scene = plain.changed(
        passes=[{"lane": 2, "speed_m_per_s": 16.7}], road={"patches": [slab], "ruts": deeper},
        profilers={"spacing_m": 0.05, "readings": 200},
    )  # fmt: skip
    later = RoughSurvey.made(scene, tmp_path / "later")
    session = later.session("store", section_m=50.0)
    run(session)
    before = surveyed.session("store", section_m=50.0)
    changes = compare_surveys(before, session)
    frame = changes.table.to_pandas()
    assert changes.alone == 0 and set(frame["share_in_common"].round(2)) == {1.0}
    ruts = frame[frame["quantity"].isin(["rut_depth_mean_left_mm", "rut_depth_mean_right_mm"])].dropna(subset="change")
    assert len(ruts) >= 6 and set(ruts["verdict"]) == {"larger"}
    truths = [
        driven(list(compared_values(s, made.height_at)), ("2",)) for s, made in ((before, surveyed), (session, later))
    ]
    for side in ("left", "right"):
        was, now = (held["section", f"rut_depth_mean_{side}_mm"][:, 1] for held in truths)
        own = ruts[ruts["quantity"] == f"rut_depth_mean_{side}_mm"]["change"].to_numpy()
        assert np.abs(own - (now - was)[: own.size]).max() < 0.5
    smooth = frame[(frame["quantity"] == "mri_m_per_km") & frame["change"].notna()]
    assert len(smooth) and set(smooth["verdict"]) <= {"no change shown"}
    rut = frame[frame["quantity"] == "rut_depth_mean_left_mm"].dropna(subset="change")
    assert (rut["sigma_change"] < 0.5).all()
    changes.write(tmp_path / "changes.parquet")
    assert len(geopandas.read_parquet(tmp_path / "changes.parquet")) == len(frame)
    changes.write(tmp_path / "changes.csv")
    assert len(pd.read_csv(tmp_path / "changes.csv")) == len(frame)
    with pytest.raises(ConfigError, match=r"\.csv or \.parquet"):
        changes.write(tmp_path / "changes.xlsx")


@pytest.mark.slow
def test_patches_that_have_lost_stones_are_outlined_on_the_map(surveyed: RoughSurvey, tmp_path: Path) -> None:
    """Texture of 0.8 mm, and of 1.6 mm over 2.8 × 0.8 m in the right wheel path."""
    session = again(surveyed, tmp_path)
    rng = np.random.default_rng(5)
    for record in session.manifest.of(stretches.LANE_TEXTURE).values():
        table = session.store.read_table(record.path)
        station, rows = table["station_m"].to_numpy(), table.num_rows
        offset = table["first_m"][0].as_py() + 0.2 * np.arange(len(table["texture_mm"][0]))
        texture = 0.8 * np.exp(rng.normal(0.0, 0.03, (rows, offset.size)))
        texture[(np.abs(station[:, None] - 70.0) < 1.5) & (np.abs(offset - 0.9) < 0.4)] = 1.6
        for name, values in (("texture_mm", texture), ("loss_mm", texture / 2), ("passes_share", 0.0 * texture)):
            lists = pa.array(list(values.astype(np.float32)), table.schema.field(name).type)
            table = table.set_column(table.schema.get_field_index(name), table.schema.field(name), lists)
        content = parquet_bytes(table, table_schema(stretches.LANE_TEXTURE))
        session.store.write_bytes(record.path, content)
        session.manifest.add([record._replace(bytes=len(content), digest=bytes_digest(content))])
    stage_named("condition").run(session)
    assert session.failures == []
    folder = tmp_path / "survey" / "store" / "survey=rough" / "products"
    (file,) = (folder / "ravelling_patches").rglob("*/2/*.parquet")
    patches = geopandas.read_parquet(file)
    assert patches.crs.to_epsg() == 32632
    (patch,) = patches.to_dict("records")
    assert patch["area_m2"] == pytest.approx(2.8 * 0.8, abs=0.01)
    assert patches.area[0] == pytest.approx(patch["area_m2"], rel=0.01)
    assert patch["ratio"] == pytest.approx(2.0, rel=0.03)
    assert patch["loss_mm"] == pytest.approx(0.4, abs=0.02)
    group = next(g for g in plan_condition(session).groups if g.lane.name == "2")
    at = np.array([70.0])
    centre = group.line.places(at, group.lane.offsets(at, 0.9))[0, :2]
    assert patches.centroid[0].distance(shapely.Point(centre)) < 0.15
    assert len(list((folder / "ravelling_pictures").glob("*_2_*.png"))) == 1
    table = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    own = table[table["lane"] == "2"]
    assert own["ravelled_area_m2"].tolist()[1] == pytest.approx(2.24, abs=0.01)
    assert own["ravelling_patches"].tolist()[:3] == [0.0, 1.0, 0.0]
    assert own["ravelling_loss_cm3_per_m2"].tolist()[1] == pytest.approx(400.0 * 2.24 / (50.0 * 3.4), rel=0.05)


@pytest.mark.slow
@pytest.mark.witness("severe_step")
@pytest.mark.parametrize(("kerb_m", "done"), [(0.15, "is kept"), (0.8, "is left out")])
def test_a_kerb_that_is_crossed_is_kept_in_the_roughness_and_doubted(
    surveyed: RoughSurvey, tmp_path: Path, kerb_m: float, done: str
) -> None:
    session = again(surveyed, tmp_path)
    before = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    for record in session.manifest.of(stretches.PROFILES).values():
        table = session.store.read_table(record.path)
        raised = table["height_m"].to_numpy() + kerb_m * (table["station_m"].to_numpy() > 130.02)
        column = table.schema.get_field_index("height_m")
        table = table.set_column(column, table.schema.field("height_m"), pa.array(raised, from_pandas=True))
        content = parquet_bytes(table, table_schema(stretches.PROFILES))
        session.store.write_bytes(record.path, content)
        session.manifest.add([record._replace(bytes=len(content), digest=bytes_digest(content))])
    stage = stage_named("condition")
    stage.run(session)
    assert session.failures == []
    after = session.store.read_table("products/condition_sections/condition_sections.parquet").to_pandas()
    was, now = (table[table["lane"] == "2"].iloc[2] for table in (before, after))
    assert f"at station 130.0 the road steps by more than {0.1 if kerb_m < 0.5 else 0.5:g} m" in now["reason"]
    assert done in now["reason"]
    if kerb_m < 0.5:
        assert now["mri_m_per_km"] > was["mri_m_per_km"] + 3.0
        assert now["iri_local_max_m_per_km"] > 40.0
    findings = [
        one
        for one in stage.findings(session.survey, (), session.manifest)
        if one.witness != "condition_not_measured"  # cells of 50 mm have no texture
    ]
    assert {one.witness for one in findings} == {"severe_step"}
    assert {one.text.split()[0] for one in findings} == {"left", "right"}
    assert all("road A1, lane 2" in one.line and done in one.line for one in findings)
