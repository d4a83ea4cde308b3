"""The lowest readings of a grid's cells, beside their robust heights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.extras import cv2

CROWD_CELLS: Final = 5
"""The readings of a cell are compared with those of the cells within this distance (cells)."""
_CROWD_TIMES: Final = 3
"""A cell with more than this many times the mean number of readings around is crowded, as where a vehicle stood."""


@dataclass(frozen=True)
class LowestReadings:
    """Lowest readings of a window; arrays (rows, columns)."""

    drop_m: npt.NDArray[np.float32]
    """Depth of a cell's lowest reading below its robust height (m), NaN where that is not known."""
    count: npt.NDArray[np.uint16]
    """Number of readings in the cell; 65,535 stands for all above."""

    def part(self, rows: slice, columns: slice) -> LowestReadings:
        """Returns some of the rows and columns, as views."""
        return LowestReadings(self.drop_m[rows, columns], self.count[rows, columns])

    def crowded(self) -> npt.NDArray[np.bool_]:
        """Returns a mask of the cells with many times the readings of non-empty cells around, in whole numbers."""
        side = (2 * CROWD_CELLS + 1,) * 2
        around = cv2.boxFilter(self.count, cv2.CV_64F, side, None, (-1, -1), False, cv2.BORDER_CONSTANT)
        cells = cv2.boxFilter(
            (self.count > 0).view(np.uint8), cv2.CV_32S, side, None, (-1, -1), False, cv2.BORDER_CONSTANT
        )
        return np.asarray(self.count * cells.astype(np.float64) > _CROWD_TIMES * around)
