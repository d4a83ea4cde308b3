"""The azimuths that a spinning lidar was told not to send: a gap of its view, inside which one packet a turn lies.

The blocks of that packet before and after the gap were fired a part of a turn apart, which neither its stamp nor its
length shows. A jump of the azimuth counts as the gap where other packets jump between the same azimuths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

Bool: TypeAlias = npt.NDArray[np.bool_]
Azimuths: TypeAlias = npt.NDArray[np.uint16]
Int32: TypeAlias = npt.NDArray[np.int32]
Int64: TypeAlias = npt.NDArray[np.int64]
Gap: TypeAlias = tuple[int, int]
"""Last azimuth before it and first one after it (0.01°)."""

TURN: Final = 36_000  # a full turn in 0.01°
_EDGE_CENTIDEG: Final = 100  # within which the azimuths beside a gap agree (0.01°)
_LEAST_JUMPS: Final = 2  # equal jumps that make a gap


def steps(azimuth: Azimuths) -> Int32:
    """Return the turn (n, blocks − 1) from block to block, 0.01°, within half a turn either way."""
    return np.asarray(np.mod(np.diff(azimuth.astype(np.int32), axis=1) + TURN // 2, TURN) - TURN // 2)


def gap_of(azimuth: Azimuths, odd: Bool) -> Gap | None:
    """Return the gap between whose azimuths most packets with one jump jump; None for fewer than two.

    Parameters
    ----------
    azimuth : (n, blocks), 0.01°.
    odd : (n, blocks − 1) steps that the head cannot have turned.
    """
    start, end = _edges(azimuth, odd)
    if start.size < _LEAST_JUMPS:
        return None
    alike = _near(start[:, None], start) & _near(end[:, None], end)
    best = int(alike.sum(axis=1).argmax())
    return (int(start[best]), int(end[best])) if alike[best].sum() >= _LEAST_JUMPS else None


def jumps(azimuth: Azimuths, odd: Bool, gap: Gap | None) -> Bool:
    """Return which packets (n,) jump elsewhere than over the gap."""
    jumping = np.asarray(odd.any(axis=1))
    if gap is not None:
        once = odd.sum(axis=1) == 1
        start, end = _edges(azimuth, odd)
        jumping[once] = ~(_near(start, np.array(gap[0])) & _near(end, np.array(gap[1])))
    return jumping


def waits_ns(azimuth: Azimuths, odd: Bool, rate: float, cycle_ns: int) -> Int64:
    """Return by how much each block (n, blocks) is later in its packet than without a gap.

    Parameters
    ----------
    rate : of the head (0.01°/ns).
    cycle_ns : time from block to block.
    """
    waits = np.zeros(azimuth.shape, dtype=np.int64)
    if odd.any() and rate:
        turned = np.mod(np.sign(rate) * np.diff(azimuth.astype(np.int64), axis=1), TURN)
        waits[:, 1:] = np.cumsum(np.where(odd, np.rint(turned / abs(rate)) - cycle_ns, 0), axis=1)
    return waits


def mean_rate(azimuth: Azimuths, epochs: Int64) -> float:
    """Return the head's rate (0.01°/ns, clockwise positive): the median over neighbouring packets, 0 where unknown."""
    passed_ns = np.diff(epochs)
    good = passed_ns > 0
    return float(np.median(steps(azimuth[:, :1].T)[0][good] / passed_ns[good])) if good.any() else 0.0


@dataclass
class Turns:
    """Numbers the turns of a head over the packets of a log, which come in pieces."""

    number: int = 0
    _azimuth: int = -1
    """Last azimuth (0.01°)."""

    def of(self, azimuth: Azimuths) -> Int32:
        """Return the turn (n, blocks) of each block: one more wherever the azimuth passes 360°, either way."""
        flat = azimuth.reshape(-1).astype(np.int32)
        before = flat[0] if self._azimuth < 0 else self._azimuth
        turns = self.number + np.cumsum(np.abs(np.diff(flat, prepend=before)) > TURN // 2)
        self.number, self._azimuth = int(turns[-1]), int(flat[-1])
        return np.asarray(turns.reshape(azimuth.shape), dtype=np.int32)


def _edges(azimuth: Azimuths, odd: Bool) -> tuple[Int32, Int32]:
    """Return the azimuths before and after the jump of each packet with one."""
    row = np.flatnonzero(odd.sum(axis=1) == 1)
    at = odd[row].argmax(axis=1)
    return azimuth[row, at].astype(np.int32), azimuth[row, at + 1].astype(np.int32)


def _near(a: Int32, b: Int32) -> Bool:
    return np.asarray(np.abs(np.mod(a - b + TURN // 2, TURN) - TURN // 2) <= _EDGE_CENTIDEG)
