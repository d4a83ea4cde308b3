"""Keys: short hashes of everything on which an output depends."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import Geoid


def key_of(*parts: Any) -> str:
    """Return sixteen hexadecimal digits for JSON-like values (order matters, dictionaries are sorted)."""
    text = json.dumps(parts, sort_keys=True, default=str, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def keys_of(common: str, content: npt.NDArray[np.void], ends: npt.NDArray[np.int64]) -> list[str]:
    """Return a key for each part of an array of records, (parts,) `ends` of the parts; `common` enters all keys.

    Faster than :func:`key_of` for the tiles of a network.
    """
    begun = hashlib.blake2b(common.encode(), digest_size=8)
    stream, size, start, found = memoryview(content.tobytes()), content.dtype.itemsize, 0, []
    for end in (size * ends).tolist():
        one = begun.copy()
        one.update(stream[start:end])
        found.append(one.hexdigest())
        start = end
    return found


def keys_beside(keys: Sequence[str], other: str) -> list[str]:
    """Return ``key_of(key, other)`` for each of many keys, which are hexadecimal digits."""
    end = f'",{json.dumps(other)}]'
    return [hashlib.blake2b(f'["{key}{end}'.encode(), digest_size=8).hexdigest() for key in keys]


def grid_key(geoid: Geoid | None) -> list[str] | None:
    """Return name and content of a geoid grid: a replaced grid counts as another one."""
    return None if geoid is None else [geoid.grid, geoid.content]
