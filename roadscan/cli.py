"""The command line. Heavy imports happen inside the commands: `roadscan --help` must be quick."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from roadscan.jobs.selection import Selection
    from roadscan.jobs.stages import Run, Stage
    from roadscan.jobs.status import Status
    from roadscan.tables.store import Store

app = typer.Typer(
    name="roadscan",
    help="Raw logs of a road survey in; pavement surfaces, point clouds and tables out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

camera = typer.Typer(help="Interior orientation and mounting of cameras.", no_args_is_help=True)
app.add_typer(camera, name="camera")

SurveyFile = Annotated[Path, typer.Argument(metavar="SURVEY.toml", help="The survey file.", show_default=False)]
Workers = Annotated[
    int | None, typer.Option(help="Worker processes of the embedded cluster; 0 computes in this process.")
]
Scheduler = Annotated[str | None, typer.Option(help="Address of a Dask scheduler, in place of the embedded cluster.")]


@app.command()
def run(
    survey_file: SurveyFile,
    workers: Workers = None,
    scheduler: Scheduler = None,
    flow: Annotated[bool, typer.Option("--flow", help="Record a Prefect flow run even without an API.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
) -> None:
    """Run a survey: ingest, navigate, footprints, tiles, surfaces, products. Does only what is missing or stale."""
    if dry_run:
        _print_status(_status(survey_file), survey_file)
        return
    if flow or os.environ.get("PREFECT_API_URL"):
        from flows.conduct import require_api
        from flows.survey import survey

        require_api()
        survey(str(survey_file), workers, scheduler)
        return
    from roadscan.jobs.stages import STAGES

    _run(survey_file, STAGES, workers, scheduler)


@app.command()
def ingest(survey_file: SurveyFile, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Raw logs into tables."""
    _run(survey_file, _stages("ingest"), workers, scheduler)


@app.command()
def navigate(survey_file: SurveyFile) -> None:
    """Trajectories from GNSS, IMU and odometer, and clocks from shared motion."""
    from roadscan.jobs.ingest import survey_records
    from roadscan.jobs.navigate import plan_trajectories

    run = _run(survey_file, _stages("navigate"), 0, None)
    if not plan_trajectories(run.survey, run.store, survey_records(run.survey, run.store)):
        typer.echo("no trajectory to compute: each run has a trajectory log, or no GNSS and IMU")


@app.command()
def clocks(survey_file: SurveyFile) -> None:
    """Clocks of sensors as they were estimated; estimates those that are missing or out of date."""
    from roadscan.jobs.clock_tables import kept_estimates

    run = _run(survey_file, _stages("navigate"), 0, None)
    rows = [
        (e.run, e.sensor, f"{e.correction.offset_s:+.6f}", f"{e.correction.sigma_offset_s:.2g}",
         f"{e.correction.drift * 1e6:+.3f}", f"{e.correction.sigma_drift * 1e6:.2g}", e.method)
        for e in kept_estimates(run.store)
    ]  # fmt: skip
    if not rows:
        typer.echo("no clock to estimate: no log has clock = {…, pairs = …}, and the survey file names no [[clocks]]")
        return
    _table(("run", "sensor", "added s", "σ s", "drift ppm", "σ ppm", "found from"), rows)


@app.command()
def calibrate(survey_file: SurveyFile) -> None:
    """Mountings of sensors from the evidence that the survey file names; readings are placed by them from then on."""
    from roadscan.jobs.calibrate import PICTURE, calibrate_survey
    from roadscan.model.survey import Survey

    store = _store(survey_file)
    with store.lock():
        done = calibrate_survey(Survey.load(survey_file), store, typer.echo)
    typer.echo(done.text)
    typer.echo(f"written: table mountings, {store.path(PICTURE)}")


@camera.command("interior")
def camera_interior(
    pictures: Annotated[list[Path], typer.Argument(help="Pictures of a chessboard, or their folder.")],
    rig: Annotated[Path, typer.Option(help="Rig file to write to.")],
    sensor: Annotated[str, typer.Option(help="Camera of the rig.")],
    board: Annotated[str, typer.Option(help="Inner corners of the board, such as 9x6.")],
    square: Annotated[float, typer.Option(help="Edge of a square (m).")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing.")] = False,
) -> None:
    """Interior orientation from pictures of a chessboard, into the rig file."""
    from roadscan.jobs.camera import calibrate_interior
    from roadscan.model.errors import ConfigError
    from roadscan.navigation.calibration.chessboard import Board

    sides = board.lower().split("x")
    if len(sides) != 2 or not all(side.isdigit() for side in sides):
        raise ConfigError(f"--board {board}", expected="inner corners along both sides, such as 9x6")
    chessboard = Board.parse({"columns": int(sides[0]), "rows": int(sides[1]), "square_m": square})
    listed = pictures[0] if len(pictures) == 1 and pictures[0].is_dir() else pictures
    found = calibrate_interior(listed, chessboard, rig, sensor, write=not dry_run)
    rows = [(p.name, f"{p.rms_px:.3f}", f"{p.tilt_deg:.0f}", f"{p.distance_m:.2f}", "") for p in found.used]
    rows += [(p.name, "", "", "", f"left out: {p.reason}") for p in found.rejected]
    _table(("picture", "RMS px", "tilt °", "distance m", ""), rows)
    i = found.interior
    typer.echo(f"focal length {_numbers(i.focal_px, 3)} px, principal point {_numbers(i.principal_px, 3)} px")
    typer.echo(f"k1, k2, p1, p2, k3: {_numbers(i.distortion, 6)}; RMS {i.rms_px:.3f} px, coverage {found.coverage:.0%}")
    typer.echo("nothing written" if dry_run else f"written: {rig}, [sensors.{sensor}.interior]")


@camera.command("resect")
def camera_resect(
    survey_file: SurveyFile,
    sensor: Annotated[str, typer.Option(help="Camera of the rig.")],
    points: Annotated[Path, typer.Option(help="CSV: picture, point, u_px, v_px.")],
    sigma_px: Annotated[float, typer.Option(help="1 σ of a measured coordinate (pixels).")] = 0.5,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing.")] = False,
) -> None:
    """Mounting of a camera from control points measured in its pictures, into the rig file."""
    from roadscan.jobs.camera import resect_camera
    from roadscan.model.survey import Survey
    from roadscan.navigation.calibration.report import report

    loaded = Survey.load(survey_file)
    found = resect_camera(
        loaded, _store(survey_file), sensor, points, sigma_px, loaded.config.navigation.calibration, write=not dry_run
    )
    typer.echo(report(found.resection.calibration))
    for r in found.resection.outliers:
        typer.echo(f"outlier: {r.measured.picture}, {r.measured.point}: {r.du_px:+.1f}, {r.dv_px:+.1f} px")
    for c in found.checks:
        typer.echo(f"check point: {c.measured.picture}, {c.measured.point}: {c.du_px:+.2f}, {c.dv_px:+.2f} px")
    typer.echo(f"RMS {found.resection.rms_px:.2f} px, started from {found.resection.start}")
    typer.echo("nothing written" if found.rig_file is None else f"written: {found.rig_file}, [sensors.{sensor}]")


@app.command()
def footprints(survey_file: SurveyFile, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Which raw block touches which tile."""
    _run(survey_file, _stages("footprints"), workers, scheduler)


@app.command()
def tile(survey_file: SurveyFile, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Readings into points, cells and tile files."""
    _run(survey_file, _stages("tiles"), workers, scheduler)


@app.command()
def surfaces(survey_file: SurveyFile, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Cells or points of tiles into the reconstructed surface and its files (section `surface` of the survey file)."""
    _run(survey_file, _stages("surfaces"), workers, scheduler)


@app.command("products")
def make_products(
    survey_file: Annotated[
        Path | None, typer.Argument(metavar="[SURVEY.toml]", help="Make its products; without it, list all there are.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Mosaics, pictures and tables over all tiles; without a survey file, list the products there are."""
    if survey_file is not None:
        _run(survey_file, _stages("products"), workers, scheduler)
        return
    from roadscan.products.base import SurfaceProduct, TileProduct, products

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
    _table(("product", "of", "made", "what"), rows)


@app.command()
def reprocess(
    survey_file: SurveyFile,
    tiles: Annotated[list[str] | None, typer.Option("--tile", help="Tile COLUMN_ROW; may be repeated.")] = None,
    bbox: Annotated[str | None, typer.Option(help="WEST,SOUTH,EAST,NORTH on the map, metres.")] = None,
    span: Annotated[str | None, typer.Option(help="START/END in UTC, such as 2026-05-04T09:30:00Z/….")] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
) -> None:
    """Compute some tiles once more, whether stale or not."""
    from roadscan.jobs.stages import STAGES
    from roadscan.model.errors import ConfigError

    if not (tiles or bbox or span):
        raise ConfigError("nothing was chosen", expected="--tile, --bbox or --span")
    done = _run(survey_file, STAGES, workers, scheduler, _selection(tiles, bbox, span))
    typer.echo(f"read {done.raw_bytes_read / 1e6:,.1f} MB of readings")


@app.command()
def status(survey_file: SurveyFile) -> None:
    """What is ingested, current, stale and failed, and what the next run would do."""
    found = _status(survey_file)
    _print_status(found, survey_file)
    if not found.is_complete:
        raise typer.Exit(1)


@app.command()
def verify(survey_file: SurveyFile) -> None:
    """Read every file the store should hold, and say which are missing or damaged."""
    from roadscan.jobs.status import verify_store
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    reporter = _reporter()
    faults = verify_store(Store(loaded.store_url, loaded.config.id), lambda d, t: reporter.progress("verify", d, t))
    reporter.close()
    for fault in faults:
        typer.echo(fault)
    typer.echo("every file is whole" if not faults else f"{len(faults)} files are not whole")
    raise typer.Exit(1 if faults else 0)


@app.command()
def sql(
    statement: Annotated[str, typer.Argument(help="DuckDB statement over the views (SHOW TABLES lists them).")],
    survey_file: Annotated[Path, typer.Option("--survey", help="The survey file.")] = Path("SURVEY.toml"),
    csv: Annotated[bool, typer.Option("--csv", help="Print comma-separated values.")] = False,
) -> None:
    """Ask the tables a question."""
    from roadscan.jobs.navigate import known_keys
    from roadscan.model.errors import StoreError
    from roadscan.model.survey import Survey
    from roadscan.tables.sql import query
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    store = Store(loaded.store_url, loaded.config.id)
    damaged: list[StoreError] = []
    try:
        result = query(store, statement, known_keys(loaded, store), damaged)
    finally:
        for error in damaged:
            typer.echo(f"not shown: {error}", err=True)
    if csv:
        import pyarrow.csv

        pyarrow.csv.write_csv(result, sys.stdout.buffer)
        return
    shown = result.slice(0, 200)
    _table(tuple(result.column_names), [tuple(_cell(v) for v in row.values()) for row in shown.to_pylist()])
    if result.num_rows > shown.num_rows:
        typer.echo(f"… {result.num_rows:,} rows in all (--csv prints them)")


@app.command()
def export(
    survey_file: SurveyFile,
    format_: Annotated[str, typer.Option("--format", help="psi (a run's profiles) or opencrg (a pass's heights).")],
    run_id: Annotated[str, typer.Option("--run", help="Run.")],
    sensor: Annotated[str, typer.Option(help="Sensor of the rig.")],
    out: Annotated[Path, typer.Option(help="Folder to write to; new or empty.")],
    length: Annotated[float, typer.Option(help="psi: road a file (m).")] = 5.0,
    pass_id: Annotated[int | None, typer.Option("--pass", help="opencrg: pass, where the run has several.")] = None,
    u_step: Annotated[float, typer.Option(help="opencrg: distance from row to row (m).")] = 0.05,
    v_step: Annotated[float, typer.Option(help="opencrg: distance from column to column (m).")] = 0.05,
    left: Annotated[float, typer.Option(help="opencrg: reach to the left of the driven path (m).")] = 2.0,
    right: Annotated[float, typer.Option(help="opencrg: reach to the right of the driven path (m).")] = 2.0,
    smoothing: Annotated[float, typer.Option(help="opencrg: length over which the path is smoothed (m).")] = 10.0,
    hole: Annotated[float, typer.Option(help="opencrg: longest hole closed by straight lines (m).")] = 0.25,
    encoding: Annotated[str, typer.Option(help="opencrg: KRBI, KDBI, LRFI or LDFI.")] = "KRBI",
) -> None:
    """Ingested readings as files of other programs: PSI containers or an OpenCRG grid."""
    from roadscan.jobs.export_opencrg import CrgSettings, export_opencrg
    from roadscan.jobs.export_psi import PsiSettings, export_psi
    from roadscan.model.errors import ConfigError
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    store = Store(loaded.store_url, loaded.config.id)
    if format_ == "psi":
        written = export_psi(loaded, store, run_id, sensor, out, PsiSettings(length))
    elif format_ == "opencrg":
        settings = CrgSettings(pass_id, u_step, v_step, left, right, smoothing, hole, encoding)
        written = export_opencrg(loaded, store, run_id, sensor, out, settings)
    else:
        raise ConfigError(f"--format {format_}", expected="psi or opencrg")
    for note in written.notes:
        typer.echo(note)
    typer.echo(f"{len(written.files):,} files in {out}")


@app.command()
def classes(
    survey_file: SurveyFile,
    run: Annotated[str, typer.Option(help="Run of the survey file.")],
    sensor: Annotated[str, typer.Option(help="Sensor whose readings are classed.")],
    out: Annotated[Path, typer.Option(help="Parquet file to write.")],
) -> None:
    """What became of every reading of a sensor, and which filter left it out: one row a reading."""
    from roadscan.jobs.classes import write_classes
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    reporter = _reporter()
    store = Store(loaded.store_url, loaded.config.id)
    counts = write_classes(loaded, store, run, sensor, out, lambda d, t: reporter.progress("classes", d, t))
    reporter.close()
    _table(("class", "readings"), [(name, f"{count:,}") for name, count in counts.items()])


@app.command("formats")
def list_formats(
    name: Annotated[str | None, typer.Argument(help="Show the settings of one format.", show_default=False)] = None,
) -> None:
    """Raw formats that can be read, and what they yield."""
    from roadscan.model.strict import meanings
    from roadscan.sensors.base import format_named, log_formats

    if name is None:
        rows = [(n, ", ".join(f.yields), f.title) for n, f in log_formats().items()]
        _table(("format", "yields", "what"), rows)
        return
    found = format_named(name)
    typer.echo(f"{found.name}: {found.title}\nyields: {', '.join(found.yields)}\ntime: {found.time}")
    for field, meaning in meanings(found.options).items():
        info = found.options.model_fields[field]
        default = "required" if info.is_required() else f"default {info.default!r}"
        typer.echo(f"  options.{field} ({default}): {meaning}")


@app.command("inspect")
def inspect_files(
    files: Annotated[list[Path], typer.Argument(metavar="FILE…", help="Files or folder logs.", show_default=False)],
    clock: Annotated[
        str | None, typer.Option(help="Time system, such as gps_week_seconds,week=2405 or unix_utc,unit=us.")
    ] = None,
    crs: Annotated[str | None, typer.Option(help='CRS of positions, such as EPSG:4979 or "local".')] = None,
    option: Annotated[
        list[str] | None, typer.Option("--option", help="Setting of the format, key=value; may be repeated.")
    ] = None,
    format_name: Annotated[str | None, typer.Option("--format", help="Read as this format.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Read only the beginning.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: a list, one entry a file.")] = False,
) -> None:
    """Say of any file what it is, what it holds, its time span and extent, and what is wrong with it.

    Ends with 0 if all files can be read (faults of single records do not count), with 2 if one cannot.
    """
    from roadscan.jobs.inspect import inspect
    from roadscan.jobs.provisional import Stated, parse_clock, parse_option

    stated = Stated(
        clock=None if clock is None else parse_clock(clock),
        crs=crs,
        options=dict(parse_option(one) for one in option or ()),
    )
    found = []
    for file in files:
        with _looking(file) as progress:
            found.append(inspect(file, stated, format_name, quick=quick, progress=progress))
        if not as_json:
            from roadscan.jobs.inspect_text import print_inspection

            print_inspection(found[-1])
    if as_json:
        import json

        typer.echo(json.dumps([one.as_json() for one in found], indent=2, ensure_ascii=False))
    raise typer.Exit(0 if all(one.readable for one in found) else 2)


@app.command("init")
def first_survey(
    folder: Annotated[Path, typer.Argument(help="Folder of raw logs, looked through recursively.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Survey file to write; RIG.toml is written beside it.")] = Path(
        "SURVEY.toml"
    ),
) -> None:
    """Look through a folder of logs and write a first survey file for you to complete."""
    from roadscan.jobs.first_survey import find_logs
    from roadscan.jobs.first_survey_text import refuse_to_overwrite, write_first_survey

    refuse_to_overwrite(out)
    with _looking(folder) as progress:
        found = find_logs(folder, progress)
    made = write_first_survey(found, out)
    _table(
        ("run", "sensor", "log", "format", "to state"),
        [
            (run.id, log.sensor or "", os.path.relpath(log.path, found.folder), log.format.name,
             ", ".join(need.key for need in log.needs))
            for run in [*found.runs, *found.further]
            for log in run.logs
        ],
    )  # fmt: skip
    for path, words in found.unknown:
        typer.echo(f"not understood: {os.path.relpath(path, found.folder)}: {words}")
    written = " and ".join(str(file) for file in (made.survey_file, made.rig_file) if file is not None)
    typer.echo(f"written: {written}, with {made.questions} lines to complete (they begin with #?)")


@app.command()
def simulate(
    scene: Annotated[
        str, typer.Argument(help="A scene file (TOML), or the name of a shipped scene (roadscan scenes).")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    hits: Annotated[bool, typer.Option("--hits", help="Also write where each beam hit, into truth/hits.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all errors, in place of the scene's own.")] = None,
) -> None:
    """Write a survey with known truth as raw logs."""
    from roadscan.simulate import Scene
    from roadscan.simulate import simulate as write

    loaded = Scene.load(scene)
    changed = loaded if seed is None else loaded.changed(seed=seed)
    made = write(changed, out, write_hits=hits, progress=typer.echo)
    typer.echo(
        f"{made.poses:,} poses, {made.profiles:,} profiles with {made.readings:,} readings in all, "
        f"{made.returns:,} returns"
    )
    typer.echo(f"survey file: {made.survey_file}")


@app.command("scenes")
def list_scenes() -> None:
    """List the scenes that ship with roadscan."""
    from roadscan.simulate import Scene
    from roadscan.simulate.scene import shipped_scenes

    scenes = {name: Scene.load(name) for name in shipped_scenes()}
    _table(
        ("scene", "length m", "passes", "what"),
        [(name, f"{one.length_m:g}", str(len(one.passes)), one.title) for name, one in scenes.items()],
    )


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("demo"),
    workers: Workers = None,
) -> None:
    """Simulate a small survey, run it, and compare the surface with the truth."""
    from roadscan.jobs.demo import prepare_demo, summarise
    from roadscan.jobs.stages import STAGES

    survey_file = prepare_demo(out, typer.echo)
    _run(survey_file, STAGES, workers, None)
    for line in summarise(survey_file).lines():
        typer.echo(line)


def main() -> None:
    """Run the command line; an error the user can mend is printed without a traceback."""
    from roadscan.model.errors import RoadscanError

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or pipe that knows no "─" or "σ" stops nothing
    try:
        app()
    except RoadscanError as error:
        typer.secho(f"roadscan: {error}", err=True, fg=typer.colors.RED)
        raise SystemExit(2) from None


def _stages(name: str) -> tuple[Stage, ...]:
    from roadscan.jobs.stages import STAGES

    return tuple(s for s in STAGES if s.name == name)


def _run(
    survey_file: Path,
    stages: tuple[Stage, ...],
    workers: int | None,
    scheduler: str | None,
    selection: Selection | None = None,
) -> Run:
    from roadscan.jobs.compute_on import compute_on
    from roadscan.jobs.stages import Run, run_stages
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    reporter = _reporter()
    with compute_on(workers, scheduler) as compute:
        run = Run(loaded, Store(loaded.store_url, loaded.config.id), compute, selection, reporter)
        try:
            run_stages(run, stages)
        finally:
            reporter.close()
    return run


def _store(survey_file: Path) -> Store:
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    return Store(loaded.store_url, loaded.config.id)


def _numbers(values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _reporter() -> Any:
    from roadscan.progress import LineReporter, TerminalReporter

    return TerminalReporter() if sys.stderr.isatty() else LineReporter()


@contextmanager
def _looking(file: Path) -> Iterator[Callable[[int, float | None], None]]:
    """Show on a terminal how far a file is read; nothing in a pipe."""
    if not sys.stderr.isatty():
        yield lambda rows, share: None
        return
    from rich.console import Console

    with Console(stderr=True).status(str(file)) as status:

        def show(rows: int, share: float | None) -> None:
            done = "" if share is None else f", {share:.0%}"
            status.update(f"{file}: {rows:,} rows{done}")

        yield show


def _selection(tiles: list[str] | None, bbox: str | None, span: str | None) -> Selection:
    import datetime as dt

    from roadscan.jobs.selection import Selection
    from roadscan.model.errors import ConfigError
    from roadscan.model.gpstime import gps_ns_from_utc
    from roadscan.model.ids import TileId
    from roadscan.tiles.grid import Bounds

    box = times = None
    if bbox is not None:
        try:
            west, south, east, north = (float(part) for part in bbox.split(","))
        except ValueError:
            raise ConfigError(f"--bbox {bbox}", expected="WEST,SOUTH,EAST,NORTH in metres") from None
        box = Bounds(west, south, east, north)
    if span is not None:
        try:
            start, end = (dt.datetime.fromisoformat(part) for part in span.split("/"))
        except ValueError:
            raise ConfigError(f"--span {span}", expected="START/END, such as 2026-05-04T09:30:00Z/…") from None
        times = (gps_ns_from_utc(start), gps_ns_from_utc(end))
    return Selection(tuple(TileId.parse(t) for t in tiles or ()), box, times)


def _status(survey_file: Path) -> Status:
    from roadscan.jobs.status import survey_status
    from roadscan.model.survey import Survey
    from roadscan.tables.store import Store

    loaded = Survey.load(survey_file)
    return survey_status(loaded, Store(loaded.store_url, loaded.config.id))


def _print_status(found: Status, survey_file: Path) -> None:
    typer.echo(f"survey file: {survey_file}")
    _table(
        ("run", "sensor", "log", "format", "state", "rows", "rejected", "bytes"),
        [
            (x["run"], x["sensor"], x["path"], x["format"], x["state"], f"{x['rows']:,}", f"{x['rejected']:,}",
             f"{x['bytes']:,}")
            for x in found.logs
        ],
    )  # fmt: skip
    for log in found.unused_logs:
        typer.echo(f"in the store, not in the survey file: {log}")
    if found.readings:
        typer.echo("readings: " + ", ".join(f"{n.replace('_', ' ')} {c:,}" for n, c in found.readings.items()))
    typer.echo(
        f"no tiles: {found.note}"
        if found.note
        else f"tiles: {found.tiles_current:,} current, {found.tiles_stale:,} to do"
    )
    if found.outputs:
        typer.echo("files: " + ", ".join(f"{n} {c:,}" for n, c in sorted(found.outputs.items())))
    for record in found.damaged:
        typer.echo(f"damaged: {record}")
    for note in found.notes:
        typer.echo(f"note: {note}")
    for failure in found.failures:
        typer.echo(f"failed in the last run: {failure['stage']} {failure['unit']}: {failure['reason']}")
    if found.next_run:
        typer.echo("next run: " + ", ".join(f"{n.replace('_', ' ')} {c:,}" for n, c in found.next_run.items()))


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    widths = [max(len(str(r[i])) for r in [head, *rows]) for i in range(len(head))]
    for row in [head, tuple("─" * w for w in widths), *rows]:
        typer.echo("  ".join(str(v).ljust(w) for v, w in zip(row, widths, strict=True)).rstrip())


def _cell(value: Any) -> str:
    text = _number(value) if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else text[:59] + "…"


def _number(value: float) -> str:
    """Six digits, and millimetres of what is as large as a coordinate."""
    return f"{value:.3f}" if 1e5 <= abs(value) < 1e9 else f"{value:.6g}"
