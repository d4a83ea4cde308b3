"""Keys: short hashes of everything that an output depends on."""

from __future__ import annotations

import functools
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import roadscan
from roadscan.model.crs import grid_folders
from roadscan.tables.store import file_digest

_SHAPING = ("model", "kernels", "navigation", "points", "tiles", "jobs")
"""Layers whose code shapes points and cells; a change in them makes every output stale."""
_SOLVING = ("model", "kernels", "navigation")
"""Layers whose code computes trajectories, clocks and mountings."""

_RECONSTRUCTING = ("model", "kernels", "points", "tiles", "surfaces", "jobs")
"""Layers whose code makes the surface of cells or points."""


def key_of(*parts: Any) -> str:
    """Sixteen hexadecimal digits over JSON-like values (order matters, dictionaries are sorted)."""
    text = json.dumps(parts, sort_keys=True, default=str, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def keys_of(common: str, content: npt.NDArray[np.void], ends: npt.NDArray[np.int64]) -> list[str]:
    """A key for each part of an array of records, (parts,) `ends` of the parts; `common` shapes all of them.

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


def grid_digest(name: str | None) -> list[str] | None:
    """Name and content of a geoid grid in the folders that PROJ looks in: a replaced grid is another grid."""
    if name is None:
        return None
    found = [Path(folder) / name for folder in grid_folders()]
    return [name, *(file_digest(f) for f in found if f.is_file())]


@functools.cache
def code_version() -> str:
    """Version of the code that shapes points and cells: release and hash of its sources."""
    return _version(_SHAPING)


@functools.cache
def solver_version() -> str:
    """Version of the code that computes trajectories, clocks and mountings."""
    return _version(_SOLVING)


@functools.cache
def surface_version() -> str:
    """Version of the code that makes the surface of cells or points."""
    return _version(_RECONSTRUCTING)


def _version(layers: tuple[str, ...]) -> str:
    root = Path(roadscan.__file__).parent
    digest = hashlib.blake2b(roadscan.__version__.encode(), digest_size=8)
    for layer in layers:
        for file in sorted((root / layer).rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()
