"""``crack_pieces``: the cracks of a tile's surface, as pieces that the product `cracks` joins over all tiles."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import pyarrow as pa
import shapely

from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict
from roadscan.distress.cracks import CrackPiece, crack_pieces, halo_cells
from roadscan.distress.settings import CrackDetection
from roadscan.surface.heights import HeightWindow
from roadscan.surface.regions import FILLED
from roadscan.surface.tile import SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct
from roadscan.tiles.products.geo_table import check_geo_table, read_geo_table, write_geo_table

_SIMPLER_CELLS: Final = 0.25
"""Vertices this close (cells) to a straight line are left out."""

COLUMNS: Final = pa.schema(
    [pa.field(name, pa.int64(), nullable=False) for name in ("start_row", "start_column", "end_row", "end_column")]
    + [
        pa.field(name, pa.float64(), nullable=False)
        for name in (
            "length_m", "measured_m", "width_sum_m2", "width_max_m", "depth_sum_m2", "depth_max_m", "seen_sum_m",
            "beside_sum_m", "cell_m",
        )
    ]
)  # fmt: skip


def check_cells(cell_m: tuple[float, float], seen: int, needed: int, product: str) -> None:
    """Raise :class:`ConfigError` where the cells do not suit a detection that needs a margin of `needed` cells."""
    east, north = cell_m
    if east != north or needed > seen:
        raise ConfigError(
            f"'{product}' got cells of {east:g} × {north:g} m and {seen} of the neighbours' on each side",
            expected=f"square cells, and {needed} of the neighbours'",
            change="give tiles.cell_m or surface.cell_m 5 mm or less, or look for narrower defects",
        )


def height_window(surface: SurfaceTile, needed: int, product: str) -> HeightWindow:
    """Returns the surface of a tile for a detection that needs a margin of `needed` cells."""
    check_cells(surface.cell_m, surface.halo, needed, product)
    window = surface.window
    seen = np.where(surface.origin == FILLED, np.nan, surface.height_m)  # a straight line is no evidence
    return HeightWindow(
        surface.raw_m,
        seen,
        surface.cell_m[0],
        surface.sigma_m,
        window.first_row,
        window.first_column,
        surface.halo,
        lowest=surface.lowest,
    )


class CrackPieces(SurfaceProduct):
    """GeoParquet 1.1: a row a piece of crack from node to node, as a line.

    Nodes are ends, junctions and the tile's border; they are named by row and column of their cell on the map, so that
    pieces of neighbouring tiles join where nodes are the same. Figures are such that can be added: length, integrals of
    width and depth along the piece, and their greatest values. Pieces of all lengths are kept: only the whole shows
    whether it is a crack.
    """

    name: ClassVar[str] = "crack_pieces"
    title: ClassVar[str] = "pieces of cracks in a tile's surface, with width and depth (GeoParquet)"
    suffix: ClassVar[str] = ".parquet"
    options: ClassVar[type[Strict]] = CrackDetection
    default: ClassVar[bool] = False

    def check_cells(self, options: Strict, cell_m: tuple[float, float], seen: int) -> None:
        """Square cells, small enough that what cracks depend on lies within those that a tile sees."""
        check_cells(cell_m, seen, halo_cells(cast(CrackDetection, options), cell_m[0]), self.name)

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Detect the cracks of the tile and write their pieces."""
        config = cast(CrackDetection, options)
        cell_m = surface.cell_m[0]
        window = height_window(surface, halo_cells(config, cell_m), self.name)
        pieces = crack_pieces(window, config)
        rows = [
            (*p.start, *p.end, p.length_m, p.measured_m, p.width_sum_m2, p.width_max_m, p.depth_sum_m2, p.depth_max_m,
             p.seen_sum_m, p.beside_sum_m, cell_m)
            for p in pieces
        ]  # fmt: skip
        table = pa.Table.from_pylist([dict(zip(COLUMNS.names, row, strict=True)) for row in rows], COLUMNS)
        lines = np.array([shapely.LineString(p.line_m) for p in pieces], dtype=object)
        lines = shapely.simplify(lines, _SIMPLER_CELLS * cell_m)
        write_geo_table(path, table, "line", lines, ["LineString"], context)

    def check(self, path: Path) -> None:
        """Decode the file."""
        check_geo_table(path, COLUMNS)


def read_pieces(content: bytes, context: ProductContext) -> tuple[list[CrackPiece], float]:
    """Returns the pieces in a tile's file, and the edge of its cells (m)."""
    table, lines = read_geo_table(content, context)
    columns = [table[name].to_pylist() for name in COLUMNS.names]
    pieces = [
        CrackPiece(shapely.get_coordinates(line), (row[0], row[1]), (row[2], row[3]), *row[4:12])
        for line, row in zip(lines, zip(*columns, strict=True), strict=True)
    ]
    return pieces, columns[-1][0] if pieces else 0.0
