"""Potholes: holes of known volume in slopes and ruts, whole and cut by tiles; kerbs and other forms that are none."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.model.distress import PotholeDetection, PotholeJoining
from roadscan.model.errors import ConfigError
from roadscan.surfaces.heights import HeightWindow
from roadscan.surfaces.potholes import halo_cells, join_potholes, pothole_pieces

CONFIG, JOINING = PotholeDetection(), PotholeJoining()
CELL_M = 0.01
NORTH, EAST = 71_000, 33_007


def road(depth_m=0.05, radius_m=0.2, halo=0, shape=(320, 330), extra=lambda x, y: 0.0):
    """Cells of 1 cm on a slope of 5 %, a hole with the form of a paraboloid at 1.61 m, 1.64 m."""
    y, x = (np.indices(shape) + 0.5) * CELL_M
    hole = depth_m * np.clip(1.0 - ((x - 1.61) ** 2 + (y - 1.64) ** 2) / radius_m**2, 0.0, 1.0)
    height = 560 + 0.04 * x - 0.03 * y - hole + extra(x, y) + np.random.default_rng(1).normal(0, 0.0005, shape)
    return HeightWindow(height, height, CELL_M, 0.0005, NORTH, EAST, halo)


def found(window):
    return join_potholes(pothole_pieces(window, CONFIG), JOINING)


def test_a_paraboloid_has_its_area_depth_and_volume():
    (one,) = found(road())
    seen = 1.0 - CONFIG.edge_depth_m / 0.05  # its outline runs at 8 mm
    assert one.area_m2 == pytest.approx(np.pi * 0.2**2 * seen, rel=0.05)
    assert one.depth_max_m == pytest.approx(0.05, abs=0.002)
    assert one.volume_m3 == pytest.approx(np.pi * 0.2**2 * 0.025 * (1 - (1 - seen) ** 2), rel=0.05)
    assert one.depth_mean_m == pytest.approx(one.volume_m3 / one.area_m2)
    assert one.outline.area == pytest.approx(one.area_m2)
    assert one.outline.centroid.coords[0] == pytest.approx((EAST * CELL_M + 1.61, NORTH * CELL_M + 1.64), abs=0.01)
    assert 0.3 < one.breadth_m <= one.length_m < 0.45


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_cells_without_a_reading_cost_no_volume(share):
    whole, window = found(road())[0], road()
    window.raw_m[np.random.default_rng(3).random(window.raw_m.shape) < share] = np.nan
    (one,) = found(window)
    assert one.volume_m3 == pytest.approx(whole.volume_m3, rel=0.03)
    assert one.area_m2 == pytest.approx(whole.area_m2, rel=0.05)


@pytest.mark.parametrize("radius_m", [0.06, 0.1, 0.3])
def test_small_and_large_holes(radius_m):
    (one,) = found(road(radius_m=radius_m))
    assert one.volume_m3 == pytest.approx(np.pi * radius_m**2 * 0.025 * (1 - 0.16**2), rel=0.15)


def test_in_a_rut():
    (one,) = found(road(extra=lambda x, y: -0.02 * np.clip(1 - ((x - 1.61) / 0.35) ** 2, 0, 1)))
    assert one.depth_max_m == pytest.approx(0.05, abs=0.006)


@pytest.mark.parametrize(
    "form",
    [
        lambda x, y: -0.03 * np.clip(1 - ((x - 1.6) / 0.4) ** 2, 0, 1),
        lambda x, y: 0.12 * (x > 1.6),
        lambda x, y: -0.014 * ((x - 1.6) ** 2 + (y - 1.6) ** 2 < 0.31**2),
        lambda x, y: -0.03 * (np.abs(x - 1.6) < 0.02),
        lambda x, y: -0.03 * np.abs(x - 1.6),
        lambda x, y: 0.12 * ((x > 2.3) | (y > 2.3)),
        lambda x, y: 0.12 * ((x - 0.6) ** 2 + (y - 1.6) ** 2 > 1.0),
    ],
    ids=["rut", "kerb", "sunk manhole", "trench", "crown", "corner of a parking bay", "bent kerb"],
)
def test_what_is_no_pothole(form):
    assert found(road(depth_m=0.0, extra=form)) == []


@pytest.mark.parametrize("halo", [80, halo_cells(CONFIG, CELL_M)], ids=["less than it may need", "full"])
def test_tiles_give_the_potholes_of_the_whole(halo):
    whole = road(halo=halo, shape=(352, 362), extra=lambda x, y: 0.01 * np.sin(3.0 * x) * np.cos(2.0 * y))
    whole.raw_m[np.random.default_rng(6).random(whole.raw_m.shape) < 0.1] = np.nan
    (expected,) = found(whole)
    cuts = [(slice(0, 164 + halo), slice(0, 161 + halo)), (slice(0, 164 + halo), slice(161 - halo, None))]
    cuts += [(slice(164 - halo, None), one[1]) for one in cuts]
    pieces = []
    for rows, columns in cuts:
        part = whole.raw_m[rows, columns]
        pieces += pothole_pieces(
            HeightWindow(part, part, CELL_M, 0.0005, NORTH + rows.start, EAST + columns.start, halo), CONFIG
        )
    assert len(pieces) == 4
    (one,) = join_potholes(pieces, JOINING)
    assert one.outline.equals(expected.outline)
    assert (one.area_m2, one.volume_m3) == pytest.approx((expected.area_m2, expected.volume_m3))
    assert one.depth_max_m == expected.depth_max_m
    assert one.pieces.tolist() == [0, 1, 2, 3]


def test_nothing_where_nothing_was_measured():
    empty = np.full((40, 40), np.nan)
    assert found(HeightWindow(empty, empty, CELL_M, 0.0005)) == []


def test_says_what_does_not_fit():
    with pytest.raises(ConfigError, match=r"edge_depth_m 0\.05 is above"):
        PotholeDetection.parse({"edge_depth_m": 0.05})
