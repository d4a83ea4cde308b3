"""Makes parts of pictures unrecognisable, for good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import UInt8
from roadscan.core.extras import cv2

KINDS: Final = ("vehicle", "person", "detected")
"""What is hidden: vehicles and people by their returns, and what a network finds."""


_CELLS: Final = 6
"""The longer side of what is hidden keeps so many mean colours: a face or a plate cannot be distinguished from them."""
_LEAST_CELL_PX: Final = 8.0  # Edge of the area of a mean colour at least (pixels).
_BEYOND_PX: Final = 2.0  # What is hidden is wider by so much at least, for edges that are not sharp (pixels).


@dataclass(frozen=True)
class Region:
    """A part of a picture that is to be hidden."""

    left: float
    top: float
    right: float
    bottom: float
    """Pixels, from the centre of the upper left one."""
    what: str
    """One of `KINDS`."""

    def wider(self, margin: float) -> Region:
        """Return the region with a margin, as a share of its sides."""
        across = max(margin * (self.right - self.left), _BEYOND_PX)
        upright = max(margin * (self.bottom - self.top), _BEYOND_PX)
        return Region(self.left - across, self.top - upright, self.right + across, self.bottom + upright, self.what)


def hidden(picture: UInt8, regions: Sequence[Region]) -> UInt8:
    """Return a picture (height, width, 3) in which regions are replaced by a few blurred mean colours.

    The means are those of the picture as it came, so that the order of regions changes nothing but where they overlap:
    there the last, in the order of their corners, holds. Nothing else of the picture goes into a region.
    """
    out = picture.copy()
    height, width = picture.shape[:2]
    for one in sorted(regions, key=lambda r: (r.left, r.top, r.right, r.bottom)):
        left, right = max(0, int(np.floor(one.left))), min(width, int(np.ceil(one.right)) + 1)
        top, bottom = max(0, int(np.floor(one.top))), min(height, int(np.ceil(one.bottom)) + 1)
        if right <= left or bottom <= top:
            continue
        part = picture[top:bottom, left:right]
        cell = max(max(part.shape[:2]) / _CELLS, _LEAST_CELL_PX)
        columns, rows = (max(1, round(side / cell)) for side in (part.shape[1], part.shape[0]))
        means = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
        out[top:bottom, left:right] = cv2.resize(
            means.reshape(rows, columns, -1), (part.shape[1], part.shape[0]), interpolation=cv2.INTER_LINEAR
        ).reshape(part.shape)
    return out
