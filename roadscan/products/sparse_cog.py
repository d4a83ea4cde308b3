"""A cloud-optimised GeoTIFF of one band from images that lie far apart, without touching the empty ground between.

A block of 512² pixels is open from the first image that reaches into it to the last; then it is compressed, halved
into the block above it, and forgotten. GDAL makes overviews of every block of the raster, empty or not: of a square
kilometre with a road through it that takes fifteen times as long.
"""

from __future__ import annotations

import mmap
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.products.base import ProductContext
from roadscan.products.geotiff import geo_keys
from roadscan.products.raster import BLOCK, SOFTWARE, Band, CellBox, compression, overview_factors
from roadscan.products.tiff import Page, Tag, digest_item, tiff_parts

Image = npt.NDArray[Any]

_COMPRESSIONS: Final = {"ZSTD": 50000, "DEFLATE": 8}
_Place = tuple[int, int, int]
"""Level (0 is the image itself), row and column of a block, counted from the north-west."""


@dataclass(frozen=True)
class SparseCog:
    """What the raster is to be: float32 with NaN, or uint8 with 0, where it is empty."""

    box: CellBox
    band: Band
    dtype: str
    context: ProductContext

    def write(
        self, path: Path, images: Iterable[tuple[int, int, Image]], places: Iterable[tuple[int, int, int]]
    ) -> None:
        """Write the file.

        Parameters
        ----------
        images : column and row (from the north-west) of each image's first pixel, and its pixels. None overlap.
        places : column, row and edge of each of the same images, known before they are made.
        """
        scratch = path.with_name(path.name + ".blocks.scratch")
        try:
            with scratch.open("w+b") as stream:
                blocks = _Blocks(self._sizes(), np.dtype(self.dtype), stream, Counter(_blocks_under(places)))
                for left, top, image in images:
                    blocks.paste(left, top, image)
                pages = self._pages(blocks)
                with path.open("wb") as file:
                    file.writelines(tiff_parts(pages))
        finally:
            scratch.unlink(missing_ok=True)

    def _sizes(self) -> list[tuple[int, int]]:
        """Width and height of the image and of its overviews."""
        width, height = self.box.width, self.box.height
        return [(-(-width // f), -(-height // f)) for f in (1, *overview_factors(width, height))]

    def _pages(self, blocks: _Blocks) -> list[Page]:
        stored = blocks.stored()
        pages: list[Page] = []
        for level, (width, height) in enumerate(self._sizes()):
            rows, columns = -(-height // BLOCK), -(-width // BLOCK)
            own = [stored.get((level, r, c)) for r in range(rows) for c in range(columns)]
            pages.append(Page((*self._layout(level, width, height), *(self._about() if level == 0 else ())), own))
        return pages

    def _layout(self, level: int, width: int, height: int) -> list[Tag]:
        floats = self.dtype == "float32"
        return [
            Tag(254, "I", [1 if level else 0]),
            Tag(256, "I", [width]),
            Tag(257, "I", [height]),
            Tag(258, "H", [32 if floats else 8]),
            Tag(259, "H", [_COMPRESSIONS[compression()]]),
            Tag(262, "H", [1]),
            Tag(277, "H", [1]),
            Tag(317, "H", [3 if floats else 2]),
            Tag(322, "I", [BLOCK]),
            Tag(323, "I", [BLOCK]),
            Tag(339, "H", [3 if floats else 1]),
            Tag(42113, "s", [b"nan" if floats else b"0"]),
        ]

    def _about(self) -> list[Tag]:
        """Place on the map, name, unit and the rest of the metadata."""
        place, frame = self.box.transform(self.context), self.context.map
        stated = [("ROADSCAN_SURVEY", self.context.survey_id)]
        stated.append(("ROADSCAN_HEIGHT", "local" if frame.is_local else frame.height))
        items = [f'<Item name="{name}">{escape(value)}</Item>' for name, value in stated]
        for name, value in (("DESCRIPTION", self.band.description), ("UNITTYPE", self.band.unit)):
            items.append(f'<Item name="{name}" sample="0" role="{name.lower()}">{escape(value)}</Item>')
        text = "\n  ".join(["<GDALMetadata>", digest_item(), *items]) + "\n</GDALMetadata>\n"
        return [
            Tag(305, "s", [SOFTWARE.encode()]),
            Tag(306, "s", [f"{self.context.date:%Y:%m:%d} 00:00:00".encode()]),
            Tag(33550, "d", [place.a, -place.e, 0.0]),
            Tag(33922, "d", [0.0, 0.0, 0.0, place.c, place.f, 0.0]),
            *geo_keys(frame),
            Tag(42112, "s", [text.encode()]),
        ]


def _blocks_under(places: Iterable[tuple[int, int, int]]) -> Iterator[_Place]:
    for left, top, edge in places:
        for row in range(top // BLOCK, -(-(top + edge) // BLOCK)):
            for column in range(left // BLOCK, -(-(left + edge) // BLOCK)):
                yield 0, row, column


@dataclass
class _Blocks:
    """Blocks of all levels on their way into a scratch file."""

    sizes: list[tuple[int, int]]
    kind: np.dtype[Any]
    stream: BinaryIO
    waiting: Counter[_Place]
    """Images, or blocks of the level below, that are still to come."""
    open: dict[_Place, Image] = field(default_factory=dict)
    extents: dict[_Place, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._compress = _compressor()
        below = list(self.waiting)
        for level in range(1, len(self.sizes)):
            parents = Counter((level, row // 2, column // 2) for _, row, column in below)
            self.waiting.update(parents)
            below = list(parents)

    def paste(self, left: int, top: int, image: Image) -> None:
        """Put an image into the blocks that it reaches into."""
        edge = image.shape[0]
        for place in _blocks_under([(left, top, edge)]):
            y, x = place[1] * BLOCK, place[2] * BLOCK
            y0, y1, x0, x1 = max(top, y), min(top + edge, y + BLOCK), max(left, x), min(left + edge, x + BLOCK)
            self._add(place, y0 - y, x0 - x, image[y0 - top : y1 - top, x0 - left : x1 - left])

    def stored(self) -> dict[_Place, memoryview]:
        """Compressed bytes of each block that holds a value."""
        self.stream.flush()
        if not self.extents:
            return {}
        whole = memoryview(mmap.mmap(self.stream.fileno(), 0, access=mmap.ACCESS_READ))
        return {place: whole[start : start + size] for place, (start, size) in self.extents.items()}

    def _add(self, place: _Place, y: int, x: int, part: Image) -> None:
        block = self.open.get(place)
        if block is None:
            empty = np.nan if self.kind.kind == "f" else 0
            block = self.open[place] = np.full((BLOCK, BLOCK), empty, self.kind)
        block[y : y + part.shape[0], x : x + part.shape[1]] = part
        self.waiting[place] -= 1
        if not self.waiting[place]:
            del self.open[place]
            self._finish(place, block)

    def _finish(self, place: _Place, block: Image) -> None:
        level, row, column = place
        if np.isnan(block).all() if self.kind.kind == "f" else not block.any():
            halved = block[: BLOCK // 2, : BLOCK // 2]
        else:
            content = self._compress(_differences(block))
            self.extents[place] = (self.stream.tell(), len(content))
            self.stream.write(content)
            halved = _halved(block)
        if level + 1 < len(self.sizes):
            half = BLOCK // 2
            self._add((level + 1, row // 2, column // 2), row % 2 * half, column % 2 * half, halved)


def _halved(block: Image) -> Image:
    """Mean of the pixels of each 2 × 2 that hold a value."""
    floats = block.dtype.kind == "f"
    parts = np.stack([block[i::2, j::2] for i in (0, 1) for j in (0, 1)]).astype(np.float64)
    known = ~np.isnan(parts) if floats else parts > 0
    parts[~known] = 0.0
    number = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = parts.sum(axis=0) / number
    return mean.astype(block.dtype) if floats else np.where(number, np.rint(mean), 0).astype(block.dtype)


def _differences(block: Image) -> bytes:
    """Pixels as TIFF's predictors want them: 3 (bytes of a line by significance) for floats, 2 for bytes."""
    if block.dtype.kind == "f":
        planes = block.astype(">f4").view(np.uint8).reshape(BLOCK, BLOCK, 4).transpose(0, 2, 1)
        block = np.ascontiguousarray(planes).reshape(BLOCK, 4 * BLOCK)
    coded = block.copy()
    coded[:, 1:] -= block[:, :-1]
    return coded.tobytes()


def _compressor() -> Callable[[bytes], bytes]:
    if compression() == "ZSTD":
        codec = pa.Codec("zstd", compression_level=1)
        return lambda block: bytes(codec.compress(block, asbytes=True))
    return lambda block: zlib.compress(block, 6)
