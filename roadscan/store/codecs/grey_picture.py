"""Writes 8-bit grey pictures as PNG (W3C, *Portable Network Graphics*) and BMP, and their world files.

PNG is put together here, because at cell resolution the time goes into compressing, and Pillow compresses with zlib;
Pillow writes BMP, and reads both back.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import StoreError
from roadscan.store.codecs.zlib_stream import compressed, crc32

if TYPE_CHECKING:
    from rasterio.transform import Affine

Grey = npt.NDArray[np.uint8]

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
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
        stream.write(_PNG_SIGNATURE)
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
        if content.startswith(_PNG_SIGNATURE):
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
    at = len(_PNG_SIGNATURE)
    while at < len(content):
        (length,) = struct.unpack_from(">I", content, at)
        if struct.unpack_from(">I", content, at + 8 + length) != (crc32(content[at + 4 : at + 8 + length]),):
            raise ValueError(f"the checksum of the part at byte {at:,} is wrong")
        at += 12 + length
