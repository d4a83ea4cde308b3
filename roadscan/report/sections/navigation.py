"""Report section on computed trajectories, estimated clocks and calibrated mountings, with their pictures."""

from __future__ import annotations

from collections.abc import Iterator

from roadscan.calibrate.tasks.calibrate import PICTURE, mounting_lines
from roadscan.navigation.tasks.navigation_status import NavigationStatus, navigation_status, trajectory_findings
from roadscan.report.blocks import Block, Paragraph, Picture
from roadscan.report.section import Material, Section


class Navigation(Section):
    """Computed poses, clocks and mountings."""

    name = "navigation"
    title = "Trajectories, clocks and mountings"
    position = 200

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a line for each of them, doubts, and the stored pictures."""
        store = material.session.store
        found = navigation_status(material.session.survey, store, material.logs, material.records)
        for one in trajectory_findings(material.logs):
            yield Paragraph(one.line, is_warning=True)
        for line in (*found.lines(), *mounting_lines(store)):
            yield Paragraph(line)
        for path, caption in (_pictures(found) | {PICTURE: "Calibration of the mountings"}).items():
            if store.exists(path):
                yield Picture(material.picture(path), caption)


def _pictures(found: NavigationStatus) -> dict[str, str]:
    """Return captions by path: one picture may show several estimates."""
    shown = {one["picture"]: f"Trajectory of run '{one['run']}'" for one in found.trajectories if one["picture"]}
    return shown | {one["picture"]: f"Clock of {one['run']}/{one['sensor']}" for one in found.clocks if one["picture"]}
