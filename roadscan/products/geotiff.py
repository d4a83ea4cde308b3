"""``geotiff``: height, intensity, count and standard deviation of a tile's cells."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from roadscan.model.strict import Strict
from roadscan.products.base import ProductContext, Tile, TileProduct
from roadscan.products.quantities import QUANTITIES, band_of, values_of
from roadscan.products.raster import CellBox, cell_image, check_cog, memory_raster, raster_settings, write_cog


class GeoTiff(TileProduct):
    """One cloud-optimised GeoTIFF a tile: four float32 bands, NaN where no point lies.

    The bands are the robust height (in the unit of the map's heights), the mean intensity, the number of
    points and the standard deviation of the heights. The georeference is in the CRS's own unit.
    """

    name: ClassVar[str] = "geotiff"
    title: ClassVar[str] = "cells of a tile as a GeoTIFF (height, intensity, count, standard deviation), for GIS"
    suffix: ClassVar[str] = ".tif"

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's four bands."""
        cells = tile.cells
        box = CellBox.around([cells.tile], context.grid)
        bands = [band_of(quantity, context) for quantity in QUANTITIES]
        with raster_settings(), memory_raster(box, bands, context) as raster:
            raster.update_tags(ROADSCAN_TILE=str(cells.tile))
            for number, quantity in enumerate(QUANTITIES, start=1):
                raster.write(cell_image(cells, values_of(quantity, cells, context), "float32"), number)
            write_cog(raster, path)

    def check(self, path: Path) -> None:
        """Decode every block of every band and overview and compare with the stored digest."""
        check_cog(path, bands=len(QUANTITIES), dtype="float32")
