"""Coloured clouds and orthophotos of recordings, held against their own pictures and returns.

python -m benchmarks.bench_imagery [recorded | simulated | draws] [FOLDER]

recorded, `colour_and_lidar`: a cloud with the colours of every second picture, against the other pictures; the
orthophoto against the calibrated intensities of the lidar. simulated: a street whose objects have colours of their own,
and painted corners in an orthophoto. draws: other such streets.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Final

import cv2
import laspy
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq

from benchmarks.coloured_streets import colour_and_lidar
from benchmarks.judge_imagery import corner_shifts_m, edge_shifts_px, paint_shift_m
from benchmarks.painted_objects import (
    DRAWS,
    code_of,
    drawn_street,
    judged,
    nearest_code,
    photographed_street,
    scene,
    seen_by_truth,
    written,
)
from roadscan.assets.intensity import ON_GROUND_M, calibrated_scene
from roadscan.assets.scene import Statistics
from roadscan.assets.tasks.load_returns import load_squares, scene_of
from roadscan.assets.tasks.plan import asset_grid, readings_of
from roadscan.assets.tasks.work import plan_evidence
from roadscan.colours.kernels.looks import Limits, look, project
from roadscan.colours.painting import cameras_of
from roadscan.colours.tasks.share import Shares
from roadscan.colours.tasks.work import plan_work
from roadscan.core.grid import Bounds
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import simulate, truth
from roadscan.survey.run import run_stages

FRAMES: Final = tuple(range(0, 37, 3))
STAGES: Final = ("ingest", "navigate", "footprints", "tiles", "colours")
SECTIONS: Final = "\n[colours]\n[colours.orthophoto]\n"
PAINT: Final = (
    ("left line, looked at", (8.9, 1.1, 10.0, 2.1), 1),
    ("left line, looked at", (10.0, 1.1, 11.5, 2.1), 1),
    ("begin of its dash, looked at", (7.9, 1.46, 9.6, 1.60), 0),
    ("right line, scored once", (8.4, -2.6, 10.0, -1.3), 1),
    ("right line, scored once", (10.0, -2.6, 11.9, -1.3), 1),
)
"""Boxes (west, south, east, north; m) of the recording with paint, and the axis that it crosses."""


def run(file: Path, *more: str) -> Session:
    """Run the stages that colours need, and some more before them."""
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in (*STAGES[:-1], *more, STAGES[-1])])
    return session


def clouds(session: Session) -> list[Path]:
    """Files of the coloured points."""
    return sorted(Path(session.store.path("products/coloured_points")).glob("*.laz"))


def edges_px(cloud: Session, whole: Session, frames: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Shifts (n, 2) between a cloud and pictures that gave it no colour; `whole` tells what these pictures show."""
    parts = [laspy.read(file) for file in clouds(cloud)]
    place = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts])
    colour = np.concatenate([np.column_stack([p.red, p.green, p.blue]) / 257.0 for p in parts])
    has = np.concatenate([np.asarray(p["pictures"]) for p in parts]) > 0
    epoch = np.concatenate([np.asarray(p.gps_time) for p in parts])[has]
    place, light = place[has], colour[has] @ (0.299, 0.587, 0.114)
    work = plan_work(whole)
    assert work.plan is not None
    assert work.gains is not None
    west, south = place[:, :2].min(axis=0)
    east, north = place[:, :2].max(axis=0)
    share = Shares(work.plan, whole.manifest, work.gains).near([Bounds(west, south, east, north)], 40.0)
    point, none = place.astype(np.float32), np.full((len(place), 3), np.nan, np.float32)
    gps_ns = np.rint((epoch + 1e9) * 1e9).astype(np.int64)
    found = [np.zeros((0, 2))]
    depths = share.palette(whole.store).depths()
    for number, (camera, shown) in enumerate(zip(cameras_of(share.pictures, np.zeros(3)), depths, strict=True)):
        if int(Path(share.pictures.files[number]).stem) not in frames:
            continue
        picture = cv2.cvtColor(cv2.imread(str(share.pictures.path(number))), cv2.COLOR_BGR2RGB)
        own, weight = np.zeros((len(point), 3), np.float32), np.zeros(len(point), np.float32)
        limits = Limits(30.0, 8.0, 0.0, 0.0, 60_000_000, 1.0)
        taken = int(share.pictures.epochs_gps_ns[number])
        look(point, gps_ns, none, camera, taken, shown, limits, np.zeros((0, 0), bool), picture, own, weight,
             np.empty(len(point), np.uint8))  # fmt: skip
        pixel, away = np.empty((len(point), 2), np.float32), np.empty(len(point), np.float32)
        project(point, camera, 40.0, pixel, away)
        seen = weight > 0.0
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        found.append(edge_shifts_px(pixel[seen].astype(np.float64), light[seen], grey))
    return np.concatenate(found)


def recorded(folder: Path) -> None:
    """Print the figures of the recording."""
    data = Path(os.environ.get("ROADSCAN_DATA", "../shared/data")) / "pictures" / "colour_and_lidar"
    half = run(colour_and_lidar(data, folder / "half", SECTIONS, FRAMES[::2]))
    whole = run(colour_and_lidar(data, folder / "whole", SECTIONS))
    shifts = edges_px(half, whole, FRAMES[1::2])
    size = np.hypot(*np.nan_to_num(shifts[~np.isnan(shifts).all(axis=1)]).T)
    print(f"colour edges: {size.size} windows, median {np.median(size):.2f} px, mean {np.nanmean(shifts, axis=0)}")
    for raised in (False, True):
        file = colour_and_lidar(data, folder / f"paint-{raised}", f"[assets]{SECTIONS}", raised=raised)
        session = run(file, "assets")
        photo, light = Path(session.store.path("products/orthophoto/orthophoto.vrt")), calibrated_ground(session)
        for name, box, axis in PAINT:
            shift, agrees, sigma = paint_shift_m(photo, light, box, axis)
            print(f"beams raised: {raised}; {name}: {shift:.3f} m, 1 σ {sigma:.3f} m, correlation {agrees:.2f}")


def calibrated_ground(session: Session) -> npt.NDArray[np.float64]:
    """Returns of the ground (n, 4): easting, northing, intensity with the survey's gains of lasers, time (s)."""
    plan = plan_evidence(session).plan
    assert plan is not None
    grid = asset_grid(plan.survey.survey, plan.config)
    gains = session.store.read_table("tables/intensity_gains/intensity_gains.parquet")
    squares = sorted(readings_of(grid, plan.tiles.tiles), key=lambda square: (square.row, square.column))
    found = [np.zeros((0, 4))]
    for loaded in load_squares(plan.load(tuple(squares), grid)):
        if len(loaded.returns):
            scene_here = calibrated_scene(scene_of(grid, loaded, plan.config.ground, Statistics()), gains)
            r = scene_here.returns
            low = np.abs(r.height_m - scene_here.ground.height_at(r.x_m, r.y_m)) <= ON_GROUND_M
            columns = r.x_m + r.corner_m[0], r.y_m + r.corner_m[1], r.intensity, r.epoch_gps_ns / 1e9
            found.append(np.column_stack(columns)[low])
    return np.unique(np.concatenate(found), axis=0)  # squares overlap


def draws(folder: Path) -> None:
    """Print the figures of other streets."""
    for number in DRAWS:
        coloured(run(written(folder / f"draw-{number}", "\n[colours]\n", drawn_street(number))), f"draw {number}")


def simulated(folder: Path) -> None:
    """Print the figures of the simulated streets."""
    coloured(run(written(folder / "street", "\n[colours]\n", scene())), "street")
    photo = run_photo(folder / "photo")
    away = np.hypot(*corner_shifts_m(photo, truth.load(folder / "photo")).T)
    print(f"painted corners: {away.size}, median {np.median(away):.4f} m, 95 % {np.percentile(away, 95):.4f}, "
          f"largest {away.max():.4f}")  # fmt: skip


def coloured(street: Session, name: str) -> None:
    """Print how many points have the colour of another object, and how many seen points have one."""
    folder = street.survey.folder
    known, found = truth.load(folder), judged(folder, clouds(street)[0].parent)
    objects = pq.read_table(known.objects_file).to_pandas()
    trees = objects.object_id[objects.kind == "tree"].to_numpy()
    leafy = np.isin(found.object_id, trees) | np.isin(nearest_code(found.colour), code_of(trees))
    share = found.wrong.sum() / found.coloured.sum()
    print(f"{name}: colour of another object: {share:.4%} of {found.coloured.sum():,} points")
    bare = found.coloured & ~np.isin(found.object_id, trees)
    print(f"where no tree is involved: {(found.wrong & ~leafy).sum() / bare.sum():.4%}")
    ground, seen = found.object_id == 0, seen_by_truth(folder, found)
    _, offset = known.station_offset_m(*found.place_m[:, :2].T)
    for part, own in (("lanes", ground & seen & (np.abs(offset) < 3.0)), ("all ground", ground & seen)):
        share = np.mean(found.pictures[own] > 0)
        print(f"points of {part} that a picture shows: {own.sum():,}, with a colour {share:.2%}")


def run_photo(folder: Path) -> Path:
    """Run the street whose orthophoto is judged; returns its mosaic."""
    file = simulate(photographed_street(), folder).survey_file
    with file.open("a") as stream:
        stream.write("\n[colours]\npoints = false\n[colours.orthophoto]\n")
    return Path(run(file).store.path("products/orthophoto/orthophoto.vrt"))


def main(arguments: list[str]) -> None:
    """Print the figures that are asked for."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(arguments[1] if len(arguments) > 1 else temporary)
        for name, judge in (("recorded", recorded), ("simulated", simulated), ("draws", draws)):
            if not arguments or arguments[0] == name:
                judge(folder)


if __name__ == "__main__":
    main(sys.argv[1:])
