"""Factorises eight small symmetric matrices at once: a matrix a lane, the lanes innermost.

A vector register then holds the same element of eight matrices, and each matrix has the bits that it has alone, however
small it is. Numba's loops keep no sums in registers here: the compiler cannot know that two rows do not overlap.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, bare
from roadscan.compute.kernels import vectors
from roadscan.compute.kernels.vectors import I64
from roadscan.compute.numba_internals import cgutils, ir, types

LANES = 8  # Matrices that are handled at once: 64-bit lanes of a 512-bit register.
TOGETHER = 4
"""Rows whose sums stay in registers at once; up to this many rows past the end may be computed, with any result."""
ROW = ir.VectorType(ir.DoubleType(), LANES)


def rows_of(context, builder, signature, arguments, k):
    """Return the data of argument `k`, an array whose last axis are the lanes, as a pointer to vectors."""
    return builder.bitcast(vectors.start(context, builder, signature, arguments, k), ROW.as_pointer())


@intrinsic
def _factorise(typingctx, system, root, other, inverse, product, columns, rows, width):
    def write(context, builder, signature, arguments):
        b = builder
        system, root, other, inverse, product = (rows_of(context, b, signature, arguments, k) for k in range(5))
        columns, rows, width = arguments[5:]
        ones = ir.Constant(ROW, [1.0] * LANES)
        get = lambda data, at: vectors.load(b, b.gep(data, [at]), ROW)  # noqa: E731
        determinant = cgutils.alloca_once_value(b, ones)
        with cgutils.for_range(b, columns) as loop:
            column = loop.index
            start = b.mul(column, width)
            with cgutils.for_range(b, column) as inner:
                value = b.fmul(get(root, b.add(start, inner.index)), get(inverse, inner.index))
                vectors.store(b, value, b.gep(other, [inner.index]))
            with cgutils.for_range_slice(b, column, rows, I64(TOGETHER), I64) as (first, _):
                starts = [b.mul(b.add(first, I64(k)), width) for k in range(TOGETHER)]
                sums = [cgutils.alloca_once_value(b, get(system, b.add(s, column))) for s in starts]
                own = [b.gep(root, [s]) for s in starts]
                with cgutils.for_range(b, column) as inner:
                    shared = get(other, inner.index)
                    for total, row in zip(sums, own, strict=True):
                        b.store(b.fsub(b.load(total), b.fmul(get(row, inner.index), shared)), total)
                for total, row in zip(sums, own, strict=True):
                    vectors.store(b, b.load(total), b.gep(row, [column]))
            pivot = get(root, b.add(start, column))
            vectors.store(b, b.fdiv(ones, pivot), b.gep(inverse, [column]))
            vectors.store(b, b.load(determinant), product)
            b.store(b.fmul(b.load(determinant), pivot), determinant)
        return context.get_dummy_value()

    return types.void(system, root, other, inverse, product, columns, rows, width), write


def _factorised(system, root, other, inverse, product, columns, rows):
    _factorise(system, root, other, inverse, product, columns, rows, root.shape[1])


def _by_numpy(system, root, other, inverse, product, columns, rows):
    determinant = 1.0
    with np.errstate(divide="ignore", invalid="ignore"):  # a lane without a matrix
        for column in range(columns):
            other[:column] = root[column, :column] * inverse[:column]
            total = system[column:rows, column].copy()
            for k in range(column):
                total -= root[column:rows, k] * other[k]
            root[column:rows, column] = total
            inverse[column] = 1.0 / total[0]
            product[:] = determinant
            determinant = determinant * total[0]


factorise: Kernel = _by_numpy if numba.config.DISABLE_JIT else bare(_factorised)
"""Eliminate the first columns of symmetric matrices: A = (L D) D⁻¹ (L D)ᵀ, without exchange of rows.

Parameters
----------
system : (rows + TOGETHER - 1 or more, columns or more, LANES) float64: lower triangle of A.
root : like `system`, out: lower triangle of L D. In the last column, which is not eliminated any more, stands what is
    left of A.
other, inverse : (columns or more, LANES) float64, work; out: 1 over D.
product : (LANES,), out: of the pivots D but the last.
columns, rows : int64.
"""
