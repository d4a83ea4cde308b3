"""The examples of docs/condition.md run, and its commands print what stands there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan.cli import app

PAGE = Path(__file__).resolve().parents[2] / "docs" / "condition.md"


def test_the_examples_run_and_print_what_the_page_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = PAGE.read_text()
    names: dict[str, object] = {}
    for example in re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL):
        exec(compile(example, str(PAGE), "exec"), names)
    (shown,) = re.findall(r"^```\n(\$ roadscan.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    commands = re.findall(r"^\$ roadscan (.*)\n((?:[^$].*\n)+)", shown, flags=re.MULTILINE)
    assert len(commands) == 2
    for command, printed in commands:
        outcome = CliRunner().invoke(app, shlex.split(command))
        assert outcome.exit_code == 0, outcome.output
        assert outcome.stdout == printed
