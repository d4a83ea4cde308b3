"""``geotiff``: height, intensity and count of a tile's cells."""

from __future__ import annotations

import dataclasses
import functools
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, cast
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
from pydantic import Field
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from roadscan.kernels.raster_blocks import cut_lines, round_values
from roadscan.model.crs import MapFrame
from roadscan.model.ids import TileId
from roadscan.model.strict import Strict
from roadscan.products import raster
from roadscan.products.base import ProductContext, Tile, TileProduct
from roadscan.products.packer import Packer
from roadscan.products.pixel_blocks import DenseBlocks, ScatteredBlocks
from roadscan.products.quantities import Quantity, band_of
from roadscan.products.raster import Band, CellBox
from roadscan.products.tiff import Page, Tag, check_tiff, digest_item, tiff_parts
from roadscan.tiles.cells import TileCells
from roadscan.tiles.pyramid import Level, pyramid_of

STEPS: Final[dict[Quantity, float]] = {
    "height": 2.0**-15,
    "intensity": 1.0,
    "count": 1.0,
    "height_std": 2.0**-20,
}
"""Pixels are whole multiples of this. Bits below it are noise that takes time and room; float32 itself has no finer
heights from 256 m on."""

BLOCK: Final = 512
"""Largest edge of a block (pixels)."""

_SMALLEST_OVERVIEW: Final = 32
_SAMPLE: Final = 4096


class GeoTiffOptions(Strict):
    """Settings of `geotiff`."""

    bands: tuple[Quantity, ...] = Field(default=("height", "intensity", "count"), min_length=1)
    """Bands in their order: height (robust, rounded to 2⁻¹⁵ of its unit), intensity (mean, rounded to a whole
    number), count (points), height_std (standard deviation of the heights, rounded to 2⁻²⁰ of the unit)."""


class GeoTiff(TileProduct):
    """One cloud-optimised GeoTIFF a tile: float32 bands, NaN where no point lies, and overviews.

    The bands are the robust height (in the unit of the map's heights), the mean intensity and the number of
    points; the standard deviation of the heights can be added. The georeference is in the CRS's own unit.
    Overviews have pixels of 2, 8 and 32 cells, or the numbers nearest to these that divide the tile (10, 40 and
    200 mm for 10 m tiles of 5 mm cells), while they are 32 pixels or more: the mean of the cells' heights, the mean
    intensity of all points, the mean number of points a cell that holds one.

    Images are DEFLATE in blocks of up to 512 pixels, those without a cell left out; where most cells have none beside
    them, as those of a scanner with few readings, without a predictor, so that a block costs by cell and not by pixel.
    """

    name: ClassVar[str] = "geotiff"
    title: ClassVar[str] = "cells of a tile as a GeoTIFF (height, intensity, count) with overviews, for GIS"
    suffix: ClassVar[str] = ".tif"
    version: ClassVar[int] = 4
    options: ClassVar[type[Strict]] = GeoTiffOptions

    def write(self, tile: Tile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the tile's bands; only blocks that hold a cell are made."""
        bands = cast(GeoTiffOptions, options).bands
        images = [_image(tile.cells, bands, context), *_overviews(tile, bands, context)]
        packer = Packer.of_thread()
        pages = [_page(image, bands, number > 0, packer) for number, image in enumerate(images)]
        place = CellBox.around([tile.cells.tile], context.grid).transform(context)
        about = description(tile.cells.tile, place, [band_of(b, context) for b in bands], context)
        first = dataclasses.replace(pages[0], tags=(*pages[0].tags, *about))
        with path.open("wb") as stream:
            stream.writelines(tiff_parts([first, *pages[1:]]))

    def check(self, path: Path) -> None:
        """Compare every byte with the stored digest."""
        check_tiff(path)


@dataclass(frozen=True)
class _Image:
    """Sparse pixels of all bands, in order of row (from the south) and column."""

    edge: int
    column: npt.NDArray[np.uint16]
    row: npt.NDArray[np.uint16]
    bands: tuple[tuple[npt.NDArray[Any], float], ...]
    """(n,) values of each band, and what they are multiplied with."""


def _image(cells: TileCells, bands: tuple[Quantity, ...], context: ProductContext) -> _Image:
    unit_m = context.map.vertical_unit_m
    sources: dict[Quantity, tuple[npt.NDArray[Any], float]] = {
        "height": (cells.height_robust_m, 1 / unit_m),
        "intensity": (cells.intensity_mean, 1.0),
        "count": (cells.count, 1.0),
        "height_std": (cells.height_std_m, 1 / unit_m),
    }
    return _Image(cells.cells_per_edge, cells.column, cells.row, tuple(sources[b] for b in bands))


def _overviews(tile: Tile, bands: tuple[Quantity, ...], context: ProductContext) -> list[_Image]:
    cells, unit_m = tile.cells, context.map.vertical_unit_m
    edge = cells.cells_per_edge
    levels = [level for level in tile.overviews if edge // level.factor >= _SMALLEST_OVERVIEW]
    spread = levels
    if "height_std" in bands:
        deviations = cells.height_std_m.astype(np.float64)
        factors = [level.factor for level in levels]
        spread = pyramid_of(dataclasses.replace(cells, height_robust_m=deviations), factors)
    sources: dict[Quantity, Callable[[Level, Level], tuple[npt.NDArray[Any], float]]] = {
        "height": lambda level, _: (level.height_m, 1 / unit_m),
        "intensity": lambda level, _: (level.intensity, 1.0),
        "count": lambda level, _: (level.count / level.cells, 1.0),
        "height_std": lambda _, of_std: (of_std.height_m, 1 / unit_m),
    }
    return [
        _Image(edge // level.factor, level.column, level.row, tuple(sources[b](level, of_std) for b in bands))
        for level, of_std in zip(levels, spread, strict=True)
    ]


def _page(image: _Image, bands: tuple[Quantity, ...], reduced: bool, packer: Packer) -> Page:
    """Encode and compress the blocks of an image, band by band."""
    edge = min(BLOCK, -(-image.edge // 16) * 16)
    across = -(-image.edge // edge)
    starts = np.append(np.searchsorted(image.row, np.arange(image.edge, dtype=np.uint16)), len(image.row))
    cuts = np.empty((across + 1, across * edge), np.int64)
    cuts[:, image.edge :] = 0
    cut_lines(image.column, starts, edge, cuts[:, : image.edge])
    cuts[:, : image.edge] = cuts[:, : image.edge][:, ::-1].copy()  # from the north
    rounded = np.empty(len(image.row), np.float32)
    scattered = _is_scattered(image)
    make = (
        ScatteredBlocks(image.column, rounded, edge) if scattered else DenseBlocks(image.column, rounded, edge, packer)
    )
    blocks: list[Any] = []
    for (values, factor), quantity in zip(image.bands, bands, strict=True):
        step = STEPS[quantity]
        round_values(values, factor / step, step, rounded)
        for strip in range(across):
            own = slice(strip * edge, (strip + 1) * edge)
            for block in range(across):
                first, last = cuts[block, own], cuts[block + 1, own]
                blocks.append(None if (first == last).all() else make.block(first, last, block * edge))
    return Page(layout(image.edge, image.edge, edge, len(bands), reduced, predicted=not scattered), blocks)


def _is_scattered(image: _Image) -> bool:
    """True where fewer than half of the pixels have one beside them, by a sample."""
    own = np.arange(1, len(image.row), 1 + len(image.row) // _SAMPLE)
    beside = (image.column[own] == image.column[own - 1] + 1) & (image.row[own] == image.row[own - 1])
    return bool(2 * np.count_nonzero(beside) < own.size)


@functools.lru_cache(maxsize=64)
def layout(
    width: int, height: int, block: int, bands: int, reduced: bool, *, predicted: bool = True
) -> tuple[Tag, ...]:
    """Tags of an image of float32 bands, each in square blocks of its own (`block` pixels), NaN where nothing lies.

    `predicted`: the blocks' bytes are by significance and differenced (TIFF Technical Note 3), not as in memory.
    """
    return (
        Tag(254, "I", [1 if reduced else 0]),
        Tag(256, "I", [width]),
        Tag(257, "I", [height]),
        Tag(258, "H", [32] * bands),
        Tag(259, "H", [8]),
        Tag(262, "H", [1]),
        Tag(277, "H", [bands]),
        Tag(284, "H", [2]),  # each band in blocks of its own
        Tag(317, "H", [3 if predicted else 1]),
        Tag(322, "I", [block]),
        Tag(323, "I", [block]),
        *([Tag(338, "H", [0] * (bands - 1))] if bands > 1 else []),
        Tag(339, "H", [3] * bands),
        Tag(42113, "s", [b"nan"]),
    )


def description(tile: TileId, place: Affine, bands: Sequence[Band], context: ProductContext) -> list[Tag]:
    """Place on the map, names, units and the rest of the metadata."""
    items = [
        f'<Item name="{name}">{escape(value)}</Item>'
        for name, value in (
            ("ROADSCAN_SURVEY", context.survey_id),
            ("ROADSCAN_HEIGHT", "local" if context.map.is_local else context.map.height),
            ("ROADSCAN_TILE", str(tile)),
        )
    ]
    text = "\n  ".join(["<GDALMetadata>", digest_item(), *items, *_band_items(bands)])
    return [
        Tag(305, "s", [raster.SOFTWARE.encode()]),
        Tag(306, "s", [f"{context.date:%Y:%m:%d} 00:00:00".encode()]),
        Tag(33550, "d", [place.a, -place.e, 0.0]),
        Tag(33922, "d", [0.0, 0.0, 0.0, place.c, place.f, 0.0]),
        *geo_keys(context.map),
        Tag(42112, "s", [text.encode() + b"\n</GDALMetadata>\n"]),
    ]


def _band_items(bands: Sequence[Band]) -> list[str]:
    items: list[str] = []
    for number, band in enumerate(bands):
        for name, value in (("DESCRIPTION", band.description), ("UNITTYPE", band.unit)):
            items.append(f'<Item name="{name}" sample="{number}" role="{name.lower()}">{escape(value)}</Item>')
    return items


@functools.lru_cache(maxsize=16)
def geo_keys(frame: MapFrame) -> tuple[Tag, ...]:
    """Tags that state the CRS, as GDAL itself writes them into a file with that CRS."""
    profile = {"driver": "GTiff", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
    with raster.raster_settings(), MemoryFile() as memory:
        with memory.open(**profile, crs=raster.raster_crs(frame), transform=Affine(1, 0, 1, 0, -1, 1)):
            pass
        content = bytes(memory.getbuffer())
    start = struct.unpack_from("<I", content, 4)[0]
    kinds = {2: ("s", 1), 3: ("H", 2), 12: ("d", 8)}
    found: list[Tag] = []
    for number in range(struct.unpack_from("<H", content, start)[0]):
        at = start + 2 + 12 * number
        tag, kind, count = struct.unpack_from("<HHI", content, at)
        if tag not in {34735, 34736, 34737}:
            continue
        code, size = kinds[kind]
        place = at + 8 if count * size <= 4 else struct.unpack_from("<I", content, at + 8)[0]
        values: Any = struct.unpack_from(f"<{count}{code}", content, place)
        found.append(Tag(tag, code, [values[0].removesuffix(b"\0")] if code == "s" else values))
    return tuple(found)
