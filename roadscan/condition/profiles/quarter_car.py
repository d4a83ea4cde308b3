"""Quarter cars of the ride indices, as the modes that the kernel rolls over a profile.

Equations of motion (World Bank Technical Paper 46; Sayers and Karamihas, The Little Book of Profiling, 1998), with all
quantities divided by the sprung mass, z_s and z_u the heights of body and wheel, h that of the road:

    z_s'' = C (z_u' − z_s') + K2 (z_u − z_s)
    µ z_u'' = K1 (h − z_u) − C (z_u' − z_s') − K2 (z_u − z_s)

They are linear: the slopes of z_s and z_u follow from the slope of h by the same equations.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.quarter_car import QuarterCar, Rules

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
