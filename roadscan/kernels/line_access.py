"""Lines of heights in memory: eight heights stored as one vector, lines fetched before they are wanted.

Written as instructions: Numba's own stores stay one by one, and it knows no way to fetch.
"""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.options import Kernel
from roadscan.kernels.vectors import I8, I16, I32, everywhere, instruction, load, start, store

VECTOR = 8
"""Heights that are stored at once."""

_WHOLE, _HALF = ir.VectorType(I32, VECTOR), ir.VectorType(I16, VECTOR)


@intrinsic
def _stored(typingctx, heights, first, base, lines, at):
    def write(context, builder, signature, arguments):
        source, target = (start(context, builder, signature, arguments, k) for k in (0, 3))
        values = load(builder, builder.gep(source, [arguments[1]]), _WHOLE)
        values = builder.trunc(builder.sub(values, everywhere(builder, _WHOLE, arguments[2])), _HALF)
        store(builder, values, builder.gep(target, [arguments[4]]))
        return context.get_dummy_value()

    return types.void(heights, first, base, lines, at), write


def _stored_by_numpy(heights, first, base, lines, at):
    own = heights[int(first) : int(first) + VECTOR]
    lines[int(at) : int(at) + VECTOR] = (own - base).astype(np.int16)


@intrinsic
def _fetched(typingctx, lines, at):
    def write(context, builder, signature, arguments):
        place = builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]])
        place = builder.bitcast(place, I8.as_pointer())  # lines of any type are fetched by one instruction
        instruction(
            builder, "llvm.prefetch.p0", ir.VoidType(), place, I32(1), I32(3), I32(1)
        )  # to write, to keep, data
        return context.get_dummy_value()

    return types.void(lines, at), write


def _not_fetched(lines, at):
    """Nothing to do without the compiler."""


store_heights: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_heights(heights, first, base, lines, at): heights[first : first + VECTOR] − base → lines[at : at + VECTOR].

heights : (≥ first + VECTOR,) int32; lines : (m,) int16, contiguous; first, at : uint64; base : int32."""

fetch_line: Kernel = _not_fetched if numba.config.DISABLE_JIT else _fetched
"""fetch_line(lines, at): the line of the cache with lines[at] is wanted soon, to be written; at : uint64."""
