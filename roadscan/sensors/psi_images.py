"""What a JPEG or PNG claims and whether its pieces are whole, before a decoder sees it.

A decoder allocates what the image's own header claims, fills up what is missing, and spends time on every scan of a
progressive JPEG. So sizes, checksums and scans are looked at first (ITU-T T.81, annex B; ISO/IEC 15948, 5).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Final

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_MOST_SCANS: Final = 32
"""An encoder writes some ten scans; each costs a walk over the whole image."""
_FRAMES: Final = {0xC0, 0xC1, 0xC2}
"""Baseline, extended and progressive Huffman coding."""
_OTHER_FRAMES: Final = {0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)}
_WITHOUT_LENGTH: Final = {0x01, *range(0xD0, 0xD9)}


class ImageError(Exception):
    """An image is not what it should be."""


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Rows and columns of a JPEG of 8 bits.

    Raises
    ------
    ImageError
        if it is no JPEG, its end is missing, or it is of a kind that cameras do not write.
    """
    if data[:2] != b"\xff\xd8":
        raise ImageError("it is no JPEG")
    if not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ImageError("the end of the JPEG is missing")
    if data.count(b"\xff\xda") > _MOST_SCANS:
        raise ImageError(f"the JPEG has more than {_MOST_SCANS} scans")
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise ImageError("a marker of the JPEG is damaged")
        marker = data[at + 1]
        if marker in _OTHER_FRAMES:
            raise ImageError("the JPEG is lossless, hierarchical or arithmetically coded")
        if marker in _FRAMES:
            return _frame(data[at + 4 : at + 10])
        if marker == 0xDA:
            break
        if marker == 0xFF:
            at += 1
        elif marker in _WITHOUT_LENGTH:
            at += 2
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ImageError("the JPEG has no frame header")


def _frame(content: bytes) -> tuple[int, int]:
    if len(content) < 6:
        raise ImageError("the JPEG's frame header is cut off")
    bits, rows, columns, components = struct.unpack(">BHHB", content)
    if bits != 8 or components not in {1, 3}:
        raise ImageError(f"the JPEG has {components} components of {bits} bits (expected 1 or 3 of 8)")
    return int(rows), int(columns)


def png_size(data: bytes) -> tuple[int, int]:
    """Rows and columns of a grey PNG of 8 bits, or :class:`ImageError`."""
    for kind, content in _chunks(data):
        if kind != b"IHDR" or len(content) != 13:
            break
        columns, rows, bits, colour = struct.unpack_from(">IIBB", content)
        if bits != 8 or colour != 0:
            raise ImageError(f"the PNG has the colour type {colour} of {bits} bits (expected grey of 8)")
        return int(rows), int(columns)
    raise ImageError("the PNG does not begin with its header")


def plain_png(data: bytes) -> bytes:
    """The PNG with its header and pixels only, after all its checksums were right, or :class:`ImageError`."""
    kept = [(kind, content) for kind, content in _chunks(data) if kind in {b"IHDR", b"IDAT", b"IEND"}]
    return _PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in kept
    )


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk up to the last."""
    if data[:8] != _PNG_SIGNATURE:
        raise ImageError("it is no PNG")
    at = 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        if len(content) < size or zlib.crc32(kind + content) != int.from_bytes(data[at + 8 + size : at + 12 + size]):
            raise ImageError("a chunk of the PNG is damaged")
        yield kind, content
        if kind == b"IEND":
            return
        at += 12 + size
    raise ImageError("the end of the PNG is missing")
