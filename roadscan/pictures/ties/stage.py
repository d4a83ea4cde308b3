"""Stage `picture_ties`: what several pictures show is found and matched, for the adjustment of the poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Final

from roadscan.core.counted import listed
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import poses_plan_of
from roadscan.pictures.ties.own_vehicle import OWN_VEHICLE
from roadscan.pictures.ties.refining import REFINED, refine_picture, refine_tasks, tracks_key, write_tracks
from roadscan.pictures.ties.tracks import ALL, CHAINS, TRACKS, chains_key, write_chains
from roadscan.pictures.ties.work import (
    FEATURES,
    MATCHES,
    TieWork,
    find_features,
    find_own_vehicle,
    match_picture,
    match_tasks,
    own_vehicle_tasks,
    plan_ties,
)
from roadscan.run.engine.compute import run_bundles
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.schema import table_schema

_PICTURES: Final = 20
"""Pictures of a task: some ten seconds of work, which a killed worker loses at most."""
_NAMED: Final = 5  # Pictures that a finding names.

ODD_PICTURES: Final = Witness(
    "odd_pictures",
    input="pictures",
    fault="A picture cannot be read, has another size than its lens, is black, or is a copy of another one.",
    asks="its bytes, and the features that it shows",
    does="it gives no tie point; the other pictures go on without it",
    told=("findings",),
)


_MOST_BEHIND: Final = 0.3
"""Share of tie points that lie behind the camera: of right stamps and directions it is a few in a hundred, by the noise
of rays that are nearly parallel."""

WRONG_WAY: Final = Witness(
    "pictures_wrong_way",
    input="pictures",
    fault="The stamps of the pictures are of other pictures, or the camera looks another way than the rig file says.",
    asks="the poses, by which the rays of a tie point should meet before the camera",
    does="it is told; what does not fit takes no part in the adjustment",
    told=("findings",),
)


MASKS: Final = {
    "hidden": "features on the vehicle itself (own_vehicle_px of the rig file)",
    "own_vehicle": "features on what stands still in the picture",
    "against": "pairs of features that contradict the epipolar geometry (things that move, false matches)",
    "sky": "chains of the sky (above the horizon, without parallax or of its look)",
    "far": "chains too far away or with too little parallax",
}
"""Figures of the chains by their names, with what they count."""

_TABLES: Final = (FEATURES, OWN_VEHICLE, MATCHES, CHAINS, REFINED, TRACKS)
"""What the stage writes, each from the one before."""


class PictureTies(Stage):
    """The stage of tie points: a file of features and one of matches a picture, and the tracks of the survey."""

    name = "picture_ties"
    title = "tie points: what several pictures show, for the adjustment of the poses"
    after = ("navigate", "video_frames")
    section = "picture_ties"
    units = "pictures"
    reads = ("images", "trajectory", "trajectory_accuracy", "clocks", "mountings")
    writes = _TABLES

    def run(self, session: Session) -> None:
        """Find features and matches that are missing or stale, and join them to tracks."""
        manifest = session.manifest
        if not self.is_asked(session.survey):
            manifest.remove([r for name in _TABLES for r in manifest.of(name).values()])
            return
        work = plan_ties(poses_plan_of(session))
        for note in work.notes:
            session.note(f"{self.name}: {note}")
        due = [t for t in work.features if not manifest.is_current(FEATURES, t.unit, t.key)]
        failed = run_bundles(
            find_features, due, lambda _: 1, _PICTURES, manifest, session.compute, session.bar("features of pictures")
        )
        session.failed(self.name, [(str(task.path), reason) for task, reason in failed])
        seen = own_vehicle_tasks(work, manifest)
        unseen = run_bundles(
            find_own_vehicle, [t for t in seen if not manifest.is_current(OWN_VEHICLE, t.unit, t.key)],
            lambda t: len(t.records), _PICTURES, manifest, session.compute, session.bar("cameras: their own vehicle"),
        )  # fmt: skip
        session.failed(self.name, [(t.unit, reason) for t, reason in unseen])
        manifest.remove(manifest.beside([OWN_VEHICLE], {t.unit for t in seen}))
        tasks = match_tasks(work, manifest)
        left = [t for t in tasks if not manifest.is_current(MATCHES, t.unit, t.key)]
        unmatched = run_bundles(
            match_picture, left, lambda t: len(t.partners), _PICTURES, manifest, session.compute,
            session.bar("pictures matched"),
        )  # fmt: skip
        session.failed(self.name, [(t.unit, reason) for t, reason in unmatched])
        manifest.remove(manifest.beside([FEATURES], set(work.units)))
        manifest.remove(manifest.beside([MATCHES], {t.unit for t in tasks}))
        if not manifest.is_current(CHAINS, ALL, chains_key(work, tasks, manifest)):
            manifest.add([write_chains(work, tasks, manifest, session.store)])
        self._refine(session, work)
        for line in _lines(work, manifest):
            session.reporter.line(f"{self.name}: {line}")

    def _refine(self, session: Session, work: TieWork) -> None:
        """Match the patches of chains, and write the tracks."""
        manifest = session.manifest
        tasks = refine_tasks(work, manifest, session.store)
        left = [t for t in tasks if not manifest.is_current(REFINED, t.unit, t.key)]
        failed = run_bundles(
            refine_picture, left, lambda _: 1, _PICTURES, manifest, session.compute, session.bar("tie points refined")
        )
        session.failed(self.name, [(str(task.path), reason) for task, reason in failed])
        manifest.remove(manifest.beside([REFINED], {t.unit for t in tasks}))
        if not manifest.is_current(TRACKS, ALL, tracks_key(tasks, manifest)):
            manifest.add([write_tracks(work, tasks, manifest, session.store)])

    def check(self, survey: Survey) -> list[RoadscanError]:
        """Check that the rig has a camera whose directions are known."""
        if not self.is_asked(survey):
            return []
        cameras = {name: one for name, one in survey.rig.sensors.items() if one.kind == "camera"}
        try:
            need("cv2", "the section [picture_ties]")
            if not any(one.interior is not None for one in cameras.values()):
                raise ConfigError(
                    "the survey asks for tie points of pictures, and no camera of its rig has an interior orientation",
                    expected=f"[sensors.{next(iter(cameras), 'NAME')}.interior] in the rig file",
                    change="find it from chessboard pictures: `roadscan camera interior`, or leave out [picture_ties]",
                )
        except RoadscanError as error:
            return [error]
        return []

    def state(self, session: Session) -> StageState:
        """Pictures whose features are current, and those that are due."""
        if not self.is_asked(session.survey):
            return StageState()
        work, manifest = plan_ties(poses_plan_of(session)), session.manifest
        state = StageState.of(manifest, [(FEATURES, t.unit, t.key) for t in work.features])
        seen = own_vehicle_tasks(work, manifest)
        state.join(StageState.of(manifest, [(OWN_VEHICLE, t.unit, t.key) for t in seen]))
        tasks = match_tasks(work, manifest)
        state.join(StageState.of(manifest, [(MATCHES, t.unit, t.key) for t in tasks]))
        chains = chains_key(work, tasks, manifest)
        state.join(StageState.of(manifest, [(CHAINS, ALL, chains)]))
        # Chains that are due name pictures that may be gone.
        tied = refine_tasks(work, manifest, session.store) if manifest.is_current(CHAINS, ALL, chains) else []
        state.join(StageState.of(manifest, [(REFINED, t.unit, t.key) for t in tied]))
        state.join(StageState.of(manifest, [(TRACKS, ALL, tracks_key(tied, manifest))]))
        return state

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Returns a finding on pictures that give no tie points."""
        record = manifest.get(TRACKS, ALL)
        own = {} if record is None else json.loads(record.detail)
        return (*_of_odd(own.get("odd", [])), *_of_behind(own.get("behind", 0), own.get("found", 0)))

    def folders(self) -> Sequence[str]:
        """Returns the folders of features, matches and tracks."""
        return [str(table_schema(name).location) for name in _TABLES]


def _of_odd(odd: list[tuple[str, str]]) -> list[Finding]:
    """Returns a finding on pictures that give no tie points."""
    if not odd:
        return []
    named = listed([f"{name}: {why}" for name, why in odd], _NAMED, "; ")
    said = f"{len(odd):,} pictures give no tie point: {named}"
    return [ODD_PICTURES.finds("pictures", said, left_out=len(odd))]


def _of_behind(behind: int, found: int) -> list[Finding]:
    """Returns a finding where many tie points lie behind the cameras that saw them."""
    if behind <= _MOST_BEHIND * found:
        return []
    said = (
        f"{behind:,} of {found:,} tie points lie behind the camera by the poses: the stamps of the pictures are of "
        "others or in another order, or the camera looks another way than the rig file says"
    )
    return [WRONG_WAY.finds("pictures", said)]


def _lines(work: TieWork, manifest: Manifest) -> list[str]:
    """Returns what was found, in words."""
    record: OutputRecord | None = manifest.get(TRACKS, ALL)
    if record is None:
        return []
    own = json.loads(record.detail)
    return [
        f"{len(work.units):,} pictures, {len(work.pairs):,} pairs compared: {own['found']:,} tie points, of which "
        f"{own['tracks']:,} are kept (long ones first, spread over the pictures); least-squares matching finds "
        f"{own['matched']:,} of {own['compared']:,} of their places",
        "left out at tie points: " + "; ".join(f"{own[word]:,} {what}" for word, what in MASKS.items() if word in own),
    ]
