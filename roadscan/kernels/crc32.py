"""CRC-32 of long runs of bytes, folded with a sparse multiple of its polynomial.

1 + x^(64·2215) + x^(64·2866) + x^(64·3006) is a multiple of the CRC-32 polynomial (found by search). So a 64-bit word
may be taken out of the data if it is added (xor) to those 140, 791 and 3006 words later: what is left of any data is
its last 3006 words. Neither tables nor multiplications are needed (after Russell, 2024, *Chorba: a novel CRC32
implementation*).
"""

from __future__ import annotations

import numpy as np

from roadscan.kernels.options import kernel

NEAR, MIDDLE, FAR = 140, 791, 3006
"""Words from one that is taken out to those that it is added to."""
_U = np.uint64
_TO_NEAR, _TO_MIDDLE, _TO_WORD = _U(FAR - NEAR), _U(FAR - MIDDLE), _U(FAR)
WINDOW = FAR + 24_576
"""Words of the working array; they stay in the processor's cache."""


@kernel
def fold(words, register, window, rest):
    """Fold data into their last words.

    Parameters
    ----------
    words
        (n,) uint64, FAR or more: the data.
    register
        uint64: the CRC's register (32 bits) before the data.
    window
        (WINDOW,) uint64, working array.
    rest
        (FAR,) uint64, out: words whose CRC, from a register of 0, is that of the data.
    """
    folded = words.size - FAR
    for i in range(FAR):
        window[i] = 0
    window[0] = register  # a word taken out FAR before the first one, which alone it is added to
    at = 0
    while at < folded:
        n = min(window.size - FAR, folded - at)
        from_word = _U(at)
        for i in range(n):  # runs of NEAR words do not depend on each other, so they are computed side by side
            k = _U(i)
            taken = window[k] ^ window[k + _TO_MIDDLE] ^ window[k + _TO_NEAR]
            window[k + _TO_WORD] = words[from_word + k] ^ taken
        at += n
        for i in range(FAR):
            window[i] = window[n + i]
    for i in range(FAR):
        rest[i] = words[folded + i] ^ window[i]
    for i in range(MIDDLE):
        rest[i] ^= window[FAR - MIDDLE + i]
    for i in range(NEAR):
        rest[i] ^= window[FAR - NEAR + i]
