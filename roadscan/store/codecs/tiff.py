"""Writes cloud-optimised TIFFs from compressed blocks (TIFF 6.0; BigTIFF where 4 GB are not enough).

First come all directories, then the blocks: those of the smallest overview first, those of the image last. Each has
its size before it and its last four bytes again behind it, as GDAL's cloud-optimised files do. A block that holds
nothing is left out (offset and size 0), as GDAL reads sparse files.
"""

from __future__ import annotations

import contextlib
import functools
import re
import struct
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from blake3 import blake3

from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError

if TYPE_CHECKING:
    from rasterio.crs import CRS


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
