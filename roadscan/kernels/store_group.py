"""Statistics of sixteen cells side by side, all of one pass, to the end of the columns of a tile: as whole vectors."""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.lanes import LANES, generator
from roadscan.kernels.options import Kernel
from roadscan.kernels.vectors import I16, I32, I64, constant, everywhere, load, store

_SHORTS, _DOUBLES, _FLOATS = (ir.VectorType(kind, LANES) for kind in (I16, ir.DoubleType(), ir.FloatType()))
_OUT, _COUNTS, _COLUMN, _ROW, _CELL, _WRITTEN, _PASS = range(7)


def _write(lanes):
    b = lanes.b

    def put(which, at, value):
        store(b, value, b.gep(lanes.data[which], [at]))

    def counting(kind, first):
        vector = ir.VectorType(kind, LANES)
        return b.add(everywhere(b, vector, lanes.data[first]), constant(vector, range(LANES)))

    table = b.bitcast(lanes.data[_OUT], _DOUBLES.as_pointer())
    statistics = [load(b, b.gep(table, [I64(k)]), _DOUBLES) for k in range(6)]
    statistics[4:] = [b.fptrunc(row, _FLOATS) for row in statistics[4:]]
    columns = [counting(I16, _COLUMN), everywhere(b, _SHORTS, lanes.data[_ROW]), lanes.load(_COUNTS), *statistics]
    for which, value in enumerate([*columns, counting(I32, _WRITTEN)], start=_PASS + 1):
        put(which, lanes.data[_CELL], value)
    put(17, b.sext(lanes.data[_WRITTEN], I64), everywhere(b, _SHORTS, lanes.data[_PASS]))


@intrinsic
def _stored(
    typingctx, out, counts, first_column, row_number, cell, written, pass_id,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    arguments = (
        out, counts, first_column, row_number, cell, written, pass_id,
        column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
    )  # fmt: skip
    return types.void(*arguments), generator(_write)


def _stored_by_numpy(
    out, counts, first_column, row_number, cell, written, pass_id,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    own = slice(int(cell), int(cell) + LANES)
    column[own], row[own], count[own] = int(first_column) + np.arange(LANES), row_number, counts
    for array, values in zip((mean, robust, low, high, deviation, bright), out, strict=True):
        array[own] = values
    pass_offsets[own] = int(written) + np.arange(LANES)
    pass_ids[int(written) : int(written) + LANES] = pass_id


store_group: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_group(out, counts, first_column, row_number, cell, written, pass_id, column, …): see ``cells.finish_cells``.

out : (6, 16) float64; counts : (16,) int32; first_column, row_number : uint16; cell : uint64, where the sixteen go in
the columns; written : int32, where their passes go; pass_id : uint16."""
