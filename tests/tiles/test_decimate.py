"""One point a square: on the plane that the road is, whatever lies on it; and the rule, by NumPy alone."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.compute.kernel_options import read_only
from roadscan.core.errors import ConfigError
from roadscan.core.grid import TileGrid, TileId
from roadscan.tiles.cells import TileCells
from roadscan.tiles.kernels.decimate import Squares, decimate_cells
from roadscan.tiles.kernels.decimate_2x2 import decimate_2x2
from roadscan.tiles.kernels.pyramid import Cells
from roadscan.tiles.products.model_las import FLOOR_UM, cells_per_square, decimate, patch_cells

EDGE = 40  # cells of 5 mm: a tile of 20 cm
CELL_M = 0.005


def cells_of(height_m, keep, seed=0):
    """Cells of a (rows, columns) image of heights, south first, where `keep` is True."""
    rng = np.random.default_rng(seed)
    row, column = np.nonzero(keep)
    n = row.size
    height, ones = height_m[row, column], np.ones(n, np.uint16)
    return TileCells(
        TileId(3, 4), EDGE, column.astype(np.uint16), row.astype(np.uint16), rng.integers(1, 40, n).astype(np.uint32),
        height, height, height, height, np.zeros(n, np.float32), rng.uniform(0, 60_000, n).astype(np.float32),
        ones, np.arange(n + 1, dtype=np.int32), ones,
    )  # fmt: skip


def plane(east, north, rng, noise_m=0.0002):
    y, x = (np.indices((EDGE, EDGE)) + 0.5) * CELL_M
    return 412.5 + east * x + north * y + rng.normal(0.0, noise_m, (EDGE, EDGE))


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (0.025, -0.06), (-0.08, 0.12)])
def test_stones_and_cracks_do_not_show_on_any_slope(east, north):
    rng = np.random.default_rng(5)
    height = plane(east, north, rng)
    lot = rng.random((EDGE, EDGE))
    height[lot < 0.10] += 0.008
    height[lot > 0.95] -= 0.015
    height[:, 31:33] -= 0.012  # a crack along the lane
    found = decimate(cells_of(height, np.ones((EDGE, EDGE), bool)), 20, CELL_M)
    assert len(found) == 4 and found.sloped.all()
    truth = 412.5 + east * (found.column + 0.5) * 0.1 + north * (found.row + 0.5) * 0.1
    assert np.abs(found.height_m - truth).max() < 0.0002
    naive = height.reshape(2, 20, 2, 20).mean(axis=(1, 3)).ravel()  # what the rule is for
    assert np.abs(naive - truth).max() > 0.0008


def by_numpy(cells, side, patch):
    """The rule as the docstring states it, square by square."""
    height = np.full((EDGE, EDGE), np.nan)
    height[cells.row, cells.column] = cells.height_robust_m
    light, count = np.zeros((EDGE, EDGE)), np.zeros((EDGE, EDGE), int)
    light[cells.row, cells.column], count[cells.row, cells.column] = cells.intensity_mean, cells.count

    def slope(part):
        lag = patch // 2
        while lag:
            steps = (part[:, lag:] - part[:, :-lag]).ravel()
            steps = np.sort(steps[~np.isnan(steps)])
            if 8 * steps.size >= patch * patch:
                return steps[(steps.size - 1) // 2] / lag, True
            lag //= 2
        return 0.0, False

    out = []
    y, x = np.indices((side, side)) - (side - 1) / 2
    for row in range(EDGE // side):
        for column in range(EDGE // side):
            own = np.s_[row * side : (row + 1) * side, column * side : (column + 1) * side]
            r0, c0 = row * side // patch * patch, column * side // patch * patch
            part = height[r0 : r0 + patch, c0 : c0 + patch]
            if np.isnan(height[own]).all():
                continue
            (east, known_e), (north, known_n) = slope(part), slope(part.T)
            flat = height[own] - east * x - north * y
            there = ~np.isnan(flat)
            values = np.sort(flat[there])
            median = values[(values.size - 1) // 2]
            mad = np.sort(np.abs(values - median))[(values.size - 1) // 2]
            with np.errstate(invalid="ignore"):
                counts = np.abs(flat - median) <= max(3 * 1.4826 * mad, 0.001)
            out.append(
                (column, row, flat[counts].mean(), light[own][counts].mean(), counts.sum(), count[own][counts].sum(),
                 known_e and known_n)
            )  # fmt: skip
    return [np.array(c) for c in zip(*out, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "cell_m"), [(4, CELL_M), (20, CELL_M), (8, CELL_M), (40, CELL_M), (2, 0.05), (1, 0.05)]
)
@pytest.mark.parametrize("cover", [1.0, 0.3])
def test_rule_is_the_one_stated(side, cell_m, cover):
    rng = np.random.default_rng(side)
    height = plane(0.03, -0.05, rng, noise_m=0.002)
    height += rng.choice([0.0, 0.008, -0.015], (EDGE, EDGE), p=[0.85, 0.1, 0.05])
    keep = rng.random((EDGE, EDGE)) < cover
    keep[:, 27:] = False  # the strip ends inside a square
    keep[:3] = False
    cells = cells_of(height, keep, side)
    patch = patch_cells(side, EDGE, cell_m)
    found, told = decimate(cells, side, cell_m), by_numpy(cells, side, patch)
    assert np.array_equal(found.column, told[0]) and np.array_equal(found.row, told[1])
    # whole micrometres can put a cell on the other side of the limit: a few squares may have one cell more or less
    same = found.cells == told[4]
    assert np.count_nonzero(~same) <= max(1, 0.03 * same.size)
    assert np.abs(found.height_m - told[2])[same].max() < 3e-6
    assert found.intensity[same] == pytest.approx(told[3][same], abs=0.02)
    assert np.array_equal(found.points[same], told[5][same])
    assert np.array_equal(found.sloped, told[6])


def test_patches_are_ten_centimetres_or_the_square():
    assert patch_cells(20, 2000, 0.005) == 20
    assert patch_cells(4, 2000, 0.005) == 20
    assert patch_cells(8, 2000, 0.005) == 40  # 24 cells do not divide the tile
    assert patch_cells(200, 2000, 0.005) == 200
    assert patch_cells(2, 200, 0.05) == 2


def test_heights_far_apart_do_not_overflow():
    height = plane(0.0, 0.0, np.random.default_rng(1))
    height[0, 0], height[5, 5] = 412.0 + 9_000.0, -430.0
    found = decimate(cells_of(height, np.ones((EDGE, EDGE), bool)), 20, CELL_M)
    assert np.abs(found.height_m - 412.5).max() < 0.001


def test_no_cells_no_squares():
    assert len(decimate(cells_of(np.zeros((EDGE, EDGE)), np.zeros((EDGE, EDGE), bool)), 20, CELL_M)) == 0


def test_a_spacing_that_does_not_fit_is_refused():
    assert cells_per_square(0.02, TileGrid(10.0, 0.005), "x") == 4
    for spacing in (0.004, 0.007, 0.03):
        with pytest.raises(ConfigError, match=f"model.spacing_m = {spacing:g}"):
            cells_per_square(spacing, TileGrid(10.0, 0.005), "model.spacing_m")


def test_squares_of_four_cells_are_to_the_bit_those_of_any_size():
    rng = np.random.default_rng(3)
    height = plane(0.03, -0.05, rng, noise_m=0.002) + rng.choice([0.0, 0.02, -400.0], (EDGE, EDGE), p=[0.8, 0.1, 0.1])
    for cover in (1.0, 0.5, 0.1):
        cells = cells_of(height, rng.random((EDGE, EDGE)) < cover, 5)
        room = len(cells)
        kinds = np.uint16, np.uint16, np.float64, np.float32, np.uint32, np.uint32, np.bool_
        fours, squares = (Squares(*(np.empty(room, kind) for kind in kinds)) for _ in range(2))
        height_m = read_only(cells.height_robust_m)
        own = Cells(cells.column, cells.row, height_m, cells.intensity_mean, cells.count)
        starts = np.searchsorted(cells.row, np.arange(EDGE + 1))
        written = decimate_2x2(own, starts, 412.0, FLOOR_UM, fours)
        assert written == decimate_cells(own, 412.0, EDGE, 2, 2, FLOOR_UM, squares) > 0
        for one, other in zip(fours, squares, strict=True):
            assert np.array_equal(one[:written], other[:written])
