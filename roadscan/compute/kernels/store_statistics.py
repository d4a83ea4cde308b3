"""Writes statistics of sixteen adjacent cells, all of one pass, to the columns of a tile as whole vectors."""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel
from roadscan.compute.kernels.column_statistics import LANES, generator
from roadscan.compute.kernels.vectors import I16, I32, I64, constant, everywhere, load, store
from roadscan.compute.numba_internals import ir, types

_SHORTS, _DOUBLES, _FLOATS = (ir.VectorType(kind, LANES) for kind in (I16, ir.DoubleType(), ir.FloatType()))
_OUT, _COUNTS, _COLUMN, _ROW, _CELL, _WRITTEN, _PASS, _COLUMNS = range(8)  # Places of the arguments of `store_group`.


def _write_to(kinds, context):
    """Writer to the columns of an argument that is a tuple of arrays of these types."""

    def write(lanes):
        b = lanes.b

        def put(k, at, value):
            array = context.make_array(kinds[k])(context, b, b.extract_value(lanes.data[_COLUMNS], k))
            store(b, value, b.gep(array.data, [at]))

        def counting(kind, first):
            vector = ir.VectorType(kind, LANES)
            return b.add(everywhere(b, vector, lanes.data[first]), constant(vector, range(LANES)))

        table = b.bitcast(lanes.data[_OUT], _DOUBLES.as_pointer())
        statistics = [load(b, b.gep(table, [I64(k)]), _DOUBLES) for k in range(6)]
        statistics[4:] = [b.fptrunc(row, _FLOATS) for row in statistics[4:]]
        cells = [counting(I16, _COLUMN), everywhere(b, _SHORTS, lanes.data[_ROW]), lanes.load(_COUNTS), *statistics]
        for k, value in enumerate([*cells, counting(I32, _WRITTEN)]):
            put(k, lanes.data[_CELL], value)
        put(len(cells) + 1, b.sext(lanes.data[_WRITTEN], I64), everywhere(b, _SHORTS, lanes.data[_PASS]))

    return write


@intrinsic
def _stored(typingctx, out, counts, first_column, row_number, cell, written, pass_id, columns):
    def write(context, builder, signature, arguments):
        return generator(_write_to(columns.types, context))(context, builder, signature, arguments)

    return types.void(out, counts, first_column, row_number, cell, written, pass_id, columns), write


def _stored_by_numpy(out, counts, first_column, row_number, cell, written, pass_id, columns):
    own = slice(int(cell), int(cell) + LANES)
    columns.column[own], columns.row[own] = int(first_column) + np.arange(LANES), row_number
    columns.readings[own] = counts
    for array, values in zip(columns[3:9], out, strict=True):
        array[own] = values
    columns.pass_offsets[own] = int(written) + np.arange(LANES)
    columns.pass_ids[int(written) : int(written) + LANES] = pass_id


store_group: Kernel = _stored_by_numpy if numba.config.DISABLE_JIT else _stored
"""store_group(out, counts, first_column, row_number, cell, written, pass_id, columns): statistics of sixteen cells.

out : (6, 16) float64; counts : (16,) int32; first_column, row_number : uint16; cell : uint64, where the sixteen go in
the columns; written : int32, where their passes go; pass_id : uint16; columns : ``CellColumns`` (`tiles`)."""
