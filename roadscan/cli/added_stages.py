"""Commands of stages that have none of their own: a stage that is added is a command without a further line."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from roadscan.cli.arguments import AsJson, Dashboard, Scheduler, SurveyFile, Workers

_FOLDER = Path(__file__).resolve().parents[1] / "jobs" / "stages"
_GROUP = "roadscan.stages"


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
    """Names of stages that may be there, without importing them: files of the folder, and entry points."""
    own = {"ingest", "navigate", "footprints", "tiles", "surfaces", "products"}
    files = {file.stem for file in _FOLDER.glob("[a-z]*.py")} | {f.parent.name for f in _FOLDER.glob("*/__init__.py")}
    return sorted((files | {entry.name for entry in entry_points(group=_GROUP)}) - own)


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
