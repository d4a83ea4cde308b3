"""Outlines of plates, heads of signals and areas of cells, against what they were made from."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kinds.landscape_area import area_of, components
from roadscan.assets.upright.plate_outlines import outline_of


def inside(shape: str, points: np.ndarray) -> np.ndarray:
    """Which points lie in a shape of 0.8 m about the origin."""
    x, y = points.T
    if shape == "round":
        return np.hypot(x, y) <= 0.4
    if shape == "octagon":
        return (np.maximum(np.abs(x), np.abs(y)) <= 0.4) & (np.abs(x) + np.abs(y) <= 0.4 * np.sqrt(2.0))
    if shape == "diamond":
        return np.abs(x) + np.abs(y) <= 0.4
    if shape == "triangle":
        return (y >= -0.2 * np.sqrt(3.0)) & (np.abs(x) <= (0.2 * np.sqrt(3.0) - y) / np.sqrt(3.0))
    wide, tall = {"square": (0.4, 0.4), "rectangle": (0.4, 0.3)}[shape]
    return (np.abs(x) <= wide) & (np.abs(y) <= tall)


@pytest.mark.parametrize("shape", ["square", "rectangle", "round", "octagon", "diamond", "triangle"])
def test_shape_place_and_size_of_a_plate(shape: str) -> None:
    points = np.random.default_rng(6).uniform(-0.5, 0.5, (4000, 2))
    points = points[inside(shape, points)] + [0.3, -0.2]
    found = outline_of(points)
    assert found.shape == shape
    np.testing.assert_allclose(found.middle, [0.3, -0.2], atol=0.02)
    assert abs(found.width_m - 0.8) < 0.04
    assert abs(found.height_m - {"rectangle": 0.6, "triangle": 0.4 * np.sqrt(3.0)}.get(shape, 0.8)) < 0.04


def test_areas_are_cells_that_share_a_side() -> None:
    column, row = np.array([4, 5, 5, 9, 6]), np.array([7, 7, 8, 8, 9])
    parts = components(column, row)
    assert [sorted(zip(column[p].tolist(), row[p].tolist(), strict=True)) for p in parts] == [
        [(4, 7), (5, 7), (5, 8)], [(9, 8)], [(6, 9)],
    ]  # fmt: skip
    area = area_of(column[parts[0]], row[parts[0]], 0.5)
    assert area.area == pytest.approx(0.75) and area.bounds == pytest.approx((2.0, 3.5, 3.0, 4.5))
