"""Points behind the head of a LAZ file: chunks, and the table of their sizes."""

from __future__ import annotations

import threading
from typing import Any, BinaryIO, Final

import lazrs
import numpy as np
import numpy.typing as npt

from roadscan.kernels.laz_model import MODELS, pack_chunk, room

_KEPT = threading.local()
_MODEL_FORMAT: Final = 6


def write_compressed(stream: BinaryIO, laz: Any, records: npt.NDArray[np.void], point_format: int) -> None:
    """Write point records (n,), 1 or more, as ``lazrs`` does, to the byte.

    Points of a model, which have places, heights and little else of their own, go through a kernel that takes a third
    of the time.
    """
    points = records.view(np.uint8).reshape(len(records), -1)
    chunks = _chunks(points, laz.chunk_size()) if point_format == _MODEL_FORMAT else None
    if chunks is None:
        compressor = lazrs.LasZipCompressor(stream, laz)
        compressor.compress_many(points.reshape(-1))
        compressor.done()
        return
    start = stream.tell()
    table_at = start + 8 + sum(map(len, chunks))
    stream.write(table_at.to_bytes(8, "little"))
    stream.writelines(chunks)
    step = laz.chunk_size()
    lazrs.write_chunk_table(
        stream, [(min(step, len(points) - k * step), len(chunk)) for k, chunk in enumerate(chunks)], laz
    )


def _chunks(points: npt.NDArray[np.uint8], most: int) -> list[bytes] | None:
    """Chunks of up to `most` points (n, bytes); None if they are no model's."""
    chunks = []
    for first in range(0, len(points), most):
        own = points[first : first + most]
        models, seen, widths, out = _scratch(*own.shape)
        size = pack_chunk(own, MODELS, models, seen, widths, out)
        if not size:
            return None
        chunks.append(out[:size].tobytes())
    return chunks


def _scratch(points: int, size: int) -> tuple[npt.NDArray[Any], ...]:
    """The thread's own: fresh memory is dear."""
    kept: tuple[npt.NDArray[Any], ...] | None = getattr(_KEPT, "scratch", None)
    needed = room(points, size)
    if kept is None or len(kept[3]) < needed or len(kept[2]) < points:
        out = np.empty(needed, np.uint8)
        kept = np.empty_like(MODELS), np.empty((2, 6), np.int64), np.empty(points, np.uint8), out
        _KEPT.scratch = kept
    return kept
