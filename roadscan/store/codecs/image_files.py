"""Checks size and completeness of JPEG, PNG and TIFF files without decoding them.

Decoders fill up what is missing, and allocate what a header claims; so the structure is checked first: what a file cut
short, or filled with zeros at its end, no longer has. Damage inside the compressed pixels stays unseen, as finding it
means decoding every image. Pillow reads TIFF's tags; it does not say whether JPEG and PNG are complete.

JPEG: ITU-T T.81, annex B. PNG: W3C PNG (third edition), sections 5 and 11. TIFF: TIFF 6.0, section 2, and BigTIFF.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from roadscan.store.codecs.zlib_stream import crc32

JPEG: Final = b"\xff\xd8\xff"
PNG: Final = b"\x89PNG\r\n\x1a\n"
TIFFS: Final = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff")

_TAIL_BYTES: Final = 1 << 16  # bytes at the end that are searched first for a marker
_BLOCK_BYTES: Final = 1 << 20  # bytes that are read at a time
_LARGEST_PX: Final = 1 << 24  # larger widths and heights are refused
_WITHOUT_LENGTH: Final = (0x01, *range(0xD0, 0xDA))
"""JPEG markers without a length: TEM, RST, SOI and EOI."""
_FILL, _SCAN, _END = 0xFF, 0xDA, 0xD9  # JPEG markers: prefix, start of scan, end of image
_HUFFMAN_FRAMES: Final = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive Huffman coding."""
_FRAMES: Final = tuple(m for m in range(0xC0, 0xD0) if m not in (0xC4, 0xC8, 0xCC))  # JPEG start-of-frame markers (SOF)
_MOST_SCANS: Final = 32
"""Most scans of a JPEG: an encoder writes some ten, and each costs a pass over the whole image."""


class ImageError(Exception):
    """The file is no complete image; the message says why."""


@dataclass(frozen=True)
class ImageSize:
    """Size of an image."""

    width_px: int
    height_px: int


def is_image(head: bytes) -> bool:
    """Return True if a file's first bytes are those of a JPEG, PNG or TIFF."""
    return head.startswith((JPEG, PNG, *TIFFS))


def image_size(path: Path) -> ImageSize:
    """Return the size of a complete JPEG, PNG or TIFF file.

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


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return rows and columns of a JPEG of 8 bits.

    Raises
    ------
    ImageError
        if it is no JPEG, its end is missing, or it is of a kind that cameras do not write.
    """
    if data[:2] != JPEG[:2]:
        raise ImageError("it is no JPEG")
    if not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ImageError("the end of the JPEG is missing")
    if data.count(b"\xff\xda") > _MOST_SCANS:
        raise ImageError(f"the JPEG has more than {_MOST_SCANS} scans")
    for marker, at, length in _segments(io.BytesIO(data)):
        if marker in _FRAMES:
            if marker not in _HUFFMAN_FRAMES:
                raise ImageError("the JPEG is lossless, hierarchical or arithmetically coded")
            if length < 6 or at + 6 > len(data):
                raise ImageError("the JPEG's frame header is cut off")
            bits, rows, columns, components = struct.unpack_from(">BHHB", data, at)
            if bits != 8 or components not in {1, 3}:
                raise ImageError(f"the JPEG has {components} components of {bits} bits (expected 1 or 3 of 8)")
            return int(rows), int(columns)
    raise ImageError("the JPEG has no frame header")


def png_size(data: bytes) -> tuple[int, int]:
    """Return rows and columns of a grey PNG of 8 bits, or raise :class:`ImageError`."""
    kind, content = _checked_chunks(data)[0]
    if kind != b"IHDR" or len(content) != 13:
        raise ImageError("the PNG does not begin with its header")
    columns, rows, bits, colour = struct.unpack_from(">IIBB", content)
    if bits != 8 or colour != 0:
        raise ImageError(f"the PNG has the colour type {colour} of {bits} bits (expected grey of 8)")
    return int(rows), int(columns)


def plain_png(data: bytes) -> bytes:
    """Return the PNG with only its header and pixels once its checksums are verified, or raise :class:`ImageError`."""
    kept = [(kind, content) for kind, content in _checked_chunks(data) if kind in {b"IHDR", b"IDAT", b"IEND"}]
    return PNG + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc32(kind + content))
        for kind, content in kept
    )


# --- JPEG --------------------------------------------------------------------------------------------


def _segments(stream: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Yield marker, place and content length of each segment up to that of the first scan."""
    at, marker = 2, 0
    while marker != _SCAN:
        stream.seek(at)
        head = stream.read(4)
        if len(head) < 4 or head[0] != _FILL:
            raise ImageError("the image is cut off or damaged before its pixels")
        marker = head[1]
        if marker == _FILL:
            at += 1
        elif marker in _WITHOUT_LENGTH:
            at += 2
            if marker == _END:
                raise ImageError("the image ends before its pixels")
        else:
            length = int.from_bytes(head[2:], "big")
            if length < 2:
                raise ImageError("the image is damaged before its pixels")
            yield marker, at + 4, length - 2
            at += 2 + length


def _jpeg(stream: BinaryIO, size: int) -> ImageSize:
    """Follow the segments to the pixels, after which the end-of-image marker has to come.

    The coded pixels hold no 0xFF that is not followed by 0x00 or a restart marker, so that the
    marker cannot come from them, nor from a preview image, which stands in a segment before them.
    """
    found: ImageSize | None = None
    pixels = 0
    for marker, at, length in _segments(stream):
        pixels = at + length
        if marker in _FRAMES:
            stream.seek(at)
            _, height, width = struct.unpack(">BHH", stream.read(5))
            found = ImageSize(width, height)
    if found is None:
        raise ImageError("the image states no size")
    if not _holds(stream, b"\xff\xd9", pixels, size):
        raise ImageError("the image is cut off: it has no end marker")
    return found


def _holds(stream: BinaryIO, marker: bytes, start: int, size: int) -> bool:
    """Return True if `marker` occurs after byte `start`; the end, where it belongs, is searched first."""
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


# --- PNG ---------------------------------------------------------------------------------------------


def _chunks(stream: BinaryIO, size: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, place and content length of each chunk, which have to be contiguous up to the last."""
    at, kind = len(PNG), b""
    while kind != b"IEND":
        stream.seek(at)
        head = stream.read(8)
        if len(head) < 8 or at + 12 > size:
            raise ImageError("the image is cut off: it has no end")
        length, kind = struct.unpack(">I4s", head)
        if not kind.isalpha():
            raise ImageError("the image is damaged: its chunks do not follow one another")
        if at + 12 + length > size:
            raise ImageError("the image is cut off: it has no end")
        yield kind, at + 8, length
        at += 12 + length


def _png(stream: BinaryIO, size: int) -> ImageSize:
    found, pixels = ImageSize(0, 0), False
    for number, (kind, at, length) in enumerate(_chunks(stream, size)):
        if number == 0:
            if kind != b"IHDR" or length != 13:
                raise ImageError("the image is damaged: it does not begin with its size")
            stream.seek(at)
            found = ImageSize(*struct.unpack(">II", stream.read(8)))
        pixels |= kind == b"IDAT"
    if not pixels:
        raise ImageError("the image holds no pixels")
    return found


def _checked_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return kind and content of each chunk after checking its checksum."""
    if data[:8] != PNG:
        raise ImageError("it is no PNG")
    found = []
    for kind, at, length in _chunks(io.BytesIO(data), len(data)):
        content = data[at : at + length]
        if crc32(kind + content) != int.from_bytes(data[at + length : at + length + 4]):
            raise ImageError("a chunk of the PNG is damaged")
        found.append((kind, content))
    return found


# --- TIFF --------------------------------------------------------------------------------------------


def _tiff(stream: BinaryIO, size: int) -> ImageSize:
    """Read the first directory; all strips or tiles of the image have to lie inside the file."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    stream.seek(0)
    head = stream.read(16)
    big = b"+" in head[2:4]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # unreadable tags are missing
        try:
            tags = ImageFileDirectory_v2(head if big else head[:8])
            stream.seek(tags.next)
            tags.load(stream)
            width, height = int(tags[256]), int(tags[257])
            places = next((tags[o], tags[c]) for o, c in ((273, 279), (324, 325)) if o in tags and c in tags)
        except (OSError, SyntaxError, ValueError, TypeError, LookupError, OverflowError, StopIteration) as error:
            raise ImageError("the image is cut off or damaged: its tags cannot be read") from error
    offsets, counts = ((one,) if isinstance(one, int) else one for one in places)
    if len(offsets) != len(counts) or any(at + count > size for at, count in zip(offsets, counts, strict=True)):
        raise ImageError("the image is cut off: its pixels lie behind the end of the file")
    if not sum(counts):
        raise ImageError("the image holds no pixels")
    return ImageSize(width, height)
