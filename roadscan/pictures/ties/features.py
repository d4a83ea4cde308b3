"""Features of a picture: SIFT (Lowe 2004), as RootSIFT (Arandjelović & Zisserman 2012), spread evenly over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Bool, Float32, Int64, UInt8
from roadscan.core.extras import cv2
from roadscan.pictures.ties.sky import is_at, sky_of

DESCRIPTOR: Final = 128
"""Numbers of a descriptor."""
_CONTRAST: Final = 0.01
"""Least contrast of a feature; a quarter of Lowe's, since asphalt is dull and the best of each cell are kept."""
_CELLS: Final = (12, 8)
"""Columns and rows of the cells over which features are spread."""
_LARGE_PX: Final = 4.0
"""Diameter of a feature (px) beyond which it comes after all smaller ones of its cell: its middle moves as it is seen
from nearer, by some hundredths of a pixel a picture and always the same way, which bends a long drive."""
FARTHEST: Final = 0.75
"""Distance of two descriptors of unit length, at most: those of unlike places differ by 1.0 in the median."""
_SCALE: Final = 255.0  # Scale of a descriptor's roots, which lie between 0 and 1, as bytes.
_SAME_PX: Final = 1e-3  # Features so near each other (px) are one place with two directions.


@dataclass(frozen=True)
class Features:
    """k features."""

    pixel: Float32
    """(k, 2) u, v from the centre of the upper left pixel."""
    size_px: Float32
    """(k,) diameter."""
    descriptor: UInt8
    """(k, 128) roots of the shares of the gradients, times 255."""
    of_sky: Bool
    """(k,) True of what the picture by itself takes for sky."""
    hidden: int = 0
    """Features that were left out, as they lie on what the rig file says to be the vehicle."""

    def __len__(self) -> int:
        """Returns the number of features."""
        return len(self.pixel)


def features_of(picture: UInt8, most: int, hidden: Bool | None = None) -> Features:
    """Returns the features of a grey picture (height, width), at most `most` of them.

    Parameters
    ----------
    hidden : (height, width) True where nothing is looked for, such as on the vehicle itself; (0, 0): nowhere.
    """
    height, width = picture.shape
    finder = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    every = finder.detect(picture, None)
    found = [one for one in every if hidden is None or not hidden.size or not hidden[_pixel(one, picture)]]
    left_out, none = len(every) - len(found), np.zeros(0, np.float32)
    if not found:
        nothing = np.zeros((0, DESCRIPTOR), np.uint8)
        return Features(none.reshape(0, 2), none, nothing, np.zeros(0, bool), left_out)
    values = np.array([(*one.pt, one.size, one.response, one.angle) for one in found])
    order = np.lexsort(
        (values[:, 4], values[:, 2], values[:, 0], values[:, 1], -values[:, 3], values[:, 2] > _LARGE_PX)
    )
    order = order[_first_at_place(values[order, :2])]
    rows = order[_spread(values[order, :2], (width, height), most)]
    kept, raw = finder.compute(picture, [found[k] for k in rows.tolist()])
    place = np.array([one.pt for one in kept], np.float32).reshape(-1, 2)
    size = np.array([one.size for one in kept], np.float32)
    share = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    descriptor = np.clip(np.rint(_SCALE * np.sqrt(share)), 0, _SCALE).astype(np.uint8)
    return Features(place, size, descriptor, is_at(sky_of(picture), place, (width, height)), left_out)


def alike(first: UInt8, second: UInt8) -> Bool:
    """Returns whether pairs (k,) of descriptors (k, 128) are of places that look alike."""
    one, other = (values.astype(np.float32) for values in (first, second))
    length = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    likeness = np.einsum("ni,ni->n", one, other) / np.maximum(length, 1e-6)
    return np.asarray(2.0 - 2.0 * likeness < FARTHEST**2)


def _pixel(point: cv2.KeyPoint, picture: UInt8) -> tuple[int, int]:
    """Returns row and column of the pixel of a feature."""
    column, row = (int(value + 0.5) for value in point.pt)
    return min(row, picture.shape[0] - 1), min(column, picture.shape[1] - 1)


def _first_at_place(place_px: npt.NDArray[np.float64]) -> Int64:
    """Returns rows of the first feature at each place, in order."""
    _, first = np.unique(np.rint(place_px / _SAME_PX).astype(np.int64), axis=0, return_index=True)
    return np.sort(first).astype(np.int64)


def _spread(place_px: npt.NDArray[np.float64], size: tuple[int, int], most: int) -> Int64:
    """Returns rows of features, best first as they come, of which each cell of the picture gives as many as it can."""
    columns, rows = _CELLS
    column = np.clip(place_px[:, 0] * columns / size[0], 0, columns - 1).astype(np.int64)
    row = np.clip(place_px[:, 1] * rows / size[1], 0, rows - 1).astype(np.int64)
    cell = row * columns + column
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(columns * rows))
    rank = np.empty(cell.size, np.int64)
    rank[order] = np.arange(cell.size) - starts[cell[order]]
    # The first of each cell, then the second of each, and so on.
    chosen = np.lexsort((np.arange(cell.size), rank))[:most]
    return np.sort(chosen).astype(np.int64)
