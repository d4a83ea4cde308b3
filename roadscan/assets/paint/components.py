"""Contrast of ground returns to the surface around them, and connected cells of paint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.classes import PERSON, VEHICLE
from roadscan.assets.kernels.paint_levels import (
    contrasts,
    distinct_in_groups,
    paint_levels,
    paint_sums,
    scan_lines,
    seen_on_ground,
)
from roadscan.assets.scene import Box, Returns, Scene
from roadscan.compute.array_types import Bool, Float32, Float64, Int64
from roadscan.compute.kernel_options import read_only

CELL_M: Final = 0.05
"""Edge of a cell of paint (m); cells lie on a grid of the map."""
ON_GROUND_M: Final = 0.1  # Returns within this height of the ground (m) are on it.
_LEVEL_CELL_M: Final = 0.5  # Edge of a cell of brightness (m).
_LEVEL_HALF: Final = 2
"""Half width of the surroundings (cells): they are 2.5 m wide."""
_USUAL_STEP, _USUAL_SIZE = 3, 9
"""The usual brightness is a median over 13 m, of every third cell."""
_DARKEST: Final = 0.9
"""Surroundings darker than this share of the usual brightness (fresh bitumen, water) count as this bright."""
ROUGHEST_M: Final = 0.03  # Ground that scatters more (m) is not searched for paint.
_ROUGH_M: Final = 0.12
"""Weights of the height's scatter about its mean fall within this distance (m)."""
SMOOTH_M: Final = 0.06
"""1 σ of the weights of the returns around a cell (m)."""
_FEWEST_PER_M2: Final = 40.0
"""With fewer returns (1/m²), only few would hit a stripe."""
_FLATTEST: Final = 0.1
"""Least sine of the angle between beam and road: below it a beam's footprint is ten times as long as it is wide."""
_LINE_NS: Final = 20_000_000  # A scan line is what one laser sees within this time (ns).
_LEAST_NOISE: Final = 0.06  # Least 1 σ of a return's contrast.
_CLIP: Final = (-0.5, 2.0)
"""Bounds of contrasts: glints are clipped to these."""


@dataclass(frozen=True, eq=False)
class Contrast:
    """Ground returns (n,) of a scene with their contrast, and rasters (rows, columns) of cells of the window."""

    rows: Int64
    """(n,) rows of the scene's returns."""
    x_m: Float64
    y_m: Float64
    height_m: Float64
    contrast: Float64
    """(n,) intensity over that of the surface around, less 1; 0 on the surface, 1 where it is twice as bright."""
    noise: Float64
    """(n,) 1 σ of the contrast of returns on the surface around."""
    line: Int64
    """(n,) number of the scan line: what one laser saw within 20 ms."""
    cell: Int64
    """(n,) cell of each return: row · columns + column."""
    box: Box
    """The extent of the scene, from the corner of its returns."""
    mean: Float32
    """Mean contrast, weighted over the returns around each cell; 0 where there are none."""
    sigma: Float32
    """Its standard deviation; infinite where there are none."""
    dense_cells: int = 0
    """Number of cells in which enough returns lie on the ground."""
    rough_cells: int = 0
    """Those of them that scatter by too much: no paint is sought there."""


def contrast_of(scene: Scene) -> Contrast:
    """Returns the contrast of a scene's returns that lie on the ground and on no vehicle or person."""
    found = scene.returns
    window = scene.extent
    rows = _on_surface(scene, window)
    x, y, intensity = found.x_m[rows], found.y_m[rows], found.intensity[rows].astype(np.float64)
    contrast, noise = np.empty(rows.size), np.empty(rows.size)
    grid = (float(window.x_min_m), float(window.y_min_m), _LEVEL_CELL_M)
    contrasts(x, y, intensity, grid, *_levels(x, y, intensity, window), (*_CLIP, _LEAST_NOISE), contrast, noise)
    shape = round((window.y_max_m - window.y_min_m) / CELL_M), round((window.x_max_m - window.x_min_m) / CELL_M)
    cell = np.maximum(cells_of(x, y, (grid[0], grid[1], CELL_M), shape), 0).astype(np.int64)
    mean, sigma, counts = _means(cell, contrast, noise, scene.above_ground_m[rows], shape, ROUGHEST_M)
    heights = found.height_m[rows]
    return Contrast(rows, x, y, heights, contrast, noise, _lines(found, rows), cell, window, mean, sigma, *counts)


def _on_surface(scene: Scene, box: Box) -> Int64:
    """Returns rows of the returns on the ground and on no road user, without those that a beam met at a small angle,
    where it is known where the sensor stood.
    """
    r, looked_at = scene.returns, np.ones(256, np.bool_)
    looked_at[[VEHICLE, PERSON]] = False
    rows = np.empty(len(r), np.int64)
    place = tuple(map(read_only, (r.x_m, r.y_m, r.height_m)))
    sensor = tuple(map(read_only, (r.sensor_x_m, r.sensor_y_m, r.sensor_height_m)))
    limits = (ON_GROUND_M, _FLATTEST)
    count = seen_on_ground(place, sensor, scene.above_ground_m, looked_at[scene.classes], limits, tuple(box), rows)
    return np.asarray(rows[:count].copy())


def _lines(found: Returns, rows: Int64) -> Int64:
    """Returns the number (n,) of the scan line of each return at `rows`."""
    out = np.empty(rows.size, np.int64)
    scan_lines(rows, read_only(found.epoch_gps_ns), found.sensor, found.laser, _LINE_NS, out)
    return out


def _levels(x: Float64, y: Float64, intensity: Float64, window: Box) -> tuple[Float64, Float64]:
    """Brightness (rows, columns) of the surface around cells, and what 84 % of the returns on it do not exceed."""
    from scipy import ndimage

    edge = _LEVEL_CELL_M
    sides = window.y_max_m - window.y_min_m, window.x_max_m - window.x_min_m
    shape = int(np.ceil(sides[0] / edge)), int(np.ceil(sides[1] / edge))
    own = cells_of(x, y, (float(window.x_min_m), float(window.y_min_m), edge), shape)
    first, order = in_bins(own, shape[0] * shape[1])
    level, upper = np.empty(shape), np.empty(shape)
    paint_levels(intensity[order], first, _LEVEL_HALF, level, upper)
    known = np.isfinite(level)
    if not known.any():
        return np.ones(shape), np.ones(shape)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = level[tuple(nearest)]
    usual = ndimage.median_filter(filled[::_USUAL_STEP, ::_USUAL_STEP], _USUAL_SIZE, mode="nearest")
    usual = np.maximum(usual.repeat(_USUAL_STEP, 0).repeat(_USUAL_STEP, 1)[: shape[0], : shape[1]], 1e-6)
    return np.maximum(filled, _DARKEST * usual), upper[tuple(nearest)]


def _means(
    cell: Int64, contrast: Float64, noise: Float64, height: Float32, shape: tuple[int, int], roughest_m: float
) -> tuple[Float32, Float32, tuple[int, int]]:
    """Returns the weighted mean of the contrast around each cell, and its standard deviation; none where it is rougher.

    The last are the numbers of cells with enough returns, and of rough ones among them.
    """
    from roadscan.core.extras import cv2

    sums = np.zeros((shape[0] * shape[1], 5), np.float32)
    paint_sums(cell, contrast, noise, height, sums)
    number, contrasted, noisy, high, squares = map(np.asarray, cv2.split(sums.reshape(*shape, 5)))

    def raster(counts: Float32, sigma_m: float) -> Float32:
        reach = 2 * int(np.ceil(3 * sigma_m / CELL_M)) + 1
        blurred = cv2.GaussianBlur(counts, (reach, reach), sigma_m / CELL_M, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred, np.float32)

    weight = raster(number, SMOOTH_M)
    area = 4.0 * np.pi * (SMOOTH_M / CELL_M) ** 2
    known = weight >= _FEWEST_PER_M2 * CELL_M**2
    dense = int(np.count_nonzero(known))
    near = np.maximum(raster(number, _ROUGH_M), 1e-9)
    middle = raster(high, _ROUGH_M) / near
    known &= raster(squares, _ROUGH_M) / near - middle**2 <= roughest_m**2
    mean = np.where(known, raster(contrasted, SMOOTH_M) / np.maximum(weight, 1e-9), 0.0)
    variance = raster(noisy, SMOOTH_M / np.sqrt(2.0)) / area / np.maximum(weight, 1e-9) ** 2
    sigma = np.where(known, np.sqrt(variance), np.inf).astype(np.float32)
    return mean.astype(np.float32), sigma, (dense, dense - int(np.count_nonzero(known)))


SEED_CONTRAST: Final = 0.30  # Paint may start at cells of this contrast (share of the surface's brightness) …
SEED_SIGMAS: Final = 3.5
"""… that is also at least this many σ of the noise. Worn and thin paint has no more; what is paint is judged later."""
_EDGE_SHARE: Final = 0.4
"""Paint extends to where the contrast is this share of the greatest near it."""
_NEAR_M: Final = 0.2  # Distance within which that greatest contrast is sought (m).
_LEAST_CONTRAST: Final = 0.10  # Least contrast of paint.
AROUND_M: Final = 0.3
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
    inside: Bool
    """(n,) mask of those that lie in the cells."""
    evidence_sigma: float
    probability: float = np.nan
    """That it is paint; NaN where it was not judged."""

    def part(self, cells: Bool, returns: Bool) -> Component:
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


def _painted(found: Contrast) -> tuple[Bool, Bool]:
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

    reach = math.ceil(AROUND_M / CELL_M) + 1
    rows, columns = (np.flatnonzero(label.any(axis=axis)) for axis in (1, 0))
    part = tuple(slice(max(int(one[0]) - reach, 0), int(one[-1]) + reach + 1) for one in (rows, columns))
    near = label[part]
    away, at = ndimage.distance_transform_edt(near == 0, return_indices=True)
    out = np.zeros_like(label)
    out[part] = np.where(away <= AROUND_M / CELL_M, near[tuple(at)], 0)
    return out
