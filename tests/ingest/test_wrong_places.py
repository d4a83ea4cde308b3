"""Wrong poses and points through the command line: left out by record and named, and all others placed as they are.

Where readings belong is computed anew, with splines of SciPy through the sound poses and PROJ.
"""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
import pyproj
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, RotationSpline
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.ingest.pose_checks import pose_track
from roadscan.poses.leaps import find_leaps
from tests.surveys import Simulated

Float64 = npt.NDArray[np.float64]
NAMES = ("time_s", "latitude_deg", "longitude_deg", "height_m", "roll_deg", "pitch_deg", "heading_deg")
PER_DEG_M = 111_200.0


@pytest.fixture
def survey(faults: Path, tmp_path: Path) -> Path:
    """201 poses at 100 Hz, of which record 100 lies 1.1 km north, and 800 returns."""
    return copied(faults / "pose_spike", tmp_path / "survey")


def copied(fault: Path, folder: Path) -> Path:
    """A copy of the inputs of a fault that can be written."""
    folder.mkdir()
    for file in fault.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def command(name: str, folder: Path, *more: str) -> dict[str, Any]:
    """What a command says as JSON."""
    done = CliRunner().invoke(app, [name, str(folder / "SURVEY.toml"), "--json", *more], catch_exceptions=False)
    return dict(json.loads(done.stdout))


def poses_of(folder: Path) -> Float64:
    """(n, 7) columns of the trajectory."""
    return np.loadtxt(folder / "t.csv", delimiter=",", skiprows=1)


def write_poses(folder: Path, poses: Float64) -> None:
    """Replace the trajectory."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    writer.writerow(NAMES)
    writer.writerows([[f"{row[0]:.10f}", *(f"{value:.12f}" for value in row[1:])] for row in poses.tolist()])
    (folder / "t.csv").write_text(stream.getvalue())


def mended(folder: Path) -> Float64:
    """Its poses with record 100 between its neighbours, and as they are in the folder from now on."""
    poses = poses_of(folder)
    sound = np.delete(poses, 100, axis=0)
    poses[100, 1:] = CubicSpline(sound[:, 0], sound[:, 1:])(poses[100, 0])
    write_poses(folder, poses)
    return poses


def rejects_of(folder: Path) -> list[tuple[int, str]]:
    """Record and reason of what was left out."""
    table = rs.open_survey(folder / "SURVEY.toml").table("rejects")
    return sorted(zip(table["record"].tolist(), table["reason"].tolist(), strict=True))


def placed_anew(folder: Path, poses: Float64) -> Float64:
    """(n, 3) easting, northing and height of the returns by poses that are sound, in order of time."""
    returns = pq.read_table(folder / "r.parquet").sort_by("epoch_gps_ns")
    t = returns.column("epoch_gps_ns").to_numpy() / 1e9
    first = poses[0, 0]
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    place = np.stack(to_ecef.transform(poses[:, 2], poses[:, 1], poses[:, 3]), axis=-1)
    lat, lon = np.radians(poses[:, 1]), np.radians(poses[:, 2])
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    east = np.stack([-np.sin(lon), np.cos(lon), 0 * lon], axis=-1)
    level = Rotation.from_matrix(np.stack([north, east, np.cross(north, east)], axis=-1))
    body = level * Rotation.from_euler("ZYX", poses[:, [6, 5, 4]], degrees=True)
    seen = np.stack([returns.column(f"{axis}_sensor_m").to_numpy() for axis in "xyz"], axis=-1).astype(np.float64)
    turn = RotationSpline(poses[:, 0] - first, body)(t - first)
    world = CubicSpline(poses[:, 0] - first, place)(t - first) + turn.apply(seen)
    lon_lat_height = np.stack(to_ecef.transform(*world.T, direction="INVERSE"), axis=-1)
    grid = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    return np.column_stack([*grid.transform(lon_lat_height[:, 0], lon_lat_height[:, 1]), lon_lat_height[:, 2]])


def points_of(folder: Path) -> Float64:
    """(n, 3) points of all tiles."""
    paths = sorted((folder / "store").rglob("tiles/las/**/*.la[sz]"))
    return np.concatenate([np.asarray(laspy.read(path).xyz) for path in paths])


@pytest.mark.witness("pose_leap")
@pytest.mark.parametrize(
    ("fault", "reason"), [("pose_spike", "the position leaps"), ("null_island_pose", "there was no fix")]
)
def test_one_wrong_pose_is_left_out_and_readings_lie_where_they_belong(
    faults: Path, tmp_path: Path, fault: str, reason: str
) -> None:
    folder = copied(faults / fault, tmp_path / fault)
    told = command("run", folder, "--workers", "0")
    ((record, why),) = rejects_of(folder)
    assert record == 100 and reason in why
    ((finding),) = [one for one in told["findings"] if one["witness"] == "pose_leap"]
    assert finding["subject"] == "t.csv" and finding["left_out"] == 1 and "record 100" in finding["text"]
    points, poses = points_of(folder), np.delete(poses_of(folder), 100, axis=0)
    truth = placed_anew(folder, poses)
    assert points.shape == truth.shape == (800, 3)
    misses_m, nearest = cKDTree(truth).query(points)
    assert misses_m.max() < 1.5e-4 and len(set(nearest.tolist())) == 800  # 0.1 mm, and half a step of the LAS file
    assert len(list((folder / "store").rglob("tiles/las/**/*.la[sz]"))) == 4
    shown = CliRunner().invoke(app, ["status", str(folder / "SURVEY.toml")], catch_exceptions=False).stdout
    assert why in shown or finding["text"][:40] in shown
    assert why.split(",")[0] in (folder / "store/survey=s/report/report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("seed", "block"), [*((seed, 100_000) for seed in range(8)), *((seed, 60) for seed in range(8))]
)
def test_drawn_bursts_are_left_out_by_record(
    survey: Path, monkeypatch: pytest.MonkeyPatch, seed: int, block: int
) -> None:
    """Poses of a long log are examined in blocks; here also in four."""
    monkeypatch.setattr("roadscan.ingest.pose_checks._BLOCK", block)
    rng = np.random.default_rng(seed)
    poses, count = mended(survey), int(rng.choice([1, 2, 5, 20]))
    at = int(rng.choice([0, 201 - count])) if seed % 2 and count <= 5 else int(rng.integers(25, 150))
    rows, size_m = slice(at, at + count), float(10 ** rng.uniform(-0.4, 4))
    column = int(rng.choice([1, 2, 3, 4, 5, 6]))
    poses[rows, column] += {1: size_m / PER_DEG_M, 2: size_m / PER_DEG_M / 0.66, 3: min(size_m, 9000.0)}.get(
        column, float(rng.uniform(5, 80))
    )
    write_poses(survey, poses)
    told = command("ingest", survey)
    rejects = rejects_of(survey)
    assert [record for record, _ in rejects] == list(range(at, at + count))
    assert all(("attitude" if column >= 4 else "position") in why for _, why in rejects)
    assert sum(one["left_out"] for one in told["findings"] if one["witness"] == "pose_leap") == count


@pytest.mark.witness("pose_step")
def test_a_step_is_named_with_its_size_and_all_poses_stay(survey: Path) -> None:
    poses = mended(survey)
    poses[120:, 1] += 0.5 / PER_DEG_M
    write_poses(survey, poses)
    told = command("ingest", survey)
    (finding,) = [one for one in told["findings"] if one["witness"] == "pose_step"]
    assert "by 0.50 m" in finding["text"] and finding["left_out"] == 0
    assert len(rs.open_survey(survey / "SURVEY.toml").table("trajectory")) == 201


def test_velocities_that_a_log_states_tell_a_smaller_step(survey: Path) -> None:
    """Every twentieth pose, at 5 Hz, with the velocities of a spline through all of them."""
    poses = mended(survey)
    per_degree = np.array([PER_DEG_M, PER_DEG_M * np.cos(np.radians(poses[0, 1])), -1.0])
    stated = (CubicSpline(poses[:, 0], poses[:, 1:4] * per_degree).derivative()(poses[:, 0]))[::20]
    poses = poses[::20]
    poses[6:, 2] += 0.25 / PER_DEG_M / np.cos(np.radians(poses[0, 1]))
    names = ",".join((*NAMES, "velocity_north_m_per_s", "velocity_east_m_per_s", "velocity_down_m_per_s"))
    for columns, named in ((np.column_stack([poses, stated]), True), (poses, False)):
        header = names if named else ",".join(NAMES)
        np.savetxt(survey / "t.csv", columns, fmt="%.12f", delimiter=",", header=header, comments="")
        told = [one["text"] for one in command("ingest", survey)["findings"] if one["witness"] == "pose_step"]
        assert [("by 0.2" in one) for one in told] == [True] * named


@pytest.mark.parametrize("degrees", [9.0, -25.0])
def test_readings_on_both_sides_of_a_step_of_a_thousand_kilometres_are_placed(survey: Path, degrees: float) -> None:
    poses = mended(survey)
    poses[120:, 1] += degrees
    write_poses(survey, poses)
    told = command("run", survey, "--workers", "0")
    ((finding),) = [one for one in told["findings"] if one["witness"] == "pose_step"]
    assert ("by 1,000,5" if degrees > 0 else "by 2,752,0") in finding["text"]
    epochs = np.sort(pq.read_table(survey / "r.parquet").column("epoch_gps_ns").to_numpy() / 1e9)
    sides = [placed_anew(survey, side) for side in (poses[:120], poses[120:])]
    truth = np.concatenate([sides[0][epochs < poses[119, 0]], sides[1][epochs > poses[120, 0]]])
    points = points_of(survey)
    assert len(points) > 740
    assert cKDTree(truth).query(points)[0].max() < 1.5e-4


def test_sound_poses_raise_no_doubt(survey: Path) -> None:
    mended(survey)
    told = command("ingest", survey)
    assert told["findings"] == [] and len(rs.open_survey(survey / "SURVEY.toml").table("trajectory")) == 201


def test_a_first_pose_at_null_island_does_not_place_the_survey(survey: Path) -> None:
    poses = mended(survey)
    poses[:3, 1:4] = 0.0
    write_poses(survey, poses)
    command("ingest", survey)
    assert [record for record, _ in rejects_of(survey)] == [0, 1, 2]


def test_records_keep_their_numbers_behind_a_damaged_one(survey: Path) -> None:
    """A line that is no pose stands before the wrong one."""
    lines = (survey / "t.csv").read_text().splitlines()
    lines[51] = lines[51].replace(",", ",x", 1)
    (survey / "t.csv").write_text("\n".join(lines) + "\n")
    command("ingest", survey)
    assert [record for record, _ in rejects_of(survey)] == [50, 100]


def far_cloud(faults: Path, folder: Path) -> Path:
    """A copy of the cloud with a far point, whose kind of height its survey file states."""
    copied(faults / "las_far_point", folder)
    stated = (folder / "SURVEY.toml").read_text().replace('path = "c.las"', 'path = "c.las"\nheight = "ellipsoidal"')
    (folder / "SURVEY.toml").write_text(stated)
    return folder


@pytest.mark.witness("far_point")
def test_a_point_that_overflowed_is_left_out(faults: Path, tmp_path: Path) -> None:
    folder = far_cloud(faults, tmp_path / "far")
    command("run", folder, "--workers", "0")
    ((_, why),) = rejects_of(folder)
    assert "outside the area" in why
    assert points_of(folder).shape == (799, 3)


@pytest.mark.parametrize("axis", "xy")
def test_far_points_of_a_cloud_are_left_out(faults: Path, tmp_path: Path, axis: str) -> None:
    """Coordinates that did not overflow and lie 9,000 km away."""
    folder = far_cloud(faults, tmp_path / "far")
    cloud = laspy.read(folder / "c.las")
    fine = laspy.LasData(cloud.header, cloud.points.copy())
    fine.header.scales = np.array([0.01, 0.01, 0.01])
    for name in "xyz":
        own = np.array(getattr(cloud, name))
        own[np.abs(own - np.median(own)) > 1e5] = np.median(own)
        own[[5, 6, 300]] += 9.0e6 if name == axis else 0.0
        setattr(fine, name, own)
    fine.write(folder / "c.las")
    command("ingest", folder)
    table = rs.open_survey(folder / "SURVEY.toml").table("rejects")
    assert sorted(zip(table["record"].tolist(), table["records"].tolist(), strict=True)) == [(5, 2), (300, 1)]


@pytest.mark.witness("gnss_no_fix")
def test_a_fix_at_null_island_is_left_out(tmp_path: Path, recordings: Path) -> None:
    """A recording of RTK positions, of which one epoch is put at latitude 0, longitude 0."""
    lines = gzip.decompress((recordings / "drive" / "gnss_rtk.pos.gz").read_bytes()).decode().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("%"))
    words = lines[first + 40].split()
    words[2:5] = ["0.000000000", "0.000000000", "0.0000"]
    lines[first + 40] = "  ".join(words)
    (tmp_path / "g.pos").write_text("\n".join(lines[: first + 200]) + "\n")
    (tmp_path / "SURVEY.toml").write_text(
        'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32613"\n[rig.sensors.antenna]\nkind = "gnss"\n'
        '[[runs]]\nid = "r"\n[[runs.logs]]\npath = "g.pos"\nsensor = "antenna"\ncrs = "EPSG:4979"\n'
    )
    command("ingest", tmp_path)
    ((_, why),) = rejects_of(tmp_path)
    assert "there was no fix" in why


def gnss_survey(recordings: Path, folder: Path, move: Callable[[list[list[str]]], None]) -> Path:
    """400 epochs of a recording of RTK positions, changed."""
    lines = gzip.decompress((recordings / "drive" / "gnss_rtk.pos.gz").read_bytes()).decode().splitlines()
    first = next(k for k, line in enumerate(lines) if not line.startswith("%"))
    words = [line.split() for line in lines[first + 200 : first + 600]]
    move(words)
    (folder / "g.pos").write_text("\n".join([*lines[:first], *("  ".join(one) for one in words)]) + "\n")
    (folder / "SURVEY.toml").write_text(
        'id = "s"\nstore = "store"\n[map]\ncrs = "EPSG:32613"\n[rig.sensors.antenna]\nkind = "gnss"\n'
        '[[runs]]\nid = "r"\n[[runs.logs]]\npath = "g.pos"\nsensor = "antenna"\ncrs = "EPSG:4979"\n'
    )
    return folder


@pytest.mark.witness("gnss_leap")
@pytest.mark.parametrize(("count", "size_m"), [(1, 1.5), (3, 4.0), (1, 300.0)])
def test_gnss_positions_that_leap_are_left_out(tmp_path: Path, recordings: Path, count: int, size_m: float) -> None:
    """An epoch, and three, of a recording at 4 Hz lie elsewhere; its stated σ are kept."""

    def move(words: list[list[str]]) -> None:
        for one in words[150 : 150 + count]:
            one[2] = f"{float(one[2]) + size_m / PER_DEG_M:.9f}"

    told = command("ingest", gnss_survey(recordings, tmp_path, move))
    ((finding),) = told["findings"]
    assert finding["witness"] == "gnss_leap" and finding["left_out"] == count
    table = rs.open_survey(tmp_path / "SURVEY.toml").table("rejects")
    assert int(table["records"].sum()) == count and "leaps away" in table["reason"].iloc[0]


def test_gnss_positions_that_step_are_named_and_all_are_used(tmp_path: Path, recordings: Path) -> None:
    def move(words: list[list[str]]) -> None:
        for one in words[150:]:
            one[2] = f"{float(one[2]) + 3.0 / PER_DEG_M:.9f}"

    told = command("ingest", gnss_survey(recordings, tmp_path, move))
    ((finding),) = told["findings"]
    assert finding["witness"] == "gnss_leap" and finding["left_out"] == 0 and "step by " in finding["text"]
    assert len(rs.open_survey(tmp_path / "SURVEY.toml").table("gnss")) == 400


def test_a_recording_of_gnss_raises_no_doubt(tmp_path: Path, recordings: Path) -> None:
    told = command("ingest", gnss_survey(recordings, tmp_path, lambda _: None))
    assert told["findings"] == [] and len(rs.open_survey(tmp_path / "SURVEY.toml").table("gnss")) == 400


def test_two_sites_far_apart_have_a_report(survey: Path) -> None:
    """A drive whose second half goes on 300 km away after an hour: the way between costs nothing."""
    poses = mended(survey)
    poses[100:, 0] += 20_000.0
    poses[100:, 1] += 2.7
    write_poses(survey, poses)
    returns = pq.read_table(survey / "r.parquet")
    epochs = returns.column("epoch_gps_ns").to_numpy().copy()
    epochs[epochs >= (poses[99, 0] + 0.005) * 1e9] += 20_000 * 10**9
    shutil.copy(survey / "r.parquet", survey / "old.parquet")
    pq.write_table(
        returns.set_column(0, "epoch_gps_ns", [epochs]).replace_schema_metadata(returns.schema.metadata),
        survey / "r.parquet",
    )
    told = command("run", survey, "--workers", "0")
    assert told["findings"] == [] or all(one["witness"] == "no_pose" for one in told["findings"])
    points = points_of(survey)
    assert len(points) > 780 and np.ptp(points[:, 1]) > 2.9e5
    assert "Places to look at" in (survey / "store/survey=s/report/report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_recordings_raise_no_doubt(recordings: Path, tmp_path: Path) -> None:
    """Poses of cars and of a robot, as they were published."""
    robot = tmp_path / "aces.clf"
    robot.write_bytes(bz2.decompress((recordings / "lms" / "aces.clf.bz2").read_bytes()))
    logs = [
        rs.read_log(robot, clock={"system": "free", "offset_s": 1e9}),
        rs.read_log(
            recordings / "av2_drive" / "city_SE3_egovehicle.feather", crs="local", options={"axes": "flu"},
            clock={"system": "free", "unit": "ns", "offset_s": 7e8},
        ),
        rs.read_log(
            recordings / "kitti_drive" / "poses.csv", format="pose_matrices", clock="unix_utc", crs="local",
            options={"axes": "flu"},
        ),
    ]  # fmt: skip
    for name, axes in (("pass1_camera", "flu"), ("pass1_lidar", "flu"), ("pass1_radar", "frd"), ("pass2_lidar", "flu")):
        file = tmp_path / f"{name}.csv"
        file.write_bytes(gzip.decompress((recordings / "two_pass" / f"{name}_poses.csv.gz").read_bytes()))
        unit = "ns" if "radar" in name else "us"
        clock = {"system": "unix_utc", "unit": unit}
        logs.append(rs.read_log(file, clock=clock, crs="EPSG:32617", height="ellipsoidal", options={"axes": axes}))
    for log in logs:
        track = pose_track(log["trajectory"], str(log.attributes["world_frame"]), np.zeros(0, np.int64))
        found = find_leaps(track)
        assert not found.position.any() and not found.attitude.any() and found.steps == (), log.path
        assert found.stalls == (), log.path


@pytest.mark.slow
def test_a_simulated_drive_raises_no_doubt(simulated: Simulated, tmp_path: Path) -> None:
    """Poses of the simulator with their noise, profiles and returns."""
    told = command("ingest", simulated.copy_to(tmp_path / "survey").survey_file.parent)
    assert told["findings"] == []
