"""Chains of pieces of lines, end to end: first continuous paint, then over the gaps between dashes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64, Int64

_TOUCHING_M: Final = 0.45
"""Ends no farther apart than this (m) belong to one band of paint."""
_ASIDE_M: Final = 0.12  # Lateral offset of ends that touch (m).
_GAP_SHARE: Final = 4.5
"""Longest gap, in lengths of the longer dash beside it …"""
_SHORT_GAP_M: Final = 4.0  # … and at least (m).
_TIGHTEST_M: Final = 25.0
"""Least radius (m) of a curve that a line follows over a gap."""
_TURN_DEG: Final = 4.0
"""1 σ of the direction of a short dash, times two (degrees)."""
_MISS_M, _MISS_PER_M = 0.12, 0.03  # Lateral offset of ends across a gap (m), and more per metre.


class Run(NamedTuple):
    """Pieces (k,) one after another, and which of them are reversed."""

    pieces: tuple[int, ...]
    turned: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Bands:
    """Straight or bent bands (n,): their ends, and the unit vectors that point out of the band there."""

    place: Float64
    """(n, 2, 2) begin and end in the map."""
    outward: Float64
    """(n, 2, 2)"""
    length_m: Float64
    width_m: Float64


def joined(bands: Bands, longest_gap_m: float) -> list[Run]:
    """Returns bands joined one after another, each in one run; with `longest_gap_m` of 0 only those that touch.

    The nearest ends are matched first; an end is used once, and no run closes to a ring.
    """
    count = len(bands.length_m)
    partner = np.full((count, 2), -1)
    group = list(range(count))

    def root(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    for _, a, b in _candidates(bands, longest_gap_m):
        i, j = root(a // 2), root(b // 2)
        if partner[a // 2, a % 2] < 0 and partner[b // 2, b % 2] < 0 and i != j:
            partner[a // 2, a % 2], partner[b // 2, b % 2] = b, a
            group[max(i, j)] = min(i, j)
    return _runs(partner)


def _runs(partner: Int64) -> list[Run]:
    """Returns chains of bands, from the first free end of each."""
    used, out = np.zeros(len(partner), np.bool_), []
    for start in range(len(partner)):
        if used[start]:
            continue
        band, side = start, 0
        while partner[band, side] >= 0:
            band, entered = divmod(int(partner[band, side]), 2)
            side = 1 - entered
        pieces, turned = [], []
        entry = side
        while True:
            used[band] = True
            pieces.append(band)
            turned.append(entry == 1)
            following = int(partner[band, 1 - entry])
            if following < 0:
                break
            band, entry = divmod(following, 2)
        out.append(Run(tuple(pieces), tuple(turned)))
    return out


def _candidates(bands: Bands, longest_gap_m: float) -> Sequence[tuple[float, int, int]]:
    """Returns pairs of ends that may belong together, best first: cost, and both ends (2 · band + 0 or 1)."""
    from scipy.spatial import cKDTree

    if not bands.length_m.size:
        return []
    places, outward = bands.place.reshape(-1, 2), bands.outward.reshape(-1, 2)
    pairs = cKDTree(places).query_pairs(max(longest_gap_m, _TOUCHING_M), output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    a, b = pairs[:, 0], pairs[:, 1]
    gap = places[b] - places[a]
    length = np.hypot(gap[:, 0], gap[:, 1])
    on = (outward[a] - outward[b]) / 2
    on /= np.maximum(np.hypot(on[:, 0], on[:, 1]), 1e-9)[:, None]
    forward = (gap * on).sum(axis=1)
    miss = np.abs(gap[:, 0] * on[:, 1] - gap[:, 1] * on[:, 0])
    turn = np.arccos(np.clip(-(outward[a] * outward[b]).sum(axis=1), -1.0, 1.0))
    shorter = np.minimum(bands.length_m[a // 2], bands.length_m[b // 2])
    longer = np.maximum(bands.length_m[a // 2], bands.length_m[b // 2])
    width = np.maximum(bands.width_m[a // 2], bands.width_m[b // 2])
    ratio = width / np.minimum(bands.width_m[a // 2], bands.width_m[b // 2])
    slack = np.radians(_TURN_DEG) * (1.0 + 0.5 / np.maximum(shorter, 0.1))
    touching = (length <= _TOUCHING_M) & (miss <= np.maximum(0.6 * width, _ASIDE_M)) & (turn <= 4 * slack)
    near = longest_gap_m >= length
    near &= (forward > 0) & (ratio <= 2.0) & (length <= np.maximum(_SHORT_GAP_M, _GAP_SHARE * longer))
    near &= (miss <= _MISS_M + _MISS_PER_M * length) & (turn <= slack + length / _TIGHTEST_M)
    good = np.flatnonzero(touching | near)
    cost = length + 10.0 * miss + 2.0 * (ratio - 1.0)
    return sorted((float(cost[k]), int(a[k]), int(b[k])) for k in good)
