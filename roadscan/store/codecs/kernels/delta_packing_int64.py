"""DELTA_BINARY_PACKED of 64-bit numbers with small differences: epochs. `delta_packing.decode` reads them."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel
from roadscan.store.codecs.kernels.bit_words import appended
from roadscan.store.codecs.kernels.delta_packing import BLOCK, MINIBLOCKS, pack_block, varint_bits, widths_of

TOO_FAR = -1
"""Result where differences are too large to be packed."""

_WIDEST = 1 << 31
"""Differences within a block must be less than this apart."""
_FARTHEST = 1 << 47
"""Differences must be smaller than this, because the arithmetic wraps."""
_U = np.uint64


@kernel
def encode_long(values, words):
    """Write the blocks of a page, which follow the page's header.

    Parameters
    ----------
    values : (n,) int64, contiguous, n > 0.
    words : uint64, room_words(n) or more, out.

    Returns
    -------
    int, bytes written, or TOO_FAR.
    """
    count = values.size
    word, used, to = _U(0), _U(0), _U(0)
    above = np.zeros(BLOCK, np.int32)
    differences = np.zeros(BLOCK, np.int64)
    for start in range(1, count, BLOCK):
        n, at = min(BLOCK, count - start), _U(start)
        least, most = np.int64(_FARTHEST), np.int64(-_FARTHEST)
        for i in range(n):
            step = values[at + _U(i)] - values[at + _U(i) - _U(1)]
            differences[i] = step
            least, most = min(least, step), max(most, step)
        if least <= -_FARTHEST or most >= _FARTHEST or most - least >= _WIDEST:
            return TOO_FAR
        for i in range(n):
            above[i] = np.int32(differences[i] - least)
        above[n:] = 0
        widths = widths_of(above)
        for number, size in (varint_bits(_U((least << 1) ^ (least >> 63))), (widths, _U(8 * MINIBLOCKS))):
            words[to], word, used, full = appended(word, used, number, size)
            to += full
        to, word, used = pack_block(above, widths, words, to, word, used)
    words[to] = word
    return np.int64(to) * 8 + np.int64(used) // 8


def room_words(count: int) -> int:
    """Return the 64-bit words that the blocks of `count` numbers may take."""
    blocks = -(-count // BLOCK)
    return 8 + blocks * (16 + MINIBLOCKS + BLOCK // 8 * 32) // 8
