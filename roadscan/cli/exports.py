"""Commands that write readings as files of their own."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from roadscan.cli.arguments import SurveyFile, options_apart
from roadscan.cli.terminal import new_reporter, print_table

if TYPE_CHECKING:
    from roadscan.export.export import Exported

Out = Annotated[Path, typer.Option(help="Folder to write to; new or empty.")]
Run = Annotated[str | None, typer.Option("--run", help="This run alone.")]
Camera = Annotated[str | None, typer.Option(help="This camera of the rig alone.")]
Points = Annotated[
    Path | None, typer.Option(help="CSV of points: easting_m, northing_m, height_m on the survey's map (metres).")
]


@dataclass(frozen=True)
class GridOptions:
    """Settings of an OpenCRG grid, named as those of `CrgSettings`."""

    pass_id: Annotated[int | None, typer.Option("--pass", help="opencrg: pass, where the run has several.")] = None
    u_step_m: Annotated[float, typer.Option("--u-step", help="opencrg: distance from row to row (m).")] = 0.05
    v_step_m: Annotated[float, typer.Option("--v-step", help="opencrg: distance from column to column (m).")] = 0.05
    left_m: Annotated[float, typer.Option("--left", help="opencrg: reach to the left of the driven path (m).")] = 2.0
    right_m: Annotated[float, typer.Option("--right", help="opencrg: reach to the right of the driven path (m).")] = 2.0
    smoothing_m: Annotated[
        float, typer.Option("--smoothing", help="opencrg: length over which the path is smoothed (m).")
    ] = 10.0
    hole_m: Annotated[float, typer.Option("--hole", help="opencrg: longest hole closed by straight lines (m).")] = 0.25
    encoding: Annotated[str, typer.Option(help="opencrg: KRBI, KDBI, LRFI or LDFI.")] = "KRBI"


class Exports(TyperGroup):
    """The exports; `roadscan export SURVEY.toml --format …` without the word `readings` means that one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the word in where none of the commands is named."""
        if args and args[0] not in (*self.commands, "--help"):
            args = ["readings", *args]
        return list(super().parse_args(ctx, args))


@options_apart
def readings(
    survey_file: SurveyFile,
    format_: Annotated[str, typer.Option("--format", help="psi (a run's profiles) or opencrg (a pass's heights).")],
    run_id: Annotated[str, typer.Option("--run", help="Run.")],
    sensor: Annotated[str, typer.Option(help="Sensor of the rig.")],
    out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
    length: Annotated[float, typer.Option(help="psi: road a file (m).")] = 5.0,
    grid: GridOptions = GridOptions(),
) -> None:
    """Ingested readings as files of other programs: PSI containers or an OpenCRG grid."""
    from roadscan.core.counted import counted
    from roadscan.core.errors import ConfigError
    from roadscan.core.survey import Survey
    from roadscan.export.export_opencrg import CrgSettings, export_opencrg
    from roadscan.export.export_psi import PsiSettings, export_psi
    from roadscan.store.store import Store

    loaded = Survey.load(survey_file)
    store = Store(loaded.store_url, loaded.config.id)
    if format_ == "psi":
        written = export_psi(loaded, store, run_id, sensor, out, PsiSettings(length))
    elif format_ == "opencrg":
        written = export_opencrg(loaded, store, run_id, sensor, out, CrgSettings(**asdict(grid)))
    else:
        raise ConfigError(f"--format {format_}", expected="psi or opencrg")
    for note in written.notes:
        typer.echo(note)
    typer.echo(f"{counted(len(written.files), 'file')} in {out}")


def classes(
    survey_file: SurveyFile,
    run: Annotated[str, typer.Option(help="Run of the survey file.")],
    sensor: Annotated[str, typer.Option(help="Sensor whose readings are classed.")],
    out: Annotated[Path, typer.Option(help="Parquet file to write.")],
) -> None:
    """What became of every reading of a sensor, and which filter left it out: one row a reading."""
    from roadscan.core.survey import Survey
    from roadscan.export.classes import write_classes
    from roadscan.store.store import Store

    loaded = Survey.load(survey_file)
    reporter = new_reporter()
    store = Store(loaded.store_url, loaded.config.id)
    counts = write_classes(loaded, store, run, sensor, out, lambda d, t: reporter.progress("classes", d, t))
    reporter.close()
    print_table(("class", "readings"), [(name, f"{count:,}") for name, count in counts.items()])


def pictures(
    survey_file: SurveyFile,
    out: Out,
    run_id: Run = None,
    camera: Camera = None,
    exif: Annotated[bool, typer.Option(help="With place, direction and time as EXIF and XMP.")] = True,
    undistorted: Annotated[bool, typer.Option("--undistorted", help="As a pinhole sees them.")] = False,
    blurred: Annotated[
        bool, typer.Option("--blurred", help="With people and vehicles hidden, as [privacy] says where they are.")
    ] = False,
) -> None:
    """Copies of pictures with their places in them, a table of their poses, and the cameras' lenses."""
    from roadscan.export.pictures.copies import Choice, CopySettings, export_pictures
    from roadscan.run.session import Session

    reporter = new_reporter()
    written = export_pictures(
        Session.open(survey_file), out, Choice(run_id, camera), CopySettings(exif, undistorted, blurred),
        lambda done, total: reporter.progress("pictures", done, total),
    )  # fmt: skip
    reporter.close()
    _tell(written, out)


def colmap(survey_file: SurveyFile, out: Out, run_id: Run = None, camera: Camera = None, points: Points = None) -> None:
    """Cameras and poses of pictures as COLMAP's text files, in a local frame, so that its dense matching can go on."""
    from roadscan.export.pictures.copies import Choice
    from roadscan.export.pictures.reconstructions import export_colmap
    from roadscan.run.session import Session

    _tell(export_colmap(Session.open(survey_file), out, Choice(run_id, camera), points), out)


def opensfm(
    survey_file: SurveyFile, out: Out, run_id: Run = None, camera: Camera = None, points: Points = None
) -> None:
    """Cameras and poses of pictures as OpenSfM's reconstruction, which OpenDroneMap reads, in a local frame."""
    from roadscan.export.pictures.copies import Choice
    from roadscan.export.pictures.reconstructions import export_opensfm
    from roadscan.run.session import Session

    _tell(export_opensfm(Session.open(survey_file), out, Choice(run_id, camera), points), out)


def _tell(written: Exported, out: Path) -> None:
    from roadscan.core.counted import counted

    for note in written.notes:
        typer.echo(note)
    typer.echo(f"{counted(len(written.files), 'file')} in {out}")
