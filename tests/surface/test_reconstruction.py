"""Smoothing a window strip by strip; heights before smoothing that are seen farther around a tile."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.core.grid import TileGrid, TileId
from roadscan.surface import reconstruction
from roadscan.surface.reconstruction import Patch, SurfaceGrid, surface_of
from roadscan.surface.settings import SurfaceConfig, SurfaceSmoothing
from roadscan.surface.smoothing import halo_cells, smooth_surface


def test_strips_have_the_bits_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SurfaceSmoothing(tolerance=0.1)
    draw = np.random.default_rng(3)
    height = 300.0 + draw.normal(0.0, 0.0005, (630, 40))
    height[:, 18:21] -= 0.01
    height[draw.random(height.shape) < 0.05] = np.nan
    window = np.full((650, 60), np.nan)
    window[7:637, 9:49] = height
    rows = []

    def counted(part: np.ndarray, settings: SurfaceSmoothing) -> np.ndarray:
        rows.append(len(part))
        return smooth_surface(part, settings)

    monkeypatch.setattr(reconstruction, "smooth_surface", counted)
    monkeypatch.setattr(reconstruction, "_CELLS_SMOOTHED", 1)
    found = reconstruction.smoothed_where_known(window, config)
    assert len(rows) > 2 and max(rows) <= 4 * halo_cells(config)
    expected = np.full(window.shape, np.nan)
    expected[7:637, 9:49] = smooth_surface(height, config)
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("smooth", [True, False])
def test_what_is_seen_before_smoothing_changes_nothing_after_it(smooth: bool) -> None:
    config = SurfaceConfig(method="cells", sigma_m=0.001, smooth=smooth, fill_m=0.2)
    tile, tiles = TileId(3, 5), TileGrid(4.0, 0.05)
    grids = [SurfaceGrid(tiles, config, around_m=m) for m in (0.0, 9.0)]
    wide = grids[1].window(tile)
    draw = np.random.default_rng(4)
    raw = np.where(draw.random((wide.rows, wide.columns)) < 0.1, np.nan, draw.normal(300.0, 0.001, (wide.rows,) * 2))
    found = []
    for grid in grids:
        window = grid.window(tile)
        own = slice(window.first_row - wide.first_row, window.first_row - wide.first_row + window.rows)
        height = raw[own, own]
        patch = Patch(height, np.where(np.isnan(height), 0, 1).astype(np.uint8), height.astype(np.float32))
        wanted = np.ones(height.shape, bool)
        wanted[:, : window.columns // 2] = False
        found.append([surface_of(tile, patch, grid, mask) for mask in (None, wanted)])
    for near, far in zip(*found, strict=True):
        assert near.window == far.window and near.halo == far.halo == 23
        for name in ("raw_m", "height_m", "origin", "intensity"):
            assert getattr(near, name).tobytes() == getattr(far, name).tobytes()
        assert near.around[1] == 23 and far.around[1] == 180
        around, halo = far.around
        assert around[157:-157, 157:-157].tobytes() == far.raw_m.tobytes()
        assert around.shape == (80 + 2 * halo, 80 + 2 * halo)
    inner = slice(wide.rows // 2 - 220, wide.rows // 2 + 220)
    assert found[1][0].around[0].tobytes() == raw[inner, inner].tobytes()
    assert np.isnan(found[1][1].around[0][:, :219]).all()
