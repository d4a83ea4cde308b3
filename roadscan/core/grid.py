"""The grid: tiles and cells of the map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from roadscan.core.errors import ConfigError
from roadscan.core.ids import TileId

QUANTUM_M: Final = 1e-5
"""Point coordinates are whole multiples of this (10 µm), so that sums are exact and independent of order."""
QUANTA_PER_M: Final = 100_000
"""Coordinate quanta in a metre."""
ENOUGH: Final = 4
"""Readings that a cell should contain: with fewer, the median cannot exclude an outlier."""
LARGEST_M: Final = 1.0
"""Largest cell that is proposed (m)."""


@dataclass(frozen=True)
class Bounds:
    """A box in the map frame (metres), lower edges inclusive, upper exclusive."""

    easting_min_m: float
    northing_min_m: float
    easting_max_m: float
    northing_max_m: float

    def meets(self, other: Bounds) -> bool:
        """Return whether two boxes overlap."""
        return (
            self.easting_min_m < other.easting_max_m
            and other.easting_min_m < self.easting_max_m
            and self.northing_min_m < other.northing_max_m
            and other.northing_min_m < self.northing_max_m
        )


@dataclass(frozen=True)
class TileGrid:
    """Square tiles of the map, each cut into square cells, anchored at the map's origin."""

    size_m: float = 10.0
    cell_m: float = 0.05

    def __post_init__(self) -> None:
        if abs(self.size_m * QUANTA_PER_M - self.size_quanta) > 1e-6:
            raise ConfigError(f"tile size {self.size_m} m", expected="a whole number of 10 µm")
        if self.size_quanta % self.cells_per_edge:
            raise ConfigError(f"cell {self.cell_m} m", expected="a cell edge of whole 10 µm that divides the tile")

    @property
    def size_quanta(self) -> int:
        """Edge of a tile in quanta."""
        return round(self.size_m * QUANTA_PER_M)

    @property
    def cells_per_edge(self) -> int:
        """Cells along a tile's edge."""
        return round(self.size_m / self.cell_m)

    @property
    def cell_quanta(self) -> int:
        """Edge of a cell in quanta."""
        return self.size_quanta // self.cells_per_edge

    def tile_at(self, easting_m: float, northing_m: float) -> TileId:
        """Return the tile that contains a position (m)."""
        return TileId(
            math.floor(easting_m * QUANTA_PER_M) // self.size_quanta,
            math.floor(northing_m * QUANTA_PER_M) // self.size_quanta,
        )

    def bounds(self, tile: TileId) -> Bounds:
        """Box of a tile (m)."""
        e, n = tile.column * self.size_m, tile.row * self.size_m
        return Bounds(e, n, e + self.size_m, n + self.size_m)

    def tiles_in(self, box: Bounds) -> list[TileId]:
        """Return the tiles that overlap a box, by row and column."""
        first = self.tile_at(box.easting_min_m, box.northing_min_m)
        end_column = math.ceil(box.easting_max_m / self.size_m)
        end_row = math.ceil(box.northing_max_m / self.size_m)
        return [TileId(c, r) for r in range(first.row, end_row) for c in range(first.column, end_column)]
