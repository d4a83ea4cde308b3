"""Surveyed lines in the adjustment: rows of points that bind across the line, and in height where it was surveyed."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import shapely

from roadscan.adjust.control.control import ControlPoint, Sighting
from roadscan.adjust.control.control_faults import WrongPoint
from roadscan.adjust.settings import AdjustConfig, LineUse
from roadscan.adjust.targets.shapes import SurveyedLine
from roadscan.compute.ways import way_along
from roadscan.core.witness import Finding, Witness
from roadscan.georeference.plan.plan import SurveyPlan
from roadscan.store.readings.row_groups import read_groups

TABLE: Final = "control_lines"
CONTROL_LINE: Final = Witness(
    "control_line",
    input="control lines",
    fault="A surveyed line lies elsewhere than surveyed, or was painted or built anew since.",
    asks="poses, ties, control points and all other lines: the normalised leave-one-out residual of each point of the "
    "line against the quantile of adjust.control.false_alarm; the intensities and heights of each pass that saw it",
    does="points of the line that are contradicted do not count; what is not found does not count either",
    told=("findings",),
)
_LEAST: Final = 3
"""A line of at least this many points that is found at none of them, though passes saw the road there, is reported."""


def line_points(plan: SurveyPlan, first: int) -> list[ControlPoint]:
    """Returns points along all surveyed lines, each `adjust.lines.each_m`; first : number of the first of them."""
    settings, found = AdjustConfig.of(plan.survey).lines, list[ControlPoint]()
    for record in plan.records:
        for file in record.tables.get(TABLE, ()):
            for row in read_groups(plan.store, file.path, range(len(file.group_rows))).to_pylist():
                found += _of_line(row, settings, first + len(found))
    return found


def _of_line(row: Mapping[str, Any], settings: LineUse, first: int) -> Iterator[ControlPoint]:
    heights = row["height_m"] or [math.nan] * len(row["easting_m"])
    way = shapely.LineString(np.stack([row["easting_m"], row["northing_m"]], axis=-1))
    vertices = np.array(way.coords)
    station = way_along(vertices)
    count = max(1, round(way.length / settings.each_m))
    across, upright = row["sigma_horizontal_m"], row["sigma_height_m"]
    for k in range(count):
        at = (k + 0.5) * way.length / count
        before = min(int(np.searchsorted(station, at, side="right")) - 1, len(station) - 2)
        east, north = vertices[before + 1] - vertices[before]
        place = way.interpolate(at)
        shape = SurveyedLine(row["kind"], row["name"], float(math.atan2(east, north)))
        yield ControlPoint(
            first + k, f"{row['name']} at {at:.1f} m", row["role"], row["kind"], place.x, place.y,
            float(np.interp(at, station, heights)), across or settings.sigma_across_m,
            upright or settings.sigma_height_m, shape,
        )  # fmt: skip


def lines_line(sightings: Sequence[Sighting]) -> str:
    """Returns how many points of lines were found; "" without lines."""
    own = [one for one in sightings if one.point.is_of_line]
    found = {one.point.number for one in own if one.is_placed}
    lines = {one.point.shape.line for one in own if isinstance(one.point.shape, SurveyedLine)}
    seen = {one.point.number for one in own}
    return (
        f"{len(lines)} surveyed lines: found at {len(found)} of {len(seen)} points that passes came by" if own else ""
    )


def line_findings(wrong: Sequence[WrongPoint], sightings: Sequence[Sighting]) -> list[Finding]:
    """Returns findings on lines that are contradicted, and on lines that are found nowhere; wrong : points of lines."""
    points, places = defaultdict[str, set[str]](set), dict[str, str]()
    found = set[str]()
    for one in sightings:
        if isinstance(one.point.shape, SurveyedLine) and one.status != "unseen":
            points[one.point.shape.line].add(one.point.name)
            places[one.point.name] = one.point.shape.line
            found |= {one.point.shape.line} if one.is_placed else set()
    findings = list[Finding]()
    by_line = defaultdict[str, list[WrongPoint]](list)
    for bad in wrong:
        by_line[places[bad.name]].append(bad)
    for line, own in sorted(by_line.items()):
        names = {name for one in own for name in (one.name, *one.alternatives) if places.get(name) == line}
        away = [(one.horizontal_m, "across") for one in own if np.isfinite(one.horizontal_m)]
        away += [(abs(one.height_m), "in height") for one in own if np.isfinite(one.height_m)]
        size, way = max(away)
        worst = max(own, key=lambda one: np.nan_to_num(one.sigmas))
        text = (
            f"all other evidence contradicts {len(names)} of its {len(points[line])} points, by up to "
            f"{1e3 * size:.1f} mm {way} ({worst.sigmas:.1f} σ, where {worst.limit:.1f} σ are the limit): not used"
        )
        findings.append(CONTROL_LINE.finds(f"line '{line}'", text, left_out=len(names)))
    for line, names in sorted(points.items()):
        if line not in found and len(names) >= _LEAST:
            text = f"it is found at none of its {len(names)} points that passes saw; it does not count"
            findings.append(CONTROL_LINE.finds(f"line '{line}'", text, left_out=len(names)))
    return findings
