"""Reads a tile's file of the product `surface` as cells."""

from __future__ import annotations

import numpy as np

from roadscan.condition.settings import ConditionConfig
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import TileGrid
from roadscan.core.ids import TileId
from roadscan.core.survey import Survey
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.store import Store
from roadscan.surface.reconstruction import SurfaceGrid
from roadscan.surface.settings import SurfaceConfig
from roadscan.tiles.cells import TileCells
from roadscan.tiles.product import ProductContext


def check_surface_cells(survey: Survey) -> None:
    """Raise :class:`ConfigError` where surface heights are requested and there is no surface on the tiles' cells."""
    config, surface = ConditionConfig.stated(survey), SurfaceConfig.stated(survey)
    if config is None or config.heights == "cells":
        return
    cell_m = survey.config.tiles.cell_m
    grid = TileGrid(survey.config.tiles.size_m, cell_m)
    made = survey.config.products.make
    if surface is None or (made is not None and "surface" not in made):
        raise ConfigError(
            'condition.heights = "surface", and the survey does not make the product `surface`',
            change="add the section [surface] and the product, or take the heights of cells",
        )
    if SurfaceGrid(grid, surface).cell_m != (cell_m, cell_m):
        east, north = SurfaceGrid(grid, surface).cell_m
        raise ConfigError(
            f'condition.heights = "surface", whose cells have {east:g} × {north:g} m',
            expected=f"those of the tiles, {cell_m:g} m",
            change="take the heights of cells",
        )


def read_surface(store: Store, record: OutputRecord, cells_per_edge: int, context: ProductContext) -> TileCells:
    """Return heights of a tile's surface as cells of one reading each, with unknown spread."""
    import rasterio  # slow to import

    with rasterio.MemoryFile(read_recorded(store, record)) as file, file.open() as raster:
        names = list(raster.descriptions)
        if "height" not in names or raster.shape != (cells_per_edge, cells_per_edge):
            raise StoreError(
                f"the surface has bands {names} of {raster.shape} pixels",
                expected=f"a band height of {cells_per_edge} × {cells_per_edge}",
                change="let products.options.surface.bands hold height",
                file=store.path(record.path),
            )
        image = raster.read(names.index("height") + 1)[::-1].astype(np.float64) * context.map.vertical_unit_m
    row, column = np.nonzero(~np.isnan(image))
    height, n = image[row, column], row.size
    nan, one = np.full(n, np.nan), np.ones(n, np.uint32)
    return TileCells(
        tile=TileId.parse(record.unit), cells_per_edge=cells_per_edge, column=column.astype(np.uint16),
        row=row.astype(np.uint16), count=one, height_mean_m=height, height_robust_m=height, height_min_m=nan,
        height_max_m=nan, height_std_m=nan.astype(np.float32), intensity_mean=nan.astype(np.float32),
        pass_count=np.zeros(n, np.uint16), pass_offsets=np.zeros(n + 1, np.int32), pass_ids=np.empty(0, np.uint16),
    )  # fmt: skip
