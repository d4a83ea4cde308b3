"""Response of a quarter car to longitudinal profiles, and its mean over any stretch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.quarter_car import QuarterCar, roll
from roadscan.condition.profiles.profiles import Breaks, breaks_of, fault_of, heights_of, stations_of
from roadscan.condition.profiles.quarter_car import COARSEST_M, GOLDEN_CAR, RULES, rules_at, usual_step_m
from roadscan.condition.profiles.segments import Segments

Note: TypeAlias = Literal["start", "gap", "jump", "step", "uneven", "short"]
NOTES: Final[tuple[Note, ...]] = get_args(Note)
"""Possible words of a segment's note, in their order."""


@dataclass(frozen=True)
class Ride:
    """Response of a quarter car to profiles that share their stations."""

    x_m: Float64
    """(n,) stations (m)."""
    response_m: Float64
    """(profiles, n) integral of the suspension's |slope|, or of its square, from the first sample on (m)."""
    measured_m: Float64
    """(profiles, n) length rolled over from the first sample on (m); gaps do not count."""
    breaks: tuple[Breaks, ...]
    """Gaps and jumps of each profile."""
    faults: tuple[str, ...]
    """Reason why a profile can have no index; empty where it can."""
    even: bool
    """Whether its stations are evenly spaced, as ASTM E1926 takes them."""

    def means(self, segments: Segments, least_share: float = 0.5) -> tuple[Float64, Float64]:
        """Return means of the response over segments, and the share of each segment that was rolled over.

        Returns
        -------
        (profiles, segments) twice. The mean is NaN where less than `least_share` of a segment was rolled over, and of
        profiles with a fault.
        """
        shape = (len(self.faults), segments.from_m.size)
        means, shares = np.full(shape, np.nan), np.zeros(shape)
        for row, fault in enumerate(self.faults):
            if fault:
                continue
            felt, rolled = self._over(self.response_m[row], segments), self._over(self.measured_m[row], segments)
            shares[row] = rolled / (segments.to_m - segments.from_m)
            enough = (shares[row] >= least_share) & (rolled > 0.0)
            means[row, enough] = felt[enough] / rolled[enough]
        return means, np.minimum(shares, 1.0)

    def notes(self, segments: Segments, nominal_m: float | None = None) -> list[list[str]]:
        """Return notes on each profile's segments, as words separated by commas; empty where there is nothing.

        `start`: the car begins in it, so its first 11 m depend on how it begins. `gap`: more than half a metre was not
        measured, or more than a foot of it is missing. `jump`: a step that no road has was left out. `step`: one of
        more than 0.1 m was kept. `uneven`: stations are not evenly spaced. `short`: less than `nominal_m` long.
        """
        return [[self._note(row, k, segments, nominal_m) for k in range(segments.from_m.size)]
                for row in range(len(self.faults))]  # fmt: skip

    def accuracy_class(self, segments: Segments) -> npt.NDArray[np.int64]:
        """Return (segments,) class of the World Bank by the widest step of a segment: 1 to 0.25 m, 2 to 0.5 m.

        The class does not depend on the accuracy of the heights.
        """
        wide = np.sort(np.concatenate([broken.wide_m for broken in self.breaks]))
        first, behind = (np.searchsorted(wide, ends) for ends in segments)
        return np.where(behind > first, 2, 1)

    def _over(self, sums: Float64, segments: Segments) -> Float64:
        """Return differences of sums over segments."""
        return np.interp(segments.to_m, self.x_m, sums) - np.interp(segments.from_m, self.x_m, sums)

    def _note(self, row: int, k: int, segments: Segments, nominal_m: float | None) -> str:
        begin, end, broken = segments.from_m[k], segments.to_m[k], self.breaks[row]
        starts = (self.x_m[:1], broken.gap_to_m, broken.jump_m)
        ends = Segments(segments.from_m[k : k + 1], segments.to_m[k : k + 1])
        missing_m = end - begin - float(self._over(self.measured_m[row], ends)[0])
        told: dict[Note, bool] = {
            "start": any(bool(((at + RULES.start_m > begin) & (at < end)).any()) for at in starts),
            "gap": bool(((broken.gap_from_m < end) & (broken.gap_to_m > begin)).any()) or missing_m > COARSEST_M,
            "jump": bool(((broken.jump_m >= begin) & (broken.jump_m <= end)).any()),
            "step": bool(((broken.severe_m >= begin) & (broken.severe_m <= end)).any()),
            "uneven": not self.even,
            "short": nominal_m is not None and bool(end - begin < nominal_m * (1.0 - 1e-6)),
        }
        return ", ".join(word for word, said in told.items() if said)


def ride(x_m: npt.ArrayLike, height_m: npt.ArrayLike, car: QuarterCar = GOLDEN_CAR, *, squared: bool = False) -> Ride:
    """Return the response of a quarter car to profiles of any spacing up to a foot, regular or not.

    The state passes from sample to sample by the exact solution of the equations of motion. The car begins at rest on
    the mean slope of the first 11 m, and so it does behind each gap of more than 0.5 m and each jump of more than
    0.5 m; pieces of less than 11 m are left out.

    Parameters
    ----------
    x_m : (n,) stations, ascending (m).
    height_m : (n,) or (profiles, n) heights; NaN where there is none (m).
    squared : the square of the suspension's slope is summed up in place of its absolute value.

    Raises
    ------
    ProfileError
        where the stations do not ascend, or heights do not fit them. A profile that cannot be judged has a fault.
    """
    x = stations_of(x_m)
    heights = heights_of(height_m, x.size)
    response, measured = np.empty_like(heights), np.empty_like(heights)
    usual_m = usual_step_m(x)
    roll(x, heights, car, rules_at(usual_m), squared, response, measured)
    return Ride(
        x,
        response,
        measured,
        tuple(breaks_of(x, row, RULES) for row in heights),
        tuple(fault_of(x, row, RULES) for row in heights),
        bool(np.isfinite(usual_m)),
    )
