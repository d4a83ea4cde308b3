"""Selects tiles among those that a reading touches."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.footprints.footprints import FootprintRanges
from roadscan.run.selection import Selection, SelectionError


def chosen_tiles(
    selection: Selection, known: Iterable[TileId], footprints: FootprintRanges, grid: TileGrid
) -> list[TileId]:
    """Return the chosen tiles among those with readings, by row and column."""
    with_readings = set(known)
    unknown = [t for t in selection.named if t not in with_readings]
    if unknown:
        raise SelectionError(
            f"no reading touches tile {unknown[0]}", expected="a tile of the survey (see the tile table)"
        )
    chosen = set(selection.named)
    if selection.box is not None:
        chosen |= {t for t in with_readings if _touches(t, selection.box, grid)}
    if selection.span_gps_ns is not None:
        first, last = selection.span_gps_ns
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
