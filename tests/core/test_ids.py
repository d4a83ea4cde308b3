"""Identifiers."""

from __future__ import annotations

import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.grid import LanePass, PassId, RunId, TileId


@pytest.mark.parametrize("text", ["62342_484882", "-3_7", " 12,-4 "])
def test_tile_reads_what_it_writes(text: str) -> None:
    tile = TileId.parse(text)
    assert TileId.parse(str(tile)) == tile
    assert str(tile) == text.strip().replace(",", "_")


@pytest.mark.parametrize("text", ["12", "1_2_3", "a_b", "1.5_2", ""])
def test_not_a_tile(text: str) -> None:
    with pytest.raises(ConfigError, match="expected COLUMN_ROW"):
        TileId.parse(text)


def test_tiles_sort_by_column_then_row() -> None:
    assert sorted([TileId(1, 2), TileId(-5, 9), TileId(1, -2)]) == [TileId(-5, 9), TileId(1, -2), TileId(1, 2)]


@pytest.mark.parametrize("number", [0, -1, 65_536])
def test_pass_ids_fit_the_point_source_id(number: int) -> None:
    with pytest.raises(ConfigError, match="from 1 to 65535"):
        LanePass(PassId(number), RunId("a"), 0, 1)


def test_a_pass_ends_after_it_starts() -> None:
    with pytest.raises(ConfigError, match="ends before it starts"):
        LanePass(PassId(1), RunId("a"), 10, 10)
