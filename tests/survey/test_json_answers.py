"""`--json`: commands whose answer a script reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from tests.surveys import Simulated


def answer(*words: str, code: int = 0) -> Any:
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == code, (done.output, done.exception)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_status_and_verify(finished: Simulated, tmp_path: Path) -> None:
    """Before and after a file of a tile is damaged; files are counted in the store's folder."""
    copy = finished.copy_with_store_to(tmp_path / "copy")
    file, root = str(copy.survey_file), Path(copy.store().root)
    told = answer("status", file)
    assert (told["complete"], told["due"], told["failures"]) == (True, {}, [])
    assert told["outputs"]["las"] == len(list((root / "tiles/las").glob("*.laz")))
    assert len(told["logs"]) == 9 and all(log["state"] == "ingested" for log in told["logs"])
    assert answer("verify", file) == {"faults": [], "repaired": [], "lost": []}
    cloud = next((root / "tiles/las").glob("*.laz"))
    cloud.write_bytes(cloud.read_bytes()[:-1])
    (fault,) = answer("verify", file, code=1)["faults"]
    assert cloud.name in fault
    told = answer("status", file, code=1)
    assert told["due"]["tiles"] == 1 and not told["complete"]


@pytest.mark.parametrize("stage", ["navigate", "footprints"])
def test_a_stage_sums_up(finished: Simulated, tmp_path: Path, stage: str) -> None:
    copy = finished.copy_with_store_to(tmp_path / "copy")
    assert answer(stage, str(copy.survey_file))["logs"]["logs"] == 9


def test_what_there_is() -> None:
    scenes = {one["scene"]: one for one in answer("scenes")}
    assert scenes["demo"]["passes"] == 2 and scenes["demo"]["length_m"] > 100
    assert {"sbet", "velodyne_pcap"} <= {one["format"] for one in answer("formats")}
    assert [one["yields"] for one in answer("formats", "sbet")] == [["trajectory"]]
    assert {"las", "tile_table"} <= {one["product"] for one in answer("products")}
