"""Tiles cut into stretches of road: each tile in one of them, few row groups in several."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from roadscan.footprints.footprints import FootprintRanges
from roadscan.footprints.row_groups import GroupsByTile
from roadscan.tiles.tasks.tile_plan import DrivenTiles, cut_stretches


def driven(tiles: int, beyond: int) -> DrivenTiles:
    """A drive along a row of tiles, from the last to the first: 50 row groups a tile, `beyond` more on both sides."""
    column = np.arange(tiles)
    first = np.maximum(50 * column[::-1] - beyond, 0)
    last = np.minimum(50 * column[::-1] + 49 + beyond, 50 * tiles - 1)
    slices = (SimpleNamespace(groups=range(50 * tiles)),)
    found = FootprintRanges(column, 0 * column, 0 * column, first, last, last - first + 1, first, last, slices)  # type: ignore[arg-type]
    groups = GroupsByTile(found, np.arange(tiles), np.arange(tiles + 1))
    return DrivenTiles(column.astype(np.int32), np.zeros(tiles, np.int32), last - first + 1, first, groups)


@pytest.mark.parametrize(
    ("tiles", "size_m", "beyond", "count"),
    [
        (40, 50.0, 0, 16),  # profilers: eight tasks a worker
        (16, 50.0, 30, 2),  # a lidar, which sees 30 row groups beyond its tile: one task a worker
        (40, 50.0, 30, 4),
        (1000, 50.0, 30, 18),  # long enough: three kilometres each
        (3, 10.0, 0, 3),
        (1, 50.0, 30, 1),
    ],
)
def test_every_tile_is_in_one_stretch_in_the_order_of_the_drive(
    tiles: int, size_m: float, beyond: int, count: int
) -> None:
    road = driven(tiles, beyond)
    stretches = cut_stretches(road, np.arange(tiles), size_m, workers=2)
    assert np.concatenate(stretches).tolist() == list(range(tiles))[::-1]
    assert len(stretches) == count
    sizes = [part.size for part in stretches]
    assert max(sizes) <= 2 * min(sizes) + 2 or tiles == 1000
