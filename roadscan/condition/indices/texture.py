"""Mean profile depth and root mean square of the texture in the wheel paths, as cells show them.

ISO 13473-1 takes heights at most 1 mm apart; `roadscan mpd` computes the mean profile depth from such a profile. Cells
of 10 mm and less, with several readings each, show it nearly
(:func:`roadscan.condition.lane_data.texture_squares` says how). Coarser cells show the root mean square of the
texture alone, by the scatter of the readings within them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData

_HALF_PATH_M: Final = 0.25
"""Half of the width of a wheel path (m)."""
_SIGMA_RMS: Final = 0.05
"""Relative σ of a root mean square: a rut of 31 mm in cells of 50 mm takes 10 % of it, one of 12 mm 2 %."""
_SIGMA_MODEL: Final = 0.1
"""Relative σ of a mean profile depth from cells, due to the different shapes of textures."""


class Texture(ConditionIndex):
    """Texture of the wheel paths."""

    name: ClassVar[str] = "texture"
    title: ClassVar[str] = "mean profile depth and RMS texture of the wheel paths, as cells show them"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("mpd_mean_mm", "mm", "Mean profile depth of the wheel paths, from cells of 10 mm or less"),
        Quantity("texture_rms_mean_mm", "mm", "Root mean square texture of the wheel paths, waves up to 50 mm"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("mpd_mean_mm", "texture_rms_mean_mm")

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        away = np.abs(np.abs(lane.texture.offset_m) - lane.config.wheel_paths_m)
        paths = away <= _HALF_PATH_M
        coarse = f"cells have {1e3 * lane.cell_m:g} mm; a mean profile depth takes 10 mm or less"
        for from_m, to_m in lane.sections_m:
            held = lane.texture.between(from_m, to_m)
            for name, values, model, instead in (
                ("mpd_mean_mm", held.mpd_mm[:, paths], _SIGMA_MODEL, coarse),
                ("texture_rms_mean_mm", held.texture_mm[:, paths], _SIGMA_RMS, ""),
            ):
                value, sigma, share, reason = _mean(values, model, lane.config.least_share)
                if lane.config.heights == "surface":
                    value, sigma, reason = math.nan, math.nan, "the reconstructed surface has no texture"
                elif reason and not np.isfinite(values).any():
                    reason = instead or reason
                yield Value(name, "section", from_m, to_m, value, sigma, share, reason)


def _mean(values: npt.NDArray[np.float64], model: float, least_share: float) -> tuple[float, float, float, str]:
    """Mean of the squares, its standard deviation, the known share of them, and the reason if there is none."""
    known = values[np.isfinite(values)]
    share = known.size / values.size if values.size else 0.0
    if share < least_share or not known.size:
        return math.nan, math.nan, share, f"the texture of {100 * share:.0f} % of the wheel paths was measured"
    mean = float(known.mean())
    return mean, math.hypot(float(known.std()) / math.sqrt(known.size), model * mean), share, ""
