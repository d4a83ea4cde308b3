"""The command that writes the report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile


def report(
    survey_file: SurveyFile,
    out: Annotated[Path | None, typer.Option(help="Write the page here as well.")] = None,
) -> None:
    """One HTML page about the survey: what was recorded, made and found. It opens offline and prints on A4."""
    from roadscan.jobs.report.page import keep_report
    from roadscan.jobs.session import Session

    session = Session.open(survey_file)
    session.hear_of_damage()
    with session.store.lock():
        path = keep_report(session)
    if out is not None:
        out.write_bytes(session.store.read_bytes(path))
    typer.echo(f"report: {out or session.store.path(path)}")
