"""Finds by an AVI's index which frames are still at their places.

An AVI stores no times: frame k is the k-th in the file. Where one is damaged, a reader continues with the next, and all
later frames seem a frame too early; only the index tells which one is gone (Microsoft, *AVI RIFF File
Reference*: ``idx1`` holds identifier, flags, offset and length of each chunk).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from roadscan.compute.array_types import Bool

_ENTRY: Final = np.dtype([("id", "S4"), ("flags", "<u4"), ("offset", "<u4"), ("length", "<u4")])
_CHUNK: Final = struct.Struct("<4sI")
_VIDEO: Final = (b"dc", b"db")


def frames_in_place(path: Path) -> Bool | None:
    """Return whether each frame (n,) of an AVI stands where its index says; None without a usable index."""
    with path.open("rb") as stream:
        head = stream.read(12)
        if head[:4] != b"RIFF" or head[8:] != b"AVI ":
            return None
        size = stream.seek(0, 2)
        found = _movi_and_index(stream, size)
        if found is None:
            return None
        movi, index, length = found
        stream.seek(index)
        entries = np.frombuffer(stream.read(min(length, size - index) // _ENTRY.itemsize * _ENTRY.itemsize), _ENTRY)
        entries = entries[[bytes(one)[2:4] in _VIDEO for one in entries["id"]]]
        if not entries.size:
            return None
        for base in (movi, 0):  # offsets count from the list of frames or, in some files, from the file's start
            if _stands(stream, base, entries[0]) or _stands(stream, base, entries[-1]):
                return np.array([_stands(stream, base, entry) for entry in entries], dtype=bool)
    return None


def _movi_and_index(stream: BinaryIO, size: int) -> tuple[int, int, int] | None:
    """Return the byte of the list of frames ('movi'), and the byte and length of the index after it."""
    movi = None
    at = 12
    while at + 12 <= size:
        stream.seek(at)
        name, length = _CHUNK.unpack(stream.read(8))
        if name == b"LIST" and stream.read(4) == b"movi":
            movi = at + 8
        if name == b"idx1" and movi is not None:
            return movi, at + 8, length
        at += 8 + length + length % 2
    return None


def _stands(stream: BinaryIO, base: int, entry: np.void) -> bool:
    """Return True if the chunk of an index entry is at its place."""
    stream.seek(base + int(entry["offset"]))
    return stream.read(8) == _CHUNK.pack(bytes(entry["id"]), int(entry["length"]))
