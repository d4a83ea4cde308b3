"""Potholes: holes of known volume in slopes, in ruts and beside kerbs, whole and cut by tiles; forms that are none."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from roadscan.core.errors import ConfigError
from roadscan.distress.potholes import around_cells, join_potholes, pothole_pieces
from roadscan.distress.settings import PotholeDetection, PotholeJoining
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.surface.heights import HeightWindow

CONFIG, JOINING = PotholeDetection(), PotholeJoining()
CELL_M = 0.01
NORTH, EAST = 71_000, 33_007


def road(depth_m=0.05, radius_m=0.2, halo=0, shape=(320, 330), extra=lambda x, y: 0.0):
    """Cells of 1 cm on a slope of 5 %, a hole with the form of a paraboloid at 1.61 m, 1.64 m."""
    y, x = (np.indices(shape) + 0.5) * CELL_M
    hole = depth_m * np.clip(1.0 - ((x - 1.61) ** 2 + (y - 1.64) ** 2) / radius_m**2, 0.0, 1.0)
    height = 560 + 0.04 * x - 0.03 * y - hole + extra(x, y) + np.random.default_rng(1).normal(0, 0.0005, shape)
    return HeightWindow(height, height, CELL_M, 0.0005, NORTH, EAST, halo)


def found(window, config=CONFIG):
    return join_potholes(pothole_pieces(window, config), JOINING)


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


def bowl(x, y, across_m, depth_m=0.05):
    """A hole with a flat floor in the middle of a window of 4.4 m, the simulator's form."""
    return depth_m * (1 - np.clip(np.hypot((x - 2.2) / across_m[0], (y - 2.2) / across_m[1]) / 0.5, 0, 1) ** 4) ** 2


@pytest.mark.parametrize("across_m", [(0.8, 0.8), (1.0, 1.0), (1.5, 1.5), (0.6, 2.0)], ids=str)
def test_wide_holes_have_their_volume(across_m):
    y, x = (np.indices((440, 440)) + 0.5) * CELL_M
    window = road(0.0, shape=x.shape, extra=lambda x, y: -bowl(x, y, across_m))
    (one,) = found(window)
    depth = bowl(x, y, across_m)
    assert one.volume_m3 == pytest.approx(depth[depth >= CONFIG.edge_depth_m].sum() * CELL_M**2, rel=0.02)
    assert one.area_m2 == pytest.approx((depth >= CONFIG.edge_depth_m).sum() * CELL_M**2, rel=0.02)
    assert one.length_m == pytest.approx(max(across_m) * 0.88, rel=0.04)


@pytest.mark.parametrize("across_m", [0.4, 1.5])
def test_the_simulators_potholes_in_an_uneven_road(across_m):
    hole = {"station_m": 12.2, "offset_m": 1.7, "radius_m": across_m / 2, "depth_m": 0.06}
    scene = Scene(seed=5).changed(map={"azimuth_deg": 0.0}, road={"roughness": {"iso_class": "C"}, "potholes": [hole]})
    first = [round(v / CELL_M) for v in (scene.map.northing_m + 10.0, scene.map.easting_m - 0.5)]
    y, x = ((k + np.arange(440) + 0.5) * CELL_M for k in first)
    height = Surface(scene).height_m(*np.broadcast_arrays(x[None], y[:, None]))
    (one,) = found(HeightWindow(height, height, CELL_M, 0.0005, *first))
    assert one.volume_m3 == pytest.approx(np.pi * across_m**2 / 4 * 0.06 * 8 / 15, rel=0.08)


@pytest.mark.parametrize("kerb_m", [0.12, 0.03])
@pytest.mark.parametrize("beyond_m", [-0.1, 0.0, 0.05, 0.15])
def test_a_hole_beside_a_kerb_has_its_volume(beyond_m, kerb_m):
    y, x = (np.indices((440, 440)) + 0.5) * CELL_M
    edge = 2.4 + beyond_m + 0.2 * (y - 2.2)  # aslant the grid; in the first case it cuts the hole
    depth = np.where(x > edge, 0.0, bowl(x, y, (0.4, 0.4)))
    (one,) = found(road(0.0, shape=x.shape, extra=lambda x, y: np.where(x > edge, kerb_m, -depth)))
    assert one.volume_m3 == pytest.approx(depth[depth >= CONFIG.edge_depth_m].sum() * CELL_M**2, rel=0.03)
    assert one.length_m < 0.4


def test_on_a_crown():
    (one,) = found(road(shape=(440, 440), extra=lambda x, y: -0.02 * np.abs(x - 1.61)))
    assert one.volume_m3 == pytest.approx(np.pi * 0.2**2 * 0.025 * (1 - 0.16**2), rel=0.12)


def test_in_a_rut():
    (one,) = found(road(extra=lambda x, y: -0.02 * np.clip(1 - ((x - 1.61) / 0.35) ** 2, 0, 1)))
    assert one.depth_max_m == pytest.approx(0.05, abs=0.008)


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
        lambda x, y: -0.3 * (x > 1.6),
        lambda x, y: 0.015 * np.cos(2 * np.pi * np.clip(np.hypot(x - 1.6, y - 1.6), 0, 1.5) / 1.5 - np.pi),
    ],
    ids=["rut", "kerb", "sunk manhole", "trench", "crown", "corner of a parking bay", "bent kerb", "edge", "hollow"],
)
def test_what_is_no_pothole(form):
    assert found(road(depth_m=0.0, extra=form)) == []


def test_tiles_give_the_potholes_of_the_whole():
    config = PotholeDetection(max_size_m=0.4)
    halo = around_cells(config, CELL_M)
    whole = road(halo=halo, shape=(322, 331), extra=lambda x, y: 0.01 * np.sin(3.0 * x) * np.cos(2.0 * y))
    whole.raw_m[np.random.default_rng(6).random(whole.raw_m.shape) < 0.1] = np.nan
    (expected,) = found(whole, config)
    cuts = [(slice(0, 164 + halo), slice(0, 161 + halo)), (slice(0, 164 + halo), slice(161 - halo, None))]
    cuts += [(slice(164 - halo, None), one[1]) for one in cuts]
    pieces = []
    for rows, columns in cuts:
        part = whole.raw_m[rows, columns]
        pieces += pothole_pieces(
            HeightWindow(part, part, CELL_M, 0.0005, NORTH + rows.start, EAST + columns.start, halo), config
        )
    assert len(pieces) == 4
    (one,) = join_potholes(pieces, JOINING)
    assert one.outline.equals(expected.outline)
    assert (one.area_m2, one.volume_m3) == pytest.approx((expected.area_m2, expected.volume_m3))
    assert one.depth_max_m == expected.depth_max_m
    assert one.pieces.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("seed", range(4))
def test_a_tile_sees_the_bits_of_the_whole_and_needs_no_more(seed):
    config = PotholeDetection(max_size_m=0.3)
    halo = around_cells(config, CELL_M)
    rng = np.random.default_rng(seed)
    rough = np.kron(rng.normal(0.0, 0.02, (60, 62)), np.ones((6, 6))) + rng.normal(0.0, 0.001, (360, 372))
    rough[:, 300:] += 0.1
    rough[rng.random(rough.shape) < 0.2] = np.nan
    rough[200:260, 40:90] = np.nan
    whole = HeightWindow(rough, rough, CELL_M, 0.001, NORTH, EAST, halo)
    part = whole.part((rng.integers(8), 2 * halo + 21), (rng.integers(9), 2 * halo + 30))
    alone = HeightWindow(part.raw_m, part.raw_m, CELL_M, 0.001, part.first_row, part.first_column, halo)
    inner = [slice(halo, n - halo) for n in alone.raw_m.shape]
    west, south, east, north = np.r_[alone.map_m(*(i.start for i in inner)), alone.map_m(*(i.stop for i in inner))]
    outlines = [one.outline for one in pothole_pieces(whole, config)]
    cut = shapely.union_all(outlines) & shapely.box(west, south, east, north)
    found_alone = shapely.union_all([one.outline for one in pothole_pieces(alone, config)])
    assert found_alone.symmetric_difference(cut).area < 1e-9 < cut.area


def test_nothing_where_nothing_was_measured():
    empty = np.full((40, 40), np.nan)
    assert found(HeightWindow(empty, empty, CELL_M, 0.0005)) == []


def test_says_what_does_not_fit():
    with pytest.raises(ConfigError, match=r"edge_depth_m 0\.05 is above"):
        PotholeDetection.parse({"edge_depth_m": 0.05})


@pytest.mark.parametrize("depth_m", [0.03, 0.06, 0.1])
@pytest.mark.parametrize("form", ["paraboloid", "simulator", "upright walls"])
def test_the_area_inside_the_rim_has_a_sigma_that_holds(form, depth_m):
    """The outline runs at 8 mm: of smooth holes it encloses 14 to 28 % less than the rim."""
    y, x = (np.indices((440, 440)) + 0.5) * CELL_M
    ratio = np.clip(np.hypot(x - 2.2, y - 2.2) / 0.4, 0.0, 1.0)
    shape = {"paraboloid": 1 - ratio**2, "simulator": (1 - ratio**4) ** 2, "upright walls": 1.0 * (ratio < 1.0)}[form]
    (one,) = found(road(0.0, shape=x.shape, extra=lambda x, y: -depth_m * shape))
    true = np.pi * 0.4**2
    assert abs(one.rim_area_m2 - true) <= 2.0 * one.sigma_rim_area_m2 + 0.02 * true
    assert abs(one.rim_area_m2 / true - 1.0) <= {"paraboloid": 0.05, "simulator": 0.17, "upright walls": 0.03}[form]
    assert abs(one.rim_area_m2 - true) <= abs(one.area_m2 - true) + 0.03 * true
