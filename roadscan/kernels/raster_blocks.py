"""Sparse cells → the bytes of a raster's block, ready for a compressor."""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import kernel


@kernel
def encode_block(column, values, per_step, step, first, last, west, out, line, whole, shuffled):
    """Write one block of float32 pixels as TIFF's floating-point predictor wants it (TIFF Technical Note 3).

    Of each line of pixels the most significant bytes come first, then the next, down to the least; then every
    byte but the line's first is replaced by its difference from the byte before.

    Parameters
    ----------
    column : (n,) uint16, cells of a raster, ascending within a line; values : (n,) of any kind.
    per_step, step : float64; a pixel is round(value · per_step) · step.
    first, last : (lines,) int64, the cells of each line of the block, from the north; those before `west` are left
        out already. `first` moves on to the cells of the block to the east.
    west : int, column of the block's first pixel.
    out : (lines · width · 4,) uint8, out.
    line, whole : (width,) float32 and shuffled : (width · 4,) uint8, scratch.

    Returns
    -------
    int, cells in the block; all other pixels are NaN.
    """
    width = line.size
    bits = line.view(np.uint32)
    corner = np.uint64(west)
    filled = 0
    for y in range(first.size):
        start, end = first[y], last[y]
        while start < end:  # the first cell beyond the block
            middle = (start + end) >> 1
            if column[middle] < west + width:
                start = middle + 1
            else:
                end = middle
        start = first[y]
        first[y] = end
        for x in range(width):
            line[x] = np.nan
        n = end - start
        if n:
            filled += n
            own, places = values[start:end], column[start:end]
            for k in range(n):
                whole[k] = np.rint(own[k] * per_step) * step
            for k in range(n):
                line[np.uint64(places[k]) - corner] = whole[k]
        for plane in range(4):
            part = shuffled[plane * width : (plane + 1) * width]
            shift = np.uint32(24 - 8 * plane)
            for x in range(width):
                part[x] = np.uint8((bits[x] >> shift) & np.uint32(255))
        coded = out[y * 4 * width : (y + 1) * 4 * width]
        after, before, rest = shuffled[1:], shuffled[:-1], coded[1:]
        coded[0] = shuffled[0]
        for x in range(before.size):
            rest[x] = after[x] - before[x]
    return filled
