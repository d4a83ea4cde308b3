"""Counts in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_SIZES: Final = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))
"""Units of sizes, the largest first."""


def counted(number: int, one: str) -> str:
    """Return a number of things in words, such as ``1 file`` and ``1,000 files``."""
    return f"{number:,} {one}{'' if number == 1 else 's'}"


def listed(words: Sequence[str], most: int, between: str = ", ") -> str:
    """Return some of many words, and the number of the others: ``A, B and 3 more``."""
    more = f" and {len(words) - most:,} more" if len(words) > most else ""
    return between.join(words[:most]) + more


def size_in_words(size: int) -> str:
    """A size in bytes, such as ``1,234.5 GB``."""
    for unit, name in _SIZES:
        if size >= unit:
            return f"{size / unit:,.1f} {name}"
    return f"{size:,} bytes"


def time_in_words(seconds: float) -> str:
    """A span of time to two units at most, such as ``3 h 20 min``."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"
