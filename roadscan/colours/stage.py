"""Stage `colours`: pictures give their colours to the points and to the road."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from roadscan.colours.settings import ColoursConfig
from roadscan.colours.tasks.depths import GAINS, write_depths
from roadscan.colours.tasks.orthophoto import ORTHOPHOTO, make_photo
from roadscan.colours.tasks.plan import DEPTHS, check_cameras
from roadscan.colours.tasks.points import POINTS, colour_points
from roadscan.colours.tasks.work import MADE, ColourWork, make_gains, make_mosaic, plan_work
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import run_bundles
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.tiles.tasks.tiles import run_tasks

_NAMED: Final = 5  # Unreadable pictures that are named.
_BUNDLE: Final = 20.0  # Pictures whose depth images one task makes, about.


class Colours(Stage):
    """The stage of colours; it runs where the survey file has a section `[colours]`."""

    name = "colours"
    title = "colours of the cameras' pictures for points and the road: coloured clouds, orthophoto"
    after = ("assets",)
    section = "colours"
    units = "outputs"
    reads = ("cells", "scans", "returns", "cloud", "trajectory", "corrections", "footprints", "images")
    writes = (DEPTHS, GAINS, POINTS, ORTHOPHOTO)

    def run(self, session: Session) -> None:
        """Make what is missing or stale: what pictures show, how bright they are, coloured points."""
        work = plan_work(session)
        manifest = session.manifest
        manifest.remove(work.gone)
        if work.plan is None:
            return
        for note in work.plan.pictures.notes:
            session.note(f"colours: {note}")
        failed = run_bundles(
            write_depths, work.depths_due, lambda t: len(t.pictures), _BUNDLE, manifest, session.compute,
            session.bar("what pictures show"),
        )  # fmt: skip
        session.failed(self.name, [(task.unit, reason) for task, reason in failed])
        make_gains(session, work.plan)
        work = plan_work(session)
        self._points(session, work)
        self._photos(session, work)
        if work.plan is not None:
            make_mosaic(session, work.plan)
        self._notes(session, work)

    def _points(self, session: Session, work: ColourWork) -> None:
        due, points = work.points_due, work.points
        if points is None or not due:
            return
        failures = run_tasks(
            colour_points, points.tasks(due), len(due), points.singly, session.manifest, session.compute,
            session.bar("tiles whose points get colours"),
        )  # fmt: skip
        session.failed(self.name, failures)

    def _photos(self, session: Session, work: ColourWork) -> None:
        due, photos = work.photos_due, work.photos
        if photos is None or not due:
            return
        tasks = [photos.task(tile) for tile in due]
        bar = session.bar("tiles of the orthophoto")
        failures = run_tasks(make_photo, tasks, len(due), lambda tiles: [photos.task(t) for t in tiles],
                             session.manifest, session.compute, bar)  # fmt: skip
        session.failed(self.name, failures)

    def _notes(self, session: Session, work: ColourWork) -> None:
        figures = [one.figures() for one in session.manifest.of(POINTS).values()]
        points, coloured = (sum(f[name] for f in figures) for name in ("points", "coloured"))
        if points > coloured:
            session.note(f"colours: {points - coloured:,} of {points:,} points are in no picture, and have no colour")
        bad = [] if work.plan is None else work.unreadable
        more = f"; and {len(bad) - _NAMED} more" if len(bad) > _NAMED else ""
        if bad:
            session.note(f"colours: {len(bad):,} pictures give no colour: {'; '.join(bad[:_NAMED])}{more}")

    def check(self, survey: Survey) -> list[RoadscanError]:
        """Check that there is a camera whose pictures can give colours."""
        config = ColoursConfig.stated(survey)
        try:
            if config is not None:
                need("cv2", "the section [colours]")
                check_cameras(survey, config)
        except RoadscanError as error:
            return [error]
        return []

    def state(self, session: Session) -> StageState:
        """Outputs that exist, and those that are due as far as is known by now."""
        work = plan_work(session)
        if work.plan is None:
            return StageState()
        made = session.manifest.files()
        due = len(work.depths_due) + work.gains_due + len(work.points_due) + len(work.photos_due)
        why = Counter({"missing or out of date": due} if due else {})
        return StageState(max(sum(made.get(name, 0) for name in MADE) - due, 0), due, why=why)

    def folders(self) -> Sequence[str]:
        """Returns folders: what pictures show, their gains, coloured points."""
        return ("tables/picture_depths", "tables/picture_gains", "products/coloured_points", "products/orthophoto")
