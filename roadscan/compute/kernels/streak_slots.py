"""Looks up the slots of sixteen streaks' cells at a time, where these lie in one tile and have slots already."""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, bare_inner
from roadscan.compute.kernels.processor import compiles_for
from roadscan.compute.kernels.vectors import I8, I16, I32, I64, constant, everywhere, instruction, load, start, store
from roadscan.compute.numba_internals import ir, types

AT_ONCE = 16  # Streaks that one instruction handles: 32-bit lanes of a 512-bit register.

_ROW = ir.VectorType(I32, AT_ONCE)
_GATHERS = compiles_for("avx512f")
"""Whether the processor can load sixteen numbers from arbitrary addresses at once."""


def _gathered(builder, array, index, mask):
    """Load numbers of a 32-bit array at sixteen places; 0 where the mask is not set."""
    none, array = constant(_ROW, [0] * AT_ONCE), builder.bitcast(array, I8.as_pointer())
    return instruction(builder, "llvm.x86.avx512.mask.gather.dpi.512", _ROW, none, array, index, mask, I32(4))


@intrinsic
def _found(typingctx, columns, rows, first, streaks, tile, nowhere, table, at, slots):
    def write(context, builder, signature, arguments):
        across, up, groups, out = (start(context, builder, signature, arguments, k) for k in (0, 1, 6, 8))
        first, streaks, tile, nowhere, at = (arguments[k] for k in (2, 3, 4, 5, 7))
        west, south, edge, per_row = (everywhere(builder, _ROW, builder.extract_value(tile, k)) for k in range(4))
        left = everywhere(builder, _ROW, builder.trunc(builder.sub(streaks, first), I32))
        x, y = (load(builder, builder.gep(array, [first]), _ROW) for array in (across, up))
        wanted = builder.icmp_signed("!=", x, everywhere(builder, _ROW, nowhere))
        wanted = builder.and_(wanted, builder.icmp_unsigned("<", constant(_ROW, range(AT_ONCE)), left))
        x, y = builder.sub(x, west), builder.sub(y, south)
        inside = builder.and_(builder.icmp_unsigned("<", x, edge), builder.icmp_unsigned("<", y, edge))
        inside = builder.and_(inside, wanted)
        place = builder.add(builder.mul(y, per_row), builder.lshr(x, constant(_ROW, [4] * AT_ONCE)))
        element = _gathered(builder, builder.gep(groups, [at]), place, inside)
        known = builder.and_(inside, builder.icmp_signed(">=", element, constant(_ROW, [0] * AT_ONCE)))
        slot = builder.shl(element, constant(_ROW, [4] * AT_ONCE))
        slot = builder.or_(slot, builder.and_(x, constant(_ROW, [AT_ONCE - 1] * AT_ONCE)))
        store(builder, builder.select(known, slot, constant(_ROW, [-1] * AT_ONCE)), builder.gep(out, [first]))
        unknown = builder.bitcast(builder.and_(wanted, builder.not_(known)), I16)
        return builder.zext(unknown, I64)

    return types.uint64(columns, rows, first, streaks, tile, nowhere, table, at, slots), write


@bare_inner
def _none_found(columns, rows, first, streaks, tile, nowhere, table, at, slots):
    unknown, bit = np.uint64(0), np.uint64(1)
    for streak in range(first, min(first + np.uint64(AT_ONCE), streaks)):
        slots[streak] = -1
        unknown |= bit if columns[streak] != nowhere else np.uint64(0)
        bit <<= np.uint64(1)
    return unknown


@intrinsic
def _lowest(typingctx, bits):
    def write(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), write


def _lowest_by_numpy(bits):
    return np.uint64((int(bits) & -int(bits)).bit_length() - 1)


lowest_bit: Kernel = _lowest_by_numpy if numba.config.DISABLE_JIT else _lowest
"""lowest_bit(bits): number of the lowest bit that is set of a uint64 other than 0."""

find_known_slots: Kernel = _found if _GATHERS else _none_found
"""find_known_slots(columns, rows, first, streaks, tile, nowhere, table, at, slots): slots of sixteen streaks.

columns, rows : (≥ first + 16,) int32, cells of streaks, of meaning for `streaks` of them; first, streaks : uint64, the
first of the sixteen, and how many there are in all; tile : (4,) tuple of int32, the tile's south-west cell, cells along
its edge, groups along its edge; nowhere : int32, column of readings that do not count; table : int32, element of each
group, −1 for none; at : uint64, where the tile's groups begin; slots : (≥ first + 16,) int32, out, the slot of each
streak's cell, −1 where it has none, lies elsewhere or nowhere. Returns a bit for each streak that does count, but got
no slot here."""
