"""Selects tiles to reprocess: named tiles, a box on the map, or a span of GPS time."""

from __future__ import annotations

from dataclasses import dataclass

from roadscan.core.errors import ConfigError
from roadscan.core.grid import Bounds, TileId


class SelectionError(ConfigError):
    """The selection names something that the survey does not have; the store is unchanged."""


@dataclass(frozen=True)
class Selection:
    """A selection of tiles; its parts are combined."""

    named: tuple[TileId, ...] = ()
    box: Bounds | None = None
    """Box on the map (m)."""
    span_gps_ns: tuple[int, int] | None = None
    """Selects tiles that readings of this span may have touched."""
