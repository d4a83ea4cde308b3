"""What stands in each cell of a window and when it was seen, and what moves: seen for a while, and then the ground."""

from __future__ import annotations

import functools
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.ground.surface import Grid, grid_over
from roadscan.assets.kernels import columns
from roadscan.assets.kernels.columns import mark_corridor
from roadscan.assets.quantiles import quantiles
from roadscan.assets.scene import Box, Returns
from roadscan.compute.array_types import Bool, Int32
from roadscan.core.extras import cv2

REACH_M: Final = 8.0
"""A vehicle of 7 m with the ground around it, by which it is told from other things, lies within this (m)."""
CELL_M: Final = 0.2  # Edge of a cell (m).
LEVEL_M: Final = 0.2  # Height of a level (m).
BODY: Final = 0b111100
"""Levels at which a vehicle has its body, as bits: 0.4–1.2 m."""
SLOT_NS: Final = 200_000_000
"""Length of a slot of time (ns), counted from the epoch of GPS time: the same for squares of any edge."""
_WORDS: Final = 4
"""Slots are counted by so many numbers of 64 bits, again from the first after 51 s: longer than a cell is in sight."""
_THING_M: Final = (0.3, 2.5, 4.4)
"""Returns between the first two heights (m) may be moving, those up to the last may be the tops of these."""
_GAP: Final = 2
"""Empty levels within what stands on the ground, at most, as between a car's body and its roof."""
_START: Final = 5
"""Level below which it begins."""
TALL: Final = 14
"""What reaches this level, 2.8 m, is no parked vehicle."""
_LOWEST_BODY: Final = 3
"""What moves and does not exceed this level, 0.8 m, carries nothing higher than cars."""
TALLEST: Final = 21
"""Greatest level of a moving lorry: 4.2 m."""
_LEAST_CELLS: Final = 6  # Smaller groups of cells are no vehicle or person.
_STAYS_SLOTS: Final = 8
"""What is seen in this many slots, and in more than twice as many as the ground without it, is stationary."""
_DRIVEN_M: Final = 0.7  # Half the width of the narrowest cars (m).
_DRIVEN_LEVELS: Final = 0b1111000
"""Levels at which a car meets what stands in its way, as bits: 0.6–1.4 m. Grass is lower, branches are higher."""
_TREE_CELLS: Final = 60
"""Least number of cells of what seems to move below a tree's crown: branches swing."""
_PERSON_M: Final = 1.2
"""What moves along a narrower track (m) is a person, on foot or on a bicycle."""


class Columns(NamedTuple):
    """Rasters (rows, columns) of what stands in each cell."""

    grid: Grid
    levels: npt.NDArray[np.uint32]
    top: Int32
    """Level that what stands on the ground reaches; -1 of none."""
    things: npt.NDArray[np.uint64]
    grounds: npt.NDArray[np.uint64]
    highs: npt.NDArray[np.uint64]
    """(rows, columns, words) slots of time in which things, ground and higher things were seen, as bits."""


def columns_of(returns: Returns, above_m: npt.NDArray[np.float32], on_ground: Bool, window: Box) -> Columns:
    """Returns what stands in each cell of a window, and when it was seen."""
    grid = grid_over(window, CELL_M)
    levels = np.zeros(grid.shape, np.uint32)
    seen = np.zeros((3, *grid.shape, _WORDS), np.uint64)
    columns.columns(
        returns.x_m,
        returns.y_m,
        above_m,
        on_ground,
        returns.epoch_gps_ns,
        SLOT_NS,
        grid.origin,
        1.0 / CELL_M,
        LEVEL_M,
        np.array(_THING_M),
        levels,
        seen,
    )
    top = np.empty(grid.shape, np.int32)
    columns.tops(levels, 1, _START, _GAP, top)
    return Columns(grid, levels, top, *seen)


def number_of(slots: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """Returns how many slots each cell (rows, columns) has, from their bits (rows, columns, words)."""
    return np.asarray(np.bitwise_count(slots).sum(axis=-1, dtype=np.int64))


def moving_cells(held: Columns) -> Bool:
    """Mask (rows, columns) of cells where things were seen for a while, and longer the ground without them."""
    things = number_of(held.things)
    free = number_of(held.grounds & ~held.things)
    both = number_of(held.grounds & held.things)
    apart = (free >= 2) & (2 * free >= 3 * things) & (2 * both <= things)
    moving = (things > 0) & (apart | ((free >= 3) & (free >= 2 * things)))
    around = _around(moving)
    # whatever its neighbours do: the edges of a post are seen now and then
    stays = (things >= _STAYS_SLOTS) & (things > 2 * free)
    return np.asarray((things > 0) & ~stays & (2 * around >= _around(things > 0)) & (around >= 3))


def driven_cells(held: Columns, drive_xyh_m: npt.NDArray[np.float64]) -> Bool:
    """Mask (rows, columns) of cells where things were seen in the way of a drive, which went through: they moved.

    drive_xyh_m : (p, 4) x, y and height of the sensor (m) and the pass, in the order of time.
    """
    inside = np.zeros(held.top.shape, np.bool_)
    for number in np.unique(drive_xyh_m[:, 3]).tolist():
        x, y = (np.ascontiguousarray(drive_xyh_m[drive_xyh_m[:, 3] == number, k]) for k in (0, 1))
        mark_corridor(x, y, _DRIVEN_M, held.grid.origin, CELL_M, inside)
    return inside & ((held.levels & np.uint32(_DRIVEN_LEVELS)) > 0)


def _around(cells: Bool) -> Int32:
    counted = cv2.boxFilter(cells.view(np.uint8), cv2.CV_32S, (3, 3), None, (-1, -1), False, cv2.BORDER_CONSTANT)
    return np.asarray(counted, np.int32)


def tracks(held: Columns, moving: Bool) -> tuple[Int32, Int32]:
    """Returns the level of moving vehicles and people, in the cells of their tracks (rows, columns); 0 elsewhere."""
    count, label, boxes, _ = cv2.connectedComponentsWithStats(moving.view(np.uint8), connectivity=8)
    vehicle, person = np.zeros(label.shape, np.int32), np.zeros(label.shape, np.int32)
    for k in range(1, count):
        left, low, width, height, cells = boxes[k]
        if cells < _LEAST_CELLS:
            continue
        part = slice(max(low - 1, 0), low + height + 1), slice(max(left - 1, 0), left + width + 1)
        inside = label[part] == k
        top = held.top[part][inside]
        if cells < _TREE_CELLS and 2 * np.count_nonzero(top >= TALL) > cells:
            continue
        reached = min(int(quantiles(top, [0.9])[0]) + 1, TALLEST)
        target = vehicle if sides_m(inside)[1] >= _PERSON_M else person
        wider = cv2.dilate(inside.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        target[part][wider] = np.maximum(target[part][wider], reached)
        if target is vehicle:  # all that was seen there below the higher things, however far apart rings meet it
            own = np.where(inside, highest_levels(held.levels[part], round(_THING_M[1] / LEVEL_M) - 1), 0)
            vehicle[part] = np.maximum(vehicle[part], own)
        if target is vehicle and reached > _LOWEST_BODY:
            around = slice(max(low - 2, 0), low + height + 2), slice(max(left - 2, 0), left + width + 2)
            target[around] = np.maximum(target[around], load_levels(held, around, label[around] == k))
    return vehicle, person


def load_levels(held: Columns, part: tuple[slice, slice], inside: Bool) -> Int32:
    """Level (rows, columns) of loads that move along a vehicle's track and are higher than cars; 0 elsewhere.

    A load is seen in the slots of the track's lower things, or in those beside them, and in no others:
    branches, signs and decks are seen before and after. From afar a scanner shows some heights only, and not each in
    each cell, so lower things within two cells count.
    """
    things = np.where(inside[..., None], held.things[part], np.uint64(0))
    for axis in (0, 1):
        things = functools.reduce(np.bitwise_or, (_shifted(things, step, axis) for step in range(-2, 3)))
    highs = held.highs[part]
    high = highs.any(axis=-1) & things.any(axis=-1)
    along = high & ((highs & ~with_neighbours(things)) == 0).all(axis=-1)
    if 2 * np.count_nonzero(along) < np.count_nonzero(high):
        return np.zeros(inside.shape, np.int32)
    return np.where(along, highest_levels(held.levels[part], TALLEST), 0)


def highest_levels(levels: npt.NDArray[np.uint32], highest: int) -> Int32:
    """Returns one more than the highest level, up to one, that was seen in each cell (rows, columns)."""
    bits = np.maximum(levels & np.uint32((1 << (highest + 1)) - 1), 1)
    return np.asarray(np.log2(bits).astype(np.int32) + 1)


def with_neighbours(slots: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Returns slots, as bits (rows, columns, words), and those before and after them."""
    one, last = np.uint64(1), np.uint64(63)
    before = (slots >> one) | (np.roll(slots, -1, axis=-1) << last)
    after = (slots << one) | (np.roll(slots, 1, axis=-1) >> last)
    return slots | before | after


def _shifted(bits: npt.NDArray[np.uint64], step: int, axis: int) -> npt.NDArray[np.uint64]:
    """Returns the bits (rows, columns, words) of the cell so many steps away; 0 beyond the border."""
    out = np.zeros_like(bits)
    size = bits.shape[axis]
    into, of = slice(max(-step, 0), size - max(step, 0)), slice(max(step, 0), size - max(-step, 0))
    if axis == 0:
        out[into] = bits[of]
    else:
        out[:, into] = bits[:, of]
    return out


def sides_m(cells: Bool) -> tuple[float, float]:
    """Length and width of the smallest rectangle about the middles of cells (rows, columns), a cell added (m)."""
    row, column = np.nonzero(cells)
    sides = cv2.minAreaRect(np.column_stack([column, row]).astype(np.float32))[1]
    return (max(sides) + 1.0) * CELL_M, (min(sides) + 1.0) * CELL_M


def returns_of(reached: Int32, held: Columns, returns: Returns, above_m: npt.NDArray[np.float32]) -> Bool:
    """Returns a mask (n,) of returns in cells up to the level that is reached there, and one more."""
    most = TALLEST + 2
    lowest, highest = np.full(most + 1, -0.2), (np.arange(most + 1) + 1.0) * LEVEL_M
    at = np.empty(len(returns), np.int32)
    grid = held.grid
    columns.marked(returns.x_m, returns.y_m, above_m, grid.origin, 1.0 / CELL_M, reached, lowest, highest, at)
    return np.asarray(at > 0)
