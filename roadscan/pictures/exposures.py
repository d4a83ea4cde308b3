"""Exposures of cameras: the pictures and key frames that stand for them, when each was taken, and the camera's pose."""

from __future__ import annotations

import atexit
import functools
import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float64, Int64, UInt8
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import cv2
from roadscan.core.frames import SENSOR_FROM_OPENCV
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Interior, Sensor
from roadscan.georeference.plan.plan import SurveyPlan, mountings_of, trajectory_source
from roadscan.georeference.sources import load_mountings
from roadscan.navigation.tasks.recorded_pictures import TakenPictures, taken_pictures
from roadscan.navigation.tasks.trajectories import TrajectorySource, load_recorded
from roadscan.pictures.lens import Lens
from roadscan.pictures.settings import VideoFramesConfig
from roadscan.poses.trajectory import world_from_ned
from roadscan.store.codecs.child import Child, ChildError
from roadscan.store.codecs.image_files import ImageError, image_size
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord
from roadscan.store.store import Store

FRAMES: Final = "video_frames"
"""Product of the manifest: a file a key frame."""
FOLDER: Final = "products/video_frames"
"""Folder of these files in the store: one a log."""
_PIECE_NS: Final = 600 * NS_PER_S
"""Poses of this long (ns) are loaded at once."""


def camera_pictures(plan: SurveyPlan, sensor: str) -> list[TakenPictures]:
    """Returns the pictures of a camera, log by log; of a video those frames between which the vehicle drives
    `video_frames.step_m` or more by the recorded poses, and none where [video_frames] is off.
    """
    config = VideoFramesConfig.of(plan.survey)
    found = list[TakenPictures]()
    for taken in taken_pictures(plan.store, plan.records, sensor):
        if not taken.is_video:
            found.append(taken)
        elif config.on:
            found.append(taken.at(_key_frames(plan, taken, config.step_m)))
    return found


def folder_of(plan: SurveyPlan, taken: TakenPictures) -> Path:
    """Returns the folder of the files of a log's pictures; that of key frames is in the store."""
    if taken.is_video:
        return Path(plan.store.path(f"{FOLDER}/{taken.record.key}"))
    return plan.survey.resolve(Path(taken.record.path))


def _key_frames(plan: SurveyPlan, taken: TakenPictures, step_m: float) -> Int64:
    """Returns rows of frames, in order of time, of which each was taken `step_m` or more away from the one before."""
    order = np.argsort(taken.epochs_gps_ns, kind="stable")
    place = _places_m(plan, taken, order)
    chosen, last = list[int](), np.full(3, np.inf)
    for row, own in zip(order.tolist(), place, strict=True):
        # A frame without a pose (NaN) is never far enough away.
        if not np.isinf(last[0]) and not np.linalg.norm(own - last) >= step_m:
            continue
        if np.isfinite(own[0]):
            chosen.append(row)
            last = own
    return np.array(chosen, np.int64)


def _places_m(plan: SurveyPlan, taken: TakenPictures, order: Int64) -> Float64:
    """Returns where the body was at each frame (n, 3; m, world frame), in some order; NaN without a pose."""
    epochs = taken.epochs_gps_ns[order]
    place = np.full((epochs.size, 3), np.nan)
    try:
        source = trajectory_source(taken.record.run, plan.records)
    except RoadscanError:
        return place  # A run without poses has no pictures with a place.
    for rows in np.split(np.arange(epochs.size), np.flatnonzero(np.diff(epochs // _PIECE_NS)) + 1):
        span = (int(epochs[rows[0]]), int(epochs[rows[-1]]))
        poses = load_recorded(plan.store, source, [span], plan.ground.max_gap_s).poses(epochs[rows])
        place[rows[poses.found]] = poses.position_world_m[poses.found]
    return place


_ASKED: Final = struct.Struct("<2d")
_SIZE: Final = struct.Struct("<2i")
_TIMEOUT_S: Final = 300.0
"""Time for a frame (s): a video without an index is read from its beginning."""
_QUALITY: Final = 95
"""Quality of the JPEG files: what their compression adds to the place of a feature is below 0.05 px."""


@dataclass(frozen=True)
class FrameTask:
    """A key frame of a video."""

    store: Store
    video: Path
    since_s: float
    """Time in the container since the first frame."""
    off_s: float
    """By how much a frame's time may differ from that."""
    unit: str
    """Log and file name."""
    key: str


@dataclass
class _Open:
    """The video that this process reads."""

    path: Path | None = None
    child: Child | None = None

    def of(self, path: Path) -> Child:
        """Returns the process that reads a video."""
        if self.child is None or path != self.path:
            self.close()
            self.path, self.child = path, Child("frame_worker", str(path))
        return self.child

    def close(self) -> None:
        """End the process."""
        if self.child is not None:
            self.child.close()
        self.path, self.child = None, None


_OPEN: Final = _Open()
atexit.register(_OPEN.close)


def write_frame(task: FrameTask) -> OutputRecord:
    """Decode a frame and write it as JPEG (runs on a worker); a record without a file where it cannot be decoded."""
    request = _ASKED.pack(1e3 * task.since_s, 1e3 * task.off_s)
    try:
        reply = _OPEN.of(task.video).ask(request, _TIMEOUT_S)
    except ChildError as error:
        return OutputRecord(FRAMES, task.unit, task.key, "", 0, "", str(error))
    height, width = _SIZE.unpack_from(reply)
    picture = np.frombuffer(reply, np.uint8, offset=_SIZE.size).reshape(height, width, 3)
    done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        return OutputRecord(FRAMES, task.unit, task.key, "", 0, "", "the frame cannot be written as JPEG")
    content, target = encoded.tobytes(), f"{FOLDER}/{task.unit}"
    task.store.write_bytes(target, content, lasting=False)
    return OutputRecord(FRAMES, task.unit, task.key, target, len(content), bytes_digest(content))


def read_picture(path: Path, size_px: tuple[int, int], *, grey: bool = False) -> UInt8:
    """Returns a decoded picture (height, width, 3; red first) or its grey values (height, width), in the orientation of
    the sensor, whatever its orientation tag.

    Parameters
    ----------
    size_px : width and height that it has to have: those of its lens.

    Raises
    ------
    ImageError
        It is cut short, of another size, or cannot be decoded.
    OSError
        It cannot be read.
    """
    size = image_size(path)  # detects truncated files, which a decoder would fill up
    if (size.width_px, size.height_px) != size_px:
        raise ImageError(f"{size.width_px} × {size.height_px} pixels, not {size_px[0]} × {size_px[1]}")
    content = np.frombuffer(path.read_bytes(), np.uint8)
    colours = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    picture = cv2.imdecode(content, colours | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None or picture.shape[:2] != size_px[::-1]:
        raise ImageError("the image cannot be decoded")
    return np.asarray(picture if grey else np.ascontiguousarray(picture[:, :, ::-1]), np.uint8)


_BESIDE_NS: Final = 10_000_000
"""Poses so long before and after an exposure (ns) give the motion in between."""


@dataclass(frozen=True)
class Camera:
    """A camera of a run."""

    run: str
    sensor: str
    log: str
    """Key of the log of its pictures."""
    folder: Path
    rig: Sensor
    """What the rig file states of it."""
    interior: Interior
    """Its interior orientation, as the rig file states it."""
    world: str
    """World frame of the run's poses."""

    @functools.cached_property
    def lens(self) -> Lens:
        """Returns the lens of that interior orientation."""
        return Lens.of(self.interior, self.rig.own_vehicle_px)


@dataclass(frozen=True)
class Exposures:
    """n pictures that have a recorded pose, by camera and time."""

    cameras: tuple[Camera, ...]
    camera: Int64
    """(n,) number of the camera."""
    epoch_gps_ns: Int64
    """(n,)"""
    file: npt.NDArray[Any]
    """(n,) path relative to the camera's folder."""
    body_world_m: Float64
    """(n, 3) origin of the body."""
    world_from_body: Float64
    """(n, 3, 3)"""
    velocity_world_m_s: Float64
    """(n, 3) of the origin of the body."""
    rate_body_rad_s: Float64
    """(n, 3) turn of the body, along its axes."""
    level_from_body: Float64
    """(n, 3, 3) north, east, down from body axes."""
    lever_body_m: Float64
    """(n, 3) of the camera, as stated."""
    body_from_opencv: Float64
    """(n, 3, 3) of the camera's axes in OpenCV's order, as stated."""

    def __len__(self) -> int:
        """Returns the number of pictures."""
        return self.epoch_gps_ns.size

    def at(self, rows: Int64 | Bool) -> Self:
        """Returns a subset."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return type(self)(**{n: v if n == "cameras" else v[rows] for n, v in values.items()})

    def name(self, number: int) -> str:
        """Returns the name of a picture in messages."""
        camera = self.cameras[self.camera[number]]
        return f"{camera.run}/{camera.sensor}/{self.file[number]}"

    def path(self, number: int) -> Path:
        """Returns the file of a picture."""
        return Path(self.cameras[self.camera[number]].folder, str(self.file[number]))

    @property
    def eye_world_m(self) -> Float64:
        """Returns projection centres (n, 3)."""
        return np.asarray(self.body_world_m + np.einsum("nij,nj->ni", self.world_from_body, self.lever_body_m))

    @property
    def world_from_opencv(self) -> Float64:
        """Returns attitudes (n, 3, 3) of the cameras."""
        return np.asarray(self.world_from_body @ self.body_from_opencv)


def exposures_of(plan: SurveyPlan) -> tuple[Exposures, tuple[str, ...]]:
    """Returns the pictures of all cameras with an interior orientation, and notes on those that are left out.

    A picture is left out whose size is not that of the interior orientation, and one at whose time there is no pose.
    """
    parts, cameras, notes = list[Exposures](), list[Camera](), list[str]()
    for name, sensor in sorted(plan.survey.rig.sensors.items()):
        if sensor.kind != "camera":
            continue
        for taken in camera_pictures(plan, name):
            where = f"{taken.record.run}/{name}"
            if sensor.interior is None:
                notes.append(f"{where}: {len(taken.files)} pictures left out: no interior orientation in the rig file")
                continue
            own, said = _of_log(plan, (sensor, sensor.interior), taken, len(cameras))
            parts.append(own)
            cameras += own.cameras
            notes += [f"{where}: {one}" for one in said]
    return _joined(parts, cameras), tuple(notes)


def _of_log(
    plan: SurveyPlan, camera: tuple[Sensor, Interior], taken: TakenPictures, number: int
) -> tuple[Exposures, list[str]]:
    """Returns the pictures of a log, and how many were left out."""
    record, (rig, interior) = taken.record, camera
    source = trajectory_source(record.run, plan.records)
    size = interior.width_px, interior.height_px
    fits = ((taken.size_px == 0) | (taken.size_px == size)).all(axis=1)
    order = np.argsort(taken.epochs_gps_ns, kind="stable")
    rows = order[fits[order]]
    epochs = taken.epochs_gps_ns[rows]
    first = np.concatenate([[True], np.diff(epochs) > 0]) if epochs.size else np.zeros(0, bool)
    found, body, turned, velocity, rate = _motion(plan, source, epochs)
    kept = found & first
    notes = []
    for count, why in (
        (int((~fits).sum()), f"another size than the {size[0]} × {size[1]} px of the interior orientation"),
        (int((~first).sum()), "the epoch of the picture before"),
        (int((~found & first).sum()), "no recorded pose at their time"),
    ):
        if count:
            notes.append(f"{count} of {order.size} pictures left out: {why}")
    lever, axes = np.empty((epochs.size, 3)), np.empty((epochs.size, 3, 3))
    mountings = mountings_of(record.run, record.sensor, rig.mounting(), load_mountings(plan.store))
    for part, mounting in mountings.pieces(epochs):
        rotation, lever[part] = mounting.arrays()
        axes[part] = rotation @ SENSOR_FROM_OPENCV
    folder = folder_of(plan, taken)
    own_camera = Camera(record.run, record.sensor, record.key, folder, rig, interior, source.world)
    level = np.einsum("nji,njk->nik", world_from_ned(source.world, body[kept]), turned[kept])
    own = Exposures(
        (own_camera,), np.full(int(kept.sum()), number), epochs[kept],
        np.array([taken.files[i] for i in rows[kept].tolist()], dtype=object),
        body[kept], turned[kept], velocity[kept], rate[kept], level, lever[kept], axes[kept],
    )  # fmt: skip
    return own, notes


def _motion(
    plan: SurveyPlan, source: TrajectorySource, epochs_gps_ns: Int64
) -> tuple[Bool, Float64, Float64, Float64, Float64]:
    """Returns whether there is a pose at epochs (n,) in order, position, attitude, velocity and turning rate."""
    from scipy.spatial.transform import Rotation

    n = epochs_gps_ns.size
    found, body, turned = np.zeros(n, bool), np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    velocity, rate = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    pieces = epochs_gps_ns // _PIECE_NS
    for rows in np.split(np.arange(n), np.flatnonzero(np.diff(pieces)) + 1) if n else []:
        own = epochs_gps_ns[rows]
        span = (int(own[0]) - _BESIDE_NS, int(own[-1]) + _BESIDE_NS)
        trajectory = load_recorded(plan.store, source, [span], plan.ground.max_gap_s)
        here, before, after = (trajectory.poses(own + shift) for shift in (0, -_BESIDE_NS, _BESIDE_NS))
        # At the ends of a trajectory the motion to one side stands for both.
        early = np.where(before.found, -_BESIDE_NS, 0)
        late = np.where(after.found, _BESIDE_NS, 0)
        step_s = np.maximum(late - early, 1)[:, None] / NS_PER_S
        first_m = np.where(before.found[:, None], before.position_world_m, here.position_world_m)
        last_m = np.where(after.found[:, None], after.position_world_m, here.position_world_m)
        first = np.where(before.found[:, None, None], before.world_from_body, here.world_from_body)
        last = np.where(after.found[:, None, None], after.world_from_body, here.world_from_body)
        found[rows], body[rows], turned[rows] = here.found, here.position_world_m, here.world_from_body
        moving = here.found & (late > early)
        velocity[rows] = np.where(moving[:, None], (last_m - first_m) / step_s, 0.0)
        between = np.einsum("nji,njk->nik", first, last)
        between[~moving] = np.eye(3)
        rate[rows] = Rotation.from_matrix(between).as_rotvec() / step_s
    return found, body, turned, velocity, rate


def _joined(parts: Sequence[Exposures], cameras: Sequence[Camera]) -> Exposures:
    """Returns all pictures, in the order of the parts."""
    if not parts:
        nothing, none = np.zeros((0, 3)), np.zeros(0, np.int64)
        turns = np.zeros((0, 3, 3))
        file = np.zeros(0, dtype=object)
        return Exposures((), none, none, file, nothing, turns, nothing, nothing, turns, nothing, turns)
    columns = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Exposures) if f.name != "cameras"
    }
    return Exposures(tuple(cameras), **columns)
