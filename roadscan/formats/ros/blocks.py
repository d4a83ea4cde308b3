"""Gathers single messages into blocks, which are converted at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from roadscan.formats.ros.topics import Timed
from roadscan.ingest.reading.format import Item

_MESSAGES: Final = 8_192  # messages of a block


def blocks(items: Iterator[Timed | Item]) -> Iterator[list[Timed] | Item]:
    """Yield lists of messages, and between them what is not a message."""
    pending: list[Timed] = []
    file = ""
    for item in items:
        if not isinstance(item, Timed):
            yield item
            continue
        if pending and (len(pending) >= _MESSAGES or item.message.file != file):
            yield pending
            pending = []
        file = item.message.file
        pending.append(item)
    if pending:
        yield pending
