"""Quaternion poses: the Argoverse drive, CSV, TUM, Feather and Parquet, damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.feather
import pyarrow.parquet
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.log_reading import read_log

NANOSECONDS = Clock(TimeSystem.GPS, unit="ns")
STATED: dict[str, Any] = {"clock": NANOSECONDS, "crs": "local"}
N = 50


def poses() -> pa.Table:
    rotations = Rotation.from_rotvec(np.random.default_rng(7).normal(size=(N, 3)))
    x, y, z, w = rotations.as_quat().T
    stamps = 1_400_000_000_123_456_789 + 5_000_000 * np.arange(N)
    names = ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    columns = (stamps, w, x, y, z, *np.random.default_rng(8).normal(size=(3, N)))
    return pa.table(dict(zip(names, columns, strict=True)))


def write(path: Path, table: pa.Table) -> Path:
    if path.suffix == ".feather":
        pa.feather.write_feather(table, path, chunksize=20)
    elif path.suffix == ".parquet":
        pa.parquet.write_table(table, path, row_group_size=20)
    else:
        pa.csv.write_csv(table, path)
    return path


def test_the_argoverse_drive(recordings: Path) -> None:
    path = recordings / "av2_drive" / "city_SE3_egovehicle.feather"
    assert format_of(path).name == "pose_quaternions"
    log = read_log("pose_quaternions", path, clock=Clock(TimeSystem.UNIX_UTC, unit="ns"), crs="local")
    assert log.attributes == {"world_frame": "local", "stamp": "timestamp_ns", "axes": "flu"}
    assert (log.table.num_rows, log.rejects) == (2706, [])
    given = pa.feather.read_table(path)
    np.testing.assert_array_equal(np.diff(log.epochs), np.diff(given["timestamp_ns"].to_numpy()))
    np.testing.assert_array_equal(log.positions[:, 2], given["tz_m"].to_numpy())
    # 75 m in 15.95 s, forward along the body's x axis, which is what flu says.
    step = log.positions[20:] - log.positions[:-20]
    forward = log.attitudes[:-20].inv().apply(step)
    moving = np.linalg.norm(step, axis=1) > 0.3
    assert np.degrees(np.abs(np.arctan2(forward[moving, 1], forward[moving, 0]))).max() < 5
    assert np.linalg.norm(np.diff(log.positions, axis=0), axis=1).sum() == pytest.approx(75, abs=1)
    # Other tables of the drive have quaternions too, and are no trajectories.
    sniff = format_named("pose_quaternions").sniff
    assert [p.name for p in recordings.rglob("*") if sniff(p)] == ["city_SE3_egovehicle.feather"]


@pytest.mark.parametrize("suffix", [".feather", ".parquet", ".csv"])
def test_containers_hold_the_same(tmp_path: Path, suffix: str) -> None:
    table = poses()
    path = write(tmp_path / f"poses{suffix}", table)
    assert format_of(path).name == "pose_quaternions"
    log = read_log("pose_quaternions", path, {"axes": "frd"}, **STATED)
    np.testing.assert_array_equal(log.epochs, table["timestamp_ns"].to_numpy())
    np.testing.assert_array_equal(log.positions, np.stack([table[f"t{a}_m"] for a in "xyz"], axis=-1))
    given = Rotation.from_quat(np.stack([table[f"q{a}"] for a in "xyzw"], axis=-1))
    assert (log.attitudes * given.inv()).magnitude().max() < 1e-12


def test_tum(tmp_path: Path) -> None:
    table = poses()
    seconds = table["timestamp_ns"].to_numpy() / 1e9
    order = [table[n].to_numpy() for n in ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")]
    path = tmp_path / "groundtruth.txt"
    np.savetxt(path, np.column_stack([seconds, *order]), header="timestamp tx ty tz qx qy qz qw", fmt="%.18g")
    assert format_of(path).name == "pose_quaternions"
    log = read_log("pose_quaternions", path, {"axes": "frd"}, clock=Clock(TimeSystem.GPS), crs="local")
    assert np.abs(log.epochs - table["timestamp_ns"].to_numpy()).max() < 300  # doubles of 1.4e9 s
    given = Rotation.from_quat(np.stack([table[f"q{a}"] for a in "xyzw"], axis=-1))
    assert (log.attitudes * given.inv()).magnitude().max() < 1e-12
    np.testing.assert_allclose(log.positions[:, 1], table["ty_m"].to_numpy(), rtol=1e-15)
    other = tmp_path / "other.txt"
    np.savetxt(other, np.column_stack([seconds, *order]) * 2)
    assert not format_named("pose_quaternions").sniff(other)


def test_names_can_be_stated(tmp_path: Path) -> None:
    table = poses().rename_columns(["t", "w", "qx", "qy", "qz", "px", "y", "z"])
    path = write(tmp_path / "a.csv", table)
    options = {"axes": "flu", "columns": {"stamp": "t", "qw": "w", "tx": "px"}}
    log = read_log("pose_quaternions", path, options, **STATED)
    assert log.table.num_rows == N
    with pytest.raises(FormatError, match="no column holds tx"):
        read_log("pose_quaternions", path, {"axes": "flu", "columns": {"stamp": "t", "qw": "w"}}, **STATED)
    with pytest.raises(ConfigError, match="did you mean 'qw'"):
        read_log("pose_quaternions", path, {"axes": "flu", "columns": {"w": "qw"}}, **STATED)


@pytest.mark.parametrize("suffix", [".feather", ".parquet", ".csv"])
def test_damaged_records_cost_themselves(tmp_path: Path, suffix: str) -> None:
    columns = {name: poses()[name].to_pylist() for name in poses().column_names}
    columns["qw"][3] += 0.1
    columns["qz"][22] = float("nan")
    columns["tx_m"][23] = None
    columns["qx"][30] = 1e200
    columns["timestamp_ns"][40] = -5
    columns["timestamp_ns"][41] = None
    path = write(tmp_path / f"poses{suffix}", pa.table(columns))
    log = read_log("pose_quaternions", path, {"axes": "frd"}, **STATED)
    found = {r.record: r.reason for r in log.rejects}
    assert set(found) == {3, 22, 23, 30, 40, 41}
    assert found[3] == "quaternion is not of length 1 (by over 0.001)"
    assert log.table.num_rows == N - 6
    if suffix != ".csv":
        assert all(r.offset == -1 for r in log.rejects)


def test_a_damaged_container_is_refused_or_loses_a_part(tmp_path: Path) -> None:
    path = write(tmp_path / "a.parquet", poses())
    data = bytearray(path.read_bytes())
    data[100:140] = b"\xff" * 40  # inside the first row group
    path.write_bytes(data)
    log = read_log("pose_quaternions", path, {"axes": "frd"}, **STATED)
    assert log.table.num_rows == N - 20
    assert [(r.record, r.records) for r in log.rejects] == [(0, 20)]
    path.write_bytes(data[:-10])
    with pytest.raises(FormatError, match="damaged"):
        read_log("pose_quaternions", path, {"axes": "frd"}, **STATED)


def test_nothing_is_guessed(tmp_path: Path) -> None:
    path = write(tmp_path / "a.feather", poses())
    with pytest.raises(ConfigError, match="axes of the poses are not stated"):
        read_log("pose_quaternions", path, **STATED)
    with pytest.raises(TimeSystemError, match=r'in ns by its name, the clock says s; .* clock.unit = "ns"'):
        read_log("pose_quaternions", path, {"axes": "frd"}, clock=Clock(TimeSystem.GPS), crs="local")
    words = poses().set_column(1, "qw", pa.array(["a"] * N))
    with pytest.raises(FormatError, match="column 'qw' is string"):
        read_log("pose_quaternions", write(tmp_path / "b.feather", words), {"axes": "frd"}, **STATED)


def test_euroc(tmp_path: Path) -> None:
    # ASL data set format, state_groundtruth_estimate0/data.csv of EuRoC's MH_01: its names, and its first line
    path = tmp_path / "data.csv"
    names = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], ba_z"
    first = "1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876"
    path.write_text(f"{names}\n{first}\n")
    assert format_of(path).name == "pose_quaternions"
    log = read_log("pose_quaternions", path, {"axes": "flu"}, clock=Clock(TimeSystem.UNIX_GPS, unit="ns"), crs="local")
    assert log.epochs[0] == 1403636580838555648 - 315_964_800 * 10**9
    np.testing.assert_array_equal(log.positions[0], [4.688319, -1.786938, 0.783338])
    flu = Rotation.from_quat([-0.153029, -0.827383, -0.082152, 0.534108])  # the body is x forward, y right, z down
    assert (log.attitudes[0] * Rotation.from_euler("x", 180, degrees=True) * flu.inv()).magnitude() < 1e-9


@pytest.mark.parametrize("north", ["grid", "true"])
def test_poses_on_a_grid(tmp_path: Path, north: str) -> None:
    """Easting, northing and height with a quaternion from east, north and up, against pyproj and SciPy."""
    longitude, latitude, height = 11.5, 48.1, 512.25
    easting, northing = pyproj.Proj("EPSG:32632")(longitude, latitude)
    heading = 30.0
    q = Rotation.from_euler("z", 90 - heading, degrees=True).as_quat()  # flu, x forward
    path = tmp_path / "slam.csv"
    rows = "".join(f"{1.4e9 + k},{easting},{northing},{height},{q[0]},{q[1]},{q[2]},{q[3]}\n" for k in range(3))
    path.write_text("time_s,x,y,z,qx,qy,qz,qw\n" + rows)
    stated = {"clock": Clock(TimeSystem.GPS), "crs": "EPSG:32632", "height": "ellipsoidal"}
    with pytest.raises(ConfigError, match="north"):
        read_log("pose_quaternions", path, {"axes": "flu"}, **stated)
    log = read_log("pose_quaternions", path, {"axes": "flu", "heading": north}, **stated)
    place = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(latitude, longitude, height)
    np.testing.assert_allclose(log.positions, [place] * 3, atol=1e-4)
    ned = Rotation.from_euler("ZY", [longitude, -latitude - 90], degrees=True).inv() * log.attitudes
    convergence = pyproj.Proj("EPSG:32632").get_factors(longitude, latitude).meridian_convergence
    expected = heading + (convergence if north == "grid" else 0.0)
    np.testing.assert_allclose(ned.as_euler("ZYX", degrees=True), [[expected, 0, 0]] * 3, atol=1e-6)
