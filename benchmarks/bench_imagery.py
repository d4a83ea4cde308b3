"""Coloured clouds and orthophotos of recordings, held against their own pictures and returns.

python -m benchmarks.bench_imagery [recorded | simulated] [FOLDER]

recorded, `colour_and_lidar`: a cloud with the colours of every second picture, against the other pictures; the
orthophoto against the intensities of the lidar. simulated: a street whose objects have colours of their own, and
painted corners in an orthophoto.
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
from benchmarks.judge_imagery import corner_shifts_m, edge_shifts_px, intensity_shifts_m
from benchmarks.painted_objects import code_of, judged, nearest_code, photographed_street, scene, seen_by_truth, written
from roadscan.colours.cameras import cameras_of
from roadscan.colours.kernels.looks import Limits, look, project
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


def run(file: Path) -> Session:
    """Run the stages that colours need."""
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in STAGES])
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
             np.empty(len(point), np.bool_))  # fmt: skip
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
    photo = Path(whole.store.path("products/orthophoto/orthophoto.vrt"))
    told = intensity_shifts_m(photo, clouds(whole))
    print(f"orthophoto against intensity: {len(told)} windows, {told.round(3).tolist()}")


def simulated(folder: Path) -> None:
    """Print the figures of the simulated streets."""
    street = run(written(folder / "street", "\n[colours]\n", scene()))
    known, found = truth.load(folder / "street"), judged(folder / "street", clouds(street)[0].parent)
    objects = pq.read_table(known.objects_file).to_pandas()
    trees = objects.object_id[objects.kind == "tree"].to_numpy()
    leafy = np.isin(found.object_id, trees) | np.isin(nearest_code(found.colour), code_of(trees))
    print(
        f"colour of another object: {found.wrong.sum() / found.coloured.sum():.4%} of {found.coloured.sum():,} points"
    )
    bare = found.coloured & ~np.isin(found.object_id, trees)
    print(f"where no tree is involved: {(found.wrong & ~leafy).sum() / bare.sum():.4%}")
    ground, seen = found.object_id == 0, seen_by_truth(folder / "street", found)
    _, offset = known.station_offset_m(*found.place_m[:, :2].T)
    for name, own in (("lanes", ground & seen & (np.abs(offset) < 3.0)), ("all ground", ground & seen)):
        share = np.mean(found.pictures[own] > 0)
        print(f"points of {name} that a picture shows: {own.sum():,}, with a colour {share:.2%}")
    photo = run_photo(folder / "photo")
    away = np.hypot(*corner_shifts_m(photo, truth.load(folder / "photo")).T)
    print(f"painted corners: {away.size}, median {np.median(away):.4f} m, 95 % {np.percentile(away, 95):.4f}, "
          f"largest {away.max():.4f}")  # fmt: skip


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
        for name, judge in (("recorded", recorded), ("simulated", simulated)):
            if not arguments or arguments[0] == name:
                judge(folder)


if __name__ == "__main__":
    main(sys.argv[1:])
