"""The quarter cars of the ride indices, as the modes that the kernel rolls over a profile.

Equations of motion (World Bank Technical Paper 46; Sayers and Karamihas, The Little Book of Profiling, 1998), with all
quantities divided by the sprung mass, z_s and z_u the heights of body and wheel, h that of the road:

    z_s'' = C (z_u' − z_s') + K2 (z_u − z_s)
    µ z_u'' = K1 (h − z_u) − C (z_u' − z_s') − K2 (z_u − z_s)

They are linear: the slopes of z_s and z_u follow from the slope of h by the same equations.
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.condition.quarter_car import QuarterCar, Rules

SPEED_M_PER_S = 80.0 / 3.6
"""Speed of all ride indices: 80 km/h."""

RULES = Rules(envelope_m=0.25, start_m=11.0, longest_step_m=0.306, highest_step_m=0.1)
"""Moving average of 250 mm and a start of 11 m, as World Bank Technical Paper 46 and ASTM E1926 have them.

A sample a foot is the coarsest that is in use, its stations rounded to a millimetre. Between two samples no road climbs
0.1 m: that is a fault of the data.
"""


def quarter_car(k1: float, k2: float, c: float, mu: float) -> QuarterCar:
    """Modes of a quarter car at 80 km/h.

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
    # At rest on a slope of one both masses have that slope; this state in modes, times what each adds to the stroke.
    at_rest = np.linalg.solve(shapes, np.array([1.0, 0.0, 1.0, 0.0], dtype=complex))
    stroke = 2.0 * (shapes[0] - shapes[2]) * at_rest
    first, second = sorted((k for k in range(4) if poles[k].imag > 0.0), key=lambda k: poles[k].imag)
    pole_per_m = (complex(poles[first]) / SPEED_M_PER_S, complex(poles[second]) / SPEED_M_PER_S)
    steps_m = np.arange(0.0, RULES.longest_step_m + 1e-3, 5e-4)
    growth = np.exp(np.multiply.outer(steps_m, np.array(pole_per_m)))
    return QuarterCar(pole_per_m, (-complex(stroke[first]), -complex(stroke[second])), growth)


GOLDEN_CAR = quarter_car(k1=653.0, k2=63.3, c=6.0, mu=0.15)
"""The car of the IRI (World Bank Technical Paper 46, table of the golden car's parameters)."""
