"""Which version of roadscan wrote to a store last: an older program does not write to a newer store."""

from __future__ import annotations

import re
from typing import Final

from roadscan import __version__
from roadscan.core.errors import StoreError
from roadscan.store.digest import checked_json, parse_checked

VERSION_FILE: Final = "manifest/version.json"
"""Its path, relative to the survey's root."""


def version_content() -> bytes:
    """Return the content of the file, as this version writes it."""
    return checked_json({"roadscan": __version__})


def version_of(content: bytes) -> str:
    """Return the version that the file names; ValueError where it is damaged."""
    found = parse_checked(content).get("roadscan")
    if not isinstance(found, str) or not _numbers(found):
        raise ValueError(f"it names no version: {found!r}")
    return found


def refuse_newer(version: str, place: str) -> None:
    """Raise StoreError where the store at `place` was written by a newer version of roadscan than this one."""
    if _numbers(version) > _numbers(__version__):
        raise StoreError(
            f"roadscan {version} wrote to this store, and this is roadscan {__version__}",
            expected=f"roadscan {version} or newer: what an older one makes anew would be lost to the newer one",
            change=f"install roadscan {version}; or remove {VERSION_FILE} of the store to go back to {__version__}, "
            "which makes all of it anew that it does not know",
            file=place,
        )


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])
