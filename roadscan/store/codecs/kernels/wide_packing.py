"""Packs the blocks of DELTA_BINARY_PACKED a register at a time: the reverse of `wide_unpacking`.

A miniblock's 32 numbers are shifted together in pairs, the pairs in pairs, and again, which gives four runs of eight
numbers, as many bytes long as a number has bits. They are written one over the end of the other.
"""

from __future__ import annotations

import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import inner, kernel
from roadscan.compute.kernels.vectors import (
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
from roadscan.store.codecs.kernels.delta_packing import BLOCK, MINIBLOCK, MINIBLOCKS, widths_of

THERE = compiles_for("avx512f", "avx512bw", "avx512vl")
"""Whether the processor has the instructions."""

_LANES, _WIDEST = 16, 16  # 32-bit lanes of a register; bits of a number up to which `pack_block` packs
_U = np.uint64
_NUMBERS, _QUADS = ir.VectorType(I32, _LANES), ir.VectorType(I64, 8)  # a register as 32-bit and as 64-bit lanes


@intrinsic
def _differences(typingctx, values, at, above):
    """Write to `above` (128,) int32 how far the differences before 128 values exceed the least one.

    Returns that one in the low 32 bits, and above them the bit widths of the miniblocks, a byte each.
    """

    def write(context, builder, signature, arguments):
        narrow = ir.VectorType(start(context, builder, signature, arguments, 0).type.pointee, _LANES)
        first = builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]])
        to = start(context, builder, signature, arguments, 2)

        def numbers(k):
            return builder.zext(load(builder, builder.gep(first, [I64(k)]), narrow), _NUMBERS)

        rows = [builder.sub(numbers(k), numbers(k - 1)) for k in range(0, BLOCK, _LANES)]
        least = rows[0]
        for row in rows[1:]:
            least = builder.select(builder.icmp_signed("<", row, least), row, least)
        least = instruction(builder, "llvm.vector.reduce.smin.v16i32", I32, least)
        rows = [builder.sub(row, everywhere(builder, _NUMBERS, least)) for row in rows]
        widths = builder.zext(least, I64)
        for k, row in enumerate(rows):
            store(builder, row, builder.gep(to, [I64(k * _LANES)]))
        for k in range(MINIBLOCKS):
            union = builder.or_(rows[2 * k], rows[2 * k + 1])
            union = instruction(builder, "llvm.vector.reduce.or.v16i32", I32, union)
            zeros = instruction(builder, "llvm.ctlz.i32", I32, union, ir.Constant(ir.IntType(1), 0))
            width = builder.zext(builder.sub(I32(32), zeros), I64)
            widths = builder.or_(widths, builder.shl(width, I64(32 + 8 * k)))
        return widths

    return types.uint64(values, at, above), write


@intrinsic
def pack_block(typingctx, above, first, width, data, to):
    """Write 32 numbers of up to 16 bits from byte `to` on; some bytes after them are set to 0."""

    def write(context, builder, signature, arguments):
        numbers = builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]])
        width = arguments[2]
        bits = [everywhere(builder, _QUADS, builder.mul(width, I64(k))) for k in (1, 2, 4)]
        quads = [load(builder, builder.gep(numbers, [I64(k)]), _QUADS) for k in (0, _LANES)]

        def left(what, by):
            return instruction(builder, "llvm.x86.avx512.psllv.q.512", _QUADS, what, by)

        def right(what, by):
            return instruction(builder, "llvm.x86.avx512.psrlv.q.512", _QUADS, what, by)

        low = constant(_QUADS, [0xFFFF_FFFF] * 8)
        half = constant(_QUADS, [32] * 8)
        quads = [builder.or_(builder.and_(q, low), left(builder.lshr(q, half), bits[0])) for q in quads]
        even, odd = (picked(builder, *quads, range(k, 16, 2)) for k in (0, 1))
        fours = builder.or_(even, left(odd, bits[1]))
        even, odd = (picked(builder, fours, fours, [k // 2 * 2 + side for k in range(8)]) for side in (0, 1))
        above = right(odd, builder.sub(constant(_QUADS, [64] * 8), bits[2]))
        eights = picked(builder, builder.or_(even, left(odd, bits[2])), above, [k + k % 2 * 8 for k in range(8)])
        at = builder.gep(start(context, builder, signature, arguments, 3), [arguments[4]])
        for k in range(4):
            store(builder, picked(builder, eights, eights, [2 * k, 2 * k + 1]), at)
            at = builder.gep(at, [width])
        return context.get_dummy_value()

    return types.void(above, first, width, data, to), write


@inner
def _pack_wide(above, first, width, data, to):
    """Write 32 numbers of more than 16 bits."""
    bits, used = _U(0), _U(0)
    for k in range(MINIBLOCK):
        bits |= _U(above[first + _U(k)]) << used
        used += width
        while used > _U(7):
            data[to] = bits & _U(255)
            bits >>= _U(8)
            used -= _U(8)
            to += _U(1)


@inner
def _put(data, to, number):
    """Write a number as a varint; return the byte after it."""
    while number > _U(127):
        data[to] = (number & _U(127)) | _U(128)
        number >>= _U(7)
        to += _U(1)
    data[to] = number
    return to + _U(1)


@inner
def _last_differences(values, first, above):
    """Compute `_differences` for the last, fewer than 128 values; the missing ones count as the least difference."""
    least = np.int32(1 << 30)
    for k in range(values.size - first):
        above[k] = np.int32(values[first + k]) - np.int32(values[first + k - 1])
        least = min(least, above[k])
    above[values.size - first :] = least
    above -= least
    return _U(least) & _U(0xFFFF_FFFF) | widths_of(above) << _U(32)


@kernel
def encode(values, words):
    """Write the same as `delta_packing.encode`, several times as fast, on processors with the instructions."""
    data, count, to = words.view(np.uint8), values.size, _U(0)
    first = _U(values[0]) if count > 0 else _U(0)
    for number in (_U(BLOCK), _U(MINIBLOCKS), _U(count), first << _U(1)):
        to = _put(data, to, number)
    above = np.empty(BLOCK, np.int32)
    for start_value in range(1, count, BLOCK):
        if count - start_value >= BLOCK:
            found = _differences(values, _U(start_value), above)
        else:
            found = _last_differences(values, start_value, above)
        least, widths = np.int32(found & _U(0xFFFF_FFFF)), found >> _U(32)
        to = _put(data, to, _U(np.int64((least << 1) ^ (least >> 31))))
        for k in range(MINIBLOCKS):
            data[to + _U(k)] = (widths >> _U(8 * k)) & _U(255)
        to += _U(MINIBLOCKS)
        for k in range(MINIBLOCKS):
            width = (widths >> _U(8 * k)) & _U(255)
            if width > _U(_WIDEST):
                _pack_wide(above, _U(k * MINIBLOCK), width, data, to)
            else:
                pack_block(above, _U(k * MINIBLOCK), width, data, to)
            to += _U(MINIBLOCK // 8) * width
    return np.int64(to)
