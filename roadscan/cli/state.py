"""Commands that look after a store: what is there, what is due, and whether it is whole."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from roadscan.cli.arguments import PlainJson, SurveyFile, Workers
from roadscan.cli.terminal import arrow_alone, new_reporter, print_json, print_table

if TYPE_CHECKING:
    from roadscan.survey.plan import PlannedStage, RunPlan
    from roadscan.survey.status import Status

_PLAN_NUMBERS: Final = ("current", "due", "unknown", "tasks", "raw bytes", "a worker")
_PIPE_COLUMNS: Final = 120
"""Width of a plan in letters where there is no terminal."""


def status(survey_file: SurveyFile, as_json: PlainJson = False) -> None:
    """What is ingested, current, stale and failed, and how much is due."""
    found = found_status(survey_file)
    if as_json:
        print_json(found.as_json())
    else:
        print_status(found, survey_file)
    if not found.is_complete:
        raise typer.Exit(1)


def plan(
    survey_file: SurveyFile,
    workers: Workers = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the plan as one JSON object, and nothing else.")
    ] = False,
    picture: Annotated[Path | None, typer.Option(help="Draw it, too: a file FILE.svg.")] = None,
) -> None:
    """What the next run would do, stage by stage; reads no log through and writes nothing."""
    from roadscan.core.errors import ConfigError
    from roadscan.survey.plan import plan_picture

    if picture is not None and picture.suffix != ".svg":
        raise ConfigError(f"--picture {picture}", expected="a name that ends with .svg")
    found = found_plan(survey_file, workers)
    if picture is not None:
        picture.write_text(plan_picture(found), encoding="utf-8")
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=2, ensure_ascii=False))
    else:
        print_plan(found)
    raise typer.Exit(2 if found.would_fail else 0)


def verify(
    survey_file: SurveyFile,
    repair: Annotated[
        bool, typer.Option("--repair", help="Read the logs of damaged tables again, or say what is lost.")
    ] = False,
    accept_losses: Annotated[
        bool, typer.Option("--accept-losses", help="Accept that rows whose logs are gone are lost; they stay listed.")
    ] = False,
    as_json: PlainJson = False,
) -> None:
    """Read every file the store should hold, and say which are missing or damaged, and which rows are lost."""
    from roadscan.core.counted import counted
    from roadscan.inventory.of_survey import inventory_faults
    from roadscan.run.session import Session
    from roadscan.store.salvage import read_lost
    from roadscan.survey.forget import still_there
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
    faults += [*inventory_faults(session.survey), *still_there(session)]
    reporter.close()
    if accept_losses:
        accept(session.store)
    lost = read_lost(session.store)
    code = 1 if faults or any(not one.accepted for one in lost) else 0
    if as_json:
        print_json({"faults": faults, "repaired": told, "lost": [one.as_json() for one in lost]})
        raise typer.Exit(code)
    for line in [*told, *(f"lost: {one.told}" for one in lost), *faults]:
        typer.echo(line)
    rows = sum(one.rows for one in lost)
    gone = f"; {counted(rows, 'row')} {'is' if rows == 1 else 'are'} lost" if lost else ""
    are = "is" if len(faults) == 1 else "are"
    whole = f"{counted(len(faults), 'file')} {are} not whole" if faults else "every file is whole"
    typer.echo(f"{whole}{gone}")
    raise typer.Exit(code)


def found_plan(survey_file: Path, workers: int | None) -> RunPlan:
    """What the next run would do."""
    from roadscan.core.survey import Survey
    from roadscan.store.store import Store
    from roadscan.survey.plan import run_plan

    survey = Survey.load(survey_file)
    return run_plan(survey, Store(survey.store_url, survey.config.id), workers)


def print_plan(found: RunPlan) -> None:
    """Print what the next run would do; lists of names are cut to the width of the terminal."""
    from roadscan.core.counted import counted

    typer.echo(f"survey {found.survey}, in {found.store}; {counted(found.workers, 'worker')}")
    print_table(("stage", "after", "of", *_PLAN_NUMBERS, "key", "why"), [*map(_plan_row, found.stages)], _PLAN_NUMBERS)
    typer.echo()
    half = (shutil.get_terminal_size((_PIPE_COLUMNS, 0)).columns - 14) // 2
    rows = [(x.name, _cut(x.reads, half), _cut(x.written, half)) for x in found.stages if x.reads or x.writes]
    print_table(("stage", "reads", "writes, files by now"), rows)
    if not any(x.state in ("due", "waits") for x in found.stages):
        typer.echo("nothing is due")
    for note in found.notes:
        typer.echo(f"note: {note}")
    for cause in found.would_fail:
        typer.echo(f"a run would fail: {cause}")


def _plan_row(one: PlannedStage) -> tuple[str, ...]:
    from roadscan.core.counted import size_in_words

    if one.is_passed_over:
        return (one.name, ", ".join(one.after), "", *[""] * len(_PLAN_NUMBERS), "", one.note)
    counts = ["?" if n is None else f"{n:,}" for n in (one.current, one.due, one.unknown)]
    costs = [(one.tasks, "{:,}".format), (one.raw_bytes, size_in_words), (one.worker_memory_bytes, size_in_words)]
    told = ["" if not one.due else "?" if n is None else words(n) for n, words in costs]
    return (one.name, ", ".join(one.after), one.units, *counts, *told, one.keys_in_words, one.reasons)


def _cut(names: Sequence[str], width: int) -> str:
    """Names as far as they fit, and how many are left."""
    fit = len(names)
    while fit > 1 and len(_some(names, fit)) > width:
        fit -= 1
    return _some(names, fit)


def _some(names: Sequence[str], count: int) -> str:
    left = len(names) - count
    return ", ".join(names[:count]) + (f" and {left:,} more" if left else "")


def found_status(survey_file: Path) -> Status:
    """The state of a survey's store."""
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # Arrow's own keeps a third more; not loaded by now
    arrow_alone()
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
    if found.due:
        typer.echo("next run: " + ", ".join(f"{stage} {count:,}" for stage, count in found.due.items()))
