"""A short survey without errors, with a camera, run once: its pictures and the ground are exact."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from roadscan.simulate import simulate, truth
from roadscan.simulate.path import Earth
from tests.surveys import Simulated, small_scene

FOCAL, WIDTH, HEIGHT = 520.0, 640, 400
DISTORTION = (-0.10, 0.02, 0.001, -0.002, 0.0)
MATRIX = np.array([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
CAMERA = {"on": True, "every_m": 3.0, "width_px": WIDTH, "height_px": HEIGHT, "focal_px": FOCAL,
          "distortion": list(DISTORTION)}  # fmt: skip
NO_FILES: dict[str, object] = {"products__make": ["tile_table"], "adjust__on": False}


@dataclass
class Drive(Simulated):
    """A survey with the simulator's truth."""

    @cached_property
    def known(self) -> truth.Truth:
        return truth.load(self.survey_file.parent)

    @cached_property
    def poses(self) -> dict[str, dict[str, float]]:
        """True poses of the camera by picture."""
        rows = pq.read_table(self.known.camera_file("run-1")).to_pylist()
        return {row["file"]: row for row in rows}

    def camera(self, file: str) -> tuple[np.ndarray, Rotation]:
        """Where the camera truly was (geocentric), and its axes (forward, right, down) there."""
        row = self.poses[file]
        return np.array([row[f"{a}_world_m"] for a in "xyz"]), Rotation.from_quat([row[f"q{a}"] for a in "xyzw"])

    def world(self, enh_m: np.ndarray) -> np.ndarray:
        """Geocentric places of the map, by PROJ."""
        return Earth(self.known.scene.map.crs).ecef_from_map(np.atleast_2d(enh_m))

    def seen(self, file: str, enh_m: np.ndarray) -> np.ndarray:
        """Places of the map in true camera axes: right, down, ahead."""
        eye, turn = self.camera(file)
        return np.ascontiguousarray(turn.inv().apply(self.world(enh_m) - eye)[:, [1, 2, 0]])

    def pixels(self, file: str, enh_m: np.ndarray) -> np.ndarray:
        """Pixels of places of the map, by OpenCV with the true pose; NaN outside the picture."""
        own = self.seen(file, enh_m)
        found = cv2.projectPoints(own, np.zeros(3), np.zeros(3), MATRIX, np.array(DISTORTION))[0].reshape(-1, 2)
        ahead = (own[:, 2] > 0.5) & (np.hypot(own[:, 0], own[:, 1]) < 1.2 * own[:, 2])
        inside = ahead & (found >= 2.0).all(axis=1) & (found <= [WIDTH - 3.0, HEIGHT - 3.0]).all(axis=1)
        found[~inside] = np.nan
        return found

    def corners(self) -> np.ndarray:
        """Places on the road (n, 3): where its lane lines begin and end, and others at even steps."""
        station, offset = np.meshgrid(np.arange(2.0, 13.0, 0.5), np.array([-1.5, -0.06, 0.06, 1.0, 1.75, 3.0]))
        east, north, _ = self.known.surface.place(station.ravel(), offset.ravel())
        return np.column_stack([east, north, self.known.height_m(east, north)])


@pytest.fixture(scope="session")
def measured_drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    scene = small_scene(camera=CAMERA, passes=[{"lane": 2}]).noiseless()
    one = Drive(simulate(scene, tmp_path_factory.mktemp("measuring") / "survey").survey_file)
    one.run(**NO_FILES)
    return one
