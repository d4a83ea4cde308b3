"""Two heads over one rough road: one that is late, looks up or reads anything is named; sound ones are not.

The road is a sum of waves whose heights are computed here at stated places: not by roadscan's code. The speed is the
same all the time and no wheel is counted, so that nothing but the road tells a clock.
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
from roadscan.strips.whose import Difference, End, whose
from tests.georeference.test_tick_clocks import SECOND_HEAD, SECOND_SENSOR
from tests.survey.test_mistakes import changed, said

Float64 = npt.NDArray[np.float64]
UInt16 = npt.NDArray[np.uint16]

SPEED_M_PER_S = 10.0
DRIVE_S = 12.0
READINGS = 80
RIGHT_M = 1.0
"""Lever arm of the second head."""
LATE_S = 0.03
WITNESSES = (
    "lie where a road can be",
    "off the others of their cell",
    "along the travel from where",
    "heights scatter",
)
"""Words of each witness."""


def road_m(along: Float64, right: Float64) -> Float64:
    """Heights of 60 waves of 0.8 m to 5 m in all directions, 2 mm in all (RMS)."""
    random = np.random.default_rng(11)
    number, turn, phase = random.uniform(1.2, 7.8, 60), random.uniform(0, np.pi, 60), random.uniform(0, 2 * np.pi, 60)
    height = np.zeros(np.broadcast(along, right).shape)
    for k, angle, begin in zip(number, turn, phase, strict=True):
        height += np.cos(k * (along * np.cos(angle) + right * np.sin(angle)) + begin)
    return height * 0.002 / np.sqrt(30.0)


def write_poses(path: Path) -> None:
    """100 poses a second to the north-east, 2 m above the road."""
    at = np.arange(round(DRIVE_S * 100)) / 100
    along = SPEED_M_PER_S * at / np.sqrt(2.0)
    lines = ["time_s,easting_m,northing_m,height_m,roll_deg,pitch_deg,heading_deg"]
    lines += [
        f"{FIRST_GPS_S + t:.6f},{500_000 + s:.5f},{5_300_000 + s:.5f},102,0,0,45"
        for t, s in zip(at, along, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_head(
    path: Path, lever_m: float, late_s: float = 0.0, wrong: Callable[[UInt16], UInt16] = lambda raw: raw
) -> None:
    """A profile each 5 ms of readings that are 5 cm apart, with 0.3 mm of noise; `late_s` is added to the stamps."""
    at = 0.5 + np.arange(round((DRIVE_S - 1.0) * 200)) / 200
    across = -2.0 + 0.05 * np.arange(READINGS)
    height = road_m(SPEED_M_PER_S * at[:, None], lever_m + across[None, :])
    noise = np.random.default_rng(round(10 * lever_m)).normal(0.0, 0.0003, height.shape)
    raw = wrong(np.round((2.0 - height + noise) / 1e-4).astype(np.uint16))
    epochs = np.round((FIRST_GPS_S + at + late_s) * 1e9).astype(np.int64)
    geometry = {"kind": "cartesian", "readings": READINGS, "first": -2.0, "step": 0.05, "range_step_m": 1e-4}
    rows = pa.table({"epoch_gps_ns": epochs, "range": pa.FixedSizeListArray.from_arrays(raw.ravel(), READINGS)})
    pq.write_table(rows.replace_schema_metadata({"roadscan.scan_geometry": json.dumps(geometry)}), path)


def told(
    folder: Path, axes: str = "frd", late_s: float = 0.0, wrong: Callable[[UInt16], UInt16] = lambda raw: raw
) -> list[str]:
    """What `status` says of the heads, of which the second is as stated."""

    def make(where: Path) -> None:
        write_poses(where / "poses.csv")
        write_head(where / "scans.parquet", 0.0)
        write_head(where / "right.parquet", RIGHT_M, late_s, wrong)

    mounted = SECOND_SENSOR[0], SECOND_SENSOR[1].replace('"profiler",', f'"profiler", axes = "{axes}",')
    changed(folder, SECOND_HEAD, mounted, make=make)
    for command in ("ingest", "footprints", "strips"):
        code, text = said(folder, command, "--workers", "0")
        assert code == 0, text
    _, status = said(folder, "status")
    return [line for line in status.splitlines() if any(word in line for word in WITNESSES)]


def anywhere(raw: UInt16) -> UInt16:
    """Each twentieth reading is any between 0 and 5 m."""
    random = np.random.default_rng(5)
    return np.where(random.random(raw.shape) < 0.05, random.integers(1, 50_000, raw.shape), raw).astype(np.uint16)


@pytest.mark.slow
def test_heads_that_are_right_are_not_named(tmp_path: Path) -> None:
    assert told(tmp_path) == []


@pytest.mark.slow
@pytest.mark.witness("along_travel")
@pytest.mark.parametrize("late_s", [LATE_S, -0.4])
def test_a_late_head_is_named_at_one_speed_and_without_ticks(tmp_path: Path, late_s: float) -> None:
    """One of two heads is, and nothing says which: both are named, with the shift."""
    (line,) = told(tmp_path, late_s=late_s)
    assert "right.parquet" in line
    assert "scans.parquet" in line
    shift_m, sigma_m = (float(line.split(words)[1].split(" m", maxsplit=1)[0]) for words in ("readings lie ", "(σ "))
    assert abs(shift_m) == pytest.approx(abs(late_s) * SPEED_M_PER_S, abs=4 * sigma_m)
    assert sigma_m < 0.05


@pytest.mark.slow
@pytest.mark.witness("sees_road")
def test_a_head_whose_axes_look_up_is_named(tmp_path: Path) -> None:
    (line,) = told(tmp_path, axes="flu")
    assert "right.parquet" in line
    assert "+2.00 m above the body's origin; the other sensors see it 2.00 m below" in line


@pytest.mark.slow
@pytest.mark.witness("readings_agree")
def test_a_head_that_reads_anything_is_named_with_the_share(tmp_path: Path) -> None:
    (line,) = told(tmp_path, wrong=anywhere)
    assert "right.parquet" in line
    share = float(line.split("%")[0].split()[-1])
    assert share == pytest.approx(4.8, abs=0.3)  # of the others each twenty-fifth lies within 0.1 m by chance


def differences(errors: dict[tuple[str, str], float], backward: str) -> list[Difference]:
    """All pairs of four logs; a run drives against the way."""
    ends = [End(run, s, 10 * k, -1 if run == backward else 1) for k, run in enumerate("ab") for s in ("one", "two")]
    return [
        Difference((p, q), q.sign * errors.get(q[:2], 0.0) - p.sign * errors.get(p[:2], 0.0), 0.03, 0.0)
        for k, p in enumerate(ends) for q in ends[k + 1 :] for _ in range(2)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("errors", "suspects"),
    [
        ({}, []),
        ({("a", "one"): 0.5}, [{("log", "a", "one")}]),
        ({("a", "one"): 0.5, ("b", "one"): 0.5}, [{("sensor", "", "one")}]),
        ({("b", "one"): -0.3, ("b", "two"): -0.3}, [{("run", "a", ""), ("run", "b", "")}]),
    ],
    ids=["nobody", "a log", "a sensor in both runs", "the poses of one of two runs"],
)
def test_the_fewest_who_explain_all_differences_are_blamed(
    errors: dict[tuple[str, str], float], suspects: list[set[tuple[str, str, str]]]
) -> None:
    found = whose(differences(errors, backward="b"), least=0.06)
    assert [{(s.kind, s.run, s.sensor) for s in one.suspects} for one in found] == suspects
    if errors:
        assert abs(found[0].value) == pytest.approx(abs(next(iter(errors.values()))))
