"""Poses from a lidar alone: against a drive that is known, in its own bytes again, and what contradicts them."""

from __future__ import annotations

import os
import shutil
import tarfile
from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation, Slerp

from roadscan.core import extras
from roadscan.core.settings.navigation import OdometryConfig
from roadscan.core.survey import Survey
from roadscan.navigation.odometry import Matched, Sweep, Way, Windows, match, sigmas
from roadscan.navigation.tasks.odometry_trajectory import findings
from roadscan.simulate import Scene, simulate
from roadscan.store.logs import read_log_records
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.answers import first_survey, roadscan, spared

pytest.importorskip("kiss_icp")

SEMANTIC = Path(os.environ.get("ROADSCAN_DATA", "../shared/data")).resolve() / "semantic_kitti_00"
BEGIN_NS = 1_400_000_000 * 10**9
SPEED_M_PER_S, SWEEP_S, SWEEPS = 8.0, 0.1, 52
LEVER_BODY_M = np.array([-0.5, 0.1, -1.0])
BODY_FROM_LIDAR = Rotation.from_euler("ZYX", [3.0, 10.0, 0.0], degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
LEANING = (2.0, -1.0)
"""Roll and pitch of the rig (degrees): it is not level when the log begins."""
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
CONFIG = OdometryConfig(voxel_m=1.0, drift_share=0.01, drift_deg_per_100m=0.3)


def rig(seconds: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """True positions (n, 3) and attitudes, forward right down to x y z, on a street that winds along y."""
    heading = 0.1 * np.sin(0.8 * seconds)
    fine = np.arange(-1.0, 8.0, 0.001)
    course = 0.1 * np.sin(0.8 * fine)
    way = np.cumsum(SPEED_M_PER_S * 0.001 * np.stack([np.sin(course), np.cos(course)]), axis=1)
    x, y = (np.interp(seconds, fine, one) - np.interp(0.0, fine, one) for one in way)
    angles = np.column_stack(
        [heading, np.full_like(heading, np.radians(LEANING[1])), np.full_like(heading, np.radians(LEANING[0]))]
    )
    attitude = Rotation.from_matrix(ENU_FROM_NED) * Rotation.from_euler("ZYX", angles)
    return np.column_stack([x, y, np.zeros_like(x)]), attitude


def street(*, bays: bool) -> np.ndarray:
    """Points (n, 3) of the ground and of two fronts; with `bays`, the fronts step back and forth."""
    rng, n = np.random.default_rng(36), 10_000
    y, side = rng.uniform(-30.0, 75.0, n), np.where(rng.random(n) < 0.5, -1.0, 1.0)
    is_back = ((y + 3.0 * side) // 7.0 % 2) * bays
    points = np.column_stack([side * (8.0 + 1.5 * is_back), y, rng.uniform(-1.5, 6.0, n)])
    kind = rng.integers(0, 4, n)
    points[kind == 0] = np.column_stack([rng.uniform(-8.0, 8.0, n), y, np.full(n, -1.5)])[kind == 0]
    if bays:  # the walls that join the fronts
        step = np.round((y + 3.0 * side) / 7.0) * 7.0 - 3.0 * side
        joins = np.column_stack([side * rng.uniform(8.0, 9.5, n), step, points[:, 2]])
        points[kind == 1] = joins[kind == 1]
    return points


STREETS = {bays: street(bays=bays) for bays in (True, False)}


def sweep(number: int, *, bays: bool = True, points: int = 10_000) -> Sweep:
    """One turn of the lidar, each return seen from where the rig is at its time; noise of 1 cm, 25 m far."""
    rng = np.random.default_rng(number)
    at = rig(np.array([number * SWEEP_S]))[0][0]
    seen = STREETS[bays][np.abs(STREETS[bays][:, 1] - at[1]) < 25.0][:points]
    seconds = (number + rng.uniform(0.0, 1.0, len(seen))) * SWEEP_S
    seconds[[0, -1]] = number * SWEEP_S, (number + 1) * SWEEP_S - 1e-6
    position, attitude = rig(seconds)
    body = attitude.inv().apply(seen + 0.01 * rng.standard_normal(seen.shape) - position) - LEVER_BODY_M
    return Sweep(body @ BODY_FROM_LIDAR, BEGIN_NS + np.rint(1e9 * seconds).astype(np.int64))


def imu() -> pd.DataFrame:
    """What an IMU at the reference point measures at 100 Hz."""
    seconds = np.arange(0.0, SWEEPS * SWEEP_S, 0.01)
    (before, _), (at, attitude), (after, later) = rig(seconds - 0.01), rig(seconds), rig(seconds + 0.01)
    force = attitude.inv().apply((after - 2 * at + before) / 0.01**2 + [0.0, 0.0, 9.80665])
    rate = (attitude.inv() * later).as_rotvec() / 0.01
    stamps = {"time_ns": BEGIN_NS + np.rint(1e9 * seconds).astype(np.int64)}
    rates = {f"angular_rate_{a}_rad_per_s": rate[:, i] for i, a in enumerate("xyz")}
    return pd.DataFrame(stamps | rates | {f"specific_force_{a}_m_per_s2": force[:, i] for i, a in enumerate("xyz")})


def survey_of(folder: Path, sweeps: list[Sweep], crs: str = 'local = { name = "nowhere" }') -> Path:
    """A survey of the lidar and the IMU."""
    rows = [
        {"epoch_gps_ns": one.epochs_gps_ns, "sweep": np.full(len(one.xyz_m), k, np.int32)}
        | {f"{a}_sensor_m": one.xyz_m[:, i].astype(np.float32) for i, a in enumerate("xyz")}
        for k, one in enumerate(sweeps)
    ]
    (folder / "logs").mkdir(parents=True)
    table = {name: np.concatenate([one[name] for one in rows]) for name in rows[0]}
    pq.write_table(pa.table(table), folder / "logs/lidar.parquet")
    imu().to_csv(folder / "logs/imu.csv", index=False)
    (folder / "RIG.toml").write_text(
        '[sensors.lidar]\nkind = "lidar"\naxes = "flu"\nboresight = { pitch_deg = 10.0, heading_deg = 3.0 }\n'
        'lever_arm_body_m = [-0.5, 0.1, -1.0]\n\n[sensors.imu]\nkind = "imu"\naxes = "frd"\nimu = "industrial"\n'
    )
    (folder / "SURVEY.toml").write_text(
        f'id = "alone"\nrig = "RIG.toml"\n\n[map]\n{crs}\n\n[navigation.odometry]\nvoxel_m = 1.0\n\n'
        '[tiles]\ncell_m = 0.2\n\n[products]\nmake = ["las"]\n\n[[runs]]\nid = "run"\n\n'
        '[[runs.logs]]\npath = "logs/lidar.parquet"\nformat = "returns_table"\nsensor = "lidar"\n\n'
        '[[runs.logs]]\npath = "logs/imu.csv"\nformat = "imu_csv"\nsensor = "imu"\n'
        'clock = { system = "gps", unit = "ns" }\n'
    )
    return folder / "SURVEY.toml"


@pytest.mark.slow
def test_a_lidar_alone_makes_a_local_map(tmp_path: Path) -> None:
    survey_file = survey_of(tmp_path, [sweep(k) for k in range(SWEEPS)])
    for command in ("ingest", "navigate"):
        done = roadscan(command, survey_file)
        assert done.exit_code == 0, done.output
    assert "no position on Earth" in done.output
    survey = Survey.load(survey_file)
    rows = query(
        Store(survey.store_url, survey.config.id), "SELECT * FROM trajectory ORDER BY epoch_gps_ns"
    ).to_pandas()
    position, attitude = rig((rows.epoch_gps_ns.to_numpy() - BEGIN_NS) / 1e9)
    found = rows[["x_world_m", "y_world_m", "z_world_m"]].to_numpy()
    assert len(rows) == SWEEPS + 1
    assert np.linalg.norm(position[-1]) > 40.0
    turned = attitude * Rotation.from_quat(rows[["qw", "qx", "qy", "qz"]].to_numpy(), scalar_first=True).inv()
    heading, pitch, roll = np.degrees(turned.as_euler("ZYX")).T
    assert np.abs(heading).max() < 0.3  # the first pose looks along y in both
    tilt = np.stack([pitch, roll])
    assert np.abs(tilt).max() < 1.0
    assert np.abs(tilt.mean(axis=1)).max() < 0.4  # level by the accelerometers, though the rig leans by 2°
    off = np.abs(found - position)
    assert off.max() < 0.3
    sigma = rows[["sigma_east_m", "sigma_north_m", "sigma_down_m"]].to_numpy()
    assert (off < 3 * sigma + 0.05).all()


def test_equal_sweeps_give_equal_bits_whatever_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    sweeps = [sweep(k) for k in range(8)]
    once = match(sweeps, CONFIG, 0.5, 60.0)
    monkeypatch.setenv("kiss_icp_mapping", '{"voxel_size": 3.0, "max_points_per_voxel": 1}')
    monkeypatch.setenv("kiss_icp_registration", '{"max_num_iterations": 1}')
    again = match(sweeps, CONFIG, 0.5, 60.0)
    assert once.first_from_lidar.tobytes() == again.first_from_lidar.tobytes()
    steps = np.linalg.norm(np.diff(once.first_from_lidar[:, :3, 3], axis=0), axis=1)
    assert steps == pytest.approx(SPEED_M_PER_S * SWEEP_S, abs=0.08)  # from the first sweep on: its motion is known


def test_a_missing_and_a_thin_sweep_bend_nothing() -> None:
    sweeps = [sweep(k, points=80 if k == 9 else 10_000) for k in range(16) if k not in (6, 7)]
    found = match(sweeps, CONFIG, 0.5, 60.0)
    assert found.thin_gps_ns.size == 1
    assert found.epochs_gps_ns.size == 14  # 13 sweeps with a pose, and the beginning of the first
    position, attitude = rig((found.epochs_gps_ns - BEGIN_NS) / 1e9)
    lidar = position + attitude.apply(LEVER_BODY_M)
    way = (attitude[0] * Rotation.from_matrix(BODY_FROM_LIDAR)).apply(found.first_from_lidar[:, :3, 3]) + lidar[0]
    assert np.linalg.norm(way - lidar, axis=1).max() < 0.12


@pytest.mark.witness("lidar_odometry")
def test_a_street_that_tells_nothing_of_the_way_makes_no_map(tmp_path: Path) -> None:
    survey_file = survey_of(tmp_path, [sweep(k, bays=False) for k in range(12)])
    assert roadscan("ingest", survey_file).exit_code == 0
    done = roadscan("navigate", survey_file)
    assert done.exit_code != 0
    assert "tells nothing of the way along the road, for 100% of the sweeps" in f"{done.output} {done.exception}"


@dataclass(frozen=True)
class Straight:
    """A straight drive of 100 poses at 10 Hz, its sweeps and its IMU, without a fault."""

    way: Way
    matched: Matched
    windows: Windows

    @classmethod
    def drive(cls) -> Straight:
        epochs = BEGIN_NS + 10**8 * np.arange(100)
        position = np.column_stack([np.zeros(100), 1.0 * np.arange(100), np.zeros(100)])
        eye = np.tile(np.eye(4), (100, 1, 1))
        held = np.full(20, 0.15)
        return cls(
            Way(epochs, position, eye[:, :3, :3]),
            Matched(epochs, eye, np.zeros(0, np.int64), epochs[::5], held),
            Windows(epochs[::10], np.tile([0.0, 0.0, 9.8], (9, 1)), np.zeros(9)),
        )

    def said(self, config: OdometryConfig = CONFIG) -> list[str]:
        return [one.text for one in findings("run", self.way, self.matched, self.windows, config, 1.0)]


@pytest.mark.witness("lidar_odometry")
def test_each_contradiction_is_named_with_its_time_and_size() -> None:
    sound = Straight.drive()
    assert sound.said() == []
    held = sound.matched.held.copy()
    held[4:6] = 0.001
    (said,) = replace(sound, matched=replace(sound.matched, held=held)).said()
    assert said.startswith("2 of 20 sweeps that were judged see surfaces that hold them along two directions only")
    thin = replace(sound.matched, thin_gps_ns=sound.way.epochs_gps_ns[[3, 8]] + 5)
    (said,) = replace(sound, matched=thin).said()
    assert said.startswith("2 sweeps have fewer than 100 thinned points")
    (fast,) = sound.said(CONFIG.model_copy(update={"speed_max_m_per_s": 9.0}))
    assert fast.startswith("99 poses can be reached only faster than 9 m/s, worst 10 m/s")
    position = sound.way.position_m.copy()
    position[50:, 0] += 1.2
    leap = replace(sound, way=replace(sound.way, position_m=position)).said()
    assert len(leap) == 1
    assert leap[0].startswith(
        "2 poses leap from the motion before them by more than a vehicle can, worst 1.20 m at 2024-"
    )
    epochs = sound.way.epochs_gps_ns + np.where(np.arange(100) < 30, 0, 3 * 10**9)
    gap = replace(sound, way=replace(sound.way, epochs_gps_ns=epochs)).said()
    assert "1 times there is no sweep for longer than navigation.max_gap_s, worst 3.1 s" in gap[-1]
    turn = sound.windows.turn_rad.copy()
    turn[3] = np.radians(4.0)
    (said,) = replace(sound, windows=replace(sound.windows, turn_rad=turn)).said()
    assert said.startswith("1 of 9 times the IMU turns otherwise than the poses within 5 s, worst by 4.0°")
    up = sound.windows.up_world.copy()
    up[6, 0] = 9.8 * np.tan(np.radians(5.0))
    (said,) = replace(sound, windows=replace(sound.windows, up_world=up)).said()
    assert said.startswith("1 of 9 times gravity points elsewhere than on average, worst by 4.4°")


def test_sigma_grows_with_the_way_and_by_speed_where_nothing_holds() -> None:
    way = Straight.drive().way
    held = np.ones(100, bool)
    sigma_m, sigma_rad = sigmas(way, held, CONFIG, 0.01, is_unbent=False)
    assert sigma_m[-1] == pytest.approx([0.99, 0.99, 1.4], abs=0.02)  # 1 % of 99 m; and 0.01 rad of tilt of it
    assert np.degrees(sigma_rad[-1, 2]) == pytest.approx(0.31, abs=0.01)
    held[40:50] = False
    guessed, _ = sigmas(way, held, CONFIG, 0.01, is_unbent=True)
    assert guessed[-1, 0] == pytest.approx(np.hypot(0.99, 10.0), abs=0.05)  # 1 s at 10 m/s


def test_the_package_and_the_map_are_asked_for_before_a_log_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey_file = survey_of(tmp_path, [sweep(k) for k in range(2)], crs='crs = "EPSG:25832"')
    monkeypatch.setattr(extras, "is_installed", lambda module: not module.startswith("kiss_icp"))
    done = roadscan("run", survey_file, "--workers", "0")
    said = " ".join(f"{done.output} {done.exception}".split())
    assert done.exit_code != 0
    assert 'the section [navigation.odometry] needs the package kiss-icp; pip install "roadscan[odometry]"' in said
    assert "poses are in the local frame, the map is 'EPSG:25832'" in said
    survey = Survey.load(survey_file)
    assert not read_log_records(Store(survey.store_url, survey.config.id))


TOWN = {
    "facades": [
        {"offset_m": side * 9.2, "start_m": first, "end_m": last, "height_m": 10.0}
        for side, first, last in ((-1, -44.0, 70.0), (-1, 82.0, 160.0), (1, -44.0, 30.0), (1, 45.0, 160.0))
    ],
    "trees": [{"station_m": 6.0, "offset_m": 7.6, "every_m": 15.0, "count": 9}],
    "parked_cars": [{"station_m": 10.0, "offset_m": 5.8, "every_m": 12.4, "count": 9}],
}


@pytest.mark.nightly
def test_a_bag_without_gnss_drifts_no_more_than_it_says(tmp_path: Path) -> None:
    """120 m of a street with fronts, trees and cars: from the bag, by the questions of `roadscan init`, to a LAS."""
    scene = Scene.load("low_cost_rig").changed(
        length_m=120.0, roadside=TOWN, lidar={"model": "XT32", "range_max_m": 60.0}, gnss={"on": False, "gaps": []},
        passes=[{"lane": 2}],
    )  # fmt: skip
    made = simulate(scene, tmp_path / "simulated")
    (tmp_path / "logs").mkdir()
    shutil.copytree(made.folder / "raw/run-1/rig", tmp_path / "logs/rig")
    survey_file, _ = first_survey(tmp_path / "logs")
    clock = 'clock = { system = "unix_utc", unit = "ns" }'
    for file in (survey_file, survey_file.parent / "RIG.toml"):
        lines = file.read_text().replace('#? imu = "????"', 'imu = "mems"').splitlines()
        file.write_text("\n".join(clock if one.startswith("#? clock") else one.removeprefix("#? ") for one in lines))
    spared(survey_file)
    done = roadscan("run", survey_file, "--workers", "0")
    assert done.exit_code == 0, done.output
    survey = Survey.load(survey_file)
    store = Store(survey.store_url, survey.config.id)
    own = query(store, "SELECT * FROM trajectory ORDER BY epoch_gps_ns").to_pandas()
    true = pq.read_table(made.folder / "truth/trajectory/run-1.parquet").to_pandas()
    shift_percent, turn_deg = drift(own, true, 50.0)
    assert shift_percent < 3.0
    assert turn_deg < 3.0
    tiles = [file for file in store.files("tiles/las") if file.endswith((".las", ".laz"))]
    with laspy.open(store.path(tiles[0])) as made_tile:
        crs = made_tile.header.vlrs[0].string
    assert "LOCAL_CS" in crs
    assert "no position on Earth" in crs


@pytest.mark.nightly
@pytest.mark.skipif(not SEMANTIC.is_dir(), reason="ROADSCAN_DATA holds no semantic_kitti_00")
def test_a_recorded_street_against_poses_of_another_program(tmp_path: Path) -> None:
    """Eight sweeps of KITTI 00; the recording's poses are those of another registration of the same sweeps."""
    with tarfile.open(SEMANTIC / "sweeps.tar.xz") as packed:
        packed.extractall(tmp_path, filter="data")
    (tmp_path / "RIG.toml").write_text('[sensors.velodyne]\nkind = "lidar"\naxes = "flu"\nrange_min_m = 3.0\n')
    (tmp_path / "SURVEY.toml").write_text(
        'id = "street"\nrig = "RIG.toml"\n\n[map]\nlocal = {}\n\n[navigation.odometry]\n\n[[runs]]\nid = "run"\n\n'
        f'[[runs.logs]]\npath = "."\nformat = "kitti"\nsensor = "velodyne"\noptions.turn = "compensated"\n'
        f'options.stamps = "{SEMANTIC / "poses.csv"}"\noptions.stamp_column = "unix_utc_s"\n'
        'clock = { system = "unix_utc", unit = "s" }\n'
    )
    for command in ("ingest", "navigate"):
        done = roadscan(command, tmp_path / "SURVEY.toml")
        assert done.exit_code == 0, done.output
    survey = Survey.load(tmp_path / "SURVEY.toml")
    own = query(Store(survey.store_url, survey.config.id), "SELECT * FROM trajectory ORDER BY epoch_gps_ns").to_pandas()
    table = pd.read_csv(SEMANTIC / "poses.csv")
    body = table[[f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]].to_numpy().reshape(-1, 3, 3) @ np.diag([1, -1, -1])
    true = pd.DataFrame({f"{a}_world_m": table[f"t{i + 1}"] for i, a in enumerate("xyz")}).assign(
        epoch_gps_ns=np.rint((table.unix_utc_s - 315_964_800 + 15) * 1e9).astype(np.int64),
        **dict(zip(("qw", "qx", "qy", "qz"), Rotation.from_matrix(body).as_quat(scalar_first=True).T, strict=True)),
    )
    shift_percent, turn_deg = drift(own, true, 3.0)
    assert shift_percent < 0.2
    assert turn_deg < 0.5


def drift(own: pd.DataFrame, true: pd.DataFrame, length_m: float) -> tuple[float, float]:
    """Mean error of the displacement over pieces of a length (%), and of the turn over 100 m (°), in the rig's axes."""
    inside = (own.epoch_gps_ns >= true.epoch_gps_ns.iloc[0]) & (own.epoch_gps_ns <= true.epoch_gps_ns.iloc[-1])
    own = own[inside]
    begin = true.epoch_gps_ns.iloc[0]
    seconds, at = (true.epoch_gps_ns - begin) / 1e9, (own.epoch_gps_ns - begin) / 1e9
    axes, turn = ["x_world_m", "y_world_m", "z_world_m"], ["qw", "qx", "qy", "qz"]
    known = np.column_stack([np.interp(at, seconds, true[a]) for a in axes])
    known_turn = Slerp(seconds, Rotation.from_quat(true[turn].to_numpy(), scalar_first=True))(at)
    found, found_turn = own[axes].to_numpy(), Rotation.from_quat(own[turn].to_numpy(), scalar_first=True)
    path = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1)))
    shifts, turns = [], []
    for i, j in enumerate(np.searchsorted(path, path + length_m)):
        if j < len(path):
            one, other = (r[i].inv().apply(p[j] - p[i]) for r, p in ((known_turn, known), (found_turn, found)))
            shifts.append(100 * np.linalg.norm(one - other) / length_m)
            relative = (known_turn[i].inv() * known_turn[j]).inv() * (found_turn[i].inv() * found_turn[j])
            turns.append(np.degrees(relative.magnitude()) * 100 / length_m)
    return float(np.mean(shifts)), float(np.mean(turns))


def test_init_proposes_a_local_map_as_a_question(tmp_path: Path) -> None:
    survey_of(tmp_path, [sweep(k) for k in range(2)])
    done = roadscan("init", tmp_path / "logs", "--out", tmp_path / "first/SURVEY.toml")
    assert done.exit_code == 0, done.output
    text = (tmp_path / "first/SURVEY.toml").read_text()
    assert '\n#? local = { name = "local, no position on Earth" }\n' in text
    assert '\n[navigation.odometry]\n#? lidar = "lidar"\n' in text
