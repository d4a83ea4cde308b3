"""Checks of longitudinal profiles: valid input, gaps and jumps, and heights that are not a road."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.quarter_car import Rules
from roadscan.condition.profiles.quarter_car import COARSEST_M, SEVERE_M
from roadscan.core.errors import ProfileError

STEEPEST = 0.3
"""Largest slope over 250 mm of a road in half of its places (a ratio)."""


FINEST_CLASS_M = 0.25
"""Widest step of the World Bank's class 1 (Technical Paper 46, section 2.2: sample intervals of 250 mm or less; m)."""


class Breaks(NamedTuple):
    """Gaps and jumps of a profile (m along it)."""

    gap_from_m: Float64
    """Last samples before gaps."""
    gap_to_m: Float64
    """First samples behind them."""
    jump_m: Float64
    """Middles of steps that are too high: nothing rolls over them."""
    severe_m: Float64
    """Middles of steps that are high and kept, as those of kerbs."""
    wide_m: Float64
    """Middles of steps of more than 0.25 m between samples that are no gap."""


def stations_of(x_m: npt.ArrayLike) -> Float64:
    """Return stations (n,) of a profile, ascending (m).

    Raises
    ------
    ProfileError
        where they are not a list of finite numbers that ascend.
    """
    x = np.ascontiguousarray(x_m, np.float64)
    if x.ndim != 1 or x.size < 2:
        raise ProfileError(f"stations of shape {x.shape}", expected="a list of two or more, in metres")
    wrong = np.flatnonzero(~np.isfinite(x))
    if wrong.size:
        raise ProfileError(f"station {x[wrong[0]]}", expected="finite numbers, in metres", record=int(wrong[0]))
    wrong = np.flatnonzero(np.diff(x) <= 0.0)
    if wrong.size:
        k = int(wrong[0])
        raise ProfileError(
            f"station {x[k + 1]:g} m comes after {x[k]:g} m",
            expected="stations that ascend",
            change="sort the samples, and leave out those measured twice",
            record=k + 1,
        )
    return x


def heights_of(height_m: npt.ArrayLike, samples: int) -> Float64:
    """Return heights (profiles, samples), also for one profile (m).

    Raises
    ------
    ProfileError
        where there is not a height for each station.
    """
    heights = np.atleast_2d(np.ascontiguousarray(height_m, np.float64))
    if heights.ndim != 2 or heights.shape[1] != samples:
        raise ProfileError(
            f"heights of shape {np.shape(height_m)}", expected=f"({samples},) or (profiles, {samples}), as the stations"
        )
    return heights


def breaks_of(x_m: Float64, height_m: Float64, rules: Rules) -> Breaks:
    """Return gaps and jumps of a profile; `x_m`, `height_m` (n,), NaN where there is no height."""
    there = np.isfinite(height_m)
    xs, hs = x_m[there], height_m[there]
    step = np.diff(xs)
    gap = step > rules.longest_step_m
    rise, middle = np.abs(np.diff(hs)), xs[:-1] + 0.5 * step
    jump = (rise > rules.highest_step_m) & ~gap
    severe = (rise > SEVERE_M) & ~gap & ~jump
    wide = (step > FINEST_CLASS_M + 1e-9) & ~gap
    return Breaks(xs[:-1][gap], xs[1:][gap], middle[jump], middle[severe], middle[wide])


def fault_of(x_m: Float64, height_m: Float64, rules: Rules) -> str:
    """Why a profile can have no index, or an empty text; `x_m`, `height_m` (n,), NaN where there is no height."""
    there = np.isfinite(height_m)
    xs, hs = x_m[there], height_m[there]
    if xs.size < 2:
        return f"{xs.size} of {x_m.size} samples have a height"
    step = np.diff(xs)
    usual = float(np.median(step))
    if usual > COARSEST_M:
        return f"a sample each {usual:g} m; the coarsest that can be judged is one each {COARSEST_M:g} m"
    if xs[-1] - xs[0] < rules.start_m:
        return f"{xs[-1] - xs[0]:g} m long; the shortest that can be judged is {rules.start_m:g} m"
    stride = max(1, round(rules.envelope_m / usual))
    slope = np.abs(np.diff(hs[::stride])) / np.diff(xs[::stride])
    if slope.size and np.count_nonzero(slope > STEEPEST) > 0.5 * slope.size:
        return (
            f"heights climb by {np.median(slope):.2g} m a metre in the middle of all places, which no road does: "
            "they may be millimetres given as metres"
        )
    return ""


def raise_fault(fault: str, **place: Any) -> None:
    """Raise an error for a profile with a fault.

    Raises
    ------
    ProfileError
        where there is one.
    """
    if fault:
        raise ProfileError(
            fault, expected="a longitudinal profile in metres", change="see to its unit, spacing and gaps", **place
        )
