"""Cell statistics against pandas, and their independence of the points' order."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roadscan.core.grid import TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.tiles.accumulator import cells_of

GRID = TileGrid(10.0, 0.5)


def points(seed: int, n: int, spread: int = 300_000) -> TilePoints:
    rng = np.random.default_rng(seed)
    return TilePoints(
        tile=TileId(-3, 7),
        x_quanta=rng.integers(0, 1_000_000, n).astype(np.int32),
        y_quanta=rng.integers(0, 1_000_000, n).astype(np.int32),
        height_quanta=(rng.integers(-spread, spread, n) - 5_000_000).astype(np.int32),
        epoch_gps_ns=rng.integers(0, 10**18, n),
        intensity=rng.integers(0, 65_536, n).astype(np.uint16),
        classification=np.ones(n, np.uint8),
        pass_id=rng.integers(1, 4, n).astype(np.uint16),
    )


def shuffled(p: TilePoints, seed: int) -> TilePoints:
    order = np.random.default_rng(seed).permutation(len(p))
    arrays = {k: v[order] for k, v in vars(p).items() if isinstance(v, np.ndarray)}
    return TilePoints(tile=p.tile, **arrays)


def robust(heights: pd.Series) -> float:
    """The documented rule, written out."""
    ordered = np.sort(heights.to_numpy())
    median = ordered[(ordered.size - 1) // 2]
    deviation = np.sort(np.abs(ordered - median))[(ordered.size - 1) // 2]
    return float(ordered[np.abs(ordered - median) <= max(3 * 1.4826 * deviation, 1e-3)].mean())


def test_statistics_equal_pandas() -> None:
    p = points(1, 20_000)
    cells = cells_of(p, GRID)
    frame = pd.DataFrame(
        {
            "row": p.y_quanta // 50_000,
            "column": p.x_quanta // 50_000,
            "h": p.height_quanta * 1e-5,
            "i": p.intensity.astype(float),
            "pass": p.pass_id,
        }
    )
    groups = frame.groupby(["row", "column"])
    assert len(cells) == groups.ngroups
    assert np.array_equal(np.column_stack([cells.row, cells.column]), np.array(list(groups.groups)))
    assert np.array_equal(cells.count, groups.size())
    np.testing.assert_allclose(cells.height_mean_m, groups["h"].mean(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(cells.height_min_m, groups["h"].min(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(cells.height_max_m, groups["h"].max(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(cells.height_std_m, groups["h"].std(ddof=0), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(cells.height_robust_m, groups["h"].apply(robust), rtol=0, atol=1e-9)
    np.testing.assert_allclose(cells.intensity_mean, groups["i"].mean(), rtol=1e-6)
    expected = groups["pass"].apply(lambda s: sorted(set(s)))
    found = [cells.pass_ids[a:b].tolist() for a, b in zip(cells.pass_offsets, cells.pass_offsets[1:], strict=False)]
    assert found == expected.tolist()
    assert np.array_equal(cells.pass_count, expected.map(len))


def test_robust_height_ignores_loose_stone_and_crack() -> None:
    heights = np.array([0, 10, 20, -10, 5, 3, 0, 2_000, -3_000], np.int32)  # a stone of 20 mm, a crack of 30 mm
    n = heights.size
    zero = np.zeros(n, np.int32)
    ones = np.ones(n, np.uint16)
    p = TilePoints(TileId(0, 0), zero, zero, heights, np.arange(n), ones, np.ones(n, np.uint8), ones)
    cells = cells_of(p, GRID)
    assert cells.height_robust_m[0] == pytest.approx(28 / 7 * 1e-5)
    assert cells.height_mean_m[0] < -0.001


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 400), st.sampled_from([1, 50, 300_000, 6_000_000]))
def test_order_of_points_changes_no_bit(seed: int, n: int, spread: int) -> None:
    p = points(seed, n, spread)
    a, b = cells_of(p, GRID), cells_of(shuffled(p, seed + 1), GRID)
    for name, value in vars(a).items():
        if isinstance(value, np.ndarray):
            assert value.tobytes() == getattr(b, name).tobytes(), name


@pytest.mark.parametrize("changes", [0, 3, 300])
@pytest.mark.parametrize("spread", [50, 6_000_000])
def test_points_cell_by_cell_and_in_any_order_give_the_same_bits(changes: int, spread: int) -> None:
    p = points(2, 40_000, spread)
    passes = np.sort(p.pass_id) if changes < 4 else p.pass_id
    p = dataclasses.replace(p, pass_id=np.ones_like(passes) if changes == 0 else passes)
    order = np.lexsort((p.x_quanta // 50_000, p.y_quanta // 50_000))
    by_cell = dataclasses.replace(p, **{k: v[order] for k, v in vars(p).items() if isinstance(v, np.ndarray)})
    a, b = cells_of(by_cell, GRID), cells_of(p, GRID)
    for name, value in vars(a).items():
        if isinstance(value, np.ndarray):
            assert value.tobytes() == getattr(b, name).tobytes(), name


def test_raster_is_north_up() -> None:
    ones = np.ones(1, np.uint16)
    p = TilePoints(
        TileId(0, 0), np.array([10], np.int32), np.array([999_990], np.int32), np.array([123_000], np.int32),
        np.zeros(1, np.int64), ones, np.ones(1, np.uint8), ones,
    )  # fmt: skip
    image = cells_of(p, GRID).raster("height_robust_m")
    assert image.shape == (20, 20)
    assert image[0, 0] == pytest.approx(1.23)
    assert np.isnan(image).sum() == 399


def test_sums_stay_exact_where_heights_spread_over_sixty_metres() -> None:
    n = 200_000
    rng = np.random.default_rng(0)
    heights = rng.integers(0, 6_000_000, n).astype(np.int32)
    zero, ones = np.zeros(n, np.int32), np.ones(n, np.uint16)
    p = TilePoints(TileId(0, 0), zero, zero, heights, np.zeros(n, np.int64), ones, np.ones(n, np.uint8), ones)
    assert cells_of(p, GRID).height_std_m[0] == pytest.approx(heights.std() * 1e-5, rel=1e-6)


def test_a_full_cell_keeps_the_intensity_of_its_readings() -> None:
    n = 40_000  # of 65,535 each: the sum takes more than 31 bits
    zeros = np.zeros(n, np.int32)
    p = dataclasses.replace(points(5, n), x_quanta=zeros, y_quanta=zeros, intensity=np.full(n, 65_535, np.uint16))
    cells = cells_of(p, GRID)
    assert cells.count.tolist() == [n]
    assert cells.intensity_mean.tolist() == [65_535.0]
    assert cells.height_robust_m[0] == pytest.approx(robust(pd.Series(p.height_quanta * 1e-5)), abs=1e-9)
