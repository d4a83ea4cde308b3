"""Cuts rasters over a whole survey into sheets, and writes the index (VRT) that joins them."""

from __future__ import annotations

import operator
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from roadscan.core.crs import MapFrame, crs_from_text
from roadscan.core.errors import StoreError
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import TileGrid, TileId
from roadscan.store.codecs.cog import Band, overview_factors
from roadscan.store.codecs.tiff import check_cog
from roadscan.tiles.cells import CellValues
from roadscan.tiles.product import LoadCells, Output, ProductContext, TileSummary
from roadscan.tiles.products.raster import CellBox

_VRT_TYPES: Final = {"float32": ("Float32", "nan"), "uint8": ("Byte", "0")}
"""GDAL's name and the value of empty cells, by type of the sheets."""

_SHEET_CELLS: Final = 20_000  # Cells along the edge of a sheet, by default.
_ROW: Final = operator.attrgetter("row")


@dataclass(frozen=True)
class Sheet:
    """One file of a survey raster and the tiles drawn on it, from north to south and west to east."""

    name: str
    tiles: tuple[TileId, ...]


def cut_sheets(stem: str, tiles: Iterable[TileId], sheet_m: float | None, grid: TileGrid) -> list[Sheet]:
    """Return the sheets of the raster `stem` over `tiles`.

    A survey no wider and no higher than one sheet is one file, ``stem.tif``. A larger one is cut along
    multiples of the sheet's edge, counted from the map's origin, into ``stem_COLUMN_ROW.tif``. A
    sheet's edge is a whole number of tiles: `sheet_m` (or 20,000 cells) rounded down, at least one tile.
    """
    drawn = _from_north_west(tiles)
    if not drawn:
        return []
    edge = _tiles_per_edge(sheet_m, grid)
    box = CellBox.around(drawn, grid)
    if max(box.width, box.height) <= edge * grid.cells_per_edge:
        return [Sheet(f"{stem}.tif", drawn)]
    cut: dict[tuple[int, int], list[TileId]] = {}
    for tile in drawn:
        cut.setdefault((tile.column // edge, tile.row // edge), []).append(tile)
    return [Sheet(f"{stem}_{column}_{row}.tif", tuple(cut[column, row])) for column, row in sorted(cut)]


def sheet_of(stem: str, output: Output, sheet_m: float | None, grid: TileGrid) -> Sheet | None:
    """Return the sheet of the raster `stem` that `output` is, if any, without tiles that are only its neighbours."""
    found = re.fullmatch(rf"{re.escape(stem)}(?:_(-?\d+)_(-?\d+))?\.tif", output.name)
    if found is None:
        return None
    if found[1] is None:
        return Sheet(output.name, _from_north_west(output.tiles))
    edge, place = _tiles_per_edge(sheet_m, grid), (int(found[1]), int(found[2]))
    own = (tile for tile in output.tiles if (tile.column // edge, tile.row // edge) == place)
    return Sheet(output.name, _from_north_west(own))


def _from_north_west(tiles: Iterable[TileId]) -> tuple[TileId, ...]:
    return tuple(sorted(sorted(tiles), key=_ROW, reverse=True))


def _tiles_per_edge(sheet_m: float | None, grid: TileGrid) -> int:
    wanted = _SHEET_CELLS / grid.cells_per_edge if sheet_m is None else sheet_m / grid.size_m
    return max(1, int(wanted + 1e-9))


def index_name(stem: str) -> str:
    """Return the name of the file that joins the sheets of `stem`."""
    return f"{stem}.vrt"


def index_output(stem: str, sheets: Sequence[Sheet]) -> list[Output]:
    """Return the index over `sheets`, where there is more than one.

    It depends on where the sheets lie, and so names the outermost tiles of each alone: a network has millions.
    """
    if len(sheets) < 2:
        return []
    return [Output(index_name(stem), tuple(sorted({tile for sheet in sheets for tile in _outermost(sheet.tiles)})))]


def _outermost(tiles: Sequence[TileId]) -> set[TileId]:
    """Return up to four tiles that span the same box as all."""
    by_column = sorted(tiles)
    by_row = sorted(by_column, key=_ROW)
    return {by_column[0], by_column[-1], by_row[0], by_row[-1]}


def unknown_output(output: Output) -> StoreError:
    """Return the error for a file that the product does not make."""
    return StoreError(f"'{output.name}' is no file of this product", expected="one of those it lists")


def dated(context: ProductContext, tiles: Iterable[TileSummary], drawn: Iterable[TileId]) -> ProductContext:
    """Return the context with the UTC date of the first epoch of the tiles `drawn`, so a file depends on them alone."""
    members = set(drawn)
    first_gps_ns = min((one.first_epoch_gps_ns for one in tiles if one.tile in members), default=None)
    return context if first_gps_ns is None else replace(context, date=utc_from_gps_ns(first_gps_ns).date())


def values_in(tile: TileId, name: str, load_cells: LoadCells) -> CellValues:
    """Return a column of the cells of a tile; raises :class:`StoreError` where they are missing."""
    found = load_cells.values(tile, name)
    if found is None:
        raise StoreError(f"tile {tile} is listed and has no cells", change="run the survey again")
    return found


def write_index(
    path: Path,
    sheets: Sequence[Sheet],
    band: Band,
    dtype: str,
    context: ProductContext,
    box_of: Callable[[Iterable[TileId]], CellBox] | None = None,
) -> None:
    """Write a GDAL virtual raster (VRT) over one-band `sheets` of `dtype`, which lie in the same folder.

    `box_of` gives the pixels over tiles, where these are not the survey's cells.
    """
    type_name, nodata = _VRT_TYPES[dtype]
    over = box_of or (lambda tiles: CellBox.around(tiles, context.grid))
    box = over(tile for sheet in sheets for tile in sheet.tiles)
    root = ET.Element("VRTDataset", rasterXSize=str(box.width), rasterYSize=str(box.height))
    frame = context.map
    ET.SubElement(root, "SRS", dataAxisToSRSAxisMapping=_axis_mapping(frame)).text = frame.wkt()
    ET.SubElement(root, "GeoTransform").text = ", ".join(repr(v) for v in box.transform(context).to_gdal())
    metadata = ET.SubElement(root, "Metadata")
    ET.SubElement(metadata, "MDI", key="AREA_OR_POINT").text = "Area"
    raster_band = ET.SubElement(root, "VRTRasterBand", dataType=type_name, band="1")
    for tag, text in (("Description", band.description), ("NoDataValue", nodata), ("UnitType", band.unit)):
        if text:
            ET.SubElement(raster_band, tag).text = text
    for sheet in sheets:
        _add_source(raster_band, sheet.name, over(sheet.tiles), box, nodata)
    factors = overview_factors(box.width, box.height)
    if factors:
        ET.SubElement(root, "OverviewList", resampling="average").text = " ".join(str(f) for f in factors)
    ET.indent(root)
    path.write_bytes(ET.tostring(root, encoding="utf-8") + b"\n")


def check_sheet(path: Path) -> None:
    """Raise :class:`StoreError` unless `path` is a whole sheet, or an index whose sheets lie inside it."""
    with path.open("rb") as stream:
        is_index = stream.read(1) == b"<"
    if is_index:
        check_index(path)
    else:
        check_cog(path)


def check_index(path: Path) -> None:
    """Raise :class:`StoreError` unless `path` is an index whose sheets lie inside it."""
    try:
        root = ET.parse(path).getroot()
        width, height = int(root.attrib["rasterXSize"]), int(root.attrib["rasterYSize"])
        places = [source.attrib for source in root.iterfind("VRTRasterBand/ComplexSource/DstRect")]
        boxes = [[int(place[key]) for key in ("xOff", "yOff", "xSize", "ySize")] for place in places]
    except (OSError, ET.ParseError, KeyError, ValueError) as error:
        raise StoreError(f"the index of sheets cannot be read: {error}", change="make it again", file=path) from error
    if not boxes:
        raise StoreError("the index names no sheet", change="make it again", file=path)
    for x, y, columns, rows in boxes:
        if x < 0 or y < 0 or x + columns > width or y + rows > height:
            raise StoreError("a sheet lies outside the index", change="make it again", file=path)


def _add_source(band: ET.Element, name: str, own: CellBox, box: CellBox, nodata: str) -> None:
    source = ET.SubElement(band, "ComplexSource")
    ET.SubElement(source, "SourceFilename", relativeToVRT="1").text = name
    ET.SubElement(source, "SourceBand").text = "1"
    for tag, x, y in (("SrcRect", 0, 0), ("DstRect", own.west - box.west, box.north - own.north)):
        ET.SubElement(source, tag, xOff=str(x), yOff=str(y), xSize=str(own.width), ySize=str(own.height))
    ET.SubElement(source, "NODATA").text = nodata


def _axis_mapping(frame: MapFrame) -> str:
    """Return which axis of the CRS the raster's columns and rows run along (some CRSs state northing first)."""
    east_first = frame.crs is None or crs_from_text(frame.crs).axis_info[0].direction == "east"
    return ("1,2" if east_first else "2,1") + ("" if frame.vertical_crs is None else ",3")
