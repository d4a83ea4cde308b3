"""Positions of returns from azimuth, distance and slot, for a lidar that fires its lasers in turn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

SLOTS = 256
"""Rows of the tables of beams: every slot that a byte can name, so that damage reads no memory outside."""
_ONE, _TWO, _SIX = np.float64(1.0), np.float64(2.0), np.float64(6.0)  # of the series of sine and cosine


class Packed(NamedTuple):
    """What the sensor wrote of n returns. Azimuth and rate stay the same for runs of them: the row after each run."""

    head: npt.NDArray[np.uint16]
    """Azimuth of the head in each run (0.01°)."""
    head_end: npt.NDArray[np.int64]
    rate: npt.NDArray[np.float64]
    """Rate of the head in each run (rad/ns)."""
    rate_end: npt.NDArray[np.int64]
    distance: npt.NDArray[np.uint16]
    """(n,)."""
    slot: npt.NDArray[np.uint8]
    """(n,)."""


class BeamTable(NamedTuple):
    """Beams by slot, (SLOTS,) each. Own azimuths that are 0 for all slots are left out, and so are a unit's offsets."""

    after_ns: npt.NDArray[np.float64]
    """(slots of the sensor,)."""
    unit_m: npt.NDArray[np.float32]
    """(1,)."""
    cos_elevation: npt.NDArray[np.float32]
    sin_elevation: npt.NDArray[np.float32]
    rise_m: npt.NDArray[np.float32]
    cos_azimuth: npt.NDArray[np.float32]
    sin_azimuth: npt.NDArray[np.float32]
    extra_m: npt.NDArray[np.float32]
    """Offsets by a calibration file: none of them, or all three."""
    reach_m: npt.NDArray[np.float32]
    side_m: npt.NDArray[np.float32]


class Turned(NamedTuple):
    """Room for what is computed once a firing sequence, by slot, (SLOTS,) each."""

    small_sine: npt.NDArray[np.float32]
    """Of the angle by which the head turns on until the slot is fired."""
    small_cosine: npt.NDArray[np.float32]
    sine: npt.NDArray[np.float32]
    """Of the azimuth of the beam."""
    cosine: npt.NDArray[np.float32]


@kernel
def positions(packed, beams, heads, turned, x_m, y_m, z_m):
    """Write the positions (n,) of returns in the sensor's axes, float32, in its arithmetic.

    Parameters
    ----------
    packed : Packed.
    beams : BeamTable.
    heads : (2, 65536) sine and cosine of each azimuth of the head, float32.
    turned : Turned, zeros for slots that the sensor does not have.

    Notes
    -----
    Until its firing the head turns by less than 0.02 rad; the series of sine and cosine to the third order are exact
    there to 1e-8.
    """
    start, run, rate_run = 0, 0, -1
    slots, unit_m = beams.after_ns.size, beams.unit_m[0]
    while start < packed.slot.size:
        if rate_run < 0 or packed.rate_end[rate_run] <= start:
            rate_run += 1
            rate = packed.rate[rate_run]
            for k in range(slots):
                angle = rate * beams.after_ns[k]
                square = angle * angle
                turned.small_sine[k] = np.float32(angle * (_ONE - square / _SIX))
                turned.small_cosine[k] = np.float32(_ONE - square / _TWO)
        if packed.head_end[run] <= start:
            run += 1
        sine, cosine = heads[0, packed.head[run]], heads[1, packed.head[run]]
        for k in range(slots):
            turned.sine[k] = sine * turned.small_cosine[k] + cosine * turned.small_sine[k]
            turned.cosine[k] = cosine * turned.small_cosine[k] - sine * turned.small_sine[k]
        for k in range(slots if beams.cos_azimuth.size else 0):
            sine, cosine = turned.sine[k], turned.cosine[k]
            turned.sine[k] = sine * beams.cos_azimuth[k] + cosine * beams.sin_azimuth[k]
            turned.cosine[k] = cosine * beams.cos_azimuth[k] - sine * beams.sin_azimuth[k]
        end = min(packed.head_end[run], packed.rate_end[rate_run])
        for i in range(start, start if beams.extra_m.size else end):
            k = packed.slot[i]
            range_m = np.float32(packed.distance[i]) * unit_m
            level_m = range_m * beams.cos_elevation[k]
            x_m[i], y_m[i] = level_m * turned.cosine[k], level_m * -turned.sine[k]
            z_m[i] = range_m * beams.sin_elevation[k] + beams.rise_m[k]
        for i in range(start, end if beams.extra_m.size else start):
            k = packed.slot[i]
            range_m = np.float32(packed.distance[i]) * unit_m + beams.extra_m[k]
            level_m = range_m * beams.cos_elevation[k] + beams.reach_m[k]
            x, y = level_m * turned.cosine[k], level_m * -turned.sine[k]
            x_m[i], y_m[i] = x + beams.side_m[k] * turned.sine[k], y + beams.side_m[k] * turned.cosine[k]
            z_m[i] = range_m * beams.sin_elevation[k] + beams.rise_m[k]
        start = end
