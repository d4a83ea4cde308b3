"""The sixteen lines of a group → a table of heights with a column for each cell, and what the headers say.

A line is a cell's; statistics want rows that hold one height of every cell. So the lines are turned in registers.
"""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.accumulate import COUNTS, LANES, LIGHT_SHIFT, LIGHTS, LINE, MARK_SHIFT, SLOTS
from roadscan.kernels.lanes import generator
from roadscan.kernels.options import Kernel
from roadscan.kernels.vectors import I32, I64, load, picked

_LINE = ir.VectorType(I32, LANES)


def _turned(b, rows):
    """Transpose 16 rows: to put every row between those of eight rows further on, four times."""
    halves = [[n for k in range(8) for n in (first + k, LANES + first + k)] for first in (0, LANES // 2)]
    for _ in range(4):
        rows = [picked(b, rows[k], rows[k + 8], half) for k in range(8) for half in halves]
    return rows


def _write(lanes):
    b = lanes.b
    first = b.bitcast(b.gep(lanes.data[0], [lanes.data[1]]), _LINE.as_pointer())
    rows = _turned(b, [load(b, b.gep(first, [I64(k)]), _LINE) for k in range(LANES)])
    sixteen = lanes.all(16)
    for k in range(SLOTS // 2):
        lanes.store(2, b.ashr(b.shl(rows[k], sixteen), sixteen), 2 * k)
        lanes.store(2, b.ashr(rows[k], sixteen), 2 * k + 1)
    low, high = rows[-2:]
    lanes.store(3, b.and_(low, lanes.all(COUNTS)))
    lanes.store(4, b.and_(b.lshr(low, lanes.all(LIGHT_SHIFT)), lanes.all(LIGHTS)))
    lanes.store(5, b.lshr(high, lanes.all(MARK_SHIFT - 32)))


@intrinsic
def _opened(typingctx, lines, first, heights, counts, light, marks):
    return types.void(lines, first, heights, counts, light, marks), generator(_write)


def _opened_by_numpy(lines, first, heights, counts, light, marks):
    own = lines[int(first) : int(first) + LANES * LINE].reshape(LANES, LINE)
    heights[:SLOTS] = own[:, :SLOTS].T
    header = np.ascontiguousarray(own[:, SLOTS:]).view(np.uint64)[:, 0].astype(object)
    counts[:] = [h & COUNTS for h in header]
    light[:] = [h >> LIGHT_SHIFT & LIGHTS for h in header]
    marks[:] = [h >> MARK_SHIFT for h in header]


open_group: Kernel = _opened_by_numpy if numba.config.DISABLE_JIT else _opened
"""open_group(lines, first, heights, counts, light, marks): the lines of a group, see ``kernels.accumulate``.

lines : (m,) int16; first : uint64, where the group begins; heights : (≥ SLOTS, LANES) int32, out, relative to the
bases; counts, light, marks : (LANES,) int32, out: heights, sum of intensities and passes of each line."""
