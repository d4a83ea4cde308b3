"""A raster's block of scattered cells → zlib's format (RFC 1950, 1951), at a cost by cell and not by pixel.

Pixels are float32, least byte first, NaN where no cell lies. The four bytes of a cell are coded one by one. NaNs repeat
what lies four bytes before; the first one behind a single cell repeats what lies eight bytes before.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.kernels.bit_words import appended
from roadscan.kernels.deflate import ADLER, END, SYMBOLS, code, coded, head, length_symbol
from roadscan.kernels.options import bare

EMPTY = np.array([0, 0, 0xC0, 0x7F], np.uint8)
"""The bytes of NaN."""
_EMPTY_SUM, _EMPTY_FALLING = 0xC0 + 0x7F, 2 * 0xC0 + 3 * 0x7F
_PIXELS_AT_ONCE = 64
"""A match repeats up to so many: 256 bytes."""
_DISTANCES = np.array([0, 0, 0, 1, 0, 1], np.uint8)
"""Bits of the codes of distances: 4 is the fourth, 7 and 8 the sixth."""
_SAMPLE = 4096
_BYTE = np.uint32(255)
_U = np.uint64


@bare
def _tally(column, words, first, last, width, counts):
    """Count the symbols of a sample of lines, at least one of each."""
    counts[:] = 0
    cells = 0
    for y in range(first.size):
        cells += last[y] - first[y]
    for y in range(0, first.size, 1 + cells // _SAMPLE):
        for k in range(first[y], last[y]):
            for shift in range(0, 32, 8):
                counts[(words[k] >> np.uint32(shift)) & _BYTE] += 1
            gap = np.int64(column[k]) - np.int64(column[k - 1]) - 1 if k > first[y] else np.int64(width // 2)
            if gap > 0:
                counts[length_symbol(4)[0]] += 1
            if gap > 1:
                counts[length_symbol(4 * min(gap - 1, _PIXELS_AT_ONCE))[0]] += 1
            counts[length_symbol(4 * _PIXELS_AT_ONCE)[0]] += gap // _PIXELS_AT_ONCE
    total = 0
    for s in range(SYMBOLS):
        total += counts[s]
    for s in range(SYMBOLS):
        counts[s] += total // _SAMPLE + 1


@bare
def _repeats(entries, bits, sizes):
    """Write the match of each number of empty pixels behind an empty one; first, of one behind a single cell."""
    for pixels in range(_PIXELS_AT_ONCE + 1):
        symbol, more, count = length_symbol(4 * max(pixels, 1))
        own, size = coded(entries, symbol)
        bits[pixels] = own | (_U(more) << size)
        sizes[pixels] = size + _U(count) + _U(1)
        if pixels == 0:  # the second distance, and that it is 8 and not 7
            bits[pixels] |= _U(3) << (sizes[pixels] - _U(1))
            sizes[pixels] += _U(1)


@bare
def _four(entries, value):
    """The codes of a pixel's bytes, and their bits."""
    bits, size = coded(entries, np.int64(value & _BYTE))
    for shift in range(8, 32, 8):
        own, more = coded(entries, np.int64((value >> np.uint32(shift)) & _BYTE))
        bits |= own << size
        size += more
    return bits, size


@bare
def _gap(pixels, behind_one, empty, bits, sizes, out, word, to, used):
    """Write empty pixels; `behind_one`: behind a single cell that lies behind an empty pixel."""
    if behind_one:
        out[to], word, used, full = appended(word, used, bits[0], sizes[0])
    else:
        out[to], word, used, full = appended(word, used, empty[0], empty[1])
    to += full
    pixels -= 1
    while pixels > 0:
        piece = _U(min(pixels, _PIXELS_AT_ONCE))
        out[to], word, used, full = appended(word, used, bits[piece], sizes[piece])
        to += full
        pixels -= _PIXELS_AT_ONCE
    return word, to, used


@bare
def _pack(column, words, first, last, west, width, entries, distances, bits, sizes, out):
    """Write the head, all pixels and the block's end.

    Returns
    -------
    The bits written, and what the cells add to Adler-32's two sums over a block that is empty.
    """
    word, to, used = head(entries, distances, out)
    empty = _four(entries, np.uint32(0x7FC0_0000))
    low, high, done, run = 0, 0, 0, 2
    size = 4 * width * first.size
    for y in range(first.size):
        for k in range(first[y], last[y]):
            at = y * width + np.int64(column[k]) - west
            if at > done:
                word, to, used = _gap(at - done, run == 1, empty, bits, sizes, out, word, to, used)
                run = 0
            value = words[k]
            own, count = _four(entries, value)
            out[to], word, used, full = appended(word, used, own, count)
            to += full
            a, b = np.int64(value & _BYTE), np.int64((value >> np.uint32(8)) & _BYTE)
            c, d = np.int64((value >> np.uint32(16)) & _BYTE), np.int64(value >> np.uint32(24))
            more = a + b + c + d - _EMPTY_SUM
            low += more
            high += (size - 4 * at) * more - (b + 2 * c + 3 * d - _EMPTY_FALLING)
            done = at + 1
            run += 1
    if 4 * done < size:
        word, to, used = _gap((size >> 2) - done, run == 1, empty, bits, sizes, out, word, to, used)
    own, count = coded(entries, END)
    out[to], word, used, full = appended(word, used, own, count)
    to += full
    out[to] = word
    return np.int64(to) * 64 + np.int64(used), low, high


def room_words(pixels: int) -> int:
    """64-bit words that a block may take."""
    return pixels + 1024


def deflate_scattered(
    column: Any, words: Any, first: Any, last: Any, west: int, width: int, counts: Any, entries: Any, out: Any
) -> bytes:
    """Make a zlib stream of a block's pixels.

    Parameters
    ----------
    column : (n,) uint16, of the cells of a raster, which are sorted by row, column; words : (n,) uint32, the bits of
        their values.
    first, last : (lines,) int64, the first cell of each line of the block, from the north, and the first beyond it.
    west, width : column of the block's first pixel, and pixels of a line.
    counts : (SYMBOLS,) int64, entries : (SYMBOLS,) uint32, out : (room_words(pixels),) uint64, scratch.
    """
    bits, sizes = np.empty((2, _PIXELS_AT_ONCE + 1), np.uint64)
    _tally(column, words, first, last, width, counts)
    code(counts, entries)
    _repeats(entries, bits, sizes)
    used, low, high = _pack(column, words, first, last, west, width, entries, _DISTANCES, bits, sizes, out)
    stream: bytes = out.view(np.uint8)[: (used + 7) // 8].tobytes()
    pixels = width * first.size
    size = 4 * pixels
    low += 1 + pixels * _EMPTY_SUM
    high += size + _EMPTY_SUM * (pixels * size - 2 * pixels * (pixels - 1)) - pixels * _EMPTY_FALLING
    return stream + (high % ADLER << 16 | low % ADLER).to_bytes(4, "big")
