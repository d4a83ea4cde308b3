"""Encodes pixels or sparse cells as the predicted bytes of a raster's block, before compression.

TIFF's floating-point predictor (TIFF Technical Note 3): of each line of pixels the most significant bytes come first,
then the next, down to the least; then every byte but the line's first is replaced by its difference from the byte
before.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inner
from roadscan.compute.kernels.copies import copy_values

EMPTY_LINE = (0x7F, 0xC0 - 0x7F, 0x100 - 0xC0, 0)
"""Bytes at the start of each plane of a line of NaN; all its other bytes are 0."""


@bare
def cut_lines(column, starts, width, cuts):
    """Find the first cell of each line at or east of the west edge of each block of `width` columns.

    Parameters
    ----------
    column : (n,) uint16, ascending within a line; starts : (lines + 1,) int64, first cell of each line.
    cuts : (blocks + 1, lines) int64, out.
    """
    for line in range(starts.size - 1):
        start, end = starts[line], starts[line + 1]
        cuts[0, line] = start
        for block in range(1, cuts.shape[0]):
            low, high = start, end
            while low < high:
                middle = (low + high) >> 1
                if column[middle] < block * width:
                    low = middle + 1
                else:
                    high = middle
            cuts[block, line] = start = low


@bare
def round_values(values, per_step, step, rounded):
    """Round (n,) values of any type to multiples of `step`; rounded (n,) float32, out."""
    for k in range(rounded.size):
        rounded[k] = np.rint(values[k] * per_step) * step


@bare_inner
def _scatter(column, values, west, line):
    for i in range(column.size):
        line[np.uint64(np.int64(column[i]) - west)] = values[i]


@bare_inner
def _subtract(bytes_, before, differences):
    for i in range(differences.size):
        differences[i] = bytes_[i] - before[i]


@bare
def _pick(words, shift, plane):
    """Write one byte of each word."""
    for x in range(plane.size):
        plane[x] = np.uint8((words[x] >> shift) & np.uint32(255))


@bare_inner
def _encode_line(pixels, differences, by_byte, coded):
    width = differences.size
    _subtract(pixels[4:], pixels[:-4], by_byte[4:])
    for plane in range(4):
        _pick(differences, np.uint32(24 - 8 * plane), coded[plane * width : (plane + 1) * width])
        before = pixels[4 * width - 1 - (plane - 1)] if plane > 0 else np.uint8(0)
        coded[plane * width] = pixels[3 - plane] - before


@bare
def encode_block(block, out, line, pixels, differences, by_byte):
    """Write a block of float32 pixels (lines, width) with the predictor; other arguments as of `encode_cells`."""
    width = line.size
    for y in range(block.shape[0]):
        copy_values(block[y], line)
        _encode_line(pixels, differences, by_byte, out[y * 4 * width : (y + 1) * 4 * width])


@bare
def encode_cells(column, values, first, last, west, out, line, pixels, differences, by_byte):
    """Write one block of float32 pixels with the predictor; NaN where no cell is.

    Parameters
    ----------
    column : (n,) uint16, of the cells of a raster, which are sorted by row, column; values : (n,) float32.
    first, last : (lines,) int64, the first cell of each line of the block, from the north, and the first beyond it.
    west : int, column of the block's first pixel.
    out : (lines · width · 4,) uint8, out.
    line : (width,) float32 and differences : (width,) uint32, scratch; pixels, by_byte : uint8, the same memory.
    """
    width = line.size
    line[:] = np.nan
    for y in range(first.size):
        start, end = first[y], last[y]
        coded = out[y * 4 * width : (y + 1) * 4 * width]
        n = end - start
        if n == 0:
            coded[:] = 0
            for plane in range(4):
                coded[plane * width] = EMPTY_LINE[plane]
            continue
        if column[end - 1] - column[start] == n - 1:
            at = np.int64(column[start]) - west
            copy_values(values[start:end], line[at : at + n])
        else:
            _scatter(column[start:end], values[start:end], west, line)
        _encode_line(pixels, differences, by_byte, coded)
        line[np.int64(column[end - n]) - west : np.int64(column[end - 1]) - west + 1] = np.nan
