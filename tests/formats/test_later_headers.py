"""Files that were appended to one another: what stands behind a second header, in each format of text lines."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

import roadscan as rs
from roadscan.cli import app
from roadscan.core.crs import MapFrame
from roadscan.core.rig import Sensor
from roadscan.ingest.reading.text_files import AGAIN
from tests.formats.log_reading import GPS_SECONDS, read_log

GPS_S = {"system": "gps", "unit": "s"}
START_S = 1_461_920_418
POSES = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
POS_HEADER = """% program   : RTKPOST
% (lat/lon/height=WGS84/{height},Q=1:fix,2:float,5:single,ns=# of satellites)
%  {time}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)
"""
POS_ROW = "2026/05/04 09:30:{s:06.3f}   48.000000000    9.000000000   300.0000   1  10   0.0100   0.0110   0.0200\n"


def poses(first: int, count: int, swapped: bool = False) -> str:
    """Lines of a trajectory, a second apart."""
    place = "9.0,48.0" if swapped else "48.0,9.0"
    return "".join(f"{START_S + k},{place},300.0,0,0,10\n" for k in range(first, first + count))


def seconds(log: rs.LogTables) -> list[int]:
    """Epochs of the rows, from the start."""
    (table,) = log.tables.values()
    return [round(e / 1e9 - START_S) for e in table.column("epoch_gps_ns").to_pylist()]


def read(file: Path, text: str, **stated: object) -> rs.LogTables:
    file.write_text(text, encoding="utf-8")
    return rs.read_log(file, **stated)


def rejected(log: rs.LogTables) -> dict[str, int]:
    out: dict[str, int] = {}
    for one in log.rejects:
        out[one.reason] = out.get(one.reason, 0) + one.records
    return out


@pytest.mark.witness("second_header")
@pytest.mark.parametrize("name", ["hdr_utc.pos", "hdr_geodetic.pos", "hdr_swapped.csv"])
def test_the_wrong_inputs(faults: Path, name: str) -> None:
    """Only the row behind the first header is read; `inspect` says of the other why."""
    file = faults / "pos_second_header" / name
    stated = {"clock": {"system": "unix_utc", "unit": "s"}} if name.endswith("csv") else {}
    log = rs.read_log(file, crs="EPSG:4979", **stated)
    (table,) = log.tables.values()
    assert table.num_rows == 1
    assert any("which differs from the first" in reason for reason in rejected(log))
    said = CliRunner().invoke(app, ["inspect", str(file)])
    assert "which differs from the first" in " ".join(said.output.split())


def test_a_header_that_stands_again_costs_itself(tmp_path: Path) -> None:
    for between in (POSES + "\n", "\ufeff" + POSES + "\n", POSES.upper() + "\r\n"):
        log = read(tmp_path / "t.csv", f"{POSES}\n{poses(0, 3)}{between}{poses(3, 3)}", clock=GPS_S, crs="EPSG:4979")
        assert seconds(log) == [0, 1, 2, 3, 4, 5]
        assert rejected(log) == {AGAIN: 1}


def test_rows_behind_another_header_are_left_out_until_the_first_comes_again(tmp_path: Path) -> None:
    swapped = "time_s,longitude_deg,latitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
    radians = POSES.replace("roll_deg", "roll_rad")
    for other in (swapped, radians, POSES.replace("latitude_deg", "lat")):
        text = f"{POSES}\n{poses(0, 2)}{other}\n{poses(2, 50_000)}{POSES}\n{poses(50_002, 2)}"
        log = read(tmp_path / "t.csv", text, clock=GPS_S, crs="EPSG:4979")
        assert seconds(log) == [0, 1, 50_002, 50_003]
        (other_reason,) = set(rejected(log)) - {AGAIN}
        assert "differs from the first" in other_reason
        assert rejected(log)[other_reason] == 50_001


def test_a_file_without_a_line_end_before_the_second(tmp_path: Path) -> None:
    swapped = "time_s,longitude_deg,latitude_deg,height_m,roll_deg,pitch_deg,heading_deg"
    first = f"{POSES}\n{poses(0, 3)}".removesuffix("\n")
    log = read(tmp_path / "t.csv", f"{first}{POSES}\n{poses(3, 2)}", clock=GPS_S, crs="EPSG:4979")
    assert seconds(log) == [0, 1, 3, 4]
    log = read(tmp_path / "t.csv", f"{first}{swapped}\n{poses(3, 2)}", clock=GPS_S, crs="EPSG:4979")
    assert seconds(log) == [0, 1]


def test_a_damaged_line_is_no_header(tmp_path: Path) -> None:
    """Words, missing values and bytes that are none cost their own line."""
    for line in ("x,y,z,,,,\n", "nan,nan,nan,nan,nan,nan,nan\n", "END OF FILE\n", "1e,2e,abc,4,5,6,7\n"):
        log = read(tmp_path / "t.csv", f"{POSES}\n{poses(0, 2)}{line}{poses(2, 2)}", clock=GPS_S, crs="EPSG:4979")
        assert seconds(log) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("time", "height", "kept"),
    [("GPST", "ellipsoidal", 4), ("UTC", "ellipsoidal", 2), ("GPST", "geodetic", 2), ("JST", "ellipsoidal", 2)],
)
def test_solutions_of_rtklib(tmp_path: Path, time: str, height: str, kept: int) -> None:
    first, second = POS_HEADER.format(time="GPST", height="ellipsoidal"), POS_HEADER.format(time=time, height=height)
    rows = [POS_ROW.format(s=18.0 + k) for k in range(4)]
    log = read(tmp_path / "a.pos", first + "".join(rows[:2]) + second + "".join(rows[2:]), crs="EPSG:4979")
    assert log.tables["gnss"].num_rows == kept
    assert sum(rejected(log).values()) == 4 - kept
    # The first header counts again where it stands again.
    log = read(tmp_path / "a.pos", first + rows[0] + second + rows[1] + first + "".join(rows[2:]), crs="EPSG:4979")
    assert log.tables["gnss"].num_rows == (4 if kept == 4 else 3)


def test_what_a_second_header_says_is_not_taken_for_the_first(tmp_path: Path) -> None:
    """The first header states no kind of height, the second geodetic heights."""
    first = "".join(line for line in POS_HEADER.format(time="GPST", height="").splitlines(True) if "(lat/" not in line)
    second = POS_HEADER.format(time="GPST", height="geodetic")
    log = read(tmp_path / "a.pos", first + POS_ROW.format(s=18.0) + second + POS_ROW.format(s=19.0), crs="EPSG:4979")
    assert log.tables["gnss"].num_rows == 1


IMU = "time_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,acc_x_g,acc_y_g,acc_z_g"
ENCODER = "time_s,ticks"


@pytest.mark.parametrize(
    ("name", "header", "other", "row", "kind"),
    [
        ("imu_csv", IMU, IMU.replace("deg_s", "rad_s"), "{t},0.1,0.2,0.3,0,0,1", "imu"),
        ("encoder_csv", ENCODER, "ticks,time_s", "{t},{k}", "encoder"),
    ],
)
def test_other_tables_of_text(tmp_path: Path, name: str, header: str, other: str, row: str, kind: str) -> None:
    rows = [row.format(t=START_S + k, k=100 + k) for k in range(4)]
    for second, kept in ((header, 4), (other, 2)):
        text = "\n".join([header, *rows[:2], second, *rows[2:]]) + "\n"
        (tmp_path / "a.csv").write_text(text)
        options = {"record": "total"} if name == "encoder_csv" else {}
        log = read_log(name, tmp_path / "a.csv", options, clock=GPS_SECONDS, sensor=Sensor(kind=kind))
        assert log.table.num_rows == kept


def test_control_points_behind_another_header(tmp_path: Path) -> None:
    first, second = "name,easting_m,northing_m,height_m", "name,northing_m,easting_m,height_m"
    (tmp_path / "c.csv").write_text(f"{first}\nP1,500000,5300000,300\n{second}\nP2,5300000,500000,300\n")
    said = {"crs": "EPSG:32632", "height": "ellipsoidal", "map": MapFrame("EPSG:32632")}
    log = read_log("control_csv", tmp_path / "c.csv", {"role": "gcp"}, **said)
    assert log.table.num_rows == 1
    assert sum(one.records for one in log.rejects) == 2
