"""Poses from pictures: a recorded drive whose poses are disturbed, and simulated streets with control in pictures.

Surveys are written as a user would, `roadscan run` takes them with default settings, and figures come from products.
Draws 0 to 2, 10 to 12, 17 and 20 to 22 were looked at or scored before; 23 to 25 are only scored.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.parquet as pq

from benchmarks import picture_drive
from benchmarks.labelled_street import recording_folder
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure

ERRORS: Final = (0.1, 0.2)
"""1 σ of the disturbed poses (m, degrees)."""
SCENES: Final = {"street_with_cameras": 0.03, "street_without_gnss": 0.05}
"""Simulated streets, and the bar of their check points in space (m)."""
MEASURED: Final = """[[runs.logs]]
path = "measured.csv"
format = "picture_points_csv"
sensor = "camera"

[picture_ties]

[[passes]]"""
"""What is added to a simulated survey: the targets that were found in its pictures, and tie points."""
DRAWS: Final = (23, 24, 25)


def figures(folder: Path) -> Iterator[Figure]:
    """Each draw of the recorded drive, then the simulated streets."""
    recording = recording_folder().parent / picture_drive.RECORDING
    for seed in DRAWS:
        yield from of_draw(recording, bench_folder(folder) / f"draw-{seed}", seed)
    for scene, bar in SCENES.items():
        yield from of_scene(scene, bench_folder(folder) / scene, bar)


def of_scene(scene: str, folder: Path, bar_m: float) -> Iterator[Figure]:
    """Check points, whose rays meet away from their survey, before and after, with targets that were searched for once,
    and again by the poses that the first run corrected.
    """
    if not (folder / "SURVEY.toml").is_file():
        _roadscan("simulate", scene, "--out", str(folder))
    file = folder / "SURVEY.toml"
    if not (folder / "measured.csv").is_file():
        _roadscan("ingest", str(file))
        _roadscan("camera", "targets", str(file), "--out", str(folder / "measured.csv"))
        file.write_text(file.read_text().replace("[[passes]]", MEASURED, 1))
    for search in ("once", "twice"):
        if search == "twice":
            _roadscan("camera", "targets", str(file), "--out", str(folder / "measured.csv"))
        picture_drive.run(file)
        yield from _check_points(folder, f"{scene}, targets searched for {search}", bar_m)


def _check_points(folder: Path, of: str, bar_m: float) -> Iterator[Figure]:
    """Figures of the check points that two pictures or more show."""
    rows = pq.read_table(next(folder.glob("store/*/tables/picture_control/*.parquet"))).to_pandas()
    every = rows[rows.role == "check"]
    check = every[every.pictures > 1]
    yield Figure(f"{of}: check points that two pictures or more show", float(len(check)), "", float(len(every)), "all")
    if check.empty:
        return
    for word in ("before", "after"):
        away = np.linalg.norm(check[[f"{word}_{axis}_m" for axis in ("north", "east", "down")]].to_numpy(), axis=1)
        yield Figure(f"{of}: check points in space, {word}, RMS", 1e3 * _rms(away), "mm", 1e3 * bar_m, "the bar")
        yield Figure(f"{of}: the same, largest", 1e3 * float(away.max()), "mm")


def _roadscan(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "roadscan", *words], check=True)


def of_draw(recording: Path, folder: Path, seed: int) -> Iterator[Figure]:
    """Errors over 5 pictures before and after, what is left in pixels, and the time of a run from raw pictures."""
    file = picture_drive.laid_out(recording, folder, ERRORS, seed)
    stated = picture_drive.disturbed(picture_drive.true_poses(recording), *ERRORS, seed)
    began = time.perf_counter()
    picture_drive.run(file)
    took = time.perf_counter() - began
    truth, found = picture_drive.truth(recording), picture_drive.placed(file)
    before = picture_drive.over_frames(picture_drive.of_camera(stated), truth)
    after = picture_drive.over_frames(found, truth)
    for k, (unit, bar) in enumerate((("m", 0.04), ("°", 0.20))):
        for word, of in (("median", np.median), ("RMS", _rms)):
            was = f"the bar; {of(before[k]):.3f} before"
            yield Figure(f"draw {seed}: over 5 pictures, {word}", float(of(after[k])), unit, bar, was)
        sound = float(_rms(after[k][picture_drive.SOUND :]))
        yield Figure(f"draw {seed}: the same where the recorded poses are sound, RMS", sound, unit, bar, "the bar")
    rows = pq.read_table(next(folder.glob("store/*/tables/picture_residuals/*.parquet"))).to_pandas()
    used = rows[rows.weight > 0.0]
    squares = used[["after_u_px", "after_v_px"]].to_numpy() ** 2
    left = float(np.sqrt(np.average(squares.mean(axis=1), weights=used.weight)))
    yield Figure(f"draw {seed}: residuals by their weight, RMS", left, "px", 0.35, "the bar")
    yield Figure(f"draw {seed}: pictures that take part", float(used.file.nunique()), "", 51.0, "all")
    yield Figure(f"draw {seed}: time of the run", took, "s", 120.0, "the bar")


def _rms(values: picture_drive.Float64) -> float:
    return float(np.sqrt(np.mean(values**2)))
