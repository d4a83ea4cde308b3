"""Commands that write about surveys: the report of one, the changes between two."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile


def report(
    survey_file: SurveyFile,
    out: Annotated[
        Path | None,
        typer.Option(help="Write the page here as well; its pictures lead into a site beside it."),
    ] = None,
) -> None:
    """One HTML page about the survey: what was recorded, made and found. It opens offline and prints on A4."""
    from roadscan.report.page import keep_report
    from roadscan.run.session import Session
    from roadscan.site.report_copy import linked_report, site_beside

    session = Session.open(survey_file)
    session.hear_of_damage()
    with session.store.lock():
        path = keep_report(session)
    if out is not None:
        out.write_bytes(linked_report(session.store.read_bytes(path), site_beside(out)))
    typer.echo(f"report: {out or session.store.path(path)}")


def compare(
    earlier: Annotated[Path, typer.Argument(metavar="EARLIER", help="Survey file of the earlier survey.")],
    later: Annotated[Path, typer.Argument(metavar="LATER", help="Survey file of the later survey.")],
    out: Annotated[Path | None, typer.Option(help="Write all changes: .csv, or .parquet with lines.")] = None,
) -> None:
    """Change of the road's condition between two surveys, section by section, and whether it is more than chance."""
    from roadscan.cli.terminal import print_table
    from roadscan.condition.tasks.compare import compare_surveys
    from roadscan.run.session import Session

    changes = compare_surveys(Session.open(earlier), Session.open(later))
    if out is not None:
        changes.write(out)
    print_table(("quantity", "sections", "larger", "smaller", "no change shown", "not judged"), changes.summary())
    if changes.alone:
        typer.echo(f"note: {changes.alone} sections of the later survey have none in the earlier one")
    if out is not None:
        typer.echo(f"changes: {out}")
