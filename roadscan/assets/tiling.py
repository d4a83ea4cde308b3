"""Squares of the map that are searched for assets separately, each with halos around it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from roadscan.assets.scene import Box
from roadscan.core.grid import Bounds, TileGrid, TileId

_ORIGINS_M: Final = 960.0
"""Returns count from the multiples of this in the map (m): whole numbers of the cells of all rasters, and the same for
squares of any edge, so that a return has the same place and lies in the same cells however squares are cut."""
_STEP_M: Final = 3.0
"""Scenes end at multiples of this (m): whole numbers of the cells of all rasters."""
_GROUND_STEP_M: Final = 24.0
"""The windows of the ground end at multiples of this (m): also whole numbers of the cells of up to 8 m that are made by
halving its rasters, to fill their holes."""


class Halos(NamedTuple):
    """How far beyond its square a search looks (m)."""

    scene_m: float
    """Kinds look for evidence."""
    classes_m: float
    """Returns are classified."""
    ground_m: float
    """Returns tell of bare earth."""


@dataclass(frozen=True)
class AssetGrid:
    """Squares whose edge is a whole number of the survey's tiles, anchored at the map's origin."""

    tiles: TileGrid
    """The survey's tiles."""
    per_edge: int
    """Tiles along the edge of a square."""
    halos: Halos

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

    def origin_m(self, square: TileId) -> tuple[float, float]:
        """Returns easting and northing of the place from which the coordinates of its returns count (m)."""
        east, north = (math.floor(at / _ORIGINS_M) * _ORIGINS_M for at in self.corner_m(square))
        return east, north

    def box_from(self, origin_m: tuple[float, float], *squares: TileId) -> Box:
        """Returns the least box with some squares, from a place."""
        east, north = zip(*map(self.corner_m, squares), strict=True)
        x, y = origin_m
        return Box(min(east) - x, min(north) - y, max(east) - x + self.edge_m, max(north) - y + self.edge_m)

    def own_box(self, *squares: TileId) -> Box:
        """Returns the least box with some squares, from the origin of the first."""
        return self.box_from(self.origin_m(squares[0]), *squares)

    def scene_box(self, *squares: TileId) -> Box:
        """Returns the window in which kinds look for evidence of some squares, from the origin of the first."""
        return _around(self.own_box(*squares), self.halos.scene_m, _STEP_M)

    def classes_box(self, *squares: TileId) -> Box:
        """Returns the window in which returns are classified, from the origin of the first square."""
        return _around(self.own_box(*squares), self.halos.classes_m, _STEP_M)

    def ground_box(self, *squares: TileId) -> Box:
        """Returns the window whose returns tell of bare earth, from the origin of the first square."""
        return _around(self.own_box(*squares), self.halos.ground_m, _GROUND_STEP_M)

    def window(self, *squares: TileId) -> Bounds:
        """Returns the map (m) on which some squares depend."""
        (east, north), box = self.origin_m(squares[0]), self.ground_box(*squares)
        return Bounds(east + box.x_min_m, north + box.y_min_m, east + box.x_max_m, north + box.y_max_m)

    def tiles_under(self, square: TileId) -> list[TileId]:
        """Returns the survey's tiles that share ground with a square or its halos, by row and column."""
        return self.tiles.tiles_in(self.window(square))


def _around(box: Box, halo_m: float, step_m: float) -> Box:
    least = (math.floor((side - halo_m) / step_m + 1e-9) * step_m for side in box[:2])
    most = (math.ceil((side + halo_m) / step_m - 1e-9) * step_m for side in box[2:])
    return Box(*least, *most)
