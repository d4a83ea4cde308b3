"""CRC-32 of long runs of bytes by multiplication without carries, 256 bytes at a time.

Two 64-bit halves of 128 bits may be taken out of the data if they are added (xor) 256 bytes later, each times the rest
of a power of x modulo the CRC's polynomial (Gopal et al., 2009, *Fast CRC computation for generic polynomials using
PCLMULQDQ instruction*). What is left of any data is its last 256 bytes and those that do not fill 256.
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from roadscan.kernels.options import kernel
from roadscan.kernels.processor import compiles_for
from roadscan.kernels.vectors import I8, I64, constant, instruction, load, start, store

STEP_BYTES = 256
THERE = compiles_for("avx512f", "vpclmulqdq")
"""Whether the processor can do it."""

_QUADS = ir.VectorType(I64, 8)
_REGISTERS = 4
_POLYNOMIAL = 0x1_04C1_1DB7


def _power(exponent):
    """X to a power, modulo the polynomial; the bit of x^k is bit k."""
    rest = 1
    for _ in range(exponent):
        rest <<= 1
        rest ^= _POLYNOMIAL if rest >> 32 else 0
    return rest


def _factor(exponent):
    """A power as 64 bits of data have it: the highest power in the lowest bit. A product is one power too high."""
    return int(f"{_power(exponent - 1):064b}"[::-1], 2)


_FACTORS = [_factor(8 * STEP_BYTES + 64), _factor(8 * STEP_BYTES)] * 4


@intrinsic
def _fold(typingctx, data, steps, register, rest):
    def write(context, builder, signature, arguments):
        data, steps, register = start(context, builder, signature, arguments, 0), arguments[1], arguments[2]
        rest = start(context, builder, signature, arguments, 3)
        places = [I64(k * STEP_BYTES // _REGISTERS) for k in range(_REGISTERS)]
        held = [cgutils.alloca_once_value(builder, load(builder, builder.gep(data, [at]), _QUADS)) for at in places]
        begun = builder.insert_element(constant(_QUADS, [0] * 8), register, I64(0))
        builder.store(builder.xor(builder.load(held[0]), begun), held[0])
        factors = constant(_QUADS, _FACTORS)
        with cgutils.for_range(builder, builder.sub(steps, I64(1))) as loop:
            before = builder.gep(data, [builder.mul(builder.add(loop.index, I64(1)), I64(STEP_BYTES))])
            for own, at in zip(held, places, strict=True):
                low, high = (
                    instruction(builder, "llvm.x86.pclmulqdq.512", _QUADS, builder.load(own), factors, I8(which))
                    for which in (0x00, 0x11)
                )
                added = load(builder, builder.gep(before, [at]), _QUADS)
                builder.store(builder.xor(builder.xor(low, high), added), own)
        for own, at in zip(held, places, strict=True):
            store(builder, builder.load(own), builder.gep(rest, [at]))
        return context.get_dummy_value()

    return types.void(data, steps, register, rest), write


@kernel
def fold(data, register, rest):
    """Fold whole steps of data into 256 bytes.

    Parameters
    ----------
    data
        (n,) uint8, STEP_BYTES or more.
    register
        uint64: the CRC's register (32 bits) before the data.
    rest
        (STEP_BYTES,) uint8, out: bytes whose CRC, from a register of 0, is that of the first n // STEP_BYTES steps.
    """
    _fold(data, data.size // STEP_BYTES, register, rest)
