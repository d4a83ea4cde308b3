"""Squares of the map that are searched for assets separately, each with a halo around it."""

from __future__ import annotations

from dataclasses import dataclass

from roadscan.assets.scene import Box
from roadscan.core.grid import Bounds, TileGrid
from roadscan.core.ids import TileId


@dataclass(frozen=True)
class AssetGrid:
    """Squares whose edge is a whole number of the survey's tiles, anchored at the map's origin."""

    tiles: TileGrid
    """The survey's tiles."""
    per_edge: int
    """Tiles along the edge of a square."""
    halo_m: float

    @property
    def edge_m(self) -> float:
        """Returns the edge of a square (m)."""
        return self.per_edge * self.tiles.size_m

    @property
    def squares(self) -> TileGrid:
        """Returns the squares as tiles of one cell."""
        return TileGrid(self.edge_m, self.edge_m)

    def of_tile(self, tile: TileId) -> TileId:
        """Returns the square that contains a tile of the survey."""
        return TileId(tile.column // self.per_edge, tile.row // self.per_edge)

    def corner_m(self, square: TileId) -> tuple[float, float]:
        """Returns easting and northing of the south-west corner of a square (m)."""
        return square.column * self.edge_m, square.row * self.edge_m

    def window(self, square: TileId) -> Bounds:
        """Returns a square with its halo on the map (m)."""
        (east, north), h, edge = self.corner_m(square), self.halo_m, self.edge_m
        return Bounds(east - h, north - h, east + edge + h, north + edge + h)

    @property
    def own_box(self) -> Box:
        """Returns a square relative to its corner (m)."""
        return Box(0.0, 0.0, self.edge_m, self.edge_m)

    @property
    def window_box(self) -> Box:
        """Returns a square with its halo relative to its corner (m)."""
        return Box(-self.halo_m, -self.halo_m, self.edge_m + self.halo_m, self.edge_m + self.halo_m)

    def tiles_under(self, square: TileId) -> list[TileId]:
        """Returns the survey's tiles that share ground with a square or its halo, by row and column."""
        return self.tiles.tiles_in(self.window(square))
