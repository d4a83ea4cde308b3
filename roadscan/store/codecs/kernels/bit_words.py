"""Packs bit fields of any width into 64-bit words, lowest bits first."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined

_U = np.uint64


@inlined
def appended(word, used, bits, count):
    """Append `count` bits to the `used` bits of a word; return (first word, current word, its bits, 1 if it is new).

    A new word follows where the old one is full.
    """
    now = word | (bits << used)
    total = used + count
    full = total >> _U(6)
    following = (bits >> _U(1)) >> (_U(63) - used)
    return now, following if full else now, total & _U(63), full
