"""Streaks, runs of consecutive readings in one cell, sixteen readings at a time, and the slots of their cells."""

from __future__ import annotations

import numba
import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, bare, bare_inlined, bare_inner
from roadscan.compute.kernels.vectors import (
    I8,
    I16,
    I32,
    I64,
    compiles_for,
    constant,
    everywhere,
    instruction,
    load,
    picked,
    start,
    store,
)
from roadscan.compute.numba_internals import ir, types

AT_ONCE = 16  # Readings that one instruction handles: 32-bit lanes of a 512-bit register.

_ROW = ir.VectorType(I32, AT_ONCE)
_COMPRESSES = compiles_for("avx512f")
"""Whether the processor can store selected lanes of a register contiguously."""
_COMPILED = not numba.config.DISABLE_JIT


@bare_inlined
def _starts_one_by_one(column, row, first, end, starts, columns, rows, streaks):
    """Record the readings from `first` to `end` − 1 whose cell differs from that of the reading before."""
    for j in range(first, end):
        starts[streaks], columns[streaks], rows[streaks] = j, column[j], row[j]
        streaks += np.uint64((column[j] != column[j - np.uint64(1)]) | (row[j] != row[j - np.uint64(1)]))
    return streaks


@intrinsic
def _starts_of_sixteen(typingctx, column, row, first, starts, columns, rows, streaks):
    """Do the same for the sixteen readings from `first`; return the number of streaks so far."""

    def write(context, builder, signature, arguments):
        first, streaks = arguments[2], arguments[6]
        before = builder.sub(first, I64(1))
        cells, differ = [], []
        for k in (0, 1):
            at = start(context, builder, signature, arguments, k)
            own, last = (load(builder, builder.gep(at, [place]), _ROW) for place in (first, before))
            cells.append(own)
            differ.append(builder.icmp_signed("!=", own, last))
        new = builder.or_(*differ)
        numbers = builder.add(everywhere(builder, _ROW, builder.trunc(first, I32)), constant(_ROW, range(AT_ONCE)))
        for k, values in zip((3, 4, 5), (numbers, *cells), strict=True):
            # Into a register, then to memory: AMD's Zen 4 takes a hundred cycles for both in one instruction.
            packed = instruction(builder, "llvm.x86.avx512.mask.compress.v16i32", _ROW, values, values, new)
            store(builder, packed, builder.gep(start(context, builder, signature, arguments, k), [streaks]))
        count = builder.ctpop(builder.bitcast(new, ir.IntType(AT_ONCE)))
        return builder.add(streaks, builder.zext(count, I64))

    return types.uint64(column, row, first, starts, columns, rows, streaks), write


@bare
def find_streaks(column, row, starts, columns, rows):
    """Find where readings of another cell begin; return the number of such streaks.

    column, row : (n,) int32, cells of readings; starts : (n + 1,) uint32, out, each streak's first reading, n behind
    the last; columns, rows : (n,) int32, out, its cell.
    """
    starts[0], columns[0], rows[0] = 0, column[0], row[0]
    streaks, j, n = np.uint64(1), np.uint64(1), np.uint64(column.size)
    if _COMPRESSES:
        while j + np.uint64(AT_ONCE) <= n:
            streaks = _starts_of_sixteen(column, row, j, starts, columns, rows, streaks)
            j += np.uint64(AT_ONCE)
    streaks = _starts_one_by_one(column, row, j, n, starts, columns, rows, streaks)
    starts[streaks] = n
    return streaks


@intrinsic
def _sums_of_sixteen(typingctx, intensity, first, total, sums):
    """Compute cumulative sums of sixteen numbers by adding each to those 1, 2, 4 and 8 places on; return the last."""

    def write(context, builder, signature, arguments):
        first = arguments[1]
        source, target = (start(context, builder, signature, arguments, k) for k in (0, 3))
        narrow = ir.VectorType(source.type.pointee, AT_ONCE)
        found = builder.zext(load(builder, builder.gep(source, [first]), narrow), _ROW)
        none = constant(_ROW, [0] * AT_ONCE)
        for step in (1, 2, 4, 8):
            moved = picked(builder, none, found, [k if k < step else AT_ONCE + k - step for k in range(AT_ONCE)])
            found = builder.add(found, moved)
        found = builder.add(found, everywhere(builder, _ROW, arguments[2]))
        store(builder, found, builder.gep(target, [builder.add(first, I64(1))]))
        return builder.extract_element(found, I32(AT_ONCE - 1))

    return types.uint32(intensity, first, total, sums), write


@bare
def sum_up(intensity, sums):
    """Compute the sums of the intensities before each reading: intensity (n,) unsigned; sums (n + 1,) uint32, out."""
    total, j, n = np.uint32(0), np.uint64(0), np.uint64(intensity.size)
    sums[0] = total
    if _COMPILED:
        while j + np.uint64(AT_ONCE) <= n:
            total = _sums_of_sixteen(intensity, j, total, sums)
            j += np.uint64(AT_ONCE)
    while j < n:
        total += np.uint32(intensity[j])
        j += np.uint64(1)
        sums[j] = total


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
