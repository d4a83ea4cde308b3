"""Which tiles to reprocess: named tiles, a box on the map, or a span of GPS time."""

from __future__ import annotations

from dataclasses import dataclass

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds
from roadscan.core.ids import TileId


class SelectionError(ConfigError):
    """The choice names what the survey does not hold; the store is as it was."""


@dataclass(frozen=True)
class Selection:
    """A choice of tiles; the parts that are given add up."""

    named: tuple[TileId, ...] = ()
    box: Bounds | None = None
    """Box on the map (m)."""
    span_gps_ns: tuple[int, int] | None = None
    """Tiles that a reading of this span may have touched."""
