"""Canonical order of a tile's points: equal readings give equal files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt


def canonical_order(
    source: npt.NDArray[np.integer[Any]],
    epoch_gps_ns: npt.NDArray[np.int64],
    whole_profiles: npt.NDArray[np.bool_],
    content: Callable[[], list[npt.NDArray[Any]]],
) -> npt.NDArray[np.int64] | None:
    """Return the order by source, epoch and, where epochs repeat, content; None where the points are in order.

    Parameters
    ----------
    source : (n,) number of the sensor and run, ascending as loaded.
    epoch_gps_ns : (n,).
    whole_profiles : (n,) True where equal epochs mean readings of one profile, already in their order.
    content : gives arrays (n, …) that distinguish points of equal epoch, called only where there are any;
        points equal in all of them are interchangeable.
    """
    same = source[1:] == source[:-1]
    step = np.diff(epoch_gps_ns)
    falls = same & (step < 0)
    tied = same & (step == 0) & ~whole_profiles[1:]
    if not falls.any() and not tied.any():
        return None
    keys = [k for tie in reversed(content()) for k in (tie.T[::-1] if tie.ndim == 2 else [tie])]
    order: npt.NDArray[np.int64] = np.lexsort([*keys, epoch_gps_ns, source])
    return order
