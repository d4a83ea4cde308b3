"""The tiles that readings are counted into, and the attributes of readings besides their position."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class ActiveTiles(NamedTuple):
    """Active tiles in a box of tiles; each has a row in the arrays of (a, …)."""

    rows: npt.NDArray[np.int32]
    """(rows, columns) of the box: the row of each tile, −1 for tiles that are not active."""
    corner_quanta: tuple[int, int]
    """South-west corner of the box."""
    cell_quanta: int
    """Edge of a cell."""
    edge: int
    """Cells along a tile's edge."""
    groups: npt.NDArray[np.int32]
    """(a, edge · ⌈edge / 16⌉) pool element of each group of sixteen cells, −1 where it has none."""
    ends: npt.NDArray[np.int32]
    """(a, edge) position for the next reading in each row's bucket (``row_buckets.Buckets``)."""
    spans: npt.NDArray[np.int64]
    """(a, 2) first and last epoch of the readings, GPS ns; in/out."""
    sigmas: npt.NDArray[np.float64]
    """(a, 2) largest horizontal and vertical 1 σ of the poses (m); in/out."""


class Measured(NamedTuple):
    """Attributes of readings, or of profiles, besides their position."""

    epochs: npt.NDArray[np.int64]
    """(n,) GPS ns of the measurement."""
    passes: npt.NDArray[np.int32]
    """(n,) index of the pass among the accumulator's, −1 for none."""
    intensity: npt.NDArray[np.unsignedinteger]
    """(n,), for profiles (n, m)."""
    gain: np.uint32
    """Factor on the intensity; the product takes at most 16 bits."""
    interval_sigmas_m: npt.NDArray[np.float64]
    """(intervals of the trajectory, 2) largest horizontal and vertical 1 σ of the poses."""
