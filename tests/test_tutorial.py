"""The commands of docs/tutorial.md run in their order, and print what the page shows."""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.answers import roadscan

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "tutorial.md"
CLONE = "/srv/roadscan"
"""Where the page's clone of the repository lies."""


def commands() -> Iterator[tuple[str, list[str]]]:
    """Each command of the page's console blocks, and the lines that the page shows below it."""
    for block in re.findall(r"^```console\n(.*?)^```", PAGE.read_text(), flags=re.MULTILINE | re.DOTALL):
        lines = iter([*block.splitlines(), "$ "])
        command, shown = "", []
        for line in lines:
            if not line.startswith("$ "):
                shown.append(line)
                continue
            if command:
                yield command, shown
            command, shown = line[2:], []
            while command.endswith("\\"):
                command += "\n" + next(lines)
            if command.endswith("<<'END'"):
                while not command.endswith("\nEND"):
                    command += "\n" + next(lines)


def answer(command: str) -> str:
    """What a command prints; roadscan and Python scripts run in this process, which saves their start."""
    words = [] if "\n" in command else shlex.split(command)
    if words[:1] == ["roadscan"]:
        outcome = roadscan(*words[1:])
        assert outcome.exit_code == (words[1] == "status"), outcome.output  # `status` ends with 1: something is to do
        return outcome.output
    if words[:1] == ["python"]:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            runpy.run_path(words[1])
        return printed.getvalue()
    return subprocess.run(["bash", "-ec", command], check=True, capture_output=True, text=True).stdout


def shape(line: str) -> str:
    """A line without what another processor or library may print otherwise: digits, and widths of columns."""
    return re.sub(r"[ ─]+", " ", re.sub(r"\d[\d,.]*", "#", line)).strip()


@pytest.mark.slow
def test_the_commands_run_and_print_what_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    printed: dict[str, list[str]] = {}
    for command, shown in commands():
        if command.startswith("cd "):
            monkeypatch.chdir(command[3:])
            continue
        text = answer(command).replace(str(tmp_path), CLONE)
        printed.setdefault(command, []).append(text)
        lines = iter([shape(line) for line in text.splitlines()])
        for line in shown:
            assert line == "…" or shape(line) in lines, f"{command}\nprints no longer, or not here: {line}\n{text}"
    # The survey that the questions led to is the one that the simulator wrote, and so is its rig.
    mine, made = (tomllib.loads(Path(f"{folder}/SURVEY.toml").read_text()) for folder in (".", "made"))
    assert mine["map"]["crs"] == made["map"]["crs"]
    for logs in (zip(a["logs"], b["logs"], strict=True) for a, b in zip(mine["runs"], made["runs"], strict=True)):
        for mine_log, made_log in logs:
            assert {**mine_log, "path": ""} == {**made_log, "path": ""}
    true_sensors = tomllib.loads(Path("made/truth/RIG.toml").read_text())["sensors"]
    for name, sensor in tomllib.loads(Path("RIG.toml").read_text())["sensors"].items():
        assert sensor == {key: true_sensors[name][key] for key in sensor}
    # The map errs by half of the wrong lever arm first: the adjustment cannot tell which head is wrong. Afterwards it
    # errs by no more than the trajectory does (σ 1 mm).
    before, after = ([float(v) for v in re.findall(r"(\S+) mm", text)] for text in printed["python truth.py"])
    assert all(9.0 < value < 11.0 for value in before)
    assert max(abs(v) for v in after) < 3.0
