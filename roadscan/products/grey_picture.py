"""Grey pictures of 8 bits as files: PNG (W3C, *Portable Network Graphics*) and BMP, and the world file beside them.

They are written here and not by a library because at cell resolution the time goes into compressing: run lengths and
Huffman codes alone take a tenth of the time of searching for repetitions, and the files are smaller.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from rasterio.transform import Affine

from roadscan.model.errors import StoreError
from roadscan.products.packer import Packer

Grey = npt.NDArray[np.uint8]

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_BMP_HEAD: Final = struct.Struct("<2sIHHI" + "IiiHHIIiiII")
_BMP_COLOURS: Final = np.repeat(np.arange(256, dtype="<u4"), 1) * 0x010101
_NO_FILTER, _UP = 0, 2


def write_png(path: Path, grey: Grey, pixel_m: float, texts: Mapping[str, str], *, smooth: bool) -> None:
    """Write (rows, columns) grey, north up, in which 0 is transparent.

    Parameters
    ----------
    pixel_m : edge of a pixel (m), stated as pixels a metre.
    texts : what the file says of itself, keyword → text (Latin 1).
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
        stream.write(_chunk(b"IDAT", Packer().pack(lines.ravel())))
        stream.write(_chunk(b"IEND", b""))


def write_bmp(path: Path, grey: Grey, pixel_m: float) -> None:
    """Write (rows, columns) grey, north up, as an uncompressed bitmap with a palette of greys."""
    rows, columns = grey.shape
    stride = -(-columns // 4) * 4
    start = _BMP_HEAD.size + 4 * 256
    lines = np.zeros((rows, stride), np.uint8)
    lines[:, :columns] = grey[::-1]
    per_metre = round(1.0 / pixel_m)
    head = _BMP_HEAD.pack(
        b"BM", start + lines.size, 0, 0, start, 40, columns, rows, 1, 8, 0, lines.size, per_metre, per_metre, 256, 0
    )
    with path.open("wb") as stream:
        stream.write(head)
        stream.write(_BMP_COLOURS.tobytes())
        stream.write(lines.data)


def world_file(transform: Affine) -> str:
    """Six lines that place a picture: pixel size, rotations, and the centre of the north-west pixel."""
    x, y = transform.c + (transform.a + transform.b) / 2, transform.f + (transform.d + transform.e) / 2
    return "".join(f"{v!r}\n" for v in (transform.a, transform.d, transform.b, transform.e, x, y))


def check_picture(path: Path) -> None:
    """Read a PNG or BMP to its end; raise :class:`StoreError` where it is not whole."""
    content = path.read_bytes()
    if content.startswith(_PNG_SIGNATURE):
        _check_png(content, path)
    elif content.startswith(b"BM"):
        _check_bmp(content, path)
    else:
        raise StoreError("the picture is neither PNG nor BMP", change="make it again", file=path)


def check_world_file(path: Path) -> None:
    """Raise :class:`StoreError` unless the file holds six numbers and a pixel of some size."""
    try:
        numbers = [float(line) for line in path.read_text("ascii").splitlines()]
    except ValueError as error:
        raise StoreError("the world file holds something else than numbers", file=path) from error
    if len(numbers) != 6 or not np.isfinite(numbers).all() or numbers[0] <= 0 or numbers[3] >= 0:
        raise StoreError("the world file does not place a picture", change="make it again", file=path)


def _chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def _check_png(content: bytes, path: Path) -> None:
    at, parts = len(_PNG_SIGNATURE), {}
    try:
        while at < len(content):
            (length,) = struct.unpack_from(">I", content, at)
            body = content[at + 4 : at + 8 + length]
            if struct.unpack_from(">I", content, at + 8 + length) != (zlib.crc32(body),):
                raise StoreError("a part of the picture is damaged", change="make it again", file=path, record=at)
            parts[body[:4]] = body[4:]
            at += 12 + length
        columns, rows, bits, colours = struct.unpack_from(">IIBB", parts[b"IHDR"])
        pixels = zlib.decompress(parts[b"IDAT"])
    except (struct.error, KeyError, zlib.error) as error:
        raise StoreError("the picture is cut short", change="make it again", file=path, record=at) from error
    if b"IEND" not in parts or (bits, colours) != (8, 0) or len(pixels) != rows * (1 + columns):
        raise StoreError("the picture is not whole", expected="8 bits of grey", file=path)


def _check_bmp(content: bytes, path: Path) -> None:
    if len(content) < _BMP_HEAD.size:
        raise StoreError("the picture is cut short", change="make it again", file=path)
    _, size, _, _, start, head, columns, rows, planes, bits, packed, *_ = _BMP_HEAD.unpack_from(content)
    stride = -(-columns // 4) * 4
    if (head, planes, bits, packed) != (40, 1, 8, 0) or size != len(content) or size != start + rows * stride:
        raise StoreError("the picture is not whole", expected="an 8-bit bitmap of its stated size", file=path)
