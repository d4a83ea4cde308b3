"""Files and folders that are made under another name beside their place, and put there when they are whole."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import uuid
from pathlib import Path
from typing import Final

from roadscan.store.holding.process import own_tag, tag_lives

_MADE: Final = re.compile(r"[0-9a-f]{8}-\d+-\d+-[0-9a-f]{32}")
"""What :func:`beside` adds to a name: the tag of a process, and a random number."""
_HERE: Final = -100
"""`AT_FDCWD` of Linux: paths count from the current folder."""
_EXCHANGE: Final = 2
"""`RENAME_EXCHANGE` of Linux's renameat2(2)."""


def beside(place: Path) -> Path:
    """Return a new name beside a file or folder; what processes that are dead left under such names is removed."""
    start = f".{place.name}-"
    for left in place.parent.iterdir() if place.parent.is_dir() else ():
        tag = left.name.removeprefix(start)
        if left.name.startswith(start) and _MADE.fullmatch(tag) and tag_lives(tag) is False:
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
    return place.parent / f"{start}{own_tag()}-{uuid.uuid4().hex}"


def put_folder(made: Path, place: Path) -> None:
    """Put a folder into its place, and remove the one that was there.

    Linux exchanges the two at once. Other systems, and some file servers, cannot: the place is empty for a moment.
    """
    if not place.exists():
        made.rename(place)
        return
    if not _exchanged(made, place):
        old = beside(place)
        place.rename(old)
        try:
            made.rename(place)
        except OSError:
            with contextlib.suppress(OSError):
                old.rename(place)
            raise
        made = old
    made.unlink() if made.is_symlink() else shutil.rmtree(made, ignore_errors=True)


def _exchanged(one: Path, other: Path) -> bool:
    """Return whether the system exchanged two names."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return bool(rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0)
