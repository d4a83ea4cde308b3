"""Control targets in pictures, from raw logs to a file of measurements: held against the simulator's truth."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from roadscan.calibrate.tasks.camera import resect_camera
from roadscan.cli import app
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_without_readings
from roadscan.ingest.ingest import ingest
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.points import control_rows, measured_points
from roadscan.pictures.settings import PictureTargetsConfig
from roadscan.pictures.targets.candidates import TargetPoint
from roadscan.pictures.targets.find import found_rows, seek
from roadscan.pictures.views import PictureRule
from roadscan.simulate import simulate
from roadscan.store.logs import read_log_records
from roadscan.store.store import Store
from tests.simulate.test_simulate_photogrammetry import SMALL, STREET
from tests.simulate.test_simulate_photogrammetry import Survey as Truth

PLATE = {"height_m": 1.4, "size_m": 0.8}
PLATES = [
    PLATE | {"station_m": 10.0, "offset_m": 4.6, "style": "checker", "name": "P1"},
    PLATE | {"station_m": 16.0, "offset_m": -4.0, "height_m": 2.0, "style": "ring", "name": "P2", "turned_deg": 25.0},
    PLATE | {"station_m": 12.0, "offset_m": -5.0, "style": "disc", "name": "P3", "role": "check"},
    PLATE | {"station_m": 20.0, "offset_m": 5.0, "height_m": 2.6, "style": "ring", "name": "P4", "role": "check"},
]
TARGETS = [
    {"station_m": 9.0, "offset_m": -1.4, "diameter_m": 0.9, "style": "checker", "name": "T1"},
    {"station_m": 10.0, "offset_m": 3.4, "diameter_m": 0.9, "style": "ring", "name": "T2"},
]
YARD = STREET.changed(
    length_m=5.0,
    road={"targets": TARGETS},
    roadside={"targets": PLATES, "trees": [], "parked_cars": [], "moving_cars": []},
    lidar={"on": False},
    camera=SMALL | {"every_m": 2.0},
    noise={"position_m": 0.03, "attitude_deg": 0.02, "heading_deg": 0.05},
)


def ready(folder: Path) -> Path:
    """The survey of a simulated folder, ingested."""
    file = folder / "SURVEY.toml"
    survey = Survey.load(file)
    ingest(survey, Store(survey.store_url, survey.config.id))
    return file


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = simulate(YARD, tmp_path_factory.mktemp("picture-targets") / "yard").folder
    return ready(folder)


def targets(file: Path, out: Path, *options: str) -> tuple[list[dict[str, str]], str]:
    """What the command writes and prints."""
    command = ["camera", "targets", str(file), "--out", str(out), *options]
    told = CliRunner().invoke(app, command, catch_exceptions=False)
    assert told.exit_code == 0, told.output
    with out.open() as stream:
        return list(csv.DictReader(stream)), told.output


@pytest.mark.slow
def test_middles_are_found_to_a_tenth_of_a_pixel(yard: Path, tmp_path: Path) -> None:
    rows, told = targets(yard, tmp_path / "found.csv")
    known, files = Truth(yard.parent), [row["file"] for row in Truth(yard.parent).rows()]
    marks = known.marks()
    away, sigma = [], []
    for row in rows:
        assert (row["run"], row["sensor"], row["source"]) == ("run-1", "camera", "found")
        expected = known.pixel(files.index(row["picture"]), marks[row["point"]]["ecef"])
        away.append(np.array([float(row["u_px"]), float(row["v_px"])]) - expected)
        sigma.append(float(row["sigma_px"]))
    assert len({row["point"] for row in rows}) >= 5 and len(rows) >= 9
    assert np.sqrt(np.mean(np.square(away))) < 0.1
    assert np.abs(away).max() < 0.3
    normalised = np.abs(away) / np.array(sigma)[:, None]
    assert np.median(normalised) < 1.5 and normalised.max() < 8.0
    lines = {line.split()[0]: line for line in told.splitlines() if line.strip()}
    assert all(name in lines for name in marks)
    assert f"{len(rows)} measurements" in told


@pytest.mark.slow
def test_poses_that_are_off_by_decimetres_change_nothing(yard: Path) -> None:
    """Poses off by 0.2 m and 0.3° (1 σ, each axis of each picture): the same middles, within their σ."""
    survey = Survey.load(yard)
    plan = plan_without_readings(survey, Store(survey.store_url, survey.config.id))
    settings = PictureTargetsConfig.of(survey).model_copy(update={"position_m": 0.2, "angle_deg": 0.3})
    pictures = plan_pictures(plan, PictureRule((), 60.0, -90.0, 1))
    points = [
        TargetPoint(
            row["name"],
            (row["easting_m"], row["northing_m"], row["height_m"]),
            settings.of_point(row["name"], row["code"]),
        )
        for row in control_rows(plan.store, plan.records)
    ]
    stated = {(r["picture"], r["point"]): r for r in found_rows(pictures, seek(pictures, points, settings)).to_pylist()}
    rng, views = np.random.default_rng(4), pictures.views
    turned = Rotation.from_rotvec(np.radians(0.3) * rng.standard_normal((len(views), 3))).as_matrix()
    off = replace(
        views,
        eye_world_m=views.eye_world_m + 0.2 * rng.standard_normal(views.eye_world_m.shape),
        opencv_from_world=turned @ views.opencv_from_world,
    )
    turned_views = replace(pictures, views=off)
    found, again = (found_rows(turned_views, seek(turned_views, points, settings)) for _ in range(2))
    assert found.equals(again), "not the same bytes"
    known, files, marks = (
        Truth(yard.parent),
        [row["file"] for row in Truth(yard.parent).rows()],
        Truth(yard.parent).marks(),
    )
    rows = found.to_pylist()
    assert len(rows) >= 0.7 * len(stated)
    away = [
        np.array([row["u_px"], row["v_px"]]) - known.pixel(files.index(row["picture"]), marks[row["point"]]["ecef"])
        for row in rows
    ]
    assert np.abs(away).max() < 0.3 and np.sqrt(np.mean(np.square(away))) < 0.1


@pytest.mark.slow
def test_where_there_is_no_target_none_is_found(yard: Path, tmp_path: Path) -> None:
    """The same street without targets, the same control points: bricks, windows and paint are no targets."""
    bare = YARD.changed(road={"targets": []}, roadside={"targets": []})
    folder = simulate(bare, tmp_path / "bare").folder
    (folder / "control.csv").write_bytes((yard.parent / "control.csv").read_bytes())
    told_of_targets = yard.read_text().partition("[picture_targets.names]")[1:]
    only_targets = "".join(told_of_targets).partition("[privacy]")[0]
    (folder / "SURVEY.toml").write_text((folder / "SURVEY.toml").read_text() + only_targets)
    rows, told = targets(ready(folder), tmp_path / "none.csv", "--misses")
    assert rows == []
    assert told.count("run-1/camera/") >= 9, "no reasons are told"


@pytest.mark.slow
def test_found_targets_are_read_again_and_give_the_mounting(yard: Path, tmp_path: Path) -> None:
    found = yard.parent / "found.csv"
    rows, _ = targets(yard, found)
    file = yard.with_name("SURVEY-with-points.toml")
    log = '[[runs.logs]]\npath = "found.csv"\nformat = "picture_points_csv"\nsensor = "camera"\n\n[[passes]]'
    file.write_text(yard.read_text().replace("[[passes]]", log, 1))
    survey = Survey.load(file)
    store = Store(survey.store_url, survey.config.id)
    ingest(survey, store)
    table = measured_points(store, read_log_records(store), survey.rig)
    assert table.notes == ()
    listed = sorted((r["picture"], r["point"], float(r["u_px"])) for r in rows)
    assert sorted((r["picture"], r["point"], r["u_px"]) for r in table.rows.to_pylist()) == listed
    report = resect_camera(survey, store, "camera", found, 1.0, write=False)  # the stated lens is off by 2 pixels
    assert report.resection.rms_px < 3.0
    assert {one.measured.point for one in report.checks} <= {"P3", "P4"}


@pytest.mark.slow
def test_what_is_wrong_in_measurements_is_named_and_counted(yard: Path) -> None:
    lines = ["000000.jpg,P1,1,2,run-1,", "000000.jpg,P1,3,4,,", "000009.jpg,P1,5,6,,", "000000.jpg,P2,5,6,run-7,"]
    lines.append("000000.jpg,P1,7,8,,found")  # what a person measured last counts
    (yard.parent / "odd.csv").write_text("\n".join(["picture,point,u_px,v_px,run,source", *lines, ""]))
    file = yard.with_name("SURVEY-with-odd-points.toml")
    log = '[[runs.logs]]\npath = "odd.csv"\nformat = "picture_points_csv"\nsensor = "camera"\n\n[[passes]]'
    file.write_text(yard.read_text().replace("[[passes]]", log, 1))
    survey = Survey.load(file)
    store = Store(survey.store_url + "-odd", survey.config.id)
    ingest(survey, store)
    table = measured_points(store, read_log_records(store), survey.rig)
    assert [(r["run"], r["sensor"], r["point"]) for r in table.rows.to_pylist()] == [("run-1", "camera", "P1")]
    assert table.rows["u_px"].to_pylist() == [3.0]
    assert len(table.notes) == 3
    assert any("000009.jpg" in note and "not in the store" in note for note in table.notes)
    assert any("P1 stands twice" in note for note in table.notes)


@pytest.mark.slow
def test_a_picture_that_cannot_be_read_costs_itself(yard: Path) -> None:
    survey = Survey.load(yard)
    plan = plan_without_readings(survey, Store(survey.store_url, survey.config.id))
    pictures = plan_pictures(plan, PictureRule((), 60.0, -90.0, 1))
    settings = PictureTargetsConfig.of(survey)
    row = next(r for r in control_rows(plan.store, plan.records) if r["name"] == "P1")
    place = row["easting_m"], row["northing_m"], row["height_m"]
    points = [TargetPoint("P1", place, settings.of_point("P1", row["code"]))]

    def read(number: int) -> np.ndarray | None:
        if number == 1:
            return np.zeros((30, 40), np.float32)  # of another size
        return None if number == 0 else cv2.imread(str(pictures.path(number)), cv2.IMREAD_GRAYSCALE).astype(np.float32)

    sought = list(seek(pictures, points, settings, read))
    assert [one.found is None for one in sought if one.picture in (0, 1)] == [True] * 2
    assert all("cannot be read" in one.reason for one in sought if one.picture in (0, 1))
