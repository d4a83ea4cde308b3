"""Overviews of a tile, beside pandas."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from roadscan.core.errors import ConfigError
from roadscan.core.grid import TileId
from roadscan.tiles.cells import Level, TileCells, overview_factors, pyramid_of


def cells(edge: int, filled: float, seed: int = 3, height_m: float = 3_500.0) -> TileCells:
    """Cells at random, on a slope of 10 %."""
    rng = np.random.default_rng(seed)
    row, column = np.nonzero(rng.random((edge, edge)) < filled)
    n = row.size
    count = rng.integers(1, 40, n).astype(np.uint32)
    height = height_m + 0.001 * column + rng.normal(0, 0.01, n)
    light = rng.integers(0, 65_536 * count.astype(np.int64)) / count
    ones = np.ones(n, np.uint16)
    return TileCells(
        TileId(1, 2), edge, column.astype(np.uint16), row.astype(np.uint16), count, height, height, height, height,
        np.zeros(n, np.float32), light.astype(np.float32), ones, np.arange(n + 1, dtype=np.int32), ones,
    )  # fmt: skip


def by_pandas(one: TileCells, factor: int) -> pd.DataFrame:
    frame = pd.DataFrame(
        {
            "row": one.row // factor,
            "column": one.column // factor,
            "count": one.count.astype(np.int64),
            "height": one.height_robust_m - 3_500.0,
            "light": np.rint(one.intensity_mean.astype(np.float64) * one.count),
        }
    )
    groups = frame.groupby(["row", "column"], sort=True)
    return groups.agg(
        count=("count", "sum"), cells=("count", "size"), height=("height", "mean"), light=("light", "sum")
    ).reset_index()


def bits(level: Level) -> list[bytes]:
    return [np.asarray(v).tobytes() for v in vars(level).values()]


@pytest.mark.parametrize(("edge", "filled"), [(200, 0.4), (120, 1.0), (80, 0.002)])
def test_pixels_are_what_pandas_says(edge, filled):
    one = cells(edge, filled)
    for level in pyramid_of(one, overview_factors(edge)):
        expected = by_pandas(one, level.factor)
        for name in ("row", "column", "count", "cells"):
            assert np.array_equal(getattr(level, name), expected[name]), name
        assert np.abs(level.height_m - 3_500.0 - expected["height"]).max() < 1e-9
        assert np.array_equal(level.intensity, (expected["light"] / expected["count"]).astype(np.float32))


def test_a_level_does_not_depend_on_the_others():
    one = cells(160, 0.3)
    together = pyramid_of(one, (2, 8, 40))
    for level in together:
        assert bits(level) == bits(pyramid_of(one, (level.factor,))[0])


def test_one_height_stays_itself():
    one = cells(40, 0.5)
    one.height_robust_m[:] = 287.30001
    for level in pyramid_of(one, (2, 8, 40)):
        assert np.abs(level.height_m - 287.30001).max() <= 2.0**-33 + 1e-13


@pytest.mark.parametrize(
    ("edge", "factors"),
    [(2000, (2, 8, 40)), (200, (2, 8, 40)), (1600, (2, 8, 32)), (20, (2, 10, 20)), (2, (2,)), (1, ()), (998, (2,))],
)
def test_factors_divide_the_tile(edge, factors):
    assert overview_factors(edge) == factors


def test_no_cells_no_pixels():
    assert [len(level) for level in pyramid_of(cells(40, 0.0), (2, 8))] == [0, 0]


@pytest.mark.parametrize("factors", [(3,), (2, 5), (8, 2), (1,)])
def test_factors_that_do_not_fit_are_refused(factors):
    with pytest.raises(ConfigError, match="overviews by"):
        pyramid_of(cells(40, 0.5), factors)
