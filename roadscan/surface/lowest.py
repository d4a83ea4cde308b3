"""The lowest readings of a grid's cells, beside their robust heights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.extras import cv2

CROWD_CELLS: Final = 5
"""Cells to either side whose readings a cell's are compared with."""
_CROWD_TIMES: Final = 3
"""More readings than this many times the mean around are a crowd, as where a vehicle stood."""


@dataclass(frozen=True)
class LowestReadings:
    """Arrays (rows, columns) of a window of cells."""

    drop_m: npt.NDArray[np.float32]
    """How far the lowest reading of a cell lies below the cell's robust height (m), NaN where that is not known."""
    count: npt.NDArray[np.uint16]
    """Readings that it is the lowest of; 65,535 stands for all above."""

    def part(self, rows: slice, columns: slice) -> LowestReadings:
        """Some of the rows and columns, as views."""
        return LowestReadings(self.drop_m[rows, columns], self.count[rows, columns])

    def crowded(self) -> npt.NDArray[np.bool_]:
        """Cells that have many times the readings of those around that have any; whole numbers decide."""
        side = (2 * CROWD_CELLS + 1,) * 2
        around = cv2.boxFilter(self.count, cv2.CV_64F, side, None, (-1, -1), False, cv2.BORDER_CONSTANT)
        cells = cv2.boxFilter(
            (self.count > 0).view(np.uint8), cv2.CV_32S, side, None, (-1, -1), False, cv2.BORDER_CONSTANT
        )
        return np.asarray(self.count * cells.astype(np.float64) > _CROWD_TIMES * around)
