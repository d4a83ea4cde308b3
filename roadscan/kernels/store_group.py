"""Statistics of sixteen cells side by side, all of one pass, to the end of the columns of a tile: as whole vectors."""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from roadscan.kernels.lanes import LANES, Lanes
from roadscan.kernels.options import Kernel

_I16, _I32, _I64, _F32, _F64 = ir.IntType(16), ir.IntType(32), ir.IntType(64), ir.FloatType(), ir.DoubleType()
_OUT, _COUNTS, _COLUMN, _ROW, _CELL, _WRITTEN, _PASS = range(7)


def _write(lanes: Lanes) -> None:
    b = lanes.b

    def put(which, value):
        place = b.bitcast(b.gep(lanes.data[which], [lanes.data[_CELL]]), value.type.as_pointer())
        b.store(value, place).align = 2

    def counting(kind, first):
        vector = ir.VectorType(kind, LANES)
        return b.add(lanes.spread(lanes.data[first], vector), ir.Constant(vector, list(range(LANES))))

    def statistic(k):
        """Row k of the table of statistics."""
        place = b.bitcast(lanes.data[_OUT], ir.VectorType(_F64, LANES).as_pointer())
        value = b.load(b.gep(place, [_I64(k)]))
        value.align = 8
        return value

    put(7, counting(_I16, _COLUMN))
    put(8, lanes.spread(lanes.data[_ROW], ir.VectorType(_I16, LANES)))
    put(9, lanes.load(_COUNTS))
    for k in range(4):
        put(10 + k, statistic(k))
    for k in range(2):
        put(14 + k, b.fptrunc(statistic(4 + k), ir.VectorType(_F32, LANES)))
    put(16, counting(_I32, _WRITTEN))
    ids = b.bitcast(
        b.gep(lanes.data[17], [b.sext(lanes.data[_WRITTEN], _I64)]), ir.VectorType(_I16, LANES).as_pointer()
    )
    b.store(lanes.spread(lanes.data[_PASS], ir.VectorType(_I16, LANES)), ids).align = 2


def _compiled() -> Kernel:
    @intrinsic
    def stored(
        typingctx, out, counts, first_column, row_number, cell, written, pass_id,
        column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
    ):  # fmt: skip
        arguments = (
            out, counts, first_column, row_number, cell, written, pass_id,
            column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
        )  # fmt: skip

        def generate(context, builder, signature, values):
            _write(Lanes(context, builder, signature, values))
            return context.get_dummy_value()

        return types.void(*arguments), generate

    return stored


def _interpreted(
    out, counts, first_column, row_number, cell, written, pass_id,
    column, row, count, mean, robust, low, high, deviation, bright, pass_offsets, pass_ids,
):  # fmt: skip
    own = slice(int(cell), int(cell) + LANES)
    column[own], row[own], count[own] = int(first_column) + np.arange(LANES), row_number, counts
    for array, values in zip((mean, robust, low, high, deviation, bright), out, strict=True):
        array[own] = values
    pass_offsets[own] = int(written) + np.arange(LANES)
    pass_ids[int(written) : int(written) + LANES] = pass_id


store_group: Kernel = _interpreted if numba.config.DISABLE_JIT else _compiled()
"""store_group(out, counts, first_column, row_number, cell, written, pass_id, column, …): see ``cells.finish_cells``.

out : (6, 16) float64; counts : (16,) int32; first_column, row_number : uint16; cell : uint64, where the sixteen go in
the columns; written : int32, where their passes go; pass_id : uint16."""
