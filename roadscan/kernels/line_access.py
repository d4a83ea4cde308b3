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

VECTOR = 8
"""Heights that are stored at once."""


def _compiled() -> Kernel:
    whole, half = ir.VectorType(ir.IntType(32), VECTOR), ir.VectorType(ir.IntType(16), VECTOR)

    @intrinsic
    def stored(typingctx, heights, first, base, lines, at):
        def write(context, builder, signature, arguments):
            source, target = (
                context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3)
            )
            read = builder.bitcast(builder.gep(source, [arguments[1]]), whole.as_pointer())
            values = builder.load(read)
            values.align = 4
            bases = ir.Constant(whole, ir.Undefined)
            for k in range(VECTOR):
                bases = builder.insert_element(bases, arguments[2], ir.Constant(ir.IntType(32), k))
            place = builder.bitcast(builder.gep(target, [arguments[4]]), half.as_pointer())
            builder.store(builder.trunc(builder.sub(values, bases), half), place).align = 2
            return context.get_dummy_value()

        return types.void(heights, first, base, lines, at), write

    return stored


def _interpreted(heights, first, base, lines, at):
    lines[int(at) : int(at) + VECTOR] = (heights[int(first) : int(first) + VECTOR] - base).astype(np.int16)


def _compiled_fetch() -> Kernel:
    number, byte = ir.IntType(32), ir.IntType(8).as_pointer()

    @intrinsic
    def fetched(typingctx, lines, at):
        def write(context, builder, signature, arguments):
            start = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            place = builder.bitcast(builder.gep(start, [arguments[1]]), byte)
            kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            fetch = builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=kind)
            builder.call(fetch, [place, number(1), number(3), number(1)])  # to write, to keep, data
            return context.get_dummy_value()

        return types.void(lines, at), write

    return fetched


def _no_fetch(lines, at):
    """Nothing to do without the compiler."""


fetch_line: Kernel = _no_fetch if numba.config.DISABLE_JIT else _compiled_fetch()
"""fetch_line(lines, at): the line of the cache with lines[at] is wanted soon, to be written; at : uint64."""

store_heights: Kernel = _interpreted if numba.config.DISABLE_JIT else _compiled()
"""store_heights(heights, first, base, lines, at): heights[first : first + VECTOR] − base → lines[at : at + VECTOR].

heights : (n,) int32; lines : (m,) int16, contiguous; first, at : uint64; base : int32."""
