"""Double lines: two lines side by side are one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import shapely

from roadscan.assets.kind import AssetObject

_APART_M: Final = (0.12, 0.55)
"""Distance between the middles of the two lines (m)."""
_EVEN_M: Final = 0.06  # Greatest variation of that distance (m).
_STEP_M: Final = 0.5  # Distance of the points that are compared (m).
_SHORTEST_M: Final = 2.0  # Shorter lines are not paired (m).
_TOGETHER: Final = 0.7  # Share of the shorter line that runs beside the longer.
_KINDS: Final = {
    ("solid", "solid"): "double_solid",
    ("dashed", "dashed"): "double_dashed",
    ("dashed", "solid"): "solid_dashed",
}


def paired(lines: Sequence[AssetObject]) -> list[AssetObject]:
    """Returns the lines, with two parallel ones made one; the longest find their partner first."""
    order = sorted(range(len(lines)), key=lambda k: (-lines[k].attributes["length_m"], lines[k].geometry.coords[0]))
    tree = shapely.STRtree([line.geometry for line in lines])
    taken: set[int] = set()
    out = []
    for k in order:
        if k in taken:
            continue
        taken.add(k)
        near = tree.query(lines[k].geometry, predicate="dwithin", distance=_APART_M[1])
        beside = [int(j) for j in sorted(near, key=order.index) if j not in taken and _beside(lines[k], lines[int(j)])]
        if not beside:
            out.append(lines[k])
            continue
        taken.add(beside[0])
        out.append(_double(lines[k], lines[beside[0]]))
    return out


def _beside(long: AssetObject, short: AssetObject) -> bool:
    """Returns True where the shorter line runs beside the longer one, at an even distance."""
    length = short.geometry.length
    if length < _SHORTEST_M or length < _TOGETHER * long.geometry.length or None in (_of(long), _of(short)):
        return False
    points = shapely.line_interpolate_point(short.geometry, np.arange(0.0, length, _STEP_M))
    apart = shapely.distance(points, long.geometry)
    middle = float(np.median(apart))
    return bool(_APART_M[0] <= middle <= _APART_M[1] and np.mean(np.abs(apart - middle) <= _EVEN_M) >= _TOGETHER)


def _of(line: AssetObject) -> str | None:
    kind = line.attributes["type"]
    return kind if kind in {"solid", "dashed"} else None


def _double(one: AssetObject, other: AssetObject) -> AssetObject:
    """Returns both as one line, midway between them."""
    kinds = tuple(sorted((str(_of(one)), str(_of(other)))))
    places = shapely.get_coordinates(one.geometry, include_z=True)
    nearest = shapely.line_interpolate_point(
        other.geometry, shapely.line_locate_point(other.geometry, shapely.points(places))
    )
    midway = (places + shapely.get_coordinates(nearest, include_z=True)) / 2
    a, b = one.attributes, other.attributes
    dashed = b if _of(other) == "dashed" else a
    attributes = {
        **a,
        "type": _KINDS[kinds[0], kinds[1]],
        "width_m": (a["width_m"] + b["width_m"]) / 2,
        "dash_m": dashed["dash_m"],
        "gap_m": dashed["gap_m"],
        "contrast": (a["contrast"] + b["contrast"]) / 2,
    }
    return replace(
        one,
        geometry=shapely.LineString(midway),
        sigma_horizontal_m=max(one.sigma_horizontal_m, other.sigma_horizontal_m),
        probability=max(one.probability, other.probability),
        returns=one.returns + other.returns,
        passes=max(one.passes, other.passes),
        first_epoch_gps_ns=min(one.first_epoch_gps_ns, other.first_epoch_gps_ns),
        last_epoch_gps_ns=max(one.last_epoch_gps_ns, other.last_epoch_gps_ns),
        attributes=attributes,
    )
