"""Chooses between roadscan's kernels and libraries for encoding and decoding."""

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
"""True if the environment has ``ROADSCAN_CODECS=library``: slower, with other bytes but the same content."""
