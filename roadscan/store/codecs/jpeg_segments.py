"""Puts EXIF and XMP into JPEG files without touching the picture (JEITA CP-3451 section 4.7; XMP part 3, 1.1.3)."""

from __future__ import annotations

from typing import Final

_START: Final = b"\xff\xd8"
_APP1: Final = b"\xff\xe1"
_COMMENT: Final = b"\xff\xfe"
_EXIF: Final = b"Exif\0\0"
_XMP: Final = b"http://ns.adobe.com/xap/1.0/\0"
_LARGEST: Final = 0xFFFF - 2  # Bytes that a segment can hold.
_WITHOUT_LENGTH: Final = (0x01, *range(0xD0, 0xD9))  # Markers that no length follows.
_SCAN: Final = 0xDA  # The marker after which the picture's data follow.


def with_tags(jpeg: bytes, exif: bytes, xmp: bytes) -> bytes:
    """Return a JPEG with these tags in place of its own; all other bytes are as they were.

    Parameters
    ----------
    exif : TIFF structure, with or without the leading ``Exif``; xmp : the packet.

    Raises
    ------
    ValueError
        where it is no JPEG, or a segment would be too long.
    """
    if not jpeg.startswith(_START):
        raise ValueError("it does not begin as a JPEG")
    content = exif if exif.startswith(_EXIF) else _EXIF + exif
    return _START + _segment(content) + _segment(_XMP + xmp) + _without_tags(jpeg)


def without_tags(jpeg: bytes) -> bytes:
    """Return a JPEG without EXIF and XMP; raises ValueError where it is none."""
    if not jpeg.startswith(_START):
        raise ValueError("it does not begin as a JPEG")
    return _START + _without_tags(jpeg)


def with_comment(jpeg: bytes, text: str) -> bytes:
    """Return a JPEG with a comment (COM) after its start; raises ValueError where it is none."""
    if not jpeg.startswith(_START):
        raise ValueError("it does not begin as a JPEG")
    content = text.encode()
    return _START + _COMMENT + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]


def comment_of(jpeg: bytes) -> str:
    """Return the comment that :func:`with_comment` put there; raises ValueError where there is none."""
    if not jpeg.startswith(_START + _COMMENT):
        raise ValueError("it has no comment after its start")
    return jpeg[6 : 4 + int.from_bytes(jpeg[4:6], "big")].decode()


def _segment(content: bytes) -> bytes:
    if len(content) > _LARGEST:
        raise ValueError(f"a segment of {len(content)} bytes, more than {_LARGEST}")
    return _APP1 + (len(content) + 2).to_bytes(2, "big") + content


def _without_tags(jpeg: bytes) -> bytes:
    """Return what follows the start of a JPEG without its segments of EXIF and XMP."""
    kept, at = bytearray(), 2
    while at + 4 <= len(jpeg):
        if jpeg[at] != 0xFF:
            raise ValueError(f"no segment begins at byte {at}")
        marker = jpeg[at + 1]
        if marker == _SCAN:
            break
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker in _WITHOUT_LENGTH:
            kept += jpeg[at : at + 2]
            at += 2
            continue
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        segment = jpeg[at : at + 2 + length]
        if not (marker == 0xE1 and segment[4:].startswith((_EXIF, _XMP))):
            kept += segment
        at += 2 + length
    return bytes(kept) + jpeg[at:]
