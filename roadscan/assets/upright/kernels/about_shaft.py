"""What lies about a shaft, counted in one pass over the returns near it."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from roadscan.assets import classes
from roadscan.compute.kernel_options import inner, kernel


class Part(IntEnum):
    """Numbers of returns: on the shaft, beside it (on it too), in rings, in its lower and upper half, below, above."""

    ON_IT, BESIDE, RING_1, RING_2, RING_3, ON_LOWER, NEAR_LOWER, ON_UPPER, NEAR_UPPER = range(9)
    BELOW, OVER, GOES_ON, LEAVES, OWN_LEAVES, BUILDING, OWN_BUILDING = range(9, 16)


RINGS = (Part.RING_1, Part.RING_2, Part.RING_3)
"""The rings about a shaft, from its surface outwards."""
_ON_IT, _BESIDE, _RING_1, _ON_LOWER, _NEAR_LOWER = 0, 1, 2, 5, 6  # as :class:`Part` has them
_BELOW, _OVER, _GOES_ON, _LEAVES, _BUILDING = 9, 10, 11, 12, 14  # likewise
_LEAVES_FROM, _LEAVES_TO = classes.LOW_VEGETATION, classes.HIGH_VEGETATION  # Classes between them are vegetation.
_GRASS_M = 0.1  # Lower returns (m) are grass and the noise of the ground.
_GOES_ON_M = 1.0  # A shaft goes on where returns lie on its axis up to so far above its top (m).


@kernel
def about_shaft(returns, near, axis, heights, edges, slot_ns, number, sectors, on_it, slots):
    """Count the returns about a shaft by where they lie and what they are.

    Parameters
    ----------
    returns : x, y, height (m), class and time (ns) of all returns.
    near : (k,) int64, rows of those near the shaft.
    axis : x, y (m) at a height (m), slopes in x and y, radius (m).
    heights : of the ground (m), and of the lower and upper end of the shaft above it.
    edges : from the surface of the shaft outwards (m): what may lie on it, three rings.
    slot_ns : length of a slot of time.
    number : (16,) int64, added to: returns of each :class:`Part`.
    sectors : (s,) int64, added to: returns beside the shaft, not on it, by direction.
    on_it : (k, 3) float64, out: x and y from the axis, height above the ground of the returns on the shaft.
    slots : (2,) int64, out: slots in which the shaft was seen, and others in which something beside or above it was.
    """
    x, y, height, kind, epoch = returns
    ground, low, top = heights
    middle = 0.5 * (low + top)
    own, other, owns, others = np.empty(near.size, np.int64), np.empty(near.size, np.int64), 0, 0
    for k in range(near.size):
        i = near[k]
        past, above = height[i] - axis[2], height[i] - ground
        right, ahead = x[i] - (axis[0] + axis[3] * past), y[i] - (axis[1] + axis[4] * past)
        away = math.hypot(right, ahead) - axis[5]
        close, higher, half = away <= edges[2], above > top, 2 if above >= middle else 0
        leaf, built = _LEAVES_FROM <= kind[i] <= _LEAVES_TO, kind[i] == classes.BUILDING
        number[_BELOW] += _GRASS_M < above < low and close
        number[_OVER] += higher and close
        number[_GOES_ON] += higher and away <= edges[0] and above < top + _GOES_ON_M
        beside = low <= above <= top
        if beside and away <= edges[0]:
            on_it[owns, 0], on_it[owns, 1], on_it[owns, 2] = right, ahead, above
            own[owns] = epoch[i] // slot_ns
            owns += 1
            number[_ON_LOWER + half] += 1
            number[_LEAVES + 1] += leaf
            number[_BUILDING + 1] += built
        elif beside or higher:
            other[others] = epoch[i] // slot_ns
            others += 1
        if beside:
            number[_BESIDE] += 1
            number[_LEAVES] += leaf
            number[_BUILDING] += built
            number[_NEAR_LOWER + half] += close
            for ring in range(3):
                number[_RING_1 + ring] += edges[ring] < away <= edges[ring + 1]
            if away > edges[0]:
                turn = math.floor(math.atan2(ahead, right) / (2.0 * math.pi / sectors.size))
                sectors[int(turn) % sectors.size] += 1
    number[_ON_IT] += owns
    slots[0], slots[1] = _distinct(own[:owns], other[:others])


@inner
def _distinct(own, other):
    """Returns how many numbers occur in `own`, and how many more in `other`; both are sorted."""
    own.sort()
    other.sort()
    first, second, k = 0, 0, 0
    for i in range(own.size):
        first += i == 0 or own[i] != own[i - 1]
    for i in range(other.size):
        if i == 0 or other[i] != other[i - 1]:
            while k < own.size and own[k] < other[i]:
                k += 1
            second += k == own.size or own[k] != other[i]
    return first, second
