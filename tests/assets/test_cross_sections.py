"""Cross-sections of ground whose heights are known everywhere."""

from __future__ import annotations

import numpy as np

from roadscan.assets.scene import GroundModel
from roadscan.assets.tasks.sections import cross_sections, stations


def tilted(x_min_m: float = 0.0, seen: bool = True) -> GroundModel:
    """A plane that rises by 2 cm a metre to the east and 1 cm to the north, 20 m by 30 m."""
    x, y = np.meshgrid(x_min_m + (np.arange(80) + 0.5) * 0.25, (np.arange(120) + 0.5) * 0.25)
    height = (100.0 + 0.02 * x + 0.01 * y).astype(np.float32)
    mask = np.full(height.shape, seen)
    mask[:, 40:48] = False
    return GroundModel(x_min_m, 0.0, 0.25, height, mask, np.where(mask, 0.003, 0.05).astype(np.float32))


def test_heights_lie_to_the_right_of_the_line() -> None:
    line = np.array([[9.0, 2.0], [9.0, 12.0], [9.0, 28.0]])  # to the north: the right is the east
    offset = np.arange(-3.0, 8.01, 0.5)
    found = cross_sections(tilted(), line, np.array([0.0, 7.3, 26.0, 30.0]), offset)
    assert np.allclose(found.x_m[1], 9.0 + offset) and np.allclose(found.y_m[1], 9.3)
    expected = 100.0 + 0.02 * found.x_m + 0.01 * found.y_m
    np.testing.assert_allclose(found.height_m[:3], expected[:3], atol=1e-4)
    assert np.isnan(found.height_m[3]).all() and not found.seen[3].any()  # beyond the line's end
    hidden = (found.x_m[1] >= 10.0) & (found.x_m[1] < 12.0)
    assert np.array_equal(found.seen[1], ~hidden)
    np.testing.assert_allclose(found.sigma_m[1], np.where(hidden, 0.05, 0.003), atol=1e-6)


def test_what_lies_off_the_raster_is_not_known_until_a_neighbour_tells_it() -> None:
    line = np.array([[15.0, 2.0], [15.0, 28.0]])
    at, offset = np.array([5.0]), np.arange(-2.0, 10.01, 1.0)
    west, east = cross_sections(tilted(), line, at, offset), cross_sections(tilted(18.0), line, at, offset)
    assert np.array_equal(np.isnan(west.height_m[0]), west.x_m[0] >= 20.0)
    both = west.joined(east)
    inner = np.abs(both.x_m - 20.0) > 0.2  # half a cell at the edge of a raster has its last height
    np.testing.assert_allclose(both.height_m[inner], (100.0 + 0.02 * both.x_m + 0.01 * both.y_m)[inner], atol=1e-4)
    unseen = cross_sections(tilted(seen=False), line, at, offset)
    assert np.array_equal(unseen.joined(west).seen, west.seen)


def test_sections_turn_with_the_line() -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])  # a bend to the left
    place, right = stations(line, np.array([5.0, 10.0, 15.0]))
    np.testing.assert_allclose(place, [[5.0, 0.0], [10.0, 0.0], [10.0, 5.0]])
    np.testing.assert_allclose(right, [[0.0, -1.0], [np.sqrt(0.5), -np.sqrt(0.5)], [1.0, 0.0]], atol=1e-12)
