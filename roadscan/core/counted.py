"""Counts in words."""

from __future__ import annotations


def counted(number: int, one: str) -> str:
    """Return a number of things in words, such as ``1 file`` and ``1,000 files``."""
    return f"{number:,} {one}{'' if number == 1 else 's'}"
