"""Defines the interface of an index of condition, and the registry that finds indices.

An index is one file of `roadscan/condition/indices/` (or an entry point of the group ``roadscan.condition_indices``)
with one subclass of :class:`ConditionIndex`: its formula, its quantities, and how it is drawn.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.lane_data import LaneData
from roadscan.core.plugins import found_kinds
from roadscan.core.witness import Finding

How: TypeAlias = Literal["mean", "max"]

ENTRY_POINT_GROUP: Final = "roadscan.condition_indices"


@dataclass(frozen=True)
class Quantity:
    """A quantity that an index computes."""

    name: str
    """Name with its unit, such as rut_depth_mm."""
    unit: str
    meaning: str


class Value(NamedTuple):
    """A value of a quantity."""

    quantity: str
    extent: Literal["cross_section", "section"]
    from_m: float
    to_m: float
    value: float
    """Value; NaN where it is not known."""
    sigma: float
    """1 σ; NaN where it is not known."""
    share: float
    reason: str = ""
    finding: Finding | None = None
    """Warning about the underlying heights; its subject, the lane, is filled in where it is written."""


class ConditionIndex(ABC):
    """An index of condition: values of sections of a lane, and of its cross-sections."""

    name: ClassVar[str]
    title: ClassVar[str]
    quantities: ClassVar[tuple[Quantity, ...]]
    drawn: ClassVar[tuple[str, ...]] = ()
    """Quantities of sections that the strip chart shows, in one panel."""
    needs_cracks: ClassVar[bool] = False
    """True for an index of the survey's cracks."""
    lead_m: ClassVar[float] = 0.0
    """Length before and after a section that its values depend on."""

    @abstractmethod
    def values(self, lane: LaneData) -> Iterable[Value]:
        """Return the values of all sections, and of cross-sections in them."""


@functools.cache
def condition_indices() -> dict[str, ConditionIndex]:
    """Return all indices by name."""
    found = found_kinds("condition/indices/*.py", ConditionIndex, ENTRY_POINT_GROUP)
    return {name: kind() for name, kind in found.items()}


@dataclass(frozen=True, eq=False)
class PerCrossSection:
    """A quantity of each cross-section, before it is aggregated by section."""

    quantity: str
    station_m: Float64
    value: Float64
    sigma: Float64
    share: Float64
    noisy: npt.NDArray[np.bool_] | None = None
    """(n,) True for those without a value because their heights are noisy; None: none."""

    def values(self) -> Iterable[Value]:
        """Return the values of the cross-sections themselves."""
        columns = (self.station_m, self.value, self.sigma, self.share, self._left_out(slice(None)))
        for station, value, sigma, share, is_noisy in zip(*(column.tolist() for column in columns), strict=True):
            lacking = "its heights are noise" if is_noisy else "too little of the cross-section was measured"
            reason = "" if math.isfinite(value) else lacking
            yield Value(self.quantity, "cross_section", station, station, value, sigma, share, reason)

    def remark(self, own: npt.NDArray[np.bool_]) -> str:
        """Return a section's remark on those of its cross-sections `own` (n,) that are left out."""
        count = np.count_nonzero(self._left_out(own))
        words = f"{count} cross-sections are left out: their heights are over ten times as noisy as the lane's"
        return words if count else ""

    def _left_out(self, own: npt.NDArray[np.bool_] | slice) -> npt.NDArray[np.bool_]:
        every = np.zeros(self.value.size, np.bool_) if self.noisy is None else self.noisy
        return every[own]


def by_section(
    held: PerCrossSection, lane: LaneData, wanted: Sequence[tuple[str, How]], spacing_m: float | None = None
) -> Iterable[Value]:
    """Return mean or greatest value of the cross-sections of each section, under separate names.

    `spacing_m` is their distance, that of the lane's cross-sections by default.

    A section in which too few cross-sections have a value has none. The standard deviation of a mean is the root mean
    square of the cross-sections' σ, since neighbours share the vehicle's motion and so their errors. The greatest value
    keeps its σ.
    """
    config = lane.config
    for from_m, to_m in lane.sections_m:
        own = (held.station_m >= from_m - 1e-6) & (held.station_m < to_m - 1e-6)
        value, sigma = held.value[own], held.sigma[own]
        known = ~np.isnan(value)
        due = max(1.0, (to_m - from_m) / (spacing_m or config.cross_section_spacing_m))
        share = min(1.0, float(known.sum()) / due)
        remark = held.remark(own)
        for name, how in wanted:
            if share < config.least_share or not known.any():
                reason = f"{100 * share:.0f} % of the cross-sections were measured"
                yield Value(name, "section", from_m, to_m, np.nan, np.nan, share, reason)
            elif how == "mean":
                spread = float(np.sqrt(np.mean(sigma[known] ** 2)))
                yield Value(name, "section", from_m, to_m, float(value[known].mean()), spread, share, remark)
            else:
                k = int(np.flatnonzero(known)[np.argmax(value[known])])
                yield Value(name, "section", from_m, to_m, float(value[k]), float(sigma[k]), share, remark)
