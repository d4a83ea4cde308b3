"""Commands before a survey: the formats there are, what a file is, and a first survey file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from roadscan.cli.arguments import PlainJson, formats_for
from roadscan.cli.terminal import arrow_alone, looking, print_json, print_table

_MOST_REJECTS: Final = 20  # messages that are listed singly


def list_formats(
    name: Annotated[
        str | None,
        typer.Argument(help="Show the settings of one format.", show_default=False, autocompletion=formats_for),
    ] = None,
    as_json: PlainJson = False,
) -> None:
    """Raw formats that can be read, and what they yield."""
    from roadscan.core.strict import meanings
    from roadscan.ingest.reading.format import format_named, log_formats

    if as_json:
        chosen = log_formats() if name is None else {name: format_named(name)}
        print_json([{"format": n, "yields": f.yields, "title": f.title, "time": f.time} for n, f in chosen.items()])
        return
    if name is None:
        rows = [(n, ", ".join(f.yields), f.title) for n, f in log_formats().items()]
        print_table(("format", "yields", "what"), rows)
        return
    found = format_named(name)
    typer.echo(f"{found.name}: {found.title}\nyields: {', '.join(found.yields)}\ntime: {found.time}")
    for field, meaning in meanings(found.options).items():
        info = found.options.model_fields[field]
        default = "required" if info.is_required() else f"default {info.default!r}"
        typer.echo(f"  options.{field} ({default}): {meaning}")


def inspect_files(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE…", help="Files or folder logs.", show_default=False, readable=False),
    ],
    clock: Annotated[
        str | None, typer.Option(help="Time system, such as gps_week_seconds,week=2405 or unix_utc,unit=us.")
    ] = None,
    crs: Annotated[str | None, typer.Option(help='CRS of positions, such as EPSG:4979 or "local".')] = None,
    height: Annotated[
        Literal["ellipsoidal", "orthometric"] | None,
        typer.Option(help="Kind of heights, where neither the file nor its CRS says it."),
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option("--option", help="Setting of the format, key=value; may be repeated.")
    ] = None,
    format_name: Annotated[
        str | None, typer.Option("--format", help="Read as this format.", autocompletion=formats_for)
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Read only the beginning.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: a list, one entry a file.")] = False,
) -> None:
    """Say of any file what it is, what it holds, its time span and extent, and what is wrong with it.

    Ends with 0 if all files can be read (faults of single records do not count), with 2 if one cannot.
    """
    arrow_alone()
    from roadscan.ingest.inspect.inspect import inspect
    from roadscan.ingest.inspect.provisional import Stated, parse_clock, parse_option

    stated = Stated(
        clock=None if clock is None else parse_clock(clock),
        crs=crs,
        height=height,
        options=dict(parse_option(one) for one in option or ()),
    )
    found = []
    for file in files:
        with looking(file) as progress:
            found.append(inspect(file, stated, format_name, quick=quick, progress=progress))
        if not as_json:
            from roadscan.ingest.inspect.inspect_text import print_inspection

            print_inspection(found[-1])
    if as_json:
        import json

        typer.echo(json.dumps([one.as_json() for one in found], indent=2, ensure_ascii=False))
    raise typer.Exit(0 if all(one.readable for one in found) else 2)


def first_survey(
    folder: Annotated[Path, typer.Argument(help="Folder of raw logs, looked through recursively.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Survey file to write; RIG.toml is written beside it.")] = Path(
        "SURVEY.toml"
    ),
) -> None:
    """Look through a folder of logs and write a first survey file for you to complete."""
    from roadscan.ingest.inspect.first_survey import find_logs, need_folder
    from roadscan.ingest.inspect.first_survey_text import refuse_to_overwrite, write_first_survey

    need_folder(folder)
    refuse_to_overwrite(out)
    with looking(folder) as progress:
        found = find_logs(folder, progress)
    made = write_first_survey(found, out)
    print_table(
        ("run", "sensor", "log", "format", "to state"),
        [
            (run.id, log.sensor or "", os.path.relpath(log.path, found.folder), log.format.name,
             ", ".join(need.key for need in log.needs))
            for run in [*found.runs, *found.further]
            for log in run.logs
        ],
    )  # fmt: skip
    for log, companion, setting in found.pairs:
        names = [os.path.relpath(one.path, found.folder) for one in (companion, log)]
        typer.echo(f"paired: {names[0]} with {names[1]}, as its options.{setting}")
    for log in found.odometries:
        place = os.path.relpath(log.path, found.folder)
        typer.echo(
            f"not listed: {log.stem} of {place}: poses from an origin of their own; IMU and GNSS make the trajectory"
        )
    for path, words in found.unknown:
        typer.echo(f"not understood: {os.path.relpath(path, found.folder)}: {words}")
    written = " and ".join(str(file) for file in (made.survey_file, made.rig_file) if file is not None)
    typer.echo(f"written: {written}, with {made.questions} lines to complete (they begin with #?)")


def unpack_topic(
    bag: Annotated[Path, typer.Argument(help="ROS bag: a file or a folder.", show_default=False)],
    topic: Annotated[str, typer.Argument(help="Topic, such as /camera/image_raw.", show_default=False)],
    folder: Annotated[Path, typer.Argument(help="Folder to write to; it is made.", show_default=False)],
) -> None:
    """Write pictures of a bag's topic with their stamps, or pairs of stamps of any other topic, as files.

    The format images reads such pictures; clock.pairs.table reads such pairs.
    """
    from roadscan.formats.ros.overview import unpack

    made = unpack(bag, topic, folder)
    typer.echo(f"written: {made.table}, {made.rows:,} rows")
    for reject in made.rejects[:_MOST_REJECTS]:
        typer.echo(f"left out: message {reject.record}: {reject.reason}")
    if len(made.rejects) > _MOST_REJECTS:
        typer.echo(f"left out: {len(made.rejects) - _MOST_REJECTS:,} more")
