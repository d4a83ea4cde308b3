"""How every raster product lies in its file: north up, in the CRS's own units, as a cloud-optimised GeoTIFF."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.shutil import copy as translate
from rasterio.transform import Affine
from rasterio.windows import Window

import roadscan
from roadscan.model.crs import MapFrame, crs_from_text
from roadscan.model.errors import StoreError
from roadscan.model.ids import TileId
from roadscan.points.cloud import QUANTA_PER_M
from roadscan.products.base import ProductContext
from roadscan.tiles.cells import TileCells
from roadscan.tiles.grid import TileGrid

SOFTWARE: Final = "roadscan " + ".".join(roadscan.__version__.split(".")[:2])
"""Program and version as the files name it."""

DIGEST_TAG: Final = "ROADSCAN_BLAKE2B"
"""Metadata item with the digest of the full-resolution pixels and their place, so that a flipped bit is found."""

BLOCK: Final = 512
"""Largest edge of a compressed block (pixels)."""

_SMALLEST_OVERVIEW: Final = 128
_CACHE_BYTES: Final = 64 * 2**20


@dataclass(frozen=True)
class Band:
    """One band of a raster."""

    description: str
    unit: str


@dataclass(frozen=True)
class CellBox:
    """A rectangle of cells, numbered over the whole map: cell 0 starts at the map's origin."""

    west: int
    """Column of the first cell."""
    south: int
    """Row of the first cell."""
    width: int
    height: int

    @classmethod
    def around(cls, tiles: Iterable[TileId], grid: TileGrid) -> Self:
        """Smallest box that holds all cells of `tiles` (at least one)."""
        columns, rows = zip(*((t.column, t.row) for t in tiles), strict=True)
        n, west, south = grid.cells_per_edge, min(columns), min(rows)
        return cls(west * n, south * n, (max(columns) + 1 - west) * n, (max(rows) + 1 - south) * n)

    @property
    def north(self) -> int:
        """Row after the last cell."""
        return self.south + self.height

    def grown(self, cells: int) -> CellBox:
        """The box with `cells` more on every side."""
        return CellBox(self.west - cells, self.south - cells, self.width + 2 * cells, self.height + 2 * cells)

    def transform(self, context: ProductContext) -> Affine:
        """Map position, in the CRS's own unit, of a (column, row) counted from the north-west corner."""
        unit_quanta = QUANTA_PER_M * context.map.horizontal_unit_m
        cell = context.grid.cell_quanta
        pixel = cell / unit_quanta
        return Affine(pixel, 0.0, self.west * cell / unit_quanta, 0.0, -pixel, self.north * cell / unit_quanta)

    def tile_window(self, tile: TileId, edge: int) -> tuple[int, int, int, int]:
        """Columns and rows (first, end, first, end) of a tile of `edge` squared cells, cut off at the box."""
        left = tile.column * edge - self.west
        top = self.north - (tile.row + 1) * edge
        return max(left, 0), min(left + edge, self.width), max(top, 0), min(top + edge, self.height)

    def block(self, column: int, row: int) -> Window:
        """Window of the block of that number, counted from the north-west."""
        left, top = column * BLOCK, row * BLOCK
        return Window(left, top, min(BLOCK, self.width - left), min(BLOCK, self.height - top))

    def blocks(self) -> Iterator[Window]:
        """Windows of the blocks that cover the raster, row by row."""
        for row in range(-(-self.height // BLOCK)):
            for column in range(-(-self.width // BLOCK)):
                yield self.block(column, row)

    def blocks_under(self, tiles: Iterable[TileId], edge: int) -> list[Window]:
        """Windows of the blocks that share a cell with one of `tiles`, row by row."""
        found: set[tuple[int, int]] = set()
        for tile in tiles:
            x0, x1, y0, y1 = self.tile_window(tile, edge)
            found |= {(y, x) for y in range(y0 // BLOCK, -(-y1 // BLOCK)) for x in range(x0 // BLOCK, -(-x1 // BLOCK))}
        return [self.block(column, row) for row, column in sorted(found)]


@functools.lru_cache(maxsize=16)
def height_unit(frame: MapFrame) -> str:
    """Name of the unit that heights are written in."""
    return "metre" if frame.vertical_crs is None else str(crs_from_text(frame.vertical_crs).axis_info[-1].unit_name)


@functools.lru_cache(maxsize=16)
def raster_crs(frame: MapFrame) -> CRS:
    """CRS of the map, compound where a vertical CRS is named, as rasterio holds it."""
    return CRS.from_wkt(frame.wkt())


def cell_image(cells: TileCells, values: npt.NDArray[Any], dtype: str) -> npt.NDArray[Any]:
    """(rows, columns) image of one value (n,) a cell, north up, NaN where no point lies."""
    edge = cells.cells_per_edge
    image = np.full((edge, edge), np.nan, dtype=dtype)
    image[edge - 1 - cells.row.astype(np.int64), cells.column] = values
    return image


def paste_tile(raster: Any, box: CellBox, tile: TileId, image: npt.NDArray[Any]) -> None:
    """Write a tile's (rows, columns) image into the first band of `raster`, as far as `box` reaches."""
    edge = image.shape[0]
    left, top = tile.column * edge - box.west, box.north - (tile.row + 1) * edge
    x0, x1, y0, y1 = box.tile_window(tile, edge)
    if x0 < x1 and y0 < y1:
        raster.write(image[y0 - top : y1 - top, x0 - left : x1 - left], 1, window=Window(x0, y0, x1 - x0, y1 - y0))


@contextlib.contextmanager
def raster_settings() -> Iterator[None]:
    """GDAL as raster products need it: one file each, one thread, a block cache that does not grow."""
    with rasterio.Env(
        GDAL_PAM_ENABLED="NO",
        GDAL_NUM_THREADS="1",
        GDAL_CACHEMAX=_CACHE_BYTES,
        SPARSE_OK_OVERVIEW="ON",
        GDAL_TIFF_OVR_BLOCKSIZE=str(BLOCK),
    ):
        yield


@contextlib.contextmanager
def without_place_warning() -> Iterator[None]:
    """Keep rasterio from warning of a file without georeference: a picture, or a product found damaged."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


@functools.cache
def compression() -> str:
    """ZSTD, or DEFLATE where this GDAL was built without it."""
    profile = _profile(1, 1, 1, "uint8", 0) | {"transform": Affine.scale(2.0)}
    try:
        with MemoryFile() as memory, memory.open(**profile, compress="ZSTD") as probe:
            probe.write(np.ones((1, 1, 1), dtype=np.uint8))
    except RasterioError:
        return "DEFLATE"
    return "ZSTD"


@dataclass(frozen=True)
class SparseRaster:
    """What a one-band raster is to be, before it has pixels."""

    box: CellBox
    band: Band
    dtype: str
    nodata: float
    context: ProductContext

    @contextlib.contextmanager
    def scratch(self, path: Path) -> Iterator[Any]:
        """The raster in the file `path`, removed at the end; blocks never written take no room."""
        try:
            with self._create(path) as raster:
                yield raster
        finally:
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def cog(self, path: Path) -> Iterator[Any]:
        """The raster to be filled; it becomes a cloud-optimised GeoTIFF at `path` when it is left."""
        scratch = path.with_name(path.name + ".scratch")
        try:
            with self._create(scratch) as raster:
                yield raster
            with rasterio.open(scratch, "r+") as raster:
                write_cog(raster, path)
        finally:
            scratch.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _create(self, path: Path) -> Iterator[Any]:
        layout = {
            "tiled": True,
            "blockxsize": BLOCK,
            "blockysize": BLOCK,
            "sparse_ok": True,
            "bigtiff": "IF_SAFER",
            "compress": compression(),
            "predictor": 3 if self.dtype.startswith("float") else 2,
        }
        if compression() == "ZSTD":
            layout["zstd_level"] = 1
        profile = _profile(self.box.width, self.box.height, 1, self.dtype, self.nodata)
        with rasterio.open(path, "w+", **profile, **layout, **_place(self.box, self.context)) as raster:
            _describe(raster, [self.band], self.context)
            yield raster


def write_cog(raster: Any, path: Path) -> None:
    """Write a filled raster (open for reading and writing) to `path` as a cloud-optimised GeoTIFF.

    Overviews halve the raster until it is small; each of their pixels is the mean of those below it
    that hold a value. The same pixels give the same bytes.
    """
    raster.update_tags(**{DIGEST_TAG: raster_digest(raster)})
    factors = overview_factors(raster.width, raster.height)
    if factors:
        raster.build_overviews(factors, Resampling.average)
    translate(
        raster,
        str(path),
        driver="COG",
        compress=compression(),
        level=1 if compression() == "ZSTD" else 6,
        predictor="YES",
        blocksize=_block_edge(raster),
        overviews="FORCE_USE_EXISTING",
        sparse_ok="TRUE",
        bigtiff="IF_SAFER",
        num_threads="1",
    )


def _block_edge(raster: Any) -> int:
    """Smallest edge that holds a small raster in one block: a multiple of 16, as TIFF wants, from 128 on."""
    longest: int = max(raster.width, raster.height)
    return min(BLOCK, max(128, -(-longest // 16) * 16))


def overview_factors(width: int, height: int) -> list[int]:
    """Powers of two by which a raster is reduced, until its longer edge is 128 pixels or less."""
    factors: list[int] = []
    while max(width, height) / 2 ** len(factors) > _SMALLEST_OVERVIEW:
        factors.append(2 ** (len(factors) + 1))
    return factors


def raster_digest(raster: Any) -> str:
    """BLAKE2b digest (128 bits, hexadecimal) of georeference and bands, block by block, without empty blocks."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr(raster.transform.to_gdal()).encode())
    for window in _stored_blocks(raster):
        pixels = raster.read(window=window)
        empty = np.isnan(pixels) if pixels.dtype.kind == "f" else pixels == raster.nodata
        if empty.all():
            continue
        pixels[empty] = raster.nodata  # one bit pattern of NaN
        digest.update(f"{window.col_off},{window.row_off};".encode())
        digest.update(np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).data)
    return digest.hexdigest()


def check_cog(path: Path, bands: int, dtype: str) -> None:
    """Decode all of a raster product, overviews too, and compare its full-resolution pixels with their digest.

    Raises :class:`StoreError` for a file that is damaged or no product.
    """
    try:
        with raster_settings(), without_place_warning():
            with rasterio.open(path, driver="GTiff") as raster:
                _check_header(raster, path, bands, dtype)
                _check_pixels(raster, path)
                levels = len(raster.overviews(1))
            for level in range(levels):
                with rasterio.open(path, driver="GTiff", overview_level=level) as overview:
                    _decode(overview)
    except (RasterioError, UnicodeDecodeError) as error:
        raise StoreError(f"the GeoTIFF cannot be read: {error}", change="make it again", file=path) from error


def _check_header(raster: Any, path: Path, bands: int, dtype: str) -> None:
    if raster.count != bands or set(raster.dtypes) != {dtype}:
        found = f"{raster.count} bands of {', '.join(sorted(set(raster.dtypes)))}"
        raise StoreError(f"the GeoTIFF has {found}", expected=f"{bands} of {dtype}", file=path)
    if raster.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") != "COG":
        raise StoreError("the GeoTIFF is not cloud-optimised", change="make it again", file=path)


def _check_pixels(raster: Any, path: Path) -> None:
    stated = raster.tags().get(DIGEST_TAG)
    found = raster_digest(raster)
    if stated != found:
        raise StoreError(
            f"the pixels' digest is {found}",
            expected=str(stated),
            change="the file is damaged: make it again",
            file=path,
        )


def _decode(raster: Any) -> None:
    for window in _stored_blocks(raster):
        raster.read(window=window)


def _stored_blocks(raster: Any) -> Iterator[Window]:
    """Windows that cover the raster, without the blocks that a sparse GeoTIFF leaves out."""
    in_file = raster.driver == "GTiff" and raster.block_shapes[0] == (BLOCK, BLOCK)
    for window in CellBox(0, 0, raster.width, raster.height).blocks():
        place = f"BLOCK_OFFSET_{window.col_off // BLOCK}_{window.row_off // BLOCK}"
        if not in_file or raster.get_tag_item(place, "TIFF", bidx=1) is not None:
            yield window


def _profile(width: int, height: int, bands: int, dtype: str, nodata: float) -> dict[str, Any]:
    return {"driver": "GTiff", "width": width, "height": height, "count": bands, "dtype": dtype, "nodata": nodata}


def _place(box: CellBox, context: ProductContext) -> dict[str, Any]:
    return {"crs": raster_crs(context.map), "transform": box.transform(context)}


def _describe(raster: Any, bands: Sequence[Band], context: ProductContext) -> None:
    raster.descriptions = [band.description for band in bands]
    raster.units = [band.unit for band in bands]
    raster.update_tags(
        AREA_OR_POINT="Area",
        TIFFTAG_SOFTWARE=SOFTWARE,
        TIFFTAG_DATETIME=f"{context.date:%Y:%m:%d} 00:00:00",
        ROADSCAN_SURVEY=context.survey_id,
        ROADSCAN_HEIGHT="local" if context.map.is_local else context.map.height,
    )
