"""Commands that ask: the tables, and the pictures of a place."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadscan.cli.arguments import SurveyOption
from roadscan.cli.terminal import print_table, print_whole

if TYPE_CHECKING:
    import pyarrow as pa

_MOST_ROWS = 200  # rows that a terminal shows


def sql(
    statement: Annotated[str, typer.Argument(help="DuckDB statement over the views (SHOW TABLES lists them).")],
    survey_file: SurveyOption,
    csv: Annotated[
        bool, typer.Option("--csv", help="Print comma-separated values: ISO times, plain numbers, lists as JSON.")
    ] = False,
    wide: Annotated[bool, typer.Option("--wide", help="Do not wrap lines at the terminal's width.")] = False,
    unconfined: Annotated[
        bool, typer.Option("--unconfined", help="Let the statement read and write any file that you may.")
    ] = False,
) -> None:
    """Ask the tables a question; `utc(epoch_gps_ns)` gives the UTC instant of an epoch.

    The statement reaches the store's files and memory alone. Ends with 1 where a damaged file is missing from the
    answer, or in it.
    """
    from roadscan.core.errors import AnswerError, StoreError
    from roadscan.run.session import Session
    from roadscan.survey.ask import ask

    session = Session.open(survey_file)
    damaged: list[StoreError] = []
    try:
        result = ask(session.survey, session.store, statement, damaged, unconfined=unconfined)
    finally:
        for error in damaged:
            typer.echo(f"{'damaged' if isinstance(error, AnswerError) else 'not shown'}: {error}", err=True)
    if csv:
        from roadscan.store.csv import write_csv

        write_csv(result, sys.stdout.buffer)
    else:
        _show(result, wide)
    raise typer.Exit(1 if damaged else 0)


def where(
    easting_m: Annotated[float, typer.Argument(metavar="EASTING", help="Easting on the map (m).")],
    northing_m: Annotated[float, typer.Argument(metavar="NORTHING", help="Northing on the map (m).")],
    survey_file: SurveyOption,
    height_m: Annotated[
        float | None, typer.Argument(metavar="[HEIGHT]", help="Height on the map (m); that of the ground by default.")
    ] = None,
    reach: Annotated[float, typer.Option(help="Farthest distance from a camera (m).")] = 60.0,
) -> None:
    """Pictures that see a place, the finest first, with the pixel that shows it. What stands between is not looked at.

    Write -- before coordinates that are negative.
    """
    from roadscan.run.session import Session
    from roadscan.site.where import pictures_of_place

    found = pictures_of_place(Session.open(survey_file), easting_m, northing_m, height_m, reach)
    rows = [
        (one.run, one.camera, f"{one.u_px:.1f}", f"{one.v_px:.1f}", f"{one.distance_m:.2f}",
         f"{1e3 * one.resolution_m:.1f}", str(one.file))
        for one in found
    ]  # fmt: skip
    print_table(("run", "camera", "u px", "v px", "distance m", "mm per px", "file"), rows)


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
