"""Blocks: neighbouring tiles that one task computes, with the halo around them.

The content of a tile never depends on the block it was computed in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import TileId


@dataclass(frozen=True)
class Block:
    """Tiles that are computed together."""

    tiles: tuple[TileId, ...]
    """Core tiles, by row and column."""
    halo_tiles: int = 0
    """Rings of neighbouring tiles whose points are loaded as well."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the tiles as one array: one by one they take longer than the rest of a task."""
        packed = np.array(self.tiles, np.int32).reshape(-1, 2)
        return _unpacked, (packed, self.halo_tiles)

    def box(self) -> tuple[int, int, int, int]:
        """First column, first row, end column, end row of core and halo."""
        columns = [t.column for t in self.tiles]
        rows = [t.row for t in self.tiles]
        h = self.halo_tiles
        return min(columns) - h, min(rows) - h, max(columns) + 1 + h, max(rows) + 1 + h

    def with_halo(self) -> frozenset[TileId]:
        """Return core tiles and the halo around each of them."""
        reach = range(-self.halo_tiles, self.halo_tiles + 1)
        return frozenset(TileId(t.column + c, t.row + r) for t in self.tiles for c in reach for r in reach)


def _unpacked(packed: npt.NDArray[np.int32], halo_tiles: int) -> Block:
    return Block(tuple(map(TileId._make, packed.tolist())), halo_tiles)


def cut_blocks(readings: Mapping[TileId, int], edge_tiles: int, max_readings: int, halo_tiles: int = 0) -> list[Block]:
    """Cut tiles into blocks of at most `edge_tiles`² tiles and about `max_readings` readings.

    Parameters
    ----------
    readings : readings expected in each tile to be computed.
    edge_tiles : edge of the largest block; blocks lie on the lattice of that edge.
    max_readings : a block with more is divided into four, down to single tiles.
    """
    groups: dict[tuple[int, int], list[TileId]] = {}
    for tile in sorted(readings, key=lambda t: (t.row, t.column)):
        groups.setdefault((tile.row // edge_tiles, tile.column // edge_tiles), []).append(tile)
    blocks: list[Block] = []
    for _, tiles in sorted(groups.items()):
        too_many = sum(readings[t] for t in tiles) > max_readings
        if too_many and edge_tiles > 1 and len(tiles) > 1:
            part = {t: readings[t] for t in tiles}
            blocks += cut_blocks(part, max(edge_tiles // 2, 1), max_readings, halo_tiles)
        else:
            blocks.append(Block(tuple(tiles), halo_tiles))
    return blocks
