"""Cells of a simulated road as tiles hold them, from readings at random places of each cell."""

from __future__ import annotations

from typing import Any

import numpy as np

from roadscan.condition.kernels.sampling import CellTable
from roadscan.condition.road_line import Lane, RoadLine
from roadscan.condition.tasks.stretches import cell_table
from roadscan.core.grid import TileId
from roadscan.simulate import Scene
from roadscan.simulate.surface import Surface
from roadscan.tiles.cells import TileCells

EDGE_M = 10.0


class LaneOfCells:
    """A straight road that crosses a tile of 10 m aslant, one lane in its middle."""

    def __init__(self, width_m: float = 2.0, **road: Any) -> None:
        values = {"id": "lane", "length_m": 20.0, "passes": [{"lane": 1}], "map": {"azimuth_deg": 73.0}}
        plain: dict[str, Any] = {"verge_slope": 0.025}
        self.scene = Scene.parse(values | {"road": plain | road})
        self.surface = Surface(self.scene)
        nodes = np.arange(0.0, 20.0)
        east, north, _ = self.surface.place(nodes, np.zeros(nodes.size))
        self.line = RoadLine("A", np.column_stack([east, north]))
        self.lane = Lane("A", "1", 1, 0, np.zeros(nodes.size), width_m, "stated", ())
        self.tile = TileId(int(east[8] // EDGE_M), int(north[8] // EDGE_M))

    def table(
        self,
        cell_m: float,
        readings: int,
        between_m: tuple[float, float] = (3.6, 10.2),
        beside_m: float = 0.1,
        noise_m: float = 0.0003,
    ) -> CellTable:
        """The cells of the tile between two stations, each with so many readings (a square number).

        beside_m : how far beyond the lane there are cells.
        """
        rng, along = np.random.default_rng(1), round(readings**0.5)
        edge = round(EDGE_M / cell_m)
        count = edge * edge
        row, column = (a.ravel() for a in np.divmod(np.arange(count), edge))
        corner = EDGE_M * np.array([self.tile.column, self.tile.row])
        middle = corner + cell_m * (np.column_stack([column, row]) + 0.5)
        station, away = self.line.along(middle, 8.0)
        near = np.abs(away) < 0.5 * self.lane.width_m + beside_m
        near &= (station > between_m[0]) & (station < between_m[1])
        row, column = row[near], column[near]
        inside = np.stack(np.meshgrid(np.arange(along), np.arange(along)), axis=-1).reshape(-1, 2)
        place = np.column_stack([column, row])[:, None] + (inside + rng.uniform(size=(row.size, readings, 2))) / along
        place = corner + cell_m * place
        height = self.surface.height_m(place[..., 0], place[..., 1]) + rng.normal(0.0, noise_m, place.shape[:2])
        shade = (self.surface.intensity(place[..., 0], place[..., 1]) + rng.normal(0.0, 3.0, place.shape[:2])).mean(1)
        n, nan = row.size, np.full(row.size, np.nan)
        cells = TileCells(
            self.tile, edge, column.astype(np.uint16), row.astype(np.uint16), np.full(n, readings, np.uint32),
            height.mean(1), np.median(height, axis=1), nan, nan, height.std(1).astype(np.float32),
            shade.astype(np.float32), np.ones(n, np.uint16), np.zeros(n + 1, np.int32), np.empty(0, np.uint16),
        )  # fmt: skip
        return cell_table([cells], cell_m)
