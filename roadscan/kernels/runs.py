"""Runs: readings side by side that fall into one cell."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.options import Kernel, bare, compiles_for, inlined

AT_ONCE = 16


@inlined
def _starts_one_by_one(column, row, first, end, starts, runs):
    """Note the readings from `first` to `end` − 1 whose cell is not that of the reading before."""
    for j in range(first, end):
        starts[runs] = j
        runs += np.uint64((column[j] != column[j - np.uint64(1)]) | (row[j] != row[j - np.uint64(1)]))
    return runs


def _compiled() -> Kernel:
    """Sixteen readings compared with those before them; the numbers of those that differ are stored side by side."""
    row_of, number = ir.VectorType(ir.IntType(32), AT_ONCE), ir.IntType(64)
    bits = ir.VectorType(ir.IntType(1), AT_ONCE)

    @intrinsic
    def noted(typingctx, column, row, first, starts, runs):
        def write(context, builder, signature, arguments):
            b, (_, _, first, _, runs) = builder, arguments
            columns, rows, target = (
                context.make_array(signature.args[k])(context, b, arguments[k]).data for k in (0, 1, 3)
            )

            def load(start, at):
                value = b.load(b.bitcast(b.gep(start, [at]), row_of.as_pointer()))
                value.align = 4
                return value

            before = b.sub(first, number(1))
            new = b.or_(
                b.icmp_signed("!=", load(columns, first), load(columns, before)),
                b.icmp_signed("!=", load(rows, first), load(rows, before)),
            )
            one = b.insert_element(ir.Constant(row_of, ir.Undefined), b.trunc(first, ir.IntType(32)), ir.IntType(32)(0))
            zeros = ir.Constant(row_of, [0] * AT_ONCE)
            numbers = b.add(
                b.shuffle_vector(one, ir.Constant(row_of, ir.Undefined), zeros),
                ir.Constant(row_of, list(range(AT_ONCE))),
            )
            place = b.gep(target, [runs])
            kind = ir.FunctionType(ir.VoidType(), [row_of, place.type, bits])
            store = b.module.declare_intrinsic("llvm.masked.compressstore.v16i32", fnty=kind)
            b.call(store, [numbers, place, new])
            return b.add(runs, b.zext(b.ctpop(b.bitcast(new, ir.IntType(AT_ONCE))), number))

        return types.uint64(column, row, first, starts, runs), write

    return noted


_VECTORS = compiles_for("avx512f")
_starts_of_sixteen: Kernel = _compiled() if _VECTORS else _starts_one_by_one


@bare
def find_runs(column, row, starts):
    """Where readings of another cell begin: (n + 1,) uint32, out, the last one n. Returns how many runs there are."""
    starts[0] = 0
    runs, j, n = np.uint64(1), np.uint64(1), np.uint64(column.size)
    if _VECTORS:
        while j + np.uint64(AT_ONCE) <= n:
            runs = _starts_of_sixteen(column, row, j, starts, runs)
            j += np.uint64(AT_ONCE)
    runs = _starts_one_by_one(column, row, j, n, starts, runs)
    starts[runs] = n
    return runs


@bare
def sum_up(intensity, gain, sums):
    """Sums of the intensities, times `gain`, before each reading: (n + 1,) uint32, out."""
    total = np.uint32(0)
    for j in range(intensity.size):
        sums[j] = total
        total += gain * np.uint32(intensity[j])
    sums[intensity.size] = total
