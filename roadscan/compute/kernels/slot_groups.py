"""Turns the sixteen slots of a group into a table of heights with a column a cell, and reads their headers.

A slot has the heights of one cell; statistics need rows with heights of every cell. So the slots are transposed in
registers, two heights at a time.
"""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel
from roadscan.compute.kernels.column_statistics import generator
from roadscan.compute.kernels.height_slots import (
    COUNTS,
    LANES,
    LIGHT_SHIFT,
    LIGHTS,
    MARK_SHIFT,
    SLOT_HEIGHTS,
    SLOT_SIZE,
)
from roadscan.compute.kernels.slot_statistics import heights_of
from roadscan.compute.kernels.vectors import I16, I32, I64, constant, load, picked, start
from roadscan.compute.numba_internals import ir, types

_LINE = ir.VectorType(I32, LANES)


def _turned(b, rows):
    """Transpose 16 rows by interleaving every row with the one eight rows further on, four times."""
    halves = [[n for k in range(8) for n in (first + k, LANES + first + k)] for first in (0, LANES // 2)]
    for _ in range(4):
        rows = [picked(b, rows[k], rows[k + 8], half) for k in range(8) for half in halves]
    return rows


def _write(lanes):
    b = lanes.b
    first = b.bitcast(b.gep(lanes.data[0], [lanes.data[1]]), _LINE.as_pointer())
    rows = _turned(b, [load(b, b.gep(first, [I64(k)]), _LINE) for k in range(LANES)])
    for k in range(SLOT_HEIGHTS // 2):
        lanes.store(2, rows[k], k)
    low, high = rows[-2:]
    lanes.store(3, b.and_(low, lanes.all(COUNTS)))
    lanes.store(4, b.and_(b.lshr(low, lanes.all(LIGHT_SHIFT)), lanes.all(LIGHTS)))
    lanes.store(5, b.lshr(high, lanes.all(MARK_SHIFT - 32)))


def _write_apart(lanes):
    b, sixteen = lanes.b, lanes.all(16)
    for k in range(SLOT_HEIGHTS // 2):
        row = lanes.load(0, k)
        lanes.store(1, b.ashr(b.shl(row, sixteen), sixteen), 2 * k)
        lanes.store(1, b.ashr(row, sixteen), 2 * k + 1)


@intrinsic
def _opened(typingctx, slots, first, pairs, counts, light, marks):
    return types.void(slots, first, pairs, counts, light, marks), generator(_write)


@intrinsic
def _put_apart(typingctx, pairs, heights):
    return types.void(pairs, heights), generator(_write_apart)


@intrinsic
def _chained(typingctx, chain, first):
    def write(context, builder, signature, arguments):
        own = load(builder, builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]]), _LINE)
        longer = builder.icmp_signed(">=", own, constant(_LINE, [0] * LANES))
        return builder.zext(builder.bitcast(longer, I16), I64)

    return types.uint64(chain, first), write


def _opened_by_numpy(slots, first, pairs, counts, light, marks):
    own = slots[int(first) : int(first) + LANES * SLOT_SIZE].reshape(LANES, SLOT_SIZE)
    pairs[:] = np.ascontiguousarray(own[:, :SLOT_HEIGHTS]).view(np.int32).T
    header = np.ascontiguousarray(own[:, SLOT_HEIGHTS:]).view(np.uint64)[:, 0].astype(object)
    counts[:] = [h & COUNTS for h in header]
    light[:] = [h >> LIGHT_SHIFT & LIGHTS for h in header]
    marks[:] = [h >> MARK_SHIFT for h in header]


def _put_apart_by_numpy(pairs, heights):
    heights[:SLOT_HEIGHTS] = heights_of(pairs)


def _chained_by_numpy(chain, first):
    return np.uint64(sum(1 << k for k in range(LANES) if chain[int(first) + k] >= 0))


open_group: Kernel = _opened_by_numpy if numba.config.DISABLE_JIT else _opened
"""open_group(slots, first, pairs, counts, light, marks): slots of a group, see ``height_slots``.

slots : (m,) int16; first : uint64, where the group begins; pairs : (SLOT_HEIGHTS / 2, LANES) int32, out, two heights
each, relative to the bases, see ``slot_statistics``; counts, light, marks : (LANES,) int32, out: heights, sum of
intensities and passes of each slot."""

put_apart: Kernel = _put_apart_by_numpy if numba.config.DISABLE_JIT else _put_apart
"""put_apart(pairs, heights): each height of the pairs of `open_group` as a number.

heights : (≥ SLOT_HEIGHTS, LANES) int32, out."""

chained_cells: Kernel = _chained_by_numpy if numba.config.DISABLE_JIT else _chained
"""chained_cells(chain, first): a bit for each of sixteen cells that has more than one slot; first : uint64."""
