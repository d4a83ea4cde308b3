"""Averages heights of points in the cells of a curved grid."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.kernels.curved_grid import accumulate_curved
from roadscan.compute.reference_line import ReferenceLine
from roadscan.core.grid import QUANTUM_M


@dataclass(frozen=True, eq=False)
class CurvedHeights:
    """Sums of heights beside a reference line; a point counts at the nearest node.

    Nodes stand at the line's vertices, `v_step_m` apart from `v_first_m` (right, negative) to the left.
    """

    line: ReferenceLine
    v_first_m: float
    v_step_m: float
    columns: int
    sums: Int64 = field(init=False)
    """(rows, columns) sums of heights, quanta."""
    counts: npt.NDArray[np.int32] = field(init=False)
    """(rows, columns) points per node."""

    def __post_init__(self) -> None:
        shape = (len(self.line.vertices_m), self.columns)
        object.__setattr__(self, "sums", np.zeros(shape, np.int64))
        object.__setattr__(self, "counts", np.zeros(shape, np.int32))

    def add(self, x_m: Float64, y_m: Float64, height_quanta: npt.NDArray[np.int32], steps: Int64) -> int:
        """Add points (n,); return how many lie beside the grid.

        Parameters
        ----------
        steps : (n,) a step of the line near each point; where the line crosses itself it says which branch is meant.
        """
        line = self.line
        return int(
            accumulate_curved(
                x_m, y_m, height_quanta, steps, line.vertices_m, line.left, line.step_m, self.v_first_m, self.v_step_m,
                self.sums, self.counts,
            )
        )  # fmt: skip

    def heights_m(self) -> Float64:
        """Return (rows, columns) mean height of each node; NaN where no point lies."""
        mean = np.full(self.sums.shape, np.nan)
        np.divide(self.sums * QUANTUM_M, self.counts, out=mean, where=self.counts > 0)
        return mean


def fill_holes(heights_m: Float64, v_nodes: int, u_nodes: int) -> tuple[Float64, int]:
    """Fill small holes by linear interpolation, first across the road, then along it.

    Parameters
    ----------
    heights_m : (rows, columns), NaN in holes.
    v_nodes, u_nodes : most nodes that a hole may span across and along; holes at an edge stay.

    Returns
    -------
    The heights, and how many nodes were filled.
    """
    across = _filled(heights_m, v_nodes)
    filled = _filled(across.T, u_nodes).T
    return np.ascontiguousarray(filled), int(np.isnan(heights_m).sum() - np.isnan(filled).sum())


def _filled(values: Float64, most: int) -> Float64:
    """Return values with holes of at most `most` neighbours along the second axis filled by linear interpolation."""
    known = ~np.isnan(values)
    where = np.arange(values.shape[1])
    before = np.maximum.accumulate(np.where(known, where, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, where, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    gap = ~known & (before >= 0) & (after < values.shape[1]) & (after - before - 1 <= most)
    row, column = np.nonzero(gap)
    left, right = before[gap], after[gap]
    part = (column - left) / (right - left)
    out = values.copy()
    out[gap] = (1 - part) * values[row, left] + part * values[row, right]
    return out


def inner_holes(heights_m: Float64) -> int:
    """Return how many nodes without a height lie between others of their row, including rows without any."""
    known = ~np.isnan(heights_m)
    begun = np.logical_or.accumulate(known, axis=1)
    goes_on = np.logical_or.accumulate(known[:, ::-1], axis=1)[:, ::-1]
    return int((begun & goes_on & ~known).sum()) + int((~known.any(axis=1)).sum())
