"""Finds runs of true flags."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def runs_of(flags: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return first index and one past the last (r, 2) of each run of true flags (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2).astype(np.int64)
