"""Captures of an OS1-128 and a PandarXT-32, and clouds of a Mid-360 in a bag: what their readers give is the truth."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.lidar_model import lidar_model, lidar_model_names
from roadscan.simulate.run import SimulatedSurvey
from tests.answers import first_survey
from tests.formats.log_reading import Log, read_log

STREET = Scene.load("low_cost_rig").changed(
    length_m=1.0, passes=[{"lane": 2, "stops": []}], imu={"on": False}, gnss={"on": False}, bag={"on": False},
    lidar={"range_max_m": 5.0}, start="2026-07-02T07:59:59.987654Z",
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


RIG = {"model": "Mid-360", "mount": {"roll_deg": 180.0, "pitch_deg": 4.0}}  # it hangs, so that it sees the road


@pytest.mark.parametrize("container", ["mcap", "ros1"])
def test_frames_of_livox_give_the_simulated_ranges(tmp_path: Path, container: str) -> None:
    pytest.importorskip("rosbags")
    scene = STREET.changed(lidar=RIG, bag={"on": True, "container": container})
    survey, log, hits = made(tmp_path, scene)
    assert survey.returns == log.table.num_rows == hits["range_m"].size > 10_000
    assert not log.rejects
    np.testing.assert_array_equal(log.epochs, hits["epoch_gps_ns"])
    np.testing.assert_array_equal(log.column("laser"), hits["laser"])
    assert abs(ranges(log) - hits["range_m"]).max() < 0.0014  # ranges and coordinates are whole millimetres
    azimuth = np.degrees(np.arctan2(-log.column("y_sensor_m"), log.column("x_sensor_m")))
    assert abs((azimuth - hits["azimuth_deg"] + 180.0) % 360.0 - 180.0).max() < 0.04
    elevation = np.degrees(np.arcsin(log.column("z_sensor_m") / ranges(log)))
    assert 51.5 < elevation.max() < 52.05  # upwards in the sensor, down to the road
    assert np.unique(log.column("sweep")).size == 8


def test_frames_of_a_mid360_do_not_repeat() -> None:
    """Field and rate of the data sheet; five frames fill what one leaves open."""
    model = lidar_model("Mid-360")
    assert model.figures.rosette is not None
    assert 1e9 * model.lasers / model.figures.cycle_ns == 200_000

    def seen(frames: range) -> np.ndarray:
        fired_s = 0.1 * frames.start + 20e-6 * np.arange(5_000 * len(frames))[:, None] + 1e-9 * model.firing_ns
        azimuth, elevation = model.figures.rosette.aimed(fired_s, 0.0, model.elevation_deg)
        assert elevation.min() > -7.01
        assert elevation.max() < 52.01
        return np.histogram2d(azimuth.ravel() % 360, elevation.ravel(), [range(361), range(-7, 53)])[0] > 0

    first, second = seen(range(1)), seen(range(1, 2))
    assert 0.5 < first.mean() < 0.75
    assert (second & ~first).mean() > 0.1
    assert seen(range(5)).mean() > 0.95


def test_a_model_errs_as_its_file_says(tmp_path: Path) -> None:
    """Noise of ranges, lost returns, drops of rain, jitter of stamps: all of them, in the file's sizes."""
    quiet = STREET.changed(lidar={"model": "XT32", "divergence_deg": 0.0})
    errors = lidar_model("XT32").figures.errors
    _, log, hits = made(tmp_path / "noisy", quiet.changed(lidar={"errors": "model"}))
    _, clean, _ = made(tmp_path / "clean", quiet)
    drops = hits["object_id"] == -1
    fired = 640_000 * np.ptp(hits["epoch_gps_ns"]) / 1e9
    assert drops.sum() / fired == pytest.approx(errors.clutter, rel=0.2)
    assert np.isnan(hits["height_m"][drops]).all()
    assert hits["range_m"][drops].mean() < 4.0
    assert np.std((ranges(log) - hits["range_m"])[~drops]) == pytest.approx(errors.range_m, rel=0.05)
    assert (log.table.num_rows - drops.sum()) / clean.table.num_rows == pytest.approx(1.0 - errors.dropout, abs=0.005)
    late = np.std(log.epochs - hits["epoch_gps_ns"])
    assert late == pytest.approx(errors.stamp_ns, rel=0.1)


@pytest.mark.parametrize("model", lidar_model_names())
def test_every_model_errs_in_every_way(model: str) -> None:
    figures = lidar_model(model).figures
    assert figures.divergence_deg > 0.0
    assert min(figures.errors.model_dump().values()) > 0.0


def test_an_odometry_drifts_in_a_frame_of_its_own(tmp_path: Path) -> None:
    """Against the true trajectory: a share of the way and a heading that turns; `init` does not take it for poses."""
    pytest.importorskip("rosbags")
    drift = {"on": True, "scale": 0.01, "turn_deg_per_m": 0.05}
    scene = STREET.changed(length_m=30.0, lidar={"on": False}, imu={"on": True}, gnss={"on": True},
                           bag={"on": True, "odometry": drift})  # fmt: skip
    survey = simulate(scene, tmp_path / "survey")
    bag, clock = survey.folder / "raw/run-1/rig", Clock(TimeSystem.UNIX_UTC)
    log = read_log("ros_poses", bag, {"axes": "flu", "topic": "/odom"}, clock=clock, crs="local")
    assert (log.attributes["frame_id"], log.attributes["child_frame_id"]) == ("odom", "base_link")
    np.testing.assert_array_equal(log.positions[0], 0.0)
    table = pq.read_table(truth.load(survey.folder).trajectory_file("run-1"))
    at = np.searchsorted(table["epoch_gps_ns"].to_numpy(), log.epochs[-1])
    true = np.stack([table[f"{axis}_world_m"].to_numpy() for axis in "xyz"], -1)[: at + 1]
    driven_m = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    way_m = np.linalg.norm(log.positions[-1])
    assert way_m / np.linalg.norm(true[-1] - true[0]) == pytest.approx(1.01, abs=0.002)
    astray = log.attitudes[-1].as_euler("ZYX", degrees=True)[0]  # z of flu is up, of the body down
    assert abs(astray) == pytest.approx(0.05 * driven_m, abs=0.7)  # the lane's wander apart
    logs = tmp_path / "logs"
    shutil.copytree(bag, logs / "rig")
    survey_file, told = first_survey(logs)
    listed = tomllib.loads(survey_file.read_text())["runs"][0]["logs"]
    assert {one["format"] for one in listed} == {"ros_gnss", "ros_imu"}
    assert "not listed: odom of rig" in told
    assert 'options.topic = "/odom"' in survey_file.read_text()
    assert '#? imu = "????"' in (survey_file.parent / "RIG.toml").read_text()
