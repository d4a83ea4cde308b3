"""Sixteen cells at a time: medians of columns of a small table, by sorting networks on vector registers.

Numba's own loops over such a table stay scalar: the compiler cannot know that two rows do not overlap. So the
rows are loaded into registers here, and the network (Batcher 1968, "Sorting networks and their applications",
odd-even mergesort) is written out as instructions. Without the compiler NumPy does the same.
"""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.options import Kernel, kernel

LANES = 16
LARGEST = np.int32(2**31 - 1)


def exchanges(n):
    """Pairs (i, j), i < j, that sort n rows when each is put in order one after another."""
    pairs = []
    p = 1
    while p < n:
        k = p
        while k >= 1:
            pairs += [
                (i + j, i + j + k)
                for j in range(k % p, n - k, 2 * k)
                for i in range(min(k, n - j - k))
                if (i + j) // (2 * p) == (i + j + k) // (2 * p)
            ]
            k //= 2
        p *= 2
    return pairs


def _sorted(builder, rows, pairs):
    for i, j in pairs:
        less = builder.icmp_signed("<", rows[i], rows[j])
        rows[i], rows[j] = builder.select(less, rows[i], rows[j]), builder.select(less, rows[j], rows[i])
    return rows


def _picked(builder, rows, index):
    """Of each lane the row of its own index."""
    found = rows[0]
    for k, row in enumerate(rows[1:], start=1):
        found = builder.select(builder.icmp_signed("==", index, _all(k)), row, found)
    return found


def _all(value):
    vector = ir.VectorType(ir.IntType(32), LANES)
    return ir.Constant(vector, [int(value)] * LANES)


def _compiled(n):
    pairs = exchanges(n)
    vector = ir.VectorType(ir.IntType(32), LANES)

    @intrinsic
    def medians_of(typingctx, heights, counts, median, deviation):
        def write(context, builder, signature, arguments):
            data = [
                context.make_array(t)(context, builder, a).data for t, a in zip(signature.args, arguments, strict=True)
            ]

            def place(which, k=0):
                return builder.bitcast(
                    builder.gep(data[which], [ir.Constant(ir.IntType(64), LANES * k)]), vector.as_pointer()
                )

            def load(which, k=0):
                value = builder.load(place(which, k))
                value.align = 4
                return value

            def store(which, value):
                builder.store(value, place(which)).align = 4

            count = load(1)
            there = [builder.icmp_signed(">", count, _all(k)) for k in range(n)]
            middle = builder.ashr(builder.sub(count, _all(1)), _all(1))
            rows = [builder.select(there[k], load(0, k), _all(LARGEST)) for k in range(n)]
            rows = _sorted(builder, rows, pairs)
            centre = _picked(builder, rows, middle)
            away = []
            for k, row in enumerate(rows):
                above = builder.sub(row, centre)
                size = builder.select(builder.icmp_signed("<", above, _all(0)), builder.neg(above), above)
                away.append(builder.select(there[k], size, _all(LARGEST)))
            store(2, centre)
            store(3, _picked(builder, _sorted(builder, away, pairs), middle))
            return context.get_dummy_value()

        return types.void(heights, counts, median, deviation), write

    def medians(heights, counts, median, deviation):
        medians_of(heights, counts, median, deviation)

    return kernel(medians)


def _interpreted(n):
    def medians(heights, counts, median, deviation):
        for lane in range(LANES):
            count = counts[lane]
            if count > 0:
                own = np.sort(heights[:count, lane])
                median[lane] = own[(count - 1) // 2]
                deviation[lane] = np.sort(np.abs(own - median[lane]))[(count - 1) // 2]

    return medians


def medians_of(n: int) -> Kernel:
    """The kernel that finds the medians of up to `n` heights a lane.

    Its arguments: heights (n, 16) int32, of which the first `counts` (16,) int32 of each lane count, differences of
    no more than 2³¹; median (16,) int32, out, the lower one for an even count; deviation (16,) int32, out, the lower
    median of the distances from it (MAD). Lanes without a height get any value.
    """
    return _interpreted(n) if numba.config.DISABLE_JIT else _compiled(n)


medians_of_8, medians_of_16, medians_of_32, medians_of_64 = (medians_of(n) for n in (8, 16, 32, 64))
