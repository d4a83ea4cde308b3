"""``pothole_pieces``: possible potholes in a tile's surface, as pieces that `potholes` joins over all tiles."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import pyarrow as pa

from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict
from roadscan.distress.potholes import PotholePiece, around_cells, halo_cells, pothole_pieces
from roadscan.distress.products.crack_pieces import check_cells, height_window
from roadscan.distress.settings import PotholeDetection
from roadscan.surface.heights import HeightWindow
from roadscan.surface.tile import SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct
from roadscan.tiles.products.geo_table import check_geo_table, read_geo_table, write_geo_table

COLUMNS: Final = pa.schema(
    [
        pa.field(name, pa.float64(), nullable=False)
        for name in ("area_m2", "volume_m3", "depth_max_m", "block_depth_max_m", "edge_depth_m", "hidden_m2")
    ]
)


class PotholePieces(SurfaceProduct):
    """GeoParquet 1.1: a row a hole, or the part of it that lies in the tile, as a polygon along the sides of cells.

    Area, volume and depth are those of its cells below the ground around. Only the whole shows whether it is a pothole.
    """

    name: ClassVar[str] = "pothole_pieces"
    title: ClassVar[str] = "holes in a tile's surface, with area, depth and volume (GeoParquet)"
    suffix: ClassVar[str] = ".parquet"
    options: ClassVar[type[Strict]] = PotholeDetection
    default: ClassVar[bool] = False

    def check_cells(self, options: Strict, cell_m: tuple[float, float], seen: int) -> None:
        """Square cells, small enough that what potholes depend on lies within those that a tile sees."""
        config = cast(PotholeDetection, options)
        check_cells(cell_m, seen, halo_cells(config, cell_m[0]), self.name)
        if cell_m[0] > config.block_m:
            raise ConfigError(
                f"'{self.name}' got cells of {cell_m[0]:g} m",
                expected=f"at most block_m, {config.block_m:g} m",
                change="make tiles.cell_m or surface.cell_m smaller",
            )

    def around_m(self, options: Strict, cell_m: tuple[float, float]) -> float:
        """Returns the margin (m) that the ground around the largest pothole needs."""
        return around_cells(cast(PotholeDetection, options), cell_m[0]) * cell_m[0]

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Detect the possible potholes of the tile and write them."""
        config = cast(PotholeDetection, options)
        pieces = pothole_pieces(self._window(surface, config), config)
        table = pa.table(
            [pa.array([getattr(p, name) for p in pieces], pa.float64()) for name in COLUMNS.names], COLUMNS
        )
        outlines = np.array([p.outline for p in pieces], dtype=object)
        write_geo_table(path, table, "outline", outlines, ["Polygon"], context)

    def _window(self, surface: SurfaceTile, config: PotholeDetection) -> HeightWindow:
        """Returns the measurements around the tile, and the tile's smooth heights in the middle of them."""
        near = height_window(surface, halo_cells(config, surface.cell_m[0]), self.name)
        wide_m, halo = surface.around
        more = halo - near.halo
        height_m = np.full(wide_m.shape, np.nan)
        height_m[more : wide_m.shape[0] - more, more : wide_m.shape[1] - more] = near.height_m
        first = near.first_row - more, near.first_column - more
        return HeightWindow(wide_m, height_m, near.cell_m, near.sigma_m, *first, halo)

    def check(self, path: Path) -> None:
        """Decode the file."""
        check_geo_table(path, COLUMNS)


def read_pieces(content: bytes, context: ProductContext) -> list[PotholePiece]:
    """Returns the pieces in a tile's file."""
    table, outlines = read_geo_table(content, context)
    figures = [table[name].to_pylist() for name in COLUMNS.names]
    return [PotholePiece(one, *row) for one, row in zip(outlines, zip(*figures, strict=True), strict=True)]
