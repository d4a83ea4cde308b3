"""A clock that steps or is late is named by the wheel's ticks; a drive without a fault is not.

Positions come from the integral of a stated speed, ticks from that speed by another clock: not from roadscan's code.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from docs.mistakes import FIRST_GPS_S
from tests.survey.test_mistakes import changed, said

Float64 = npt.NDArray[np.float64]

SECOND_HEAD = (
    '[[runs.logs]]\npath = "scans.parquet"\n',
    '[[runs.logs]]\npath = "right.parquet"\nsensor = "right"\n\n[[runs.logs]]\npath = "scans.parquet"\n',
)
SECOND_SENSOR = (
    "\n[[runs]]", 'rig.sensors.right = { kind = "profiler", lever_arm_body_m = [0.0, 1.0, 0.0] }\n\n[[runs]]'
)  # fmt: skip
DRIVE_S = 12.0
LATE_S = 0.020
STEP_AT = 500


def way_m(seconds: Float64) -> Float64:
    """Integral of 10 m/s + 2 m/s · sin(π t / 2): it repeats, so that a clock could be off by 4 s as well."""
    return 10.0 * seconds + 4.0 / np.pi * (1.0 - np.cos(np.pi * seconds / 2.0))


def write_drive(path: Path, late: Callable[[Float64], Float64] = np.zeros_like) -> None:
    """100 poses a second with 1 mm of noise to the north-east; `late` is added to their stamps."""
    at = np.arange(round(DRIVE_S * 100)) / 100
    along = (way_m(at) + np.random.default_rng(7).normal(0, 0.0005, at.size)) / np.sqrt(2.0)
    lines = ["time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"]
    lines += [
        f"{FIRST_GPS_S + t:.6f},{500_000 + s:.5f},{5_300_000 + s:.5f},102,0,0,45"
        for t, s in zip(at + late(at), along, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_ticks(path: Path, late: Callable[[Float64], Float64] = np.zeros_like, metres: float = 0.002) -> None:
    """A profile each 10 ms, from the first second to the last but one, with the ticks of a wheel."""
    at = 1.0 + np.arange(round((DRIVE_S - 2.0) * 100)) / 100 + 0.0023
    epochs = np.round((FIRST_GPS_S + at + late(at)) * 1e9).astype(np.int64)
    ranges = 20_000 + np.random.default_rng(3).integers(-3, 4, (at.size, 40))
    geometry = {"kind": "cartesian", "readings": 40, "first": -2.0, "step": 0.1, "range_step_m": 1e-4}
    rows = pa.table(
        {
            "epoch_gps_ns": epochs,
            "range": pa.FixedSizeListArray.from_arrays(ranges.astype(np.uint16).ravel(), 40),
            "encoder_ticks": np.floor(way_m(at) / metres).astype(np.int64) + 70_000,
        }
    )
    pq.write_table(rows.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)


def constant(size_s: float) -> Callable[[Float64], Float64]:
    return lambda at: np.full_like(at, size_s)


def step(size_s: float) -> Callable[[Float64], Float64]:
    return lambda at: np.where(np.arange(at.size) >= STEP_AT, size_s, 0.0)


def told(folder: Path, head: Callable[[Float64], Float64], poses: Callable[[Float64], Float64]) -> list[str]:
    """Lines of the summary about clocks; `head` is added to the stamps of one head, `poses` to those of the poses."""

    def make(where: Path) -> None:
        write_drive(where / "poses.csv", poses)
        write_ticks(where / "scans.parquet", head)
        write_ticks(where / "right.parquet")

    changed(folder, SECOND_HEAD, SECOND_SENSOR, make=make)
    code, text = said(folder, "run", "--workers", "0")
    assert code == 0, text
    _, status = said(folder, "status")
    assert ("the clock of" in text) == ("the clock of" in status)
    return [line for line in text.splitlines() if "the clock of" in line and not line.startswith("note: ")]


def size_ms(line: str, begin: str) -> float:
    """The milliseconds behind some words."""
    return float(line.split(begin)[1].split(" ms", maxsplit=1)[0].replace(",", ""))


@pytest.mark.slow
def test_clocks_that_are_right_are_not_named(tmp_path: Path) -> None:
    assert told(tmp_path, np.zeros_like, np.zeros_like) == []


@pytest.mark.slow
@pytest.mark.witness("tick_clock")
@pytest.mark.parametrize("size_s", [LATE_S, -LATE_S, 0.6])
def test_a_late_head_is_named_with_its_offset(tmp_path: Path, size_s: float) -> None:
    (line,) = told(tmp_path, constant(size_s), np.zeros_like)
    assert "scans.parquet: the clock of this sensor is" in line
    offset_ms, sigma_ms = size_ms(line, "sensor is "), size_ms(line, "(σ ")
    assert offset_ms == pytest.approx(1e3 * size_s, abs=4 * sigma_ms + 0.2)
    assert sigma_ms < 3.0


@pytest.mark.slow
def test_late_poses_are_named_since_both_heads_say_so(tmp_path: Path) -> None:
    (line,) = told(tmp_path, np.zeros_like, constant(LATE_S))
    assert "poses.csv: the clock of all 2 sensors is -" in line
    assert size_ms(line, "sensors is ") == pytest.approx(-1e3 * LATE_S, abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("size_s", [0.02, 2.0])
def test_a_head_whose_clock_steps_is_named(tmp_path: Path, size_s: float) -> None:
    (line,) = told(tmp_path, step(size_s), np.zeros_like)
    assert "scans.parquet: the clock of this sensor steps against that of the poses by +" in line
    assert size_ms(line, "poses by ") == pytest.approx(1e3 * size_s, rel=0.1)


@pytest.mark.slow
def test_poses_whose_clock_steps_are_named_once(tmp_path: Path) -> None:
    lines = told(tmp_path, np.zeros_like, step(0.5))
    assert len(lines) == 1
    assert "poses.csv: the clock of all 2 sensors steps" in lines[0]
    assert size_ms(lines[0], "poses by ") == pytest.approx(-500.0, abs=20.0)


def test_a_wheel_that_slips_for_a_while_is_no_clock(tmp_path: Path) -> None:
    def make(where: Path) -> None:
        write_drive(where / "poses.csv")
        write_ticks(where / "scans.parquet")
        rows = pq.read_table(where / "scans.parquet")
        ticks = rows.column("encoder_ticks").to_numpy().copy()
        steps = np.diff(ticks, prepend=ticks[0])
        steps[400:420] = 0  # the wheel is locked for 0.2 s
        slipped = rows.set_column(2, "encoder_ticks", pa.array(ticks[0] + np.cumsum(steps)))
        pq.write_table(slipped.replace_schema_metadata(rows.schema.metadata), where / "scans.parquet")

    changed(tmp_path, make=make)
    code, text = said(tmp_path, "run", "--workers", "0")
    assert code == 0
    assert "steps against" not in text


@pytest.mark.witness("pose_stamps")
@pytest.mark.parametrize("size_s", [3.0, 0.0])
def test_a_gap_in_time_that_is_none_of_the_way_is_named(tmp_path: Path, size_s: float) -> None:
    """Without ticks, the way across the gap says it; a gap in which the vehicle drives on is not named."""

    def make(where: Path) -> None:
        write_drive(where / "poses.csv", step(size_s))
        if not size_s:
            lines = (where / "poses.csv").read_text().splitlines(keepends=True)
            (where / "poses.csv").write_text("".join(lines[:500] + lines[800:]))

    changed(tmp_path, make=make)
    code, text = said(tmp_path, "run", "--workers", "0")
    assert code == 0, text
    assert ("poses.csv: the stamps jump forward by about 3.00" in text) == (size_s > 0)
