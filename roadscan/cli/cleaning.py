"""The command that removes what a store does not need."""

from __future__ import annotations

from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile
from roadscan.cli.terminal import print_table

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
