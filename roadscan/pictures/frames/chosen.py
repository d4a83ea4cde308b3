"""Pictures of a camera as all of `pictures` takes them: files of their own, and of videos the key frames."""

from __future__ import annotations

import atexit
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64, UInt8
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import cv2
from roadscan.core.gpstime import NS_PER_S
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.navigation.tasks.recorded_pictures import TakenPictures, taken_pictures
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.pictures.settings import VideoFramesConfig
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
