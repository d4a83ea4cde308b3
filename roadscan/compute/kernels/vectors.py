"""Instructions on whole vector registers, for kernels that Numba's own loops cannot express."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))


def start(context, builder, signature, arguments, k):
    """Where the data of argument `k`, an array, begin."""
    return context.make_array(signature.args[k])(context, builder, arguments[k]).data


def load(builder, at, kind):
    """A value of a type from any address."""
    value = builder.load(builder.bitcast(at, kind.as_pointer()))
    value.align = 1
    return value


def store(builder, value, at):
    """Write a value to any address."""
    builder.store(value, builder.bitcast(at, value.type.as_pointer())).align = 1


def constant(vector, values):
    """A vector of known numbers."""
    return ir.Constant(vector, [int(value) for value in values])


def picked(builder, first, second, lanes):
    """Lanes of two vectors by their numbers, which go on from the first vector to the second."""
    return builder.shuffle_vector(first, second, constant(ir.VectorType(I32, len(lanes)), lanes))


def everywhere(builder, vector, number):
    """A vector with a number in each lane."""
    nothing = ir.Constant(vector, ir.Undefined)
    return picked(builder, builder.insert_element(nothing, number, I32(0)), nothing, [0] * vector.count)


def instruction(builder, name, result, *arguments):
    """Call an instruction by LLVM's name."""
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)
