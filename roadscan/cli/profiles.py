"""Commands for those who have only a profile: its roughness, its texture."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadscan.cli.terminal import print_table

if TYPE_CHECKING:
    from roadscan.condition.profiles.profile_files import ProfileFile
    from roadscan.condition.profiles.tables import ProfileTable

ProfileArgument = Annotated[
    Path, typer.Argument(metavar="FILE", help="ERD, or columns of text: a station and heights to a line.",
                         show_default=False)
]  # fmt: skip
XUnit = Annotated[
    str | None, typer.Option("--x-unit", help="Unit of stations, where the file does not say it: m, mm, ft …")
]
HeightUnit = Annotated[str | None, typer.Option("--height-unit", help="Unit of heights, likewise.")]
Columns = Annotated[
    str | None,
    typer.Option(help="Columns of stations and heights by name or number, such as 2,3; of ERD, the channels."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def iri(
    file: ProfileArgument,
    segment: Annotated[float | None, typer.Option(help="Length of segments (m); one for all by default.")] = None,
    stations: Annotated[
        str | None, typer.Option(help="Ends of segments (m), such as 0,160.9,321.8, in place of a length.")
    ] = None,
    localised: Annotated[
        float | None, typer.Option(help="List stretches whose rolling IRI over 7.62 m is above this (m/km), instead.")
    ] = None,
    x_unit: XUnit = None,
    height_unit: HeightUnit = None,
    columns: Columns = None,
    as_json: AsJson = False,
) -> None:
    """IRI, and ride number, of longitudinal profiles in a file; of two wheel paths also their mean and half car."""
    from roadscan.condition.profiles import tables
    from roadscan.core.errors import RoadscanError

    read = _read(file, x_unit, height_unit, columns)
    try:
        if localised is None:
            found = tables.iri_table(
                read.x_m, read.height_m, segment_m=segment, stations_m=_numbers(stations), names=read.names
            )
        else:
            found = tables.localised_table(read.x_m, read.height_m, localised)
    except RoadscanError as error:
        raise error.at(file, error.record) from error
    _show(found, read, file, as_json)


def mpd(
    file: ProfileArgument,
    segment: Annotated[
        float | None, typer.Option(help="Length that a row is for (m), a multiple of 0.1; one for all by default.")
    ] = None,
    from_m: Annotated[float | None, typer.Option("--from", help="Leave out what lies before this station (m).")] = None,
    to_m: Annotated[float | None, typer.Option("--to", help="Leave out what lies behind this station (m).")] = None,
    x_unit: XUnit = None,
    height_unit: HeightUnit = None,
    columns: Columns = None,
    as_json: AsJson = False,
) -> None:
    """Mean profile depth, and RMS texture, of a texture profile in a file."""
    from roadscan.condition.profiles import tables
    from roadscan.core.errors import RoadscanError

    read = _read(file, x_unit, height_unit, columns)
    try:
        found = tables.mpd_table(read.x_m, read.height_m, segment_m=segment, from_m=from_m, to_m=to_m)
    except RoadscanError as error:
        raise error.at(file, error.record) from error
    _show(found, read, file, as_json)


def _read(file: Path, x_unit: str | None, height_unit: str | None, columns: str | None) -> ProfileFile:
    from roadscan.condition.profiles.profile_files import StatedUnits, read_profile

    chosen = tuple(one.strip() for one in columns.split(",")) if columns else ()
    read = read_profile(file, StatedUnits(x_unit, height_unit, chosen))
    for line, text in read.rejects[:5]:
        typer.echo(f"rejected: {file}, line {line}: {text}", err=True)
    if len(read.rejects) > 5:
        typer.echo(f"rejected: {len(read.rejects) - 5:,} more lines of {file}", err=True)
    return read


def _numbers(text: str | None) -> list[float] | None:
    from roadscan.core.errors import ConfigError

    if text is None:
        return None
    try:
        return [float(one) for one in text.split(",")]
    except ValueError:
        raise ConfigError(f"--stations {text}", expected="numbers with commas between them") from None


def _show(found: ProfileTable, read: ProfileFile, file: Path, as_json: bool) -> None:
    for one in found.findings:
        typer.echo(f"{'left out' if one.left_out else 'doubtful'}: {file}: {one.line}", err=True)
    names = tuple(found.columns)
    rows = list(zip(*(map(_plain, found.columns[name]) for name in names), strict=True))
    if as_json:
        told = {"file": str(file), "profiles": list(read.names), "rejected_lines": len(read.rejects),
                "findings": [vars(one) for one in found.findings],
                "rows": [dict(zip(names, row, strict=True)) for row in rows]}  # fmt: skip
        typer.echo(json.dumps(told, indent=2, ensure_ascii=False))
        return
    print_table(names, [tuple(map(_cell, names, row)) for row in rows])


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: None for NaN, nine decimals."""
    if isinstance(value, float):
        return round(float(value), 9) if math.isfinite(value) else None
    return value if isinstance(value, str) else int(value)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.2f}" if name == "measured_share" else f"{value:.3f}"
    return str(value)
