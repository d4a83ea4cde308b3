"""Commands that remove what a store does not need, and that keep copies of raw logs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile, span_gps_ns
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


def forget(
    survey_file: SurveyFile,
    picture: Annotated[
        list[str] | None, typer.Option(metavar="RUN/CAMERA/FILE", help="A picture. May be repeated.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option("--list", help="File with a picture's name a line; - for standard input.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(metavar="RUN/CAMERA", help="All pictures of a camera between two times.")
    ] = None,
    span: Annotated[
        str | None,
        typer.Option(metavar="START/END", help="Two times, such as 2026-05-04T09:30:00Z/2026-05-04T09:30:10Z."),
    ] = None,
    why: Annotated[str, typer.Option(help="The reason, for the record.")] = "",
    archive: Annotated[
        list[str] | None,
        typer.Option(help="An archive that has copies, also of pictures that went before. May be repeated."),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove them. Without this, they are only listed.")] = False,
) -> None:
    """Remove pictures for people's privacy: their files and their copies in archives. It cannot be undone."""
    from roadscan.core.counted import counted
    from roadscan.core.errors import ConfigError
    from roadscan.run.session import Session
    from roadscan.survey.forget import choose_named, choose_taken
    from roadscan.survey.forget import forget as let_go

    names = [*(picture or ()), *(_lines(pictures) if pictures else ())]
    if not names and camera is None and not archive:
        expected = "--picture, --list, or --camera with --span; --archive alone takes those that went before"
        raise ConfigError("no picture is named", expected=expected)
    if span and camera is None:
        raise ConfigError(f"the span '{span}' without a camera", expected="START/END, and --camera RUN/CAMERA")
    first, last = span_gps_ns(span) if span else (None, None)
    session = Session.open(survey_file)
    with session.store.lock():
        chosen = choose_named(session, names)
        if camera is not None:
            chosen += choose_taken(session, camera, first, last)
        chosen = list(dict.fromkeys(chosen))
        if remove and (chosen or archive):
            told = let_go(session, chosen, why, archive or ())
    for one in chosen:
        typer.echo(one.name)
    if not remove:
        typer.echo(f"{counted(len(chosen), 'picture')}: nothing was removed: `--remove` does it, for ever")
        return
    if not chosen and not archive:
        typer.echo("no picture was taken then")
        return
    typer.echo(f"{counted(told.removed, 'picture')} removed, and {told.archived:,} of their copies in archives")
    for line in told.left:
        typer.echo(f"still there: {line}")
    typer.echo(
        "what was made of them is still there: `roadscan run` makes it anew, `roadscan publish` the page, "
        "`roadscan clean --remove` takes the rows that name them; other copies are yours to find"
    )
    raise typer.Exit(1 if told.left else 0)


def _lines(file: Path) -> list[str]:
    text = sys.stdin.read() if str(file) == "-" else file.read_text(encoding="utf-8")
    return [line.strip() for line in text.splitlines() if line.strip()]
