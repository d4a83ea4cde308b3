"""The sky of a picture by itself: from the upper border down to the first edge of each column (Shen & Wang 2013).

The strength of that edge is the one with which what lies above is most uniform, and what lies below as well; the sky is
the brighter of the two. A smooth wall that ends above the picture looks alike, so other evidence has to agree: the
horizon, and the distance.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, UInt8
from roadscan.core.extras import cv2

_WIDTH_PX: Final = 320  # Width of the reduced picture (px).
_STRENGTHS: Final = (8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Strengths of an edge that are tried: sums of differences of grey values (Sobel, 3 × 3) of the reduced picture."""
_UNIFORM: Final = 2.0
"""Weight of the variance of the sky beside that of the ground, as Shen & Wang have it."""
_LEAST: Final = 0.02  # Share of the picture that a sky has, at least.


def sky_of(picture: UInt8) -> Bool:
    """Returns a mask (rows, columns) of a reduced grey picture that shows what may be sky; all False where none is."""
    height, width = picture.shape
    size = min(_WIDTH_PX, width), max(1, round(height * min(_WIDTH_PX, width) / width))
    small = cv2.GaussianBlur(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), (5, 5), 0)
    edge = np.abs(cv2.Sobel(small, cv2.CV_16S, 1, 0).astype(np.int32))
    edge += np.abs(cv2.Sobel(small, cv2.CV_16S, 0, 1).astype(np.int32))
    best, found = np.inf, np.zeros(small.shape, bool)
    grey = small.astype(np.float64)
    for strength in _STRENGTHS:
        strong = edge > strength
        border = np.where(strong.any(axis=0), strong.argmax(axis=0), small.shape[0])
        sky = np.arange(small.shape[0])[:, None] < border
        if not sky.any() or sky.all():
            continue
        energy = _UNIFORM * float(grey[sky].var()) + float(grey[~sky].var())
        if energy < best and grey[sky].mean() > grey[~sky].mean():
            best, found = energy, sky
    return found if found.mean() >= _LEAST else np.zeros(small.shape, bool)


def is_at(sky: Bool, pixel: npt.NDArray[np.float32], size_px: tuple[int, int]) -> Bool:
    """Returns whether pixels (k, 2) of a picture lie in its sky."""
    rows, columns = sky.shape
    column = np.clip(pixel[:, 0] * columns / size_px[0], 0, columns - 1).astype(np.int64)
    row = np.clip(pixel[:, 1] * rows / size_px[1], 0, rows - 1).astype(np.int64)
    return np.asarray(sky[row, column])
