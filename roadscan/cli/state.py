"""Commands that look after a store: what is there, what is due, and whether it is whole."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadscan.cli.arguments import SurveyFile
from roadscan.cli.terminal import new_reporter, print_table

if TYPE_CHECKING:
    from roadscan.survey.status import Status


def status(survey_file: SurveyFile) -> None:
    """What is ingested, current, stale and failed, and what the next run would do."""
    found = found_status(survey_file)
    print_status(found, survey_file)
    if not found.is_complete:
        raise typer.Exit(1)


def verify(
    survey_file: SurveyFile,
    repair: Annotated[
        bool, typer.Option("--repair", help="Read the logs of damaged tables again, or say what is lost.")
    ] = False,
    accept_losses: Annotated[
        bool, typer.Option("--accept-losses", help="Accept that rows whose logs are gone are lost; they stay listed.")
    ] = False,
) -> None:
    """Read every file the store should hold, and say which are missing or damaged, and which rows are lost."""
    from roadscan.core.counted import counted
    from roadscan.inventory.of_survey import inventory_faults
    from roadscan.run.session import Session
    from roadscan.store.salvage import read_lost
    from roadscan.survey.repair import accept_losses as accept
    from roadscan.survey.repair import repair_store
    from roadscan.survey.status import verify_store

    session, reporter = Session.open(survey_file), new_reporter()
    told: list[str] = []
    if repair:
        mended = repair_store(session.survey, session.store, lambda d, t: reporter.progress("verify", d, t))
        faults, told = mended.faults, mended.lines
    else:
        faults = verify_store(session.store, lambda d, t: reporter.progress("verify", d, t))
    faults += inventory_faults(session.survey)
    reporter.close()
    if accept_losses:
        accept(session.store)
    lost = read_lost(session.store)
    for line in [*told, *(f"lost: {one.told}" for one in lost), *faults]:
        typer.echo(line)
    rows = sum(one.rows for one in lost)
    gone = f"; {counted(rows, 'row')} {'is' if rows == 1 else 'are'} lost" if lost else ""
    are = "is" if len(faults) == 1 else "are"
    whole = f"{counted(len(faults), 'file')} {are} not whole" if faults else "every file is whole"
    typer.echo(f"{whole}{gone}")
    raise typer.Exit(1 if faults or any(not one.accepted for one in lost) else 0)


def found_status(survey_file: Path) -> Status:
    """The state of a survey's store."""
    from roadscan.run.session import Session
    from roadscan.survey.status import survey_status

    return survey_status(Session.open(survey_file))


def print_status(found: Status, survey_file: Path) -> None:
    """Print the state of a survey."""
    typer.echo(f"survey file: {survey_file}")
    print_table(
        ("run", "sensor", "log", "format", "state", "rows", "rejected", "bytes"),
        [
            (x["run"], x["sensor"], x["path"], x["format"], x["state"], f"{x['rows']:,}", f"{x['rejected']:,}",
             f"{x['bytes']:,}")
            for x in found.logs
        ],
    )  # fmt: skip
    for log in found.unused_logs:
        typer.echo(f"in the store, not in the survey file: {log}")
    if found.readings:
        typer.echo("readings: " + ", ".join(f"{n.replace('_', ' ')} {c:,}" for n, c in found.readings.items()))
    for line in (line for state in found.stages.values() for line in state.lines):
        typer.echo(line)
    typer.echo(
        f"no tiles: {found.note or found.places_nothing}"
        if found.note or found.places_nothing
        else f"tiles: {found.of('tiles').current:,} current, {found.of('tiles').stale:,} to do"
    )
    if found.outputs:
        typer.echo("files: " + ", ".join(f"{n} {c:,}" for n, c in sorted(found.outputs.items())))
    if empty := found.of("tiles").empty:
        typer.echo(f"tiles looked at that hold no reading: {empty:,}")
    for record in found.damaged:
        typer.echo(f"damaged: {record}")
    for lost in found.lost:
        typer.echo(f"lost: {lost.told}")
    for note in found.notes:
        typer.echo(f"note: {note}")
    for cause in found.would_fail:
        typer.echo(f"a run would fail: {cause}")
    for failure in found.failures:
        typer.echo(f"failed in the last run: {failure['stage']} {failure['unit']}: {failure['reason']}")
    if found.next_run:
        typer.echo("next run: " + ", ".join(f"{n.replace('_', ' ')} {c:,}" for n, c in found.next_run.items()))
