"""Stage `assets`: returns are turned into evidence, evidence into objects, objects into tables and files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from roadscan.assets.kind import AssetKind
from roadscan.assets.kinds.lane_line import LaneLine
from roadscan.assets.paint.components import ROUGHEST_M
from roadscan.core.errors import RoadscanError
from roadscan.core.extras import need
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.asset_schema import ASSET_FOLDER
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest

if TYPE_CHECKING:
    from roadscan.assets.tasks.objects import Cluster
    from roadscan.assets.tasks.picture_work import PicturePlan
    from roadscan.assets.tasks.plan import AssetPlan
    from roadscan.assets.tasks.work import AssetsWork

_MOST_ROUGH: Final = 0.5
"""Share of rough ground from which readings are suspect: verges and kerbs are rough, but not half of the ground."""

# The figure in its words is `ROUGHEST_M` in millimetres.
ROUGH_READINGS: Final = Witness(
    "rough_readings",
    "lidar",
    "Readings or poses scatter by more than the road's own roughness, so that nothing painted is found.",
    f"the scatter of the returns on the ground about their mean height, against {1e3 * ROUGHEST_M:.0f} mm",
    "paint is not sought where it is larger; where that is more than half of the ground, it is named",
    ("findings",),
)

CONSTANT_INTENSITY: Final = Witness(
    "constant_intensity",
    "lidar",
    "Logs of a lidar hold one number in place of intensities, or intensities are cut off at the end of their range.",
    "the intensities of the returns on the ground, in samples of the map",
    "the returns are used; paint is not found by their intensity, and the sensor is named",
    ("findings",),
)


class Assets(Stage):
    """The stage of objects on, beside and over the road; it runs where the survey file has a section `[assets]`."""

    name = "assets"
    title = "what stands on, beside and over the road: ground, kerbs, markings, signs, poles, by kind"
    after = ("condition",)
    section = "assets"
    units = "outputs"
    reads = (
        "scans", "returns", "cloud", "trajectory", "trajectory_accuracy", "clocks", "mountings", "mounting_corrections",
        "corrections", "footprints", "reference_lines", "images",
    )  # fmt: skip
    writes = (
        "intensity_samples", "intensity_gains", "scene_statistics", "asset_evidence", "asset_screens",
        "asset_ground", "asset_green", "asset_painted", "asset_grey_edges", "asset_visibility", "asset_objects",
        "classified_points", "bare_earth", "ground_sections", AssetKind,
    )  # fmt: skip

    def run(self, session: Session) -> None:
        """Compute what is missing or stale."""
        from roadscan.assets.tasks.work import plan_evidence

        work = plan_evidence(session)
        session.manifest.remove(work.gone)
        if work.plan is None:
            return
        if not work.plan.keys:
            session.note("assets: no lidar, no line scanner with a turning mirror and no cloud saw anything")
        if work.gains_due:
            self._calibrate(session, work, work.plan)
            work = plan_evidence(session)
        if work.plan is not None:
            self._search(session, work, work.plan)
            self._look_at_ground(session, work.plan)
            self._join(session, work.plan)
            self._write(session, work.plan, self._look(session, work.plan))

    def _calibrate(self, session: Session, work: AssetsWork, plan: AssetPlan) -> None:
        """Compute what all squares share: samples of the map, then gains of the intensity and statistics."""
        from roadscan.assets.tasks.gains import find_samples, sample_tasks, write_gains
        from roadscan.tiles.tasks.tiles import run_tasks

        manifest, due = session.manifest, work.samples
        failures = run_tasks(
            find_samples, sample_tasks(plan, due), len(due), lambda squares: sample_tasks(plan, due, squares),
            manifest, session.compute, session.bar("samples of the map"),
        )  # fmt: skip
        session.failed(self.name, failures)
        if not work.gains.due(manifest):
            manifest.add(write_gains(work.gains, manifest, plan, work.gains.key(manifest)))

    def _search(self, session: Session, work: AssetsWork, plan: AssetPlan) -> None:
        from roadscan.assets.tasks.evidence import evidence_tasks, find_evidence, singly
        from roadscan.assets.tasks.gains import current_gains
        from roadscan.tiles.tasks.tiles import run_tasks

        manifest = session.manifest
        due, gains = work.squares, current_gains(work.gains, session.manifest)
        tasks = evidence_tasks(plan, due, gains, session.compute.workers)
        failures = run_tasks(
            find_evidence, tasks, len(due), lambda squares: singly(plan, due, gains, squares), manifest,
            session.compute, session.bar("squares searched for assets"),
        )  # fmt: skip
        session.failed(self.name, failures)

    def _look_at_ground(self, session: Session, plan: AssetPlan) -> None:
        """Find green ground and paint in the pictures, where there are any."""
        from roadscan.assets.tasks.green import find_green, green_tasks, plan_green
        from roadscan.condition.tasks.tasks import run_units

        manifest = session.manifest
        green = plan_green(plan, manifest)
        manifest.remove(green.gone(manifest))
        tasks = green_tasks(plan, green, manifest, session.compute.workers)
        if tasks:
            bar = session.bar("squares whose ground is sought in pictures")
            session.failed(self.name, run_units(find_green, tasks, manifest, session.compute, bar))
        elsewhere = green.elsewhere(manifest)
        if elsewhere:
            session.note(
                f"assets: {len(elsewhere):,} pictures show the ground elsewhere than the lidar does and tell no green "
                f"ground and no paint; check the camera's clock and mounting: {'; '.join(elsewhere[:5])}"
            )

    def _join(self, session: Session, plan: AssetPlan) -> None:
        """Join pieces kind after kind, each after those that it uses."""
        from roadscan.assets.tasks.objects import join_objects, plan_joins
        from roadscan.condition.tasks.tasks import run_units

        manifest = session.manifest
        clusters: dict[str, list[Cluster]] = {}
        for wanted in plan.kinds:
            joins = plan_joins(session.store, plan.grid, wanted, manifest, clusters)
            manifest.remove(joins.gone)
            due = joins.due(manifest)
            if due:
                bar = session.bar(f"objects: {wanted.name}")
                failed = run_units(join_objects, due, manifest, session.compute, bar)
                session.failed(self.name, failed)

    def _look(self, session: Session, plan: AssetPlan) -> PicturePlan:
        """Search the pictures of objects, where there are any."""
        from roadscan.assets.tasks.picture_work import picture_tasks, plan_asset_pictures
        from roadscan.assets.tasks.pictures import find_pictures
        from roadscan.condition.tasks.tasks import run_units

        manifest = session.manifest
        pictures = plan_asset_pictures(plan, manifest)
        for note in pictures.notes:
            session.note(f"assets: {note}")
        due = pictures.due(manifest)
        if pictures.pictures is not None and due:
            tasks = picture_tasks(plan, pictures.pictures, due, manifest, session.compute.workers)
            bar = session.bar("squares whose assets are sought in pictures")
            session.failed(self.name, run_units(find_pictures, tasks, manifest, session.compute, bar))
        manifest.remove(pictures.gone(manifest))
        unreadable = pictures.unreadable(manifest)
        if unreadable:
            session.note(f"assets: {len(unreadable):,} pictures cannot be read: {'; '.join(unreadable[:5])}")
        return pictures

    def _write(self, session: Session, plan: AssetPlan, pictures: PicturePlan) -> None:
        from roadscan.assets.tasks.sections import SECTIONS, plan_sections, write_sections
        from roadscan.assets.tasks.tables import (
            TABLES,
            drives_key,
            load_drives,
            plan_files,
            plan_tables,
            write_file,
            write_table,
        )
        from roadscan.condition.tasks.lines import survey_roads

        manifest, context = session.manifest, plan.context
        roads, key = survey_roads(plan.survey, manifest)
        if plan.kinds and not roads.lines:
            session.note("assets: no run has a trajectory of 20 m or more, so assets have no road, station and offset")
        tables = plan_tables(plan.kinds, manifest, key + drives_key(plan), context, pictures)
        due = [one for one in tables if not manifest.is_current(TABLES, one.unit, one.key)]
        if due:
            drives = load_drives(plan)
            for table in due:
                manifest.add([write_table(table, roads, drives, session.store, context)])
        for file in plan_files(plan.kinds, manifest, plan.config, context):
            if not manifest.is_current(TABLES, file.unit, file.key):
                manifest.add([write_file(file, session.store, context)])
        sections = plan_sections(roads, plan.config.cross_sections, plan.grid, manifest, context)
        manifest.remove(manifest.beside({SECTIONS}, {unit for one in sections for unit in one.units}))
        for one in sections:
            if not all(manifest.is_current(SECTIONS, unit, one.key) for unit in one.units):
                manifest.add(write_sections(one, plan.grid, session.store, context))
        manifest.settle()

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Returns findings where most of the ground is too rough to show paint, or intensities do not tell it."""
        if not survey.has("assets"):
            return ()
        return (*_rough_readings(manifest), *_constant_intensities(manifest))

    def check(self, survey: Survey) -> list[RoadscanError]:
        """Check that kinds, their settings and sensors exist."""
        from roadscan.assets.tasks.plan import check_assets

        try:
            if survey.has("assets"):
                need("cv2", "the section [assets]")
            check_assets(survey)
        except RoadscanError as error:
            return [error]
        return []

    def state(self, session: Session) -> StageState:
        """Outputs of squares, objects and files that exist, and those that are due as far as is known by now."""
        if not session.survey.has("assets"):
            return StageState()
        from roadscan.assets.tasks.evidence import EVIDENCE, evidence_tasks, memory_of
        from roadscan.assets.tasks.gains import current_gains
        from roadscan.assets.tasks.green import plan_green
        from roadscan.assets.tasks.objects import OBJECTS
        from roadscan.assets.tasks.tables import TABLES
        from roadscan.assets.tasks.work import due_joins, plan_evidence

        work = plan_evidence(session)
        plan, manifest = work.plan, session.manifest
        if plan is None:
            return StageState()
        made = manifest.files()
        stale = work.evidence_due
        if not stale:
            stale = len(plan_green(plan, manifest).due(manifest)) + len(due_joins(plan, manifest))
            stale = stale or self._files_due(session, plan)
        current = sum(made.get(name, 0) for name in (EVIDENCE, OBJECTS, TABLES))
        tasks = evidence_tasks(plan, work.squares, current_gains(work.gains, manifest), session.compute.workers)
        state = StageState(current, stale)
        if work.squares:
            state.tasks, state.raw_bytes = len(tasks), sum(t.load.readings.raw_bytes for t in tasks)
            state.worker_memory_bytes = memory_of(plan, tasks)
        return state

    def _files_due(self, session: Session, plan: AssetPlan) -> int:
        from roadscan.assets.tasks.picture_work import plan_asset_pictures
        from roadscan.assets.tasks.sections import SECTIONS, plan_sections
        from roadscan.assets.tasks.tables import TABLES, drives_key, plan_files, plan_tables
        from roadscan.condition.tasks.lines import roads_key, survey_roads

        manifest, context = session.manifest, plan.context
        key = roads_key(plan.survey) + drives_key(plan)
        pictures = plan_asset_pictures(plan, manifest)
        tables = plan_tables(plan.kinds, manifest, key, context, pictures)
        due = len(pictures.due(manifest)) + sum(not manifest.is_current(TABLES, one.unit, one.key) for one in tables)
        files = plan_files(plan.kinds, manifest, plan.config, context)
        due += sum(not manifest.is_current(TABLES, one.unit, one.key) for one in files)
        if due or plan.config.cross_sections is None:
            return due
        roads, _ = survey_roads(plan.survey, manifest)
        sections = plan_sections(roads, plan.config.cross_sections, plan.grid, manifest, context)
        return sum(not manifest.is_current(SECTIONS, unit, one.key) for one in sections for unit in one.units)

    def folders(self) -> Sequence[str]:
        """Returns folders: evidence, objects, tables and files, classified points, bare earth."""
        from roadscan.assets.tasks.pictures import FOLDER as PICTURE_FOLDER

        return (
            "tables/intensity_samples", "tables/intensity_gains", "tables/scene_statistics", "tables/asset_evidence",
            "tables/asset_objects",
            "tables/asset_screens", "tables/asset_ground", "tables/asset_green", "tables/asset_painted",
            "tables/asset_grey_edges", "tables/asset_visibility",
            "tables/asset_pictures", ASSET_FOLDER, PICTURE_FOLDER,
            "products/classified_points", "products/ground_sections", "products/bare_earth",
        )  # fmt: skip


def _rough_readings(manifest: Manifest) -> Iterator[Finding]:
    from roadscan.assets.tasks.evidence import EVIDENCE

    records_of = manifest.of(EVIDENCE)
    found = [one.figures() for unit, one in records_of.items() if unit.startswith(f"{LaneLine.name}/")]
    dense, rough = (sum(one.get(name, 0) for one in found) for name in ("dense_cells", "rough_cells"))
    if rough > _MOST_ROUGH * dense:
        yield ROUGH_READINGS.finds(
            "assets",
            f"Paint was not sought on {rough / dense:.0%} of the ground that is seen densely enough: its returns "
            f"scatter by more than {1e3 * ROUGHEST_M:.0f} mm about their mean height, so lane lines and markings are "
            "missing there. The sensor's noise, poses of passes that disagree, or rough ground do that.",
        )


def _constant_intensities(manifest: Manifest) -> Iterator[Finding]:
    from roadscan.assets.tasks.gains import CONSTANT, STATISTICS

    for record in manifest.of(STATISTICS).values():
        for sensor, intensity in record.figures().get(CONSTANT, {}).items():
            yield CONSTANT_INTENSITY.finds(
                "assets",
                f"The intensity of all returns of {sensor} on the ground, in all runs, is {intensity:g}, so that no "
                "paint stands out: lane lines and markings are missing where no other sensor shows them, and signs "
                "where their intensity is the same. Either the driver writes no intensities, or they are cut off at "
                "the end of their range: check the driver, and the options of the log that name and scale them.",
            )
