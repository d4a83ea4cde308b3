"""Checks size and completeness of JPEG, PNG and TIFF files without decoding them, and writes grey PNG and BMP.

Decoders fill up what is missing, and allocate what a header claims; so the structure is checked first: what a file cut
short, or filled with zeros at its end, no longer has. Damage inside the compressed pixels stays unseen, as finding it
means decoding every image. Pillow reads TIFF's tags; it does not say whether JPEG and PNG are complete.

Grey PNG is put together here, because at cell resolution the time goes into compressing, and Pillow compresses with
zlib; Pillow writes BMP, and reads both back.

JPEG: ITU-T T.81, annex B. PNG: W3C PNG (third edition), sections 5 and 11. TIFF: TIFF 6.0, section 2, and BigTIFF.
"""

from __future__ import annotations

import io
import math
import struct
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import StoreError
from roadscan.store.codecs.zlib_stream import compressed, crc32

if TYPE_CHECKING:
    from rasterio.transform import Affine


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


_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
"""Diagonal of the 35 mm film that FocalLengthIn35mmFilm refers to (CIPA DCG-001)."""
_TURNED: Final = {3: "to be turned by 180°", 6: "to be turned by 90° clockwise", 8: "to be turned by 90° anticlockwise"}
"""How a picture becomes upright, by Orientation; 1 is upright, the others are mirrored."""
_UPRIGHT: Final = 1  # Orientation of an upright picture


def picture_tags(path: Path) -> dict[str, Any]:
    """Return what the tags of a picture state, JSON values by name; nothing of a damaged picture.

    taken (with its offset from UTC where stated), camera, focal_mm, focal_35mm_mm, focal_px (from the latter and the
    picture's diagonal), size_px, orientation (where not upright), latitude_deg, longitude_deg, altitude_m.
    """
    from PIL import ExifTags, Image

    try:
        with Image.open(path) as image:
            tags = image.getexif()
            shot, place = tags.get_ifd(ExifTags.IFD.Exif), tags.get_ifd(ExifTags.IFD.GPSInfo)
            base = ExifTags.Base
            taken = _text(shot.get(base.DateTimeOriginal)) or _text(tags.get(base.DateTime))
            film_mm = _number(shot.get(base.FocalLengthIn35mmFilm))
            orientation = _number(tags.get(base.Orientation)) or _UPRIGHT
            found = {
                "taken": " ".join(filter(None, (taken, _text(shot.get(base.OffsetTimeOriginal))))),
                "camera": " ".join(filter(None, (_text(tags.get(base.Make)), _text(tags.get(base.Model))))),
                "focal_mm": _number(shot.get(base.FocalLength)),
                "focal_35mm_mm": film_mm,
                "focal_px": None if not film_mm else round(film_mm / _FILM_DIAGONAL_MM * math.hypot(*image.size), 1),
                "size_px": list(image.size),
                "orientation": "" if orientation == _UPRIGHT else _TURNED.get(int(orientation), "mirrored"),
                "latitude_deg": _degrees(place, ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S"),
                "longitude_deg": _degrees(place, ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W"),
                "altitude_m": _number(place.get(ExifTags.GPS.GPSAltitude)),
            }
    except Exception:  # noqa: BLE001 — Pillow raises anything on damaged bytes
        return {}
    stated = {name: value for name, value in found.items() if value not in (None, "")}
    return stated if stated.keys() - {"size_px"} else {}


def tags_in_words(tags: Mapping[str, Any]) -> str:
    """Return what :func:`picture_tags` found as a list of words; "" for nothing."""
    parts = [
        ("taken", "taken {taken} on the camera's own clock"),
        ("camera", "{camera}"),
        ("focal_mm", "focal length {focal_mm:g} mm"),
        ("focal_px", "{focal_px:g} pixels by its equivalent of {focal_35mm_mm:g} mm film"),
        ("orientation", "{orientation}"),
        ("latitude_deg", "at {latitude_deg:.6f}°, {longitude_deg:.6f}°"),
        ("altitude_m", "{altitude_m:g} m high"),
    ]
    known = [words for name, words in parts if name in tags and (name != "latitude_deg" or "longitude_deg" in tags)]
    return ", ".join(words.format(**tags) for words in known)


def _text(value: Any) -> str:
    return str(value).strip(" \0") if isinstance(value, str) else ""


def _number(value: Any) -> float | None:
    """Return a finite number, None for anything else: a denominator may be 0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _degrees(place: Mapping[int, Any], tag: int, reference: int, negative: str) -> float | None:
    """Return an angle of three rational numbers (degrees, minutes, seconds), None where it is none."""
    values = place.get(tag)
    parts = [_number(value) for value in values] if isinstance(values, tuple) and len(values) == 3 else [None]
    if any(part is None for part in parts):
        return None
    degrees, minutes, seconds = (part or 0.0 for part in parts)
    angle = degrees + minutes / 60 + seconds / 3600
    return -angle if _text(place.get(reference)) == negative else angle


_START: Final = b"\xff\xd8"
_APP1: Final = b"\xff\xe1"
_COMMENT: Final = b"\xff\xfe"
_EXIF: Final = b"Exif\0\0"
_XMP: Final = b"http://ns.adobe.com/xap/1.0/\0"
_LARGEST: Final = 0xFFFF - 2  # Bytes that a segment can hold.


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
        if jpeg[at] != _FILL:
            raise ValueError(f"no segment begins at byte {at}")
        marker = jpeg[at + 1]
        if marker == _SCAN:
            break
        if marker == _FILL:
            at += 1
            continue
        if marker in _WITHOUT_LENGTH and marker != _END:
            kept += jpeg[at : at + 2]
            at += 2
            continue
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        segment = jpeg[at : at + 2 + length]
        if not (marker == 0xE1 and segment[4:].startswith((_EXIF, _XMP))):
            kept += segment
        at += 2 + length
    return bytes(kept) + jpeg[at:]


Grey = npt.NDArray[np.uint8]

_NO_FILTER, _UP = 0, 2  # PNG filter types
_M_PER_INCH: Final = 0.0254  # metres per inch


def write_png(path: Path, grey: Grey, pixel_m: float, texts: Mapping[str, str], *, smooth: bool) -> None:
    """Write (rows, columns) grey, north up, in which 0 is transparent, as PNG.

    Parameters
    ----------
    pixel_m : edge of a pixel (m), stated as pixels a metre.
    texts : metadata, keyword → text (Latin 1).
    smooth : True where lines resemble the line above them; they are then stored as differences.
    """
    rows, columns = grey.shape
    lines = np.empty((rows, columns + 1), np.uint8)
    lines[:, 0] = _UP if smooth else _NO_FILTER
    lines[:, 1:] = grey
    if smooth:
        np.subtract(grey[1:], grey[:-1], out=lines[1:, 1:])
    per_metre = round(1.0 / pixel_m)
    with path.open("wb") as stream:
        stream.write(PNG)
        stream.write(_chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)))
        stream.write(_chunk(b"tRNS", struct.pack(">H", 0)))
        stream.write(_chunk(b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1)))
        for keyword, text in sorted(texts.items()):
            stream.write(_chunk(b"tEXt", f"{keyword}\0{text}".encode("latin-1", "replace")))
        stream.write(_chunk(b"IDAT", compressed(lines)))
        stream.write(_chunk(b"IEND", b""))


def write_bmp(path: Path, grey: Grey, pixel_m: float) -> None:
    """Write (rows, columns) grey, north up, as an uncompressed bitmap with a palette of greys."""
    from PIL import Image

    per_inch = _M_PER_INCH / pixel_m
    Image.fromarray(grey).save(path, format="BMP", dpi=(per_inch, per_inch))


def world_file(transform: Affine) -> str:
    """Return the six lines of a world file: pixel size, rotations, and the centre of the north-west pixel."""
    x, y = transform.c + (transform.a + transform.b) / 2, transform.f + (transform.d + transform.e) / 2
    return "".join(f"{v!r}\n" for v in (transform.a, transform.d, transform.b, transform.e, x, y))


def check_picture(path: Path, bands: str = "L") -> None:
    """Decode a PNG or BMP; raise :class:`StoreError` where it is incomplete.

    Parameters
    ----------
    bands : L for grey, LA for grey and opacity.
    """
    from PIL import Image

    try:
        content = path.read_bytes()
        if content.startswith(PNG):
            _check_chunks(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=("PNG", "BMP")) as picture:
                picture.load()
                found = picture.mode
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError) as error:
        raise StoreError(f"the picture is damaged: {error}", change="make it again", file=path) from error
    if found != bands:
        raise StoreError(f"the picture is of the kind {found}", expected=bands, change="make it again", file=path)


def check_world_file(path: Path) -> None:
    """Raise :class:`StoreError` unless the file has six numbers and a positive pixel size."""
    try:
        numbers = [float(line) for line in path.read_text("ascii").splitlines()]
    except ValueError as error:
        raise StoreError("the world file holds something else than numbers", file=path) from error
    if len(numbers) != 6 or not np.isfinite(numbers).all() or numbers[0] <= 0 or numbers[3] >= 0:
        raise StoreError("the world file does not place a picture", change="make it again", file=path)


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", crc32(name + body))


def _check_chunks(content: bytes) -> None:
    """Check every chunk of a PNG against its checksum, because Pillow skips some of them."""
    at = len(PNG)
    while at < len(content):
        (length,) = struct.unpack_from(">I", content, at)
        if struct.unpack_from(">I", content, at + 8 + length) != (crc32(content[at + 4 : at + 8 + length]),):
            raise ValueError(f"the checksum of the part at byte {at:,} is wrong")
        at += 12 + length
