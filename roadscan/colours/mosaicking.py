"""Pixels of an orthophoto from the best looks at each: the best view, blended with those that agree with it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadscan.colours.kernels.blending import blend
from roadscan.colours.painting import Looks
from roadscan.compute.array_types import UInt8


def blended(looks: Looks) -> tuple[UInt8, npt.NDArray[np.int32]]:
    """Returns colours (n, 3), from 1, 0 without a look, and the number of the picture (n,) of most weight, −1: none.

    Where three pictures or more see a place, those that differ from the median of all are left out: something moved
    there. Of the others the best has most weight, and weights are smooth over the ground, so that seams are blended.
    """
    colour, number = np.zeros((len(looks.weight), 3), np.uint8), np.full(len(looks.weight), -1, np.int32)
    median, count = looks.medians()
    blend(looks.colour, looks.weight, looks.number, median, count, colour, number)
    return colour, number
