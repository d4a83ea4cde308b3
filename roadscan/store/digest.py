"""Digests of files and of their bytes."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

from blake3 import blake3

_CHUNK: Final = 1 << 18  # fits into a core's cache between reading and hashing (bytes)
_ALGORITHM: Final = "blake3:"


def file_digest(path: Path) -> str:
    """Return the BLAKE3-128 of a file's bytes: ``blake3:`` and 32 hexadecimal digits."""
    with path.open("rb", buffering=0) as stream:
        return stream_digest(stream)


def stream_digest(stream: Any) -> str:
    """Return the same digest for the rest of an open binary stream."""
    return f"{_ALGORITHM}{_hashed(stream, blake3()).digest(length=16).hex()}"


def bytes_digest(content: bytes) -> str:
    """Return the same digest for a file's future bytes."""
    return f"{_ALGORITHM}{blake3(content).digest(length=16).hex()}"


def digest_holds(path: Path, digest: str) -> bool:
    """Return True if a file still has the content of `digest`.

    A digest without a prefix is BLAKE2b-128, as stores of older versions hold them: such files stay sound.
    """
    if ":" in digest:
        return file_digest(path) == digest
    with path.open("rb", buffering=0) as stream:
        return bool(_hashed(stream, hashlib.blake2b(digest_size=16)).hexdigest() == digest)


def bytes_hold(content: bytes, digest: str) -> bool:
    """Return the same for a file's content."""
    if ":" in digest:
        return bytes_digest(content) == digest
    return hashlib.blake2b(content, digest_size=16).hexdigest() == digest


def _hashed(stream: Any, state: Any) -> Any:
    # Read, not mapped: an unreadable sector then raises OSError, instead of a signal that ends the process.
    buffer = bytearray(_CHUNK)
    view = memoryview(buffer)
    while count := stream.readinto(buffer):
        state.update(view[:count])
    return state
