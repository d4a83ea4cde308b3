"""Cracks: the simulator's road with known cracks, drawn forms that are none, and shapely and SciPy as judges."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import shapely
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.distress.crack_network import bridges, join_cracks
from roadscan.distress.crack_response import _boxes, _thinned, crack_response_of
from roadscan.distress.cracks import CrackPiece, crack_pieces, halo_cells, needed_part, sharpened
from roadscan.distress.kernels.cross_sections import cross_sections
from roadscan.distress.settings import CrackDetection, CrackJoining
from roadscan.distress.skeleton_graph import SkeletonGraph, pruned
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.surface.heights import HeightWindow, LowestReadings

CONFIG, JOINING = CrackDetection(), CrackJoining()
CELL_M = 0.0025
NOISE_M = 0.0003
SEEN_FROM = 58
"""Cells along the border of a window in which nothing is found."""
ROAD = {"roughness": {"iso_class": "C"}, "texture": {"mpd_mm": 0.8}, "cross_slope": 0.03, "ruts": [{"offset_m": 0.9}]}
BRANCHED = [[(10.1, 0.65), (10.4, 0.9), (10.85, 1.05)], [(10.4, 0.9), (10.3, 1.25)]]


def road(lines=(), width_m=0.005, depth_m=0.003, cells=(340, 340), fine=2, seed=1, **more):
    """Heights of a patch from station 10 and offset 0.55 on, each the mean of four readings; its truth as lines."""
    cracks = [{"points_m": line, "width_m": width_m, "depth_m": depth_m} for line in lines]
    scene = Scene(seed=7).changed(map={"azimuth_deg": 0.0}, road={**ROAD, "cracks": cracks, **more})
    north = round((scene.map.northing_m + 10.0) / CELL_M)
    east = round((scene.map.easting_m + 0.55) / CELL_M)
    y, x = ((k + (np.arange(n * fine) + 0.5) / fine) * CELL_M for k, n in zip((north, east), cells, strict=True))
    height = Surface(scene).height_m(*np.broadcast_arrays(x[None], y[:, None]))
    rng = np.random.default_rng(seed)
    height += rng.normal(0.0, NOISE_M, height.shape)
    height = height.reshape(cells[0], fine, cells[1], fine).mean(axis=(1, 3))
    height[rng.random(cells) < 0.03] = np.nan
    corner = scene.map.easting_m, scene.map.northing_m
    truth = shapely.MultiLineString([[(corner[0] + o, corner[1] + s) for s, o in one] for one in lines])
    edge = SEEN_FROM * CELL_M
    truth = truth & shapely.box(
        east * CELL_M + edge,
        north * CELL_M + edge,
        (east + cells[1]) * CELL_M - edge,
        (north + cells[0]) * CELL_M - edge,
    )
    return HeightWindow(height, height, CELL_M, NOISE_M, north, east), truth


def drawn(height_m, cell_m=0.005, seed=2, halo=0, first=(0, 0)):
    noise = np.random.default_rng(seed).normal(0.0, 0.0002, height_m.shape)
    return HeightWindow(height_m + noise, height_m + noise, cell_m, 0.0002, *first, halo)


def joined(window, lane=0.0):
    return join_cracks(crack_pieces(window, CONFIG), lane, window.cell_m, JOINING)


def scores(found, truth, tolerance_m):
    """Share of what was found that is true, and of what is true that was found."""
    places = shapely.points(np.concatenate([shapely.get_coordinates(c.line) for c in found]))
    true = [line.interpolate(s) for line in truth.geoms for s in np.arange(0.0, line.length, CELL_M)]
    return tuple(
        float((shapely.distance(a, b) <= tolerance_m).mean())
        for a, b in ((places, truth), (true, shapely.union_all([c.line for c in found])))
    )


@pytest.fixture(scope="module")
def branched():
    window, truth = road(BRANCHED)
    return window, truth, joined(window)


def test_a_crack_of_5_mm_by_3_mm_is_found_where_it_is(branched):
    _, truth, found = branched
    assert min(scores(found, truth, 2 * CELL_M)) > 0.95
    assert sum(c.length_m for c in found) == pytest.approx(truth.length, rel=0.03)


def test_its_figures_are_those_of_the_simulator(branched):
    one, branch = sorted(branched[2], key=lambda c: -c.length_m)
    for crack in (one, branch):
        assert crack.depth_mean_m == pytest.approx(0.003, rel=0.1)
        assert crack.width_mean_m == pytest.approx(0.541 * 0.005, abs=2 * CELL_M)  # (1 - u²)² = 1/2
        assert crack.depth_max_m >= crack.depth_mean_m and crack.width_max_m >= crack.width_mean_m
        assert crack.area_m2 == pytest.approx(crack.length_m * crack.width_mean_m)
    assert (one.junctions, one.ends, one.polygons) == (1, 2, 0)
    assert (branch.kind, branch.junctions, branch.ends, branch.network) == ("transverse", 1, 1, one.network)


def test_a_clean_road_with_stains_has_none():
    window, _ = road(
        stains=[{"station_m": 10.4, "offset_m": 1.0}], tyre_marks=[{"points_m": [(10.0, 0.9), (11.0, 0.9)]}]
    )
    assert crack_pieces(window, CONFIG) == []


def test_deep_and_wide_cracks_keep_their_depth_and_width():
    window, truth = road(BRANCHED[:1], 0.02, 0.015)
    (one,) = joined(window)
    assert one.depth_mean_m == pytest.approx(0.015, rel=0.05)
    assert one.width_mean_m == pytest.approx(0.541 * 0.02, abs=CELL_M / 2)
    assert one.length_m == pytest.approx(truth.length, rel=0.04)


def step(x):
    return 0.12 * np.clip(x - 150, 0, 2) / 2


@pytest.mark.parametrize(
    "form",
    [
        lambda x, y: step(x) + 0.0002 * np.abs(x - 150),
        lambda x, y: 0.010 * np.clip((x - 150) / 6, 0, 1),
        lambda x, y: 0.0004 * np.abs(x - 150),
        lambda x, y: -0.05 * np.clip(1 - ((x - 150) ** 2 + (y - 150) ** 2) / 40**2, 0, 1),
        lambda x, y: -0.008 * ((x % 60 - 30) ** 2 + (y % 60 - 30) ** 2 < 16),
        lambda x, y: 0.004 * (np.abs(x - 150) < 3),
    ],
    ids=["kerb", "edge of a patch", "rut", "pothole", "lost stones", "ridge"],
)
def test_what_is_no_crack(form):
    y, x = np.indices((300, 300))
    assert joined(drawn(560 + 0.0001 * x + form(x, y))) == []


def test_types_follow_the_lane():
    y, _ = np.indices((240, 240))
    window = drawn(-0.006 * (np.abs(y - 120) < 1.5))
    ((along,), (across,), (aslant,)) = (joined(window, lane=np.radians(lane)) for lane in (90.0, 0.0, -45.0))
    assert (along.kind, across.kind, aslant.kind) == ("longitudinal", "transverse", "diagonal")
    assert along.azimuth_deg == pytest.approx(90.0, abs=1.0)
    assert (along.lane_angle_deg, across.lane_angle_deg) == pytest.approx((0.0, 90.0), abs=1.0)
    assert across.transverse_m == pytest.approx(across.length_m) and across.longitudinal_m == 0.0


def net(halo=0, first=(7_000, 9_000), half=1.8):
    """A net of cracks, 0.25 m apart, aslant, with holes in the data."""
    y, x = np.indices((500, 520))
    distance = np.minimum(np.abs((0.96 * x + 0.28 * y) % 50 - 25), np.abs((0.96 * y - 0.28 * x) % 50 - 25))
    height = 560 - 0.008 * np.clip(1 - (distance / half) ** 2, 0, 1)
    height[np.hypot(x - 260, y - 250) > 170] = 560.0
    height[200:205, 300:330] = np.nan
    return drawn(height, halo=halo, first=first)


def test_a_net_is_an_alligator_and_closes_the_polygons_that_shapely_closes():
    window = net()
    pieces = crack_pieces(window, CONFIG)
    (one,) = join_cracks(pieces, 0.0, 0.005, JOINING)
    assert one.kind == "alligator"
    closed = shapely.polygonize([shapely.LineString(p.line_m) for p in pieces])
    assert one.polygons == len(closed.geoms) > 20
    assert one.length_m == pytest.approx(sum(p.length_m for p in pieces))
    assert one.depth_mean_m == pytest.approx(0.008, rel=0.1)


def with_lowest(window):
    """The same with lowest readings of two to nine a cell, below the heights by up to 0.5 mm.

    In stripes they alone show the cracks.
    """
    rng = np.random.default_rng(6)
    drop = rng.uniform(0.0, 0.0005, window.raw_m.shape).astype(np.float32)
    hidden = (window.raw_m < 559.999) & (np.arange(len(drop)) % 55 < 14)[:, None]
    raw = np.where(hidden, 560.0, window.raw_m)
    drop += (raw - window.raw_m).astype(np.float32)
    return replace(
        window, raw_m=raw, height_m=raw, lowest=LowestReadings(drop, rng.integers(2, 10, drop.shape, np.uint16))
    )


def edges_of(pieces):
    return {frozenset(e) for p in pieces for e in itertools.pairwise(map(tuple, p.line_m.tolist()))}


def test_tiles_give_the_bits_and_the_cracks_of_the_whole():
    config = CrackDetection(max_width_m=0.02)
    halo = halo_cells(config, 0.005)
    whole = with_lowest(net(halo, half=1.2))
    expected = crack_pieces(whole, config)
    assert crack_response_of(whole, config).bridge.sum() > 100
    found = []
    for rows in (slice(0, 2 * halo + 61), slice(61, None)):
        for columns in (slice(0, 2 * halo + 50), slice(50, None)):
            cut, low = whole.raw_m[rows, columns], whole.lowest.part(rows, columns)
            first = whole.first_row + (rows.start or 0), whole.first_column + (columns.start or 0)
            found += crack_pieces(HeightWindow(cut, cut, 0.005, 0.0002, *first, halo, lowest=low), config)
    assert len(found) > len(expected) > 10
    assert sum(len(p.line_m) - 1 for p in found) == len(edges_of(found))  # none twice
    assert edges_of(found) == edges_of(expected)
    figures = [
        (c.kind, c.junctions, c.ends, c.polygons, c.depth_max_m, c.width_max_m, pytest.approx(c.length_m))
        for c in join_cracks(expected, 0.0, 0.005, JOINING)
    ]
    again = join_cracks(found, 0.0, 0.005, JOINING)
    assert [
        (c.kind, c.junctions, c.ends, c.polygons, c.depth_max_m, c.width_max_m, c.length_m) for c in again
    ] == figures


def test_what_is_empty_is_not_looked_at_and_changes_nothing():
    config = CrackDetection(max_width_m=0.02)
    y, x = np.indices((500, 520))
    height = 560 - 0.008 * (np.abs((0.96 * x + 0.28 * y) % 50 - 25) < 1.5)
    height[(y < 210 + 0.1 * x) | (y > 300 + 0.1 * x) | (x < 180) | (x > 400)] = np.nan  # a road that ends
    whole = drawn(height, first=(7_000, 9_000), halo=halo_cells(config, 0.005))
    part = needed_part(whole, config)
    assert part.raw_m.shape < (260, 320)
    low = part.first_row - whole.first_row, part.first_column - whole.first_column
    own = tuple(slice(a, a + n) for a, n in zip(low, part.raw_m.shape, strict=True))
    expected, found = crack_response_of(whole, config), crack_response_of(part, config)
    assert found.skeleton.sum() > 300 and expected.skeleton.sum() == found.skeleton.sum()
    assert (expected.skeleton[own] == found.skeleton).all()
    for name in ("depth_m", "direction", "flank"):
        assert (getattr(expected, name)[own] == getattr(found, name))[found.skeleton].all()


def test_lowest_readings_are_asked_near_cracks_only():
    cells = np.zeros((700, 900), bool)
    cells[100:140, 50] = cells[600, 700:830] = True
    boxes = _boxes(cells, 20, 30)
    assert sorted((r.start, r.stop, c.start, c.stop) for r, c in boxes) == [(80, 160, 30, 71), (580, 621, 680, 850)]
    cells[::100, ::100] = True
    assert _boxes(cells, 20, 30) == [(slice(0, 621), slice(0, 850))]


def piece(start, end):
    """A straight piece of 1 cm cells, from (row, column) to (row, column)."""
    a, b = np.array(start[::-1]) * 0.01, np.array(end[::-1]) * 0.01
    length = float(np.hypot(*(b - a)))
    line = a + np.linspace(0, 1, max(int(length / 0.02), 2))[:, None] * (b - a)
    return CrackPiece(line, start, end, length, length, 0.004 * length, 0.004, 0.01 * length, 0.01)


def kinds(pieces, lane=0.0):
    """Type, length (cm) and network of the cracks that pieces make, for a lane to the north."""
    found = join_cracks(pieces, lane, 0.01, JOINING)
    assert sorted(k for c in found for k in c.pieces.tolist()) == list(range(len(pieces)))  # each in one
    return sorted((c.kind, round(100 * c.length_m), c.network) for c in found)


def test_cracks_that_meet_are_parts_of_a_network():
    along = [piece((0, 100), (90, 100)), piece((90, 100), (92, 101)), piece((92, 101), (200, 100))]  # a tile's border
    across = [piece((90, 100), (90, 20)), piece((92, 101), (92, 190))]
    assert kinds(along + across) == [("longitudinal", 200, 1), ("transverse", 169, 1)]
    spur = piece((92, 101), (84, 107))  # too short for a crack of its own
    assert kinds([*along, *across, spur]) == [("longitudinal", 210, 1), ("transverse", 169, 1)]
    apart = [piece((0, 900), (0, 960))]
    assert kinds(along + across + apart) == [("longitudinal", 200, 1), ("transverse", 60, 2), ("transverse", 169, 1)]
    assert kinds(along + across, float("nan")) == [("unknown", 369, 1)]
    (part,) = join_cracks(along, [np.pi / 2, np.pi / 2, float("nan")], 0.01, JOINING)  # nobody drove by its end
    assert part.kind == "transverse" and part.lane_angle_deg == pytest.approx(90.0, abs=2.0)
    assert np.isnan(join_cracks(along, float("nan"), 0.01, JOINING)[0].lane_angle_deg)


def test_a_crack_keeps_its_type_where_branches_leave_it():
    stations = range(0, 200, 40)
    wandering = [piece((s, 100 + 12 * (k % 2)), (s + 40, 112 - 12 * (k % 2))) for k, s in enumerate(stations)]
    steep = piece((200, 112), (222, 133))  # 44°, and goes on
    sides = [piece((s, 100 + 12 * (k % 2)), (s, 160)) for k, s in enumerate(stations) if k]
    found = kinds([*wandering, steep, *sides])
    assert [f[0] for f in found] == ["longitudinal"] + 4 * ["transverse"]
    assert found[0][1] == pytest.approx(5 * 41.8 + 30.4, abs=2)


def test_a_net_is_parted_from_the_crack_that_runs_into_it():
    posts = [(r, c) for r in (0, 30, 60) for c in (0, 30, 60)]
    mesh = [piece((r, c), (r, c + 30)) for r, c in posts if c < 60]
    mesh += [piece((r, c), (r + 30, c)) for r, c in posts if r < 60]
    dead_end = piece((30, 30), (42, 44))
    into = [piece((60, 30), (160, 30)), piece((160, 30), (300, 32))]
    far = [piece(a, b) for a, b in (((300, 32), (340, 32)), ((340, 32), (340, 70)), ((340, 70), (300, 32)))]
    found = kinds([*mesh, dead_end, *into, *far])
    assert ("alligator", 378, 1) in found
    assert kinds([*mesh, piece((0, 60), (0, 105))]) == [("alligator", 405, 1)]  # its fringe
    assert kinds([*mesh, piece((0, 60), (0, 115))]) == [("alligator", 360, 1), ("transverse", 55, 1)]
    for ends in (((0, 60), (0, 115)), ((0, 115), (0, 60))):  # as tiles store it: a straight line has two vertices
        stored = replace(piece(*ends), line_m=piece(*ends).line_m[[0, -1]])
        assert kinds([*mesh, stored]) == [("alligator", 360, 1), ("transverse", 55, 1)]
    assert [f[0] for f in found if f[0] != "alligator"] == ["longitudinal"]  # one polygon is no net
    (net,) = [c for c in join_cracks([*mesh, *into], 0.0, 0.01, JOINING) if c.kind == "alligator"]
    assert net.polygons == len(shapely.polygonize([shapely.LineString(p.line_m) for p in mesh]).geoms) == 4


def test_gaps_between_ends_that_face_one_another_are_closed():
    one, other = piece((0, 0), (100, 4)), piece((108, 4), (200, 8))
    (crack,) = join_cracks([one, other], 0.0, 0.01, JOINING)
    assert crack.length_m == pytest.approx(one.length_m + 0.08 + other.length_m, abs=0.002)
    assert crack.pieces.tolist() == [0, 1] and len(crack.line.geoms) == 1
    assert crack.depth_mean_m == pytest.approx(0.01) and crack.measured_share == pytest.approx(0.96, abs=0.005)
    far, beside, across = piece((112, 4), (200, 8)), piece((104, 14), (200, 23)), piece((105, 0), (105, 60))
    for another in (far, beside, across):
        assert len(join_cracks([one, another], 0.0, 0.01, JOINING)) == 2
    assert len(join_cracks([one, other], 0.0, 0.01, CrackJoining(bridge_m=0.0))) == 2
    third = piece((109, 5), (150, 30))  # farther from the end: only one goes on
    assert len(join_cracks([third, one, other], 0.0, 0.01, JOINING)) == 2


def test_depth_is_judged_crack_by_crack():
    deep = [piece((0, 50), (50, 50)), piece((50, 50), (90, 50))]
    shallow = [piece((50, 50), (50, 250)), piece((50, 250), (50, 300))]
    shallow = [replace(one, depth_sum_m2=0.0006 * one.length_m, depth_max_m=0.0009) for one in shallow]
    assert sum(p.depth_sum_m2 for p in deep + shallow) > 0.001 * sum(p.length_m for p in deep + shallow)
    (one,) = join_cracks(deep + shallow, 0.0, 0.01, JOINING)
    assert (one.kind, one.depth_mean_m) == ("longitudinal", pytest.approx(0.01)) and one.pieces.tolist() == [0, 1]
    deep = [replace(one, depth_sum_m2=0.0015 * one.length_m) for one in deep]  # the mean of all is below 1 mm
    assert [c.kind for c in join_cracks(deep + shallow, 0.0, 0.01, JOINING)] == ["longitudinal"]
    assert len(join_cracks(deep + shallow, 0.0, 0.01, CrackJoining(min_depth_m=0.0005))) == 2
    assert join_cracks(shallow, 0.0, 0.01, JOINING) == []


def test_bridges_are_those_without_which_a_network_falls_apart():
    rng = np.random.default_rng(8)
    for _ in range(20):
        ends = rng.integers(0, 14, (16, 2))
        found = bridges(ends)
        sets = lambda rows: connected_components(  # noqa: E731
            coo_array((np.ones(len(rows)), tuple(rows.T)), shape=(14, 14)), directed=False
        )[0]
        expected = [sets(np.delete(ends, k, axis=0)) > sets(ends) for k in range(16)]
        assert found.tolist() == expected


def test_short_pieces_count_when_they_join():
    assert join_cracks([piece((500, 0), (500, 8))], 0.0, 0.01, JOINING) == []
    (one,) = join_cracks([piece((500, 8), (500, 16)), piece((500, 0), (500, 8))], 0.0, 0.01, JOINING)
    assert one.length_m == pytest.approx(0.16) and one.line.length == pytest.approx(0.16)
    assert sorted(one.pieces.tolist()) == [0, 1]


def test_thinning_keeps_the_topology_that_scipy_counts():
    rng = np.random.default_rng(4)
    for _ in range(5):
        blobs = np.zeros((90, 90), np.uint8)
        for _ in range(12):
            (a, b), (c, d) = rng.integers(10, 80, (2, 2))
            t = np.linspace(0, 1, 200)
            i, j = np.rint(a + t * (c - a)).astype(int), np.rint(b + t * (d - b)).astype(int)
            blobs[i, j] = blobs[i + 1, j] = blobs[i, j + 1] = 1
        thin = _thinned(blobs, 12)
        eight = np.ones((3, 3))
        assert label(thin, eight)[1] == label(blobs, eight)[1]
        assert label(~thin)[1] == label(blobs == 0)[1]
        assert distance_transform_edt(thin).max() < 2.0
        assert not (thin & (blobs == 0)).any()


def test_the_end_of_a_crack_that_frays_goes_on_as_the_longer_branch():
    cells = np.zeros((40, 40), bool)
    cells[20, 3:31] = True
    cells[21:24, 25] = True  # five cells on, three to the side
    graph = pruned(cells, 8)
    assert (graph.degree == 1).sum() == 2
    assert sorted(zip(graph.row.tolist(), graph.column.tolist(), strict=True)) == [(20, c) for c in range(3, 31)]


def test_gaps_do_not_count_as_what_has_no_cross_section():
    parts = [piece((10 * k, 100), (10 * k + 5, 100)) for k in range(9)]
    parts = [replace(p, measured_m=0.7 * p.length_m) for p in parts]
    (one,) = join_cracks(parts, 0.0, 0.01, JOINING)
    assert one.length_m == pytest.approx(0.85) and one.measured_share == pytest.approx(0.7 * 0.45 / 0.85)
    assert join_cracks([replace(p, measured_m=0.5 * p.length_m) for p in parts], 0.0, 0.01, JOINING) == []


def test_spurs_go_and_branches_stay():
    cells = np.zeros((40, 40), bool)
    cells[20, 3:37] = True
    cells[21:24, 10] = True
    cells[21:35, 25] = True
    graph = pruned(cells, 5)
    assert graph.row.size == cells.sum() - 3
    assert (graph.degree == 1).sum() == 3
    paths = list(graph.paths(np.ones(len(graph.edges), bool)))
    assert sum(map(len, paths)) - len(paths) == len(graph.edges)
    ring = np.zeros((9, 9), bool)
    ring[2, 3:6] = ring[6, 3:6] = ring[3:6, 2] = ring[3:6, 6] = True
    (path,) = SkeletonGraph.of(ring).paths(np.ones(12, bool))
    assert path[0] == path[-1] and len(path) == 13


@pytest.mark.parametrize("width_cells", [1.3, 2.0, 5.0])
def test_widths_and_depths_seen_through_cells_are_sharpened(width_cells):
    north, east, fine = np.sin(0.35), np.cos(0.35), 8
    y, x = (np.indices((40 * fine, 60 * fine)) + 0.5) / fine
    right = (x - 30.2) * north - (y - 20.3) * east
    form = 560.0 + 0.01 * right - 0.01 * np.exp(-4 * np.log(2) * (right / width_cells) ** 2)
    cells = form.reshape(40, fine, 60, fine).mean(axis=(1, 3))
    row, column, flank = np.array([20, 21]), np.array([30, 33]), np.full(2, 8)
    out = np.empty((2, 5))
    cross_sections(cells, row, column, np.full(2, north), np.full(2, east), flank, 13, out)
    width, depth = sharpened(out[:, 1], out[:, 0])
    np.testing.assert_allclose(width, width_cells, rtol=0.12)
    np.testing.assert_allclose(depth, 0.01, rtol=0.08)
    np.testing.assert_allclose(out[:, 3], out[:, 0] - 0.01 * 10, atol=0.03)
    truth = (30.2 - column - 0.5) * north - (20.3 - row - 0.5) * east
    np.testing.assert_allclose(out[:, 2], truth, atol=0.15)


def test_nothing_where_nothing_was_measured():
    assert crack_pieces(drawn(np.full((60, 60), np.nan)), CONFIG) == []
    assert crack_pieces(drawn(np.full((400, 400), np.nan)), CONFIG) == []
    assert join_cracks([], 0.0, 0.005, JOINING) == []


def test_says_what_does_not_fit():
    with pytest.raises(RoadscanError, match="halo of 5; expected cells that are not halo"):
        HeightWindow(np.zeros((10, 20)), np.zeros((10, 20)), 0.005, 0.0005, 0, 0, 5)
    with pytest.raises(RoadscanError, match="expected two grids"):
        HeightWindow(np.zeros((10, 20)), np.zeros((10, 21)), 0.005, 0.0005)
    with pytest.raises(ConfigError, match="weak_sigmas 9 is above"):
        CrackDetection.parse({"weak_sigmas": 9.0})
