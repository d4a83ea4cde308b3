"""Layout of raster products (north up, in the CRS's units, cloud-optimised GeoTIFF), their quantities and sheets."""

from __future__ import annotations

import contextlib
import functools
import operator
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import MapFrame, crs_from_text
from roadscan.core.errors import StoreError
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import QUANTA_PER_M, TileGrid, TileId
from roadscan.store.codecs.cog import BLOCK, About, Band, check_cog, overview_factors, write_sparse_cog
from roadscan.tiles.cells import CellValues, TileCells
from roadscan.tiles.product import LoadCells, Output, ProductContext, TileSummary

if TYPE_CHECKING:
    from rasterio.transform import Affine
    from rasterio.windows import Window


@dataclass(frozen=True)
class CellBox:
    """A rectangle of cells, numbered over the whole map: cell 0 starts at the map's origin."""

    west: int
    """Column of the first cell."""
    south: int
    """Row of the first cell."""
    width: int
    height: int
    edges_m: tuple[float, float] | None = None
    """Edges of a cell (m), east and north, of a grid other than the map's; None for the context's cells."""

    @classmethod
    def around(cls, tiles: Iterable[TileId], grid: TileGrid) -> Self:
        """Return the smallest box that contains all cells of `tiles` (at least one)."""
        columns, rows = zip(*tiles, strict=True)
        n, west, south = grid.cells_per_edge, min(columns), min(rows)
        return cls(west * n, south * n, (max(columns) + 1 - west) * n, (max(rows) + 1 - south) * n)

    @property
    def north(self) -> int:
        """Row after the last cell."""
        return self.south + self.height

    def grown(self, cells: int) -> CellBox:
        """Return the box with `cells` more on every side."""
        return CellBox(
            self.west - cells, self.south - cells, self.width + 2 * cells, self.height + 2 * cells, self.edges_m
        )

    def transform(self, context: ProductContext) -> Affine:
        """Return the transform from (column, row) from the north-west corner to the map, in the CRS's unit."""
        from rasterio.transform import Affine

        if self.edges_m is not None:
            unit_m, (east, north) = context.map.horizontal_unit_m, self.edges_m
            return Affine(
                east / unit_m, 0.0, self.west * east / unit_m, 0.0, -north / unit_m, self.north * north / unit_m
            )
        unit_quanta = QUANTA_PER_M * context.map.horizontal_unit_m
        cell = context.grid.cell_quanta
        pixel = cell / unit_quanta
        return Affine(pixel, 0.0, self.west * cell / unit_quanta, 0.0, -pixel, self.north * cell / unit_quanta)

    def tile_window(self, tile: TileId, edge: int) -> tuple[int, int, int, int]:
        """Return columns and rows (first, end, first, end) of a tile of `edge` squared cells, cut off at the box."""
        left = tile.column * edge - self.west
        top = self.north - (tile.row + 1) * edge
        return max(left, 0), min(left + edge, self.width), max(top, 0), min(top + edge, self.height)

    def block(self, column: int, row: int) -> Window:
        """Return the window of a block by its column and row, counted from the north-west."""
        from rasterio.windows import Window

        left, top = column * BLOCK, row * BLOCK
        return Window(left, top, min(BLOCK, self.width - left), min(BLOCK, self.height - top))

    def blocks(self) -> Iterator[Window]:
        """Yield the windows of the blocks that cover the raster, row by row."""
        for row in range(-(-self.height // BLOCK)):
            for column in range(-(-self.width // BLOCK)):
                yield self.block(column, row)

    def blocks_under(self, tiles: Iterable[TileId], edge: int) -> list[Window]:
        """Yield the windows of the blocks that share a cell with one of `tiles`, row by row."""
        found: set[tuple[int, int]] = set()
        for tile in tiles:
            x0, x1, y0, y1 = self.tile_window(tile, edge)
            found |= {(y, x) for y in range(y0 // BLOCK, -(-y1 // BLOCK)) for x in range(x0 // BLOCK, -(-x1 // BLOCK))}
        return [self.block(column, row) for row, column in sorted(found)]


@functools.lru_cache(maxsize=16)
def height_unit(frame: MapFrame) -> str:
    """Return the name of the unit in which heights are written."""
    return frame.vertical_unit


def cell_image(cells: TileCells | CellValues, values: npt.NDArray[Any], dtype: str) -> npt.NDArray[Any]:
    """Return a (rows, columns) image of one value (n,) a cell, north up, NaN where no point lies."""
    edge = cells.cells_per_edge
    image = np.full((edge, edge), np.nan, dtype=dtype)
    image[edge - 1 - cells.row.astype(np.int64), cells.column] = values
    return image


def paste_tile(raster: Any, box: CellBox, tile: TileId, image: npt.NDArray[Any]) -> None:
    """Write a tile's (rows, columns) image into the first band of `raster`, as far as `box` reaches."""
    from rasterio.windows import Window

    edge = image.shape[0]
    left, top = tile.column * edge - box.west, box.north - (tile.row + 1) * edge
    x0, x1, y0, y1 = box.tile_window(tile, edge)
    if x0 < x1 and y0 < y1:
        raster.write(image[y0 - top : y1 - top, x0 - left : x1 - left], 1, window=Window(x0, y0, x1 - x0, y1 - y0))


@dataclass(frozen=True)
class SparseRaster:
    """Properties of a one-band raster whose pixels are written later."""

    box: CellBox
    band: Band
    dtype: str
    nodata: float
    context: ProductContext

    @contextlib.contextmanager
    def scratch(self, path: Path) -> Iterator[Any]:
        """Yield a raster in the file `path`, removed at the end; blocks never written take no room."""
        try:
            with self._create(path) as raster:
                yield raster
        finally:
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def cog(self, path: Path) -> Iterator[Any]:
        """Yield a raster to be filled; at the end it becomes a cloud-optimised GeoTIFF at `path`.

        Overviews halve the raster until it is small; each of their pixels is the mean of those below it that hold a
        value. The same pixels give the same bytes.
        """
        import rasterio

        scratch = path.with_name(path.name + ".scratch")
        try:
            with self._create(scratch) as raster:
                yield raster
            with rasterio.open(scratch) as raster:
                blocks = list(self._stored_blocks(raster))
                write_sparse_cog(
                    path,
                    (self.box.width, self.box.height),
                    self.dtype,
                    ((block.col_off, block.row_off, raster.read(1, window=block)) for block in blocks),
                    [block.flatten() for block in blocks],
                    about(self.box.transform(self.context), [self.band], self.context),
                )
        finally:
            scratch.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _create(self, path: Path) -> Iterator[Any]:
        import rasterio

        layout = {"tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK, "sparse_ok": True, "bigtiff": "IF_SAFER"}
        profile = {
            "driver": "GTiff",
            "width": self.box.width,
            "height": self.box.height,
            "count": 1,
            "dtype": self.dtype,
            "nodata": self.nodata,
            "transform": self.box.transform(self.context),
            "compress": "DEFLATE",
            "zlevel": 1,
        }
        with rasterio.open(path, "w+", **profile, **layout) as raster:
            yield raster

    def _stored_blocks(self, raster: Any) -> Iterator[Window]:
        """Return the windows of the blocks that were written."""
        for block in self.box.blocks():
            place = f"BLOCK_OFFSET_{block.col_off // BLOCK}_{block.row_off // BLOCK}"
            if raster.get_tag_item(place, "TIFF", bidx=1) is not None:
                yield block


def about(
    transform: Affine,
    bands: Sequence[Band],
    context: ProductContext,
    tile: TileId | None = None,
    more: Sequence[tuple[str, str]] = (),
) -> About:
    """Return the metadata of a raster; `more`: names and values of further metadata."""
    height = "local" if context.map.is_local else context.map.height
    items = [("ROADSCAN_SURVEY", context.survey_id), ("ROADSCAN_HEIGHT", height)]
    if tile is not None:
        items.append(("ROADSCAN_TILE", str(tile)))
    return About(context.map, transform, tuple(bands), context.date, (*items, *more))


Quantity = Literal["height", "intensity", "count", "height_std"]
"""Robust height, mean intensity, number of points, standard deviation of the heights."""

QUANTITIES: Final[tuple[Quantity, ...]] = get_args(Quantity)


def band_of(quantity: Quantity, context: ProductContext) -> Band:
    """Return the band that shows a quantity; heights are in the unit of the map's heights."""
    unit = height_unit(context.map)
    return {
        "height": Band("height", unit),
        "intensity": Band("intensity", "digital number"),
        "count": Band("count", "points"),
        "height_std": Band("height standard deviation", unit),
    }[quantity]


COLUMNS: Final[dict[Quantity, str]] = {
    "height": "height_robust_m",
    "intensity": "intensity_mean",
    "count": "count",
    "height_std": "height_std_m",
}
"""The column of cells that each quantity draws."""


def in_unit(quantity: Quantity, values: npt.NDArray[Any], context: ProductContext) -> npt.NDArray[Any]:
    """Return (n,) values of a quantity's column in the unit of its band."""
    return values.astype(np.float64) / context.map.vertical_unit_m if quantity in ("height", "height_std") else values


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


def outputs_of_bands(
    names: Iterable[str], tiles: Sequence[TileId], sheet_m: float | None, grid: TileGrid
) -> list[Output]:
    """Return the sheets of each band, followed by the index that joins them."""
    found: list[Output] = []
    for name in names:
        sheets = cut_sheets(name, tiles, sheet_m, grid)
        found += [Output(sheet.name, sheet.tiles) for sheet in sheets]
        found += index_output(name, sheets)
    return found


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
