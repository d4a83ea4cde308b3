"""Commands over many surveys."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from roadscan.cli.terminal import print_table


def fleet(
    folder: Annotated[
        str, typer.Argument(metavar="FOLDER", help="Folder or bucket (s3://…) with surveys.", show_default=False)
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the catalogue as one JSON object, and nothing else.")
    ] = False,
) -> None:
    """Make the catalogue of all surveys below a folder: place, time, rig, state and quality of each.

    It is written to FOLDER/fleet, as GeoParquet and as STAC. Only rows of surveys that changed are made anew. Ends with
    1 where something is wrong with a survey.
    """
    from roadscan.core.counted import counted
    from roadscan.fleet.catalogue import make_catalogue

    made = make_catalogue(folder)
    rows = made.table.drop_columns(["geometry"]).to_pylist()
    if as_json:
        told = {"file": made.file, "made": made.made, "unplaced": made.unplaced, "surveys": rows}
        typer.echo(json.dumps(told, indent=2, ensure_ascii=False))
    else:
        print_table(
            ("survey", "state", "year", "km", "lane km", "σ height", "MRI"),
            [
                (row["survey"], row["state"], _shown(row["year"], "d"), _shown(row["driven_km"], ",.3f"),
                 _shown(row["lane_km"], ",.3f"), _shown(row["sigma_down_m"], ".4f", " m"),
                 _shown(row["mri_m_per_km"], ".2f", " m/km"))
                for row in rows
            ],
            ("year", "km", "lane km", "σ height", "MRI"),
        )  # fmt: skip
        typer.echo(f"{made.file}: {counted(len(rows), 'survey')}, {made.made:,} made anew")
    for row in rows:
        if row["notes"]:
            typer.echo(f"{row['survey']}: {row['notes']}", err=True)
    raise typer.Exit(1 if any(row["notes"] for row in rows) else 0)


def _shown(value: float | None, form: str, unit: str = "") -> str:
    return "" if value is None else f"{value:{form}}{unit}"
