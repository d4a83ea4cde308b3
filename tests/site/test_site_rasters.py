"""Levels of pictures over the tiles of a survey, against sets of plain Python."""

from __future__ import annotations

import random

import pytest

from roadscan.core.grid import TileGrid, TileId
from roadscan.site.site_rasters import Place, Pyramid

TILES = sorted({TileId(69_000 + k, 533_400 + k // 3 + s) for k in range(-40, 40) for s in (0, 1)})


def expected(pyramid: Pyramid, level: int) -> set[tuple[int, int]]:
    """Pictures that hold a pixel of a tile."""
    size, edge, found = pyramid.tile_px * pyramid.factors[level], pyramid.grid.cells_per_edge, set()
    for tile in pyramid.tiles:
        columns = range(tile.column * edge // size, ((tile.column + 1) * edge - 1) // size + 1)
        rows = range(tile.row * edge // size, ((tile.row + 1) * edge - 1) // size + 1)
        found |= {(c, r) for c in columns for r in rows}
    return found


@pytest.mark.parametrize(("size_m", "cell_m"), [(10.0, 0.005), (10.0, 0.05), (50.0, 0.05), (8.0, 0.005), (10.0, 0.2)])
def test_a_level_has_the_pictures_that_its_tiles_lie_in(size_m: float, cell_m: float) -> None:
    pyramid = Pyramid(TileGrid(size_m, cell_m), tuple(TILES))
    assert 250 <= pyramid.tile_px <= 512
    assert len(expected(pyramid, len(pyramid.factors) - 1)) <= 4
    rng = random.Random(1)
    for level in range(len(pyramid.factors)):
        there = expected(pyramid, level)
        assert {tuple(place) for place in pyramid.places(level).tolist()} == there
        assert {(c, row) for row, runs in pyramid.runs(level) for a, b in runs for c in range(a, b + 1)} == there
        for c, r in rng.sample(sorted(there), min(30, len(there))):
            for near in ((c, r), (c + 1, r), (c, r - 1), (c - 1, r + 1)):
                assert pyramid.holds(Place(level, *near)) == (near in there)


def test_levels_follow_the_overviews_of_tiles() -> None:
    pyramid = Pyramid(TileGrid(10.0, 0.005), tuple(TILES))
    assert pyramid.factors[:5] == (1, 2, 8, 40, 160)
    assert (pyramid.tile_px, pyramid.stored_levels, pyramid.pixel_m(3)) == (500, 4, 0.2)
