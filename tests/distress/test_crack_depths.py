"""Depths from lowest readings: the simulator's cracks, narrower than a cell, in cells of many readings; NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from numpy.lib.stride_tricks import sliding_window_view

from roadscan.distress.crack_network import join_cracks
from roadscan.distress.crack_response import LINE_HALF, flank_cells
from roadscan.distress.cracks import NARROW_CELLS, WIDE_CELLS, blended, crack_pieces
from roadscan.distress.kernels.cross_sections import quantiles_along
from roadscan.distress.settings import CrackDetection, CrackJoining
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.surface.heights import HeightWindow, LowestReadings

Float64 = npt.NDArray[np.float64]

CELL_M, FINE = 0.005, 5
CELLS = (112, 130)
WRONG = 0.02
CONFIG = CrackDetection(max_width_m=0.02)
LINE = [(10.0, 0.95), (10.3, 1.03), (10.6, 0.98)]


def cells_of(width_m: float, depth_m: float, kept: float = 0.95, wrong: float = 0.0) -> HeightWindow:
    """Cells of 5 mm of a textured road with a crack along it, of readings 1 mm apart of which a share is kept.

    Of these a share is wrong by up to 3 cm. What wrong readings do to the robust height is another matter: smoothed
    heights are those of a road without any.
    """
    crack = {"points_m": LINE, "width_m": width_m, "depth_m": depth_m}
    road = {"texture": {"mpd_mm": 0.8}, "cross_slope": 0.03, "cracks": [crack]}
    scene = Scene(seed=3).changed(map={"azimuth_deg": 0.0}, road=road)
    north, east = round((scene.map.northing_m + 10.0) / CELL_M), round((scene.map.easting_m + 0.7) / CELL_M)
    y, x = ((k + (np.arange(n * FINE) + 0.5) / FINE) * CELL_M for k, n in zip((north, east), CELLS, strict=True))
    draw = np.random.default_rng(11)
    height = Surface(scene).height_m(*np.broadcast_arrays(x[None], y[:, None]))
    height += draw.normal(0.0, 0.0003, height.shape)
    height += np.where(draw.random(height.shape) < wrong, draw.uniform(-0.03, 0.03, height.shape), 0.0)
    height[draw.random(height.shape) > kept] = np.nan
    readings = height.reshape(CELLS[0], FINE, CELLS[1], FINE).swapaxes(1, 2).reshape(*CELLS, FINE * FINE)
    count = (~np.isnan(readings)).sum(axis=2)
    readings[count == 0, 0] = height[~np.isnan(height)].mean()
    robust = np.nanmedian(readings, axis=2)
    drop = robust - np.nanmin(readings, axis=2)
    robust[count == 0] = drop[count == 0] = np.nan
    lowest = LowestReadings(drop.astype(np.float32), count.astype(np.uint16))
    return HeightWindow(robust, robust, CELL_M, 0.0003, north, east, lowest=lowest)


def depths(window: HeightWindow) -> tuple[float, float]:
    """Mean and greatest depth of the only crack (m)."""
    (crack,) = join_cracks(crack_pieces(window, CONFIG), 0.0, CELL_M, CrackJoining())
    return crack.depth_mean_m, crack.depth_max_m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width_m", "depth_m", "kept", "wrong"),
    [(0.005, 0.003, 0.95, 0.0), (0.005, 0.008, 0.95, WRONG), (0.004, 0.010, 0.95, 0.0), (0.005, 0.008, 0.3, 0.0)],
    ids=["5 x 3 mm", "5 x 8 mm, wrong readings", "4 x 10 mm", "few readings"],
)
def test_a_crack_narrower_than_a_cell_is_as_deep_as_the_simulators(
    width_m: float, depth_m: float, kept: float, wrong: float
) -> None:
    window = cells_of(width_m, depth_m, kept, wrong)
    mean, greatest = depths(window)
    assert mean == pytest.approx(depth_m, rel=0.1)
    assert mean <= greatest < 1.25 * depth_m
    unknown, _ = depths(replace(window, lowest=None))
    assert unknown < 0.75 * depth_m  # half of it is not in the cells


def test_the_depth_of_a_wide_crack_is_that_of_robust_heights_as_well() -> None:
    window = cells_of(0.020, 0.015, wrong=WRONG)
    mean, greatest = depths(window)
    plain, plain_greatest = depths(replace(window, lowest=None))
    assert mean == pytest.approx(0.015, rel=0.05) and mean == pytest.approx(plain, rel=0.05)
    assert greatest == pytest.approx(plain_greatest, rel=0.05)


def test_a_crack_that_heights_hardly_show_is_found_by_lowest_readings_alone() -> None:
    window = cells_of(0.003, 0.005)
    alone = CrackDetection(max_width_m=0.02, lowest_alone=True)
    found, bridged = (sum(p.length_m for p in crack_pieces(window, config)) for config in (alone, CONFIG))
    border = LINE_HALF + 3 * flank_cells(CONFIG, CELL_M)[-1]  # where nothing is found
    assert found == pytest.approx((CELLS[0] - 2 * border) * CELL_M, rel=0.1) and bridged < 0.7 * found
    assert crack_pieces(cells_of(0.003, 1e-6, wrong=WRONG), alone) == []


def test_crowded_cells_are_those_with_many_times_the_readings_around() -> None:
    count = np.random.default_rng(3).integers(0, 9, (40, 50)).astype(np.uint16)
    count[20], count[30:32, 7] = 40, 60
    padded = np.pad(count.astype(float), 5)
    around = sliding_window_view(padded, (11, 11)).sum(axis=(2, 3))
    cells = sliding_window_view(padded > 0, (11, 11)).sum(axis=(2, 3))
    found = LowestReadings(np.zeros(count.shape, np.float32), count).crowded()
    assert found[20].all() and found[30:32, 7].all() and found.sum() < 70
    np.testing.assert_array_equal(found, count * cells > 3 * around)


def of_readings(height_m: Float64, seed: int = 1) -> HeightWindow:
    """Cells of readings (rows, columns, n) with noise."""
    readings = height_m + np.random.default_rng(seed).normal(300.0, 0.0003, height_m.shape)
    robust = np.nanmedian(readings, axis=2)
    lowest = LowestReadings(
        (robust - np.nanmin(readings, axis=2)).astype(np.float32), (~np.isnan(readings)).sum(axis=2).astype(np.uint16)
    )
    return HeightWindow(robust, robust, CELL_M, 0.0003, lowest=lowest)


def low_profile(height_m: Float64) -> None:
    height_m[60, :, :2] -= 0.003  # a fifth of the row's readings


def standing(height_m: Float64) -> None:
    height_m[:60, :, 10:] = height_m[61:, :, 10:] = np.nan  # ten readings a cell, eighty in one row
    height_m[60, :, 40] -= 0.003


@pytest.mark.parametrize("fault", [low_profile, standing])
def test_what_lowest_readings_alone_show_is_no_crack(fault: Callable[[Float64], None]) -> None:
    height = np.zeros((120, 150, 80 if fault is standing else 10))
    fault(height)
    window = of_readings(height)
    assert crack_pieces(window, CONFIG) == []
    alone = CrackDetection(max_width_m=0.02, lowest_alone=True)
    assert [row.length_m > 0.3 for row in crack_pieces(window, alone)] == ([True] if fault is low_profile else [])
    height[:, 70, :8] -= 0.006  # a crack across it
    (crack,) = join_cracks(crack_pieces(of_readings(height), CONFIG), 0.0, CELL_M, CrackJoining())
    assert crack.ends == 2 and np.ptp(shapely.get_coordinates(crack.line)[:, 0]) < 0.02


def test_lowest_readings_lead_from_one_stretch_to_the_next() -> None:
    height = np.zeros((130, 120, 10))
    height[:, 60, :8] -= 0.006
    height[55:80, 60, 2:8] += 0.006  # two of ten readings show it
    window = of_readings(height)
    (whole,) = crack_pieces(window, CONFIG)
    parts = crack_pieces(window, CrackDetection(max_width_m=0.02, lowered_m=0.0))
    assert len(parts) == 2 and sum(p.length_m for p in parts) < whole.length_m - 10 * CELL_M
    assert whole.depth_sum_m2 / whole.measured_m == pytest.approx(0.006, rel=0.05)
    height[80:, 60, :8] = 0.0
    (end,) = crack_pieces(of_readings(height), CONFIG)  # leads nowhere
    assert end.length_m == pytest.approx(min(p.length_m for p in parts), abs=10 * CELL_M)


@pytest.mark.parametrize("count", [5, 25])
def test_a_level_floor_is_not_deeper_than_it_is(count: int) -> None:
    y, x = np.indices((110, 120))
    share = np.clip(1.2 - np.abs(x + 0.5 - 60 - 0.02 * (y - 55)), 0.0, 1.0)  # 1.4 cells wide, aslant
    hit = np.random.default_rng(4).random((110, 120, count)) < share[:, :, None]
    height = np.random.default_rng(5).normal(0.0, 0.0005, hit.shape) - 0.004 * hit
    (crack,) = join_cracks(crack_pieces(of_readings(height), CONFIG), 0.0, CELL_M, CrackJoining())
    assert crack.depth_mean_m == pytest.approx(0.004, rel=0.07)  # the lowest of 25 lies a millimetre lower


def test_heights_of_several_readings_below_are_no_impulses() -> None:
    raw = np.array([[299.99, 299.99, 300.01, 300.0005, np.nan]])
    lowest = LowestReadings(
        np.array([[0.001, 0.0, 0.001, 0.009, np.nan]], np.float32), np.array([[5, 2, 9, 9, 0]], np.uint16)
    )
    window = HeightWindow(raw, np.full(raw.shape, 300.0), CELL_M, 0.0003, lowest=lowest)
    np.testing.assert_array_equal(window.cleaned_m(), [[299.99, np.nan, np.nan, 300.0005, np.nan]])
    np.testing.assert_allclose(window.lowered_m(0.002), [[299.989, np.nan, np.nan, 299.9985, np.nan]], atol=1e-9)
    np.testing.assert_array_equal(window.lowered_m(0.0), window.cleaned_m())
    alone = replace(window, lowest=None)
    np.testing.assert_array_equal(alone.lowered_m(0.002), [[np.nan, np.nan, np.nan, 300.0005, np.nan]])


def test_where_no_lowest_reading_is_known_robust_heights_are_taken() -> None:
    window = cells_of(0.010, 0.010)
    nothing = LowestReadings(np.full(CELLS, np.nan, np.float32), np.zeros(CELLS, np.uint16))
    assert depths(replace(window, lowest=nothing)) == depths(replace(window, lowest=None))


def test_the_depth_changes_gradually_with_the_width() -> None:
    width = np.array([0.9, NARROW_CELLS, 3.0, WIDE_CELLS, 4.0, 1.0])
    bottom = np.array([0.01, 0.01, 0.01, 0.01, 0.01, np.nan])
    found = blended(bottom, np.full(6, 0.006), width)
    np.testing.assert_allclose(found, [0.01, 0.01, 0.008, 0.006, 0.006, 0.006])


def test_quantiles_along_a_line_are_numpys() -> None:
    draw = np.random.default_rng(5)
    grid = np.full((60, 70), np.nan)
    row, column = np.arange(5, 55), 10 + np.arange(50) // 2  # half a column a row
    values = draw.normal(0.0, 1.0, row.size)
    values[[7, 8, 20]] = np.nan
    grid[row, column] = values
    beside_row, beside_column = np.array([30]), np.array([27])  # 5 cells off the line: it is another's
    number = np.full(grid.shape, -1, np.int32)
    number[row, column] = np.arange(50)
    number[beside_row, beside_column] = 50
    angle = np.arctan2(2.0, 1.0)
    north, east = np.full(51, np.sin(angle)), np.full(51, np.cos(angle))
    level, found = draw.uniform(0.0, 1.0, 51), np.empty(51)
    every = [np.concatenate(pair) for pair in ((row, beside_row), (column, beside_column), (values, [99.0]))]
    quantiles_along(number, every[0], every[1], north, east, every[2], level, found)
    for k in range(50):
        stretch = grid[max(row[k] - 10, 0) : row[k] + 11, max(column[k] - 10, 0) : column[k] + 11]
        assert found[k] == pytest.approx(np.nanquantile(stretch, level[k]), abs=1e-12)
    values[:] = np.nan
    quantiles_along(number, row, column, north[:50], east[:50], values, level[:50], found[:50])
    assert np.isnan(found[:50]).all()
