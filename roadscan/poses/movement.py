"""Bounds on how far corrections move poses, within which results made from recorded poses stay valid."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.poses.trajectory import Corrections

_LEAST_SHIFT_M: Final = 0.05  # Smallest allowance of a shift.
_LEAST_TURN_RAD: Final = 0.0005  # Smallest allowance of a turn.
_STEP: Final = 4.0  # Each allowance is this many times the one before it.
_MOST_STEPS: Final = 8  # Number of allowances; a larger correction is an error.


class Allowance(NamedTuple):
    """The largest corrections for which bounds on recorded poses still hold."""

    shift_m: float
    """Horizontal shift. A vertical movement changes no place on the map."""
    turn_rad: float
    """Angle of the small rotation."""

    @property
    def is_none(self) -> bool:
        """True where no correction is allowed for."""
        return self.shift_m == 0.0 and self.turn_rad == 0.0

    def moved_m(self, arm_m: float) -> float:
        """Return how far (m) a point on the ground moves at most that lies `arm_m` from the body's origin.

        Between its knots the corrected trajectory is not the recorded one with a correction that is linear in time: it
        is interpolated through corrected knots. With even knots that swings over by at most 3/8 of the largest
        correction (cubic Hermite with slopes through five knots: |slope| ≤ 1.5 per knot, times u (1 − u) ≤ 1/4), with
        uneven ones by more, where corrections change from one knot to the next by their own size. So the bound is twice
        the correction.
        """
        return 2.0 * (self.shift_m + self.turn_rad * arm_m)


NO_CORRECTION: Final = Allowance(0.0, 0.0)  # Bounds hold for the recorded poses only.


def allowance_for(corrections: Corrections | None, mounting: tuple[float, float] = (0.0, 0.0)) -> Allowance:
    """Return the smallest allowance that covers the corrections, in steps of four from 0.05 m and 0.5 mrad on.

    Without corrections it is the first step, within which most later corrections stay.

    Parameters
    ----------
    corrections : of one run; None where it has none.
    mounting : shift (m) and turn (rad) that are added to the mounting of the sensor.

    Raises
    ------
    ValueError
        where corrections are beyond all reason (819 m, 8 rad).
    """
    shift, turn = largest(corrections)
    return Allowance(_step(shift + mounting[0], _LEAST_SHIFT_M), _step(turn + mounting[1], _LEAST_TURN_RAD))


def largest(corrections: Corrections | None) -> tuple[float, float]:
    """Return the largest horizontal shift (m) and turn (rad) of corrections."""
    if corrections is None or corrections.epochs_gps_ns.size == 0:
        return 0.0, 0.0
    shift: npt.NDArray[np.float64] = np.hypot(*corrections.north_east_down_m[:, :2].T)
    turn = np.linalg.norm(corrections.roll_pitch_heading_rad, axis=1)
    return float(shift.max()), float(turn.max())


def _step(value: float, least: float) -> float:
    for number in range(_MOST_STEPS):
        if value <= least * _STEP**number:
            return least * _STEP**number
    raise ValueError(f"a correction of {value:g}")
