"""Runs: readings side by side that fall into one cell."""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.options import Kernel, bare, bare_inlined, compiles_for

AT_ONCE = 16


@bare_inlined
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


def _sums_compiled() -> Kernel:
    """Sixteen sums at once: each number is added to those 1, 2, 4 and 8 places on, and the sum so far to all."""
    wide = ir.VectorType(ir.IntType(32), AT_ONCE)

    @intrinsic
    def summed(typingctx, intensity, first, total, sums):
        def write(context, builder, signature, arguments):
            b, (_, first, total, _) = builder, arguments
            source, target = (context.make_array(signature.args[k])(context, b, arguments[k]).data for k in (0, 3))
            narrow = ir.VectorType(source.type.pointee, AT_ONCE)
            read = b.load(b.bitcast(b.gep(source, [first]), narrow.as_pointer()))
            read.align = 1
            found, none = b.zext(read, wide), ir.Constant(wide, [0] * AT_ONCE)
            for step in (1, 2, 4, 8):
                moved = [AT_ONCE + k if k < step else k - step for k in range(AT_ONCE)]
                found = b.add(found, b.shuffle_vector(found, none, ir.Constant(wide, moved)))
            before = b.insert_element(ir.Constant(wide, ir.Undefined), total, ir.IntType(32)(0))
            found = b.add(found, b.shuffle_vector(before, ir.Constant(wide, ir.Undefined), none))
            place = b.bitcast(b.gep(target, [b.add(first, ir.IntType(64)(1))]), wide.as_pointer())
            b.store(found, place).align = 4
            return b.extract_element(found, ir.IntType(32)(AT_ONCE - 1))

        return types.uint32(intensity, first, total, sums), write

    return summed


_sixteen_sums: Kernel | None = None if numba.config.DISABLE_JIT else _sums_compiled()
_SUMS = _sixteen_sums is not None


@bare
def sum_up(intensity, sums):
    """Sums of the intensities before each reading: intensity : (n,) unsigned; sums : (n + 1,) uint32, out."""
    total, j, n = np.uint32(0), np.uint64(0), np.uint64(intensity.size)
    sums[0] = total
    if _SUMS:
        while j + np.uint64(AT_ONCE) <= n:
            total = _sixteen_sums(intensity, j, total, sums)
            j += np.uint64(AT_ONCE)
    while j < n:
        total += np.uint32(intensity[j])
        j += np.uint64(1)
        sums[j] = total
