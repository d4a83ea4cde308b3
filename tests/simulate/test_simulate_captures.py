"""Captures of an OS1-128 and a PandarXT-32, and clouds of a Mid-360 in a bag: what their readers give is the truth."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.run import SimulatedSurvey
from tests.formats.log_reading import Log, read_log

STREET = Scene.load("low_cost_rig").changed(
    length_m=1.0, passes=[{"lane": 2, "stops": []}], imu={"on": False}, gnss={"on": False}, bag={"on": False},
    lidar={"range_max_m": 6.0}, start="2026-07-02T07:59:59.987654Z",
).noiseless()  # fmt: skip


def made(folder: Path, scene: Scene, stop: int = 0) -> tuple[SimulatedSurvey, Log, dict[str, np.ndarray]]:
    """A survey, its lidar's log as the survey file lists it, and what the beams met."""
    survey = simulate(scene, folder / "survey", write_hits=True)
    listed = tomllib.loads(survey.survey_file.read_text())["runs"][0]["logs"]
    entry = next(one for one in listed if one.get("sensor") == "lidar")
    rig = tomllib.loads(survey.rig_file.read_text())["sensors"]["lidar"]
    clock = Clock(TimeSystem(entry["clock"]["system"]), unit=entry["clock"].get("unit", "s"))
    sensor = Sensor.parse(rig)
    log = read_log(entry["format"], survey.folder / entry["path"], entry.get("options"), sensor=sensor, clock=clock)
    table = pq.read_table(truth.load(survey.folder).hits_file("run-1", "lidar"))
    return survey, log, {name: table[name].to_numpy() for name in table.column_names}


def ranges(log: Log) -> np.ndarray:
    return np.linalg.norm([log.column(f"{axis}_sensor_m").astype(float) for axis in "xyz"], axis=0)


def directed(log: Log, hits: dict[str, np.ndarray], model: str) -> np.ndarray:
    """How far the points are from the beams of the model's figures at the exact ranges (m)."""
    elevation, azimuth = np.radians(lidar_model(model).elevation_deg[hits["laser"]]), np.radians(hits["azimuth_deg"])
    flat = hits["range_m"] * np.cos(elevation)
    true = np.stack([flat * np.cos(azimuth), -flat * np.sin(azimuth), hits["range_m"] * np.sin(elevation)])
    return np.linalg.norm(true - [log.column(f"{axis}_sensor_m") for axis in "xyz"], axis=0)


@pytest.mark.parametrize(("model", "step_m", "late_ns", "astray_deg"),
                         [("OS1-128", 0.001, 0, 0.0), ("XT32", 0.004, 500, 0.0051)])  # fmt: skip
def test_a_capture_gives_the_simulated_ranges(
    tmp_path: Path, model: str, step_m: float, late_ns: int, astray_deg: float
) -> None:
    """Every range to the sensor's unit, every stamp, every direction; the hour changes on the way."""
    survey, log, hits = made(tmp_path, STREET.changed(lidar={"model": model}))
    assert survey.returns == log.table.num_rows == hits["range_m"].size > 10_000
    assert not log.rejects
    assert not log.findings
    assert abs(ranges(log) - np.rint(hits["range_m"] / step_m) * step_m).max() < 4e-6  # of 32-bit numbers
    assert abs(log.epochs - hits["epoch_gps_ns"]).max() <= late_ns
    np.testing.assert_array_equal(log.column("laser"), hits["laser"])
    assert (directed(log, hits, model) - np.radians(astray_deg) * hits["range_m"]).max() < step_m / 2 + 5e-6
    assert np.unique(log.column("sweep")).size in {7, 8}  # in 0.7 s


def test_a_capture_of_columns_has_one_rate(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"1,024 columns a turn: .* is 20, expected 10"):
        STREET.changed(lidar={"turns_per_s": 20.0})
    with pytest.raises(ConfigError, match="'VLP-16' is recorded in a bag"):
        STREET.changed(lidar={"model": "VLP-16"})
