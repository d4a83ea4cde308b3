"""Answers the questions of a first survey as its reader would: the lines that begin with #?, and no other."""

from __future__ import annotations

import re
from pathlib import Path

from typer.testing import CliRunner, Result

from roadscan.cli import app
from roadscan.core.strict import OPEN_QUESTION


def roadscan(*words: str | Path) -> Result:
    """The command line, in this process."""
    return CliRunner().invoke(app, [str(word) for word in words])


def first_survey(logs: Path) -> tuple[Path, str]:
    """The survey file that `roadscan init` writes beside a folder of logs, and what it printed."""
    survey_file = logs.parent / "SURVEY.toml"
    done = roadscan("init", logs, "--out", survey_file)
    assert done.exit_code == 0, done.output
    return survey_file, done.stdout


def answer_questions(file: Path, answers: dict[str, str]) -> int:
    """Put whole lines in place of the questions of a survey or rig file; how many there were.

    Parameters
    ----------
    answers : line by the question's key, with its table where that is not a log's ("map.crs"). A question that they
        do not know fails the test: the reader would have been asked something unexpected.
    """
    table, count, lines = "", 0, []
    for line in file.read_text(encoding="utf-8").splitlines():
        table = line.strip("[]") if line.startswith("[") else table
        question = re.match(rf"{re.escape(OPEN_QUESTION)} (\S+) = ", line)
        count += question is not None
        key = "" if question is None else question[1] if table == "runs.logs" else f"{table}.{question[1]}"
        lines.append(answers[key] if key else line)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return count


def spared(survey_file: Path) -> None:
    """Leave out what takes time and moves no point: most products, and cells of 5 mm."""
    text = survey_file.read_text(encoding="utf-8")
    survey_file.write_text(text + '\n[tiles]\ncell_m = 0.2\n\n[products]\nmake = ["las"]\n', encoding="utf-8")
