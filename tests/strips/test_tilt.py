"""A vehicle that sways over an even road: angles of a wrong sign or unit, mirrored profiles, late angles are named.

Profiles are computed here, from the sway and the heights of a sum of waves: not by roadscan's code.
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
from tests.strips.test_strips import DRIVE_S, READINGS, SPEED_M_PER_S, road_m
from tests.survey.test_mistakes import changed, said

Float64 = npt.NDArray[np.float64]

HEIGHT_M = 2.0
LATE_S = 0.06


def roll_deg(at_s: Float64) -> Float64:
    """Sway of the vehicle, right side down: two tones, as of a body on its springs."""
    return np.asarray(0.25 * np.sin(2 * np.pi * 1.3 * at_s) + 0.15 * np.sin(2 * np.pi * 0.83 * at_s + 1.0))


def write_poses(path: Path, angle: Callable[[Float64], Float64]) -> None:
    """100 poses a second to the north-east, 2 m above the road."""
    at = np.arange(round(DRIVE_S * 100)) / 100
    along = SPEED_M_PER_S * at / np.sqrt(2.0)
    lines = ["time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"]
    lines += [
        f"{FIRST_GPS_S + t:.6f},{500_000 + s:.5f},{5_300_000 + s:.5f},102,{r:.5f},0,45"
        for t, s, r in zip(at, along, angle(at), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_head(path: Path, *, mirrored: bool) -> None:
    """A profile each 5 ms of readings that are 5 cm apart, with 0.3 mm of noise, from a head that sways."""
    at = 0.5 + np.arange(round((DRIVE_S - 1.0) * 200)) / 200
    across, roll = (-2.0 + 0.05 * np.arange(READINGS))[None, :], np.radians(roll_deg(at))[:, None]
    place = across * np.cos(roll) - HEIGHT_M * np.sin(roll)
    down = (HEIGHT_M - road_m(SPEED_M_PER_S * at[:, None], place) - across * np.sin(roll)) / np.cos(roll)
    noisy = down + np.random.default_rng(3).normal(0.0, 0.0003, down.shape)
    raw = np.round(noisy / 1e-4).astype(np.uint16)[:, :: -1 if mirrored else 1]
    epochs = np.round((FIRST_GPS_S + at) * 1e9).astype(np.int64)
    geometry = {"kind": "cartesian", "readings": READINGS, "first": -2.0, "step": 0.05, "range_step_m": 1e-4}
    rows = pa.table({"epoch_gps_ns": epochs, "range": pa.FixedSizeListArray.from_arrays(raw.ravel(), READINGS)})
    pq.write_table(rows.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)


def told(folder: Path, angle: Callable[[Float64], Float64] = roll_deg, *, mirrored: bool = False) -> list[str]:
    """What `status` says of the roll."""

    def make(where: Path) -> None:
        write_poses(where / "poses.csv", angle)
        write_head(where / "scans.parquet", mirrored=mirrored)

    changed(folder, make=make)
    for command in ("ingest", "footprints", "strips"):
        code, text = said(folder, command, "--workers", "0")
        assert code == 0, text
    _, status = said(folder, "status")
    return [line for line in status.splitlines() if "roll of the poses" in line]


def test_a_sway_that_the_readings_confirm_is_not_named(tmp_path: Path) -> None:
    assert told(tmp_path) == []


@pytest.mark.witness("attitude_seen")
@pytest.mark.parametrize("mirrored", [False, True], ids=["wrong sign", "mirrored profiles"])
def test_a_roll_against_the_road_is_named(tmp_path: Path, mirrored: bool) -> None:
    (line,) = told(tmp_path, roll_deg if mirrored else lambda at: -roll_deg(at), mirrored=mirrored)
    assert "the sign of roll is wrong, or the readings are mirrored" in line
    assert float(line.split("it confirms ")[1].split(" ")[0]) == pytest.approx(-1.0, abs=0.1)


def test_half_a_roll_is_named(tmp_path: Path) -> None:
    (line,) = told(tmp_path, lambda at: 0.5 * roll_deg(at))
    assert float(line.split("sways ")[1].split(" ")[0]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [LATE_S, -LATE_S])
def test_a_late_roll_is_named_with_the_time(tmp_path: Path, late_s: float) -> None:
    (line,) = told(tmp_path, lambda at: roll_deg(at - late_s))
    assert float(line.split("poses is ")[1].split(" ms")[0]) == pytest.approx(1e3 * abs(late_s), abs=8.0)
    assert (" late against " in line) == (late_s > 0.0)
