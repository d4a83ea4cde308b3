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
from roadscan.kernels.processor import compiles_for
from roadscan.kernels.vectors import I8, I16, I32, constant, everywhere, instruction, load, start, store

VECTOR = 8
"""Heights that are stored at once."""

_WHOLE, _HALF = ir.VectorType(I32, VECTOR), ir.VectorType(I16, VECTOR)


STORES_SOME = numba.config.DISABLE_JIT or compiles_for("avx512bw", "avx512vl")
"""Whether only those heights are stored that are wanted; else what lies behind them is overwritten."""


@intrinsic
def _stored(typingctx, heights, first, size, base, lines, at):
    def write(context, builder, signature, arguments):
        source, target = (start(context, builder, signature, arguments, k) for k in (0, 4))
        values = load(builder, builder.gep(source, [arguments[1]]), _WHOLE)
        values = builder.trunc(builder.sub(values, everywhere(builder, _WHOLE, arguments[3])), _HALF)
        place = builder.bitcast(builder.gep(target, [arguments[5]]), _HALF.as_pointer())
        if not STORES_SOME:
            store(builder, values, place)
            return context.get_dummy_value()
        wanted = everywhere(builder, _HALF, builder.trunc(arguments[2], I16))
        wanted = builder.icmp_unsigned("<", constant(_HALF, range(VECTOR)), wanted)
        instruction(builder, "llvm.masked.store.v8i16.p0", ir.VoidType(), values, place, I32(2), wanted)
        return context.get_dummy_value()

    return types.void(heights, first, size, base, lines, at), write


def _stored_by_numpy(heights, first, size, base, lines, at):
    own = heights[int(first) : int(first) + int(size)]
    lines[int(at) : int(at) + own.size] = (own - base).astype(np.int16)


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
"""store_heights(heights, first, size, base, lines, at): heights[first : first + size] − base → lines[at : at + size].

heights : (n,) int32, read as far as first + VECTOR; lines : (m,) int16, contiguous; first, size, at : uint64; size
≤ VECTOR; base : int32. Without STORES_SOME, all of lines[at : at + VECTOR] is overwritten."""

fetch_line: Kernel = _not_fetched if numba.config.DISABLE_JIT else _fetched
"""fetch_line(lines, at): the line of the cache with lines[at] is wanted soon, to be written; at : uint64."""
