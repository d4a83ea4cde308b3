"""``roadscan plan``: what it says before a run, after it and after a change, against what there is and a run does."""

from __future__ import annotations

import json
import os
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.survey import Survey
from roadscan.ingest.reading.format import LogFormat, log_formats
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import WORKER_BASE_BYTES, Stage, stage_named, stages
from roadscan.store.asset_schema import asset_tables
from roadscan.store.logs import read_log_records
from roadscan.store.schema import schema_names, table_schema
from roadscan.survey import plan, status
from roadscan.survey.run import run_stages
from roadscan.tiles.product import products
from tests.surveys import Simulated

OF_LOGS = {table for one in log_formats().values() for table in one.yields}


def planned(place: Simulated, *options: str, code: int = 0) -> dict[str, Any]:
    """The stages of the plan by name."""
    told = CliRunner().invoke(app, ["plan", str(place.survey_file), "--json", *options])
    assert told.exit_code == code, told.output
    return {one["name"]: one for one in json.loads(told.stdout)["stages"]}


def printed(place: Simulated, *command: str) -> str:
    told = CliRunner().invoke(app, [*command, str(place.survey_file)])
    assert told.exit_code == 0, told.output
    return told.stdout


def files_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of each file."""
    found = ((file, file.stat()) for file in folder.rglob("*") if file.is_file())
    return {str(file): (stat.st_size, stat.st_mtime_ns) for file, stat in found}


@pytest.fixture
def copy(finished: Simulated, tmp_path: Path) -> Simulated:
    """The survey with its store, as it is after a run."""
    return finished.copy_with_store_to(tmp_path / "survey")


# --- before a run -----------------------------------------------------------------------------------


def test_before_a_run_all_logs_are_due_and_the_rest_waits(simulated: Simulated, tmp_path: Path) -> None:
    place = simulated.copy_to(tmp_path / "survey")
    found = planned(place)
    raw = [file for file in (place.survey_file.parent / "raw").rglob("*") if file.is_file()]
    ingest = found["ingest"]
    assert ingest["due"] == ingest["tasks"] == ingest["why"]["missing"] == 9  # two runs of four logs, control points
    assert ingest["raw_bytes"] == sum(
        file.stat().st_size for file in (*raw, place.survey_file.with_name("control.csv"))
    )
    assert {"scans", "returns", "trajectory", "control_points", "rejects"} == ingest["writes"].keys()
    assert found["tiles"]["due"] is None and found["tiles"]["waits_for"] == "ingest"
    assert [name for name, one in found.items() if one["state"] == "passed over"] == [
        "video_frames", "picture_ties", "adjust", "pictures", "surfaces", "condition", "assets", "colours",
    ]  # fmt: skip
    assert list(found) == [stage.name for stage in stages()]
    text = printed(place, "plan")
    assert "9 missing" in text and "known after ingest" in text and "[adjust] is off" in text
    assert "\x1b" not in text
    assert not (place.survey_file.parent / "store").exists()


def test_a_dry_run_prints_the_plan(simulated: Simulated) -> None:
    assert printed(simulated, "run", "--dry-run") == printed(simulated, "plan")


# --- after a run ------------------------------------------------------------------------------------


def test_after_a_run_nothing_is_due_and_nothing_is_written(copy: Simulated) -> None:
    folder = copy.survey_file.parent
    before = files_of(folder)
    assert "nothing is due" in printed(copy, "plan")
    found = planned(copy)
    assert files_of(folder) == before
    assert {one["state"] for one in found.values()} == {"current", "passed over"}
    store = folder / "store" / "survey=demo"
    for stage, place in (("tiles", "tiles"), ("products", "products")):
        for name, count in found[stage]["writes"].items():
            assert count == len([f for f in (store / place / name).iterdir() if f.suffix not in (".jgw", ".pgw")]), name
    assert found["footprints"]["writes"] == {"footprints": len(list((store / "tables/footprints").rglob("*.parquet")))}
    assert set(found["tiles"]["reads"]) == {"scans", "returns", "trajectory", "footprints"}


def test_after_a_changed_setting_it_says_what_the_run_then_does(copy: Simulated) -> None:
    copy.survey_file.write_text(copy.survey_file.read_text() + "\n[filters]\nheight_max_m = 2000.0\n")
    found = planned(copy, "--workers", "0")
    footprints, tiles, later = found["footprints"], found["tiles"], found["products"]
    assert footprints["why"] == {"changed": 6 + 4}  # data files, and profilers of two runs
    assert tiles["why"] == {"changed": tiles["due"]} and tiles["waits_for"] == "footprints"
    assert later["state"] == "waits" and later["waits_for"] == "tiles" and later["unknown"] == 7

    class Counted(Inline):
        tasks = 0

        def map(self, function: Any, tasks: Any) -> Any:
            self.tasks += len(tasks)
            return super().map(function, tasks)

    session = Session(Survey.load(copy.survey_file), copy.store(), compute := Counted())
    before = files_of(Path(copy.store().path("tiles")))
    run_stages(session, [stage_named("footprints"), stage_named("tiles")])
    assert compute.tasks == footprints["tasks"] + tiles["tasks"]
    assert session.raw_bytes_read == tiles["raw_bytes"]
    made = {file for file, stat in files_of(Path(copy.store().path("tiles"))).items() if before.get(file) != stat}
    assert tiles["due"] >= len([file for file in made if "/geotiff/" in file]) > 0
    after = planned(copy)
    assert after["tiles"]["state"] == "current"
    assert after["products"]["current"] == 7  # the filter met no reading: unknown was the word for it


@pytest.mark.slow
def test_memory_of_a_worker_is_told_of_what_searches_returns(copy: Simulated) -> None:
    """It grows with the readings of a task: by 100 bytes each of a row group, by 430 each of a scene."""
    text = copy.survey_file.read_text()
    assert "[adjust]\non = false\n" in text
    copy.survey_file.write_text(text.replace("on = false", "on = true") + "\n[assets]\n")
    found = planned(copy)
    logs = read_log_records(copy.store())
    returns = sum(file.rows for log in logs for file in log.tables.get("returns", ()))
    profiles = [sorted(n for file in log.tables.get("scans", ()) for n in file.group_rows) for log in logs]
    assert returns > 1000 and sum(map(sum, profiles)) > 100
    of_assets = found["assets"]["worker_memory_bytes"] - WORKER_BASE_BYTES
    assert 200 * returns < of_assets < 430 * 1.2 * returns  # all squares fit into one scene; some returns lie in none
    placed, kept = max(map(max, filter(None, profiles))), max(sum(own[-8:]) for own in profiles)
    of_adjust = found["adjust"]["worker_memory_bytes"] - WORKER_BASE_BYTES
    assert of_adjust == 200 * (100 * placed + 3 * kept)  # of profiles alone, with 200 readings each
    assert not re.search(r"^ *(adjust|assets) .* \? *$", printed(copy, "plan"), re.MULTILINE)


def test_reasons(copy: Simulated) -> None:
    store = Path(copy.store().root)
    victim = next((store / "tiles" / "geotiff").glob("*.tif"))
    victim.unlink()
    assert planned(copy)["tiles"]["why"] == {"geotiff damaged": 1}
    text = copy.survey_file.read_text()
    copy.survey_file.write_text(text.replace("week = 2417", "week = 2417, offset_s = 0.001", 1))
    assert planned(copy)["ingest"]["why"] == {"with other settings or another reader": 1}
    copy.survey_file.write_text(text)
    log = copy.survey_file.parent / "raw" / "run-1" / "lidar.pcap"
    os.utime(log, (1.0, 1.0))
    ingest = planned(copy)["ingest"]
    assert ingest["why"] == {"of another size or time": 1}
    assert ingest["raw_bytes"] == log.stat().st_size


def test_a_run_that_would_fail_ends_with_2(copy: Simulated) -> None:
    copy.survey_file.write_text(copy.survey_file.read_text() + '\n[products]\nmake = ["lass"]\n')
    told = CliRunner().invoke(app, ["plan", str(copy.survey_file)])
    assert told.exit_code == 2
    assert told.stdout.count("a run would fail: ") == 1


# --- the picture ------------------------------------------------------------------------------------


def test_the_picture_shows_each_stage_and_what_it_writes(copy: Simulated, tmp_path: Path) -> None:
    file = tmp_path / "plan.svg"
    found = planned(copy, "--picture", str(file))
    root = ET.parse(file).getroot()
    names = {"svg": "http://www.w3.org/2000/svg"}
    words = [one.text or "" for one in root.findall("svg:text", names)]
    assert [word for word in words if word in found] == list(found)
    width, height = (float(root.get(name, "0")) for name in ("width", "height"))
    for one in root.findall("svg:rect", names):
        left, top = float(one.get("x", "0")), float(one.get("y", "0"))
        assert left + float(one.get("width", "0")) <= width and top + float(one.get("height", "0")) <= height
    assert any("cells 15" in word for word in words)
    classes = Counter(one.get("class") for one in root.findall("svg:rect", names))
    assert classes["over"] == 8 and classes["current"] == len(found) - 8


def test_a_picture_of_another_kind_is_refused(copy: Simulated, tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["plan", str(copy.survey_file), "--picture", str(tmp_path / "plan.png")])
    assert told.exit_code != 0 and not (tmp_path / "plan.png").exists()


# --- what stages declare ----------------------------------------------------------------------------


def names_of(declared: tuple[str | type, ...]) -> set[str]:
    """Names, with all there are of a class of plugins in its place."""
    found: set[str] = set()
    for one in declared:
        if isinstance(one, str):
            found.add(one)
        elif one is LogFormat:
            found |= OF_LOGS
        else:
            found |= {name for name, product in products().items() if isinstance(product, one)} or set(asset_tables())
    return found


OWN = [stage for stage in stages() if type(stage).__module__.startswith("roadscan.")]


@pytest.mark.parametrize("stage", OWN, ids=lambda stage: stage.name)
def test_declared_names_are_those_of_tables_and_products(stage: Stage) -> None:
    folders = {folder.rpartition("/")[2] for folder in stage.folders()}
    known = {*schema_names(), *products(), *asset_tables()}
    assert names_of(stage.writes) <= known | folders
    earlier = {name for other in OWN[: OWN.index(stage)] for name in names_of(other.writes)}
    assert names_of(stage.reads) - names_of(stage.writes) <= earlier | OF_LOGS | {"mountings"}  # `roadscan calibrate`


def test_each_table_and_product_is_written_by_one_stage() -> None:
    written = Counter(name for stage in OWN for name in names_of(stage.writes))
    twice = {name for name, count in written.items() if count > 1}
    assert twice == {"trajectory", "trajectory_accuracy"}  # logged or computed
    places = {folder for stage in OWN for folder in stage.folders()}
    filled = {name for name in schema_names() if table_schema(name).location in places}
    of_products = {product.table for product in products().values() if getattr(product, "table", None)}
    assert filled - of_products <= written.keys()
    assert products().keys() <= written.keys()


def test_all_files_of_a_run_are_declared(finished: Simulated) -> None:
    folders = {path.split("/")[1] for path in finished.store().files("tiles") + finished.store().files("products")}
    pictures = {name for name in folders if name in ("navigation", "adjustment", "calibration")}
    assert folders - pictures <= {name for stage in OWN for name in names_of(stage.writes)}


def test_a_stage_that_declares_nothing_is_shown(copy: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    class Bare(Stage):
        """A stage of another package."""

        name = "bare"
        title = "nothing that is declared"
        after = ("tiles",)

        def run(self, session: Session) -> None:
            """Do nothing."""

    for module in (plan, status):
        monkeypatch.setattr(module, "stages", lambda: (*stages(), Bare()))
    found = planned(copy)["bare"]
    assert (found["state"], found["reads"], found["writes"]) == ("current", [], {})
