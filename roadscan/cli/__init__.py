"""The command line. Heavy imports happen inside the commands: `roadscan --help` must be quick.

Each module holds the commands of one group as plain functions; they become commands here, in the order of the help.
"""

from __future__ import annotations

import atexit
import gc
import io
import sys
from typing import Annotated, Final

import typer

from roadscan import __version__
from roadscan.cli import (
    cameras,
    cleaning,
    estimates,
    exports,
    fleets,
    inventory,
    logs,
    pages,
    ppk,
    profiles,
    queries,
    reports,
    runs,
    simulations,
    state,
)
from roadscan.cli.added_stages import Commands
from roadscan.cli.ending import ending_well

_OBJECTS: Final = 600_000
"""New objects after which Python looks for garbage: modules make many and none of it, and looking took a fifth of a
start, and a third of a short command at its end, where all is looked through once more."""

app = typer.Typer(
    name="roadscan",
    cls=Commands,
    help="Raw logs of a road survey in; pavement surfaces, point clouds and tables out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"roadscan {__version__}")
        raise typer.Exit


@app.callback()
def roadscan(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and end.")
    ] = False,
) -> None:
    """Raw logs of a road survey in; pavement surfaces, point clouds and tables out."""


app.command("run")(runs.run)
app.command("ingest")(runs.ingest)
app.command("navigate")(runs.navigate)
app.command("clocks")(estimates.clocks)
app.command("calibrate")(estimates.calibrate)
app.command("footprints")(runs.footprints)
app.command("tile")(runs.tile)
app.command("surfaces")(runs.surfaces)
app.command("products")(runs.make_products)
app.command("reprocess")(runs.reprocess)
app.command("plan")(state.plan)
app.command("status")(state.status)
app.command("verify")(state.verify)
app.command("clean")(cleaning.clean)
app.command("archive")(cleaning.archive)
app.command("forget")(cleaning.forget)
app.command("report")(reports.report)
app.command("compare")(reports.compare)
app.command("view")(pages.view)
app.command("publish")(pages.publish)
app.command("sql")(queries.sql)
app.command("where")(queries.where)
app.command("fleet")(fleets.fleet)

export = typer.Typer(
    cls=exports.Exports, help="Readings and pictures as files of other programs.", no_args_is_help=True
)
for exported in (exports.readings, exports.pictures, exports.colmap, exports.opensfm):
    export.command(exported.__name__)(exported)
app.add_typer(export, name="export")

app.command("classes")(exports.classes)
app.command("formats")(logs.list_formats)
app.command("inspect")(logs.inspect_files)
app.command("unpack")(logs.unpack_topic)
app.command("init")(logs.first_survey)
app.command("ppk")(ppk.ppk)
app.command("iri")(profiles.iri)
app.command("mpd")(profiles.mpd)
app.command("simulate")(simulations.simulate)
app.command("scenes")(simulations.list_scenes)
app.command("demo")(simulations.demo)

camera = typer.Typer(help="Interior orientation and mounting of cameras.", no_args_is_help=True)
camera.command("interior")(cameras.camera_interior)
camera.command("resect")(cameras.camera_resect)
camera.command("targets")(cameras.camera_targets)
app.add_typer(camera, name="camera")

assets = typer.Typer(help="The inventory of assets: what was found, and what people changed.", no_args_is_help=True)
for command in (
    inventory.publish, inventory.pull, inventory.status, inventory.diff, inventory.changes, inventory.history,
    inventory.undo, inventory.log, inventory.export,
):  # fmt: skip
    assets.command(command.__name__)(command)
app.add_typer(assets, name="inventory")


def _leave() -> None:
    """Let the process end without looking for garbage in what it leaves.

    DuckDB would tell of each of its objects that nobody frees, so theirs are looked for.
    """
    if "duckdb" not in sys.modules:
        gc.freeze()


def main() -> None:
    """Run the command line; an error the user can mend is printed without a traceback."""
    gc.set_threshold(_OBJECTS)
    atexit.register(_leave)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or pipe that knows no "─" or "σ" stops nothing
    ending_well(app)
