"""Whose code makes and reads bytes where roadscan has kernels of its own: these, or libraries alone."""

from __future__ import annotations

import os
from typing import Final

_VARIABLE: Final = "ROADSCAN_CODECS"
_CHOICES: Final = ("own", "library")


def _chosen() -> str:
    stated = os.environ.get(_VARIABLE, "") or "own"
    if stated not in _CHOICES:
        raise SystemExit(f"{_VARIABLE} is '{stated}'; it is one of: {', '.join(_CHOICES)}")
    return stated


LIBRARY: Final = _chosen() == "library"
"""True if the environment says ``ROADSCAN_CODECS=library``: slower, other bytes, the same content."""
