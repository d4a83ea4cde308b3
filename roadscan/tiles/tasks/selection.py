"""Which tiles to reprocess: named tiles, a box on the map, or a span of GPS time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from roadscan.core.errors import ConfigError
from roadscan.core.ids import TileId
from roadscan.tiles.footprints.footprints import FootprintRanges
from roadscan.tiles.grid import Bounds, TileGrid


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

    def tiles(self, known: Iterable[TileId], footprints: FootprintRanges, grid: TileGrid) -> list[TileId]:
        """Chosen tiles among those with readings, by row and column."""
        with_readings = set(known)
        unknown = [t for t in self.named if t not in with_readings]
        if unknown:
            raise SelectionError(
                f"no reading touches tile {unknown[0]}", expected="a tile of the survey (see the tile table)"
            )
        chosen = set(self.named)
        if self.box is not None:
            chosen |= {t for t in with_readings if _touches(t, self.box, grid)}
        if self.span_gps_ns is not None:
            first, last = self.span_gps_ns
            rows = (footprints.first_epoch_gps_ns <= last) & (footprints.last_epoch_gps_ns >= first)
            pairs = np.unique(np.column_stack([footprints.tile_column, footprints.tile_row])[rows], axis=0)
            chosen |= {TileId(int(c), int(r)) for c, r in pairs}
        if not chosen:
            raise SelectionError("the choice holds no tile with readings", expected="tiles of the survey")
        return sorted(chosen, key=lambda t: (t.row, t.column))


def _touches(tile: TileId, box: Bounds, grid: TileGrid) -> bool:
    own = grid.bounds(tile)
    return (
        own.easting_min_m < box.easting_max_m
        and own.easting_max_m > box.easting_min_m
        and own.northing_min_m < box.northing_max_m
        and own.northing_max_m > box.northing_min_m
    )
