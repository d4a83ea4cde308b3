"""What each laser of a spinning lidar measured in each firing, and its ranges against those of two others."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel

_MOST_RES_M = 1.0  # larger differences to the neighbours (m) are not of one surface
_NEAREST_M = 1.0  # nearer returns (m) are not compared
_EVEN = 0.7  # least ratio of the two neighbours' ranges: below it, they do not measure one surface
_SIDE = np.sin(np.radians(2.0))  # sine of the largest difference of azimuth to the neighbours


@kernel
def by_firing(laser, firing, xyz_m, heads):
    """Write range (m), sine of the elevation, cosine and sine of the azimuth of returns by laser and firing.

    Parameters
    ----------
    laser, firing : (n,) int64.
    xyz_m : (3, n) positions in the sensor's frame.
    heads : (4, lasers, firings), out; what returns nothing keeps its values.
    """
    for i in range(laser.size):
        x, y, z = xyz_m[0, i], xyz_m[1, i], xyz_m[2, i]
        level = x * x + y * y
        far = np.sqrt(level + z * z)
        level = np.sqrt(level)
        if level > 0.0 and far < np.inf:
            heads[0, laser[i], firing[i]] = far
            heads[1, laser[i], firing[i]] = z / far
            heads[2, laser[i], firing[i]] = x / level
            heads[3, laser[i], firing[i]] = y / level


@kernel
def residuals(heads, mid, one, other, share_one, share_other, off_m, quarter, pulls):
    """Write by how much the ranges of a laser differ from what two others measure of the same planes.

    On a plane 1/range is linear in the direction: 1 / mid = share_one / one + share_other / other.

    Parameters
    ----------
    heads : (4, lasers, firings) as `by_firing` writes them, NaN where a laser measured nothing.
    mid, one, other : numbers of the lasers.
    off_m : (firings,) m, out.
    quarter : (firings,) int64 quarter of the turn, 0 to 3, out.
    pulls : (2, firings) what 1 m of each neighbour's range adds, out.

    Returns
    -------
    int, the firings that can be compared, which are written first.
    """
    count = 0
    for i in range(heads.shape[2]):
        own, a, b = heads[0, mid, i], heads[0, one, i], heads[0, other, i]
        if not (a > _NEAREST_M and min(a, b) > _EVEN * max(a, b)):
            continue
        should = 1.0 / (share_one / a + share_other / b)
        ahead, left = heads[2, mid, i], heads[3, mid, i]
        beside_a = abs(ahead * heads[3, one, i] - left * heads[2, one, i]) < _SIDE
        beside_b = abs(ahead * heads[3, other, i] - left * heads[2, other, i]) < _SIDE
        if abs(own - should) < _MOST_RES_M and beside_a and beside_b:
            off_m[count] = own - should
            quarter[count] = (0 if ahead < 0 else 1) if left < 0 else (3 if ahead < 0 else 2)
            pulls[0, count] = -share_one * (should / a) ** 2
            pulls[1, count] = -share_other * (should / b) ** 2
            count += 1
    return count
