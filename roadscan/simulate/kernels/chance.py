"""Random numbers by counter: independent of the order and the blocks in which they are drawn."""

from __future__ import annotations

import numpy as np

from roadscan.simulate.kernels.options import inlined


@inlined
def mixed(counter: np.uint64) -> np.uint64:
    """Return 64 random bits for a counter: the finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    z = counter * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
