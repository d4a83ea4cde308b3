"""Stage `video_frames`: key frames of videos become files, as pictures are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from roadscan.core.counted import listed
from roadscan.core.errors import ConfigError
from roadscan.core.extras import is_installed
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import (
    NothingToPlaceError,
    SurveyPlan,
    plan_without_readings,
    poses_plan_of,
)
from roadscan.navigation.tasks.navigate import records_of
from roadscan.navigation.tasks.recorded_pictures import TakenPictures
from roadscan.pictures.exposures import FOLDER, FRAMES, FrameTask, camera_pictures, write_frame
from roadscan.run.engine.compute import run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest

_FRAMES: Final = 100
"""Frames of a task: a worker reads a video from its first one on."""
_NAMED: Final = 5  # Frames that a finding names.
_OFF: Final = 0.26
"""Share of the time between two frames by which one may be beside its place: the reader of videos allows a quarter."""
_LEAST_OFF_S: Final = 5e-4  # Containers count milliseconds at the coarsest (s).

DAMAGED_FRAMES: Final = Witness(
    "damaged_frames",
    input="pictures",
    fault="A frame of a video cannot be decoded.",
    asks="the decoder",
    does="the frame gives no picture; the others go on",
    told=("findings",),
)


class VideoFrames(Stage):
    """A file a key frame."""

    name = "video_frames"
    title = "key frames of videos, as pictures"
    after = ("navigate",)
    section = "video_frames"
    units = "frames"
    reads = ("images", "trajectory", "clocks")
    writes = (FRAMES,)

    def is_asked(self, survey: Survey) -> bool:
        """Returns True where the rig has a camera whose directions are known, and the section is not off."""
        cameras = [one for one in survey.rig.sensors.values() if one.kind == "camera" and one.interior is not None]
        return bool(cameras) and (super().is_asked(survey) or not survey.has(self.section))

    def why_not_asked(self, survey: Survey) -> str:
        """Returns the words of `roadscan plan`."""
        off = survey.has(self.section)
        return super().why_not_asked(survey) if off else "the rig has no camera with an interior orientation"

    def run(self, session: Session) -> None:
        """Decode the frames that are missing or stale."""
        manifest, tasks = session.manifest, self._tasks(session)
        manifest.remove(manifest.beside([FRAMES], {task.unit for task in tasks}))
        due = [task for task in tasks if not manifest.is_current(FRAMES, task.unit, task.key)]
        if due and not is_installed("cv2"):
            session.note('frames of videos need the package opencv: pip install "roadscan[opencv]"')
            return
        bar = session.bar("key frames of videos")
        failed = run_bundles(write_frame, due, lambda _: 1, _FRAMES, manifest, session.compute, bar)
        session.failed(self.name, [(task.unit, reason) for task, reason in failed])
        if tasks:
            session.reporter.line(f"{self.name}: {len(tasks):,} key frames of videos")

    def state(self, session: Session) -> StageState:
        """Returns frames that are there, and those that are due."""
        return StageState.of(session.manifest, [(FRAMES, task.unit, task.key) for task in self._tasks(session)])

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Returns a finding on frames that cannot be decoded."""
        bad = sorted(record.unit for record in manifest.of(FRAMES).values() if not record.path)
        if not bad:
            return ()
        named = listed([Path(unit).name for unit in bad], _NAMED)
        text = f"{len(bad):,} key frames of videos cannot be decoded: {named}"
        return (DAMAGED_FRAMES.finds("pictures", text, left_out=len(bad)),)

    def folders(self) -> Sequence[str]:
        """Returns the folder of the frames."""
        return (FOLDER,)

    def _tasks(self, session: Session) -> list[FrameTask]:
        """Returns a task for each key frame, video by video in order of time."""
        if not self.is_asked(session.survey):
            return []
        if not any(record.attributes.get("kind") == "video" for record in records_of(session)):
            return []
        try:
            plan = poses_plan_of(session)
        except NothingToPlaceError:
            plan = plan_without_readings(session.survey, session.store)
        cameras = [n for n, s in sorted(plan.survey.rig.sensors.items()) if s.kind == "camera" and s.interior]
        videos = [one for name in cameras for one in camera_pictures(plan, name) if one.is_video and one.files]
        if videos and not plan.store.is_folder:
            raise no_folder_of_frames()
        return [task for one in videos for task in _of_video(plan, one)]


def no_folder_of_frames() -> ConfigError:
    """Returns the error of a survey whose videos give key frames and whose store is no folder."""
    return ConfigError(
        "frames of videos are read from files, and the store is not a folder",
        expected="a store on a disk",
        change="set [video_frames] on = false, or move the store",
    )


def _of_video(plan: SurveyPlan, taken: TakenPictures) -> list[FrameTask]:
    """Returns a task for each key frame of a video."""
    record, code = taken.record, code_digest("roadscan.pictures.exposures:write_frame")
    path = plan.survey.resolve(Path(record.path))
    off_s = max(_OFF / float(record.attributes["fps"]), _LEAST_OFF_S)
    tasks = []
    for file, since_ns in zip(taken.files, taken.since_first_ns.tolist(), strict=True):
        unit = f"{record.key}/{file}"
        tasks.append(FrameTask(plan.store, path, since_ns / NS_PER_S, off_s, unit, key_of(code, unit, since_ns, off_s)))
    return tasks
