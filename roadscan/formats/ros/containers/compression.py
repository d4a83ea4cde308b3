"""Unpacks the chunks, messages and files of bags, within the size that the bag states."""

from __future__ import annotations

import bz2
import shutil
from pathlib import Path
from typing import Final

from roadscan.core.extras import needed
from roadscan.formats.ros.containers.storage import MOST_CHUNK_BYTES

WHAT: Final = "a compressed bag"  # as the error of a missing package names it
ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a Zstandard frame (RFC 8878, 3.1.1)


def unpacked(data: bytes | memoryview, method: str, size: int | None = None) -> bytes | memoryview:
    """Unpacked bytes; `size` where the bag states their number.

    Raises
    ------
    ValueError
        where the bytes are damaged, or more than stated.
    """
    most = MOST_CHUNK_BYTES if size is None else size
    if most > MOST_CHUNK_BYTES:
        raise ValueError(f"it states {most:,} bytes unpacked")
    if method in {"", "none"}:
        content: bytes | memoryview = data
    elif method == "bz2":
        content = _bz2(data, most)
    elif method == "lz4":
        content = _lz4(data, most)
    elif method == "zstd":
        content = _zstd(data, most)
    else:
        raise ValueError(f"its compression '{method}' is not known")
    if size is not None and len(content) != size:
        raise ValueError(f"{len(content):,} bytes unpacked, {size:,} stated")
    return content


def unpack_file(packed: Path, to: Path) -> str:
    """Unpack a Zstandard file; return why it ended early ("" if it did not)."""
    zstandard = needed("zstandard", WHAT)
    with packed.open("rb") as source, to.open("wb") as sink:
        try:
            with zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True) as reader:
                shutil.copyfileobj(reader, sink, 1 << 20)
        except zstandard.ZstdError as error:
            return f"the compressed file is damaged: {error}"
    return ""


def _bz2(data: bytes | memoryview, most: int) -> bytes:
    try:
        return bz2.BZ2Decompressor().decompress(data, most + 1)
    except OSError as error:
        raise ValueError(str(error)) from error


def _lz4(data: bytes | memoryview, most: int) -> bytes:
    frame = needed("lz4.frame", WHAT)
    try:
        return bytes(frame.LZ4FrameDecompressor().decompress(data, most + 1))
    except RuntimeError as error:
        raise ValueError(str(error)) from error


def _zstd(data: bytes | memoryview, most: int) -> bytes:
    zstandard = needed("zstandard", WHAT)
    try:
        if zstandard.frame_content_size(data) > most:
            raise ValueError("more bytes unpacked than stated")
        return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=most))
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
