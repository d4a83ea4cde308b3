"""From one bag of a low-cost rig (lidar, MEMS IMU, RTK) to the road's surface, by the questions of `roadscan init`."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from roadscan.door import open_survey
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.run import SimulatedSurvey
from tests.answers import answer_questions, first_survey, roadscan

pytest.importorskip("rosbags")

ANSWERS = {
    "clock": 'clock = { system = "unix_utc", unit = "ns" }',
    "crs": 'crs = "EPSG:4979"',
    "map.crs": 'crs = "EPSG:32632"',
    "control.crs": 'crs = "EPSG:32632"',
    "control.height": 'height = "ellipsoidal"',
}


def from_the_bag(made: SimulatedSurvey, folder: Path, settings: str = "") -> tuple[Path, truth.Truth]:
    """The survey file of a scene's bag and control points, as `roadscan init` and a reader's answers make it."""
    logs = folder / "logs"
    shutil.copytree(made.folder / "raw/run-1/rig", logs / "rig")
    shutil.copy(made.control_file, logs)
    survey_file, _ = first_survey(logs)
    assert answer_questions(survey_file, ANSWERS) == 7
    rig_file = survey_file.parent / "RIG.toml"
    text = rig_file.read_text()
    assert text.count("\n#? ") == 8  # the mountings as the bag's static transforms have them, and the IMU's grade
    rig_file.write_text(text.replace("#? ", "").replace('imu = "????"', 'imu = "mems"'))
    survey_file.write_text(survey_file.read_text() + settings)
    return survey_file, truth.load(made.folder)


def height_errors(survey_file: Path, known: truth.Truth) -> Any:
    """Heights of the product `mosaic` on the lanes minus the true ones (m)."""
    found = []
    for file in survey_file.parent.glob("store*/**/products/mosaic/height.tif"):
        with rasterio.open(file) as raster:
            heights = raster.read(1, masked=True).filled(np.nan)
            rows, columns = np.nonzero(np.isfinite(heights))
            easting, northing = (np.asarray(one) for one in raster.xy(rows, columns))
            station, offset = known.surface.station_offset_m(easting, northing)
            on_road = (abs(offset) < 3.0) & (station > 0.0) & (station < known.scene.length_m)
            true = known.surface.height_m(easting, northing, texture=False)
            found.append((heights[rows, columns] - true)[on_road])
    return np.concatenate(found)


def rms(errors: Any) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.slow
def test_a_bag_becomes_a_road(tmp_path: Path) -> None:
    """A VLP-16 on a short straight street, which tells little of roll and pitch: σ say so."""
    scene = Scene.load("low_cost_rig").changed(
        length_m=80.0, lidar={"model": "VLP-16", "range_max_m": 15.0}, passes=[{"lane": 2}], gnss={"gaps": []},
        control={"spacing_m": 40.0},
    )  # fmt: skip
    less = '\n[tiles]\ncell_m = 0.1\n\n[products]\nmake = ["mosaic", "tile_table"]\n'
    survey_file, known = from_the_bag(simulate(scene, tmp_path / "simulated"), tmp_path, less)
    done = roadscan("run", survey_file, "--workers", "0")
    assert done.exit_code == 0, done.output
    errors = height_errors(survey_file, known)
    assert errors.size > 10_000 and rms(errors) < 0.06
    assert 0.3 < rms(errors) / open_survey(survey_file).table("tiles")["sigma_down_m"].median() < 2.0


def test_how_good_the_imu_is_is_asked_before_a_log_is_read(tmp_path: Path) -> None:
    scene = Scene.load("low_cost_rig").changed(length_m=30.0, lidar={"on": False}, passes=[{"lane": 2}])
    made = simulate(scene, tmp_path / "simulated")
    rig_file = made.folder / "RIG.toml"
    rig_file.write_text(rig_file.read_text().replace('imu = "mems"\n', ""))
    done = roadscan("run", made.survey_file, "--workers", "0")
    assert done.exit_code != 0
    assert "does not say how good the IMU 'imu' is" in " ".join(str(done.exception).split()) + done.output
    assert not list(made.folder.glob("store/**/*.parquet"))


HANGING = {"model": "Mid-360", "mount": {"roll_deg": 181.2, "pitch_deg": 5.0}}
"""A Mid-360 sees from 7° below its level up to 52° above: where it is to see the road, it hangs."""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("seed", "lidar"),
    [(5101, {"model": "OS1-128"}), (5102, {"model": "XT32"}), (5103, {"model": "OS1-128"}), (5301, HANGING)],
)
def test_bars_of_the_low_cost_rig(tmp_path: Path, seed: int, lidar: dict[str, Any]) -> None:
    """240 m with a stop and 4 s without positions: 3 cm before the adjustment, 1.5 cm after it; σ are honest."""
    odometry = {"on": lidar is HANGING}  # no trajectory of the map, and not taken for one
    scene = Scene.load("low_cost_rig").changed(seed=seed, lidar=lidar, bag={"odometry": odometry})
    made = simulate(scene, tmp_path / "simulated")
    for settings, bar_m in (("\n[adjust]\non = false\n", 0.03), ("", 0.015)):
        survey_file, known = from_the_bag(made, tmp_path / f"{bar_m}", settings)
        done = roadscan("run", survey_file)
        assert done.exit_code == 0, done.output
        errors = height_errors(survey_file, known)
        assert rms(errors) < bar_m
        sigma_m = open_survey(survey_file).table("tiles")["sigma_down_m"].median()
        assert 0.3 < rms(errors) / sigma_m < 2.0
