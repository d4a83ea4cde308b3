"""``pothole_pieces``: what may be potholes in a tile's surface, as pieces that `potholes` joins over all tiles."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import pyarrow as pa

from roadscan.model.distress import PotholeDetection
from roadscan.model.strict import Strict
from roadscan.products.base import ProductContext, SurfaceProduct
from roadscan.products.crack_pieces import check_cells, height_window
from roadscan.products.geo_table import check_geo_table, read_geo_table, write_geo_table
from roadscan.surfaces.potholes import PotholePiece, halo_cells, pothole_pieces
from roadscan.surfaces.tile import SurfaceTile

COLUMNS: Final = pa.schema(
    [
        pa.field(name, pa.float64(), nullable=False)
        for name in ("area_m2", "volume_m3", "depth_max_m", "block_depth_max_m")
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
        check_cells(cell_m, seen, halo_cells(cast(PotholeDetection, options), cell_m[0]), self.name)

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Detect and write."""
        config = cast(PotholeDetection, options)
        pieces = pothole_pieces(height_window(surface, halo_cells(config, surface.cell_m[0]), self.name), config)
        table = pa.table(
            [pa.array([getattr(p, name) for p in pieces], pa.float64()) for name in COLUMNS.names], COLUMNS
        )
        outlines = np.array([p.outline for p in pieces], dtype=object)
        write_geo_table(path, table, "outline", outlines, ["Polygon"], context)

    def check(self, path: Path) -> None:
        """Decode it."""
        check_geo_table(path, COLUMNS)


def read_pieces(content: bytes, context: ProductContext) -> list[PotholePiece]:
    """Pieces of a tile's file."""
    table, outlines = read_geo_table(content, context)
    figures = [table[name].to_pylist() for name in COLUMNS.names]
    return [PotholePiece(one, *row) for one, row in zip(outlines, zip(*figures, strict=True), strict=True)]
