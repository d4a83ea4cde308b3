"""The boresight of a recorded camera that starts off, after `roadscan run`: what range edges say, and the adjustment.

python -m benchmarks.bench_boresight FOLDER [ROLL PITCH HEADING] [--half 0 | 1] [--street]

Turns the stated boresight of `colour_and_lidar` (with --street: of `semantic_kitti_00`) by these angles about the axes
of the body (degrees; 1 −1 1 where not given), runs the survey up to the adjustment and prints what is left against the
published mounting. --half takes every second picture alone.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from benchmarks.coloured_streets import colour_and_lidar, rig
from benchmarks.labelled_street import RECORDING, laid_out, survey_text
from benchmarks.timing import Figure
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.manifest import recorded_table
from roadscan.store.small_tables import read_small
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

STAGES = ("ingest", "navigate", "footprints", "picture_ties", "adjust")
AXES = ("roll", "pitch", "heading")
FRAMES = tuple(range(0, 37, 3))
TURN_DEG = (1.0, -1.0, 1.0)
STREET_FROM_VELODYNE = (
    np.array(
        [
            [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03],
            [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01],
            [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03],
        ]
    ),
    np.array([-1.198459927713e-02, -5.403984729748e-02, -2.921968648686e-01]),
)
"""As the recording `semantic_kitti_00` publishes it: axes right, down, ahead."""


def street(recording: Path, folder: Path, half: int | None) -> Path:
    """Write the survey of `semantic_kitti_00` with its pictures; returns its survey file."""
    laid_out(recording, folder, range(8))
    shutil.copytree(recording / "image_0", folder / "image_0")
    rows = [line.split(",")[:2] for line in (recording / "poses.csv").read_text().splitlines()[1:]]
    taken = [
        (f"{int(n):06d}.png", stamp) for n, stamp in rows if (recording / "image_0" / f"{int(n):06d}.png").is_file()
    ]
    with (folder / "pictures.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("file", "time"), *(taken if half is None else taken[half::2])])
    (folder / "rig.toml").write_text(rig(*STREET_FROM_VELODYNE, (1241, 376), 718.856, (607.1928, 185.2157)))
    (folder / "SURVEY.toml").write_text(survey_text(pictures="image_0"))
    return folder / "SURVEY.toml"


def turned(file: Path, off_deg: Float64) -> None:
    """Turn the stated camera of a survey, and let the survey be adjusted with its pictures."""
    path = file.parent / "rig.toml"
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("body_from_sensor"))
    stated = np.array(tomllib.loads(lines[at])["body_from_sensor"])
    off = Rotation.from_rotvec(off_deg, degrees=True).as_matrix() @ stated
    lines[at] = f"body_from_sensor = {off.tolist()}"
    path.write_text("\n".join(lines) + "\n")
    text = file.read_text().replace("[adjust]\non = false", "[adjust]\n[adjust.priors]\nattitude_time_s = 1.0")
    file.write_text(f"{text}\n[picture_ties]\n")


def left_after(file: Path, off_deg: Float64) -> Iterator[tuple[str, Float64, Float64]]:
    """Yields who says it, and what is left of the turn with its σ (3,) about the axes of the body (°), after a run.

    file : of a survey whose camera is turned by `off_deg` first.
    """
    turned(file, off_deg)
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in STAGES])
    for record in session.manifest.of("edge_boresights").values():
        for row in recorded_table(session.store, record).to_pylist():
            found, sigma = (np.array([row[f"{word}{a}_deg"] for a in AXES], np.float64) for word in ("", "sigma_"))
            why = row["why_not"] or "used"
            yield f"{row['edges']} edges in {row['pictures']} pictures, {why}", found + off_deg, sigma
    table = read_small(session.store, "mounting_corrections")
    for row in [] if table is None else table.to_pylist():
        if row["sensor"] == "camera":
            names = [f"{axis}_rad" for axis in AXES]
            found, sigma = (np.degrees([row[f"{word}{name}"] for name in names]) for word in ("", "sigma_"))
            yield "adjusted", found + off_deg, sigma


def figures(folder: Path) -> Iterator[Figure]:
    """Yields what the adjustment leaves of a turn by 1° about each axis."""
    data = Path(os.environ.get("ROADSCAN_DATA", "../shared/data"))
    file = colour_and_lidar(data / "pictures" / "colour_and_lidar", folder / "drive", "", FRAMES)
    *_, (_, left, sigma) = left_after(file, np.array(TURN_DEG))
    for axis, one, its_sigma in zip(AXES, left.tolist(), sigma.tolist(), strict=True):
        yield Figure(f"boresight, colour_and_lidar, {axis}: left of 1°", abs(one), "°", None, f"1 σ {its_sigma:.2f}°")


def main() -> None:
    """Print what is left."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("off", type=float, nargs="*", default=TURN_DEG)
    parser.add_argument("--half", type=int, choices=(0, 1))
    parser.add_argument("--street", action="store_true")
    asked = parser.parse_args()
    data = Path(os.environ.get("ROADSCAN_DATA", "../shared/data"))
    if asked.street:
        file = street(data / RECORDING, asked.folder, asked.half)
    else:
        frames = FRAMES if asked.half is None else FRAMES[asked.half :: 2]
        file = colour_and_lidar(data / "pictures" / "colour_and_lidar", asked.folder, "", frames)
    for what, left, sigma in left_after(file, np.array(asked.off)):
        print(f"{what}: left", left.round(3), "1 σ", sigma.round(3))
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(f"processor time {used.ru_utime + used.ru_stime:.1f} s, {used.ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
