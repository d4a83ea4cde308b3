"""Unpacks the blocks of DELTA_BINARY_PACKED a register at a time, in the layout of all common writers.

A miniblock's 32 numbers are brought to their 16-bit lanes by a permutation of its bytes and a shift of each lane, both
taken from a table by bit width; then they are summed up in the register, in steps of 1, 2, 4 … lanes. Numba has no such
instructions, so they are written out here. They are those of processors with AVX-512 VBMI; on others, and without the
compiler, `unpack_blocks` leaves every page to its caller.

Arithmetic is that of unsigned 16-bit numbers, wrapping, which is enough for values of up to 16 bits.
"""

from __future__ import annotations

import numpy as np
from numba.extending import intrinsic

from roadscan.compute.kernel_options import Kernel, inlined, kernel
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

READ_AHEAD_BYTES = 128
"""Bytes after a page that are read; their content does not matter."""
NOT_KNOWN = -1
"""Result for a page that these kernels cannot read: it is damaged, or has something rare in it."""

_BLOCK, _MINIBLOCK, _MINIBLOCKS = 128, 32, 4  # values of a block and of a miniblock; miniblocks of a block
_WIDEST = 32  # largest bit width
_REGISTER_BYTES = 64  # bytes of an AVX-512 register
_BYTES, _LANES, _QUADS = ir.VectorType(I8, 64), ir.VectorType(I16, 32), ir.VectorType(I64, 8)  # a register
_U = np.uint64


def _table():
    """Return (33, 3, 64) uint8: by bit width, for 32 lanes of 16 bits, their two bytes, their shifts, their masks."""
    table = np.zeros((_WIDEST + 1, 3, _REGISTER_BYTES), np.uint8)
    for width in range(_WIDEST + 1):
        bits = np.arange(_MINIBLOCK) * width
        table[width, 0, 0::2], table[width, 0, 1::2] = bits // 8, bits // 8 + 1
        table[width, 1].view(np.uint16)[:] = bits % 8
        table[width, 2].view(np.uint16)[:] = ((1 << width) - 1) & 0xFFFF
    return table


_TABLE = _table()


def _lanes(builder, data, row):
    """Return the numbers of a miniblock in their lanes; `row` is that of its width in the table."""
    halves = [load(builder, builder.gep(data, [I64(k)]), _BYTES) for k in (0, _REGISTER_BYTES)]
    low = load(builder, row, _BYTES)
    high = builder.add(low, constant(_BYTES, [2] * 64))
    low, high = (
        instruction(builder, "llvm.x86.avx512.vpermi2var.qi.512", _BYTES, halves[0], which, halves[1])
        for which in (low, high)
    )
    shift, mask = (load(builder, builder.gep(row, [I64(k * _REGISTER_BYTES)]), _LANES) for k in (1, 2))
    high, low = builder.bitcast(high, _LANES), builder.bitcast(low, _LANES)
    return builder.and_(instruction(builder, "llvm.fshr.v32i16", _LANES, high, low, shift), mask)


def _sums(builder, lanes):
    """Return prefix sums of the lanes."""
    for bits in (16, 32):
        shifted = builder.shl(builder.bitcast(lanes, _QUADS), constant(_QUADS, [bits] * 8))
        lanes = builder.add(lanes, builder.bitcast(shifted, _LANES))
    zero, outside = constant(_LANES, [0] * _MINIBLOCK), _MINIBLOCK
    for span in (4, 8, 16):
        last = [k // span * span - 1 if k // span % 2 else outside for k in range(_MINIBLOCK)]
        lanes = builder.add(lanes, picked(builder, lanes, zero, last))
    return lanes


@intrinsic
def _unpack_block(typingctx, data, at, widths, step, value, table, values, to):
    """Write 128 values that follow `value`; widths are one byte per miniblock. Returns the last value."""

    def write(context, builder, signature, arguments):
        at, widths, step, value = arguments[1:5]
        starts = (start(context, builder, signature, arguments, k) for k in (0, 5, 6))
        data, table, values = starts
        steps, before = (everywhere(builder, _LANES, builder.trunc(number, I16)) for number in (step, value))
        narrow = signature.args[6].dtype == types.uint8
        for k in range(_MINIBLOCKS):
            width = builder.and_(builder.lshr(widths, I64(8 * k)), I64(255))
            row = builder.gep(table, [builder.mul(width, I64(3 * _REGISTER_BYTES))])
            lanes = builder.add(_lanes(builder, builder.gep(data, [at]), row), steps)
            lanes = builder.add(_sums(builder, lanes), before)
            before = picked(builder, lanes, lanes, [_MINIBLOCK - 1] * _MINIBLOCK)
            lanes = builder.trunc(lanes, ir.VectorType(I8, _MINIBLOCK)) if narrow else lanes
            store(builder, lanes, builder.gep(values, [builder.add(arguments[7], I64(k * _MINIBLOCK))]))
            at = builder.add(at, builder.mul(width, I64(_MINIBLOCK // 8)))
        return builder.zext(builder.extract_element(before, I32(0)), I64)

    return types.uint64(data, at, widths, step, value, table, values, to), write


@intrinsic
def _word(typingctx, data, at):
    """Return 64 bits from byte `at` on."""

    def write(context, builder, signature, arguments):
        return load(builder, builder.gep(start(context, builder, signature, arguments, 0), [arguments[1]]), I64)

    return types.uint64(data, at), write


@inlined
def _signed(zigzag):
    return (zigzag >> _U(1)) ^ (_U(0) - (zigzag & _U(1)))


def _unpack_blocks(data, at, end, zigzag, values):
    at, end, to, left = _U(at), _U(end), _U(1), values.size - 1
    value = _signed(zigzag)
    spare = np.empty(_BLOCK, values.dtype)
    values[0] = value
    while left > 0:
        head = _word(data, at)
        second = (head >> _U(7)) & _U(1)
        third = second & (head >> _U(15))
        if third & (head >> _U(23)):
            return NOT_KNOWN
        size = _U(1) + second + third
        zigzag = (head & _U(0x7F)) | ((head >> _U(1)) & _U(0x3F80)) | ((head >> _U(2)) & _U(0x1F_C000))
        zigzag &= (_U(1) << (_U(7) * size)) - _U(1)
        step = _signed(zigzag)
        widths = (head >> (_U(8) * size)) & _U(0xFFFF_FFFF)
        at += size + _U(_MINIBLOCKS)
        if at > end:
            return NOT_KNOWN
        if left < _BLOCK:  # miniblocks without values may have any width, and have no bytes
            widths &= (_U(1) << (_U(8) * _U((left + _MINIBLOCK - 1) // _MINIBLOCK))) - _U(1)
        if (((widths & _U(0x7F7F_7F7F)) + _U(0x5F5F_5F5F)) | widths) & _U(0x8080_8080):  # a width above 32
            return NOT_KNOWN
        following = at + _U(_MINIBLOCK // 8) * (((widths * _U(0x0101_0101)) >> _U(24)) & _U(255))
        if following > end:
            return NOT_KNOWN
        if left >= _BLOCK:
            value = _unpack_block(data, at, widths, step, value, _TABLE, values, to)
            to += _U(_BLOCK)
        else:
            _unpack_block(data, at, widths, step, value, _TABLE, spare, _U(0))
            for k in range(left):
                values[to + _U(k)] = spare[k]
        at = following
        left -= _BLOCK
    return np.int64(at)


def _left_to_others(data, at, end, zigzag, values):
    return NOT_KNOWN


def _chosen() -> Kernel:
    return kernel(_unpack_blocks if compiles_for("avx512f", "avx512bw", "avx512vbmi") else _left_to_others)


unpack_blocks = _chosen()
"""Write the values of blocks of 128 numbers in 4 miniblocks; return the byte after the last one, or NOT_KNOWN.

Its arguments: data (b,) uint8, the page's buffer, READ_AHEAD_BYTES longer than the page; at, end: bytes where the first
block begins and where the page ends; zigzag: the first value as the page states it, uint64; values (n,) uint16 or
uint8, contiguous, n > 0, out.
"""
