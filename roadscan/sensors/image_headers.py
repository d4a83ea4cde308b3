"""Size and completeness of JPEG, PNG and TIFF files, told without decoding them.

Only structure is read: what a file cut short, or filled with zeros at its end, no longer has. Damage
inside the compressed pixels stays unseen, as finding it means decoding every image.

JPEG: ITU-T T.81, annex B. PNG: W3C PNG (third edition), sections 5 and 11. TIFF: TIFF 6.0, section 2, and
BigTIFF.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

JPEG: Final = b"\xff\xd8\xff"
PNG: Final = b"\x89PNG\r\n\x1a\n"
TIFFS: Final = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff")

_TAIL_BYTES: Final = 1 << 16
_BLOCK_BYTES: Final = 1 << 20
_LARGEST_PX: Final = 1 << 24
_SOI_EOI_RST_TEM: Final = (0x01, *range(0xD0, 0xDA))
"""JPEG markers without a length."""
_FRAMES: Final = tuple(m for m in range(0xC0, 0xD0) if m not in (0xC4, 0xC8, 0xCC))
"""JPEG markers of a frame header (SOF)."""


class ImageError(Exception):
    """The file is no complete image; says why."""


@dataclass(frozen=True)
class ImageSize:
    """Size of an image."""

    width_px: int
    height_px: int


def is_image(head: bytes) -> bool:
    """True if a file's first bytes are those of a JPEG, PNG or TIFF."""
    return head.startswith((JPEG, PNG, *TIFFS))


def image_size(path: Path) -> ImageSize:
    """Size of a complete JPEG, PNG or TIFF file.

    Raises
    ------
    ImageError
        if the file cannot be read, is of no such format, or is not complete.
    """
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            head = stream.read(8)
            stream.seek(0)
            if size == 0:
                raise ImageError("the file is empty")
            if head.startswith(JPEG):
                found = _jpeg(stream, size)
            elif head == PNG:
                found = _png(stream, size)
            elif head.startswith(TIFFS):
                found = _tiff(stream, size)
            else:
                raise ImageError("the file is no JPEG, PNG or TIFF")
    except (OSError, struct.error) as error:
        raise ImageError("the image is cut off or damaged") from error
    if not (0 < found.width_px <= _LARGEST_PX and 0 < found.height_px <= _LARGEST_PX):
        raise ImageError(f"the image states an impossible size of {found.width_px} × {found.height_px} px")
    return found


def _jpeg(stream: BinaryIO, size: int) -> ImageSize:
    """Follow the segments to the pixels; after them the end-of-image marker has to come.

    The coded pixels hold no 0xFF that is not followed by 0x00 or a restart marker, so that the
    marker cannot come from them, nor from a preview image, which stands in a segment before them.
    """
    found: ImageSize | None = None
    at = 2
    while True:
        stream.seek(at)
        head = stream.read(4)
        if len(head) < 4 or head[0] != 0xFF:
            raise ImageError("the image is cut off or damaged before its pixels")
        marker = head[1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker in _SOI_EOI_RST_TEM:
            at += 2
            if marker == 0xD9:
                raise ImageError("the image ends before its pixels")
            continue
        length = int.from_bytes(head[2:], "big")
        if length < 2:
            raise ImageError("the image is damaged before its pixels")
        if marker in _FRAMES:
            _, height, width = struct.unpack(">BHH", stream.read(5))
            found = ImageSize(width, height)
        at += 2 + length
        if marker == 0xDA:
            break
    if found is None:
        raise ImageError("the image states no size")
    if not _holds(stream, b"\xff\xd9", at, size):
        raise ImageError("the image is cut off: it has no end marker")
    return found


def _holds(stream: BinaryIO, marker: bytes, start: int, size: int) -> bool:
    """True if `marker` stands behind byte `start`: looked for at the end first, where it belongs."""
    tail = max(start, size - _TAIL_BYTES)
    stream.seek(tail)
    if marker in stream.read(_TAIL_BYTES):
        return True
    stream.seek(start)
    carry = b""
    while (left := tail + len(marker) - stream.tell()) > 0:
        block = stream.read(min(left, _BLOCK_BYTES))
        if not block:
            return False
        if marker in carry + block:
            return True
        carry = block[-(len(marker) - 1) :]
    return False


def _png(stream: BinaryIO, size: int) -> ImageSize:
    """Follow the chunks, which have to fill the file up to the one that ends the image."""
    stream.seek(8)
    length, kind = struct.unpack(">I4s", stream.read(8))
    if kind != b"IHDR" or length != 13:
        raise ImageError("the image is damaged: it does not begin with its size")
    width, height = struct.unpack(">II", stream.read(8))
    at, pixels = 33, False
    while at + 12 <= size:
        stream.seek(at)
        length, kind = struct.unpack(">I4s", stream.read(8))
        at += 12 + length
        pixels = pixels or kind == b"IDAT"
        if kind == b"IEND" and pixels and at <= size:
            return ImageSize(width, height)
        if not kind.isalpha():
            raise ImageError("the image is damaged: its chunks do not follow one another")
    raise ImageError("the image is cut off: it has no end")


def _tiff(stream: BinaryIO, size: int) -> ImageSize:
    """Read the first directory; all strips or tiles of the image have to lie inside the file."""
    head = stream.read(16)
    order = "<" if head[:1] == b"I" else ">"
    big = head[2:4] in {b"+\x00", b"\x00+"}
    at = struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)[0]
    tags = _TiffTags(stream, size, order, big)
    tags.load(at)
    width, height = (int(tags.numbers(tag)[0]) for tag in (256, 257))
    for offsets_tag, counts_tag in ((273, 279), (324, 325)):
        if offsets_tag in tags.entries:
            offsets, counts = tags.numbers(offsets_tag), tags.numbers(counts_tag)
            if offsets.size != counts.size or not (counts <= size).all() or not (offsets <= size - counts).all():
                raise ImageError("the image is cut off: its pixels lie behind the end of the file")
            if not counts.sum():
                raise ImageError("the image holds no pixels")
            return ImageSize(width, height)
    raise ImageError("the image holds no pixels")


class _TiffTags:
    """Entries of a TIFF directory."""

    _TYPES: Final = {1: "u1", 3: "u2", 4: "u4", 16: "u8"}

    def __init__(self, stream: BinaryIO, size: int, order: str, big: bool) -> None:
        self._stream = stream
        self._size = size
        self._order = order
        self._big = big
        self.entries: dict[int, tuple[int, int, bytes]] = {}
        """Type, count, and value or offset by tag."""

    def load(self, at: int) -> None:
        """Read the directory at byte `at`."""
        count_form, entry_form, entry_bytes = ("Q", "HHQ8s", 20) if self._big else ("H", "HHI4s", 12)
        if at >= self._size:
            raise ImageError("the image is cut off: its directory lies behind the end of the file")
        self._stream.seek(at)
        width = struct.calcsize(self._order + count_form)
        count = struct.unpack(self._order + count_form, self._stream.read(width))[0]
        if count > (self._size - at) // entry_bytes:
            raise ImageError("the image is cut off or damaged: its directory does not fit into the file")
        raw = self._stream.read(count * entry_bytes)
        for tag, kind, values, data in struct.iter_unpack(self._order + entry_form, raw):
            self.entries[tag] = (kind, values, data)

    def numbers(self, tag: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
        """Values (n,) of a tag."""
        if tag not in self.entries:
            raise ImageError(f"the image is damaged: tag {tag} is missing")
        kind, count, data = self.entries[tag]
        if kind not in self._TYPES or count == 0:
            raise ImageError(f"the image is damaged: tag {tag} holds no whole numbers")
        dtype = np.dtype(self._order + self._TYPES[kind])
        length = count * dtype.itemsize
        if length > len(data):
            at = int.from_bytes(data, "little" if self._order == "<" else "big")
            if at > self._size or length > self._size - at:
                raise ImageError(f"the image is cut off or damaged: tag {tag} lies behind the end of the file")
            self._stream.seek(at)
            data = self._stream.read(length)
        return np.frombuffer(data[:length], dtype).astype(np.uint64)
