"""Adaptive regularised smoothing of a gridded surface (Yu et al. 2007, section 3.2.3, eq. 10–12).

The smoothed surface F minimises the paper's energy

    E(F) = ‖W (F − P)‖² + λ_C Σᵢ ‖Iᵢ Cᵢ F‖² + λ_M ‖F − P_M‖²

where P are the measured heights, P_M their median and C₁ … C₅ the five high-pass filters of eq. 12. All filters act on
neighbouring cells, whatever their size: on 1 × 3 cm cells, "two cells" is 2 cm one way and 6 cm the other.

**P_M** is detail-preserving (``surface/detail_median.py``): with λ_M = 30 the surface follows it, and a 9 × 9 median
loses every crack.

**Iᵢ**. The paper does not define it; it cites Paik et al. (2001), "Adaptive regularized noise smoothing of dense range
image using directional Laplacian operators", whose text was not at hand. Its title, the names of the filters
(vertical, horizontal, 45°, 135°, all around) and the step β = 1/λ_M speak for one filter a cell: the Iᵢ are diagonal
matrices of 0 and 1 of which at most one is 1 at a cell, the direction in which the surface runs on. One filter at a
time keeps |Cᵢ(ω)|² ≤ 0.73, near the 0.58 that 1/λ_M allows with λ_C = 50 (0.36 for C₅, which acts on level ground); all
five together have 2.45, and the explicit iteration bursts. So here: C₅ (all around) where it finds no more than
`filter_sigmas` · σ in P_M; else the directional filter that finds least, if that is no more: it smooths along a
crack or an edge and not across; else none, because every filter would flatten what is there (even C₁ has two
neighbours across the line, and would take 6 % of the depth of a crack one cell wide). None either on a crack that only
a long strip shows: no cell of it finds much. The choice rests on P_M and
stays, so that E is one quadratic function.

**W** is the identity, but for heights farther than `outlier_sigmas` · σ from P_M: these are impulses, of which
1/(1 + λ_M) would be left (1 mm of 30 mm). With ``outlier_sigmas = inf`` it is the paper's energy to the letter.

**Descent**. The paper's iteration (11) is gradient descent, F ← F − β ∇E/2, and is kept, with a step that is proven.
∇E/2 = A F − b with A = W + λ_M + λ_C SᵀS, where a row of S is the chosen filter at that cell. Its absolute row sums are
at most 1; a column sums at most 1/2 + Σ over the 24 neighbours of the largest weight of any filter there = 38/21; so
‖S‖² ≤ ‖S‖₁ ‖S‖_∞ ≤ 38/21 whatever is chosen and measured, and λ_M ≤ A ≤ L = 1 + λ_M + λ_C 38/21. With β = 2 / (λ_M + L)
every step multiplies each component of the error by at most q = (L − λ_M) / (L + λ_M) < 1: E falls at every step,
until F is the minimum. It begins where the paper begins, at the mean of P and P_M with their weights.

**Convergence**. The paper stops when ‖F_l − F_(l−1)‖ / N is small. A test over the whole grid would make a cell depend
on what else is in the window, so the number of steps follows from the proof instead: the first n with qⁿ ≤ `tolerance`;
then ‖F_n − F*‖ ≤ tolerance ‖F_0 − F*‖. With the paper's weights q = 0.60: 14 steps for 1/1000.

**Windows**. A step sees four cells, the choice two, the median 88. A cell farther than :func:`halo_cells` from the
window's border (146 cells with the paper's weights) has the same bits in every window, because each cell's arithmetic
is the same and in the same order everywhere. Conjugate gradients would need fewer steps, but have no such halo: their
sums run over the whole window.

**Holes and borders**. A hole (NaN) stays one and is no neighbour: its differences are left out of the filters (a
filter is a sum of differences), its height out of the medians. The grid ends like a hole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float32, Float64, UInt8
from roadscan.core.errors import RoadscanError
from roadscan.surface.detail_median import REACH as MEDIAN_REACH
from roadscan.surface.detail_median import detail_median
from roadscan.surface.kernels.smoothing import REACH as STEP_REACH
from roadscan.surface.kernels.smoothing import choose_filters, descend
from roadscan.surface.settings import SurfaceSmoothing

FILTER_BOUND = 38.0 / 21.0
"""Upper bound of the spectral norm of SᵀS for one filter a cell, any cells missing."""
_FILTER_REACH = 2  # Reach of a filter (cells).


def smooth_surface(height_m: npt.ArrayLike, config: SurfaceSmoothing | None = None) -> Float64:
    """Returns smoothed heights of a grid.

    Parameters
    ----------
    height_m : (rows, columns) heights of cells (m), NaN where nothing was measured. Rows may run either way.

    Returns
    -------
    (rows, columns) float64 (m), NaN where `height_m` is.
    """
    return Smoothing.of(height_m, config or SurfaceSmoothing()).minimum()


def halo_cells(config: SurfaceSmoothing) -> int:
    """Returns the margin (cells) beyond which a cell does not depend on the window."""
    return STEP_REACH * steps(config) + MEDIAN_REACH + _FILTER_REACH


def steps(config: SurfaceSmoothing) -> int:
    """Returns the number of steps after which at most `tolerance` of the distance from the minimum is left."""
    low, high = _bounds(config)
    share = (high - low) / (high + low)
    return max(1, math.ceil(math.log(config.tolerance) / math.log(share)))


def _bounds(config: SurfaceSmoothing) -> tuple[float, float]:
    """Returns half the least and half the greatest curvature of the energy."""
    return config.median_weight, 1.0 + config.median_weight + config.curvature_weight * FILTER_BOUND


@dataclass(frozen=True)
class Smoothing:
    """The energy of one grid. All arrays are (rows, columns)."""

    height_m: Float64
    """P; NaN where nothing was measured."""
    median_m: Float64
    """P_M; NaN likewise."""
    weight: Float32
    """Diagonal of W: 1, or 0 where nothing was measured and on outliers."""
    chosen: UInt8
    """Active filter: 1 to 5, 0 for none."""
    own: Float32
    """Weight of the cell itself in that filter: 1/2 where all neighbours are measured."""
    residual_m: Float32
    """Iᵢ Cᵢ P_M (m)."""
    config: SurfaceSmoothing

    @classmethod
    def of(cls, height_m: npt.ArrayLike, config: SurfaceSmoothing) -> Smoothing:
        """Median, weights and filters of a grid (rows, columns) of heights (m), NaN where nothing was measured."""
        heights = np.ascontiguousarray(height_m, dtype=np.float64)
        if heights.ndim != 2 or np.isinf(heights).any():
            raise RoadscanError(
                f"heights of shape {heights.shape}, {int(np.isinf(heights).sum())} of them infinite",
                expected="a grid (rows, columns) of finite heights in metres",
                change="put NaN where nothing was measured",
            )
        found = detail_median(heights, config)
        median = found.height_m
        with np.errstate(invalid="ignore"):
            weight = np.abs(heights - median) <= config.outlier_sigmas * config.sigma_m
        chosen, own, residual = _choose(median, found.drawn, config.filter_sigmas * config.sigma_m)
        return cls(heights, median, weight.astype(np.float32), chosen, own, residual, config)

    def minimum(self) -> Float64:
        """Returns the surface after :func:`steps` steps (m)."""
        for correction in self.corrections(steps(self.config)):  # noqa: B007 - the last one is wanted
            pass
        return self.median_m + correction

    def corrections(self, count: int) -> Iterator[Float32]:
        """Yields F − P_M (m) at the start and after each of `count` steps; each array is overwritten two steps later.

        Float32 holds these millimetres to a nanometre; P_M stays in float64.
        """
        low, high = _bounds(self.config)
        step, median_weight = 2.0 / (low + high), self.config.median_weight
        measured = ~np.isnan(self.median_m)
        off = np.where(self.weight > 0, self.height_m - self.median_m, 0.0).astype(np.float32)
        pull = np.where(measured, step * (self.weight + median_weight), 0.0).astype(np.float32)
        push = np.where(measured, step * self.config.curvature_weight, 0.0).astype(np.float32)
        fields = (self.chosen.astype(np.float32), self.own, self.residual_m, pull, np.float32(step) * off, push)
        grids = [np.pad(field, STEP_REACH) for field in fields]
        before = np.pad(off / np.float32(1.0 + median_weight), STEP_REACH)
        after = np.zeros_like(before)
        ring = np.zeros((5, 7, before.shape[1] - 4), np.float32)
        inner = (slice(STEP_REACH, -STEP_REACH),) * 2
        yield before[inner]
        for _ in range(count):
            descend(before, *grids, ring, after)
            before, after = after, before
            yield before[inner]


def _choose(median_m: Float64, drawn: Bool, limit_m: float) -> tuple[UInt8, Float32, Float32]:
    measured = ~np.isnan(median_m)
    shape = median_m.shape
    chosen, own, residual = (np.empty(shape, np.float32) for _ in range(3))
    surface = np.pad(np.where(measured, median_m, 0.0), _FILTER_REACH)
    choose_filters(surface, np.pad(measured.astype(np.float64), _FILTER_REACH), limit_m, chosen, own, residual)
    for field in (chosen, own, residual):
        field[drawn] = 0.0
    return chosen.astype(np.uint8), own, residual
