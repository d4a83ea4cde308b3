"""Slots of Velodyne packets to packed returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import kernel

_BLOCK, _RETURN = 100, 3  # bytes of a block, and of a return in it
_FIRST_RETURN = 4  # bytes of a block before its first return
_SLOTS = 32  # returns of a block


class Firings(NamedTuple):
    """What is known of n packets beside their returns."""

    epoch_gps_ns: npt.NDArray[np.int64]
    """(n, blocks) GPS time of each block's packet, and the block's wait at a gap of the view."""
    head: npt.NDArray[np.uint16]
    """(n, blocks, 1 or 32) azimuth of the head (0.01°), of a block or of each slot."""
    rate: npt.NDArray[np.float64]
    """(n,) rate of the head (rad/ns)."""
    sweep: npt.NDArray[np.int32]
    """(n, blocks or more)."""
    time_ns: npt.NDArray[np.int64]
    """(blocks, 32) time of each return after the packet's."""
    slot: npt.NDArray[np.uint8]
    """(blocks, 32) slot of each return."""


class Room(NamedTuple):
    """Room for m returns, (m,) each."""

    epoch_gps_ns: npt.NDArray[np.int64]
    head: npt.NDArray[np.uint16]
    rate: npt.NDArray[np.float64]
    distance: npt.NDArray[np.uint16]
    intensity: npt.NDArray[np.uint8]
    slot: npt.NDArray[np.uint8]
    sweep: npt.NDArray[np.int32]


@kernel
def returned(packets, firings, dual, room):
    """Write the returns of packets, slot by slot, without empty slots; return their number.

    Parameters
    ----------
    packets : (n, bytes) uint8.
    firings : Firings.
    dual : whether every second block repeats the one before with the other return: equal ones count once.
    room : Room for all slots.
    """
    count = 0
    ways = firings.head.shape[2]
    for p in range(packets.shape[0]):
        for b in range(firings.slot.shape[0]):
            epoch, sweep = firings.epoch_gps_ns[p, b], firings.sweep[p, b]
            for j in range(_SLOTS):
                at = _BLOCK * b + _FIRST_RETURN + _RETURN * j
                low, high, bright = packets[p, at], packets[p, at + 1], packets[p, at + 2]
                if low == 0 and high == 0:
                    continue
                if dual and b % 2:
                    other = at - _BLOCK
                    if packets[p, other] == low and packets[p, other + 1] == high and packets[p, other + 2] == bright:
                        continue
                room.epoch_gps_ns[count] = epoch + firings.time_ns[b, j]
                room.head[count] = firings.head[p, b, j % ways]
                room.rate[count] = firings.rate[p]
                room.distance[count] = np.uint16(low) | (np.uint16(high) << np.uint16(8))
                room.intensity[count] = bright
                room.slot[count] = firings.slot[b, j]
                room.sweep[count] = sweep
                count += 1
    return count
