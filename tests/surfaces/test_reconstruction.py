"""Smoothing a window strip by strip."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.model.surface_smoothing import SurfaceSmoothing
from roadscan.surfaces import reconstruction
from roadscan.surfaces.smoothing import halo_cells, smooth_surface


def test_strips_have_the_bits_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SurfaceSmoothing(tolerance=0.1)
    draw = np.random.default_rng(3)
    height = 300.0 + draw.normal(0.0, 0.0005, (330, 40))
    height[:, 18:21] -= 0.01
    height[draw.random(height.shape) < 0.05] = np.nan
    window = np.full((350, 60), np.nan)
    window[7:337, 9:49] = height
    rows = []

    def counted(part: np.ndarray, settings: SurfaceSmoothing) -> np.ndarray:
        rows.append(len(part))
        return smooth_surface(part, settings)

    monkeypatch.setattr(reconstruction, "smooth_surface", counted)
    monkeypatch.setattr(reconstruction, "_CELLS_SMOOTHED", 1)
    found = reconstruction.smoothed_where_known(window, config)
    assert len(rows) > 2 and max(rows) <= 4 * halo_cells(config)
    expected = np.full(window.shape, np.nan)
    expected[7:337, 9:49] = smooth_surface(height, config)
    assert found.tobytes() == expected.tobytes()
