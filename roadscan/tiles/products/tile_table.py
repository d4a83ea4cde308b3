"""``tile_table``: which tiles there are and what lies in them, for SQL and GIS."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.core.grid import TileId
from roadscan.core.strict import Strict
from roadscan.tiles.product import LoadCells, Output, ProductContext, SurveyProduct, TileSummary
from roadscan.tiles.products.geo_table import check_geo_table, write_geo_table

_FILE: Final = "tiles.parquet"

_COLUMNS: Final = pa.schema(
    [
        pa.field("tile", pa.string(), nullable=False),
        pa.field("tile_column", pa.int32(), nullable=False),
        pa.field("tile_row", pa.int32(), nullable=False),
        pa.field("easting_min_m", pa.float64(), nullable=False),
        pa.field("northing_min_m", pa.float64(), nullable=False),
        pa.field("points", pa.int64(), nullable=False),
        pa.field("cells", pa.int64(), nullable=False),
        pa.field("area_m2", pa.float64(), nullable=False),
        pa.field("height_min_m", pa.float64(), nullable=False),
        pa.field("height_mean_m", pa.float64(), nullable=False),
        pa.field("height_max_m", pa.float64(), nullable=False),
        pa.field("height_std_median_m", pa.float64(), nullable=False),
        pa.field("intensity_mean", pa.float64(), nullable=False),
        pa.field("passes", pa.list_(pa.field("element", pa.uint16(), nullable=False)), nullable=False),
        pa.field("first_epoch_gps_ns", pa.int64(), nullable=False),
        pa.field("last_epoch_gps_ns", pa.int64(), nullable=False),
        pa.field("sigma_horizontal_m", pa.float64(), nullable=True),
        pa.field("sigma_down_m", pa.float64(), nullable=True),
    ]
)
"""Types of ``schemas/tiles.toml``; a test compares them."""


class TileTable(SurveyProduct):
    """GeoParquet 1.1 of the table ``tiles`` with each tile's outline.

    The plain columns (metres) suffice for SQL without a spatial extension; the outline is in the map's
    CRS and its unit. A local frame states no CRS.
    """

    name: ClassVar[str] = "tile_table"
    table: ClassVar[str] = "tiles"
    title: ClassVar[str] = "table of the tiles with their outlines (GeoParquet), for DuckDB, pandas and GIS"

    def outputs(self, tiles: Sequence[TileId], options: Strict, context: ProductContext) -> list[Output]:
        """Return one file."""
        return [Output(_FILE, tuple(sorted(tiles)))]

    def write(
        self,
        output: Output,
        tiles: Sequence[TileSummary],
        load_cells: LoadCells,
        options: Strict,
        context: ProductContext,
        path: Path,
    ) -> None:
        """Write the table, sorted by column and row of the tile."""
        rows = sorted(tiles, key=lambda t: t.tile)
        table = pa.Table.from_pylist([_row(one, context) for one in rows], schema=_COLUMNS)
        write_geo_table(path, table, "outline", _outlines_m(rows, context), ["Polygon"], context, counterclockwise=True)

    def check(self, path: Path) -> None:
        """Decode every column, page checksums included, and every outline."""
        check_geo_table(path, _COLUMNS)


def _row(one: TileSummary, context: ProductContext) -> dict[str, Any]:
    box = context.grid.bounds(one.tile)
    return {
        "tile": str(one.tile),
        "tile_column": one.tile.column,
        "tile_row": one.tile.row,
        "easting_min_m": box.easting_min_m,
        "northing_min_m": box.northing_min_m,
        "points": one.points,
        "cells": one.cells,
        "area_m2": one.cells * context.grid.cell_m**2,
        "height_min_m": one.height_min_m,
        "height_mean_m": one.height_mean_m,
        "height_max_m": one.height_max_m,
        "height_std_median_m": one.height_std_median_m,
        "intensity_mean": one.intensity_mean,
        "passes": list(one.passes),
        "first_epoch_gps_ns": one.first_epoch_gps_ns,
        "last_epoch_gps_ns": one.last_epoch_gps_ns,
        "sigma_horizontal_m": one.sigma_horizontal_m,
        "sigma_down_m": one.sigma_down_m,
    }


def _outlines_m(rows: Sequence[TileSummary], context: ProductContext) -> Any:
    """Return (n,) polygons on the map (m), counter-clockwise."""
    boxes = [context.grid.bounds(one.tile) for one in rows]
    edges = np.array([[b.easting_min_m, b.northing_min_m, b.easting_max_m, b.northing_max_m] for b in boxes])
    return shapely.box(*edges.reshape(-1, 4).T, ccw=True)
