"""Columns above the cells of a raster, and cells along the path of a vehicle."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel

LEVELS = 32
"""Bits of a column: heights above ground in steps."""
THINGS, GROUND, HIGH = range(3)
"""Kinds of what is seen in a slot of time."""


@kernel
def distinct(epoch, step, out):
    """Write each step of time that differs from the one before to out (most,) int64; returns how many, at most `most`.

    epoch : (n,) int64; step : int64, its length in the epoch's unit.
    """
    found, last = 0, np.int64(-1)
    for k in range(epoch.size):
        at = epoch[k] // step
        if at != last or k == 0:
            last = at
            if found < out.size:
                out[found] = at
            found += 1
    return found


@kernel
def columns(x, y, above, on_ground, epoch, slot_ns, origin, per_m, level_m, band, levels, seen):
    """Compute the heights in each cell, and the time slots in which things, ground, and higher things were seen there.

    Parameters
    ----------
    x, y : (n,) float64 (m); above : (n,) float32 (m); on_ground : (n,) bool.
    epoch : (n,) int64; slot_ns : length of a slot: its number, by the number of bits, is a bit.
    origin : (2,) float64; per_m : cells a metre; level_m : height of a level.
    band : (3,) float64, things are returns between the first two of these heights, what is higher reaches the last (m).
    levels : (rows, columns) uint32, bits of heights; seen : (3, rows, columns, words) uint64, bits of slots.
    """
    rows, many = levels.shape
    words = seen.shape[3]
    for k in range(x.size):
        i, j = math.floor((y[k] - origin[1]) * per_m), math.floor((x[k] - origin[0]) * per_m)
        if i < 0 or j < 0 or i >= rows or j >= many:
            continue
        if on_ground[k]:
            slot = (epoch[k] // slot_ns) % (64 * words)
            seen[GROUND, i, j, slot // 64] |= np.uint64(1) << np.uint64(slot % 64)
            continue
        h = above[k]
        if h >= 0.0 and h < LEVELS * level_m:
            levels[i, j] |= np.uint32(1) << np.uint32(int(h / level_m))
            if band[0] <= h <= band[2]:
                slot = (epoch[k] // slot_ns) % (64 * words)
                seen[THINGS if h <= band[1] else HIGH, i, j, slot // 64] |= np.uint64(1) << np.uint64(slot % 64)


@kernel
def tops(levels, first, start, gap, out):
    """Compute the level that what stands on the ground reaches in each cell, -1 of none.

    It begins at a level from `first` up to `start` and continues over no more than `gap` empty levels.
    levels : (rows, columns) uint32; out : (rows, columns) int32.
    """
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            top, empty = -1, 0
            bits = levels[i, j]
            for m in range(first, LEVELS):
                if (bits >> np.uint32(m)) & np.uint32(1):
                    top, empty = m, 0
                else:
                    empty += 1
                    if (top >= 0 and empty > gap) or (top < 0 and m >= start):
                        break
            out[i, j] = top


@kernel
def marked(x, y, above, origin, per_m, cells, lowest, highest, out):
    """Write the number (n,) int32 of each return's cell, and 0 where the return is outside that number's heights.

    cells : (rows, columns) int32; lowest, highest : (numbers,) float64, heights by number (m).
    """
    rows, many = cells.shape
    for k in range(x.size):
        i, j = math.floor((y[k] - origin[1]) * per_m), math.floor((x[k] - origin[0]) * per_m)
        out[k] = 0
        if i >= 0 and j >= 0 and i < rows and j < many:
            at = cells[i, j]
            if at > 0 and lowest[at] <= above[k] <= highest[at]:
                out[k] = at


@kernel
def straight_run(x, y, free, angles, gap, chosen):
    """Choose the longest straight run of free cells, two cells wide; returns its length in cells.

    x, y : (n,) float64 column and row of each cell; free : (n,) bool; chosen : (n,) bool, set where a cell is in it.
    angles : directions that are tried, of half a turn; gap : empty cells that do not end a run.
    """
    best, strip, first, cosine, sine, along_min, across_min = 0, 0, 0, 1.0, 0.0, 0.0, 0.0
    for k in range(angles):
        c, s = math.cos(math.pi * k / angles), math.sin(math.pi * k / angles)
        a0, a1, o0, o1 = math.inf, -math.inf, math.inf, -math.inf
        for i in range(x.size):
            if free[i]:
                a, o = x[i] * c + y[i] * s, y[i] * c - x[i] * s
                a0, a1, o0, o1 = min(a0, a), max(a1, a), min(o0, o), max(o1, o)
        if not a1 - a0 >= best:
            continue
        held = np.zeros((int(o1 - o0) + 3, int(a1 - a0) + 2), np.bool_)
        for i in range(x.size):
            if free[i]:
                at, beside = int(x[i] * c + y[i] * s - a0 + 0.5), int(y[i] * c - x[i] * s - o0 + 0.5)
                held[beside, at] = held[beside + 1, at] = True
        for o in range(held.shape[0]):
            last, begin = -gap - 2, 0
            for a in range(held.shape[1]):
                if held[o, a]:
                    if a - last > gap + 1:
                        begin = a
                    last = a
                    if a - begin + 1 > best:
                        best, strip, first = a - begin + 1, o, begin
                        cosine, sine, along_min, across_min = c, s, a0, o0
    for i in range(x.size):
        if free[i]:
            at = int(x[i] * cosine + y[i] * sine - along_min + 0.5)
            beside = int(y[i] * cosine - x[i] * sine - across_min + 0.5)
            chosen[i] = beside <= strip <= beside + 1 and first <= at < first + best
    return best


@kernel
def mark_corridor(x, y, reach_m, corner, cell_m, inside):
    """Mark the cells whose middle lies within reach of a line: inside (rows, columns) bool.

    x, y : (p,) points of the line, in their order (m); corner : (x, y) of cell (0, 0). Points farther apart than 5 m
    are not joined: the vehicle left the window between them.
    """
    rows, columns = inside.shape
    for i in range(x.size):
        j = (
            i + 1
            if i + 1 < x.size and math.hypot(x[min(i + 1, x.size - 1)] - x[i], y[min(i + 1, x.size - 1)] - y[i]) <= 5.0
            else i
        )
        west, east = min(x[i], x[j]) - reach_m - corner[0], max(x[i], x[j]) + reach_m - corner[0]
        south, north = min(y[i], y[j]) - reach_m - corner[1], max(y[i], y[j]) + reach_m - corner[1]
        wx, wy = x[j] - x[i], y[j] - y[i]
        square = wx * wx + wy * wy
        for r in range(max(int(south / cell_m), 0), min(int(north / cell_m) + 1, rows)):
            for c in range(max(int(west / cell_m), 0), min(int(east / cell_m) + 1, columns)):
                px, py = corner[0] + (c + 0.5) * cell_m - x[i], corner[1] + (r + 0.5) * cell_m - y[i]
                share = min(max((px * wx + py * wy) / square, 0.0), 1.0) if square > 0.0 else 0.0
                if math.hypot(px - share * wx, py - share * wy) <= reach_m:
                    inside[r, c] = True


@kernel
def mark_strip(x, y, rows, middle, axes, box, marked):
    """Mark the returns of a rectangle seen from above: `marked` (n,) bool at their numbers.

    x, y : (k,) places (m) and rows : (k,) numbers of returns. middle : (2,) where axes (2, 2) begin, unit vectors. box
    : (4,) least and greatest place along the first axis, then along the second (m).
    """
    for i in range(x.size):
        dx, dy = x[i] - middle[0], y[i] - middle[1]
        along = dx * axes[0, 0] + dy * axes[0, 1]
        if box[0] <= along <= box[1]:
            across = dx * axes[1, 0] + dy * axes[1, 1]
            if box[2] <= across <= box[3]:
                marked[rows[i]] = True
