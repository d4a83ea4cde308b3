"""Slots of heights in memory: their layout, storing eight heights as one vector, and prefetching.

A slot has 64 bytes, as long as a line of the cache: SLOT_HEIGHTS differences from the slot's base, and a header with
their number, the sum of their intensities and the passes they are from.

Written as instructions, because Numba stores numbers one by one and cannot prefetch.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel
from roadscan.compute.kernels.vectors import I8, I16, I32, everywhere, instruction, load, start, store
from roadscan.compute.numba_internals import ir, types

VECTOR = 8
"""Number of heights that are stored at once."""
LANES = 16
"""Number of cells in a group."""
SLOT_SIZE = 32
"""Numbers of 16 bits in a slot: the heights, then the header."""
SLOT_HEIGHTS = 28
"""Number of heights in a slot."""
SLOT_HEADERS = 8
"""Numbers of 64 bits in a slot; the last one is its header."""
LAST = SLOT_SIZE - VECTOR
"""Most heights that a slot may hold before a whole vector is stored behind them."""
FARTHEST = 32_000
"""Largest difference (quanta) between a height and the base of its slot."""

COUNTS = 31  # Mask of the number of heights in a header.
LIGHT_SHIFT, LIGHTS = 5, (1 << 21) - 1  # Lowest bit and mask of the sum of intensities.
WORD_SHIFT, WORDS = 26, (1 << 14) - 1  # Lowest bit and mask of the word of passes.
MARK_SHIFT = 40  # Lowest bit of the passes.
PASSES = 24
"""A header, from its lowest bit: number of heights (5), sum of intensities (21), word (14), passes (24).

Pass number p has the bit p mod 24 in slots of the word p div 24; a slot has one word."""

_WHOLE, _HALF = ir.VectorType(I32, VECTOR), ir.VectorType(I16, VECTOR)


@intrinsic
def _stored(typingctx, heights, first, base, slots, at):
    def write(context, builder, signature, arguments):
        source, target = (start(context, builder, signature, arguments, k) for k in (0, 3))
        values = load(builder, builder.gep(source, [arguments[1]]), _WHOLE)
        values = builder.trunc(builder.sub(values, everywhere(builder, _WHOLE, arguments[2])), _HALF)
        store(builder, values, builder.gep(target, [arguments[4]]))
        return context.get_dummy_value()

    return types.void(heights, first, base, slots, at), write


def _stored_by_numpy(heights, first, base, slots, at):
    own = heights[int(first) : int(first) + VECTOR]
    slots[int(at) : int(at) + VECTOR] = (own - base).astype(np.int16)


@intrinsic
def _fetched(typingctx, array, at):
    def write(context, builder, signature, arguments):
        place = builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]])
        place = builder.bitcast(place, I8.as_pointer())  # arrays of any type are fetched by one instruction
        instruction(
            builder, "llvm.prefetch.p0", ir.VoidType(), place, I32(1), I32(3), I32(1)
        )  # to write, to keep, data
        return context.get_dummy_value()

    return types.void(array, at), write


def _not_fetched(array, at):
    """Do nothing: without the compiler there is no prefetch."""


store_heights: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_heights(heights, first, base, slots, at): heights[first : first + VECTOR] − base → slots[at : at + VECTOR].

heights : (≥ first + VECTOR,) int32; slots : (m,) int16, contiguous; first, at : uint64; base : int32."""

prefetch: Kernel = _not_fetched if numba.config.DISABLE_JIT else _fetched
"""prefetch(array, at): the line of the cache with array[at] is wanted soon, to be written; at : uint64."""
