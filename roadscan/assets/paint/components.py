"""Connected cells of paint, from the contrast of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.paint_levels import distinct_in_groups
from roadscan.assets.paint.contrast import CELL_M, Contrast
from roadscan.compute.array_types import Float64, Int64

SEED_CONTRAST: Final = 0.30  # Paint may start at cells of this contrast (share of the surface's brightness) …
SEED_SIGMAS: Final = 3.5
"""… that is also at least this many σ of the noise. Worn and thin paint has no more; what is paint is judged later."""
_EDGE_SHARE: Final = 0.4
"""Paint extends to where the contrast is this share of the greatest near it."""
_NEAR_M: Final = 0.2  # Distance within which that greatest contrast is sought (m).
_LEAST_CONTRAST: Final = 0.10  # Least contrast of paint.
_AROUND_M: Final = 0.3
"""Returns within this distance of its cells (m) belong to a component's surroundings."""
FEWEST_RETURNS: Final = 8  # A component needs this many returns …
FEWEST_LINES: Final = 3  # … on this many scan lines.
EVIDENCE_SIGMAS: Final = 3.0
"""Least mean contrast of a component, in units of its standard deviation on a bare surface: less is chance."""
_LINE_SIGMA: Final = 0.15
"""1 σ of the contrast of a whole scan line on a bare surface: errors of its gain."""


@dataclass(frozen=True, eq=False)
class Component:
    """Connected cells (c,) of paint, with the ground returns on and around them."""

    cell: Int64
    """(c,) cells of the window: row · columns + column."""
    cell_x_m: Float64
    cell_y_m: Float64
    """(c,) middles of the cells, from the corner of the scene's returns."""
    near: Int64
    """(n,) indices of the contrast's returns on or around the cells."""
    inside: npt.NDArray[np.bool_]
    """(n,) mask of those that lie in the cells."""
    evidence_sigma: float
    probability: float = np.nan
    """That it is paint; NaN where it was not judged."""

    def part(self, cells: npt.NDArray[np.bool_], returns: npt.NDArray[np.bool_]) -> Component:
        """Returns the component of some of its cells (c,) and returns (n,)."""
        return Component(
            self.cell[cells], self.cell_x_m[cells], self.cell_y_m[cells], self.near[returns], self.inside[returns],
            self.evidence_sigma, self.probability,
        )  # fmt: skip


def components_of(found: Contrast) -> list[Component]:
    """Returns all components of paint in the window, in the order of their first cell."""
    from scipy import ndimage

    mask, seeds = _painted(found)
    label, count = ndimage.label(mask, structure=np.ones((3, 3), np.int8))
    if count == 0:
        return []
    columns = mask.shape[1]
    with_seed = np.zeros(count + 1, np.bool_)
    with_seed[np.unique(label[seeds])] = True
    with_seed[0] = False
    label = np.where(with_seed[label], label, 0)
    own = label.ravel()[found.cell]
    evidence, lines = _evidence(found, own, count)
    enough = (
        (evidence >= EVIDENCE_SIGMAS)
        & (lines >= FEWEST_LINES)
        & (np.bincount(own, minlength=count + 1) >= FEWEST_RETURNS)
    )
    enough[0] = False
    label = np.where(enough[label], label, 0)
    if not label.any():
        return []
    around = _nearest(label)[found.cell // columns, found.cell % columns]
    cells = np.flatnonzero(label)
    cells = cells[np.argsort(label.ravel()[cells], kind="stable")]
    returns = np.flatnonzero(around)
    returns = returns[np.argsort(around[returns], kind="stable")]
    numbers = np.unique(label.ravel()[cells])
    cell_edges = np.searchsorted(label.ravel()[cells], np.append(numbers, count + 1))
    return_edges = np.searchsorted(around[returns], np.append(numbers, count + 1))
    x, y = found.box.x_min_m + (cells % columns + 0.5) * CELL_M, found.box.y_min_m + (cells // columns + 0.5) * CELL_M
    out = []
    for i, number in enumerate(numbers):
        c, r = slice(cell_edges[i], cell_edges[i + 1]), slice(return_edges[i], return_edges[i + 1])
        near = returns[r]
        inside = label.ravel()[found.cell[near]] == number
        out.append(Component(cells[c], x[c], y[c], near, inside, float(evidence[number])))
    return out


def _painted(found: Contrast) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Cells that may be paint (rows, columns), and those of them that paint begins at."""
    from roadscan.core.extras import cv2

    size = 2 * round(_NEAR_M / CELL_M) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    highest = cv2.dilate(found.mean, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    mask = found.mean >= np.maximum(_EDGE_SHARE * highest, _LEAST_CONTRAST)
    seeds = (found.mean >= SEED_CONTRAST) & (found.mean >= SEED_SIGMAS * found.sigma)
    return np.asarray(mask), np.asarray(mask & seeds)


def _evidence(found: Contrast, own: Int64, count: int) -> tuple[Float64, Int64]:
    """Mean contrast of each label's returns, in units of its standard deviation; scan lines."""
    returns = np.maximum(np.bincount(own, minlength=count + 1), 1)
    mean = np.bincount(own, weights=found.contrast, minlength=count + 1) / returns
    variance = np.bincount(own, weights=found.noise**2, minlength=count + 1) / returns**2
    lines = np.empty(count + 1, np.int64)
    distinct_in_groups(*in_bins(np.where(own > 0, own, -1), count + 1), found.line, lines)
    out: Float64 = mean / np.sqrt(variance + _LINE_SIGMA**2 / np.maximum(lines, 1))
    return out, lines


def _nearest(label: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Returns the label of the nearest labelled cell within reach, else 0."""
    from scipy import ndimage

    reach = math.ceil(_AROUND_M / CELL_M) + 1
    rows, columns = (np.flatnonzero(label.any(axis=axis)) for axis in (1, 0))
    part = tuple(slice(max(int(one[0]) - reach, 0), int(one[-1]) + reach + 1) for one in (rows, columns))
    near = label[part]
    away, at = ndimage.distance_transform_edt(near == 0, return_indices=True)
    out = np.zeros_like(label)
    out[part] = np.where(away <= _AROUND_M / CELL_M, near[tuple(at)], 0)
    return out
