"""Command that post-processes GNSS observations outside a survey."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.terminal import print_table


def ppk(
    rover: Annotated[
        Path, typer.Argument(metavar="ROVER", help="RINEX observations, or UBX with RXM-RAWX.", show_default=False)
    ],
    base: Annotated[list[Path], typer.Option(help="The base's observations; may be repeated.", show_default=False)],
    base_position: Annotated[
        str,
        typer.Option(
            metavar="A,B,C",
            help="Position of the base's mark in --base-crs: X,Y,Z (m), or latitude,longitude (°),height (m).",
            show_default=False,
        ),
    ],
    base_crs: Annotated[
        str,
        typer.Option(
            help="CRS of it: geocentric, or geographic with heights; @epoch where coordinates move: EPSG:7789@2020.5.",
            show_default=False,
        ),
    ],
    base_antenna_height: Annotated[
        float, typer.Option(help="Height of the base's antenna above the mark (m).", show_default=False)
    ],
    navigation: Annotated[
        list[Path] | None,
        typer.Option(
            help="Navigation file of the day; precise orbits (SP3) and clocks (CLK) too. May be repeated.",
            show_default=False,
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(
            help="Another setting of the format ppk (`roadscan formats ppk`), such as mode=static; may be repeated."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Solution to write; ROVER's name with .pos by default.", show_default=False)
    ] = None,
) -> None:
    """Positions of a GNSS rover, post-processed against a base station by RTKLIB: a .pos file and its picture."""
    from roadscan.formats.motion.ppk import PpkOptions
    from roadscan.formats.motion.rtklib_programs import is_precise
    from roadscan.ingest.inspect.provisional import parse_option
    from roadscan.navigation.ppk import post_process

    files = [one.resolve() for one in navigation or ()]
    station = {
        "files": [one.resolve() for one in base],
        "antenna_height_m": base_antenna_height,
        **_position(base_position, base_crs),
    }
    orbits = {"navigation": [f for f in files if not is_precise(f)], "precise": [f for f in files if is_precise(f)]}
    more = dict(parse_option(one) for one in option or ())
    done = post_process(
        rover, PpkOptions.parse({"base": station, **orbits, **more}), out or Path(rover.name).with_suffix(".pos")
    )
    figures = {name: value for name, value in done.figures.items() if not isinstance(value, dict)}
    figures |= {f"apart_{k}": v for k, v in done.figures["apart"].items() if not isinstance(v, list)}
    figures["last_position_m"] = ", ".join(f"{one:.4f}" for one in done.last_world_m)
    print_table(("figure", "value"), [(name, str(value)) for name, value in figures.items()])
    for one in done.findings:
        typer.echo(f"doubtful: {one.text}")
    typer.echo(f"written: {' and '.join(map(str, done.files))}")


def _position(text: str, crs: str) -> dict[str, float | str | None]:
    """Return the base's position by the keys of its settings, geocentric or geodetic as the CRS is."""
    from roadscan.core.crs import crs_from_text

    name, _, epoch = crs.partition("@")
    geocentric = crs_from_text(name, "--base-crs").is_geocentric
    keys = ("x_m", "y_m", "z_m") if geocentric else ("latitude_deg", "longitude_deg", "height_m")
    try:
        values = [float(one) for one in text.split(",")]
        return {"crs": name, "epoch": float(epoch) if epoch else None, **dict(zip(keys, values, strict=True))}
    except ValueError as error:
        raise typer.BadParameter(f"'{text}' in '{crs}' is not three numbers between commas, nor @ an epoch") from error
