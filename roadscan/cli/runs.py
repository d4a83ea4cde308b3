"""Commands that run a survey: all of it, one stage, or some tiles."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadscan.cli.arguments import (
    USUAL,
    AsJson,
    Dashboard,
    Scheduler,
    SurveyFile,
    Workers,
    options_apart,
    span_gps_ns,
    surveys_for,
)
from roadscan.cli.state import plan
from roadscan.cli.survey import Where, run_and_sum_up, run_survey, sum_up
from roadscan.cli.terminal import print_json, print_table

if TYPE_CHECKING:
    from roadscan.run.session import Selection


@dataclass(frozen=True)
class ToldOptions:
    """Files that a run writes about itself."""

    events: Annotated[
        Path | None,
        typer.Option(help="Append the run's events to this file, as lines of JSON (also: ROADSCAN_EVENTS)."),
    ] = None
    metrics: Annotated[
        Path | None,
        typer.Option(
            help="Write the run's figures for Prometheus to this file FILE.prom, or into this folder (also: "
            "ROADSCAN_METRICS)."
        ),
    ] = None


@options_apart
def run(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
    told: ToldOptions = ToldOptions(),
    flow: Annotated[bool, typer.Option("--flow", help="Record a Prefect flow run even without an API.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done: `plan`.")] = False,
) -> None:
    """Run a survey: all stages, from ingest to condition and assets, and the report. Does only what is due."""
    if dry_run:
        plan(survey_file, workers, as_json)
    if flow or os.environ.get("PREFECT_API_URL"):
        from roadscan.core.errors import ConfigError
        from roadscan.flows.conduct import require_api
        from roadscan.flows.survey import survey

        if dashboard:
            raise ConfigError("--dashboard of a flow run", expected="a run without Prefect", change="leave one out")
        require_api()
        survey(str(survey_file), workers, scheduler, *(str(f) if f else None for f in (told.events, told.metrics)))
        sum_up(survey_file, as_json)
        return
    where = Where(workers, scheduler, dashboard, told.events, told.metrics)
    run_and_sum_up(survey_file, None, where, as_json)


def ingest(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Raw logs into tables."""
    run_and_sum_up(survey_file, ["ingest"], Where(workers, scheduler, dashboard), as_json)


def navigate(survey_file: SurveyFile, as_json: AsJson = False) -> None:
    """Trajectories from GNSS, IMU and odometer, and clocks from shared motion."""
    from roadscan.ingest.ingest import survey_records
    from roadscan.navigation.tasks.navigate import plan_trajectories

    run = run_survey(survey_file, ["navigate"], Where(0))
    if as_json:
        sum_up(survey_file, as_json)
    elif not plan_trajectories(run.survey, run.store, survey_records(run.survey, run.store)):
        typer.echo("no trajectory to compute: each run has a trajectory log, or no GNSS and IMU")


def footprints(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Which raw block touches which tile."""
    run_survey(survey_file, ["footprints"], Where(workers, scheduler, dashboard))
    if as_json:
        sum_up(survey_file, as_json)


def tile(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Readings into points, cells and tile files."""
    run_and_sum_up(survey_file, ["tiles"], Where(workers, scheduler, dashboard), as_json)


def surfaces(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Cells or points of tiles into the reconstructed surface and its files (section `surface` of the survey file)."""
    run_and_sum_up(survey_file, ["surfaces"], Where(workers, scheduler, dashboard), as_json)


def make_products(
    survey_file: Annotated[
        Path | None,
        typer.Argument(
            metavar=USUAL,
            help="Make its products; without it, list all there are.",
            autocompletion=surveys_for,
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Mosaics, pictures and tables over all tiles; without a survey file, list the products there are."""
    if survey_file is not None:
        run_and_sum_up(survey_file, ["products"], Where(workers, scheduler, dashboard), as_json)
        return
    from roadscan.tiles.product import SurfaceProduct, TileProduct, products

    of = {TileProduct: "tile", SurfaceProduct: "surface"}
    made = {"any": "yes", "fine": "of cells below 2 cm", "coarse": "of cells of 2 cm or more"}
    rows = [
        (
            name,
            next((word for kind, word in of.items() if isinstance(p, kind)), "survey"),
            made[p.default_cells] if p.default else "on request",
            p.title,
        )
        for name, p in products().items()
    ]
    head = ("product", "of", "made", "what")
    if as_json:
        print_json([dict(zip(head, row, strict=True)) for row in rows])
        return
    print_table(head, rows)


def reprocess(
    survey_file: SurveyFile,
    tiles: Annotated[list[str] | None, typer.Option("--tile", help="Tile COLUMN_ROW; may be repeated.")] = None,
    bbox: Annotated[str | None, typer.Option(help="WEST,SOUTH,EAST,NORTH on the map, metres.")] = None,
    span: Annotated[str | None, typer.Option(help="START/END in UTC, such as 2026-05-04T09:30:00Z/….")] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    dashboard: Dashboard = False,
    as_json: AsJson = False,
) -> None:
    """Compute some tiles once more, whether stale or not."""
    from roadscan.core.errors import ConfigError

    if not (tiles or bbox or span):
        raise ConfigError("nothing was chosen", expected="--tile, --bbox or --span")
    done = run_and_sum_up(survey_file, None, Where(workers, scheduler, dashboard), as_json, selected(tiles, bbox, span))
    typer.echo(f"read {done.raw_bytes_read / 1e6:,.1f} MB of readings", err=as_json)


def selected(tiles: list[str] | None, bbox: str | None, span: str | None) -> Selection:
    """The selection of tiles that the options state."""
    from roadscan.core.errors import ConfigError
    from roadscan.core.grid import Bounds, TileId
    from roadscan.run.session import Selection

    box = times = None
    if bbox is not None:
        try:
            west, south, east, north = (float(part) for part in bbox.split(","))
        except ValueError:
            raise ConfigError(f"--bbox {bbox}", expected="WEST,SOUTH,EAST,NORTH in metres") from None
        box = Bounds(west, south, east, north)
    if span is not None:
        times = span_gps_ns(span)
    return Selection(tuple(TileId.parse(t) for t in tiles or ()), box, times)
