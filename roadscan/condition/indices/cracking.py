"""Cracking of a section: length by type and by severity, and how much of the wheel paths is cracked.

Severity goes by the mean width of a crack: low up to 6 mm, moderate up to 19 mm, high above (classes of the LTPP
distress identification manual, FHWA-HRT-13-092, as published). The wheel paths are strips of 0.75 m, cut each 0.5 m
along the lane; the share of the pieces that a crack touches is the cracked share. What lies beyond the road's edges,
where these are known, is no crack of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from roadscan.condition.index import ConditionIndex, Quantity, Value
from roadscan.condition.lane_data import LaneData

_TYPES: Final = ("longitudinal", "transverse", "diagonal", "alligator", "unknown")
_SEVERITIES: Final = {"low": 0.006, "moderate": 0.019, "high": np.inf}
"""Greatest mean width of each severity (m)."""
_STRIP_M: Final = 0.75  # Width of a wheel path.
_PIECE_M: Final = 0.5  # Length of a piece of a wheel path.
_PERCENT: Final = "cracked_wheel_path_percent"


class Cracking(ConditionIndex):
    """Cracks by section."""

    name: ClassVar[str] = "cracking"
    title: ClassVar[str] = "length of cracks by type and severity, cracked share of the wheel paths"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("crack_length_m", "m", "Length of the cracks in the lane"),
        *(Quantity(f"crack_{kind}_m", "m", f"Length of those of type {kind}") for kind in _TYPES),
        *(Quantity(f"crack_{one}_severity_m", "m", f"Length of those of {one} severity") for one in _SEVERITIES),
        Quantity(_PERCENT, "%", "Share of the wheel paths, in pieces of 0.5 m, that a crack touches"),
    )
    drawn: ClassVar[tuple[str, ...]] = ("crack_length_m",)
    needs_cracks: ClassVar[bool] = True

    def values(self, lane: LaneData) -> Iterator[Value]:
        """Return the values of sections."""
        for from_m, to_m in lane.sections_m:
            share, reason = lane.paths_share(from_m, to_m), ""
            if lane.cracks is None:
                share, reason = 0.0, "there is no table of cracks: let the survey make the product `cracks`"
            elif share < lane.config.least_share:
                reason = f"{100 * share:.0f} % of the wheel paths were measured"
            found = {} if reason else self._section(lane, from_m, to_m)
            for one in self.quantities:
                yield Value(one.name, "section", from_m, to_m, found.get(one.name, np.nan), np.nan, share, reason)

    def _section(self, lane: LaneData, from_m: float, to_m: float) -> dict[str, float]:
        found = {one.name: 0.0 for one in self.quantities}
        pieces = max(1, int(np.ceil((to_m - from_m) / _PIECE_M - 1e-6)))
        touched = np.zeros((2, pieces), bool)
        for crack in lane.cracks or ():
            inside = (crack.station_m >= from_m) & (crack.station_m < to_m)
            own = inside & (np.abs(crack.own_m) <= lane.width_m / 2)
            if lane.edges is not None:
                own &= lane.edges.inside(crack.station_m, crack.own_m)
            length = float(crack.length_m[own].sum())
            found["crack_length_m"] += length
            found[f"crack_{crack.kind if crack.kind in _TYPES else 'unknown'}_m"] += length
            severity = next(name for name, most in _SEVERITIES.items() if crack.width_m <= most)
            found[f"crack_{severity}_severity_m"] += length
            for row, side in enumerate((-1.0, 1.0)):
                on = own & (np.abs(crack.own_m - side * lane.config.wheel_paths_m) <= _STRIP_M / 2)
                touched[row, ((crack.station_m[on] - from_m) / _PIECE_M).astype(np.int64)] = True
        found[_PERCENT] = 100.0 * float(touched.mean())
        return found
