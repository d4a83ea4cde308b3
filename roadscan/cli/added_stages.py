"""Commands of stages that have none of their own: a stage that is added is a command without a further line."""

from __future__ import annotations

import functools
import re
from typing import Any, Final

import typer
from typer.core import TyperGroup

from roadscan.cli.arguments import AsJson, Dashboard, Scheduler, SurveyFile, Workers
from roadscan.core.plugins import added, files_at

_PLACE: Final = "**/stage.py"
_GROUP: Final = "roadscan.stages"
_STATED: Final = re.compile(r'^    name = "(\w+)"\n    title = "(.+)"$', re.MULTILINE)
"""How a stage states its name and what it makes."""


class Commands(TyperGroup):
    """The program's commands, and one for each further stage."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, in the order of the help."""
        known = super().list_commands(ctx)
        return known + [word for word in _added() if word not in known]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command by name; a stage of roadscan is imported when its command runs."""
        return super().get_command(ctx, cmd_name) or _stage_command(cmd_name)


@functools.cache
def _stated() -> dict[str, str]:
    """Titles of roadscan's stages by name, as their files state them: importing all stages takes seconds."""
    return dict(one for file in files_at(_PLACE) for one in _STATED.findall(file.read_text(encoding="utf-8")))


def _added() -> list[str]:
    """Names of stages that may be there: those that are stated, and entry points."""
    own = {"ingest", "navigate", "footprints", "tiles", "surfaces", "products"}
    return sorted((_stated().keys() | {entry.name for entry in added(_GROUP)}) - own)


def _stage_command(word: str) -> Any:
    title = _stated().get(word) or _title_of_added(word)
    if title is None:
        return None

    def run(
        survey_file: SurveyFile,
        workers: Workers = None,
        scheduler: Scheduler = None,
        dashboard: Dashboard = False,
        as_json: AsJson = False,
    ) -> None:
        from roadscan.cli.survey import Where, run_and_sum_up

        run_and_sum_up(survey_file, [word], Where(workers, scheduler, dashboard), as_json)

    one = typer.Typer(add_completion=False)
    one.command(word, help=f"{title[0].upper()}{title[1:]}.")(run)
    command = typer.main.get_command(one)
    command.name = word
    return command


def _title_of_added(word: str) -> str | None:
    """Title of a stage that another package adds; None where there is none of this name."""
    if not added(_GROUP):
        return None
    from roadscan.run.stage import stages

    return next((one.title for one in stages() if one.word == word), None)
