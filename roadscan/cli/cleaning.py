"""Commands that remove what a store does not need, and that keep copies of raw logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile
from roadscan.cli.terminal import new_reporter, print_table

_DAY_S = 86_400.0
"""Seconds of a day."""


def clean(
    survey_file: SurveyFile,
    what: Annotated[
        list[str] | None,
        typer.Option(help="Only this: superseded, damaged, unused or unrecorded. May be repeated.", show_default="all"),
    ] = None,
    product: Annotated[
        list[str] | None, typer.Option(help="Files of this product too; a run that is asked for it makes it again.")
    ] = None,
    older_than: Annotated[float, typer.Option(metavar="DAYS", help="Only what was written so many days ago.")] = 0.0,
    remove: Annotated[bool, typer.Option("--remove", help="Remove it. Without this, it is only listed.")] = False,
    every: Annotated[bool, typer.Option("--files", help="List each file.")] = False,
) -> None:
    """What the store holds that nothing needs, and its removal; raw logs and people's edits are never touched."""
    from roadscan.core.counted import size_in_words
    from roadscan.run.session import Session
    from roadscan.survey.clean import KINDS, remove_waste, summed, waste_of

    session = Session.open(survey_file)
    with session.store.lock():
        waste = waste_of(session, what or tuple(KINDS), product or (), older_than * _DAY_S)
        if remove:
            remove_waste(session, waste)
    rows = [(kind, f"{n:,}", size_in_words(size), KINDS.get(kind, "a product")) for kind, n, size in summed(waste)]
    if not rows:
        typer.echo("the store holds nothing that is not needed")
        return
    print_table(("what", "files", "size", "what it is"), rows, ("files", "size"))
    for one in waste if every else ():
        typer.echo(one.path)
    typer.echo("removed" if remove else "nothing was removed: `--remove` does it")


def archive(
    survey_file: SurveyFile,
    to: Annotated[str, typer.Option(metavar="FOLDER|URL", help="Where the archive is: a folder, or an object store.")],
    check: Annotated[bool, typer.Option("--check", help="Copy nothing: read all of the archive.")] = False,
    restore: Annotated[bool, typer.Option("--restore", help="Copy logs that are not at their places back.")] = False,
) -> None:
    """Copy the raw logs to another place, with proof that they are the bytes that were ingested."""
    from roadscan.core.counted import counted
    from roadscan.run.session import Session
    from roadscan.survey.archive import archive as keep
    from roadscan.survey.archive import check_archive
    from roadscan.survey.archive import restore as put_back

    if check and restore:
        raise typer.BadParameter("--check and --restore are two commands")
    session, reporter = Session.open(survey_file), new_reporter()

    def report(done: int, total: int) -> None:
        reporter.progress("archive", done, total)

    if check or restore:
        done = (check_archive if check else put_back)(session, to, report)
    else:
        done = keep(session, Path(survey_file), to, report)
    reporter.close()
    for line in (*done.faults, *(f"not ingested yet: {path}" for path in done.not_ingested)):
        typer.echo(line)
    told = [f"{counted(len(done.copied), 'file')} copied and read back"] if done.copied else []
    told += [f"{counted(len(done.restored), 'file')} restored"] if done.restored else []
    told += [f"{counted(len(done.there), 'file')} {'whole' if check else 'there'}"] if done.there else []
    told += [f"{counted(len(done.faults), 'fault')}"] if done.faults else []
    typer.echo(", ".join(told) or "nothing to do")
    raise typer.Exit(1 if done.faults else 0)
