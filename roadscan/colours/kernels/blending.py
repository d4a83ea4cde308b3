"""The colour of a place from several looks at it."""

from __future__ import annotations

import numpy as np

from roadscan.colours.kernels.looks import ALIKE
from roadscan.compute.kernel_options import kernel

VOTES = 3  # Fewest looks whose median tells what is there.
SHARE = 2.0
"""Power of the weights of looks that are blended: the best view stands out, and seams stay soft."""


@kernel
def blend(held_colour, held_weight, held_number, median, count, colour, number):
    """Blend the looks that agree: with the median where there are three or more, else with the best.

    Parameters
    ----------
    held_colour : (n, k, 3) uint8; held_weight : (n, k) float32, 0: none; held_number : (n, k) int32.
    median : (n, 3) uint8; count : (n,) uint8, of looks.
    colour : (n, 3) uint8, written, from 1; 0 where there is none.
    number : (n,) int32, written: the picture of most weight; −1 where there is none.
    """
    most = held_weight.shape[1]
    for i in range(held_weight.shape[0]):
        number[i] = -1
        for c in range(3):
            colour[i, c] = 0
        if count[i] == 0:
            continue
        best = -1
        for k in range(most):
            if held_weight[i, k] <= 0.0:
                continue
            if count[i] >= VOTES:
                off = 0.0
                for c in range(3):
                    off = max(off, abs(float(held_colour[i, k, c]) - float(median[i, c])))
                if off > ALIKE:
                    continue
            if best < 0 or held_weight[i, k] > held_weight[i, best]:
                best = k
        if best < 0:  # looks disagree in single channels: the median stands for them
            for k in range(most):
                if held_weight[i, k] > 0.0 and (best < 0 or held_weight[i, k] > held_weight[i, best]):
                    best = k
            number[i] = held_number[i, best]
            for c in range(3):
                colour[i, c] = max(median[i, c], np.uint8(1))
            continue
        number[i] = held_number[i, best]
        total = 0.0
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(most):
            if held_weight[i, k] <= 0.0:
                continue
            off = 0.0
            for c in range(3):
                off = max(off, abs(float(held_colour[i, k, c]) - float(held_colour[i, best, c])))
            if off > ALIKE:
                continue
            share = (held_weight[i, k] / held_weight[i, best]) ** SHARE
            total += share
            red += share * held_colour[i, k, 0]
            green += share * held_colour[i, k, 1]
            blue += share * held_colour[i, k, 2]
        colour[i, 0] = np.uint8(max(1.0, red / total + 0.5))
        colour[i, 1] = np.uint8(max(1.0, green / total + 0.5))
        colour[i, 2] = np.uint8(max(1.0, blue / total + 0.5))
