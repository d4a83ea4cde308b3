"""Digests of files and of their bytes, and small JSON files that bear one: damage is detected."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
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


_SEAL: Final = b',\n "checksum": "%b"'
_END: Final = b"\n}"


def checked_json(values: Mapping[str, Any]) -> bytes:
    """Return a non-empty object as JSON with its checksum."""
    return _sealed(json.dumps(values, indent=1, sort_keys=True).encode())


def parse_checked(content: bytes) -> dict[str, Any]:
    """Return the object without its checksum (files of older versions have none); raise ValueError for damage."""
    mark, _, _ = _SEAL.partition(b"%b")
    start = content.rfind(mark)
    text = content if start < 0 else content[:start] + _END
    if start >= 0 and content != _sealed(text):
        raise ValueError("its checksum differs")
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("it holds no object")
    return values


def _sealed(text: bytes) -> bytes:
    return text.removesuffix(_END) + _SEAL % bytes_digest(text).encode() + _END
