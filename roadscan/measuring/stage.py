"""Stage `pictures`: the layer of all pictures with their places, orientations, uncertainties and footprints."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from typing import Final

from roadscan.core.extras import is_installed
from roadscan.core.survey import Survey
from roadscan.measuring.layer import GEOPACKAGE, PRODUCT, PictureRows, write_picture_package, write_rows
from roadscan.measuring.settings import PicturesConfig
from roadscan.measuring.work import all_pictures, row_tasks
from roadscan.run.engine.compute import run_bundles
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.manifest import Manifest
from roadscan.store.schema import table_schema

_WORK: Final = 4000
"""Pictures that one task writes at most."""


class PictureLayer(Stage):
    """A GeoParquet file for each log of pictures, and a GeoPackage of all."""

    name = "pictures"
    title = "pictures with their places: position, orientation, σ and footprint of each"
    after = ("tiles",)
    section = "pictures"
    units = "files"
    reads = (
        "images", "trajectory", "trajectory_accuracy", "clocks", "mountings", "corrections", "mounting_corrections",
        "camera_corrections", "camera_covariances", "cells", "overviews",
    )  # fmt: skip
    writes = (PRODUCT,)

    def is_asked(self, survey: Survey) -> bool:
        """Return True where the rig has a camera and the section is not off."""
        return _has_camera(survey) and PicturesConfig.of(survey).on

    def why_not_asked(self, survey: Survey) -> str:
        """Return the words of `roadscan plan`."""
        return super().why_not_asked(survey) if _has_camera(survey) else "the rig has no camera"

    def run(self, session: Session) -> None:
        """Write the files that are missing or stale."""
        manifest = session.manifest
        if self.is_asked(session.survey) and not is_installed("cv2"):
            session.note('no layer of pictures without the package opencv: pip install "roadscan[opencv]"')
            return
        tasks = row_tasks(session) if self.is_asked(session.survey) else []
        manifest.remove(manifest.beside({PRODUCT}, {*(t.unit for t in tasks), *((GEOPACKAGE,) if tasks else ())}))
        if not tasks:
            return
        due = [t for t in tasks if not manifest.is_current(PRODUCT, t.unit, t.key)]
        failed = run_bundles(write_rows, due, _pictures, _WORK, manifest, session.compute, session.bar(self.name))
        session.failed(self.name, [(task.unit, reason) for task, reason in failed])
        for reason, count in sorted(Counter(one.reason for one in all_pictures(session).unplaced).items()):
            session.note(f"pictures: {count:,} without a pose: {reason}")
        without = Counter[str]()
        for record in manifest.of(PRODUCT).values():
            without.update(json.loads(record.detail or "{}").get("without_footprint", {}))
        for reason, count in sorted(without.items()):
            session.note(f"pictures: {count:,} without a footprint: {reason}")
        key = self._package_key(manifest, tasks)
        if not failed and not manifest.is_current(PRODUCT, GEOPACKAGE, key):
            held = manifest.of(PRODUCT)
            records = [held[t.unit] for t in tasks]
            manifest.add([write_picture_package(session.store, tasks[0].context, records, key)])

    def state(self, session: Session) -> StageState:
        """Files that are missing or stale."""
        if not self.is_asked(session.survey) or not is_installed("cv2"):
            return StageState()
        tasks, manifest = row_tasks(session), session.manifest
        units = [(PRODUCT, t.unit, t.key) for t in tasks]
        if tasks:
            units.append((PRODUCT, GEOPACKAGE, self._package_key(manifest, tasks)))
        return StageState.of(manifest, units)

    def folders(self) -> Sequence[str]:
        """A folder of files."""
        return (str(table_schema(PRODUCT).location),)

    def _package_key(self, manifest: Manifest, tasks: Sequence[PictureRows]) -> str:
        held = manifest.of(PRODUCT)
        digests = [(t.unit, held[t.unit].digest if t.unit in held else "") for t in tasks]
        return key_of(code_digest("roadscan.measuring.layer:write_picture_package"), digests, tasks[0].context.map)


def _has_camera(survey: Survey) -> bool:
    return any(sensor.kind == "camera" for sensor in survey.rig.sensors.values())


def _pictures(task: PictureRows) -> float:
    return float(len(task.unplaced) + (0 if task.poses is None else len(task.poses)))
