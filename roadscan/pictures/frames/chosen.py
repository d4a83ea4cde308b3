"""Pictures of a camera as all of `pictures` takes them: files of their own, and of videos the key frames."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import RoadscanError
from roadscan.core.gpstime import NS_PER_S
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.navigation.tasks.taken_pictures import TakenPictures, taken_pictures
from roadscan.navigation.tasks.trajectories import load_recorded
from roadscan.pictures.settings import VideoFramesConfig

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
