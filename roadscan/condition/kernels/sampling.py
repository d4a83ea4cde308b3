"""Heights and mean intensities of the road at given places, from the cells of the tiles around.

Cells are visited by row and column of the map, whatever their tiles, so that a height has the same bits for any set of
tiles that contains its cells.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.arrays import SIGMA_OF_MAD
from roadscan.compute.kernel_options import inlined, inner, kernel
from roadscan.compute.kernels.arrays import median

MOST_CELLS = 4096
"""Most cells of a window that are used; of a denser window those of its first rows."""
ENOUGH_CELLS = 100.0
"""In windows of four times as many cells and more, one in two rows and columns is used, and so on."""
OUTLIER = 3.0 * SIGMA_OF_MAD
"""Cells this many median absolute deviations from the first surface are left out of the second."""
LEAST_SCALE_M = 0.0005
"""Least median absolute deviation that is assumed (m)."""
GROSS_M = 0.01
"""The same before there is a surface: deviations count from the window's median height (m)."""
TERMS = 4  # Terms of the local surface.
LEAST_FREEDOM = 0.05
"""Least share of a window's weights that its surface leaves free: with less, residuals are rounding errors."""


class CellTable(NamedTuple):
    """Cells of some tiles, tile after tile, each sorted by row and column."""

    slot: npt.NDArray[np.int32]
    """(rows, columns) index of the tile here, −1 for none."""
    first: npt.NDArray[np.int64]
    """(2,) row and column on the map of the tile at slot[0, 0]."""
    row_start: npt.NDArray[np.int64]
    """(tiles, edge + 1) first cell of each row of a tile."""
    column: npt.NDArray[np.int32]
    """(n,) column of the cell in its tile."""
    height: npt.NDArray[np.float64]
    """(n,) height (m)."""
    noise: npt.NDArray[np.float32]
    """(n,) sum of the squared deviations of the cell's readings (m²), NaN where it is not known."""
    readings: npt.NDArray[np.float32]
    """(n,) number of readings."""
    intensity: npt.NDArray[np.float32]
    """(n,) mean intensity of the readings, NaN where there is none."""
    passes: npt.NDArray[np.float32]
    """(n,) number of drives with readings in it."""
    cell: npt.NDArray[np.float64]
    """(2,) edges of a cell, east and north (m)."""
    edge: npt.NDArray[np.int64]
    """(2,) cells of a tile along east and north."""


class Cells(NamedTuple):
    """Memory for the cells of a window."""

    along: npt.NDArray[np.float64]
    across: npt.NDArray[np.float64]
    height: npt.NDArray[np.float64]
    weight: npt.NDArray[np.float64]
    noise: npt.NDArray[np.float64]
    readings: npt.NDArray[np.float64]
    at: npt.NDArray[np.int64]
    """Their indices in the table."""


@inlined
def first_from(column, low, high, wanted):
    """Return the first index in column[low:high] (ascending) whose value is not below `wanted`."""
    while low < high:
        middle = (low + high) // 2
        if column[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def gather(table, place, half_along, half_across, stride, found):
    """Collect the cells within a window that lies along a direction; return their number.

    place : (4,) float64, easting, northing (m), and the unit vector of the direction.
    half_along, half_across : float64, half of the window's extents (m).
    stride : int64, of rows and columns of the map one in so many is looked at; found : Cells, out.
    """
    x, y, ux, uy = place[0], place[1], place[2], place[3]
    reach_x = abs(ux) * half_along + abs(uy) * half_across
    reach_y = abs(uy) * half_along + abs(ux) * half_across
    east, north = table.cell[0], table.cell[1]
    edge_x, edge_y = table.edge[0], table.edge[1]
    count = 0
    column_0 = math.ceil((x - reach_x) / east - 0.5)
    column_1 = math.floor((x + reach_x) / east - 0.5)
    for row in range(math.ceil((y - reach_y) / north - 0.5), math.floor((y + reach_y) / north - 0.5) + 1):
        if row % stride != 0:
            continue
        tile_row = row // edge_y
        r = tile_row - table.first[0]
        if r < 0 or r >= table.slot.shape[0]:
            continue
        dy = (row + 0.5) * north - y
        for tile_column in range(column_0 // edge_x, column_1 // edge_x + 1):
            c = tile_column - table.first[1]
            if c < 0 or c >= table.slot.shape[1] or table.slot[r, c] < 0:
                continue
            starts = table.row_start[table.slot[r, c]]
            own = row - tile_row * edge_y
            base = tile_column * edge_x
            end = starts[own + 1]
            k = first_from(table.column, starts[own], end, column_0 - base)
            while k < end and base + table.column[k] <= column_1:
                dx = (base + table.column[k] + 0.5) * east - x
                s, o = dx * ux + dy * uy, dx * uy - dy * ux
                wanted = (base + table.column[k]) % stride == 0
                if wanted and abs(s) < half_along and abs(o) < half_across and count < MOST_CELLS:
                    found.along[count] = s / half_along
                    found.across[count] = o / half_across
                    found.height[count] = table.height[k]
                    found.weight[count] = (1.0 - abs(s) / half_along) * (1.0 - abs(o) / half_across)
                    found.noise[count] = table.noise[k]
                    found.readings[count] = table.readings[k]
                    found.at[count] = k
                    count += 1
                k += 1
    return count


@inlined
def fill_terms(found, k, terms):
    """Compute the terms of the local surface at cell k."""
    terms[0] = 1.0
    terms[1] = found.along[k]
    terms[2] = found.across[k]
    terms[3] = found.across[k] * found.across[k]


@kernel
def factorise(normal, size, factor):
    """Compute the Cholesky factor of the leading part of a matrix; return the number of independent rows.

    normal, factor : (4, 4) float64; size : rows wanted. A row that the ones before it nearly say is not sound.
    """
    for i in range(size):
        for j in range(i + 1):
            value = normal[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if value <= 1e-3 * normal[i, i] or value <= 0.0:
                    return i
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    return size


@inlined
def solve(factor, size, right, out):
    """Solve the factorised system for `right`."""
    for i in range(size):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * out[k]
        out[i] = value / factor[i, i]
    for i in range(size - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, size):
            value -= factor[k, i] * out[k]
        out[i] = value / factor[i, i]


@inner
def fit(found, count, wanted, base, out):
    """Fit a local surface to the cells of a window; return the number of terms that are determined.

    found : Cells; count : how many; wanted : 3 for a plane, 4 for one that bends across.
    base : float64, height that the cells' count from (m).
    out : (4,) float64, out: height in the window's middle above base (m), its slopes along and across, its bend.
    """
    normal, factor = np.zeros((TERMS, TERMS)), np.zeros((TERMS, TERMS))
    right, terms = np.zeros(TERMS), np.zeros(TERMS)
    for k in range(count):
        w = found.weight[k]
        if w <= 0.0:
            continue
        fill_terms(found, k, terms)
        for i in range(wanted):
            right[i] += w * terms[i] * (found.height[k] - base)
            for j in range(i + 1):
                normal[i, j] += w * terms[i] * terms[j]
    size = factorise(normal, wanted, factor)
    out[:] = 0.0
    if size == 0:
        return 0
    solve(factor, size, right, out)
    return size


@inner
def residuals(found, count, base, surface, out):
    """Compute distances of a window's cells from a fitted surface, out (count,) float64 (m)."""
    terms = np.zeros(TERMS)
    for k in range(count):
        fill_terms(found, k, terms)
        value = found.height[k] - base
        for i in range(TERMS):
            value -= surface[i] * terms[i]
        out[k] = value


@inner
def sigma(found, count, size, away, told):
    """Return the standard deviation of the height in the middle (m), from the scatter of cells about a surface.

    Cells are taken as measurements of one variance. Residuals of a weighted fit X, with A = (X'WX)⁻¹, have
    E[Σ w r²] = σ² (Σ w − tr(A X'W²X)), whatever the weights. How the readings scatter within a cell says nothing of it:
    the cell's height is robust, and one wrong reading makes this scatter many times larger.
    size : terms of the surface that the height is of; away : (count,) distances (m) from one of `told` terms.
    """
    squares, weights = 0.0, 0.0
    normal, factor, squared = np.zeros((TERMS, TERMS)), np.zeros((TERMS, TERMS)), np.zeros((TERMS, TERMS))
    terms, column, row = np.zeros(TERMS), np.zeros(TERMS), np.zeros(TERMS)
    for k in range(count):
        w = found.weight[k]
        if w <= 0.0:
            continue
        fill_terms(found, k, terms)
        weights += w
        squares += w * away[k] * away[k]
        for i in range(told):
            for j in range(i + 1):
                normal[i, j] += w * terms[i] * terms[j]
                squared[i, j] += w * w * terms[i] * terms[j]
                squared[j, i] = squared[i, j]
    if factorise(normal, told, factor) < told:
        return np.nan
    freedom = weights
    for j in range(told):
        for i in range(TERMS):
            column[i] = squared[i, j]
        solve(factor, told, column, row)
        freedom -= row[j]
    if freedom < LEAST_FREEDOM * weights:
        return np.nan
    column[:] = 0.0
    column[0] = 1.0
    if factorise(normal, size, factor) < size:
        return np.nan
    solve(factor, size, column, row)
    total = 0.0
    for i in range(size):
        for j in range(size):
            total += row[i] * row[j] * squared[i, j]
    return math.sqrt(total * squares / freedom)


@kernel
def sample(table, places, half_along, half_across, bend, out):
    """Compute heights of the road at places, each from the cells of a window along a direction.

    A weighted surface (weights fall linearly to the window's sides) is fitted twice, the second time without the cells
    that lie far from the first. NaN where the window holds too little, or its cells lie on one side of the place.

    Parameters
    ----------
    table : CellTable.
    places : (n, 4) float64, easting, northing (m), and the unit vector along the road.
    half_along, half_across : float64, half of a window's extents (m).
    bend : whether the surface may bend across the road.
    out : (n, 3) float64, out: height (m), its standard deviation from how the cells scatter (m, NaN where it is not
        known), and the share of the window that holds cells.
    """
    room = np.empty((6, MOST_CELLS))
    found = Cells(room[0], room[1], room[2], room[3], room[4], room[5], np.empty(MOST_CELLS, np.int64))
    surface, away, work = np.zeros(TERMS), np.empty(MOST_CELLS), np.empty(MOST_CELLS)
    wanted = 4 if bend else 3
    window = 4.0 * half_along * half_across / (table.cell[0] * table.cell[1])
    stride = max(int(math.sqrt(window / ENOUGH_CELLS)), 1)
    for i in range(len(places)):
        out[i, 0], out[i, 1], out[i, 2] = np.nan, np.nan, 0.0
        count = gather(table, places[i], half_along, half_across, stride, found)
        out[i, 2] = min(count * stride * stride / window, 1.0)
        if count < 3 or not central(found, count):
            continue
        for k in range(count):
            work[k] = found.height[k]
        base = median(work[:count])
        for k in range(count):
            away[k] = found.height[k] - base
        leave_out(found, count, away, GROSS_M, work)
        if fit(found, count, wanted, base, surface) < 3:
            continue
        residuals(found, count, base, surface, away)
        leave_out(found, count, away, LEAST_SCALE_M, work)
        size = fit(found, count, wanted, base, surface)
        if size < 3:
            continue
        out[i, 0] = base + surface[0]
        # A rut bends across the road even if the surface may not: this bend is no error.
        told = fit(found, count, TERMS, base, surface)
        residuals(found, count, base, surface, away)
        out[i, 1] = sigma(found, count, size, away, told)


@inlined
def central(found, count):
    """Return whether a window's cells lie around its middle, and not on one side of it."""
    total, s, o = 0.0, 0.0, 0.0
    for k in range(count):
        total += found.weight[k]
        s += found.weight[k] * found.along[k]
        o += found.weight[k] * found.across[k]
    return total > 0.0 and abs(s) < 0.35 * total and abs(o) < 0.35 * total


@inner
def leave_out(found, count, away, least, work):
    """Set the weight of cells far from the surface to 0; median distances count as at least `least` (m)."""
    for k in range(count):
        work[k] = abs(away[k])
    scale = max(median(work[:count]), least)
    for k in range(count):
        if abs(away[k]) > OUTLIER * scale:
            found.weight[k] = 0.0


@kernel
def mean_intensities(table, places, half_along, half_across, out):
    """Compute mean intensities of the cells around places.

    Parameters
    ----------
    table : CellTable; places : (n, 4) float64, easting, northing (m), and the unit vector along the road.
    half_along, half_across : float64, half of a window's extents (m).
    out : (n,) float64, out: mean over the cells of the window that have an intensity; NaN without one.
    """
    room = np.empty((6, MOST_CELLS))
    found = Cells(room[0], room[1], room[2], room[3], room[4], room[5], np.empty(MOST_CELLS, np.int64))
    window = 4.0 * half_along * half_across / (table.cell[0] * table.cell[1])
    stride = max(math.ceil(math.sqrt(window / (0.9 * MOST_CELLS))), 1)
    for i in range(len(places)):
        count = gather(table, places[i], half_along, half_across, stride, found)
        total, lit = 0.0, 0.0
        for k in range(count):
            value = table.intensity[found.at[k]]
            if not np.isnan(value):
                total += value
                lit += 1.0
        out[i] = total / lit if lit > 0.0 else np.nan
