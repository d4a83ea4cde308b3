"""Parquet's BYTE_STREAM_SPLIT: first bytes of all values, then their second bytes, and so on (*Encodings.md*)."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel

_AT_ONCE = 2048
"""Values per round, which stay in the fastest cache while their planes are written."""


@kernel
def _pick(values, shift, plane):
    for i in range(plane.size):
        plane[i] = np.uint8((values[i] >> shift) & values.dtype.type(255))


@kernel
def split(values, width, planes):
    """Write the planes (width · n,) of (n,) unsigned values as numbers of `width` bytes, no fewer than theirs."""
    n = values.size
    own = min(width, values.itemsize)
    for start in range(0, n, _AT_ONCE):
        end = min(start + _AT_ONCE, n)
        for p in range(own):
            _pick(values[start:end], values.dtype.type(8 * p), planes[p * n + start : p * n + end])
    planes[own * n :] = 0


@kernel
def _round(values, per_step, step, rounded):
    for i in range(rounded.size):
        rounded[i] = np.rint(values[i] * per_step) * step


@kernel
def split_rounded(values, per_step, step, line, bits, planes):
    """Write the planes of (n,) floats, each rounded to a multiple of `step`, in the values' arithmetic.

    Parameters
    ----------
    per_step, step : of the type of the values, inverse to each other.
    line : (2048,) of that type, scratch; bits : (2048,) unsigned, the same memory.
    planes : (bytes of all values,) uint8, out.
    """
    n = values.size
    for start in range(0, n, _AT_ONCE):
        end = min(start + _AT_ONCE, n)
        _round(values[start:end], per_step, step, line[: end - start])
        for p in range(values.itemsize):
            _pick(bits[: end - start], bits.dtype.type(8 * p), planes[p * n + start : p * n + end])


@kernel
def join(first, second, third, fourth, values):
    """Write (n,) unsigned 32-bit values from their planes (n,), lowest bytes first."""
    for i in range(values.size):
        low = np.uint32(first[i]) | (np.uint32(second[i]) << np.uint32(8))
        values[i] = low | (np.uint32(third[i]) << np.uint32(16)) | (np.uint32(fourth[i]) << np.uint32(24))


@kernel
def join_low(first, second, values):
    """Write (n,) unsigned 16-bit values from their planes (n,), ignoring higher planes."""
    for i in range(values.size):
        values[i] = np.uint16(first[i]) | (np.uint16(second[i]) << np.uint16(8))
