"""The logs that the simulator writes, read by hand and taken back to the ground by a chain of their own."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.gpstime import gps_ns_from_utc
from roadscan.core.survey import Survey
from roadscan.simulate import Scene, SimulatedSurvey, simulate, truth
from roadscan.simulate.drive import Drive
from roadscan.simulate.files import write_control
from roadscan.simulate.path import Earth
from roadscan.simulate.surface import Surface
from tests.simulate.chain import WEEK_NS, Chain, read_sbet

CURVE = Scene.load("demo").changed(
    length_m=70.0,
    profilers={"spacing_m": 0.25, "readings": 301},
    lidar={"on": False},
)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Two passes in opposite directions through the first curve, without noise, with true hits."""
    return simulate(CURVE.noiseless(), tmp_path_factory.mktemp("logs") / "survey", write_hits=True)


@pytest.mark.parametrize("run", ["run-1", "run-2"])
@pytest.mark.parametrize("head", ["profiler_left", "profiler_right"])
def test_profiles_lie_where_their_beams_hit(survey: SimulatedSurvey, run: str, head: str):
    raw = survey.folder / "raw" / run
    log = pq.ParquetFile(raw / f"{head}.parquet")
    geometry = json.loads(log.schema_arrow.metadata[b"roadscan.scan_geometry"])
    table = log.read()
    n = geometry["readings"]
    units = table["range"].combine_chunks().flatten().to_numpy().reshape(-1, n)
    epochs = table["epoch_gps_ns"].to_numpy()
    y = geometry["first"] + geometry["step"] * np.arange(n)
    points = np.zeros((*units.shape, 3))
    points[:, :, 1] = y
    points[:, :, 2] = geometry["range_offset_m"] + geometry["range_step_m"] * units.astype(float)
    sensor = tomllib.loads(survey.rig_file.read_text())["sensors"][head]
    seconds = np.repeat((epochs % WEEK_NS) / 1e9, n)
    ground = Chain(raw / "trajectory.sbet", "EPSG:32632").to_ground(seconds, sensor, points.reshape(-1, 3))

    known = truth.load(survey.folder)
    hits_table = pq.read_table(known.hits_file(run, head))
    columns = ("easting_m", "northing_m", "height_m")
    hits = np.stack([hits_table[c].combine_chunks().flatten().to_numpy() for c in columns], axis=-1)
    seen = units.ravel() > 0
    assert seen.mean() > 0.99
    # Rounding of the range: half of 0.05 mm. The rest is interpolation between poses 5 ms apart.
    assert np.abs(ground - hits)[seen].max() < 4e-5
    # The stored hits are on the true surface to much less than a micrometre.
    assert np.abs(hits[:, 2] - known.height_m(hits[:, 0], hits[:, 1]))[seen].max() < 1e-7


def test_profiles_are_spaced_by_the_distance_driven(survey: SimulatedSurvey):
    known = truth.load(survey.folder)
    for run, sign in (("run-1", 1.0), ("run-2", -1.0)):
        log = pq.read_table(survey.folder / "raw" / run / "profiler_left.parquet")
        ticks = log["encoder_ticks"].to_numpy()
        np.testing.assert_array_equal(ticks, np.rint(np.arange(ticks.size) * 0.25 * 1000.0))
        poses = pq.read_table(known.trajectory_file(run))
        at = np.stack([poses[c].to_numpy() for c in ("x_world_m", "y_world_m", "z_world_m")], axis=-1)
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1)))
        driven = np.interp(log["epoch_gps_ns"].to_numpy(), poses["epoch_gps_ns"].to_numpy(), way)
        # In space the way is longer by grade and springs, and by the map's scale of 0.99975 here.
        assert (driven[-1] - driven[0]) / (0.25 * (ticks.size - 1)) == pytest.approx(1.0004, abs=6e-4)
        to_map = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
        e, n, _ = to_map.transform(*at.T)
        station, offset = known.station_offset_m(e, n)
        assert np.all(np.diff(station) * sign > 0)
        np.testing.assert_allclose(offset, sign * 1.75, atol=0.15)


def test_sbet_read_by_hand(survey: SimulatedSurvey):
    for run, start_s in (("run-1", 0.0), ("run-2", 600.0)):
        rows = read_sbet(survey.folder / "raw" / run / "trajectory.sbet")
        poses = pq.read_table(truth.load(survey.folder).trajectory_file(run))
        epochs = poses["epoch_gps_ns"].to_numpy()
        np.testing.assert_allclose(rows[:, 0], (epochs % WEEK_NS) / 1e9, rtol=0, atol=2e-10)
        # 2026-05-04 is a Monday: 1 day, 9 h 30 min and 18 leap seconds into the week.
        first_profile = 86_400.0 + 9.5 * 3600.0 + 18.0 + start_s
        assert rows[0, 0] == pytest.approx(first_profile - 0.6, abs=0.006)
        np.testing.assert_allclose(np.diff(rows[:, 0]), 0.005, atol=1e-9)

        to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
        position = np.stack(to_ecef.transform(np.degrees(rows[:, 2]), np.degrees(rows[:, 1]), rows[:, 3]), axis=-1)
        true = np.stack([poses[c].to_numpy() for c in ("x_world_m", "y_world_m", "z_world_m")], axis=-1)
        np.testing.assert_allclose(position, true, atol=1e-8)

        wander = rows[:, 10]
        assert np.all(wander == wander[0])
        assert abs(wander[0]) > 0.01
        # The vehicle looks where it goes: heading is the track's, but for the sway of a few hundredths of a degree.
        geod = pyproj.Geod(ellps="WGS84")
        lon, lat = np.degrees(rows[:, 2]), np.degrees(rows[:, 1])
        track = geod.inv(lon[:-2], lat[:-2], lon[2:], lat[2:])[0]
        heading = np.degrees(rows[1:-1, 9] - wander[1:-1])
        assert np.abs((heading - track + 180.0) % 360.0 - 180.0).max() < 0.35
        # Velocity turned from the wander frame to north and east is along the track too.
        north = rows[:, 4] * np.cos(wander) - rows[:, 5] * np.sin(wander)
        east = -rows[:, 4] * np.sin(wander) - rows[:, 5] * np.cos(wander)
        course = np.degrees(np.arctan2(east, north))[1:-1]
        assert np.abs((course - track + 180.0) % 360.0 - 180.0).max() < 0.02
        climbed = np.diff(rows[:, 3])
        np.testing.assert_allclose(rows[1:-1, 6], (climbed[1:] + climbed[:-1]) / 0.01, atol=1e-3)
        turned = np.unwrap(rows[:, 9] - wander)
        np.testing.assert_allclose(rows[1:-1, 16], (turned[2:] - turned[:-2]) / 0.01, atol=2e-3)


def test_body_stands_on_the_road(survey: SimulatedSurvey):
    """Roll is the cross slope's and pitch the grade's, up to the springs' quarter of a degree."""
    for run, sign in (("run-1", 1.0), ("run-2", -1.0)):
        rows = read_sbet(survey.folder / "raw" / run / "trajectory.sbet")
        # The crown falls to the right of either lane, seen in its direction: the right side is lower, roll positive.
        assert np.degrees(rows[:, 7].mean()) == pytest.approx(np.degrees(0.025), abs=0.15)
        assert np.degrees(rows[:, 8].mean()) == pytest.approx(sign * np.degrees(0.018), abs=0.25)


def test_survey_file_loads(survey: SimulatedSurvey):
    loaded = Survey.load(survey.survey_file)
    assert [run.id for run in loaded.config.runs] == ["run-1", "run-2"]
    assert [(p.run, p.lane, p.direction) for p in loaded.config.passes] == [
        ("run-1", "2", "forward"),
        ("run-2", "1", "backward"),
    ]
    logs = [log for run in loaded.config.runs for log in run.logs]
    assert [log.format for log in logs] == ["sbet", "scans", "scans"] * 2
    assert all(loaded.resolve(log.path).is_file() for log in logs)
    assert {log.crs for log in logs if log.format == "sbet"} == {"EPSG:4979"}
    clock = logs[0].clock
    assert clock is not None
    rows = read_sbet(loaded.resolve(logs[0].path))
    start = int(clock.clock().to_epoch_gps_ns(rows[:1, 0])[0])
    assert start == pytest.approx(gps_ns_from_utc(CURVE.start) - 0.6e9, abs=5e6)
    # The rig file's boresight, composed by the model, is SciPy's own Z-Y-X.
    mounting = loaded.sensor("profiler_left").mounting()
    expected = Rotation.from_euler("ZYX", [0.6, -0.3, 0.4], degrees=True).as_matrix()
    np.testing.assert_allclose(mounting.arrays()[0], expected, atol=1e-12)
    assert mounting.lever_arm_body_m == (-2.35, -0.98, -1.08)


def test_control_points_lie_on_the_road(survey: SimulatedSurvey):
    known = truth.load(survey.folder)
    rows = list(csv.DictReader(survey.control_file.read_text().splitlines()))
    assert [row["role"] for row in rows] == ["gcp", "gcp", "check", "gcp"]
    assert [row["name"][0] for row in rows] == ["G", "G", "C", "G"]
    assert len({row["name"] for row in rows}) == len(rows) == 4
    enh = np.array([[float(row[c]) for c in ("easting_m", "northing_m", "height_m")] for row in rows])
    np.testing.assert_allclose(enh[:, 2], known.height_m(enh[:, 0], enh[:, 1]), atol=1e-4)
    _, offset = known.station_offset_m(enh[:, 0], enh[:, 1])
    np.testing.assert_allclose(np.abs(offset), 3.05, atol=2e-4)


def test_painted_targets_keep_their_roles(tmp_path: Path):
    roles = ["check", "gcp", "gcp", "check", "gcp"]
    targets = [{"station_m": 4.0 * i, "offset_m": 1.0, "role": role} for i, role in enumerate(roles)]
    scene = CURVE.noiseless().changed(road={"targets": targets})
    write_control(scene, Surface(scene), tmp_path / "control.csv")
    rows = list(csv.DictReader((tmp_path / "control.csv").read_text().splitlines()))
    assert [row["role"] for row in rows] == roles


def test_noise_has_the_stated_size(tmp_path: Path):
    quiet = CURVE.changed(length_m=25.0, passes=[{"lane": 2}]).noiseless()
    noise = {"profiler_range_m": 0.0005, "intensity": 5.0, "dropout": 0.02, "position_m": 0.01, "attitude_deg": 0.02}
    loud = quiet.changed(noise=noise)
    ranges, shades = [], []
    for name, scene in (("quiet", quiet), ("loud", loud)):
        simulate(scene, tmp_path / name)
        table = pq.read_table(tmp_path / name / "raw" / "run-1" / "profiler_left.parquet")
        ranges.append(table["range"].combine_chunks().flatten().to_numpy().astype(float))
        shades.append(table["intensity"].combine_chunks().flatten().to_numpy().astype(float))
    both = (ranges[0] > 0) & (ranges[1] > 0)
    assert both.size > 30_000
    assert 1.0 - both.mean() == pytest.approx(0.02, rel=0.15)
    difference = (ranges[1] - ranges[0])[both] * 0.00005
    assert difference.std() == pytest.approx(0.0005, rel=0.03)
    assert abs(difference.mean()) < 2e-5
    assert (shades[1] - shades[0])[both].std() == pytest.approx(5.0, rel=0.05)
    stated = read_sbet(tmp_path / "loud" / "raw" / "run-1" / "trajectory.sbet")
    true = read_sbet(tmp_path / "quiet" / "raw" / "run-1" / "trajectory.sbet")
    error = (stated - true)[:, [1, 2, 3, 7, 8, 9]] * [6.37e6, 4.25e6, 1.0, 1.0, 1.0, 1.0]
    assert 0.0005 < np.abs(error[:, :3]).max() < 0.05
    # Errors wander slowly (30 s): from pose to pose they change by σ · sqrt(2 · 5 ms / 30 s) = 0.18 mm.
    steps = np.diff(error, axis=0)
    np.testing.assert_allclose(steps[:, :3].std(axis=0), 0.01 * np.sqrt(0.01 / 30.0), rtol=0.15)
    np.testing.assert_allclose(steps[:, 3:5].std(axis=0), np.radians(0.02) * np.sqrt(0.01 / 30.0), rtol=0.15)


@pytest.mark.parametrize(
    ("crs", "easting", "northing"),
    [("EPSG:32756", 334_000.0, 6_250_000.0), ("EPSG:2263", 300_000.0, 60_000.0)],
    ids=["UTM south", "state plane in US feet"],
)
def test_other_maps_and_a_steep_bend(crs: str, easting: float, northing: float, tmp_path: Path):
    """Steep, tight and tilted: the stored hits still lie on the surface."""
    bend = [{"kind": k, "length_m": 15.0} | ({"radius_m": 25.0} if k == "arc" else {}) for k in ("spiral", "arc")]
    scene = CURVE.noiseless().changed(
        length_m=30.0,
        passes=[{"lane": 1, "direction": "backward"}],
        map={"crs": crs, "easting_m": easting, "northing_m": northing},
        road={"alignment": bend, "grade": 0.12},
        vehicle={"speed_m_per_s": 5.0, "sway_deg": 3.0},
        profilers={"left": {"roll_deg": 5.0, "pitch_deg": -5.0, "heading_deg": 8.0}},
    )
    survey = simulate(scene, tmp_path / "survey", write_hits=True)
    known = truth.load(survey.folder)
    table = pq.read_table(known.hits_file("run-1", "profiler_left"))
    e, n, h = (table[c].combine_chunks().flatten().to_numpy() for c in ("easting_m", "northing_m", "height_m"))
    error = np.abs(h - known.height_m(e, n))
    assert np.isfinite(error).mean() > 0.99
    assert np.nanmax(error) < 1e-7


def test_poses_at_any_epoch_agree_with_the_map():
    """The IMU stands over the lane, as high above the smooth road as the scene says."""
    scene = CURVE.changed(vehicle={"heave_m": 0.0, "sway_deg": 0.0})
    earth, surface = Earth(scene.map.crs), Surface(scene, ride=True)
    drive = Drive(scene, 0, earth, surface)
    epochs = drive.start_gps_ns + np.arange(0, 4 * 10**9, 37_000_001)
    driven = drive.driven_m(epochs)
    np.testing.assert_array_equal(drive.epoch_gps_ns(driven), epochs)
    position = drive.poses(epochs).position_ecef_m
    to_map = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS("EPSG:32632").to_3d(), always_xy=True)
    e, n, h = to_map.transform(*position.T)
    above = h - surface.height_m(np.asarray(e), np.asarray(n))
    # 0.95 m along the tilted body: its vertical part, and the slope under its foot, nearly cancel.
    np.testing.assert_allclose(above, 0.95 * np.sqrt(1 + 0.025**2 + 0.02**2), atol=1e-3)
