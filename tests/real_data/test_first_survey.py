"""From a folder of logs, by the questions of `roadscan init` alone, to a map: held against the truth of recordings."""

from __future__ import annotations

import shutil
from pathlib import Path

import ground_raster
import numpy as np
import pandas as pd
import pytest
from las_points import read_points

from tests.answers import answer_questions, first_survey, roadscan, spared
from tests.real_data.test_aces import expected_points, recorded_scans

ARGOVERSE = {
    "map.crs": 'local = { name = "city frame PIT" }',
    "clock": 'clock = { system = "unix_gps", unit = "ns" }',
    "crs": 'crs = "local"',
}


@pytest.fixture
def argoverse(recordings: Path, tmp_path: Path) -> Path:
    """A survey file with all questions answered; the rig file asks none."""
    shutil.copytree(recordings / "av2_drive", tmp_path / "logs" / "drive")
    survey_file, _ = first_survey(tmp_path / "logs")
    assert answer_questions(survey_file, ARGOVERSE) == 4
    assert answer_questions(survey_file.with_name("RIG.toml"), {}) == 0
    spared(survey_file)
    return survey_file


@pytest.mark.slow
def test_argoverse_lies_on_the_citys_raster(argoverse: Path, recordings: Path) -> None:
    done = roadscan("run", argoverse, "--workers", "0")
    assert done.exit_code == 0, done.output
    points = read_points(argoverse.parent / "store" / "survey=logs")
    assert len(points) == 198_695
    above = ground_raster.ground(ground_raster.differences(points, recordings / "av2_drive"))
    assert len(above) > 25_000
    assert abs(above.median()) <= 0.01  # published: −0.006 m
    assert ground_raster.deviation(above) <= 0.03  # published: 0.026 m


@pytest.mark.slow
def test_the_real_lever_arm_of_argoverse_is_refused(argoverse: Path, recordings: Path) -> None:
    """It is applied already: once more, it would lift the ground by 1.64 m."""
    mountings = pd.read_feather(recordings / "av2_drive" / "calibration" / "egovehicle_SE3_sensor.feather")
    roof = mountings.set_index("sensor_name").loc["up_lidar"]
    assert roof.tz_m == pytest.approx(1.64, abs=0.01)
    rig_file = argoverse.with_name("RIG.toml")
    written = rig_file.read_text()
    lever_arm = f"lever_arm_body_m = [{roof.tx_m}, {-roof.ty_m}, {-roof.tz_m}]\n"
    rig_file.write_text(written + lever_arm)
    refused = roadscan("run", argoverse, "--workers", "0")
    assert refused.exit_code != 0
    for said in (f"{refused.output} {refused.exception}", roadscan("run", argoverse, "--dry-run").output):
        assert "the rig file states lever_arm_body_m for the sensor 'lidar', and the readings" in said
        assert "the vehicle's frame already" in said
    assert not list(argoverse.parent.glob("store/survey=*/tables/returns/**/*.parquet"))
    rig_file.write_text(f"{written}mounts_vehicle_frame = true\n{lever_arm}")
    confirmed = roadscan("run", argoverse, "--dry-run")
    assert confirmed.exit_code == 0, confirmed.output
    for stated in ('axes = "flu"\n', "lever_arm_body_m = [0.0, 0.0, 0.0]\n"):  # the truth, and so no contradiction
        rig_file.write_text(written + stated)
        assert roadscan("run", argoverse, "--dry-run").exit_code == 0


@pytest.mark.slow
def test_a_robots_scans_make_the_building(recordings: Path, tmp_path: Path) -> None:
    """The log itself says that its scanner stands upright: x up, y right, z ahead."""
    logs = tmp_path / "logs"
    logs.mkdir()
    shutil.copy(recordings / "lms" / "aces.clf.bz2", logs)
    survey_file, _ = first_survey(logs)
    assert answer_questions(survey_file, {"clock": 'clock = { system = "free", offset_s = 1e9 }'}) == 1
    assert answer_questions(survey_file.with_name("RIG.toml"), {}) == 0
    spared(survey_file)
    done = roadscan("run", survey_file, "--workers", "0")
    assert done.exit_code == 0, done.output
    points = read_points(tmp_path / "store" / "survey=logs")
    expected = expected_points(recorded_scans(recordings), farthest_m=49.99)
    # One scan stands alone between two gaps of more than a second, where the trajectory is not believed.
    lonely = ~np.isin(expected.stamp.round(4), (points.gps_s - 1e9).round(4))
    assert expected.stamp[lonely].nunique() == 1
    expected = expected[~lonely]
    assert len(points) == len(expected) > 1_300_000
    assert np.abs(points.z).max() == 0.0
    for axis in "xy":  # LAS holds 0.1 mm
        assert np.abs(np.sort(points[axis]) - np.sort(expected[axis])).max() < 1.5e-4
