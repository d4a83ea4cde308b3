"""Pool of memory for the heights of cells: slots of 64 bytes, allocated sixteen at a time.

The heights of a cell are stored in a *slot* (``compute.kernels.height_slots``). Sixteen adjacent cells along a row of a
tile form a *group*. With its first reading, a group gets an *element* of the pool: a slot for each of its cells. A cell
with more readings, or with heights too far from the base for 16 bits, or of more passes than a header has bits for,
chains spare slots behind its first one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare_inlined
from roadscan.compute.kernels.height_slots import (
    COUNTS,
    FARTHEST,
    LANES,
    MARK_SHIFT,
    PASSES,
    SLOT_HEADERS,
    SLOT_HEIGHTS,
    WORD_SHIFT,
    WORDS,
)
from roadscan.compute.kernels.streak_slots import lowest_bit


class Pool(NamedTuple):
    """c elements of LANES slots each."""

    slots: npt.NDArray[np.int16]
    """(c · LANES · SLOT_SIZE,) beginning with a line of the cache."""
    headers: npt.NDArray[np.uint64]
    """(c · LANES · SLOT_HEADERS,) the same memory; of each slot the last is its header."""
    bases: npt.NDArray[np.int32]
    """(c · LANES,) height (quanta) from which those of each slot are counted."""
    chain: npt.NDArray[np.int32]
    """(c · LANES,) next slot of the cell, −1 for none."""
    free: npt.NDArray[np.int32]
    """(c,) stack of free elements."""
    spare: npt.NDArray[np.int32]
    """(c · LANES,) stack of spare slots."""
    held: npt.NDArray[np.int64]
    """(2,) elements in use, spare slots."""


@bare_inlined
def header_of(slot, pool):
    """Return the header of a slot."""
    return pool.headers[slot * SLOT_HEADERS + SLOT_HEADERS - 1]


@bare_inlined
def header_of_pass(number):
    """Return what a pass sets in a header, its bit and its word (uint64)."""
    word, bit = np.uint64(number // PASSES), np.uint64(number % PASSES)
    return (word << np.uint64(WORD_SHIFT)) | (np.uint64(1) << (bit + np.uint64(MARK_SHIFT)))


@bare_inlined
def new_group(height, pool):
    """Take an element from the free list, with empty slots based on a height (quanta)."""
    e = pool.free[pool.held[0]]
    pool.held[0] += 1
    for slot in range(np.uint64(e) * np.uint64(LANES), np.uint64(e + 1) * np.uint64(LANES)):
        pool.headers[slot * np.uint64(SLOT_HEADERS) + np.uint64(SLOT_HEADERS - 1)] = 0
        pool.bases[slot] = height
        pool.chain[slot] = -1
    return e


@bare_inlined
def new_slot(height, pool):
    """Take an empty slot from the spare ones; if there is none, turn an element into spare slots."""
    held, spare = pool.held, pool.spare
    if held[1] == 0:
        e = new_group(height, pool)
        for lane in range(LANES):
            spare[lane] = e * LANES + LANES - 1 - lane
        held[1] = LANES
    held[1] -= 1
    slot = spare[held[1]]
    pool.headers[slot * SLOT_HEADERS + SLOT_HEADERS - 1] = 0
    pool.bases[slot] = height
    pool.chain[slot] = -1
    return slot


@bare_inlined
def slot_with_room(own, size, low, high, word, pool):
    """Return a slot of the chain from `own` that takes `size` more heights from `low` to `high`; −1 where none does."""
    slot = np.int64(own)
    while slot >= 0:
        header = header_of(slot, pool)
        used = np.int64(header & np.uint64(COUNTS))
        base = np.int64(pool.bases[slot])
        fits = (used + size <= SLOT_HEIGHTS) & (low - base >= -FARTHEST) & (high - base <= FARTHEST)
        if fits & ((used == 0) | (header & np.uint64(WORDS << WORD_SHIFT) == word)):
            return slot
        slot = np.int64(pool.chain[slot])
    return slot


@bare_inlined
def longer_chain(own, height, pool):
    """Insert a new slot after `own`, before the older ones, which are full."""
    slot = np.int64(new_slot(height, pool))
    pool.chain[slot] = pool.chain[own]
    pool.chain[own] = slot
    return slot


@bare_inlined
def release(element, longer, pool):
    """Free a group's element and the further slots of its cells; longer: uint64, a bit for each such cell."""
    held, chain = pool.held, pool.chain
    while longer:
        slot = np.int64(chain[element * LANES + np.int64(lowest_bit(longer))])
        longer &= longer - np.uint64(1)
        while slot >= 0:
            pool.spare[held[1]] = slot
            held[1] += 1
            slot = np.int64(chain[slot])
    held[0] -= 1
    pool.free[held[0]] = element
