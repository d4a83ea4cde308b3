"""Checks of longitudinal profiles: valid input, gaps and jumps, and heights that are not a road.

Quarter cars of the ride indices, as the modes that the kernel rolls over a profile.

Equations of motion (World Bank Technical Paper 46; Sayers and Karamihas, The Little Book of Profiling, 1998), with all
quantities divided by the sprung mass, z_s and z_u the heights of body and wheel, h that of the road:

    z_s'' = C (z_u' − z_s') + K2 (z_u − z_s)
    µ z_u'' = K1 (h − z_u) − C (z_u' − z_s') − K2 (z_u − z_s)

They are linear: the slopes of z_s and z_u follow from the slope of h by the same equations.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.quarter_car import QuarterCar, Rules
from roadscan.core.errors import ProfileError

SPEED_M_PER_S = 80.0 / 3.6
"""Speed of all ride indices: 80 km/h."""

RULES = Rules(envelope_m=0.25, ahead_m=0.0, start_m=11.0, longest_step_m=0.5, highest_step_m=0.5)
"""Moving average of 250 mm and a start of 11 m, as World Bank Technical Paper 46 and ASTM E1926 have them.

A step of 0.5 m is the widest of the World Bank's class 2: a wider one is a gap. Kerbs rise by 0.15 m and potholes are
0.3 m deep: between two samples no road climbs 0.5 m, which is a fault of the data.
"""
COARSEST_M = 0.306
"""Coarsest spacing in use: a sample a foot, with stations rounded to a millimetre (m)."""
SEVERE_M = 0.1
"""A higher step between neighbours is kept and noted: a kerb, a pothole's edge, or a fault of the data (m)."""
_EVEN: Final = 0.02
"""Largest deviation of even steps from the usual one, as a share of it, …"""
_EVEN_M: Final = 0.0011  # … or rounding of stations to millimetres.
_EVEN_SHARE: Final = 0.9
"""Least share of steps of the usual length where spacing is even: lost samples leave some longer ones."""


def usual_step_m(x_m: Float64) -> float:
    """Return the usual distance between stations (m), or NaN where they are not evenly spaced."""
    step = np.diff(x_m)
    usual = float(np.median(step))
    alike = np.abs(step - usual) <= max(_EVEN * usual, _EVEN_M)
    return usual if np.mean(alike) >= _EVEN_SHARE else float("nan")


def rules_at(usual_m: float) -> Rules:
    """Return the rules for a profile with this many metres between its stations; NaN for uneven spacing.

    ASTM E1926 averages over the whole number of steps that is nearest to 250 mm (Sayers 1995: from 167 mm on the slope
    of the step itself counts). Its average of an even number of steps lies half a step ahead. For uneven spacing the
    standard has no rule: the average is taken over 250 mm.
    """
    if not usual_m < RULES.envelope_m:
        return RULES
    count = max(int(RULES.envelope_m / usual_m + 0.5), 1)
    return RULES._replace(envelope_m=count * usual_m, ahead_m=0.0 if count % 2 else 0.5 * usual_m)


def quarter_car(k1: float, k2: float, c: float, mu: float) -> QuarterCar:
    """Return the modes of a quarter car at 80 km/h.

    Parameters
    ----------
    k1, k2 : stiffness of tyre and suspension over the sprung mass (1/s²).
    c : damping over the sprung mass (1/s).
    mu : unsprung over sprung mass.
    """
    motion = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-k2, -c, k2, c],
            [0.0, 0.0, 0.0, 1.0],
            [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu],
        ]
    )
    poles, shapes = np.linalg.eig(motion)
    # At rest on a slope of one, both masses have that slope; this state in modes, times their share in the stroke.
    at_rest = np.linalg.solve(shapes, np.array([1.0, 0.0, 1.0, 0.0], dtype=complex))
    stroke = 2.0 * (shapes[0] - shapes[2]) * at_rest
    first, second = sorted((k for k in range(4) if poles[k].imag > 0.0), key=lambda k: poles[k].imag)
    pole_per_m = (complex(poles[first]) / SPEED_M_PER_S, complex(poles[second]) / SPEED_M_PER_S)
    steps_m = np.arange(0.0, RULES.longest_step_m + 1e-3, 5e-4)
    growth = np.exp(np.multiply.outer(steps_m, np.array(pole_per_m)))
    return QuarterCar(pole_per_m, (-complex(stroke[first]), -complex(stroke[second])), growth)


GOLDEN_CAR = quarter_car(k1=653.0, k2=63.3, c=6.0, mu=0.15)
"""The car of the IRI (World Bank Technical Paper 46, table of the golden car's parameters)."""


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
