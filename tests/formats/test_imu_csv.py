"""IMU readings as CSV: units, increments, signs, damage; a real drive."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import ConfigError, FormatError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.ingest.reading.format import format_of
from tests.formats.log_reading import GPS_SECONDS, Log, read_log

NAMES = "time_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_g,acc_y_g,acc_z_g,temperature_deg_c"
IMU = Sensor(kind="imu")
STATED: dict[str, Any] = {"clock": GPS_SECONDS, "sensor": IMU}
RATES = [f"angular_rate_{a}_rad_per_s" for a in "xyz"]
FORCES = [f"specific_force_{a}_m_per_s2" for a in "xyz"]


def sample(records: int = 6) -> bytes:
    """A small valid log."""
    lines = [f"{1_400_000_000 + i}.25,{i},-2,180,0.5,-1,{i},21.5" for i in range(records)]
    return "\n".join([NAMES, *lines, ""]).encode()


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def rates(log: Log) -> np.ndarray:
    """(n, 3) rad/s."""
    return np.stack([log.column(name) for name in RATES], axis=-1)


def forces(log: Log) -> np.ndarray:
    """(n, 3) m/s²."""
    return np.stack([log.column(name) for name in FORCES], axis=-1)


def test_units_stand_in_the_names(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    path.write_bytes(sample())
    assert format_of(path).name == "imu_csv"
    log = read_log("imu_csv", path, **STATED)
    assert log.rejects == []
    np.testing.assert_array_equal(log.epochs, [(1_400_000_000 + i) * 10**9 + 250_000_000 for i in range(6)])
    np.testing.assert_allclose(rates(log)[3], [math.radians(3), math.radians(-2), math.pi], rtol=1e-15)
    np.testing.assert_allclose(forces(log)[3], [4.903325, -9.80665, 29.41995], rtol=1e-15)
    assert log.column("temperature_deg_c").tolist() == [21.5] * 6


def test_other_names_units_and_layout(tmp_path: Path) -> None:
    path = tmp_path / "imu.txt.gz"
    text = (
        "% made by nobody\nStempel;ax;ay;az;wx;wy;wz\n"
        "2026-05-04T09:30:00.125Z;1000;-2000;500;3600;-7200;0\n2026-05-04T09:30:00.135Z;0;0;1000;0;0;0\n"
    )
    path.write_bytes(gzip.compress(text.encode()))
    options: dict[str, Any] = {"comment": "%", "rate_unit": "deg_per_h", "force_unit": "mg"}
    options["columns"] = {"time": {"name": "Stempel"}}
    log = read_log("imu_csv", path, options, sensor=IMU)
    np.testing.assert_allclose(rates(log)[0], np.radians([1.0, -2.0, 0.0]), rtol=1e-15)
    np.testing.assert_allclose(forces(log)[0], [9.80665, -19.6133, 4.903325], rtol=1e-15)
    # 2026-05-04T09:30:00Z is 1,777,887,000 s of POSIX time; GPS is 18 s ahead of UTC and begins at 315,964,800.
    np.testing.assert_array_equal(
        log.epochs, [(1_777_887_000 - 315_964_800 + 18) * 10**9 + n * 10**6 for n in (125, 135)]
    )
    assert log.table["temperature_deg_c"].null_count == 2
    options["columns"] |= {f"angular_rate_{axis}": {"name": f"w{axis}"} for axis in "xyz"}
    again = read_log("imu_csv", path, options, sensor=IMU)
    assert again.table.equals(log.table)


def test_increments_are_divided_by_the_interval(tmp_path: Path) -> None:
    names = "time_s," + ",".join(
        [f"delta_angle_{a}_arcsec" for a in "xyz"] + [f"delta_velocity_{a}_m_per_s" for a in "xyz"]
    )
    path = write(tmp_path / "a.csv", names, "1400000000,206.264806247,0,-20.6264806247,0.049,0,0.0098")
    assert format_of(path).name == "imu_csv"
    with pytest.raises(ConfigError, match=r"increments \(delta_angle\).*interval_s"):
        read_log("imu_csv", path, **STATED)
    log = read_log("imu_csv", path, {"interval_s": 0.005}, **STATED)
    np.testing.assert_allclose(rates(log)[0], [0.2, 0, -0.02], rtol=1e-9)  # 206.26 arcseconds are a milliradian
    np.testing.assert_allclose(forces(log)[0], [9.8, 0, 1.96], rtol=1e-12)
    turned = read_log("imu_csv", path, {"interval_s": 0.005, "reads_gravity": True}, **STATED)
    np.testing.assert_allclose(forces(turned), -forces(log))
    np.testing.assert_allclose(rates(turned), rates(log))


TAI_NS = Clock(TimeSystem.UNIX_TAI, unit="ns")
PLAIN = "time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"


@pytest.mark.parametrize(
    ("names", "options", "stated", "error", "message"),
    [
        (PLAIN, {"force_unit": "g"}, STATED, ConfigError, r"'gyro_x'.*no unit.*rate_unit.*rad_per_s.*deg_per_h"),
        (PLAIN, {"rate_unit": "rad_per_s"}, STATED, ConfigError, r"'acc_x'.*no unit.*force_unit.*m_per_s2.*mg"),
        (PLAIN, {"rate_unit": "deg", "force_unit": "g"}, STATED, ConfigError, r"'deg'.*is no unit of angular_rate_x"),
        (NAMES, {"rate_unit": "rad_per_s"}, STATED, ConfigError, r"'gyro_x_deg_s'.*is in deg_s"),
        (NAMES, {"columns": {"gyro": {"name": "a"}}}, STATED, ConfigError, "unknown quantity 'gyro'"),
        (NAMES.replace("acc_y_g", "acc_y"), {}, STATED, ConfigError, "'acc_y'.*no unit"),
        (NAMES.replace("acc_y_g", "other"), {}, STATED, FormatError, "no column holds the specific_force_y"),
        (NAMES, {}, {"clock": GPS_SECONDS}, ConfigError, "names no sensor"),
        (NAMES, {}, STATED | {"sensor": Sensor(kind="lidar")}, ConfigError, "kind lidar.*of kind imu"),
        (NAMES, {}, {"sensor": IMU}, TimeSystemError, "time system is not stated"),
        (NAMES, {}, STATED | {"clock": Clock(TimeSystem.GPS, unit="ms")}, TimeSystemError, "in s by its name"),
        (NAMES.replace("time_s", "time"), {}, STATED | {"clock": TAI_NS}, TimeSystemError, "as 's' it would fit"),
    ],
)  # fmt: skip
def test_what_is_not_stated_is_asked_for(
    tmp_path: Path,
    names: str,
    options: dict[str, Any],
    stated: dict[str, Any],
    error: type[RoadscanError],
    message: str,
) -> None:
    count = len(names.split(","))
    path = write(tmp_path / "a.csv", names, ",".join(["1400000000", *["1"] * (count - 1)]))
    with pytest.raises(error, match=message) as caught:
        read_log("imu_csv", path, options, **stated)
    assert caught.value.file == str(path)


def test_a_damaged_record_costs_itself(tmp_path: Path) -> None:
    lines = sample(8).decode().splitlines()
    lines[3] = lines[3].replace("180", "x")  # record 2: no number
    lines[5] = lines[5].replace("180", "1e6")  # record 4: faster than any sensor turns
    lines[6] = lines[6].replace("0.5", "")  # record 5: nothing
    lines[7] = lines[7].replace("21.5", "")  # record 6: no temperature, which is none too few
    path = write(tmp_path / "a.csv", *lines)
    log = read_log("imu_csv", path, **STATED)
    assert log.epochs.tolist() == [(1_400_000_000 + i) * 10**9 + 250_000_000 for i in (0, 1, 3, 6, 7)]
    assert log.column("temperature_deg_c")[3] != log.column("temperature_deg_c")[3]
    starts = np.cumsum([0, *(len(line) + 1 for line in lines)])
    found = {r.record: (r.offset, r.reason) for r in log.rejects}
    assert {record: offset for record, (offset, _) in found.items()} == {k: starts[k + 1] for k in (2, 4, 5)}
    assert "'x' is not a number" in found[2][1]
    assert found[4][1] == "angular_rate_z is outside -200 to 200 rad/s"
    assert found[5][1] == "specific_force_x is missing or not a number"


def test_a_cut_off_file_keeps_its_whole_records(tmp_path: Path) -> None:
    packed = gzip.compress(sample(2_000), mtime=0)
    path = tmp_path / "a.csv.gz"
    path.write_bytes(packed[: len(packed) // 2])
    log = read_log("imu_csv", path, **STATED)
    assert 100 < log.table.num_rows < 2_000
    assert "compressed file is damaged" in log.rejects[-1].reason


def test_a_table_of_poses_is_none_of_an_imu(tmp_path: Path) -> None:
    names = NAMES + ",latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
    path = write(tmp_path / "a.csv", names, "1400000000,0,0,0,0,0,1,20,50,10,100,0,0,0")
    assert format_of(path).name == "trajectory_csv"


def test_the_recorded_drive(recordings: Path) -> None:
    path = recordings / "drive" / "imu.csv.gz"
    assert format_of(path).name == "imu_csv"
    log = read_log("imu_csv", path, clock=Clock(TimeSystem.UNIX_GPS), sensor=IMU)
    with gzip.open(path, "rt") as stream:
        table = np.loadtxt(stream, delimiter=",", skiprows=1)
    assert log.rejects == []
    assert table.shape == (54_858, 7)
    # A stamp has tenths of milliseconds, so rounding to microseconds undoes the float's own rounding.
    stamps_us = np.rint(table[:, 0] * 1e6).astype(np.int64) - 315_964_800 * 10**6
    np.testing.assert_allclose(log.epochs, stamps_us * 1000, rtol=0, atol=300)
    np.testing.assert_allclose(rates(log), np.radians(table[:, 4:7]), rtol=1e-14)
    np.testing.assert_allclose(forces(log), table[:, 1:4] * 9.80665, rtol=1e-14)
    assert (log.epochs[-1] - log.epochs[0]) / 1e9 == pytest.approx(549, abs=1)
    standing = np.linalg.norm(forces(log)[:2_000], axis=1)  # before it drives off
    assert standing.mean() == pytest.approx(9.8, abs=0.15)  # a low-cost sensor: 1.3 % above
    assert standing.std() < 0.2
