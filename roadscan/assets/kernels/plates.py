"""Beams at the sides of a plate."""

from __future__ import annotations

from roadscan.compute.kernel_options import kernel


@kernel
def nearest_sides(along, reach, share, sides, nearest, away, grows):
    """Find the side of a plate that each beam lies farthest past, or least within.

    Parameters
    ----------
    along, reach : (n, k) how far beams lie along the direction of each side, and how much farther their spots reach.
    share : of that reach which counts; sides : (k,) places of the sides along their directions.
    nearest : (n,) int64, out: the side, the first where equal.
    away, grows : (n,) out: how far past it the beam lies, and the reach there.
    """
    for i in range(along.shape[0]):
        best, most = 0, along[i, 0] + share * reach[i, 0] - sides[0]
        for k in range(1, sides.size):
            past = along[i, k] + share * reach[i, k] - sides[k]
            if past > most:
                best, most = k, past
        nearest[i], away[i], grows[i] = best, most, reach[i, best]
