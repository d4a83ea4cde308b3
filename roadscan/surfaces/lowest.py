"""The lowest readings of a grid's cells, beside their robust heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


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
