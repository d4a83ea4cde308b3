"""IMU, GNSS, encoder, accuracy and clocks, against another library's mechanisation and the definitions."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pynmea2
import pytest
from pyins import strapdown
from pyproj import Transformer

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S, Clock, TimeSystem, gps_ns_from_utc
from roadscan.core.rig import Rig
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.drive import Drive, drives_of
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import ClockError
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.gnss import AT_BODY, FIXED, FLOAT, felt, imu_of, solve
from roadscan.simulate.surface import Surface
from roadscan.store.logs import read_log_records
from roadscan.store.store import Store

BARE = {"profilers": {"on": False}, "lidar": {"on": False}}


def drive_of(scene: Scene, number: int = 0) -> Drive:
    return drives_of(scene, Earth(scene.map.crs), Surface(scene, ride=True))[number]


def geodetic(drive: Drive, epochs: np.ndarray) -> pd.DataFrame:
    """True position, velocity and attitude as pyins names them."""
    h = 5_000_000
    poses = drive.poses(epochs)
    level = drive.earth.ecef_from_level(poses.position_ecef_m)
    lon, lat, alt = drive.earth.geographic_from_ecef(poses.position_ecef_m).T
    change = drive.poses(epochs + h).position_ecef_m - drive.poses(epochs - h).position_ecef_m
    north, east, down = level.inv().apply(change / (2e-9 * h)).T
    heading, pitch, roll = (level.inv() * poses.ecef_from_body).as_euler("ZYX", degrees=True).T
    return pd.DataFrame(
        {"lat": lat, "lon": lon, "alt": alt, "VN": north, "VE": east, "VD": down, "roll": roll, "pitch": pitch,
         "heading": heading},
        index=(epochs - epochs[0]) / NS_PER_S,
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:The copy keyword is deprecated")  # pyins calls pandas so
def test_perfect_imu_integrates_to_the_drive():
    """Another library's strapdown mechanisation of the samples stays on the true path for 15 s."""
    scene = Scene.load("demo").changed(length_m=300.0, passes=[{"lane": 2}], **BARE)
    drive = drive_of(scene)
    step = 2_000_000
    epochs = np.arange(drive.start_gps_ns, drive.start_gps_ns + 15 * NS_PER_S, step)
    rate, force = felt(drive, AT_BODY, epochs, step, 5)
    time = (epochs - epochs[0]) / NS_PER_S
    names = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    imu = pd.DataFrame(np.column_stack([rate, force]), index=time, columns=names)
    start = geodetic(drive, epochs[:1]).iloc[0]
    start.name = 0.0
    found = strapdown.Integrator(start).integrate(strapdown.compute_increments_from_imu(imu, "rate"))
    true = geodetic(drive, epochs)
    last = found.index[-1]
    north = np.radians(found.lat[last] - true.lat[last]) * 6.37e6
    east = np.radians(found.lon[last] - true.lon[last]) * 6.37e6 * math.cos(math.radians(true.lat[last]))
    assert math.hypot(north, east) < 0.02
    assert abs(found.alt[last] - true.alt[last]) < 0.02
    assert abs(found.roll[last] - true.roll[last]) < 1e-3
    assert abs(found.heading[last] - true.heading[last]) < 1e-3


def test_imu_at_rest_feels_gravity_and_the_earths_rotation():
    scene = Scene.load("demo").changed(length_m=20.0, vehicle={"standstill_s": 20.0, "speed_m_per_s": 5.0}, **BARE)
    drive = drive_of(scene)
    first, _ = drive.recorded_span_gps_ns
    epochs = first + NS_PER_S + np.arange(0, 5 * NS_PER_S, 10_000_000)
    rate, force = felt(drive, AT_BODY, epochs, 10_000_000)
    assert np.linalg.norm(force, axis=1) == pytest.approx(9.8077, abs=3e-3)  # normal gravity at 48.1°, 560 m
    assert np.all(force[:, 2] < -9.7)  # upwards is −z of forward, right, down
    assert np.linalg.norm(rate, axis=1) == pytest.approx(7.292115e-5, abs=2e-6)
    pose = drive.poses(epochs[:1])
    assert pose.ecef_from_body.apply(rate.mean(axis=0))[0] == pytest.approx([0, 0, 7.292115e-5], abs=1e-6)


def test_imu_grades_have_their_errors():
    scene = Scene.load("demo").changed(length_m=60.0, **BARE)
    from roadscan.simulate.sensors.gnss import _SensorErrors

    for grade, noise in (("tactical", 50.0), ("mems", 150.0)):
        one = imu_of(scene.changed(imu={"on": True, "grade": grade}))
        still = np.zeros((40_000, 3))
        biases, scales = [], []
        for seed in range(12):
            made = [_SensorErrors(one, np.random.default_rng(seed), np.random.default_rng(99 + seed)) for _ in range(2)]
            rate, force = made[0].applied(still, still)
            turning, _ = made[1].applied(still + 1.0, still)
            biases.append(np.degrees(rate.mean(axis=0)) * 3600.0)
            scales.append((turning - rate).mean(axis=0) - 1.0)
        assert np.std(scales) == pytest.approx(one.errors.gyro_scale_ppm * 1e-6, rel=0.35)
        density = np.diff(force, axis=0).std() / math.sqrt(2) / math.sqrt(one.rate_hz) / 9.80665e-6
        assert density == pytest.approx(noise, rel=0.05)
        assert np.std(biases) == pytest.approx(one.errors.gyro_bias_deg_per_h, rel=0.35)


def test_gnss_solutions_have_their_errors_gaps_and_jumps(tmp_path: Path):
    gnss = {"on": True, "rate_hz": 10.0, "gaps": [{"start_s": 5.0, "duration_s": 4.0}], "float_after_gap_s": 3.0}
    scene = Scene.load("demo").changed(length_m=600.0, passes=[{"lane": 2}], gnss=gnss, **BARE)
    drive = drive_of(scene)
    found = solve(scene, drive)
    seconds = (found.epoch_gps_ns - drive.start_gps_ns) / NS_PER_S
    assert not np.any((seconds >= 5.0) & (seconds < 9.0))
    assert np.all(found.quality[(seconds >= 9.0) & (seconds < 12.0)] == FLOAT)
    assert np.all(found.quality[(seconds < 5.0) | (seconds >= 12.0)] == FIXED)
    poses = drive.poses(found.epoch_gps_ns)
    antenna = poses.position_ecef_m + poses.ecef_from_body.apply(scene.gnss.lever_arm_body_m)
    stated = _ecef(found.geographic)
    error = drive.earth.ecef_from_level(antenna).inv().apply(stated - antenna)
    fixed = found.quality == FIXED
    assert error[fixed, :2].std() == pytest.approx(0.010, rel=0.35)
    assert error[fixed, 2].std() == pytest.approx(0.018, rel=0.5)
    assert 0.05 < np.abs(error[~fixed]).max() < 2.0
    jumping = solve(scene.changed(gnss={"jumps_per_minute": 30.0}), drive)
    jumps = np.linalg.norm(_ecef(jumping.geographic) - stated, axis=1)
    jumps[jumps < 1e-6] = 0.0  # rounding of the coordinates (m)
    assert 0.1 < (jumps > 0).mean() < 0.95
    assert np.all(jumping.quality[jumps > 0] > 0)  # the receiver does not notice


def _ecef(geographic: np.ndarray) -> np.ndarray:
    lon, lat = np.radians(geographic[:, :2]).T
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    h = geographic[:, 2]
    return np.stack(
        [(n + h) * np.cos(lat) * np.cos(lon), (n + h) * np.cos(lat) * np.sin(lon), (n * (1 - e2) + h) * np.sin(lat)],
        axis=-1,
    )


def test_gaps_and_lever_arms_of_one_pass(tmp_path: Path):
    gap = {"start_s": 0.0, "duration_s": 1.0, "passes": [2]}
    gnss = {"on": True, "rate_hz": 10.0, "gaps": [gap], "lever_arm_error_m": (0.3, -0.2, 0.1)}
    scene = Scene.load("demo").changed(length_m=40.0, gnss=gnss, **BARE)
    sizes = [solve(scene, drive_of(scene, number)).epoch_gps_ns.size for number in (0, 1)]
    assert sizes[0] - sizes[1] == pytest.approx(10, abs=2)
    rig = Survey.load(simulate(scene, tmp_path / "s").survey_file).rig
    true = Rig.load(truth.load(tmp_path / "s").rig_file)
    stated = np.array(rig.sensors["gnss"].lever_arm_body_m) - true.sensors["gnss"].lever_arm_body_m
    assert stated == pytest.approx([0.3, -0.2, 0.1])
    assert true.sensors["gnss"].lever_arm_body_m == pytest.approx(scene.gnss.lever_arm_body_m)


def test_nmea_says_what_pos_says(tmp_path: Path):
    scene = Scene.load("demo").changed(length_m=40.0, passes=[{"lane": 2}], gnss={"on": True}, **BARE)
    raw = simulate(scene, tmp_path / "s").folder / "raw" / "run-1"
    rows = [line.split() for line in (raw / "gnss.pos").read_text().splitlines() if not line.startswith("%")]
    sentences = [pynmea2.parse(line, check=True) for line in (raw / "gnss.nmea").read_text().splitlines()]
    gga = [s for s in sentences if s.sentence_type == "GGA"]
    assert len(rows) == len(gga) > 10
    for row, one in zip(rows, gga, strict=True):
        assert one.latitude == pytest.approx(float(row[2]), abs=2e-9)
        assert one.longitude == pytest.approx(float(row[3]), abs=2e-9)
        assert float(one.altitude) + float(one.geo_sep) == pytest.approx(float(row[4]), abs=1e-4)
        gps = pd.Timestamp(" ".join(row[:2]).replace("/", "-"))
        assert (gps - pd.Timedelta(seconds=18)).time() == one.timestamp.replace(tzinfo=None)
    rmc = [s for s in sentences if s.sentence_type == "RMC"]
    speed = [math.hypot(float(row[15]), float(row[16])) for row in rows]
    assert [s.spd_over_grnd * 1852 / 3600 for s in rmc] == pytest.approx(speed, abs=1e-4)
    assert {str(s.datestamp) for s in rmc} == {"2026-05-04"}


@pytest.mark.parametrize(("side", "reverse"), [(0.0, False), (0.8, False), (0.8, True)])
def test_encoder_counts_the_wheels_way(tmp_path: Path, side: float, reverse: bool):
    pieces = [{"length_m": 20.0}, {"length_m": math.pi * 30.0, "radius_m": 30.0}, {"length_m": 20.0}]
    route = {"station_m": 5.0, "offset_m": -30.0, "pieces": pieces, "reverse": reverse}
    scene = Scene.load("calibration_yard").changed(
        passes=[{"route": route}], vehicle={"sway_deg": 0.0, "wander_m": 0.0},
        encoder={"on": True, "scale_error": 0.01, "side_m": side}, sick={"on": False}, camera={"on": False}, **BARE,
    )  # fmt: skip
    drive = drive_of(scene)
    folder = simulate(scene, tmp_path / "s").folder
    log = pa_csv.read_csv(folder / "raw" / "run-1" / "encoder.csv").to_pandas()
    inside = (log.time_ns >= drive.start_gps_ns) & (log.time_ns <= drive.start_gps_ns + drive.duration_s * NS_PER_S)
    counted = log.ticks[inside].iloc[-1] - log.ticks[inside].iloc[0]
    # Half a turn to the right: the right wheel's way is shorter by π · side; looking backwards it is the outer one.
    sign = -1.0 if reverse else 1.0
    assert counted / 1010.0 == pytest.approx(drive.length_m - sign * math.pi * side, abs=0.15)


def test_accuracy_file_states_the_errors(tmp_path: Path):
    scene = Scene.load("demo").changed(length_m=20.0, **BARE)
    folder = simulate(scene, tmp_path / "s").folder
    rows = np.fromfile(folder / "raw" / "run-1" / "trajectory.smrmsg", "<f8").reshape(-1, 10)
    assert np.allclose(rows[:, 1:4], scene.noise.position_m)
    assert np.allclose(rows[:, 7], scene.noise.attitude_deg * 60.0)
    assert np.allclose(rows[:, 9], 2 * scene.noise.attitude_deg * 60.0)
    assert np.all(np.diff(rows[:, 0]) == 1.0)


def test_components_of_the_poses_have_errors_and_time_constants_of_their_own(tmp_path: Path):
    noise = {"position_m": 0.01, "down_m": 0.03, "attitude_deg": 0.01, "heading_deg": 0.05, "time_constant_s": 0.2,
             "attitude_time_constant_s": 1.0}  # fmt: skip
    passes = [{"lane": 2, "stops": [{"at_m": 10.0, "duration_s": 200.0}]}]
    scene = Scene.load("demo").changed(length_m=20.0, noise=noise, passes=passes, **BARE)
    folder = simulate(scene, tmp_path / "s").folder
    accuracy = np.fromfile(folder / "raw" / "run-1" / "trajectory.smrmsg", "<f8").reshape(-1, 10)
    assert np.allclose(accuracy[:, [1, 2, 3, 7, 8, 9]], [0.01, 0.01, 0.03, 0.6, 0.6, 3.0])
    stated = np.fromfile(folder / "raw" / "run-1" / "trajectory.sbet", "<f8").reshape(-1, 17)
    true = pq.read_table(truth.load(folder).trajectory_file("run-1")).to_pandas()
    place = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    longitude, latitude, height = place.transform(true.x_world_m, true.y_world_m, true.z_world_m)
    north = (stated[:, 1] - np.radians(latitude)) * 6_367_000.0
    still = np.hypot(np.gradient(longitude), np.gradient(latitude)) < 1e-12
    spread, tau = spread_and_time(north[still], 0.005)
    assert (spread, tau) == pytest.approx((0.01, 0.2), rel=0.15)
    spread, tau = spread_and_time((stated[:, 3] - height)[still], 0.005)
    assert (spread, tau) == pytest.approx((0.03, 0.2), rel=0.15)
    spread, tau = spread_and_time(np.degrees(stated[still, 9]), 0.005)
    assert (spread, tau) == pytest.approx((0.05, 1.0), rel=0.3)


def spread_and_time(error: np.ndarray, step_s: float) -> tuple[float, float]:
    """Standard deviation, and time constant by the correlation of neighbours, of a first-order process."""
    centred = error - error.mean()
    keep = float((centred[1:] * centred[:-1]).mean() / (centred**2).mean())
    return float(centred.std()), -step_s / math.log(keep)


STARTS = {
    "a week ends": "2026-05-09T23:59:42.2Z",
    "a week begins": "2026-05-10T00:00:05Z",
    "a day begins": "2026-05-12T00:00:00.1Z",
    "an hour ends": "2026-05-12T09:59:59.5Z",
}
DRIFTING = {"offset_s": -0.9, "drift_ppm": 300.0, "known": True}


@pytest.mark.slow
@pytest.mark.parametrize("crs", ["EPSG:32632", "local"])
@pytest.mark.parametrize("start", list(STARTS))
def test_every_log_comes_back_to_its_true_epochs(tmp_path: Path, start: str, crs: str):
    """Over the ends of weeks, days and hours, with clocks whose errors are known: ingest gives true epochs."""
    weekly = DRIFTING | {"system": "gps_week_seconds"}
    scene = Scene.load("demo").changed(
        start=STARTS[start],
        map={"crs": crs},
        length_m=6.0,
        passes=[{"lane": 2}],
        road={"lead_m": 100.0},
        vehicle={"speed_m_per_s": 8.0, "standstill_s": 9.0},
        profilers={"spacing_m": 0.2, "readings": 20, "clock": weekly, "head_imus": "mems"},
        lidar={"range_max_m": 8.0, "clock": DRIFTING},
        imu={"on": True, "clock": weekly},
        encoder={"on": True, "clock": weekly},
    )
    folder = simulate(scene, tmp_path / "s", write_hits=True).folder
    survey = Survey.load(folder / "SURVEY.toml")
    store = Store(survey.store_url, survey.config.id)
    ingest(survey, store)
    drive = drive_of(scene)
    first, last = drive.recorded_span_gps_ns
    true = truth.load(folder)
    for record in read_log_records(store):
        if record.run == "survey":
            continue
        table = next(t for t in record.tables if t != "rejects")
        files = [store.path(f.path) for f in record.tables[table]]
        found = np.sort(pq.ParquetDataset(files).read(["epoch_gps_ns"]).column(0).to_numpy())
        if record.sensor in ("lidar", "profiler_left", "profiler_right"):
            expected = np.sort(pq.read_table(true.hits_file("run-1", record.sensor)).column("epoch_gps_ns").to_numpy())
            assert np.abs(found - expected).max() < 1_500, record.sensor
        else:
            assert abs(found[0] - first) < 0.1 * NS_PER_S, record.sensor
            assert abs(found[-1] - last) < 0.1 * NS_PER_S, record.sensor


def test_scenes_that_the_survey_file_could_not_state():
    with pytest.raises(ConfigError, match="full UTC hour"):
        Scene.load("demo").changed(lidar={"clock": {"system": "gps"}})


def test_noiseless_scenes_have_no_error_left(tmp_path: Path):
    quiet = Scene.load("urban_street").noiseless()
    assert quiet.profilers.head_imus == "perfect"
    assert quiet.lidar.divergence_deg == quiet.sick.divergence_deg == 0.0
    assert quiet.noiseless() == quiet


def test_a_pass_without_a_solution(tmp_path: Path):
    scene = Scene.load("demo").changed(length_m=10.0, passes=[{"lane": 2}], gnss={"on": True, "rate_hz": 0.1}, **BARE)
    assert solve(scene, drive_of(scene)).epoch_gps_ns.size <= 1
    simulate(scene, tmp_path / "s")


@pytest.mark.parametrize("system", ["gps", "unix_utc", "unix_gps", "gps_week_seconds", "free"])
def test_stated_clocks_bring_stamps_back(system: str):
    scene = Scene.load("demo")
    clock = SensorClock.of(
        scene, ClockError(offset_s=0.75, drift_ppm=-35.0, known=True, system=TimeSystem(system)), TimeSystem.GPS
    )
    epochs = gps_ns_from_utc(scene.start) + np.arange(0, 3 * 3600 * NS_PER_S, 977 * NS_PER_S)
    stated = tomllib.loads("clock = " + clock.toml("ns", int(epochs[0])))["clock"]
    stamps = clock.stamps_ns(epochs)
    back = Clock(**stated | {"system": TimeSystem(system)}).to_epoch_gps_ns(stamps)
    assert np.abs(back - epochs).max() < 300  # reference_s has 15 digits
    wrong = Clock(TimeSystem(system), "ns", week=stated.get("week"), offset_s=1e-9).to_epoch_gps_ns(stamps)
    assert (wrong - epochs).min() > 0.3e9


def test_a_sensors_clock_shifts_its_stamps_alone(tmp_path: Path):
    profilers = {"spacing_m": 0.5, "readings": 50}
    scene = Scene.load("demo").changed(length_m=10.0, passes=[{"lane": 2}], profilers=profilers, lidar={"on": False})
    right = simulate(scene, tmp_path / "right", write_hits=True).folder
    late = simulate(scene.changed(profilers={"clock": {"offset_s": 2.0}}), tmp_path / "late", write_hits=True).folder
    name = Path("raw/run-1/profiler_left.parquet")
    a, b = pq.read_table(right / name), pq.read_table(late / name)
    assert np.all(b.column("time").to_numpy() - a.column("epoch_gps_ns").to_numpy() == 2 * NS_PER_S)
    assert a.column("range").equals(b.column("range"))
    hits = Path("truth/hits/run-1/profiler_left.parquet")
    assert pq.read_table(right / hits).equals(pq.read_table(late / hits))
    clocks = pd.read_csv(truth.load(late).clocks_file).set_index("sensor")
    assert clocks.ahead_s.profiler_left == 2.0
    assert not clocks.stated_in_survey_file.profiler_left
    log = next(g for g in Survey.load(late / "SURVEY.toml").config.runs[0].logs if g.sensor == "profiler_left")
    assert log.clock is not None and log.clock.offset_s == 0.0  # an unknown error is not stated


def test_rig_file_states_nominal_mountings(tmp_path: Path):
    off = {"on": False}
    scene = Scene.load("calibration_yard").changed(
        lidar=off, sick=off, camera=off, profilers={"spacing_m": 0.5, "readings": 20}, vehicle={"standstill_s": 1.0},
        passes=[{"route": {"station_m": 5.0, "offset_m": 0.0, "pieces": [{"length_m": 10.0}]}}],
    )  # fmt: skip
    rig = Survey.load(simulate(scene, tmp_path / "s").survey_file).rig
    in_truth = Rig.load(truth.load(tmp_path / "s").rig_file)
    assert in_truth.sensors["profiler_left"].boresight.roll_deg == 0.7
    assert in_truth.sensors["encoder"].metres_per_tick == pytest.approx(0.001 / 1.006)
    assert rig.sensors["encoder"].metres_per_tick == pytest.approx(0.001)
    true, nominal = scene.profilers.left, rig.sensors["profiler_left"]
    assert nominal.lever_arm_body_m == pytest.approx((-2.32, -1.00, -1.06))
    assert nominal.boresight.roll_deg == pytest.approx(0.0)
    assert true.roll_deg == 0.7
    assert truth.load(tmp_path / "s").scene.profilers.left == true


def test_local_frames_have_no_latitude(tmp_path: Path):
    scene = Scene.load("demo").changed(map={"crs": "local"}, length_m=10.0, lidar={"on": False})
    with pytest.raises(ConfigError, match="gnss"):
        simulate(scene.changed(gnss={"on": True}), tmp_path / "b")
    done = simulate(scene, tmp_path / "c")
    assert Survey.load(done.survey_file).config.map.local is not None
