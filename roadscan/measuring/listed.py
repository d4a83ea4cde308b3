"""All pictures of a survey's cameras: those with a pose, and the others with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from roadscan.core.errors import RoadscanError
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.rig import Sensor
from roadscan.georeference.plan.plan import SurveyPlan, trajectory_source
from roadscan.measuring.poses import PicturePoses, picture_poses
from roadscan.navigation.tasks.taken_pictures import TakenPictures
from roadscan.pictures.frames.chosen import camera_pictures
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.views import PictureRule

_ANYWHERE: Final = PictureRule((), 30.0, -90.0, 1)
"""Pictures of all cameras; its reach selects none here."""


@dataclass(frozen=True)
class Unplaced:
    """A picture without a pose."""

    run: str
    camera: str
    file: str
    log: str
    epoch_gps_ns: int
    size_px: tuple[int, int]
    """0 where it is not known."""
    reason: str


@dataclass(frozen=True, eq=False)
class ListedPictures:
    """The pictures of all cameras."""

    placed: tuple[PicturePoses, ...]
    """By camera, in the order of their names."""
    unplaced: tuple[Unplaced, ...]
    """In the order of camera, log and epoch."""


def listed_pictures(plan: SurveyPlan) -> ListedPictures:
    """Return all pictures of a survey's cameras; a camera whose pictures cannot be placed costs those alone."""
    placed: list[PicturePoses] = []
    unplaced: list[Unplaced] = []
    cameras = {name: one for name, one in sorted(plan.survey.rig.sensors.items()) if one.kind == "camera"}
    for name, camera in cameras.items():
        taken = [one for one in camera_pictures(plan, name) if one.files]
        if not taken:
            continue
        held, refused = set[tuple[str, str, int]](), ""
        try:
            pictures = plan_pictures(plan, replace(_ANYWHERE, cameras=(name,)))
        except RoadscanError as error:
            refused = error.args[0] if error.args else str(error)
        else:
            placed.append(picture_poses(plan, pictures))
            held = {
                (pictures.logs[log].key, file, epoch)
                for log, file, epoch in zip(
                    pictures.log.tolist(), pictures.files, pictures.epochs_gps_ns.tolist(), strict=True
                )
            }
        for one in taken:
            unplaced += _unplaced(plan, camera, one, held, refused)
    return ListedPictures(tuple(placed), tuple(unplaced))


def _unplaced(
    plan: SurveyPlan, camera: Sensor, taken: TakenPictures, held: set[tuple[str, str, int]], refused: str
) -> list[Unplaced]:
    """Return the pictures of a log that are not among those placed."""
    record, found = taken.record, []
    for number in np.argsort(taken.epochs_gps_ns, kind="stable").tolist():
        epoch, file = int(taken.epochs_gps_ns[number]), taken.files[number]
        if (record.key, file, epoch) in held:
            continue
        width, height = taken.size_px[number].tolist()
        reason = _reason(plan, camera, taken, number, refused)
        found.append(Unplaced(record.run, record.sensor, file, record.path, epoch, (width, height), reason))
    return found


def _reason(plan: SurveyPlan, camera: Sensor, taken: TakenPictures, number: int, refused: str) -> str:
    record, interior = taken.record, camera.interior
    if interior is None:
        return "the camera has no interior orientation in the rig file"
    width, height = taken.size_px[number].tolist()
    if width and (width, height) != (interior.width_px, interior.height_px):
        return (
            f"{width} × {height} pixels, and the interior orientation is for {interior.width_px} × {interior.height_px}"
        )
    try:
        files = trajectory_source(record.run, plan.records).files
    except RoadscanError as error:
        return str(error.args[0] if error.args else error)
    spans = [span for file in files for span in file.group_spans]
    epoch = int(taken.epochs_gps_ns[number])
    first, last = min(a for a, _ in spans), max(b for _, b in spans)
    if epoch < first:
        return f"taken {(first - epoch) / NS_PER_S:.1f} s before the trajectory begins"
    if epoch > last:
        return f"taken {(epoch - last) / NS_PER_S:.1f} s after the trajectory ends"
    return refused or "taken in a gap of the trajectory"
