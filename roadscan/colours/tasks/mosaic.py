"""The orthophotos of all tiles as one raster: a VRT that names them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final
from xml.sax.saxutils import escape

from roadscan.colours.tasks.orthophoto import BANDS, ORTHOPHOTO
from roadscan.core.grid import TileGrid
from roadscan.core.ids import TileId
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.raster import CellBox

MOSAIC: Final = "orthophoto_mosaic"
UNIT: Final = "orthophoto"


@dataclass(frozen=True)
class Mosaic:
    """The mosaic of a survey's orthophotos."""

    key: str
    tiles: tuple[TileId, ...]


def plan_mosaic(manifest: Manifest, context: ProductContext, cell_m: float) -> Mosaic:
    """Returns the mosaic of the orthophotos that are there."""
    held = (TileId.parse(unit) for unit, one in manifest.of(ORTHOPHOTO).items() if one.path)
    tiles = tuple(sorted(held, key=lambda t: (t.row, t.column)))
    code = code_digest("roadscan.colours.tasks.mosaic:write_mosaic")
    return Mosaic(key_of(code, [str(t) for t in tiles], context.map, context.grid, cell_m), tiles)


def write_mosaic(store: Store, mosaic: Mosaic, context: ProductContext, cell_m: float) -> OutputRecord:
    """Write the VRT beside the files of the tiles; its numbers of pictures count in each tile for itself."""
    grid = TileGrid(context.grid.size_m, cell_m)
    box, edge = CellBox.around(mosaic.tiles, grid), grid.cells_per_edge
    place = box.transform(replace(context, grid=grid))
    lines = [
        f'<VRTDataset rasterXSize="{box.width}" rasterYSize="{box.height}">',
        f"<SRS>{escape(context.map.wkt())}</SRS>",
    ]
    lines.append("<GeoTransform>" + ", ".join(repr(float(v)) for v in place.to_gdal()) + "</GeoTransform>")
    for number, band in enumerate(BANDS, start=1):
        colour = band.description.capitalize() if number <= 3 else "Undefined"
        lines.append(f'<VRTRasterBand dataType="Byte" band="{number}"><Description>{band.description}</Description>')
        lines.append(f"<NoDataValue>0</NoDataValue><ColorInterp>{colour}</ColorInterp>")
        for tile in mosaic.tiles:
            left, right, top, bottom = box.tile_window(tile, edge)
            size = f'xSize="{right - left}" ySize="{bottom - top}"'
            lines.append(
                f'<ComplexSource><SourceFilename relativeToVRT="1">{tile}.tif</SourceFilename>'
                f'<SourceBand>{number}</SourceBand><SrcRect xOff="0" yOff="0" {size}/>'
                f'<DstRect xOff="{left}" yOff="{top}" {size}/><NODATA>0</NODATA></ComplexSource>'
            )
        lines.append("</VRTRasterBand>")
    content = "\n".join([*lines, "</VRTDataset>", ""]).encode()
    target = f"products/{ORTHOPHOTO}/{UNIT}.vrt"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(MOSAIC, UNIT, mosaic.key, target, len(content), bytes_digest(content))
