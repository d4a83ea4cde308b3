"""Estimates the random walk of a trajectory's heights from the trajectory itself.

A vehicle's body moves slowly: at 2 Hz, its main frequency, a fourth difference of poses 5 ms apart keeps 2 · 10⁻⁵ of
the movement, at 10 Hz, the frequency of the wheels, 1 %. The rest is the random walk of the poses, whose fourth
difference has 20 times the variance of its steps. Its spectrum is that of a road of waviness 2: it adds to roughness.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.robust import scatter_about

Float64 = npt.NDArray[np.float64]

_LONGEST_STEP_NS: Final = 11_000_000
"""At a longer interval the fourth differences of poses contain the vehicle's movement."""
_WALK: Final = 20.0
"""Variance of the fourth difference of a random walk over that of its steps: 1 + 9 + 9 + 1."""
_SLOWEST_M_PER_S: Final = 1.0  # Slower poses are left out.


def height_wander(epoch_ns: npt.NDArray[np.int64], place_m: Float64) -> float:
    """Return the random walk's variance of pose heights per metre of travel (m²/m); 0 where poses do not show it.

    Parameters
    ----------
    epoch_ns : (n,) ascending.
    place_m : (n, 3) easting, northing, height on the map (m).
    """
    step = np.diff(epoch_ns)
    if step.size < 100 or np.median(step) > _LONGEST_STEP_NS:
        return 0.0
    seconds = 1e-9 * float(np.median(step))
    speed = np.hypot(*np.diff(place_m[:, :2], axis=0).T) / seconds
    even = (np.abs(step - np.median(step)) <= 0.01 * np.median(step)) & (speed > _SLOWEST_M_PER_S)
    fourth = np.diff(place_m[:, 2], 4)
    own = fourth[np.convolve(even, np.ones(4), mode="valid") == 4.0]
    if own.size < 100:
        return 0.0
    spread = scatter_about(own, float(np.median(own)))
    return spread**2 / (_WALK * seconds * float(np.median(speed[even])))
