"""Mountings from a survey's own evidence, through the survey file, against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from roadscan.calibrate.tasks.calibrate import PICTURE, TEXT, Calibrated, calibrate_survey, outdated_calibrations
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.rig import Rig
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_survey
from roadscan.georeference.sources import load_mountings
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.simulate import Scene, simulate
from roadscan.store.small_tables import small_path
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status, verify_store
from tests.surveys import changed

OBJECT = {
    "kind": "object",
    "sensors": ["profiler_left", "profiler_right"],
    "steps": [[1.2, 1.2, 0.02], [0.8, 0.8, 0.04], [0.4, 0.4, 0.06]],
    "easting_m": 566008.3,
    "northing_m": 5933039.1,
    "heading_deg": 12.0,
}


QUARTER = [{"length_m": 4.0}, {"length_m": 15.7, "radius_m": 10.0}, {"length_m": 4.0}]
"""A turn to the right: what lies along the drive at first lies across it afterwards."""


def stop_and_go(head: str) -> dict[str, Any]:
    return {"kind": "stop_and_go", "sensor": head, "imu": f"{head}_imu"}


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """There and back over the object, and across it."""
    scene = Scene.load("calibration_yard")
    scene = scene.changed(
        lidar={"on": False}, sick={"on": False}, camera={"on": False}, gnss={"on": False}, encoder={"on": False},
        imu={"on": False}, passes=[one.model_dump() for one in scene.passes[1:]],
        profilers={"readings": 400},
    )  # fmt: skip
    made = simulate(scene, tmp_path_factory.mktemp("yard") / "survey")
    survey = Survey.load(made.survey_file)
    run_stages(Session(survey, store_of(survey), Inline()), [s for s in stages() if s.name == "ingest"])
    return made.survey_file


def store_of(survey: Survey) -> Store:
    return Store(survey.store_url, survey.config.id)


@pytest.fixture(scope="module")
def calibrated(yard: Path) -> tuple[Survey, Calibrated]:
    entries = [OBJECT, stop_and_go("profiler_left"), stop_and_go("profiler_right")]
    survey = changed(Survey.load(yard), {"calibration": entries})
    return survey, calibrate_survey(survey, store_of(survey))


@pytest.mark.slow
def test_heads_on_one_object_with_their_imus(yard: Path, calibrated: tuple[Survey, Calibrated]) -> None:
    _, done = calibrated
    truth = Rig.load(yard.parent / "truth" / "RIG.toml")
    errors = {}
    for name, found in done.calibration.sensors.items():
        (rotation, lever), (true, arm) = found.mounting.arrays(), truth.sensors[name].mounting().arrays()
        turn = Rotation.from_matrix(rotation @ true.T).as_rotvec(degrees=True)
        assert np.abs(turn[:2]).max() < 0.01 and abs(turn[2]) < 0.025
        assert np.abs(np.radians(turn) / found.sigma[3:]).max() < 4.0
        errors[name] = lever - arm
        before = found.before.arrays()[0]
        assert np.degrees(Rotation.from_matrix(before @ true.T).magnitude()) > 1.0
    # Both heads see the object at one height: their relative height is found, their common one is not.
    relative = errors["profiler_left"][2] - errors["profiler_right"][2]
    assert abs(relative) < 0.0015  # 30 mm by the rig file
    words = " ".join(done.calibration.observability.undetermined)
    assert "vertical lever arm of 'profiler_left', 'profiler_right' together" in words


@pytest.mark.slow
def test_what_it_wrote_is_what_readings_are_placed_by(calibrated: tuple[Survey, Calibrated]) -> None:
    survey, done = calibrated
    store = store_of(survey)
    table = load_mountings(store)
    for name, found in done.calibration.sensors.items():
        ((since, mounting),) = table[("*", name)]
        assert since == 0
        np.testing.assert_allclose(mounting.arrays()[0], found.mounting.arrays()[0], atol=1e-12)
        np.testing.assert_allclose(mounting.arrays()[1], found.mounting.arrays()[1], atol=1e-12)
    assert store.read_bytes(TEXT).decode() == done.text
    assert store.read_bytes(PICTURE)[:8] == b"\x89PNG\r\n\x1a\n"
    row = next(r for r in done.rows if r["sensor"] == "profiler_left")
    covariance = np.reshape(row["covariance"], (6, 6))
    assert row["sigma_roll_deg"] == pytest.approx(np.degrees(covariance[3, 3] ** 0.5))
    assert "vertical lever arm" in row["not_determined"]


@pytest.mark.slow
def test_a_report_that_is_gone_or_damaged_is_seen_and_written_again(calibrated: tuple[Survey, Calibrated]) -> None:
    """From its record: a run calibrates nothing."""
    survey, _ = calibrated
    store = store_of(survey)
    before = {path: store.read_bytes(path) for path in (PICTURE, TEXT)}
    store.remove(PICTURE)
    store.write_bytes(TEXT, before[TEXT][::-1])
    faults = verify_store(store)
    assert [any(path in fault for fault in faults) for path in (PICTURE, TEXT)] == [True, True]
    run_stages(Session(survey, store, Inline()), [s for s in stages() if s.name == "footprints"])
    assert {path: store.read_bytes(path) for path in (PICTURE, TEXT)} == before
    assert verify_store(store) == []
    lines = survey_status(Session(survey, store)).of("footprints").lines
    (line,) = [one for one in lines if one.startswith("mounting of profiler_left ")]
    assert ", not determined: " in line and "vertical lever arm" in line and line.endswith(PICTURE)


@pytest.mark.slow
def test_a_later_calibration_stands_beside_the_first(yard: Path, calibrated: tuple[Survey, Calibrated]) -> None:
    entries = [stop_and_go("profiler_left")]
    later = {"calibration": entries, "navigation__calibration": {"valid_from": "2026-03-02T12:03:00Z"}}
    survey = changed(Survey.load(yard), later)
    calibrate_survey(survey, store_of(survey))
    dated = load_mountings(store_of(survey))
    assert [since > 0 for since, _ in dated[("*", "profiler_left")]] == [False, True]
    assert len(dated[("*", "profiler_right")]) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ([], "names no evidence"),
        ([{"kind": "stop_and_go", "sensor": "profiler_lef", "imu": "profiler_left_imu"}], "did you mean"),
        ([{**OBJECT, "sensors": ["lidar"]}], "'lidar'"),
    ],
)
def test_what_the_survey_does_not_have_is_named(yard: Path, entries: list[dict[str, Any]], words: str) -> None:
    survey = changed(Survey.load(yard), {"calibration": entries})
    with pytest.raises(ConfigError, match=words):
        calibrate_survey(survey, store_of(survey))


@pytest.mark.slow
def test_a_lidar_against_a_reference_scan(tmp_path: Path) -> None:
    scene = Scene.load("calibration_yard").changed(
        profilers={"on": False}, sick={"on": False}, camera={"on": False}, gnss={"on": False}, encoder={"on": False},
        imu={"on": False}, lidar={"range_max_m": 30.0}, noise={"position_m": 0.0, "attitude_deg": 0.0},
        passes=[{"route": {"station_m": 30.0, "offset_m": -20.0, "pieces": QUARTER}}],
        vehicle={"standstill_s": 0.0, "speed_m_per_s": 25.0},
    )  # fmt: skip
    made = simulate(scene, tmp_path / "survey", write_hits=True)
    hits = pq.read_table(tmp_path / "survey" / "truth" / "hits" / "run-1" / "lidar.parquet").to_pandas()
    rng = np.random.default_rng(4)
    # A scanner of its own would see the same surfaces elsewhere: other points of them, with its own noise.
    chosen = hits[["easting_m", "northing_m", "height_m"]].to_numpy()[::2]
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.offsets, las.header.scales = np.floor(chosen.min(axis=0)), [1e-4] * 3
    las.xyz = chosen + 0.005 * rng.standard_normal(chosen.shape)
    las.write(tmp_path / "survey" / "reference.las")
    reference = {
        "kind": "reference", "sensor": "lidar", "path": "reference.las", "crs": "EPSG:25832", "height": "ellipsoidal",
    }  # fmt: skip
    survey = changed(Survey.load(made.survey_file), {"calibration": [reference]})
    store = store_of(survey)
    run_stages(Session(survey, store, Inline()), [s for s in stages() if s.name == "ingest"])
    found = calibrate_survey(survey, store).calibration.sensors["lidar"]
    truth = Rig.load(made.survey_file.parent / "truth" / "RIG.toml").sensors["lidar"].mounting()
    (rotation, lever), (true, arm) = found.mounting.arrays(), truth.arrays()
    assert np.abs(Rotation.from_matrix(rotation @ true.T).as_rotvec(degrees=True)).max() < 0.01
    assert np.abs(lever - arm).max() < 0.005
    assert np.abs((lever - arm) / found.sigma[:3]).max() < 4.0


@pytest.mark.slow
def test_evidence_that_finds_nothing_is_refused_and_what_was_known_stays(
    yard: Path, calibrated: tuple[Survey, Calibrated]
) -> None:
    store = store_of(calibrated[0])
    before = store.read_bytes(small_path("mountings"))
    west, south = 566002.0, 5933047.0
    beside = {"easting_min_m": west, "northing_min_m": south, "easting_max_m": west + 1, "northing_max_m": south + 1}
    entry = {"kind": "overlap", "sensors": ["profiler_left", "profiler_right"], "area": beside}
    survey = changed(Survey.load(yard), {"calibration": [entry, stop_and_go("profiler_left")]})
    with pytest.raises(RoadscanError):
        calibrate_survey(survey, store)
    assert store.read_bytes(small_path("mountings")) == before


@pytest.mark.slow
def test_an_overlap_of_whole_runs_is_refused_before_their_readings_are_loaded(yard: Path) -> None:
    entry = {"kind": "overlap", "sensors": ["profiler_left"]}
    survey = changed(Survey.load(yard), {"calibration": [entry]})
    with pytest.raises(ConfigError, match="an area"):
        calibrate_survey(survey, store_of(survey))


@pytest.mark.slow
def test_status_says_when_the_rig_is_another_than_the_calibrated_one(calibrated: tuple[Survey, Calibrated]) -> None:
    survey, _ = calibrated
    store = store_of(survey)
    rig = survey.rig.model_dump()
    rig["sensors"]["profiler_left"]["lever_arm_body_m"] = (-2.35, -0.98, -2.08)
    other = changed(survey, {"rig": rig})
    assert not any("profiler_right" in note for note in outdated_calibrations(plan_survey(survey, store)))
    assert any("profiler_right" in note for note in outdated_calibrations(plan_survey(other, store)))


@pytest.mark.slow
def test_a_damaged_table_is_calibrated_anew(calibrated: tuple[Survey, Calibrated]) -> None:
    survey, done = calibrated
    store, said, name = store_of(survey), [], "profiler_left"
    before = store.read_bytes(small_path("mountings"))
    store.write_bytes(small_path("mountings"), b"PAR1 and no more")
    calibrate_survey(changed(survey, {"calibration": [stop_and_go(name)]}), store, said.append)
    assert [line for line in said if line.startswith("the damaged table was set aside (damaged/tables/mountings/")]
    ((key, ((_, mounting),)),) = load_mountings(store).items()
    assert key == ("*", name)
    turn = mounting.arrays()[0] @ done.calibration.sensors[name].mounting.arrays()[0].T
    assert Rotation.from_matrix(turn).magnitude() < 1e-3
    store.write_bytes(small_path("mountings"), before)
