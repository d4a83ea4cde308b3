"""Argoverse 2 sweeps: the recorded drive against the city's ground raster, and damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.ingest.reading.format import LogSource, NoOptions, format_named, format_of
from tests.formats.readings import read

CLOCK = Clock(TimeSystem.UNIX_GPS, unit="ns")
UNIX_OF_GPS_NS = 315_964_800 * 10**9
STAMP = 315_966_265_259_836_000
SMALL = {
    "x": np.array([1.5, -2.0, 30.0, 4.0], np.float16),
    "y": np.array([0.0, 3.0, -7.5, 4.0], np.float16),
    "z": np.array([-0.25, 1.0, 2.0, 4.0], np.float16),
    "intensity": np.array([0, 10, 255, 3], np.uint8),
    "laser_number": np.array([31, 0, 63, 5], np.uint8),
    "offset_ns": np.array([2_654_000, 2_656_303, 106_085_816, 7], np.int32),
}


def write_sweep(folder: Path, stamp: int = STAMP, **columns: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stamp}.feather"
    given = SMALL | columns
    pyarrow.feather.write_feather(pa.table({k: v for k, v in given.items() if v is not None}), str(path))
    return path


def test_a_return_has_its_own_epoch_and_the_sweeps_pose(tmp_path: Path) -> None:
    path = write_sweep(tmp_path)
    assert format_of(path).name == "argoverse"
    log = read("argoverse", path, clock=CLOCK)
    stamp = STAMP - UNIX_OF_GPS_NS
    assert log.epochs.tolist() == (stamp + SMALL["offset_ns"].astype(np.int64)).tolist()
    assert set(log["pose_epoch_gps_ns"].tolist()) == {stamp}
    assert np.array_equal(log.xyz_sensor_m, np.stack([SMALL[a] for a in "xyz"], axis=-1).astype(float))
    assert log["intensity"].tolist() == [0, 2570, 65_535, 771]
    assert log["laser"].tolist() == [31, 0, 63, 5]
    assert log["sweep"].tolist() == [0] * 4


def test_sweeps_are_numbered_in_order_of_time(tmp_path: Path) -> None:
    folder = tmp_path / "sensors" / "lidar"
    for stamp in (STAMP + 10**8, STAMP, STAMP + 2 * 10**8):
        write_sweep(folder, stamp)
    (tmp_path / "city_SE3_egovehicle.feather").write_bytes(b"poses, not a sweep")
    assert format_of(tmp_path).name == format_of(folder).name == "argoverse"
    log = read("argoverse", tmp_path, clock=CLOCK)
    assert np.array_equal(np.unique(log["sweep"]), [0, 1, 2])
    assert (np.diff(log["pose_epoch_gps_ns"]) >= 0).all()
    assert [r.file for r in log.rows] == [f"sensors/lidar/{STAMP + k * 10**8}.feather" for k in range(3)]


def test_recorded_ground_returns_lie_on_the_citys_raster(recordings: Path) -> None:
    """The recording's README: median −0.006 m, MAD 0.026 m within 30 m and ± 0.3 m of the raster."""
    drive = recordings / "av2_drive"
    assert format_of(drive).name == "argoverse"
    log = read("argoverse", drive, clock=CLOCK)
    assert len(log) == 99_229 + 99_466
    assert log.rejects == []
    poses = pyarrow.feather.read_table(drive / "city_SE3_egovehicle.feather").to_pandas().set_index("timestamp_ns")
    raster = np.load(next(drive.glob("map/*ground_height_surface*.npy")))
    errors = []
    for stamp in np.unique(log["pose_epoch_gps_ns"]):
        pose = poses.loc[stamp + UNIX_OF_GPS_NS]
        rows = (log["pose_epoch_gps_ns"] == stamp) & (np.linalg.norm(log.xyz_sensor_m, axis=1) < 30.0)
        turn = Rotation.from_quat(pose[["qx", "qy", "qz", "qw"]].to_numpy())
        city = turn.apply(log.xyz_sensor_m[rows]) + pose[["tx_m", "ty_m", "tz_m"]].to_numpy()
        cell = np.floor(3.3333 * (city[:, :2] + np.array([-5072.400390625, -2283.900390625]))).astype(int)
        inside = ((cell >= 0) & (cell < np.array(raster.shape[::-1]))).all(axis=1)
        errors.append(city[inside, 2] - raster[cell[inside, 1], cell[inside, 0]])
    error = np.concatenate(errors)
    ground = error[np.abs(error) < 0.3]
    assert np.median(ground) == pytest.approx(-0.006, abs=0.002)
    assert np.median(np.abs(ground - np.median(ground))) == pytest.approx(0.026, abs=0.003)


def test_stamps_need_a_clock_in_nanoseconds(tmp_path: Path) -> None:
    path = write_sweep(tmp_path)
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read("argoverse", path)
    with pytest.raises(TimeSystemError, match=r'clock\.unit = "ns"'):
        read("argoverse", path, clock=Clock(TimeSystem.UNIX_GPS))


def test_the_log_says_that_it_is_in_the_vehicles_frame(tmp_path: Path) -> None:
    log_format = format_named("argoverse")
    header = log_format.header(LogSource(write_sweep(tmp_path), NoOptions(), clock=CLOCK))
    assert header.attributes["frame"] == "body"
    mounting = Sensor(kind="lidar").mounted_as(header.attributes["mounting"]).mounting()
    np.testing.assert_array_equal(mounting.arrays()[0], np.diag([1, -1, -1]))  # x forward, y left, z up
    assert mounting.lever_arm_body_m == (0.0, 0.0, 0.0)


def test_damage_costs_its_return_or_its_sweep(tmp_path: Path) -> None:
    x = np.array([np.nan, -2.0, 30.0, 4.0], np.float16)
    laser = pa.array([31, None, 63, 5], pa.uint8())
    write_sweep(tmp_path, STAMP, x=x, laser_number=laser, offset_ns=np.array([0, 0, 2 * 10**9, 7], np.int64))
    write_sweep(tmp_path, STAMP + 1, offset_ns=None)
    (tmp_path / f"{STAMP + 2}.feather").write_bytes(b"ARROW1 cut off")
    write_sweep(tmp_path, STAMP + 3)
    log = read("argoverse", tmp_path, clock=CLOCK)
    assert len(log) == 1 + 4
    first = {(r.record, r.reason) for r in log.rejects if r.file == f"{STAMP}.feather"}
    assert first == {
        (0, "the position is not a number or beyond 10 km"),
        (1, "laser_number is missing"),
        (2, "offset_ns is more than 1 s"),
    }
    assert [r.file for r in log.rejects if r.file != f"{STAMP}.feather"] == [
        f"{STAMP + 1}.feather",
        f"{STAMP + 2}.feather",
    ]


def test_a_single_sweep_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / f"{STAMP}.feather"
    path.write_bytes(b"ARROW1 cut off")
    assert not format_named("argoverse").sniff(path)
    with pytest.raises(FormatError, match="cannot be read"):
        read("argoverse", path, clock=CLOCK)
