"""Positions of returns from what a lidar that fires its lasers in turn wrote: azimuth of the head, distance, slot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

SLOTS = 256
"""Rows of the tables of beams: every slot that a byte can name, so that damage reads no memory outside."""
_ONE, _TWO, _SIX = np.float64(1.0), np.float64(2.0), np.float64(6.0)  # of the series of sine and cosine


class Packed(NamedTuple):
    """What the sensor wrote, (n,) each."""

    head: npt.NDArray[np.uint16]
    """Azimuth of the head (0.01°)."""
    rate: npt.NDArray[np.float64]
    """Rate of the head (rad/ns)."""
    distance: npt.NDArray[np.uint16]
    slot: npt.NDArray[np.uint8]


class BeamTable(NamedTuple):
    """Beams by slot, (SLOTS,) each; a quantity without a value other than 0 for any slot has none of them."""

    after_ns: npt.NDArray[np.float64]
    unit_m: npt.NDArray[np.float32]
    level: npt.NDArray[np.float32]
    """(2, SLOTS) cosine and sine of the elevation."""
    rise_m: npt.NDArray[np.float32]
    turn: npt.NDArray[np.float32]
    """(2, SLOTS or 0) cosine and sine of the beam's own azimuth."""
    extra_m: npt.NDArray[np.float32]
    reach_m: npt.NDArray[np.float32]
    side_m: npt.NDArray[np.float32]


@kernel
def positions(packed, beams, heads, scratch, x_m, y_m, z_m):
    """Write the positions (n,) of returns in the sensor's axes, float32, in its arithmetic.

    Parameters
    ----------
    packed : Packed.
    beams : BeamTable.
    heads : (2, 65536) sine and cosine of each azimuth of the head, float32.
    scratch : (2, SLOTS) float32.

    Notes
    -----
    Until its firing the head turns by less than 0.02 rad; the series of sine and cosine to the third order are exact
    there to 1e-8. They are taken once for all slots while the rate is the same, which is that of a packet.
    """
    before = np.nan
    for i in range(packed.slot.size):
        rate = packed.rate[i]
        if rate != before:
            before = rate
            for k in range(beams.after_ns.size):
                turned = rate * beams.after_ns[k]
                square = turned * turned
                scratch[0, k] = np.float32(turned * (_ONE - square / _SIX))
                scratch[1, k] = np.float32(_ONE - square / _TWO)
        k = packed.slot[i]
        sine, cosine = heads[0, packed.head[i]], heads[1, packed.head[i]]
        small_sine, small_cosine = scratch[0, k], scratch[1, k]
        sine, cosine = sine * small_cosine + cosine * small_sine, cosine * small_cosine - sine * small_sine
        if beams.turn.size:
            own_cosine, own_sine = beams.turn[0, k], beams.turn[1, k]
            sine, cosine = sine * own_cosine + cosine * own_sine, cosine * own_cosine - sine * own_sine
        range_m = np.float32(packed.distance[i]) * beams.unit_m[k]
        if beams.extra_m.size:
            range_m += beams.extra_m[k]
        level_m = range_m * beams.level[0, k]
        if beams.reach_m.size:
            level_m += beams.reach_m[k]
        x, y = level_m * cosine, level_m * -sine
        if beams.side_m.size:
            x, y = x + beams.side_m[k] * sine, y + beams.side_m[k] * cosine
        x_m[i], y_m[i], z_m[i] = x, y, range_m * beams.level[1, k] + beams.rise_m[k]
