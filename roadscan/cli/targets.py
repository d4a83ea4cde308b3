"""Control targets of a survey in its pictures: what was found of them, and how far it is from where poses say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.georeference.plan.plan import plan_without_readings
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.points import control_rows
from roadscan.pictures.settings import PictureTargetsConfig
from roadscan.pictures.targets.candidates import TargetPoint
from roadscan.pictures.targets.find import Sought, found_rows, seek
from roadscan.pictures.views import PictureRule
from roadscan.run.session import Session

_ANY_ANGLE_DEG: Final = -90.0  # accepts any angle between view and surface
_BORDER_PX: Final = 1  # least distance of a place from a picture's border (pixels)


@dataclass(frozen=True)
class Seen:
    """Targets that were looked for in a survey's pictures."""

    sought: tuple[Sought, ...]
    rows: pa.Table
    """Those found, of the table `picture_points`."""
    names: tuple[str, ...]
    """Of the pictures."""
    roles: dict[str, str]
    """Of the control points, by their names."""
    notes: tuple[str, ...]

    def by_point(self) -> list[tuple[str, ...]]:
        """Return a line for each control point."""
        lines: list[tuple[str, ...]] = []
        for name, role in sorted(self.roles.items()):
            own = [one for one in self.sought if one.aim.point.name == name]
            good = [one for one in own if one.found is not None]
            away = np.array([one.found.pixel - one.aim.pixel for one in good if one.found is not None]).reshape(-1, 2)
            sigma = [one.found.sigma_px for one in good if one.found is not None]
            told = ("", "", "", "")
            if good:
                du, dv = away.mean(axis=0)
                rms = float(np.sqrt((away**2).mean()))
                told = f"{du:+.2f}", f"{dv:+.2f}", f"{rms:.2f}", f"{float(np.median(sigma)):.3f}"
            lines.append((name, role, str(len(own)), str(len(good)), *told))
        return lines

    @property
    def misses(self) -> list[tuple[str, str, str]]:
        """Return picture, point and reason of what was not found."""
        return [(self.names[o.picture], o.aim.point.name, o.reason) for o in self.sought if o.found is None]


def seen_targets(survey_file: Path, cameras: Sequence[str]) -> Seen:
    """Return what the pictures of a survey show of its control targets.

    cameras : names in the rig; empty: all of them.

    Raises
    ------
    RoadscanError
        where pictures, poses or control points are not ingested.
    """
    session = Session.open(survey_file)
    plan = plan_without_readings(session.survey, session.store)
    settings = PictureTargetsConfig.of(session.survey)
    pictures = plan_pictures(plan, PictureRule(tuple(cameras), settings.farthest_m, _ANY_ANGLE_DEG, _BORDER_PX))
    control = control_rows(plan.store, plan.records)
    points = [
        TargetPoint(
            row["name"],
            (row["easting_m"], row["northing_m"], row["height_m"]),
            settings.of_point(row["name"], row["code"]),
        )
        for row in control
    ]
    sought = tuple(seek(pictures, points, settings))
    names = tuple(pictures.name(number) for number in range(len(pictures)))
    return Seen(sought, found_rows(pictures, sought), names, {r["name"]: r["role"] for r in control}, pictures.notes)
