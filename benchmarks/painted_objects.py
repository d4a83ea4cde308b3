"""A simulated street in whose pictures each object has a colour of its own, so that a wrong colour is seen at once.

The pictures are cast by the simulator's own rays (four to a pixel) and hold no light and no shadow; the truth of each
lidar return is the object that its beam met.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

import cv2
import laspy
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from roadscan.core.gpstime import ADJUSTED_OFFSET_S, NS_PER_S
from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors import camera as simulated_camera
from roadscan.simulate.sensors.picture import Studio, _Eye

Float64 = npt.NDArray[np.float64]

_LEVELS: Final = (16, 88, 160, 232)
_SUB: Final = (-0.25, 0.25)
_SAME_M: Final = 0.02
"""A point is the return whose true place lies so near (m)."""


def colour_of(object_id: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.uint8]:
    """Colours (n, 3) of objects: each of 64 that lie 72 apart; the road is 0, the sky −1."""
    code = (np.asarray(object_id, np.int64) * 29 + 21) % 64
    levels = np.array(_LEVELS, np.uint8)
    return np.stack([levels[code % 4], levels[code // 4 % 4], levels[code // 16]], axis=-1)


def nearest_code(colour: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.int64]:
    """Number of the nearest of the 64 colours (n,)."""
    step = np.clip(np.rint((colour.astype(np.float64) - _LEVELS[0]) / (_LEVELS[1] - _LEVELS[0])), 0, 3).astype(int)
    return np.asarray(step[:, 0] + 4 * step[:, 1] + 16 * step[:, 2])


def code_of(object_id: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.int64]:
    """Number of an object's colour (n,)."""
    return nearest_code(colour_of(object_id))


def _labelled(studio: Studio, drive: Any, epoch_gps_ns: int, number: int) -> npt.NDArray[np.float32]:
    """Picture (height, width, 3) of the objects' colours."""
    eye = _Eye(studio, drive, epoch_gps_ns, number)
    camera = studio.camera
    rows, columns = (a.ravel() for a in np.indices((camera.height_px, camera.width_px), dtype=np.float32))
    total = np.zeros((rows.size, 3), np.float32)
    for i in _SUB:
        for j in _SUB:
            seen = eye.look(columns + np.float32(j), rows + np.float32(i))
            total += colour_of(seen.object_id)
    return (total / len(_SUB) ** 2).reshape(camera.height_px, camera.width_px, 3)


@contextmanager
def labelled_pictures() -> Iterator[None]:
    """Within it the simulator's pictures are labelled, and without loss (their names do not change)."""
    real = cv2.imencode
    lossless = mock.Mock(wraps=cv2)
    lossless.imencode = lambda _end, picture, _options: real(".png", picture)
    lossless.IMWRITE_JPEG_QUALITY = cv2.IMWRITE_JPEG_QUALITY
    with (
        mock.patch.object(simulated_camera, "picture", _labelled),
        mock.patch.object(simulated_camera, "cv2", lossless),
    ):
        yield


def _street(length_m: float, lidar: dict[str, float], camera: dict[str, Any], range_m: float) -> Scene:
    """A town street with an upright lidar and a camera, without errors of poses; `range_m` is 1 σ of a range."""
    upright = {"lever_arm_body_m": (0.0, 0.0, -1.9), "roll_deg": 0.2, "pitch_deg": 0.0, "heading_deg": 0.5}
    return Scene.load("urban_street").changed(
        length_m=length_m, passes=[{"lane": 2}],
        **{key: {"on": False} for key in ("profilers", "sick", "imu", "gnss", "encoder")},
        lidar={"model": "HDL-32E", "divergence_deg": 0.0, "mount": upright, **lidar},
        camera={"on": True, "every_m": 2.0, **camera},
        noise={"position_m": 0.0, "attitude_deg": 0.0, "lidar_range_m": range_m},
    )  # fmt: skip


def scene(length_m: float = 60.0, **changes: Any) -> Scene:
    """A town street with parked and moving cars, an upright lidar and a camera that looks ahead."""
    camera = {"width_px": 960, "height_px": 600, "noise": 0.0,
              "mount": {"lever_arm_body_m": (0.9, -0.25, -1.6), "pitch_deg": -12.0}}  # fmt: skip
    return _street(length_m, {"range_max_m": 40.0}, camera, 0.0).changed(**changes)


DRAWS: Final = (11, 12, 13)
"""Streets that are scored and nothing else: another layout each; the second and the third have another scanner and
another camera, mounted otherwise."""


def drawn_street(number: int) -> Scene:
    """A town street whose cars, trees and posts stand and drive where chance puts them, and its scanner and camera."""
    rng = np.random.default_rng(number)
    mounts = ((0.9, -0.25, -1.6, -12.0, 0.0), (1.4, 0.45, -2.1, -20.0, 18.0), (0.6, -0.5, -1.9, -8.0, -30.0))
    forward, right, down, pitch, heading = mounts[number - DRAWS[0]]
    camera = {"width_px": 960, "height_px": 600, "noise": 0.0, "focal_px": (820.0, 640.0, 700.0)[number - DRAWS[0]],
              "mount": {"lever_arm_body_m": (forward, right, down), "pitch_deg": pitch, "heading_deg": heading},
    }  # fmt: skip
    lidar = {"model": ("HDL-32E", "OS1-128", "XT32")[number - DRAWS[0]], "range_max_m": 40.0}

    def row(kind: dict[str, Any], count: int, offset_m: float) -> list[dict[str, Any]]:
        stations = np.cumsum(rng.uniform(5.5, 14.0, count)) - 10.0
        return [{**kind, "station_m": float(s), "offset_m": offset_m + rng.uniform(-0.15, 0.15)} for s in stations]

    cars = row({}, 5, 4.2) + row({"heading_deg": 180.0, "shade": 110.0}, 6, -4.2)
    for one in cars:
        one |= {"length_m": rng.uniform(3.8, 5.4), "height_m": rng.uniform(1.4, 2.4), "width_m": rng.uniform(1.7, 2.0)}
    trees = [
        {**one, "height_m": rng.uniform(5.0, 9.0), "crown_m": rng.uniform(2.5, 4.5), "trunk_m": 0.25}
        for one in row({}, 4, 7.2) + row({}, 4, -7.4)
    ]
    driving = [
        {"station_m": rng.uniform(14.0, 30.0), "offset_m": 1.6, "speed_m_per_s": rng.uniform(7.0, 10.0)},
        {"station_m": rng.uniform(40.0, 80.0), "offset_m": -1.6, "speed_m_per_s": -rng.uniform(5.0, 9.0)},
    ]
    beside = {
        "parked_cars": cars, "trees": trees, "moving_cars": driving,
        "poles": row({"height_m": 0.9, "diameter_m": 0.12}, 6, 5.6), "lamp_posts": row({"height_m": 6.0}, 3, -5.8),
        "facades": [{"offset_m": side * rng.uniform(9.0, 11.0), "start_m": -40.0, "end_m": rng.uniform(70.0, 110.0),
                     "height_m": rng.uniform(7.0, 14.0)} for side in (-1.0, 1.0)],
    }  # fmt: skip
    return _street(50.0, lidar, camera, 0.0).changed(seed=number, roadside=beside)


def photographed_street(length_m: float = 24.0, **changes: Any) -> Scene:
    """A street with painted lines, an upright lidar and a camera that looks down ahead of the vehicle."""
    camera = {"width_px": 1400, "height_px": 900, "focal_px": 1000.0,
              "mount": {"lever_arm_body_m": (0.9, -0.25, -1.8), "pitch_deg": -35.0}}  # fmt: skip
    return _street(length_m, {"range_max_m": 25.0}, camera, 0.01).changed(**changes)


def written(folder: Path, sections: str, one: Scene) -> Path:
    """Simulate the scene into a folder, with sections added to its survey file; returns that."""
    with labelled_pictures():
        file = simulate(one, folder, write_hits=True).survey_file
    with file.open("a") as stream:
        stream.write(sections)
    return file


@dataclass(frozen=True, eq=False)
class Judged:
    """Coloured points of a survey beside the truth."""

    place_m: Float64
    """(n, 3) easting, northing, height."""
    epoch_gps_ns: npt.NDArray[np.int64]
    colour: npt.NDArray[np.uint8]
    pictures: npt.NDArray[np.uint8]
    """(n,) of how many the colour is the median; 0 without a colour."""
    object_id: npt.NDArray[np.int32]
    """(n,) what the beam met; −9 where that is not known, or where it met two things."""

    @property
    def coloured(self) -> npt.NDArray[np.bool_]:
        """Points of known objects that have a colour."""
        return (self.pictures > 0) & (self.object_id > -9)

    @property
    def wrong(self) -> npt.NDArray[np.bool_]:
        """Points with the colour of another object."""
        return self.coloured & (nearest_code(self.colour) != code_of(self.object_id))


def judged(survey_folder: Path, products: Path, run: str = "run-1") -> Judged:
    """Coloured points of the products, each with the object that its beam met."""
    hits = pq.read_table(truth.load(survey_folder).hits_file(run, "lidar")).to_pandas()
    parts = [laspy.read(file) for file in sorted(products.glob("*.laz"))]
    place = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts])
    epoch = np.concatenate([np.rint(np.asarray(p.gps_time) * NS_PER_S) for p in parts]).astype(np.int64)
    epoch += ADJUSTED_OFFSET_S * NS_PER_S
    colour = np.concatenate([np.column_stack([p.red, p.green, p.blue]) // 257 for p in parts]).astype(np.uint8)
    count = np.concatenate([np.asarray(p["pictures"]) for p in parts])
    first = int(hits.epoch_gps_ns.min())
    true = hits[["easting_m", "northing_m", "height_m"]].to_numpy()
    # A metre a millisecond keeps returns of different instants apart.
    tree = cKDTree(np.column_stack([true, (hits.epoch_gps_ns.to_numpy() - first) / 1e6]))
    away, row = tree.query(np.column_stack([place, (epoch - first) / 1e6]), distance_upper_bound=_SAME_M)
    known = np.isfinite(away)
    row = np.minimum(row, len(hits) - 1)
    ids = np.where(known & ~hits.is_mixed.to_numpy()[row], hits.object_id.to_numpy()[row], -9)
    return Judged(place, epoch, colour, count, ids.astype(np.int32))


def seen_by_truth(
    survey_folder: Path, found: Judged, nearest_m: float = 2.0, farthest_m: float = 40.0
) -> npt.NDArray[np.bool_]:
    """Points that lie in the middle of a patch of the road's colour in a picture, by the camera's true pose."""
    known = truth.load(survey_folder)
    world = Earth(known.scene.map.crs).ecef_from_map(found.place_m)
    seen, road = np.zeros(len(world), bool), int(code_of(np.array([0]))[0])
    camera = known.scene.camera
    size = camera.width_px, camera.height_px
    for pose in pq.read_table(known.camera_file("run-1")).to_pylist():
        turn = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")]).as_matrix()
        ahead, right, down = ((world - [pose[f"{a}_world_m"] for a in "xyz"]) @ turn).T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = [camera.focal_px * a / ahead + (n - 1) / 2 for a, n in zip((right, down), size, strict=True)]
        inside = (ahead > nearest_m) & (ahead < farthest_m)
        for place, count in zip(pixel, size, strict=True):
            inside &= (place > 8) & (place < count - 9)
        picture = cv2.imread(str(survey_folder / "raw/run-1/camera" / pose["file"]))[:, :, ::-1]
        same = (nearest_code(picture.reshape(-1, 3)) == road).reshape(picture.shape[:2]).astype(np.uint8)
        wide = cv2.erode(same, np.ones((3, 3), np.uint8)) > 0
        rows = np.flatnonzero(inside)
        seen[rows] |= wide[np.rint(pixel[1][rows]).astype(int), np.rint(pixel[0][rows]).astype(int)]
    return seen
