"""Writes cloud-optimised GeoTIFFs that omit empty blocks: equal pixels give equal bytes.

GDAL's driver does neither: it makes overviews of every block of a raster, empty or not, which takes fifteen times
as long for a square kilometre with a road through it. GDAL, which reads the files, is the oracle in tests. Pixels are
float32 with NaN or uint8 with 0 where nothing lies. Blocks go through TIFF's predictors (3 and 2), then DEFLATE, which
takes least time, or where most of a block may be empty ZSTD, which takes a third of the room for that.

In the file (TIFF 6.0; BigTIFF where 4 GB are not enough), first come all directories, then the blocks: those of the
smallest overview first, those of the image last. Each has its size before it and its last four bytes again behind it,
as GDAL's cloud-optimised files do. A block that holds nothing is left out (offset and size 0), as GDAL reads sparse
files.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import functools
import mmap
import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from blake3 import blake3

from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.kernels.byte_planes import cut_lines, encode_block, encode_cells, round_values
from roadscan.store.codecs.zlib_stream import compressed

if TYPE_CHECKING:
    from rasterio.crs import CRS
    from rasterio.transform import Affine

BLOCK: Final = 512
"""Largest edge of a compressed block (pixels)."""

_SMALLEST_OVERVIEW: Final = 128  # overviews are made until the longer edge (pixels) is not larger than this
_DEFLATE, _ZSTD = 8, 50000  # TIFF compression codes
_NEW_SUBFILE, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC = 254, 256, 257, 258, 259, 262  # TIFF tags
# Further tags (TIFF 6.0, section 8).
_SAMPLES, _PLANES, _SOFTWARE, _DATE, _PREDICTOR, _BLOCK_WIDTH, _BLOCK_HEIGHT = 277, 284, 305, 306, 317, 322, 323
_EXTRA_SAMPLES, _SAMPLE_FORMAT, _PIXEL_SCALE, _TIE_POINT, _GDAL_METADATA, _GDAL_NODATA = (
    338, 339, 33550, 33922, 42112, 42113
)  # fmt: skip
_COLOURS: Final = 3  # bands of bytes that are red, green and blue; further ones are something else
_GEO_KEYS: Final = (34735, 34736, 34737)  # TIFF tags of the GeoTIFF keys

Pixels = npt.NDArray[Any]


@dataclass(frozen=True)
class Band:
    """One band of a raster."""

    description: str
    unit: str


@dataclass(frozen=True)
class About:
    """Georeference and metadata of a raster."""

    frame: MapFrame
    transform: Affine
    """Map position, in the CRS's unit, of a (column, row) counted from the north-west corner."""
    bands: tuple[Band, ...]
    date: dt.date
    items: tuple[tuple[str, str], ...]
    """Further metadata: name and value."""


@dataclass(frozen=True)
class Image:
    """An image or one of its overviews, compressed."""

    width: int
    height: int
    edge: int
    """Edge of a block (pixels)."""
    dtype: str
    blocks: Sequence[Any]
    """Compressed blocks, None for empty ones; by band, then row by row."""
    compression: int = _DEFLATE


def write_cog(path: Path, images: Sequence[Image], about: About) -> None:
    """Write a whole file: the image, then its overviews in decreasing size."""
    pages = [Page(_layout(image, len(about.bands), number > 0), image.blocks) for number, image in enumerate(images)]
    first = Page((*pages[0].tags, *_description(about)), pages[0].blocks)
    with path.open("wb") as stream:
        stream.writelines(tiff_parts([first, *pages[1:]]))


def overview_factors(width: int, height: int) -> list[int]:
    """Return the powers of two by which a raster is reduced, until its longer edge is 128 pixels or less."""
    factors: list[int] = []
    while max(width, height) / 2 ** len(factors) > _SMALLEST_OVERVIEW:
        factors.append(2 ** (len(factors) + 1))
    return factors


def dense_image(bands: Sequence[npt.NDArray[np.float32]]) -> Image:
    """Return compressed bands (rows, columns), north up, NaN where no data is."""
    height, width = bands[0].shape
    edge = _block_edge(max(height, width))
    blocks = [
        _dense_block(band[top : top + edge, left : left + edge], edge)
        for band in bands
        for top in range(0, height, edge)
        for left in range(0, width, edge)
    ]
    return Image(width, height, edge, "float32", blocks)


def bytes_image(bands: Sequence[npt.NDArray[np.uint8]]) -> Image:
    """Return compressed bands (rows, columns) of bytes, north up, 0 where no data is."""
    height, width = bands[0].shape
    edge = _block_edge(max(height, width))
    blocks: list[bytes | None] = []
    for band in bands:
        for top in range(0, height, edge):
            for left in range(0, width, edge):
                part = band[top : top + edge, left : left + edge]
                whole = np.zeros((edge, edge), np.uint8)
                whole[: part.shape[0], : part.shape[1]] = part
                blocks.append(compressed(_predicted(whole)) if part.any() else None)
    return Image(width, height, edge, "uint8", blocks)


def sparse_image(
    size: int,
    column: npt.NDArray[np.uint16],
    row: npt.NDArray[np.uint16],
    bands: Iterable[tuple[Pixels, float, float]],
) -> Image:
    """Return the compressed cells of a square of `size` cells; only blocks with a cell are made.

    Parameters
    ----------
    column, row : (n,) of the cells, in order of row (from the south) and column.
    bands : (n,) values of each band, what they are multiplied with, and of what the pixels are whole multiples.
    """
    edge = _block_edge(size)
    across = -(-size // edge)
    starts = np.append(np.searchsorted(row, np.arange(size, dtype=np.uint16)), len(row))
    cuts = np.zeros((across + 1, across * edge), np.int64)
    cut_lines(column, starts, edge, cuts[:, :size])
    cuts[:, :size] = cuts[:, :size][:, ::-1].copy()  # row counted from the north
    rounded, out, lines = np.empty(len(row), np.float32), np.empty(4 * edge * edge, np.uint8), _lines(edge)
    blocks: list[bytes | None] = []
    for values, factor, step in bands:
        round_values(values, factor / step, step, rounded)
        for top in range(0, across * edge, edge):
            for block in range(across):
                first, last = cuts[block : block + 2, top : top + edge]
                if (first == last).all():
                    blocks.append(None)
                    continue
                encode_cells(column, rounded, first, last, block * edge, out, *lines)
                blocks.append(compressed(out))
    return Image(size, size, edge, "float32", blocks)


def write_sparse_cog(
    path: Path,
    size: tuple[int, int],
    dtype: str,
    pieces: Iterable[tuple[int, int, Pixels]],
    places: Iterable[tuple[int, int, int, int]],
    about: About,
) -> None:
    """Write a raster of one band from pieces, which may lie far apart, in bounded memory.

    A block is open from the first piece that reaches into it to the last; then it is compressed, halved into the block
    above it, and forgotten. Each pixel of an overview is the mean of those of the 2 × 2 below it that hold a value.

    Parameters
    ----------
    size : width and height.
    dtype : float32 or uint8.
    pieces : column and row (from the north-west) of each piece's first pixel, and its pixels. None overlap.
    places : column, row, width and height of each of the same pieces, known before they are made.
    """
    scratch = path.with_name(path.name + ".blocks.scratch")
    sizes = [(-(-size[0] // f), -(-size[1] // f)) for f in (1, *overview_factors(*size))]
    try:
        with scratch.open("w+b") as stream:
            blocks = _Blocks(sizes, np.dtype(dtype), stream, Counter(_blocks_under(places)))
            for left, top, piece in pieces:
                blocks.paste(left, top, piece)
            stored = blocks.stored()
            images = []
            for level, (width, height) in enumerate(sizes):
                rows, columns = -(-height // BLOCK), -(-width // BLOCK)
                own = [stored.get((level, r, c)) for r in range(rows) for c in range(columns)]
                images.append(Image(width, height, BLOCK, dtype, own, _ZSTD))
            write_cog(path, images, about)
    finally:
        scratch.unlink(missing_ok=True)


# --- blocks ------------------------------------------------------------------------------------------

_Place = tuple[int, int, int]
"""Level (0 is the image itself), row and column of a block, counted from the north-west."""


def _block_edge(longest: int) -> int:
    """Return the edge of an image's blocks: a small image is one block, whose edge is a multiple of 16."""
    return min(BLOCK, -(-longest // 16) * 16)


def _lines(edge: int) -> tuple[Any, ...]:
    """Return scratch arrays of the kernels: a line of pixels and its bytes, differences and their bytes."""
    line, differences = np.empty(edge, np.float32), np.empty(edge, np.uint32)
    return line, line.view(np.uint8), differences, differences.view(np.uint8)


def _dense_block(part: npt.NDArray[np.float32], edge: int) -> bytes | None:
    if np.isnan(part).all():
        return None
    whole = np.full((edge, edge), np.nan, np.float32)
    whole[: part.shape[0], : part.shape[1]] = part
    return compressed(_predicted(whole))


def _predicted(block: Pixels) -> npt.NDArray[np.uint8]:
    """Return a whole block encoded by TIFF's predictors: 3 for floats, 2 for bytes."""
    if block.dtype.kind != "f":
        return np.diff(block, axis=1, prepend=block.dtype.type(0))
    out = np.empty(block.nbytes, np.uint8)
    encode_block(block, out, *_lines(block.shape[1]))
    return out


def _blocks_under(places: Iterable[tuple[int, int, int, int]]) -> Iterator[_Place]:
    for left, top, width, height in places:
        for row in range(top // BLOCK, -(-(top + height) // BLOCK)):
            for column in range(left // BLOCK, -(-(left + width) // BLOCK)):
                yield 0, row, column


@dataclass
class _Blocks:
    """Blocks of all levels while they are written to a scratch file."""

    sizes: list[tuple[int, int]]
    kind: np.dtype[Any]
    stream: BinaryIO
    waiting: Counter[_Place]
    """Number of pieces, or blocks of the level below, that are still missing from each block."""
    open: dict[_Place, Pixels] = field(default_factory=dict)
    extents: dict[_Place, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._codec = pa.Codec("zstd", compression_level=1)
        below = list(self.waiting)
        for level in range(1, len(self.sizes)):
            parents = Counter((level, row // 2, column // 2) for _, row, column in below)
            self.waiting.update(parents)
            below = list(parents)

    def paste(self, left: int, top: int, piece: Pixels) -> None:
        """Copy a piece into the blocks that it overlaps."""
        height, width = piece.shape
        for place in _blocks_under([(left, top, width, height)]):
            y, x = place[1] * BLOCK, place[2] * BLOCK
            y0, y1, x0, x1 = max(top, y), min(top + height, y + BLOCK), max(left, x), min(left + width, x + BLOCK)
            self._add(place, y0 - y, x0 - x, piece[y0 - top : y1 - top, x0 - left : x1 - left])

    def stored(self) -> dict[_Place, memoryview]:
        """Return the compressed bytes of each block with data."""
        self.stream.flush()
        if not self.extents:
            return {}
        whole = memoryview(mmap.mmap(self.stream.fileno(), 0, access=mmap.ACCESS_READ))
        return {place: whole[start : start + size] for place, (start, size) in self.extents.items()}

    def _add(self, place: _Place, y: int, x: int, part: Pixels) -> None:
        block = self.open.get(place)
        if block is None:
            empty = np.nan if self.kind.kind == "f" else 0
            block = self.open[place] = np.full((BLOCK, BLOCK), empty, self.kind)
        block[y : y + part.shape[0], x : x + part.shape[1]] = part
        self.waiting[place] -= 1
        if not self.waiting[place]:
            del self.open[place]
            self._finish(place, block)

    def _finish(self, place: _Place, block: Pixels) -> None:
        level, row, column = place
        if np.isnan(block).all() if self.kind.kind == "f" else not block.any():
            halved = block[: BLOCK // 2, : BLOCK // 2]
        else:
            content = self._codec.compress(_predicted(block), asbytes=True)
            self.extents[place] = (self.stream.tell(), len(content))
            self.stream.write(content)
            halved = _halved(block)
        if level + 1 < len(self.sizes):
            half = BLOCK // 2
            self._add((level + 1, row // 2, column // 2), row % 2 * half, column % 2 * half, halved)


def _halved(block: Pixels) -> Pixels:
    """Return the mean of the valid pixels of each 2 × 2."""
    floats = block.dtype.kind == "f"
    parts = np.stack([block[i::2, j::2] for i in (0, 1) for j in (0, 1)]).astype(np.float64)
    known = ~np.isnan(parts) if floats else parts > 0
    parts[~known] = 0.0
    number = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = parts.sum(axis=0) / number
    return mean.astype(block.dtype) if floats else np.where(number, np.rint(mean), 0).astype(block.dtype)


# --- what the file says ------------------------------------------------------------------------------


def _layout(image: Image, bands: int, reduced: bool) -> tuple[Tag, ...]:
    """Return the tags of an image whose bands have separate blocks, without the places of the blocks."""
    floats = image.dtype == "float32"
    colours = not floats and bands >= _COLOURS
    beside = bands - (_COLOURS if colours else 1)
    return (
        Tag(_NEW_SUBFILE, "I", [int(reduced)]),
        Tag(_WIDTH, "I", [image.width]),
        Tag(_HEIGHT, "I", [image.height]),
        Tag(_BITS, "H", [32 if floats else 8] * bands),
        Tag(_COMPRESSION, "H", [image.compression]),
        Tag(_PHOTOMETRIC, "H", [2 if colours else 1]),
        Tag(_SAMPLES, "H", [bands]),
        Tag(_PLANES, "H", [2]),
        Tag(_PREDICTOR, "H", [3 if floats else 2]),
        Tag(_BLOCK_WIDTH, "I", [image.edge]),
        Tag(_BLOCK_HEIGHT, "I", [image.edge]),
        *([Tag(_EXTRA_SAMPLES, "H", [0] * beside)] if beside else []),
        Tag(_SAMPLE_FORMAT, "H", [3 if floats else 1] * bands),
        Tag(_GDAL_NODATA, "s", [b"nan" if floats else b"0"]),
    )


def _description(about: About) -> list[Tag]:
    """Return tags for georeference, names, units and the other metadata."""
    place = about.transform
    items = [f'<Item name="{name}">{escape(value)}</Item>' for name, value in about.items]
    for number, band in enumerate(about.bands):
        for name, value in (("DESCRIPTION", band.description), ("UNITTYPE", band.unit)):
            items.append(f'<Item name="{name}" sample="{number}" role="{name.lower()}">{escape(value)}</Item>')
    text = "\n  ".join(["<GDALMetadata>", digest_item(), *items]) + "\n</GDALMetadata>\n"
    return [
        Tag(_SOFTWARE, "s", [SOFTWARE.encode()]),
        Tag(_DATE, "s", [f"{about.date:%Y:%m:%d} 00:00:00".encode()]),
        Tag(_PIXEL_SCALE, "d", [place.a, -place.e, 0.0]),
        Tag(_TIE_POINT, "d", [0.0, 0.0, 0.0, place.c, place.f, 0.0]),
        *_geo_keys(about.frame),
        Tag(_GDAL_METADATA, "s", [text.encode()]),
    ]


@functools.lru_cache(maxsize=16)
def _geo_keys(frame: MapFrame) -> tuple[Tag, ...]:
    """Return tags that state the CRS, as GDAL writes them into a file with that CRS."""
    from rasterio.io import MemoryFile
    from rasterio.transform import Affine

    profile = {"driver": "GTiff", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
    with raster_settings(), MemoryFile() as memory:
        with memory.open(**profile, crs=raster_crs(frame), transform=Affine(1, 0, 1, 0, -1, 1)):
            pass
        content = bytes(memory.getbuffer())
    start = struct.unpack_from("<I", content, 4)[0]
    kinds = {2: ("s", 1), 3: ("H", 2), 12: ("d", 8)}
    found: list[Tag] = []
    for number in range(struct.unpack_from("<H", content, start)[0]):
        at = start + 2 + 12 * number
        tag, kind, count = struct.unpack_from("<HHI", content, at)
        if tag not in _GEO_KEYS:
            continue
        code, size = kinds[kind]
        place = at + 8 if count * size <= 4 else struct.unpack_from("<I", content, at + 8)[0]
        values: Any = struct.unpack_from(f"<{count}{code}", content, place)
        found.append(Tag(tag, code, [values[0].removesuffix(b"\0")] if code == "s" else values))
    return tuple(found)


DIGEST_ITEM: Final = "ROADSCAN_FILE_BLAKE3"
"""Metadata item with the BLAKE3 digest (128 bits, hexadecimal) of the file with this digest's characters as 0."""

_NO_DIGEST: Final = b"0" * 32  # placeholder of the digest while it is computed
_DIGEST: Final = re.compile(rb'<Item name="' + DIGEST_ITEM.encode() + rb'">([0-9a-f]{32})</Item>')
_STRUCTURE: Final = b"""LAYOUT=IFDS_BEFORE_DATA
BLOCK_ORDER=ROW_MAJOR
BLOCK_LEADER=SIZE_AS_UINT4
BLOCK_TRAILER=LAST_4_BYTES_REPEATED
KNOWN_INCOMPATIBLE_EDITION=NO
 """
_GHOST: Final = b"GDAL_STRUCTURAL_METADATA_SIZE=%06d bytes\n" % len(_STRUCTURE) + _STRUCTURE
"""Mark by which GDAL recognises a cloud-optimised file (GDAL, COG driver: header ghost area)."""
_KINDS: Final = {"s": 2, "H": 3, "I": 4, "d": 12, "Q": 16}  # TIFF field types by `struct` code
_LEADER: Final = 4  # bytes before and after each block, as in GDAL's files
_CLASSIC_END: Final = 2**32 - 2**20  # larger files (bytes) are BigTIFF


@dataclass(frozen=True)
class Tag:
    """One entry of a directory: values of a `struct` kind, or text as bytes of kind ``s``."""

    number: int
    kind: str
    values: Sequence[Any]

    def packed(self) -> bytes:
        """Return the values as bytes of the file; text ends with a zero byte."""
        if self.kind == "s":
            return b"".join(self.values) + b"\0"
        return struct.pack(f"<{len(self.values)}{self.kind}", *self.values)

    @property
    def count(self) -> int:
        """Number of values of the entry."""
        return len(self.packed()) if self.kind == "s" else len(self.values)


@dataclass(frozen=True)
class Page:
    """An image or one of its overviews: its blocks, and its tags without the places of the blocks."""

    tags: tuple[Tag, ...]
    blocks: Sequence[Any]
    """Compressed blocks, None for empty ones; by band, then row by row."""


def tiff_parts(pages: Sequence[Page]) -> list[Any]:
    """Return the file's buffers: directories, then blocks. `pages`: the image, then overviews, largest first."""
    sizes = [[0 if b is None else len(b) for b in page.blocks] for page in pages]
    entries = sum(len(s) for s in sizes)
    big = sum(map(sum, sizes)) + 40 * entries > _CLASSIC_END
    word = "Q" if big else "I"
    starts, at = [], (16 if big else 8) + len(_GHOST)
    for page, size in zip(pages, sizes, strict=True):
        at += at % 2
        starts.append(at)
        at += len(_directory(_tags(page, size, size, word), 0, 0, big))
    places: list[list[int]] = [[] for _ in pages]
    for number in reversed(range(len(pages))):
        for length in sizes[number]:
            places[number].append(at + _LEADER if length else 0)
            at += length + 2 * _LEADER if length else 0
    head = struct.pack("<2sHHHQ", b"II", 43, 8, 0, starts[0]) if big else struct.pack("<2sHI", b"II", 42, starts[0])
    head += _GHOST
    for page, size, place, start, following in zip(pages, sizes, places, starts, [*starts[1:], 0], strict=True):
        head += b"\0" * (start - len(head))
        head += _directory(_tags(page, place, size, word), start, following, big)
    blocks = [
        part
        for page in reversed(pages)
        for block in page.blocks
        if block is not None
        for part in (struct.pack("<I", len(block)), block, bytes(memoryview(block)[-_LEADER:]))
    ]
    return [head.replace(_NO_DIGEST, _digest([head, *blocks]), 1), *blocks]


def digest_item() -> str:
    """Return the metadata item that `tiff_parts` fills in; the metadata of the first page must contain it once."""
    return f'<Item name="{DIGEST_ITEM}">{_NO_DIGEST.decode()}</Item>'


def check_cog(path: Path) -> None:
    """Raise :class:`StoreError` unless the file is to the bit what `tiff_parts` gave."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise StoreError(f"the GeoTIFF cannot be read: {error}", change="make it again", file=path) from error
    stated = _DIGEST.search(content)
    if stated is None or _GHOST not in content[:256]:
        raise StoreError(
            "the GeoTIFF states no digest of itself",
            expected="one: the file was made by an older version, or is damaged",
            change="make it again",
            file=path,
        )
    found = _digest([content[: stated.start(1)], _NO_DIGEST, memoryview(content)[stated.end(1) :]])
    if found != stated[1]:
        raise StoreError(
            f"the file's digest is {found.decode()}",
            expected=stated[1].decode(),
            change="the file is damaged: make it again",
            file=path,
        )


def _tags(page: Page, places: Sequence[int], sizes: Sequence[int], word: str) -> list[Tag]:
    return sorted([*page.tags, Tag(324, word, places), Tag(325, word, sizes)], key=lambda tag: tag.number)


def _directory(tags: Sequence[Tag], start: int, following: int, big: bool) -> bytes:
    """Return the directory for byte `start`, followed by the values that do not fit into its entries."""
    word, room = ("Q", 8) if big else ("I", 4)
    end = start + (8 if big else 2) + len(tags) * (4 + 2 * room) + room
    entries, values = struct.pack("<Q" if big else "<H", len(tags)), b""
    for tag in tags:
        packed = tag.packed()
        entries += struct.pack(f"<HH{word}", tag.number, _KINDS[tag.kind], tag.count)
        if len(packed) <= room:
            entries += packed.ljust(room, b"\0")
        else:
            entries += struct.pack(f"<{word}", end + len(values))
            values += packed + b"\0" * (len(packed) % 2)
    return entries + struct.pack(f"<{word}", following) + values


def _digest(parts: Iterable[Any]) -> bytes:
    digest = blake3()
    for part in parts:
        digest.update(part)
    return digest.hexdigest(length=16).encode()


_CACHE_BYTES: Final = 64 * 2**20  # block cache of GDAL


@functools.lru_cache(maxsize=16)
def raster_crs(frame: MapFrame) -> CRS:
    """Return the CRS of the map for rasterio, compound where a vertical CRS is named."""
    from rasterio.crs import CRS

    return CRS.from_wkt(frame.wkt())


@contextlib.contextmanager
def raster_settings() -> Iterator[None]:
    """Run GDAL with one file per raster, one thread, and a block cache of constant size."""
    import rasterio

    with rasterio.Env(GDAL_PAM_ENABLED="NO", GDAL_NUM_THREADS="1", GDAL_CACHEMAX=_CACHE_BYTES):
        yield


@contextlib.contextmanager
def without_place_warning() -> Iterator[None]:
    """Suppress rasterio's warning about files without georeference, such as pictures."""
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield
