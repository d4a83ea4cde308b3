"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, one: str) -> str:
    """A number of things, such as ``1 file`` and ``1,000 files``."""
    return f"{number:,} {one}{'' if number == 1 else 's'}"
