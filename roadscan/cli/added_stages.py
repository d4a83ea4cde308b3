"""Commands of stages that have none of their own: a stage that is added is a command without a further line."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from typing import Any, Final

import typer
from typer.core import TyperGroup

from roadscan.cli.arguments import AsJson, Dashboard, Scheduler, SurveyFile, Workers
from roadscan.core.plugins import files_at

_PLACE: Final = "**/stage.py"
_GROUP: Final = "roadscan.stages"
_NAME: Final = re.compile(r'^    name = "(\w+)"$', re.MULTILINE)
"""How a stage states its name."""


class Commands(TyperGroup):
    """The program's commands, and one for each further stage."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, in the order of the help."""
        known = super().list_commands(ctx)
        return known + [word for word in _added() if word not in known]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command by name; a stage is imported only when it is asked for."""
        return super().get_command(ctx, cmd_name) or _stage_command(cmd_name)


def _added() -> list[str]:
    """Names of stages that may be there, without importing them: as their files state them, and entry points."""
    own = {"ingest", "navigate", "footprints", "tiles", "surfaces", "products"}
    stated = {name for file in files_at(_PLACE) for name in _NAME.findall(file.read_text(encoding="utf-8"))}
    return sorted((stated | {entry.name for entry in entry_points(group=_GROUP)}) - own)


def _stage_command(word: str) -> Any:
    from roadscan.run.stage import stages

    stage = next((one for one in stages() if one.word == word), None)
    if stage is None:
        return None

    def run(
        survey_file: SurveyFile,
        workers: Workers = None,
        scheduler: Scheduler = None,
        dashboard: Dashboard = False,
        as_json: AsJson = False,
    ) -> None:
        from roadscan.cli.survey import Where, run_and_sum_up

        where = Where(workers if stage.uses_workers else 0, scheduler, dashboard)
        run_and_sum_up(survey_file, (stage,), where, as_json)

    one = typer.Typer(add_completion=False)
    one.command(word, help=f"{stage.title[0].upper()}{stage.title[1:]}.")(run)
    command = typer.main.get_command(one)
    command.name = word
    return command
