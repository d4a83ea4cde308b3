"""A process that dies while the store removes files."""

from __future__ import annotations

import itertools

import pytest

from roadscan.store.store import Store


def dies_at_removal(store: Store, number: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the removal of that number among the manifest's parts end the process instead; None: of none."""
    remove, removals = store.remove, itertools.count()

    def dying(path: str) -> None:
        if path.startswith("manifest/") and next(removals) == number:
            raise KeyboardInterrupt
        remove(path)

    monkeypatch.setattr(store, "remove", dying)
