"""Greatest deviation under the middle of a rolling straightedge in the wheel paths.

Formula and sources: :mod:`roadscan.condition.profiles.straightedge`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData
from roadscan.condition.of_sections.wheel_paths import WheelPath, greatest_of, spread_of, wheel_paths
from roadscan.condition.profiles.straightedge import LENGTHS_M, straightedge_mm

_BEAMS: Final = {"straightedge_3m_max_mm": LENGTHS_M["3 m"], "straightedge_16ft_max_mm": LENGTHS_M["16 ft"]}


class Straightedge(ConditionIndex):
    """Rolling straightedges of 3 m and 16 ft."""

    name: ClassVar[str] = "straightedge"
    title: ClassVar[str] = "greatest deviation under rolling straightedges of 3 m and 16 ft"
    quantities: ClassVar[tuple[Quantity, ...]] = tuple(
        Quantity(name, "mm", f"Greatest deviation, without sign, under a straightedge of {length:g} m that rolls along "
                 "either wheel path")
        for name, length in _BEAMS.items()
    )  # fmt: skip
    lead_m: ClassVar[float] = 10.0

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            paths = list(wheel_paths(lane, from_m, to_m).values())
            share, reason = min(p.share for p in paths), next((p.reason for p in paths if p.reason), "")
            for name, length in _BEAMS.items():
                value, sigma = (np.nan, np.nan) if reason else max(_greatest(path, length) for path in paths)
                said = reason or ("" if np.isfinite(value) else "no place of it is measured over the whole beam")
                yield Value(name, "section", from_m, to_m, value, sigma, share, said)


def _greatest(path: WheelPath, length_m: float) -> tuple[float, float]:
    """Return the greatest deviation in the section (mm), and its standard deviation."""
    away = [np.abs(straightedge_mm(path.profile.distance_m, height, length_m))[path.inside]
            for height in path.with_noise()]  # fmt: skip
    most = greatest_of(np.array(away))
    return float(most[0]), spread_of(most)
