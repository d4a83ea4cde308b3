"""Size and time of a file, which show without reading it that it has not been written since."""

from __future__ import annotations

import os
from typing import Any, Final, NamedTuple

from roadscan.store.store import Store

_MARKS: Final = ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime", "updated", "created")
"""What changes with a file's content, by the names that S3, Azure and Google, and file systems give it."""


class Stamp(NamedTuple):
    """Size and time that show, without reading it, that a file has not been written since."""

    bytes: int
    changed: str
    """Time of the last change (ns) in a folder; an object store's equivalent, empty where it has none."""


def stamp_of(store: Store, path: str) -> Stamp | None:
    """Return size and time of a file of the store (`path` relative to the survey's root), None where it is missing."""
    try:
        if store.is_folder:
            return stamp_of_stat(os.stat(store.path(path)))  # noqa: PTH116 — thousands of them
        known = store.state(path)
        return stamp_of_info(store.fs.info(store.path(path))) if known is None else Stamp(*known)
    except (FileNotFoundError, NotADirectoryError):
        return None


def stamp_of_stat(found: os.stat_result) -> Stamp:
    """Return size and time of a local file or folder."""
    return Stamp(found.st_size, str(found.st_mtime_ns))


def stamp_of_info(found: dict[str, Any]) -> Stamp:
    """Return size and time of an object from what its file system tells of it (`fsspec`'s `info`)."""
    return Stamp(int(found["size"]), str(next((found[name] for name in _MARKS if found.get(name)), "")))
