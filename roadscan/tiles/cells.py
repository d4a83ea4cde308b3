"""Statistics of a tile's cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import TileId


@dataclass(frozen=True)
class TileCells:
    """Cells of one tile with at least one point, in order of row and column; columns as in ``schemas/cells.toml``.

    All arrays are (n,); heights are metres in the map frame.
    """

    tile: TileId
    cells_per_edge: int
    column: npt.NDArray[np.uint16]
    """Column counted from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row counted from the south edge."""
    count: npt.NDArray[np.uint32]
    height_mean_m: npt.NDArray[np.float64]
    height_robust_m: npt.NDArray[np.float64]
    height_min_m: npt.NDArray[np.float64]
    height_max_m: npt.NDArray[np.float64]
    height_std_m: npt.NDArray[np.float32]
    intensity_mean: npt.NDArray[np.float32]
    pass_count: npt.NDArray[np.uint16]
    pass_offsets: npt.NDArray[np.int32]
    """(n + 1,): the passes of cell i are ``pass_ids[pass_offsets[i]:pass_offsets[i + 1]]``."""
    pass_ids: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return int(self.column.size)

    def raster(self, name: str) -> npt.NDArray[np.float32]:
        """Return a (rows, columns) float32 image of one quantity, north up, NaN where no point lies.

        Parameters
        ----------
        name : a column such as ``"height_robust_m"`` or ``"count"``.
        """
        image = np.full((self.cells_per_edge, self.cells_per_edge), np.nan, dtype=np.float32)
        image[self.cells_per_edge - 1 - self.row.astype(np.int64), self.column] = getattr(self, name)
        return image


class CellValues(NamedTuple):
    """One column of a tile's cells; arrays are (n,), in the order of :class:`TileCells`."""

    cells_per_edge: int
    column: npt.NDArray[np.uint16]
    """Column counted from the west edge."""
    row: npt.NDArray[np.uint16]
    """Row counted from the south edge."""
    values: npt.NDArray[Any]

    @classmethod
    def of(cls, cells: TileCells, name: str) -> CellValues:
        """Return a column, by its name, of cells in memory."""
        return cls(cells.cells_per_edge, cells.column, cells.row, getattr(cells, name))


@dataclass(frozen=True)
class TileEvidence:
    """Epochs of a tile's readings, and σ of the poses that georeferenced them."""

    first_epoch_gps_ns: int
    last_epoch_gps_ns: int
    sigma_horizontal_m: float
    """Largest 1 σ of the poses; NaN where a trajectory does not state it."""
    sigma_down_m: float
