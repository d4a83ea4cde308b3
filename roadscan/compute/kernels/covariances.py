"""Covariances of heights on a surface for eight groups of points at once, and factors of eight small matrices.

Matrices are factorised eight at once: a matrix a lane, the lanes innermost. A vector register then holds the same
element of eight matrices, and each matrix has the bits that it has alone, however small it is. Numba's loops keep no
sums in registers here: the compiler cannot know that two rows do not overlap.

The covariance of two heights falls with their distance by Wendland's C⁴ function, which is positive definite in the
plane (Wendland 1995, "Piecewise polynomial, positive definite and compactly supported radial functions of minimal
degree").
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, bare
from roadscan.compute.kernels import vectors
from roadscan.compute.kernels.vectors import I64, instruction
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


REACH = 12.0
"""Distance from which heights are uncorrelated."""
RISE = REACH**5 / 448.0
"""Scale of the covariance at which its term in distance⁵ has the factor −1, as in a quintic spline."""
PEAK = 3.0 * RISE  # Covariance at distance 0: the variance of a height.
STEEPEST = 56.0 * RISE / REACH**2  # Scale of the covariance between a height and a slope.


def _constant(value):
    return ir.Constant(ROW, [value] * ROW.count)


def _shares(b, u, v):
    """Return distance over REACH, and 1 less it (0 beyond)."""
    square = b.fadd(b.fmul(u, u), b.fmul(v, v))
    d = b.fmul(instruction(b, "llvm.sqrt.v8f64", ROW, square), _constant(1.0 / REACH))
    left = b.fsub(_constant(1.0), d)
    return d, b.select(b.fcmp_ordered(">", left, _constant(0.0)), left, _constant(0.0))


@intrinsic
def _rows(typingctx, u, v, out, size, width):
    def write(context, builder, signature, arguments):
        b = builder
        us, vs, data = (rows_of(context, b, signature, arguments, k) for k in range(3))
        size, width = arguments[3:]
        with cgutils.for_range(b, size) as outer:
            own = [vectors.load(b, b.gep(at, [outer.index]), ROW) for at in (us, vs)]
            start = b.mul(outer.index, width)
            with cgutils.for_range(b, outer.index) as inner:
                other = [vectors.load(b, b.gep(at, [inner.index]), ROW) for at in (us, vs)]
                d, left = _shares(b, *(b.fsub(one, two) for one, two in zip(own, other, strict=True)))
                cube = b.fmul(b.fmul(left, left), left)
                form = b.fadd(b.fmul(_constant(35.0), d), _constant(18.0))
                form = b.fadd(b.fmul(form, d), _constant(3.0))
                value = b.fmul(b.fmul(b.fmul(cube, cube), _constant(RISE)), form)
                vectors.store(b, value, b.gep(data, [b.add(start, inner.index)]))
        return context.get_dummy_value()

    return types.void(u, v, out, size, width), write


@intrinsic
def _slopes(typingctx, u, v, along_u, along_v, size):
    def write(context, builder, signature, arguments):
        b = builder
        us, vs, *outs = (rows_of(context, b, signature, arguments, k) for k in range(4))
        with cgutils.for_range(b, arguments[4]) as loop:
            own = [vectors.load(b, b.gep(at, [loop.index]), ROW) for at in (us, vs)]
            d, left = _shares(b, *own)
            square = b.fmul(left, left)
            steep = b.fadd(b.fmul(_constant(5.0), d), _constant(1.0))
            steep = b.fmul(b.fmul(b.fmul(b.fmul(square, square), left), _constant(STEEPEST)), steep)
            for offset, out in zip(own, outs, strict=True):
                vectors.store(b, b.fmul(steep, offset), b.gep(out, [loop.index]))
        return context.get_dummy_value()

    return types.void(u, v, along_u, along_v, size), write


def _covariances(u, v, out, size):
    _rows(u, v, out, size, out.shape[1])


def _slope_covariances(u, v, along_u, along_v, size):
    _slopes(u, v, along_u, along_v, size)


def _shares_by_numpy(u, v):
    d = np.sqrt(u * u + v * v) * (1.0 / REACH)
    return d, np.maximum(1.0 - d, 0.0)


def _covariances_by_numpy(u, v, out, size):
    for p in range(size):
        for q in range(p):
            d, left = _shares_by_numpy(u[p] - u[q], v[p] - v[q])
            cube = left * left * left
            out[p, q] = cube * cube * RISE * ((35.0 * d + 18.0) * d + 3.0)


def _slope_covariances_by_numpy(u, v, along_u, along_v, size):
    d, left = _shares_by_numpy(u[:size], v[:size])
    square = left * left
    steep = square * square * left * STEEPEST * (5.0 * d + 1.0)
    along_u[:size], along_v[:size] = steep * u[:size], steep * v[:size]


covariances: Kernel = _covariances_by_numpy if numba.config.DISABLE_JIT else bare(_covariances)
"""Of all pairs of the first `size` points at (u, v), as the lower triangle of `out`, without the diagonal (PEAK).

Parameters
----------
u, v : (n, LANES) float64; out : (n or more, n or more, LANES) float64.
"""
slope_covariances: Kernel = _slope_covariances_by_numpy if numba.config.DISABLE_JIT else bare(_slope_covariances)
"""Of the heights of the first `size` points at (u, v) with the slopes along u and v at the origin; all (n, LANES)."""
