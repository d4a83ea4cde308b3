"""Writers of arrays, and the tables they write: what went in comes back, what is not stated is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.arrays import Quaternions, write_profiles, write_returns, write_trajectory
from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import read_log
from tests.formats.readings import read

EPOCHS = 1_461_922_218_000_000_000 + np.arange(50) * 10_000_000
POSES = {
    "epoch_gps_ns": EPOCHS, "longitude_deg": 10.0 + 1e-6 * np.arange(50), "latitude_deg": np.full(50, 50.0),
    "height_m": np.linspace(100, 101, 50), "roll_deg": np.zeros(50), "pitch_deg": np.ones(50),
    "heading_deg": np.full(50, 359.0),
}  # fmt: skip
ACROSS = np.linspace(-1.0, 1.0, 21)


def poses(**changes: Any) -> dict[str, Any]:
    """Poses with some columns changed; None leaves one out."""
    return {name: values for name, values in (POSES | changes).items() if values is not None}


def heights(scale_m: float = 0.1) -> np.ndarray:
    return -1.5 + scale_m * np.random.default_rng(3).random((50, 21))


# --- trajectories ---------------------------------------------------------------------------------


def test_a_table_gives_the_poses_of_the_same_text(tmp_path: Path) -> None:
    table = poses(sigma_north_m=np.full(50, 0.02), sigma_heading_deg=np.full(50, 0.3))
    written = write_trajectory(table, tmp_path / "poses.parquet", "EPSG:4937")
    assert (written.rows, written.first_epoch_gps_ns, written.last_epoch_gps_ns) == (50, EPOCHS[0], EPOCHS[-1])
    pd.DataFrame(table).rename(columns={"epoch_gps_ns": "time_ns"}).to_csv(tmp_path / "poses.csv", index=False)
    assert format_of(tmp_path / "poses.parquet").name == "trajectory_table"
    one = read_log("trajectory_table", tmp_path / "poses.parquet")
    other = read_log("trajectory_csv", tmp_path / "poses.csv", crs="EPSG:4937", clock=Clock(TimeSystem.GPS, unit="ns"))
    assert one.attributes["world_frame"] == other.attributes["world_frame"]
    assert np.array_equal(one.epochs, EPOCHS)
    assert np.abs(one.positions - other.positions).max() < 1e-8
    assert (one.attitudes.inv() * other.attitudes).magnitude().max() < 1e-12
    for sigma in ("sigma_north_m", "sigma_heading_deg"):
        assert np.allclose(one.column(sigma), other.column(sigma), rtol=1e-6)


@pytest.mark.parametrize("suffix", ["parquet", "feather"])
def test_a_table_of_another_program(tmp_path: Path, suffix: str) -> None:
    """Other names, degrees, UTC timestamps, a column of words: stated in the survey file."""
    frame = pd.DataFrame(poses(epoch_gps_ns=None, latitude_deg=None, Lat=np.full(50, 50.0), note=["x"] * 50))
    frame["time"] = pd.date_range("2026-05-04T09:30:00Z", periods=50, freq="10ms")
    file = tmp_path / f"poses.{suffix}"
    frame.to_parquet(file) if suffix == "parquet" else frame.to_feather(file)
    log = read_log("trajectory_table", file, {"columns": {"latitude": {"name": "Lat", "unit": "deg"}}}, crs="EPSG:4937")
    # 2026-05-04T09:30:00Z is 1777887000 POSIX seconds; GPS counts from 315964800 and is 18 s ahead.
    assert log.epochs[0] == (1_777_887_000 - 315_964_800 + 18) * 10**9
    assert np.diff(log.epochs).tolist() == [10_000_000] * 49


def test_what_file_and_survey_say_has_to_agree(tmp_path: Path) -> None:
    file = tmp_path / "poses.parquet"
    write_trajectory(poses(), file, "EPSG:4937", height="orthometric")
    with pytest.raises(CrsError, match=r"heights are orthometric by the file's metadata.*says ellipsoidal"):
        read_log("trajectory_table", file, height="ellipsoidal")
    with pytest.raises(CrsError, match="positions are in EPSG:4326"):
        read_log("trajectory_table", file, crs="EPSG:4326", height="orthometric")
    write_trajectory(poses(), file, "EPSG:4937")
    with pytest.raises(ConfigError, match="a clock is stated"):
        read_log("trajectory_table", file, clock=Clock(TimeSystem.GPS))


@pytest.mark.parametrize(
    ("changes", "given", "error", "says"),
    [
        ({"roll_deg": None, "roll": np.zeros(50)}, {}, FormatError, "column 'roll' says no unit"),
        ({"epoch_gps_ns": None, "time_s": EPOCHS / 1e9}, {}, TimeSystemError, "time system is not stated"),
        ({"epoch_gps_ns": EPOCHS // 10**9}, {}, TimeSystemError, "no GPS nanoseconds"),
        ({"epoch_gps_ns": None, "time": pd.date_range("2026", periods=50)}, {}, TimeSystemError, "without a zone"),
        ({"pitch_deg": np.append(np.nan, np.zeros(49))}, {}, ConfigError, "no number in row 0"),
        ({"pitch_deg": np.zeros(49)}, {}, ConfigError, r"'pitch_deg' has the shape \(49,\)"),
        ({}, {"heading": "grid"}, ConfigError, "no such north"),
        ({}, {"crs": "EPSG:25832"}, FormatError, "no column holds the easting"),
        ({"qw": np.ones(50), "qx": np.ones(50), "qy": np.zeros(50), "qz": np.zeros(50)},
         {"quaternions": Quaternions("level", "frd")}, ConfigError, "not of length 1"),
        ({"qw": np.ones(50), "qx": np.zeros(50), "qy": np.zeros(50), "qz": np.zeros(50)},
         {"quaternions": Quaternions("world", "frd")}, ConfigError, "no three straight ones"),
    ],
)  # fmt: skip
def test_poses_that_do_not_say_what_they_are(
    tmp_path: Path, changes: dict[str, Any], given: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        write_trajectory(poses(**changes), tmp_path / "poses.parquet", **({"crs": "EPSG:4937"} | given))
    assert not list(tmp_path.iterdir())


def test_a_projected_heading_needs_its_north(tmp_path: Path) -> None:
    table = poses(longitude_deg=None, latitude_deg=None, easting_m=np.full(50, 5e5), northing_m=np.full(50, 5.3e6))
    with pytest.raises(ConfigError, match="the north that headings count from"):
        write_trajectory(table, tmp_path / "poses.parquet", "EPSG:25832")


# --- profiles -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale_m", "quantum_m"), [(0.1, 2e-6), (6.0e-1, 1e-5), (7.0, 2e-4)])
def test_heights_come_back_within_half_a_quantum(tmp_path: Path, scale_m: float, quantum_m: float) -> None:
    given = heights(scale_m)
    given[7, 3] = np.nan
    light = np.arange(50 * 21).reshape(50, 21) % 256
    written = write_profiles(tmp_path / "p", EPOCHS, given, ACROSS, intensity=light, sensor_height_m=6.0)
    assert written.quantum_m == pytest.approx(quantum_m)
    log = read("scans", tmp_path / "p")
    geometry = log.attributes["scan_geometry"]
    raw = log.table.column("range").combine_chunks().flatten().to_numpy().reshape(50, 21)
    ranges = geometry["range_offset_m"] + geometry["range_step_m"] * raw
    assert np.array_equal(raw == 0, np.isnan(given))
    errors = np.abs((6.0 - ranges) - given)[raw > 0]
    assert errors.max() == pytest.approx(written.largest_error_m, rel=1e-6)
    assert errors.max() <= quantum_m / 2 * (1 + 1e-9)
    assert errors.max() > quantum_m / 4
    assert np.allclose(geometry["first"] + geometry["step"] * np.arange(21), ACROSS, atol=1e-12)
    assert np.array_equal(log.table.column("intensity").combine_chunks().flatten().to_numpy(), light.ravel())
    assert np.array_equal(log.epochs, EPOCHS)


def test_files_of_one_log_share_a_geometry(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    first = write_profiles(tmp_path / "log" / "1.parquet", EPOCHS, heights(), ACROSS, quantum=1e-5)
    later = EPOCHS + 10**9
    write_profiles(tmp_path / "log" / "2.parquet", later, heights() + 0.02, ACROSS, quantum=first.geometry)
    assert np.array_equal(read("scans", tmp_path / "log").epochs, np.concatenate([EPOCHS, later]))
    with pytest.raises(ConfigError, match="do not fit into 65,535 steps"):
        write_profiles(tmp_path / "log" / "3.parquet", later, heights() - 3.0, ACROSS, quantum=first.geometry)
    with pytest.raises(ConfigError, match="across_m differs"):
        write_profiles(tmp_path / "log" / "3.parquet", later, heights(), ACROSS + 0.1, quantum=first.geometry)
    assert len(list((tmp_path / "log").iterdir())) == 2


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"quantum": 1e-6}, "do not fit into 65,535 steps"),
        ({"sensor_height_m": -1.45}, "above the sensor's origin"),
        ({"across_m": ACROSS**3}, "not evenly spaced"),
        ({"heights_m": heights()[:, :20]}, r"shape \(50, 20\)"),
        ({"heights_m": np.full((50, 21), np.nan)}, "no reading"),
        ({"heights_m": np.full((50, 21), -np.inf)}, "infinite"),
        ({"intensity": np.full((50, 21), 256)}, "intensity holds 256"),
        ({"quantum": 0.0}, "quantum is 0"),
    ],
)
def test_profiles_that_cannot_be_written(tmp_path: Path, given: dict[str, Any], says: str) -> None:
    stated = {"epochs": EPOCHS, "heights_m": heights(), "across_m": ACROSS} | given
    with pytest.raises(ConfigError, match=says):
        write_profiles(tmp_path / "p.parquet", **stated)
    assert not list(tmp_path.iterdir())


# --- returns --------------------------------------------------------------------------------------


def test_returns_come_back(tmp_path: Path) -> None:
    xyz = np.random.default_rng(5).uniform(-40, 40, (50, 3))
    xyz[9, 1] = np.nan
    stamps = (EPOCHS - 1_461_888_000_000_000_000) / 1e6 + 0.0  # ms of the GPS week 2417, which begins there
    clock = {"system": "gps_week_seconds", "unit": "ms", "week": 1_461_888_000 // 604_800}
    stamps = stamps + 1_461_888_000 % 604_800 * 1e3
    write_returns(tmp_path / "r.parquet", stamps, xyz, intensity=np.arange(50), sweep=np.arange(50), clock=clock)
    assert format_of(tmp_path / "r.parquet").name == "returns_table"
    log, kept = read("returns_table", tmp_path / "r.parquet"), np.delete(np.arange(50), 9)
    assert np.abs(log.epochs - EPOCHS[kept]).max() < 1_000
    assert np.array_equal(log["pose_epoch_gps_ns"], log.epochs)
    assert np.abs(log.xyz_sensor_m - xyz[kept]).max() < 2e-6
    assert np.array_equal(log["intensity"], kept)
    assert np.array_equal(log["sweep"], kept)
    assert not log["laser"].any()


def test_returns_of_a_compensated_sweep(tmp_path: Path) -> None:
    """A folder of tables, each with the epoch of its pose."""
    columns = {"epoch_gps_ns": EPOCHS, "pose_epoch_gps_ns": np.full(50, EPOCHS[25]), "x_sensor_m": np.ones(50)}
    columns |= {"y_sensor_m": np.zeros(50, np.float32), "z_sensor_m": np.append(np.nan, np.zeros(49))}
    (tmp_path / "log").mkdir()
    for k in range(2):
        pq.write_table(pa.table(columns), tmp_path / "log" / f"{k}.parquet")
    assert format_of(tmp_path / "log").name == "returns_table"
    log = read("returns_table", tmp_path / "log")
    assert set(log["pose_epoch_gps_ns"]) == {EPOCHS[25]}
    assert [(r.reason, r.records, r.file) for r in log.rejects] == [
        ("z_sensor_m is missing or not a number", 1, f"{k}.parquet") for k in range(2)
    ]


def test_returns_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected \(50, 3\)"):
        write_returns(tmp_path / "r.parquet", EPOCHS, np.zeros((50, 2)))
    with pytest.raises(ConfigError, match="within 1,000 m"):
        write_returns(tmp_path / "r.parquet", EPOCHS, np.full((50, 3), 5e6))
    with pytest.raises(ConfigError, match=r"laser holds 0\.5"):
        write_returns(tmp_path / "r.parquet", EPOCHS, np.zeros((50, 3)), laser=np.full(50, 0.5))
    assert not list(tmp_path.iterdir())
