"""Compresses zlib streams (RFC 1950, 1951) and computes CRC-32; zlib is their test reference and fallback.

CRC-32 is ISA-L's. Its compressor is nearly as fast as the kernel here, but two runs of one survey got different bytes
from it (isal 1.9.1). The kernel finds runs and no other repetitions: measured rasters have none.
"""

from __future__ import annotations

import os
import threading
import zlib
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from roadscan.store.codecs.kernels.deflate import PAIRS, SEGMENT, deflate, room_words

_VARIABLE: Final = "ROADSCAN_CODECS"
_CHOICES: Final = ("own", "library")


def _chosen() -> str:
    stated = os.environ.get(_VARIABLE, "") or "own"
    if stated not in _CHOICES:
        raise SystemExit(f"{_VARIABLE} is '{stated}'; it is one of: {', '.join(_CHOICES)}")
    return stated


LIBRARY: Final = _chosen() == "library"
"""True if the environment has ``ROADSCAN_CODECS=library``: slower, with other bytes but the same content."""


_LEVEL = 1  # zlib's fastest level
_KEPT = threading.local()


def crc32(data: Any, before: int = 0) -> int:
    """Return the CRC-32 of a contiguous buffer that follows bytes whose CRC-32 is `before`."""
    return zlib.crc32(data, before) if LIBRARY else isal_zlib.crc32(data, before)


def compressed(data: npt.NDArray[np.uint8]) -> bytes:
    """Return contiguous bytes as a zlib stream, favouring speed."""
    if LIBRARY:
        return zlib.compress(data.data, _LEVEL)
    flat = data.reshape(-1)
    whole = flat.size // SEGMENT
    segments, pairs, out = _scratch(whole, room_words(flat.size))
    return deflate(flat, flat[: SEGMENT * whole].view(np.uint64), segments, pairs, out)


def _scratch(segments: int, words: int) -> tuple[npt.NDArray[Any], ...]:
    """Return scratch arrays of the thread, because allocating fresh memory is slow."""
    kept: tuple[npt.NDArray[Any], ...] | None = getattr(_KEPT, "scratch", None)
    if kept is None or kept[0].size < segments or kept[2].size < words:
        kept = np.empty(segments, np.int32), np.empty(PAIRS, np.uint32), np.empty(words, np.uint64)
        _KEPT.scratch = kept
    return kept
