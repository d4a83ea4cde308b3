"""The labelled street of SemanticKITTI with its pictures, as a survey that is run and published."""

from __future__ import annotations

import csv
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.coloured_streets import rig
from benchmarks.labelled_street import labelled_sweeps, laid_out, survey_text
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.site.material import Material, Wishes
from roadscan.site.site import publish
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

SIZE_PX: Final = (1241, 376)
FOCAL_PX: Final = 718.856
PRINCIPAL_PX: Final = (607.1928, 185.2157)
CAMERA_FROM_VELODYNE: Final = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03],
    ]
)
"""Camera axes: x right, y down, z ahead."""
CAMERA_FROM_VELODYNE_M: Final = np.array([-1.198459927713e-02, -5.403984729748e-02, -2.921968648686e-01])
POLE: Final = 80
TRUNK: Final = 71


@dataclass(frozen=True)
class RecordedStreet:
    """What was recorded, and the site that was made of it."""

    site: Path
    pictures: Path
    places: Float64
    """(n, 3) returns in the frame of sweep 0: ahead, left, up (m)."""
    labels: npt.NDArray[np.uint8]
    poses: Float64
    """(p, 3, 4) velodyne to sweep 0."""
    first: npt.NDArray[np.int64]
    """(s + 1,) first return of each sweep."""

    def sweep(self, number: int) -> Float64:
        """Returns (n, 3) of a sweep in the frame of sweep 0."""
        return self.places[self.first[number] : self.first[number + 1]]

    def leaps_m(self, number: int) -> Float64:
        """By how much the return beside each one (n,) of a sweep, of the same laser, is farther away (m)."""
        pose = self.poses[number]
        own = (self.sweep(number) - pose[:, 3]) @ pose[:, :3]
        range_m = np.linalg.norm(own, axis=1)
        azimuth, elevation = np.arctan2(own[:, 1], own[:, 0]), np.arcsin(own[:, 2] / range_m)
        beside = (np.abs(np.diff(azimuth)) < 0.02) & (np.abs(np.diff(elevation)) < 0.01)
        farther = np.where(beside, np.diff(range_m), 0.0)
        leap = np.maximum(np.append(farther, 0.0), np.insert(-farther, 0, 0.0))
        return np.where(range_m < 40.0, leap, 0.0)

    def pixel(self, place: Float64, picture: int) -> Float64:
        """Pixels (n, 2) of places (n, 3) by the recording's own calibration."""
        pose = self.poses[picture]
        seen = ((place - pose[:, 3]) @ pose[:, :3]) @ CAMERA_FROM_VELODYNE.T + CAMERA_FROM_VELODYNE_M
        return FOCAL_PX * seen[:, :2] / seen[:, 2:] + PRINCIPAL_PX

    def depth_m(self, place: Float64, picture: int) -> Float64:
        """How far ahead of the camera places lie."""
        pose = self.poses[picture]
        return ((place - pose[:, 3]) @ pose[:, :3]) @ CAMERA_FROM_VELODYNE[2] + CAMERA_FROM_VELODYNE_M[2]


def recorded_street(recording: Path, folder: Path) -> RecordedStreet:
    """Run and publish the recording as a survey below a folder."""
    laid_out(recording, folder, range(8))
    shutil.copytree(recording / "image_0", folder / "image_0")
    frames = [line.split(",")[:2] for line in (recording / "poses.csv").read_text().splitlines()[1:]]
    names = [(f"{int(frame):06d}.png", stamp) for frame, stamp in frames]
    with (folder / "pictures.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("file", "time"), *(n for n in names if (recording / "image_0" / n[0]).is_file())])
    (folder / "rig.toml").write_text(rig(CAMERA_FROM_VELODYNE, CAMERA_FROM_VELODYNE_M, SIZE_PX, FOCAL_PX, PRINCIPAL_PX))
    privacy = '\n[privacy]\npictures = "off" # published by their makers\n'
    (folder / "SURVEY.toml").write_text(survey_text(pictures="image_0") + privacy)
    survey = Survey.load(folder / "SURVEY.toml")
    session = Session(survey, Store(survey.store_url, survey.config.id), Inline())
    run_stages(session, [stage_named(name) for name in ("ingest", "footprints", "tiles", "products")])
    session = Session(survey, Store(survey.store_url, survey.config.id), Inline())
    publish(Material(session, Wishes()), folder / "site")
    poses = np.loadtxt(recording / "poses.csv", delimiter=",", skiprows=1)[:, 2:14].reshape(-1, 3, 4)
    places, labels = zip(*labelled_sweeps(folder), strict=True)
    first = np.cumsum([0, *map(len, places)])
    return RecordedStreet(
        folder / "site", recording / "image_0", np.concatenate(places), np.concatenate(labels), poses, first
    )
