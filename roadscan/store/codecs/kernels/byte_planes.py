"""Bytes before compression: Parquet's BYTE_STREAM_SPLIT and RLE_DICTIONARY, and predicted bytes of a raster's block.

Of RLE_DICTIONARY, columns that keep a value for many rows have the runs, never the bit-packed groups. A page begins
with the bits of an index; each run is twice its length as a varint, then the index in whole bytes (Apache Parquet
format, *Encodings.md*, "RLE / bit-packing hybrid").

Of a raster's block, pixels or sparse cells are encoded by TIFF's floating-point predictor (TIFF Technical Note 3). Of
each line of pixels the most significant bytes come first, then the next, down to the least; then every byte but the
line's first is replaced by its difference from the byte before.
"""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import bare, bare_inner, kernel
from roadscan.compute.kernels.arrays import copy_values

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


LONGEST_RUN_BYTES = 14
"""Bytes of a run at most: a varint of 64 bits, and an index of 32."""
_MOST_BITS = 32  # of an index
_U = np.uint64


@kernel
def encode_runs(lengths, indices, bits, page):
    """Write the page of runs (r,) of dictionary indices of `bits` bits; return its bytes.

    Parameters
    ----------
    lengths, indices : int64; no run is empty.
    page : (1 + LONGEST_RUN_BYTES · r,) uint8, out.
    """
    page[0] = bits
    at = 1
    for k in range(lengths.size):
        head = _U(lengths[k]) << _U(1)
        while head > _U(127):
            page[at] = np.uint8(head & _U(127)) | np.uint8(128)
            head >>= _U(7)
            at += 1
        page[at] = np.uint8(head)
        at += 1
        for byte in range((bits + 7) // 8):
            page[at] = np.uint8((_U(indices[k]) >> _U(8 * byte)) & _U(255))
            at += 1
    return at


@kernel
def decode_runs(page, rows, known, ends, indices):
    """Write the runs of a page: the row after each, and its dictionary index; return their number, −1 at damage.

    Parameters
    ----------
    page : (n,) uint8.
    rows : int, the rows that all runs have together.
    known : int, the values of the dictionary.
    ends, indices : (page bytes,) int64, out.
    """
    if page.size == 0 or page[0] > _MOST_BITS:
        return -1
    index_bytes = (np.int64(page[0]) + 7) // 8
    at, end, count = 1, 0, 0
    while at < page.size:
        head, shift = 0, 0
        while True:
            if at >= page.size or shift > 56:
                return -1
            byte = np.int64(page[at])
            head |= (byte & 127) << shift
            at += 1
            shift += 7
            if byte < 128:
                break
        index = 0
        if at + index_bytes > page.size:
            return -1
        for k in range(index_bytes):
            index |= np.int64(page[at + k]) << (8 * k)
        at += index_bytes
        length = head >> 1
        if head & 1 or length <= 0 or length > rows - end or index >= known:
            return -1
        end += length
        ends[count], indices[count] = end, index
        count += 1
    return count if end == rows else -1


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
def _bytes_of_words(words, shift, plane):
    """Write one byte of each word."""
    for x in range(plane.size):
        plane[x] = np.uint8((words[x] >> shift) & np.uint32(255))


@bare_inner
def _encode_line(pixels, differences, by_byte, coded):
    width = differences.size
    _subtract(pixels[4:], pixels[:-4], by_byte[4:])
    for plane in range(4):
        _bytes_of_words(differences, np.uint32(24 - 8 * plane), coded[plane * width : (plane + 1) * width])
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
