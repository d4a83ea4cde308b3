"""Mean profile depth of the texture: cells are too coarse to show it, and the section table says so.

ISO 13473-1 takes heights at most 1 mm apart. `roadscan mpd` computes it from a texture profile.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData


class Texture(ConditionIndex):
    """Why there is no mean profile depth."""

    name: ClassVar[str] = "texture"
    title: ClassVar[str] = "mean profile depth of the texture, where cells show it"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("mpd_mean_mm", "mm", "Mean profile depth"),)

    def values(self, lane: LaneData) -> Iterator[Value]:
        """A reason for each section."""
        spacing = 1e3 * max(lane.cell_m, lane.config.profile_spacing_m)
        reason = f"heights of the wheel paths are {spacing:g} mm apart; texture takes 1 mm or less"
        for from_m, to_m in lane.sections_m:
            yield Value("mpd_mean_mm", "section", from_m, to_m, np.nan, np.nan, 0.0, reason)
