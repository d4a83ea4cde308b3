"""The record of pictures that went for people's privacy: which, when, by whom and why. It holds no picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final

from roadscan.core.errors import DamagedError
from roadscan.store.digest import checked_json, parse_checked
from roadscan.store.store import Store

FORGOTTEN: Final = "manifest/forgotten.json"
"""The record, relative to the survey's root."""


@dataclass(frozen=True)
class Forgotten:
    """A picture that went."""

    run: str
    camera: str
    path: str
    """From the survey file's folder."""
    at_utc: str
    who: str
    why: str


def forgotten_pictures(store: Store) -> list[Forgotten]:
    """Return the pictures of a survey that went.

    Raises
    ------
    DamagedError
        where the record is damaged.
    """
    if not store.exists(FORGOTTEN):
        return []
    try:
        return [Forgotten(**one) for one in parse_checked(store.read_bytes(FORGOTTEN))["pictures"]]
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedError(
            f"the record of forgotten pictures is damaged: {error}",
            change="restore it from a copy of the store, or remove it: then nothing tells which pictures went",
            file=store.path(FORGOTTEN),
        ) from error


def record_forgotten(store: Store, pictures: Iterable[Forgotten]) -> None:
    """Write the record of all pictures that went (requires the store's lock)."""
    rows = [asdict(one) for one in sorted(pictures, key=lambda one: one.path)]
    if rows:
        store.write_bytes(FORGOTTEN, checked_json({"pictures": rows}))
