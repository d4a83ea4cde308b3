"""Bits of any number put one behind the other into words of 64 bits, the lowest first."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined

_U = np.uint64


@inlined
def appended(word, used, bits, count):
    """Put `count` bits behind the `used` ones of a word: (that word, the word to go on with, its bits, 1 if it is new).

    A new word follows where the old one is full.
    """
    now = word | (bits << used)
    total = used + count
    full = total >> _U(6)
    following = (bits >> _U(1)) >> (_U(63) - used)
    return now, following if full else now, total & _U(63), full
