"""Vector instructions for kernels that Numba's loops cannot express."""

from __future__ import annotations

import numba

from roadscan.compute.numba_internals import cgutils, host_features, ir


def compiles_for(*features: str) -> bool:
    """Return True if kernels are compiled for a processor with all these features (LLVM's names)."""
    stated = numba.config.CPU_FEATURES
    if numba.config.DISABLE_JIT or (stated is None and numba.config.CPU_NAME is not None):
        return False
    known = host_features() if stated is None else stated
    return {f"+{feature}" for feature in features} <= set(known.split(","))


I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))  # LLVM's types of whole numbers.


def start(context, builder, signature, arguments, k):
    """Return the address of the data of argument `k`, an array."""
    return context.make_array(signature.args[k])(context, builder, arguments[k]).data


def load(builder, at, kind):
    """Load a value of a type from an address."""
    value = builder.load(builder.bitcast(at, kind.as_pointer()))
    value.align = 1
    return value


def store(builder, value, at):
    """Write a value to an address."""
    builder.store(value, builder.bitcast(at, value.type.as_pointer())).align = 1


def constant(vector, values):
    """Return a vector of constants."""
    return ir.Constant(vector, [int(value) for value in values])


def picked(builder, first, second, lanes):
    """Return lanes of two vectors by number; the second vector's lanes are numbered after the first's."""
    return builder.shuffle_vector(first, second, constant(ir.VectorType(I32, len(lanes)), lanes))


def everywhere(builder, vector, number):
    """Return a vector with a number in each lane."""
    nothing = ir.Constant(vector, ir.Undefined)
    return picked(builder, builder.insert_element(nothing, number, I32(0)), nothing, [0] * vector.count)


def instruction(builder, name, result, *arguments):
    """Call an instruction by LLVM's name."""
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)
