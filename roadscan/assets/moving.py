"""Vehicles and people: those that move, and parked vehicles."""

from __future__ import annotations

import functools
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.cubes import Cubes
from roadscan.assets.ground.grid import Grid, grid_over
from roadscan.assets.kernels import columns, voxels
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box
from roadscan.core.extras import cv2

Bools = npt.NDArray[np.bool_]
Int32 = npt.NDArray[np.int32]

REACH_M: Final = 8.0
"""A vehicle of 7 m with the ground around it, by which it is told from other things, lies within this (m)."""
CELL_M: Final = 0.2  # Edge of a cell (m).
LEVEL_M: Final = 0.2  # Height of a level (m).
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
_TALL: Final = 14
"""What reaches this level, 2.8 m, is no parked vehicle."""
_BODY: Final = 0b111100
"""Levels at which a vehicle has its body, as bits: 0.4–1.2 m."""
_LOWEST_BODY: Final = 3
"""What moves and does not exceed this level, 0.8 m, carries nothing higher than cars."""
_TALLEST: Final = 21
"""Greatest level of a moving lorry: 4.2 m."""
_LEAST_CELLS: Final = 6  # Smaller groups of cells are no vehicle or person.
_STAYS_SLOTS: Final = 8
"""What is seen in this many slots, and in more than twice as many as the ground without it, is stationary."""
_TREE_CELLS: Final = 60
"""Least number of cells of what seems to move below a tree's crown: branches swing."""
_PERSON_M: Final = 1.2
"""What moves along a narrower track (m) is a person, on foot or on a bicycle."""


class Users(NamedTuple):
    """Masks (n,) of the returns of road users."""

    vehicle: Bools
    person: Bools


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


def road_users(
    returns: Returns, above_m: npt.NDArray[np.float32], on_ground: Bools, cubes: Cubes, window: Box
) -> Users:
    """Returns masks of vehicles and people among the returns that do not lie on the ground."""
    held = columns_of(returns, above_m, on_ground, window)
    moving = moving_cells(held)
    vehicle, person = tracks(held, moving)
    parked = parked_cells(held, moving, Bodies(returns, above_m, on_ground, cubes))
    return Users(
        returns_of(np.where(parked > 0, parked, vehicle), held, returns, above_m) & ~on_ground,
        returns_of(person, held, returns, above_m) & ~on_ground,
    )


def columns_of(returns: Returns, above_m: npt.NDArray[np.float32], on_ground: Bools, window: Box) -> Columns:
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


def moving_cells(held: Columns) -> Bools:
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


def _around(cells: Bools) -> Int32:
    counted = cv2.boxFilter(cells.view(np.uint8), cv2.CV_32S, (3, 3), None, (-1, -1), False, cv2.BORDER_CONSTANT)
    return np.asarray(counted, np.int32)


def tracks(held: Columns, moving: Bools) -> tuple[Int32, Int32]:
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
        if cells < _TREE_CELLS and 2 * np.count_nonzero(top >= _TALL) > cells:
            continue
        reached = min(int(np.quantile(top, 0.9)) + 1, _TALLEST)
        target = vehicle if sides_m(inside)[1] >= _PERSON_M else person
        wider = cv2.dilate(inside.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        target[part][wider] = np.maximum(target[part][wider], reached)
        if target is vehicle and reached > _LOWEST_BODY:
            around = slice(max(low - 2, 0), low + height + 2), slice(max(left - 2, 0), left + width + 2)
            target[around] = np.maximum(target[around], load_levels(held, around, label[around] == k))
    return vehicle, person


def load_levels(held: Columns, part: tuple[slice, slice], inside: Bools) -> Int32:
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
    bits = np.maximum(held.levels[part] & np.uint32((1 << (_TALLEST + 1)) - 1), 1)
    return np.where(along, np.log2(bits).astype(np.int32) + 1, 0)


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


def sides_m(cells: Bools) -> tuple[float, float]:
    """Length and width of the smallest rectangle about the middles of cells (rows, columns), a cell added (m)."""
    row, column = np.nonzero(cells)
    sides = cv2.minAreaRect(np.column_stack([column, row]).astype(np.float32))[1]
    return (max(sides) + 1.0) * CELL_M, (min(sides) + 1.0) * CELL_M


class Bodies(NamedTuple):
    """Returns that may be those of parked vehicles."""

    returns: Returns
    above_m: npt.NDArray[np.float32]
    on_ground: Bools
    cubes: Cubes


class Shape(NamedTuple):
    """Figures of a group of cells that stand apart."""

    length_m: float
    width_m: float
    top_m: float
    """Height that nine tenths of its cells do not exceed."""
    fill: float
    """Share of its rectangle that its cells cover."""
    scattering: float
    """Mean scattering of its returns: 0 on surfaces, above 0.4 in leaves."""
    ground: float
    """Share of the cells around it in which ground was seen."""

    @property
    def is_vehicle(self) -> bool:
        """Returns whether it looks like a vehicle, a part of one, or a row of them that stand close together."""
        if self.scattering > _LEAFY or not _LOWEST_M <= self.top_m <= _HIGHEST_M:
            return False
        low = self.top_m <= _CAR_TOP_M
        one = 0.9 <= self.length_m <= 7.0 and 0.5 <= self.width_m <= 2.8 and self.ground >= 0.2
        hidden = 1.1 <= self.length_m <= 3.0 and 0.45 <= self.width_m <= 2.2
        hidden = hidden and self.scattering <= 0.31 and self.ground >= 0.02
        van = self.length_m >= 3.5 and self.width_m >= 1.4
        face = 1.4 <= self.length_m <= 2.3 and self.width_m >= 0.4 and self.ground >= 0.4 and self.scattering <= 0.3
        row = self.length_m > 4.0 and 1.4 <= self.width_m <= 6.5 and self.ground >= 0.5 and self.fill >= 0.25
        return (one and (low or van)) or ((face or hidden) and low) or row


_LEAFY: Final = 0.42  # Greatest mean scattering of a vehicle.
_LOWEST_M, _CAR_TOP_M, _HIGHEST_M = 1.15, 2.25, 2.85  # Heights of vehicles (m): least, of a car, greatest.


def parked_cells(held: Columns, moving: Bools, bodies: Bodies) -> Int32:
    """Returns the level of parked vehicles, in their cells (rows, columns); 0 elsewhere.

    A vehicle's body stands apart from all that is tall, has the size and the surfaces of one, and ground around it.
    """
    low = (held.top >= 1) & (held.top < _TALL) & ~moving
    body = low & ((held.levels & np.uint32(_BODY)) > 0)
    count, label, boxes, _ = cv2.connectedComponentsWithStats(body.view(np.uint8), connectivity=8)
    tall = (held.top >= _TALL) & ~moving
    touched = np.bincount(label[cv2.dilate(tall.view(np.uint8), np.ones((3, 3), np.uint8)) > 0], minlength=count)
    scattering = mean_scattering(label.astype(np.int32), held.grid, bodies, count)
    found = np.zeros(label.shape, np.int32)
    for k in range(1, count):
        left, lower, width, height, cells = boxes[k]
        if cells < _LEAST_CELLS or 20 * touched[k] > cells or not scattering[k] <= _LEAFY:
            continue
        part = slice(max(lower - 3, 0), lower + height + 3), slice(max(left - 3, 0), left + width + 3)
        inside = label[part] == k
        length_m, width_m = sides_m(inside)
        top = held.top[part][inside]
        ground = ground_around(inside, np.asarray(held.grounds[part].any(axis=-1)))
        fill = float(cells) * CELL_M**2 / (length_m * width_m)
        top_m = float(np.quantile(top, 0.9) + 1.0) * LEVEL_M
        if Shape(length_m, width_m, top_m, fill, float(scattering[k]), ground).is_vehicle:
            wider = cv2.dilate(inside.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
            wider &= (label[part] == 0) | inside
            reached = int(np.quantile(top, 0.9)) + 1
            wider &= held.top[part] <= reached + 1  # what is taller stands beside it
            found[part][wider] = np.maximum(found[part][wider], reached + 1)
    return found


def mean_scattering(label: Int32, grid: Grid, bodies: Bodies, count: int) -> npt.NDArray[np.float64]:
    """Returns the mean scattering (count,) of the returns above the cells of each label; NaN of none."""
    at = np.empty(len(bodies.returns), np.int32)
    lowest, highest = np.full(count, LEVEL_M), np.full(count, _TALL * LEVEL_M)
    x, y = bodies.returns.x_m, bodies.returns.y_m
    columns.marked(x, y, bodies.above_m, grid.origin, 1.0 / CELL_M, label, lowest, highest, at)
    chosen = (at > 0) & ~bodies.on_ground & (bodies.cubes.number >= 0)
    values = bodies.cubes.features[bodies.cubes.number[chosen], voxels.SCATTERING].astype(np.float64)
    total = np.bincount(at[chosen], weights=values, minlength=count)
    number = np.bincount(at[chosen], minlength=count)
    return np.asarray(np.divide(total, number, out=np.full(count, np.nan), where=number > 0))


def ground_around(inside: Bools, ground: Bools) -> float:
    """Returns the share of the cells in a ring about some cells (rows, columns) in which ground was seen."""
    near = cv2.dilate(inside.view(np.uint8), np.ones((3, 3), np.uint8))
    ring = cv2.dilate(inside.view(np.uint8), np.ones((7, 7), np.uint8)) > near
    return float(np.count_nonzero(ground & ring)) / float(max(int(np.count_nonzero(ring)), 1))


def returns_of(reached: Int32, held: Columns, returns: Returns, above_m: npt.NDArray[np.float32]) -> Bools:
    """Returns a mask (n,) of returns in cells up to the level that is reached there, and one more."""
    most = _TALLEST + 2
    lowest, highest = np.full(most + 1, -0.2), (np.arange(most + 1) + 1.0) * LEVEL_M
    at = np.empty(len(returns), np.int32)
    grid = held.grid
    columns.marked(returns.x_m, returns.y_m, above_m, grid.origin, 1.0 / CELL_M, reached, lowest, highest, at)
    return np.asarray(at > 0)
