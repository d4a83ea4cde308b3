"""Passes held fixed, ties by hand and observed again, surveyed lines: through the pipeline, against the truth."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pyproj
import pytest

from roadscan.adjust.tasks.outcome import known_findings
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.georeference.plan.plan import plan_of
from roadscan.navigation.tasks.trajectories import load_recorded, load_trajectory
from roadscan.simulate import Scene, simulate, truth
from roadscan.store.manifest import Manifest
from roadscan.store.small_tables import small_path
from roadscan.store.store import Store
from tests.adjust.adjusted_site import CIRCLES, NO_FILES, OFF, adjust, cell_errors, corrections, rows
from tests.surveys import Simulated, changed

pytestmark = pytest.mark.slow

STAGES = ("ingest", "navigate", "footprints", "adjust")
AZIMUTH = np.radians(128.0)
"""Of the site's road."""
RADIUS_M = 6_378_000.0
EVER = [(0, 2 * 10**18)]
"""GPS ns: until 2043."""


def findings(store: Store, witness: str) -> list[Finding]:
    return [one for one in known_findings(Manifest(store)) if one.witness == witness]


def shifted(one: Simulated, runs: Sequence[str], north_east_up_m: Sequence[float], sigma_m: float = 0.0) -> None:
    """Shift the stated positions of some runs (SBET), and state their σ in the plane (SMRMSG) where it is above 0."""
    for run in runs:
        file = one.survey_file.parent / "raw" / run / "trajectory.sbet"
        poses = np.fromfile(file, "<f8").reshape(-1, 17)
        poses[:, 1] += north_east_up_m[0] / RADIUS_M
        poses[:, 2] += north_east_up_m[1] / RADIUS_M / np.cos(poses[:, 1])
        poses[:, 3] += north_east_up_m[2]
        poses.tofile(file)
        if sigma_m:
            sigmas = np.fromfile(file.with_suffix(".smrmsg"), "<f8").reshape(-1, 10)
            sigmas[:, 1:3] = sigma_m
            sigmas.tofile(file.with_suffix(".smrmsg"))


def true_errors(one: Simulated, run: str, corrected: bool) -> npt.NDArray[np.float64]:
    """North, east, down (k, 3) of a run's poses, as recorded or corrected, minus the true ones, at its knots."""
    folder = one.survey_file.parent
    stated = np.fromfile(folder / "raw" / run / "trajectory.sbet", "<f8").reshape(-1, 17)
    true = pq.read_table(truth.load(folder).trajectory_file(run)).to_pandas()
    to_geodetic = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    lon, lat, height = to_geodetic.transform(*(true[f"{a}_world_m"].to_numpy() for a in "xyz"))
    error = np.stack(
        [
            (stated[:, 1] - np.radians(lat)) * RADIUS_M,
            (stated[:, 2] - np.radians(lon)) * RADIUS_M * np.cos(stated[:, 1]),
            height - stated[:, 3],
        ],
        axis=-1,
    )
    if not corrected:
        return error
    own = [row for row in rows(one.store(), "FROM corrections ORDER BY epoch_gps_ns") if row["run"] == run]
    epochs = true["epoch_gps_ns"].to_numpy()
    at = np.array([row["epoch_gps_ns"] for row in own])
    inside = (epochs >= at[0]) & (epochs <= at[-1])
    added = [np.interp(epochs, at, [row[n] for row in own]) for n in ("north_m", "east_m", "down_m")]
    return np.asarray((error + np.stack(added, axis=-1))[inside])


def test_a_run_that_is_held_keeps_its_poses_and_the_others_come_to_it(adjusted: Simulated, tmp_path: Path) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    run = adjust(copy, adjust__fixed=["run-1"])
    store = copy.store()
    assert [line for line in run.reporter.lines if "held fixed, with poses as they were recorded: run-1" in line]
    assert rows(store, "SELECT DISTINCT run FROM corrections ORDER BY run") == [{"run": "run-2"}, {"run": "run-3"}]
    assert not store.exists(small_path("mounting_corrections"))
    held, moved = (next(s for s, _ in plan_of(run).sources if s.run == name) for name in ("run-1", "run-2"))
    for source, same in ((held, True), (moved, False)):
        assert source.trajectory is not None
        ways = [load(store, source.trajectory, EVER, 1.0) for load in (load_trajectory, load_recorded)]
        epochs = ways[1].epochs_gps_ns[10:-10]
        assert epochs.size > 100
        poses = [way.poses(epochs).position_world_m for way in ways]
        assert np.array_equal(*poses) is same
    seams = rows(store, "FROM relative_accuracy WHERE kind = 'height_tie'")
    assert min(row["rms_before_m"] for row in seams) > 0.003
    assert max(row["rms_after_m"] for row in seams) < 0.001
    # What the run that is held errs by is that of all of them, and their σ hold it.
    wrong = float(np.mean(true_errors(copy, "run-1", corrected=False)[:, 2]))
    sigma = rows(store, "SELECT avg(sigma_down_m) AS s FROM corrections")[0]["s"]
    for other in ("run-2", "run-3"):
        assert abs(np.mean(true_errors(copy, other, corrected=True)[:, 2]) - wrong) < 0.003
    assert abs(wrong) > 0.01
    assert 0.4 * abs(wrong) < sigma < 0.03
    assert not findings(store, "fixed_run")  # 18 mm where its σ is 20 mm
    assert not findings(store, "run_not_held")


@pytest.mark.witness("fixed_run")
def test_a_run_that_is_held_and_lies_elsewhere_than_its_sigma_says_is_named(
    adjusted: Simulated, tmp_path: Path
) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    stated = {"source": "stated", "sigma_down_m": 0.004, "sigma_horizontal_m": 0.02}
    adjust(copy, adjust__fixed=["run-1"], adjust__priors=stated)
    found = findings(copy.store(), "fixed_run")
    assert [one.subject for one in found] == ["run 'run-1'"]
    assert " mm down (" in found[0].text


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"adjust__fixed": ["run-9"]}, "names the unknown run 'run-9'"),
        ({"adjust__fixed": ["run-1", "run-2", "run-3"]}, "names all runs"),
        ({"adjust__fixed": ["run-1"], "adjust__mode": "helmert"}, "moves the survey as a whole"),
    ],
)
def test_runs_that_cannot_be_held_are_refused(raw_site: Simulated, changes: dict[str, object], says: str) -> None:
    with pytest.raises(RoadscanError, match=says):
        changed(Survey.load(raw_site.survey_file), changes)


def hand_ties(one: Simulated, change: Callable[[list[dict[str, object]]], None]) -> None:
    """Write targets that run-1 and run-2 saw as ties by hand."""
    seen = rows(one.store(), "FROM control_sightings WHERE status = 'found' ORDER BY name, run")
    at = {(row["name"], row["run"]): row for row in seen}
    ties: list[dict[str, object]] = [
        {
            "name": name, "sigma_m": 0.005,
            **{f"{end}_run": run for end, run in (("first", "run-1"), ("second", "run-2"))},
            **{f"{end}_{axis}_m": at[name, run][f"{axis}_m"]
               for end, run in (("first", "run-1"), ("second", "run-2")) for axis in ("easting", "northing")},
        }
        for name in ("C002", "C004", "G001", "G003")
    ]  # fmt: skip
    change(ties)
    with (one.survey_file.parent / "hand.csv").open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(ties[0]))
        out.writeheader()
        out.writerows(ties)


@pytest.mark.witness("hand_tie")
def test_ties_by_hand_bring_passes_together_and_one_that_is_wrong_is_named(adjusted: Simulated, tmp_path: Path) -> None:
    """Two passes whose shifts are not sought: nothing but the ties by hand tells of their place."""
    copy = adjusted.copy_with_store_to(tmp_path / "survey")

    def wrong(ties: list[dict[str, object]]) -> None:
        ties[2]["second_easting_m"] += 0.3  # type: ignore[operator]
        ties.append({**ties[0], "name": "elsewhere", "first_easting_m": 0.0})

    hand_ties(copy, wrong)
    blind = {"search_m": 0.02, "least_correlation": 0.99}
    changes = {"adjust__hand_ties": {"path": "hand.csv"}, "adjust__ties": blind, "control": []}
    adjust(copy, stages=STAGES, **changes)
    store = copy.store()
    said = {one.subject: one.text for one in findings(store, "hand_tie")}
    assert set(said) == {"hand tie 'G001'", "hand tie 'elsewhere'"}
    assert "mm from what all other evidence says" in said["hand tie 'G001'"]
    assert "saw no road" in said["hand tie 'elsewhere'"]
    weights = rows(store, "SELECT place, min(weight) AS w, count(*) AS n FROM tie_residuals WHERE kind = 'hand_tie' "
                          "GROUP BY place ORDER BY place")  # fmt: skip
    assert [(row["w"] > 0, row["n"]) for row in weights] == [(True, 3), (False, 3), (True, 3), (True, 3)]
    apart = true_errors(copy, "run-1", corrected=True)[:, :2].mean(0) - true_errors(copy, "run-2", True)[:, :2].mean(0)
    before = true_errors(copy, "run-1", False)[:, :2].mean(0) - true_errors(copy, "run-2", False)[:, :2].mean(0)
    assert np.hypot(*before) > 0.01
    assert np.hypot(*apart) < 0.006


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("first_run,second_run\n", "no column 'first_easting_m'"),
        (
            "first_run,first_easting_m,first_northing_m,second_run,second_easting_m,second_northing_m,kinds\n",
            "a column 'kinds'",
        ),
        (
            "first_run,first_easting_m,first_northing_m,second_run,second_easting_m,second_northing_m\n"
            "run-1,1,2,run-4,1,2\n",
            "the unknown run 'run-4'",
        ),
        (
            "first_run,first_easting_m,first_northing_m,second_run,second_easting_m,second_northing_m\n"
            "run-1,1,2,run-2,1,north\n",
            "second_northing_m 'north'",
        ),
    ],
)
def test_a_file_of_ties_by_hand_that_is_none_is_refused(
    adjusted: Simulated, tmp_path: Path, text: str, says: str
) -> None:
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    (copy.survey_file.parent / "hand.csv").write_text(text)
    with pytest.raises(ConfigError, match=says):
        adjust(copy, adjust__hand_ties={"path": "hand.csv"})


@pytest.mark.nightly
@pytest.mark.witness("runs_apart")
def test_a_pass_that_lies_half_a_metre_off_ends_as_one_that_does_not(adjusted: Simulated, tmp_path: Path) -> None:
    """The second of three passes lies 0.5 m aside and 0.5 m up; its log states 0.02 m."""
    copy = adjusted.copy_to(tmp_path / "survey")
    shifted(copy, ["run-2"], (0.4, 0.3, 0.5))
    run = copy.run(**CIRCLES, **NO_FILES)
    store = copy.store()
    found = findings(store, "runs_apart")
    assert [one.subject for one in found] == ["run 'run-2'"]
    assert "from run-1" in found[0].text
    assert "from run-3" in found[0].text
    assert [line for line in run.reporter.lines if "ties observed again" in line]
    assert not findings(store, "ties_fail")
    assert not findings(store, "control_point")
    mean, usual = (float(np.mean(np.abs(cell_errors(one, one.store())))) for one in (copy, adjusted))
    assert mean < 1.15 * usual
    assert np.hypot(*true_errors(copy, "run-2", corrected=True)[:, :2].mean(0)) < 0.005
    # A second run does nothing; the order of the runs in the survey file changes nothing.
    before = corrections(store)
    assert copy.run(**CIRCLES, **NO_FILES).raw_bytes_read == 0
    turned = changed(Survey.load(copy.survey_file), {})
    runs = list(reversed(turned.config.model_dump()["runs"]))
    adjust(copy, stages=STAGES, runs=runs)
    assert corrections(store) == before


@pytest.mark.nightly
@pytest.mark.witness("ties_settled")
def test_ties_that_still_move_after_the_last_round_are_told(adjusted: Simulated, tmp_path: Path) -> None:
    copy = adjusted.copy_to(tmp_path / "survey")
    shifted(copy, ["run-2"], (0.4, 0.3, 0.0))
    adjust(copy, stages=STAGES, adjust__again={"rounds": 1, "share": 0.002})
    found = findings(copy.store(), "ties_settled")
    assert len(found) == 1
    assert "after ties were observed again 1 time " in found[0].text


@pytest.mark.witness("ties_fail")
def test_passes_whose_ties_mostly_fail_are_named_with_the_reason(adjusted: Simulated, tmp_path: Path) -> None:
    """Half a metre in height, and nothing is sought farther apart."""
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    shifted(copy, ["run-2"], (0.0, 0.0, 0.5))
    adjust(copy, stages=STAGES, adjust__again={"rounds": 0}, control=[])
    found = {one.subject: one.text for one in findings(copy.store(), "ties_fail")}
    assert set(found) == {"runs 'run-1' and 'run-2'", "runs 'run-2' and 'run-3'"}
    assert all("farther apart than the bound" in text and "lever arm" in text for text in found.values())
    assert not findings(adjusted.store(), "ties_fail")


def write_line(one: Simulated, aside_m: float) -> None:
    """The right edge line of the site as a surveyed line, so far to the right of the true one."""
    surface = truth.load(one.survey_file.parent).surface
    east, north, _ = surface.place(np.array([2.0, 14.0, 26.0]), np.full(3, 3.6 + aside_m))
    height = surface.height_m(east, north, texture=False)
    lines = ["line,kind,easting_m,northing_m,height_m,sigma_horizontal_m,sigma_height_m"]
    lines += [f"edge,paint,{e:.4f},{n:.4f},{h:.4f},0.005,0.005" for e, n, h in zip(east, north, height, strict=True)]
    (one.survey_file.parent / "lines.csv").write_text("\n".join(lines) + "\n")


LINES = {"path": "lines.csv", "format": "control_lines", "crs": "EPSG:25833", "height": "ellipsoidal"}


def test_a_surveyed_line_brings_passes_without_accurate_positions_across_the_road(
    adjusted: Simulated, tmp_path: Path
) -> None:
    """All poses lie 0.2 m to the right, as their σ allow; there is a painted line, and no control point."""
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    write_line(copy, 0.0)
    right = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH)])
    shifted(copy, ["run-1", "run-2", "run-3"], [*(0.2 * right), 0.0], sigma_m=0.2)
    run = adjust(copy, stages=STAGES, control=[LINES], adjust__lines={"each_m": 4.0})
    assert [line for line in run.reporter.lines if "1 surveyed lines: found at 6 of 6 points" in line]
    store = copy.store()
    assert not findings(store, "control_line")
    for number in (1, 2, 3):
        before, after = (true_errors(copy, f"run-{number}", corrected=c)[:, :2] @ right for c in (False, True))
        assert np.mean(before) > 0.15
        assert abs(np.mean(after)) < 3.0 * 0.005
        assert abs(np.mean(true_errors(copy, f"run-{number}", corrected=True)[:, 2])) < 3.0 * 0.005
    sigma = np.array(
        [[row["sigma_north_m"], row["sigma_east_m"]] for row in rows(store, "FROM corrections WHERE run = 'run-1'")]
    )
    assert sigma.max() > 0.05  # along the road nothing is told


@pytest.mark.witness("control_line")
def test_a_surveyed_line_that_is_wrong_is_named_and_bends_nothing(adjusted: Simulated, tmp_path: Path) -> None:
    before = rows(adjusted.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")
    copy = adjusted.copy_with_store_to(tmp_path / "survey")
    write_line(copy, 0.05)
    control = [one.model_dump() for one in Survey.load(copy.survey_file).config.control]
    adjust(copy, stages=STAGES, control=[*control, LINES], adjust__lines={"each_m": 4.0})
    found = findings(copy.store(), "control_line")
    assert [one.subject for one in found] == ["line 'edge'"]
    assert "mm across" in found[0].text
    assert found[0].left_out >= 5
    after = rows(copy.store(), "FROM control_residuals WHERE role = 'check' ORDER BY point, run")
    for name in ("easting_after_m", "northing_after_m", "height_after_m"):
        assert max(abs(a[name] - b[name]) for a, b in zip(after, before, strict=True)) < 0.002
    by = "SELECT points, component, count FROM absolute_accuracy ORDER BY ALL"
    assert rows(copy.store(), by) == rows(adjusted.store(), by)  # lines are no points


@pytest.mark.nightly
def test_a_surveyed_kerb_brings_a_pass_across_the_road_and_in_height(tmp_path: Path) -> None:
    scene = Scene.load("reference_site").changed(
        road={"kerbs": [{"side": "right"}], "shoulder_width_m": 0.3, "targets": [], "markings": []}, length_m=27.0,
        lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF, passes=[{"lane": 2, "offset_m": 0.8}],
        profilers={"spacing_m": 0.02, "readings": 400, "head_imus": None, "width_m": 3.0},
        noise={"position_m": 0.02, "attitude_deg": 0.005, "time_constant_s": 60.0, "control_m": 0.001},
        vehicle={"standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip
    one = Simulated(simulate(scene, tmp_path / "survey").survey_file)
    known = truth.load(tmp_path / "survey")
    offset = 2 * 3.75 / 2 + 0.3
    stations = np.array([2.0, 26.0])
    top = known.surface.height_m(*known.surface.place(stations, np.full(2, offset + 0.1))[:2], texture=False)
    east, north, _ = known.surface.place(stations, np.full(2, offset))
    features = [[float(e), float(n), float(h)] for e, n, h in zip(east, north, top, strict=True)]
    right = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH)])
    shifted(one, ["run-1"], [*(0.2 * right), 0.04], sigma_m=0.2)
    layer = {
        "type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25833"}},
        "features": [{"type": "Feature", "properties": {"name": "kerb", "kind": "kerb", "sigma_horizontal_m": 0.01,
                      "sigma_height_m": 0.01}, "geometry": {"type": "LineString", "coordinates": features}}],
    }  # fmt: skip
    (tmp_path / "survey" / "lines.geojson").write_text(json.dumps(layer))
    run = adjust(one, stages=STAGES, control=[{**LINES, "path": "lines.geojson"}], adjust__lines={"each_m": 4.0})
    assert [line for line in run.reporter.lines if "1 surveyed lines: found at 6 of 6 points" in line]
    before, after = (true_errors(one, "run-1", corrected=c) for c in (False, True))
    assert np.mean(before[:, :2] @ right) > 0.15
    assert abs(np.mean(after[:, :2] @ right)) < 3.0 * 0.01
    assert abs(np.mean(after[:, 2])) < min(3.0 * 0.01, abs(np.mean(before[:, 2])))
