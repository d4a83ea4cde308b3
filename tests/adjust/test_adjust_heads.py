"""Heads that do not meet as the survey says: exchanged logs, ranges of another scale in one run and in all.

Two passes of a bare road, whose heads overlap by some centimetres alone, past control whose heights alone are used.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.adjust.tasks.outcome import known_findings
from roadscan.core.witness import Finding
from roadscan.simulate import Scene, simulate
from roadscan.store.manifest import Manifest
from roadscan.store.small_tables import read_small
from tests.answers import roadscan
from tests.drawn_faults.kinds import _ranges, _with
from tests.surveys import Simulated

pytestmark = pytest.mark.nightly

OFF = {"on": False}
HEADS = ("profiler_left", "profiler_right")
RANGE_M = 1.25
"""Recorded range of the road beyond the heads' offset of 0.8 m, about."""
FACTOR = 0.998


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a survey without a fault, as it was recorded."""
    targets = [{"station_m": 6.0 + 12.0 * k, "offset_m": 0.8 + 1.8 * (k % 2), "role": "gcp"} for k in range(5)]
    scene = Scene.load("reference_site").changed(
        road={"targets": targets}, length_m=60.0, lidar=OFF, imu=OFF, gnss=OFF, encoder=OFF, camera=OFF,
        profilers={"spacing_m": 0.05, "readings": 250, "head_imus": None},
        passes=[{"lane": 2}, {"lane": 2, "offset_m": 0.5}],
        noise={"position_m": 0.005, "attitude_deg": 0.003, "time_constant_s": 60.0, "control_m": 0.001},
        vehicle={"standstill_s": 0.0}, roadside={"poles": [], "trees": []},
    )  # fmt: skip
    return simulate(scene, tmp_path_factory.mktemp("heads") / "survey").survey_file.parent


def adjusted(folder: Path, workers: int = 0) -> tuple[list[Finding], str]:
    """Findings of `roadscan adjust`, and what it printed."""
    survey = folder / "SURVEY.toml"
    text = ""
    for command in ("ingest", "adjust"):
        done = roadscan(command, survey, "--workers", str(workers))
        assert done.exit_code == 0, done.output
        text = done.output
    return known_findings(Manifest(Simulated(survey).store())), text


def mountings(folder: Path) -> dict[tuple[str, str], dict[str, float]]:
    """Rows of the table by run and sensor; none where there is none."""
    table = read_small(Simulated(folder / "SURVEY.toml").store(), "mounting_corrections")
    return {(row["run"], row["sensor"]): row for row in ([] if table is None else table.to_pylist())}


def scaled(folder: Path, runs: tuple[str, ...], head: str = HEADS[0]) -> None:
    """Make the recorded ranges of a head shorter."""
    for run in runs:
        file = folder / "raw" / run / f"{head}.parquet"
        table = pq.read_table(file)
        raw = _ranges(table)
        raw[raw > 0] = np.rint(raw[raw > 0] * FACTOR).astype(np.uint16)
        pq.write_table(_with(table, "range", raw), file)


def copied(sound: Path, folder: Path) -> Path:
    shutil.copytree(sound, folder, ignore=shutil.ignore_patterns("store*"))
    return folder


def test_sound_heads_are_not_doubted(sound: Path, tmp_path: Path) -> None:
    folder = copied(sound, tmp_path / "survey")
    found, text = adjusted(folder)
    assert found == []
    assert "which of these is off" not in text
    assert mountings(folder) == {}


@pytest.mark.witness("heads_of_a_run")
def test_exchanged_logs_are_named_and_no_control_is_blamed(sound: Path, tmp_path: Path) -> None:
    folder = copied(sound, tmp_path / "survey")
    left, right = (folder / "raw" / "run-1" / f"{head}.parquet" for head in HEADS)
    content = left.read_bytes()
    left.write_bytes(right.read_bytes())
    right.write_bytes(content)
    found, _ = adjusted(folder)
    (told,) = (one for one in found if one.witness == "heads_of_a_run")
    assert told.subject == "run 'run-1'"
    assert "the logs of profiler_left and profiler_right are exchanged" in told.text
    assert not {one.witness for one in found} & {"control_point", "control_datum", "stated_sigma", "mounting"}


def test_a_scale_of_one_run_is_told_and_taken_from_that_run_alone(sound: Path, tmp_path: Path) -> None:
    folder = copied(sound, tmp_path / "survey")
    scaled(folder, ("run-2",))
    found, text = adjusted(folder)
    assert [(one.witness, one.subject) for one in found] == [("heads_of_a_run", "run 'run-2'")]
    assert "range scale" in found[0].text
    assert "range scale of profiler_left in run 'run-2'" in text
    assert {run for run, _ in mountings(folder)} == {"run-2"}
    assert step_m(mountings(folder), "run-2") == pytest.approx(RANGE_M * (1.0 - FACTOR), abs=0.0005)


def test_a_scale_of_all_runs_is_a_scale_or_a_height_of_the_head(sound: Path, tmp_path: Path) -> None:
    """Flat roads do not tell one from the other, and σ says so; with both, heads meet."""
    folder = copied(sound, tmp_path / "survey")
    scaled(folder, ("run-1", "run-2"))
    _, text = adjusted(folder)
    line = next(one for one in text.splitlines() if "do not tell which of these is off" in one)
    assert "lever arm down of profiler_left" in line
    assert "range scale of profiler_left" in line
    assert step_m(mountings(folder), "*") == pytest.approx(RANGE_M * (1.0 - FACTOR), abs=0.0005)
    for row in mountings(folder).values():
        assert row["sigma_range_scale"] > 0.5 * row["prior_sigma_range_scale"]


def step_m(found: dict[tuple[str, str], dict[str, float]], run: str) -> float:
    """By how much the left head is lowered against the right one where they meet, about 1 m beside either."""
    nothing = dict.fromkeys(("lever_down_m", "range_scale", "roll_rad"), 0.0)
    left, right = (found.get((run, head), nothing) for head in HEADS)
    apart = (
        left["lever_down_m"] - right["lever_down_m"] + (0.8 + RANGE_M) * (left["range_scale"] - right["range_scale"])
    )
    return apart + left["roll_rad"] + right["roll_rad"]


def test_workers_change_no_bit_of_estimated_mountings(sound: Path, tmp_path: Path) -> None:
    tables = []
    for workers in (1, 2):
        folder = copied(sound, tmp_path / f"by-{workers}")
        scaled(folder, ("run-1", "run-2"))
        adjusted(folder, workers)
        files = sorted(folder.glob("store/*/tables/*corrections/*"))
        assert [one.parent.name for one in files] == ["corrections", "mounting_corrections"]
        tables.append([one.read_bytes() for one in files])
    assert tables[0] == tables[1]
