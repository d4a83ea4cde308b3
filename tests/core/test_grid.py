"""The grid and its blocks: no position is lost or counted twice."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from roadscan.assets.tasks.plan import cut_squares
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.tiles.tasks.tile_plan import Block, cut_blocks

GRID = TileGrid(10.0, 0.05)
coordinate = st.floats(-6e6, 6e6, allow_nan=False)


@given(coordinate, coordinate)
def test_a_position_lies_in_its_tile(easting: float, northing: float) -> None:
    box = GRID.bounds(GRID.tile_at(easting, northing))
    assert box.easting_min_m - 1e-5 <= easting < box.easting_max_m + 1e-5
    assert box.northing_min_m - 1e-5 <= northing < box.northing_max_m + 1e-5


def test_edges_belong_to_the_tile_east_and_north_of_them() -> None:
    assert GRID.tile_at(620_000.0, 5_300_010.0) == TileId(62_000, 530_001)
    assert GRID.tile_at(-0.00001, -10.0) == TileId(-1, -1)


def test_tiles_in_a_box() -> None:
    assert GRID.tiles_in(Bounds(-5, 0, 15, 10)) == [TileId(-1, 0), TileId(0, 0), TileId(1, 0)]


tiles = st.dictionaries(
    st.builds(TileId, st.integers(-30, 30), st.integers(-30, 30)), st.integers(0, 1000), min_size=1, max_size=200
)


@given(tiles, st.integers(1, 16), st.integers(1, 5000))
def test_blocks_hold_every_tile_once(readings: dict[TileId, int], edge: int, limit: int) -> None:
    blocks = cut_blocks(readings, edge, limit)
    listed = [t for b in blocks for t in b.tiles]
    assert sorted(listed) == sorted(readings)
    for block in blocks:
        box = block.box()
        assert box[2] - box[0] <= edge
        assert len(block.tiles) == 1 or sum(readings[t] for t in block.tiles) <= limit


@given(tiles, st.integers(1, 64), st.integers(1, 50_000))
def test_squares_that_fit_into_one_block_are_one_wherever_they_lie(
    readings: dict[TileId, int], edge: int, limit: int
) -> None:
    blocks = cut_squares(readings, edge, limit)
    assert sorted(t for block in blocks for t in block) == sorted(readings)
    spans = [max(at) - min(at) < edge for at in zip(*readings, strict=True)]
    for block in blocks:
        assert all(max(at) - min(at) < edge for at in zip(*block, strict=True))
    if all(spans) and sum(readings.values()) <= limit:
        assert len(blocks) == 1


def test_halo_surrounds_each_tile() -> None:
    block = Block((TileId(5, 5), TileId(6, 5)), 2)
    assert block.box() == (3, 3, 9, 8)
    assert len(block.with_halo()) == 6 * 5
