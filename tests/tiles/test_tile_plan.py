"""Planned tiles by number."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.core.grid import TileId
from roadscan.tiles.tasks.tile_plan import PlannedTiles


@pytest.mark.parametrize("spread", [1, 10_000_000])
def test_numbers_of_tiles(spread: int) -> None:
    random = np.random.default_rng(spread)
    row, column = np.unique(random.integers(-40, 40, (300, 2)) * spread, axis=0).astype(np.int32).T
    none = np.empty(0, np.int64)
    keys = ("key",) * row.size
    tiles = PlannedTiles(column=column, row=row, readings=none, first_epoch_gps_ns=none, groups=none, keys=keys)
    chosen = random.permutation(row.size)[:50]
    assert tiles.numbers([tiles.ids[n] for n in chosen]).tolist() == chosen.tolist()
    assert tiles.numbers([]).size == 0
    for other in (TileId(0, 40 * spread), TileId(0, -41 * spread), TileId(41 * spread, int(row[7]))):
        with pytest.raises(KeyError, match=str(other.row)):
            tiles.numbers([tiles.ids[0], other])
