"""What a user meets first: version, completion, the survey file of the current folder, the summary of a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import roadscan
from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.ingest.reading.format import log_formats
from roadscan.simulate.scene import shipped_scenes
from roadscan.store.logs import read_log_records
from tests.conftest import REPOSITORY
from tests.surveys import Simulated

PROGRAM = Path(sys.executable).with_name("roadscan")


def printed(*arguments: object) -> str:
    """Standard output of a command."""
    return CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False).stdout


def test_the_version_is_printed() -> None:
    assert printed("--version") == f"roadscan {roadscan.__version__}\n"


def test_every_command_finds_the_survey_file_of_its_folder(
    finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = printed("status", finished.survey_file).splitlines()[1:]
    monkeypatch.chdir(finished.survey_file.parent)
    assert printed("status").splitlines()[1:] == named
    assert "15" in printed("sql", "SELECT count(*) FROM tiles")
    monkeypatch.chdir(tmp_path)
    for command in (
        ["run"],
        ["status"],
        ["verify"],
        ["sql", "SELECT 1"],
        ["camera", "resect", "--sensor", "a", "--points", "b"],
    ):
        with pytest.raises(ConfigError, match=r"no SURVEY\.toml here"):
            printed(*command)


def test_of_several_survey_files_it_says_which(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = 'id = "{}"\n[map]\nlocal = {{ name = "x" }}\n[[runs]]\nid = "a"\n[[runs.logs]]\npath = "none.sbet"\n'
    Path("monday.toml").write_text(text.format("monday"))
    Path("RIG.toml").write_text("[sensors]\n")
    assert "survey file: monday.toml" in printed("status")
    Path("tuesday.toml").write_text(text.format("tuesday"))
    with pytest.raises(ConfigError, match=r"several here: monday\.toml, tuesday\.toml"):
        printed("status")


def completed(words: str, folder: Path, shell: str) -> set[str]:
    """What a shell is told to complete the last of some words with."""
    environment = os.environ | {"_ROADSCAN_COMPLETE": f"complete_{shell}", "PYTHONPATH": str(REPOSITORY)}
    if shell == "bash":
        environment |= {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    else:
        environment |= {"_TYPER_COMPLETE_ARGS": words, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    done = subprocess.run([PROGRAM], env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    if shell == "zsh":
        return {part.split('"')[1] for part in done.stdout.split("((", 1)[1].splitlines()}
    return {line.split("\t")[0] for line in done.stdout.splitlines()}


@pytest.mark.slow
@pytest.mark.skipif(not PROGRAM.exists(), reason="roadscan is not installed as a program")
def test_a_shell_completes_files_formats_and_scenes(tmp_path: Path) -> None:
    (tmp_path / "SURVEY.toml").touch()
    assert completed("roadscan run ", tmp_path, "bash") == {"SURVEY.toml"}
    assert completed("roadscan formats s", tmp_path, "bash") == {n for n in log_formats() if n.startswith("s")}
    assert completed("roadscan simulate u", tmp_path, "bash") == {n for n in shipped_scenes() if n.startswith("u")}


@pytest.mark.slow
@pytest.mark.skipif(not PROGRAM.exists(), reason="roadscan is not installed as a program")
@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_are_told_the_same_in_their_own_form(tmp_path: Path, shell: str) -> None:
    assert completed("roadscan formats s", tmp_path, shell) == {n for n in log_formats() if n.startswith("s")}


@pytest.mark.skipif(not PROGRAM.exists(), reason="roadscan is not installed as a program")
def test_bash_completes_by_the_script_that_is_installed(tmp_path: Path) -> None:
    """Through bash itself; without a survey file in the folder the shell is told nothing, and no error is printed."""
    (tmp_path / "home").mkdir()
    environment = os.environ | {"HOME": str(tmp_path / "home"), "PYTHONPATH": str(REPOSITORY)}
    environment |= {
        "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}",
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
    }
    script = """
        roadscan --install-completion bash >/dev/null && . ~/.bashrc
        complete -p roadscan
        COMP_WORDS=(roadscan run ''); COMP_CWORD=2
        $(complete -p roadscan | sed 's/.*-F \\([^ ]*\\) .*/\\1/') roadscan; echo "first ${COMPREPLY[*]}"
        touch one.toml; COMPREPLY=()
        $(complete -p roadscan | sed 's/.*-F \\([^ ]*\\) .*/\\1/') roadscan; echo "then ${COMPREPLY[*]}"
    """
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert done.stdout.splitlines()[1:] == ["first ", "then one.toml"]


def test_a_run_ends_with_a_summary(finished: Simulated, tmp_path: Path) -> None:
    """Held against the files themselves: readings in the logs, cells in their tables, sizes on the disk."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    found = json.loads(printed("run", copy.survey_file, "--workers", 0, "--json"))
    store = copy.store()
    records = read_log_records(store)
    readings = sum(
        file.rows * (200 if table == "scans" else 1)
        for record in records
        for table in ("scans", "returns")
        for file in record.tables.get(table, ())
    )
    assert sum(found["readings"].values()) == readings
    assert found["logs"] == {
        "logs": len(records), "rows": sum(r.rows for r in records), "rejected": 0, "reject_reasons": {},
    }  # fmt: skip
    cells = pq.read_table(store.path("tiles/cells")).select(["passes", "count"])
    overlapped = sum(len(passes) > 1 for passes in cells["passes"].to_pylist())
    tiles = found["tiles"]
    assert tiles["cells"] == cells.num_rows
    assert tiles["with_readings"] == len(store.files("tiles/cells")) < tiles["looked_at"]
    assert tiles["area_m2"] == pytest.approx(cells.num_rows * 0.05**2)
    assert 0 < tiles["overlap_area_m2"] == pytest.approx(overlapped * 0.05**2)
    table = pq.read_table(store.path("products/tile_table/tiles.parquet"))
    assert tiles["sigma_down_m"]["largest"] == pytest.approx(max(table["sigma_down_m"].to_pylist()))
    assert found["failures"] == []
    for product, files in found["files"].items():
        there = [path for path in Path(files["folder"]).rglob("*") if path.is_file()]
        assert (files["files"], files["bytes"]) == (len(there), sum(p.stat().st_size for p in there)), product
    text = printed("run", copy.survey_file, "--workers", 0)
    assert f"{tiles['with_readings']} hold readings, of {tiles['looked_at']} looked at" in text
    assert f"{readings:,}, of which kept {found['readings']['kept']:,}" in text
    empty = tiles["looked_at"] - tiles["with_readings"]
    assert f"tiles looked at that hold no reading: {empty}\n" in printed("status", copy.survey_file)


def test_the_summary_tells_rejects_and_failures(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    control = copy.survey_file.parent / "control.csv"
    lines = control.read_text().splitlines()
    control.write_text("\n".join([*lines, "broken,PAINT,gcp,not,a,number,0.1,0.1"]) + "\n")
    profiles = copy.survey_file.parent / "raw/run-1/profiler_left.parquet"
    content = bytearray(profiles.read_bytes())
    content[1000 : len(content) // 2] = bytes(len(content) // 2 - 1000)  # it opens, and cannot be read
    profiles.write_bytes(content)
    done = CliRunner().invoke(app, ["ingest", str(copy.survey_file), "--workers", "0", "--json"])
    assert done.exit_code != 0
    found = json.loads(done.stdout)
    assert found["logs"]["rejected"] == Counter(found["logs"]["reject_reasons"]).total() == 1 + 141  # all profiles
    assert found["tiles"] is None
    assert [failure["stage"] for failure in found["failures"]] == ["ingest"]
    assert "profiler_left" in found["failures"][0]["unit"] + found["failures"][0]["reason"]


def test_classes_overwrites_only_what_it_wrote(finished: Simulated, tmp_path: Path) -> None:
    mine, table = tmp_path / "mine.toml", tmp_path / "classes.parquet"
    mine.write_text("# mine\n")
    command = ["classes", finished.survey_file, "--run", "run-1", "--sensor", "profiler_left", "--out"]
    with pytest.raises(ConfigError, match="holds no classes of readings"):
        printed(*command, mine)
    assert mine.read_text() == "# mine\n"
    assert printed(*command, table) == printed(*command, table)
