"""Stage `strips`: strips of road as each sensor of each run saw them are compared."""

from __future__ import annotations

from collections.abc import Sequence

from roadscan.core.survey import Survey
from roadscan.core.witness import Finding
from roadscan.run.session import Session
from roadscan.run.stage import Stage, StageState
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest
from roadscan.strips.findings import strip_findings
from roadscan.strips.work import PRODUCT, compare_strips, strip_tasks


class Strips(Stage):
    """The stage that makes no product: its findings name suspect sensors."""

    name = "strips"
    title = "what sensors saw of the same strips of road, held against one another"
    after = ("footprints",)
    units = "strips"
    reads = ("scans", "returns", "cloud", "trajectory", "trajectory_accuracy", "clocks", "mountings", "footprints")

    def run(self, session: Session) -> None:
        """Compare the strips that have not been compared yet."""
        session.failed(self.name, compare_strips(session, session.manifest))

    def state(self, session: Session) -> StageState:
        """Stretches that are compared, and those that are due."""
        tasks = strip_tasks(session, session.manifest)
        return StageState.of(session.manifest, [(PRODUCT, one.unit, one.key) for one in tasks])

    def findings(self, survey: Survey, records: Sequence[LogRecord], manifest: Manifest) -> Sequence[Finding]:
        """Returns findings on sensors that the others contradict, and on those that see no road."""
        return strip_findings(records, manifest)
