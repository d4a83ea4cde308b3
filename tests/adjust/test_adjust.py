"""The adjustment through the pipeline: three passes over painted targets, with errors of centimetres in the poses."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from roadscan.core.survey import Survey
from roadscan.footprints.footprints import FootprintTask, _stale, _tasks, load_ranges
from roadscan.georeference.plan.plan import SurveyPlan, plan_of, plan_survey
from roadscan.report.blocks import Picture, Table
from roadscan.report.section import Material
from roadscan.report.sections.adjustment import Adjustment
from roadscan.run.engine.compute import Done, Inline
from roadscan.run.engine.compute_on import embedded
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate.surface import Surface
from roadscan.store.manifest import Manifest
from roadscan.store.small_tables import read_small, small_path, write_small
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status
from roadscan.tiles.tasks.tile_plan import plan_tiles
from tests.adjust.adjusted_site import CIRCLES, NO_FILES, TARGETS, adjust, cell_errors, corrections, rows, site
from tests.surveys import Lines, Simulated, changed

pytestmark = pytest.mark.slow


def test_surface_and_check_points_come_to_the_truth(adjusted: Simulated) -> None:
    recorded = Simulated(adjusted.survey_file)
    recorded.run("store-recorded", adjust__on=False, **NO_FILES)
    before, after = (np.abs(cell_errors(adjusted, adjusted.store(name))) for name in ("store-recorded", "store"))
    assert np.mean(after) < 0.3 * np.mean(before)
    assert np.mean(after) < 0.003
    store = adjusted.store()
    residuals = rows(store, "FROM control_residuals")
    assert {row["status"] for row in residuals} == {"found"}
    assert len(residuals) == 3 * len(TARGETS)
    check = [row for row in residuals if row["role"] == "check"]
    for name, bar in (("height", 0.004), ("easting", 0.012), ("northing", 0.012)):
        was, now = (np.array([row[f"{name}_{word}_m"] for row in check]) for word in ("before", "after"))
        assert np.sqrt(np.mean(now**2)) < min(bar, 0.7 * np.sqrt(np.mean(was**2)))
    seams = rows(store, "FROM relative_accuracy WHERE kind = 'height_tie'")
    assert min(row["rms_before_m"] for row in seams) > 0.003
    assert max(row["rms_after_m"] for row in seams) < 0.001
    assert rows(store, "SELECT count(*) AS n FROM absolute_accuracy WHERE points = 'check'")[0]["n"] == 4
    sigma = rows(store, "SELECT max(sigma_down_m) AS s FROM tiles")[0]["s"]
    assert 0.0003 < sigma < 0.005  # a fifth of the 0.02 m that the logs state
    pictures = store.files("products/adjustment", ".png")
    assert {"adjustment.png", "seams.png"} < {path.rsplit("/", 1)[-1] for path in pictures}
    assert len(pictures) == 2 + len(residuals)


def test_accuracy_is_told_by_distance_to_control_and_the_report_shows_seams(adjusted: Simulated) -> None:
    store = adjusted.store()
    by_distance = {(row["points"], row["from_m"]): row for row in rows(store, "FROM accuracy_by_distance")}
    # GCPs lie 4 m (the last two) to 8 m from one another, check points 4 m from the next of them.
    assert {points: one["count"] for (points, _), one in by_distance.items()} == {"check": 2, "left_out": 4}
    assert by_distance["check", 0.0]["mean_distance_m"] == pytest.approx(4.0, abs=0.1)
    assert by_distance["left_out", 0.0]["mean_distance_m"] == pytest.approx((8 + 8 + 4 + 4) / 4, abs=0.1)
    whole = rows(store, "FROM absolute_accuracy WHERE component = 'height' AND points <> 'datum'")
    for row in (one for one in whole if one["poses"] == "adjusted"):  # all lie in one class
        assert by_distance[row["points"], 0.0]["rmse_m"] == pytest.approx(row["rmse_m"])
    survey = changed(Survey.load(adjusted.survey_file), {**CIRCLES, **NO_FILES})
    blocks = list(Adjustment().blocks(Material(Session(survey, store))))
    pictures = [one.content for one in blocks if isinstance(one, Picture)]
    assert store.read_bytes("products/adjustment/seams.png") in pictures
    assert "accuracy_by_distance" in [one.full_table for one in blocks if isinstance(one, Table)]


def test_a_raster_states_the_sigma_of_its_tile_and_a_change_of_sigma_alone_makes_no_tile_anew(
    adjusted: Simulated, tmp_path: Path
) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    whole = {**CIRCLES, "products__make": ["tile_table", "geotiff"]}
    survey = changed(Survey.load(copy.survey_file), whole)
    run_stages(Session(survey, store, Inline(), None, Lines()), [stage_named(name) for name in ("tiles", "products")])
    told = {row["tile"]: row for row in rows(store, "FROM tiles")}
    files = store.files("tiles/geotiff", ".tif")
    assert len(files) == len(told) > 3
    for path in files:
        with rasterio.MemoryFile(store.read_bytes(path)) as held, held.open() as raster:
            tags = raster.tags()
        row = told[tags["ROADSCAN_TILE"]]
        assert float(tags["ROADSCAN_SIGMA_HEIGHT_M"]) == pytest.approx(row["sigma_down_m"], abs=5e-7)
        assert float(tags["ROADSCAN_SIGMA_HORIZONTAL_M"]) == pytest.approx(row["sigma_horizontal_m"], abs=5e-7)
    manifest = Manifest(store)
    before = plan_tiles(load_ranges(plan_survey(survey, store), manifest), plan_survey(survey, store))
    table = read_small(store, "corrections")
    assert table is not None
    write_small(store, "corrections", [{**row, "sigma_down_m": 2 * row["sigma_down_m"]} for row in table.to_pylist()])
    after = plan_tiles(load_ranges(plan_survey(survey, store), manifest), plan_survey(survey, store))
    assert list(after.keys) == list(before.keys)


def test_a_second_run_does_nothing_and_status_says_what_it_is_worth(adjusted: Simulated) -> None:
    store = adjusted.store()
    before = corrections(store)
    run = adjusted.run(**CIRCLES, **NO_FILES)
    assert run.raw_bytes_read == 0
    assert not [line for line in run.reporter.lines if line.startswith("adjust: ") and "ties" in line]
    assert corrections(store) == before
    survey = changed(Survey.load(adjusted.survey_file), {**CIRCLES, **NO_FILES})
    status = survey_status(Session(survey, store))
    assert status.is_complete
    assert any("check points, height: RMSE" in line for line in status.of("adjust").lines)


class Shuffled:
    """Runs tasks in another order, as if there were many workers."""

    workers = 7

    def __init__(self, fails_after: int = 10**9) -> None:
        self.left = fails_after

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        for task in reversed(list(tasks)):
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            yield Done(task, function(task), None)


def test_workers_order_and_a_killed_run_change_no_bit(adjusted: Simulated, tmp_path: Path) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    before = corrections(store)
    store.remove(small_path("corrections"))
    manifest = Manifest(store)
    manifest.remove([r for name in ("ties", "control_sightings") for r in manifest.of(name).values()])
    with pytest.raises(KeyboardInterrupt):
        adjust(copy, Shuffled(2))
    assert not store.exists(small_path("corrections"))
    adjust(copy, Shuffled())
    assert corrections(store) == before


@pytest.mark.nightly
@pytest.mark.parametrize("workers", [1, 2])
def test_a_cluster_of_workers_gives_the_same_bits(adjusted: Simulated, tmp_path: Path, workers: int) -> None:
    """Evidence, corrections, tables and pictures of the adjustment, against those of this process alone."""
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    store, manifest = copy.store(), Manifest(copy.store())
    before = adjustment_files(store)
    store.remove(small_path("corrections"))
    made = ("ties", "control_sightings", "adjustment_picture", "tie_residuals", "control_residuals")
    manifest.remove([r for name in made for r in manifest.of(name).values()])
    with embedded(workers) as cluster:
        adjust(copy, cluster)
    assert adjustment_files(store) == before


def adjustment_files(store: Store) -> dict[str, bytes]:
    """All that the stage writes, by path."""
    tables = ("ties", "control_sightings", "tie_residuals", "control_residuals", "relative_accuracy")
    folders = ["products/adjustment", *(f"tables/{name}" for name in tables)]
    paths = [path for folder in folders for path in store.files(folder)]
    assert len(paths) > len(folders)
    return {path: store.read_bytes(path) for path in [*paths, small_path("corrections")]}


def stale_footprints(plan: SurveyPlan, manifest: Manifest) -> list[FootprintTask]:
    return _stale(_tasks(plan), manifest)


def test_corrections_leave_footprints_current_and_switching_off_takes_them_away(
    adjusted: Simulated, tmp_path: Path
) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    session = adjust(copy, adjust__on=False)
    assert not copy.store().exists(small_path("corrections"))
    assert not rows(copy.store(), "SELECT * FROM outputs WHERE product = 'ties'")
    assert stale_footprints(plan_of(session), session.manifest) == []
    survey = changed(Survey.load(copy.survey_file), {**CIRCLES, **NO_FILES})
    again = Session(survey, copy.store())
    assert survey_status(again).of("adjust").stale == 1
    assert survey_status(again).of("footprints").stale == 0


def test_only_tiles_near_a_changed_knot_become_stale(adjusted: Simulated) -> None:
    survey = changed(Survey.load(adjusted.survey_file), {**CIRCLES, "navigation__max_gap_s": 0.02})
    store = adjusted.store()
    whole = store.read_bytes(small_path("corrections"))
    manifest, plan = Manifest(store), plan_survey(survey, store)
    footprints = load_ranges(plan, manifest)
    table = read_small(store, "corrections")
    assert table is not None
    moved = table.to_pylist()
    last = [k for k, row in enumerate(moved) if row["run"] == "run-2"][-1]
    moved[last]["down_m"] += 0.001
    try:
        write_small(store, "corrections", moved)
        after = plan_survey(survey, store)
    finally:
        store.write_bytes(small_path("corrections"), whole)
    assert stale_footprints(after, manifest) == stale_footprints(plan, manifest)
    ends = moved[last - 1]["epoch_gps_ns"] - 70_000_000
    run_2 = np.array([s.source.run == "run-2" for s in footprints.slices])[footprints.slice_index]
    near = run_2 & (footprints.last_epoch_gps_ns > ends)
    one, other = plan_tiles(footprints, plan), plan_tiles(footprints, after)
    stale = {tile for tile, a, b in zip(one.ids, one.keys, other.keys, strict=True) if a != b}
    expected = set(zip(footprints.tile_column[near].tolist(), footprints.tile_row[near].tolist(), strict=True))
    assert stale == expected
    assert 0 < len(stale) < len(one.keys)


def with_control(one: Simulated, folder: Path, change: Callable[[dict[str, dict[str, str]]], None]) -> Simulated:
    """A copy of the survey with its store, and other control points."""
    copy = one.copy_with_store_to(folder)
    file = copy.survey_file.parent / "control.csv"
    with file.open(newline="") as stream:
        points = {row["name"]: row for row in csv.DictReader(stream)}
    change(points)
    with file.open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(next(iter(points.values()))))
        out.writeheader()
        out.writerows(points.values())
    return copy


def raised(points: dict[str, dict[str, str]], name: str, by_m: float) -> None:
    points[name]["height_m"] = f"{float(points[name]['height_m']) + by_m:.4f}"


@pytest.mark.witness("control_point")
def test_a_control_point_that_is_wrong_by_50_mm_is_named_and_bends_nothing(adjusted: Simulated, tmp_path: Path) -> None:
    before = rows(adjusted.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")
    copy = with_control(adjusted, tmp_path / "survey", lambda points: raised(points, "G003", 0.050))
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    notes = [line for line in run.reporter.lines if line.startswith("note: ")]
    assert len(named := [line for line in notes if "from what all other evidence says" in line]) == 1
    assert named[0].startswith("note: G003: its surveyed height lies +")
    after = rows(copy.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")
    change = [a["height_after_m"] - b["height_after_m"] for a, b in zip(after, before, strict=True)]
    assert np.abs(change).max() < 0.001
    weights = rows(copy.store(), "SELECT DISTINCT name, weight_height FROM control_residuals WHERE role = 'gcp'")
    assert {row["name"] for row in weights if row["weight_height"] == 0.0} == {"G003"}


def test_heights_that_were_exchanged_are_named(adjusted: Simulated, tmp_path: Path) -> None:
    def exchange(points: dict[str, dict[str, str]]) -> None:
        one, other = points["G001"], points["G006"]
        one["height_m"], other["height_m"] = other["height_m"], one["height_m"]

    copy = with_control(adjusted, tmp_path / "survey", exchange)
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    assert [line for line in run.reporter.lines if "the heights of G001 and G006 look exchanged" in line]


def test_control_in_another_height_datum_is_named_and_not_used(adjusted: Simulated, tmp_path: Path) -> None:
    def geoid(points: dict[str, dict[str, str]]) -> None:
        for name in points:
            raised(points, name, -45.3)

    copy = with_control(adjusted, tmp_path / "survey", geoid)
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    assert [line for line in run.reporter.lines if "-45.3" in line and "another height datum or CRS" in line]
    moved = rows(copy.store(), "SELECT max(abs(down_m)) AS most FROM corrections")[0]["most"]
    assert moved < 0.1  # passes are still tied to one another


def test_one_point_in_another_datum_and_one_elsewhere(adjusted: Simulated, tmp_path: Path) -> None:
    def other(points: dict[str, dict[str, str]]) -> None:
        raised(points, "G001", 45.3)

    copy = with_control(adjusted, tmp_path / "survey", other)
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    assert [line for line in run.reporter.lines if "G001: its surveyed height lies +45." in line]


@pytest.mark.witness("control_place")
def test_control_in_another_crs_is_named(adjusted: Simulated, tmp_path: Path) -> None:
    def elsewhere(points: dict[str, dict[str, str]]) -> None:
        for row in points.values():
            row["easting_m"] = f"{float(row['easting_m']) - 470_000.0:.4f}"

    copy = with_control(adjusted, tmp_path / "survey", elsewhere)
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    assert [line for line in run.reporter.lines if "not one of the 6 control points lies where a pass drove" in line]
    assert not rows(copy.store(), "SELECT * FROM outputs WHERE product = 'control_sightings'")


def test_one_point_in_another_crs_is_named_and_so_are_heights_exchanged_that_are_too_far_to_be_used(
    adjusted: Simulated, tmp_path: Path
) -> None:
    """470 km to the west; and heights exchanged that differ by more than `largest_m`, as 300 m of a slope make them."""

    def change(points: dict[str, dict[str, str]]) -> None:
        points["G003"]["easting_m"] = f"{float(points['G003']['easting_m']) - 470_000.0:.4f}"
        one, other = points["G001"], points["G005"]
        one["height_m"], other["height_m"] = other["height_m"], one["height_m"]

    copy = with_control(adjusted, tmp_path / "survey", change)
    stages = ("ingest", "navigate", "footprints", "adjust")
    lines = adjust(copy, stages=stages, adjust__control={"largest_m": 0.06}).reporter.lines
    assert [line for line in lines if "1 of 6 control points lie where no pass saw the road: G003 (469," in line]
    assert len([line for line in lines if "from the road that was measured; it is in another" in line]) == 2
    assert [line for line in lines if "the heights of G001 and G005 look exchanged" in line]


def test_a_point_of_the_lane_beside_that_nobody_drove_is_no_fault(adjusted: Simulated, tmp_path: Path) -> None:
    """The rightmost head passes 3.25 m right of the road's axis; no head sees 7 m beside it."""

    def beside(points: dict[str, dict[str, str]]) -> None:
        for name, station, offset in (("G003", 11.0, 3.25 + 7.0), ("G005", 19.0, 3.25 + 12.0)):
            easting, northing, _ = Surface(site()).place(station, offset)
            points[name] |= {"easting_m": f"{easting.item():.4f}", "northing_m": f"{northing.item():.4f}"}

    copy = with_control(adjusted, tmp_path / "survey", beside)
    lines = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust")).reporter.lines
    (found,) = (line for line in lines if "lie where no pass saw the road" in line)
    assert "1 of 6 control points" in found and "G005 (12.0 m from the nearest track)" in found
    assert any("4 of 6 control points seen" in line for line in lines)


@pytest.mark.parametrize("mode", ["each_pass", "vertical", "helmert"])
def test_every_mode_improves_the_check_points(adjusted: Simulated, tmp_path: Path, mode: str) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    adjust(copy, adjust__mode=mode)
    found = rows(copy.store(), "FROM absolute_accuracy WHERE points = 'check' AND component = 'height'")
    rmse = {row["poses"]: row["rmse_m"] for row in found}
    assert rmse["adjusted"] < rmse["recorded"]
    if mode == "vertical":
        level = rows(copy.store(), "SELECT max(abs(north_m) + abs(east_m) + abs(roll_rad)) AS most FROM corrections")
        assert level[0]["most"] == 0.0
    left = rows(copy.store(), "FROM absolute_accuracy WHERE points = 'left_out' AND component = 'height'")
    assert [row["count"] for row in left] == [12 if mode == "each_pass" else 4]


def test_a_survey_without_overlap_and_control_is_told_so(raw_site: Simulated, tmp_path: Path) -> None:
    copy = raw_site.copy_to(tmp_path / "survey")
    survey = changed(Survey.load(copy.survey_file), {**CIRCLES, **NO_FILES, "control": []})
    alone = survey.config.model_copy(update={"runs": survey.config.runs[:1], "passes": survey.config.passes[:1]})
    session = Session(Survey(alone, survey.rig, survey.folder), copy.store(), Inline(), None, Lines())
    run_stages(session, [stage_named(name) for name in ("ingest", "navigate", "footprints", "adjust")])
    assert [line for line in session.reporter.lines if line.startswith("adjust: nothing to adjust")]
    assert not copy.store().exists(small_path("corrections"))


@pytest.mark.witness("corrected_elsewhere")
def test_corrections_of_another_program_stay(adjusted: Simulated, tmp_path: Path) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    table = read_small(store, "corrections")
    assert table is not None
    own = [{**row, "written_by": None, "down_m": 0.01} for row in table.to_pylist() if row["run"] == "run-1"]
    write_small(store, "corrections", own)
    run = adjust(copy)
    assert [line for line in run.reporter.lines if "run 'run-1': its poses were corrected by another program" in line]
    kept = rows(store, "SELECT DISTINCT down_m FROM corrections WHERE run = 'run-1'")
    assert kept == [{"down_m": 0.01}]
    assert rows(store, "SELECT DISTINCT run FROM corrections ORDER BY run") == [{"run": f"run-{k}"} for k in (1, 2, 3)]


def test_a_control_point_whose_place_is_wrong_is_named_and_bends_nothing(adjusted: Simulated, tmp_path: Path) -> None:
    before = rows(adjusted.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")

    def shifted(points: dict[str, dict[str, str]]) -> None:
        points["G003"]["easting_m"] = f"{float(points['G003']['easting_m']) + 0.05:.4f}"

    copy = with_control(adjusted, tmp_path / "survey", shifted)
    run = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"))
    assert [line for line in run.reporter.lines if line.startswith("note: G003: its surveyed place lies ")]
    after = rows(copy.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")
    for name in ("easting_after_m", "northing_after_m", "height_after_m"):
        assert max(abs(a[name] - b[name]) for a, b in zip(after, before, strict=True)) < 0.002
    weights = rows(copy.store(), "SELECT DISTINCT name FROM control_residuals WHERE weight_horizontal = 0")
    assert weights == [{"name": "G003"}]


@pytest.mark.witness("control_target")
def test_a_target_that_lies_elsewhere_is_measured_where_it_lies(adjusted: Simulated, tmp_path: Path) -> None:
    """One stated 0.3 m from its paint, then all of them: no height moves, though the road falls by some mm there."""
    before = rows(adjusted.store(), "FROM control_residuals ORDER BY point, run")
    found: dict[str, Session] = {}
    wide = {"adjust__targets": CIRCLES["adjust__targets"] | {"search_m": 0.5}}
    for name, shifted in (("one", ["G003"]), ("all", [f"{'GCGCGG'[k]}00{k + 1}" for k in range(6)])):

        def shift(points: dict[str, dict[str, str]], shifted: list[str] = shifted) -> None:
            for point in shifted:
                points[point]["easting_m"] = f"{float(points[point]['easting_m']) + 0.3:.4f}"

        copy = with_control(adjusted, tmp_path / name, shift)
        found[name] = adjust(copy, stages=("ingest", "navigate", "footprints", "adjust"), **wide)
        after = rows(copy.store(), "FROM control_residuals ORDER BY point, run")
        assert {row["status"] for row in after if row["name"] in shifted} == {"moved"}
        pairs = list(zip(after, before, strict=True))
        assert max(abs(a["height_before_m"] - b["height_before_m"]) for a, b in pairs) < 0.0005
        assert max(abs(a["height_after_m"] - b["height_after_m"]) for a, b in pairs) < 0.001
        notes = [line for line in found[name].reporter.lines if line.startswith("note: control: ")]  # type: ignore[attr-defined]
        assert [line for line in notes if f"{3 * len(shifted)} targets lie elsewhere than surveyed" in line]
    one, every = (found[name].reporter.lines for name in ("one", "all"))  # type: ignore[attr-defined]
    assert [line for line in one if line.startswith("note: G003: its surveyed place lies 30")]
    assert not [line for line in (*one, *every) if "the stated σ of" in line]
    # All of them: poses of 20 mm cannot err so; heights hold, and so does the shape in the plane.
    assert [
        line for line in every if "the places of the control lie" in line and "mm east from where the poses" in line
    ]
    assert not [line for line in every if "its surveyed place lies" in line]


def test_targets_picked_by_hand_stand_in_for_those_that_would_be_found(adjusted: Simulated, tmp_path: Path) -> None:
    """A tester picks the true places as the recorded poses show them: the check points come as near as by finding."""
    found = rows(adjusted.store(), "FROM control_residuals ORDER BY point, run")
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    with (copy.survey_file.parent / "picked.csv").open("w", newline="") as stream:
        out = csv.writer(stream)
        out.writerow(["run", "name", "easting_m", "northing_m"])
        for row in found:
            seen = [row[f"{axis}_m"] - row[f"{axis}_before_m"] for axis in ("easting", "northing")]
            out.writerow([row["run"], row["name"], *(f"{value:.4f}" for value in seen)])
    targets = CIRCLES["adjust__targets"] | {"shape": "none", "picked": "picked.csv", "picked_sigma_m": 0.002}
    adjust(copy, adjust__targets=targets)
    after = rows(copy.store(), "FROM control_residuals ORDER BY point, run")
    assert {row["status"] for row in after} == {"picked"}
    for name in ("easting_after_m", "northing_after_m"):
        assert max(abs(a[name] - b[name]) for a, b in zip(after, found, strict=True)) < 0.004
