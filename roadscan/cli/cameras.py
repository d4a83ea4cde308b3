"""Commands for cameras: interior orientation and mounting."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from roadscan.cli.arguments import SurveyFile
from roadscan.cli.survey import opened_store
from roadscan.cli.terminal import print_table


def camera_interior(
    pictures: Annotated[list[Path], typer.Argument(help="Pictures of a chessboard, or their folder.")],
    rig: Annotated[Path, typer.Option(help="Rig file to write to.")],
    sensor: Annotated[str, typer.Option(help="Camera of the rig.")],
    board: Annotated[str, typer.Option(help="Inner corners of the board, such as 9x6.")],
    square: Annotated[float, typer.Option(help="Edge of a square (m).")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing.")] = False,
) -> None:
    """Interior orientation from pictures of a chessboard, into the rig file."""
    from roadscan.calibrate.chessboard import Board
    from roadscan.calibrate.tasks.camera import calibrate_interior
    from roadscan.core.errors import ConfigError

    sides = board.lower().split("x")
    if len(sides) != 2 or not all(side.isdigit() for side in sides):
        raise ConfigError(f"--board {board}", expected="inner corners along both sides, such as 9x6")
    chessboard = Board.parse({"columns": int(sides[0]), "rows": int(sides[1]), "square_m": square})
    listed = pictures[0] if len(pictures) == 1 and pictures[0].is_dir() else pictures
    found = calibrate_interior(listed, chessboard, rig, sensor, write=not dry_run)
    rows = [(p.name, f"{p.rms_px:.3f}", f"{p.tilt_deg:.0f}", f"{p.distance_m:.2f}", "") for p in found.used]
    rows += [(p.name, "", "", "", f"left out: {p.reason}") for p in found.rejected]
    print_table(("picture", "RMS px", "tilt °", "distance m", ""), rows)
    i = found.interior
    typer.echo(f"focal length {numbers(i.focal_px, 3)} px, principal point {numbers(i.principal_px, 3)} px")
    typer.echo(f"k1, k2, p1, p2, k3: {numbers(i.distortion, 6)}; RMS {i.rms_px:.3f} px, coverage {found.coverage:.0%}")
    typer.echo("nothing written" if dry_run else f"written: {rig}, [sensors.{sensor}.interior]")


def camera_resect(
    survey_file: SurveyFile,
    sensor: Annotated[str, typer.Option(help="Camera of the rig.")],
    points: Annotated[Path, typer.Option(help="CSV: picture, point, u_px, v_px.")],
    sigma_px: Annotated[float, typer.Option(help="1 σ of a measured coordinate (pixels).")] = 0.5,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing.")] = False,
) -> None:
    """Mounting of a camera from control points measured in its pictures, into the rig file."""
    from roadscan.calibrate.in_words import report
    from roadscan.calibrate.tasks.camera import resect_camera
    from roadscan.core.survey import Survey

    loaded = Survey.load(survey_file)
    found = resect_camera(
        loaded,
        opened_store(survey_file),
        sensor,
        points,
        sigma_px,
        loaded.config.navigation.calibration,
        write=not dry_run,
    )
    typer.echo(report(found.resection.calibration))
    for r in found.resection.outliers:
        typer.echo(f"outlier: {r.measured.picture}, {r.measured.point}: {r.du_px:+.1f}, {r.dv_px:+.1f} px")
    for c in found.checks:
        typer.echo(f"check point: {c.measured.picture}, {c.measured.point}: {c.du_px:+.2f}, {c.dv_px:+.2f} px")
    typer.echo(f"RMS {found.resection.rms_px:.2f} px, started from {found.resection.start}")
    typer.echo("nothing written" if found.rig_file is None else f"written: {found.rig_file}, [sensors.{sensor}]")


def camera_targets(
    survey_file: SurveyFile,
    out: Annotated[Path, typer.Option(help="CSV to write: a line for each target found in a picture.")],
    sensor: Annotated[list[str] | None, typer.Option(help="Camera of the rig; all of them where left out.")] = None,
    misses: Annotated[bool, typer.Option("--misses", help="Also list where a target was not found, and why.")] = False,
) -> None:
    """Control targets in pictures: found, measured to a tenth of a pixel, and written to a CSV."""
    from roadscan.cli.targets import Seen, seen_targets
    from roadscan.pictures.points import write_points

    seen: Seen = seen_targets(survey_file, tuple(sensor or ()))
    write_points(seen.rows, out)
    for note in seen.notes:
        typer.echo(note)
    header = ("point", "role", "in pictures", "found", "mean du px", "mean dv px", "RMS px", "median σ px")
    print_table(header, seen.by_point())
    if misses:
        print_table(("picture", "point", "not found"), seen.misses)
    typer.echo(f"written: {out}, {seen.rows.num_rows:,} measurements; du, dv: found less where the stated poses say")


def numbers(values: Sequence[float], digits: int) -> str:
    """The numbers with so many digits, separated by commas."""
    return ", ".join(f"{value:.{digits}f}" for value in values)
