"""Commands that ask: the tables, the pictures of a place, and the places of pixels."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadscan.cli.arguments import SurveyOption, SurveyOrFleet, found_survey, options_apart
from roadscan.cli.terminal import arrow_alone, print_table, print_whole

if TYPE_CHECKING:
    import pyarrow as pa

    from roadscan.measuring.measure import MeasuredPlace
    from roadscan.run.session import Session

_MOST_ROWS = 200  # rows that a terminal shows


def sql(  # noqa: PLR0913  each is an option of the command
    statement: Annotated[str, typer.Argument(help="DuckDB statement over the views (SHOW TABLES lists them).")],
    survey_file: SurveyOrFleet = None,
    fleet: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="Ask all surveys of a folder or bucket at once: each table has a column survey; fleet is the "
            "catalogue.",
        ),
    ] = None,
    csv: Annotated[
        bool, typer.Option("--csv", help="Print comma-separated values: ISO times, plain numbers, lists as JSON.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a list of objects as JSON, and nothing else; values as in --csv.")
    ] = False,
    wide: Annotated[bool, typer.Option("--wide", help="Do not wrap lines at the terminal's width.")] = False,
    unconfined: Annotated[
        bool, typer.Option("--unconfined", help="Let the statement read and write any file that you may.")
    ] = False,
    timeout: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="Stop the statement after this time; 0: never.")
    ] = 600.0,
    memory: Annotated[
        float | None,
        typer.Option(
            min=0.01, metavar="GB", help="Memory for the statement, and as much for its answer; 40 % of the machine's."
        ),
    ] = None,
) -> None:
    """Ask the tables a question; `utc(epoch_gps_ns)` gives the UTC instant of an epoch.

    The statement reaches the store's files and memory alone. Ends with 1 where a damaged file is missing from the
    answer, or in it.
    """
    arrow_alone()
    from roadscan.core.errors import AnswerError, ConfigError, StoreError
    from roadscan.run.session import Session
    from roadscan.store.query.sql import Limits
    from roadscan.survey.ask import ask

    if fleet is not None and survey_file is not None:
        raise ConfigError("--fleet and --survey are both given", expected="one of them")
    limits = Limits(timeout, None if memory is None else round(memory * 1e9))
    damaged: list[StoreError] = []
    try:
        if fleet is not None:
            from roadscan.fleet.ask import ask_fleet

            result = ask_fleet(fleet, statement, damaged, unconfined=unconfined, limits=limits)
        else:
            session = Session.open(survey_file or found_survey())
            result = ask(session.survey, session.store, statement, damaged, unconfined=unconfined, limits=limits)
    finally:
        for error in damaged:
            typer.echo(f"{'damaged' if isinstance(error, AnswerError) else 'not shown'}: {error}", err=True)
    if csv:
        from roadscan.store.csv import write_csv

        write_csv(result, sys.stdout.buffer)
    elif as_json:
        from roadscan.store.csv import write_json

        write_json(result, sys.stdout.buffer)
    else:
        _show(result, wide)
    raise typer.Exit(1 if damaged else 0)


@dataclass(frozen=True)
class PictureOptions:
    """Pixels to be measured."""

    picture: Annotated[
        str | None, typer.Option(help="Measure in this picture: its path, or RUN/CAMERA/FILE; in place of a place.")
    ] = None
    pixel: Annotated[
        list[str] | None,
        typer.Option(metavar="U,V", help="A pixel of it, from the centre of the upper left one; several make a line."),
    ] = None
    second: Annotated[
        str | None, typer.Option(help="Another picture that shows the same: the place where both rays meet.")
    ] = None
    second_pixel: Annotated[str | None, typer.Option(metavar="U,V", help="Its pixel in that picture.")] = None
    sigma_pixel: Annotated[float, typer.Option(min=0.0, help="1 σ of a measured pixel, on each axis (pixels).")] = 0.5
    out: Annotated[Path | None, typer.Option(help="Write the line that was measured as GeoJSON.")] = None


@options_apart
def where(
    survey_file: SurveyOption,
    easting_m: Annotated[float | None, typer.Argument(metavar="[EASTING", help="Easting on the map (m).")] = None,
    northing_m: Annotated[float | None, typer.Argument(metavar="NORTHING]", help="Northing on the map (m).")] = None,
    height_m: Annotated[
        float | None, typer.Argument(metavar="[HEIGHT]", help="Height on the map (m); that of the ground by default.")
    ] = None,
    reach: Annotated[float, typer.Option(help="Farthest distance from a camera (m).")] = 60.0,
    asked: PictureOptions = PictureOptions(),
) -> None:
    """Pictures that see a place of the map, or, with --picture and --pixel, the place that a pixel shows, with its σ.

    Pictures come with the finest first, with the pixel that shows the place; what stands between is not looked at. A
    pixel's ray is followed to the surveyed ground that it meets first; with --second two rays meet without any ground.
    Write -- before coordinates that are negative.
    """
    from roadscan.core.errors import ConfigError
    from roadscan.run.session import Session

    if asked.picture is not None:
        if easting_m is not None:
            raise ConfigError("a place and --picture are both given", expected="one of them")
        _measure(Session.open(survey_file), asked, reach)
        return
    if easting_m is None or northing_m is None:
        raise ConfigError("where takes a place or a picture", expected="EASTING NORTHING, or --picture and --pixel")
    if asked != PictureOptions():
        raise ConfigError("options of a picture are given without it", expected="--picture FILE")
    from roadscan.site.where import pictures_of_place

    found = pictures_of_place(Session.open(survey_file), easting_m, northing_m, height_m, reach)
    rows = [
        (one.run, one.camera, f"{one.u_px:.1f}", f"{one.v_px:.1f}", f"{one.sigma_u_px:.1f}", f"{one.sigma_v_px:.1f}",
         f"{one.distance_m:.2f}", f"{1e3 * one.resolution_m:.1f}", str(one.file))
        for one in found
    ]  # fmt: skip
    print_table(("run", "camera", "u px", "v px", "σ u px", "σ v px", "distance m", "mm per px", "file"), rows)


def _measure(session: Session, asked: PictureOptions, reach_m: float) -> None:
    """Print the places of pixels; ends with 1 where none has one."""
    from roadscan.core.errors import ConfigError
    from roadscan.georeference.plan.plan import plan_of
    from roadscan.measuring.measure import measure, meet
    from roadscan.measuring.words import write_geojson_of

    picture, pixels = asked.picture or "", [_pixel_of(text) for text in asked.pixel or ()]
    if not pixels:
        raise ConfigError("--picture without --pixel", expected="--pixel U,V, once or more")
    if (asked.second is None) != (asked.second_pixel is None) or (asked.second is not None and len(pixels) != 1):
        raise ConfigError("two pictures take a pixel each", expected="--pixel U,V --second FILE --second-pixel U,V")
    if asked.second is not None and asked.second_pixel is not None:
        if asked.out is not None:
            raise ConfigError("--out takes what was measured in one picture", expected="no --out with --second")
        place, gap_m = meet(
            session, (picture, asked.second), (pixels[0], _pixel_of(asked.second_pixel)), asked.sigma_pixel
        )
        _print_places([place])
        typer.echo(f"the rays pass each other by {1e3 * gap_m:.1f} mm")
        return
    measured = measure(session, picture, pixels, asked.sigma_pixel, reach_m)
    _print_places(measured.places)
    if measured.assumed:
        typer.echo(f"note: {measured.assumed}")
    if asked.out is not None:
        count = write_geojson_of(asked.out, measured, plan_of(session).ground.map)
        typer.echo(f"{count} of {len(measured.places)} places in {asked.out}")
    if all(one.reason for one in measured.places):
        raise typer.Exit(1)


def _pixel_of(text: str) -> tuple[float, float]:
    """The pixel of ``U,V``; raises ConfigError where it is none."""
    from roadscan.core.errors import ConfigError

    try:
        u, v = (float(one) for one in text.split(","))
    except ValueError as error:
        raise ConfigError(f"the pixel '{text}'", expected="U,V such as 412.5,318.2") from error
    return u, v


def _print_places(places: Sequence[MeasuredPlace]) -> None:
    head = (
        "u px",
        "v px",
        "easting m",
        "northing m",
        "height m",
        "σ east mm",
        "σ north mm",
        "σ height mm",
        "distance m",
    )
    rows = []
    for one in places:
        pixel = f"{one.u_px:g}", f"{one.v_px:g}"
        if one.reason:
            rows.append((*pixel, *[""] * 7))
            continue
        sigmas = (f"{1e3 * s:.1f}" for s in one.sigma_m.tolist())
        rows.append((*pixel, *(f"{v:.4f}" for v in one.place_m.tolist()), *sigmas, f"{one.distance_m:.2f}"))
    print_table(head, rows)
    for one in places:
        for text in filter(None, (one.reason, one.warning)):
            typer.echo(f"pixel {one.u_px:g} {one.v_px:g}: {text}")


def _show(result: pa.Table, wide: bool) -> None:
    """Print the first rows, each value whole."""
    shown = result.slice(0, _MOST_ROWS)
    show = print_table if wide or not sys.stdout.isatty() else print_whole
    show(tuple(result.column_names), [tuple(cell_text(v) for v in row) for row in _rows(shown)])
    if result.num_rows > shown.num_rows:
        typer.echo(f"… {result.num_rows:,} rows in all (--csv prints them)")


def _rows(table: pa.Table) -> list[tuple[Any, ...]]:
    """Rows by the place of their columns: two may have one name."""
    return list(zip(*(column.to_pylist() for column in table.columns), strict=True))


def cell_text(value: Any) -> str:
    """What a table shows of a value, whole."""
    if isinstance(value, float):
        return number_text(value)
    return "" if value is None else str(value)


def number_text(value: float) -> str:
    """Six digits, and millimetres of what is as large as a coordinate."""
    return f"{value:.3f}" if 1e5 <= abs(value) < 1e9 else f"{value:.6g}"
