"""Kernels of one loop each on tiny arrays, of all rooms but cells and simd, against NumPy and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer
from scipy import ndimage
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from roadscan.calibrate.kernels.surface_patches import place, splat
from roadscan.calibrate.kernels.ties import SIDE, tie_residuals, tie_rows
from roadscan.compute.kernel_options import read_only
from roadscan.compute.kernels.arrays import range_bounds
from roadscan.compute.kernels.curved_grid import accumulate_curved, thin_path
from roadscan.distress.kernels.crack_response import add_bend, deepen, fill_holes, line_sums, thin
from roadscan.georeference.kernels.segmentation import keep_road
from roadscan.georeference.kernels.tile_set import add_tile, block_ranges, empty, mark_zonotope, take, tile_set
from roadscan.georeference.kernels.timed_readings import between_ticks
from roadscan.navigation.inertial.kernels.strapdown import geodetic_of, gravity_at, turned_frame
from roadscan.pictures.kernels.lens import sample, take_better
from roadscan.surface.kernels.coarse import spline_profiles, sum_patches
from roadscan.surface.kernels.delaunay import flip_edges, grow, is_narrow, units, whitening
from roadscan.surface.kernels.ground import depths, grounds, highest, rim, slopes
from roadscan.surface.kernels.line_medians import keep_better, window_sums
from roadscan.surface.kernels.smoothing import choose_filters, descend


def test_spans_of_ranges() -> None:
    ranges = np.array([[0, 7, 3, 5, 9], [0, 0, 0, 0, 0]], np.uint16)
    low, high = np.zeros(2, np.uint16), np.zeros(2, np.uint16)
    range_bounds(ranges, low, high)
    assert (low.tolist(), high.tolist()) == ([3, 0], [9, 0])
    low, high = block_ranges(ranges, 2)
    assert low.tolist() == [[7, 3, 9], [0, 0, 0]] and high.tolist() == [[7, 5, 9], [0, 0, 0]]


def test_a_set_of_tiles() -> None:
    found = tile_set(4, 10.0)
    count = add_tile(-1, 5, 2.5, found, 0)
    count = add_tile(-1, 5, 1.0, found, count)
    count = add_tile(7, 8, 0.0, found, count)
    assert count == 2
    out = take(3, found, count, 0, np.zeros((1, 3), np.int64), np.zeros(1, np.int64))
    assert out[0][:2].tolist() == [[3, -1, 5], [3, 7, 8]] and out[1][:2].tolist() == [4, 1] and out[2] == 2
    assert not found.slots.any()  # emptied by taking
    for k in range(4):
        count = add_tile(k, 0, 1.0, found, k)
    assert add_tile(9, 9, 1.0, found, count) == -1
    empty(found, -1)
    assert not found.slots.any()


def test_a_zonotope_touches_the_tiles_that_its_points_lie_in() -> None:
    found = tile_set(64, 1.0)
    g = (2.0, 1.0, -0.5, 1.5, 0.0, 0.0, 0.0, 0.0)
    count = mark_zonotope(0.3, -0.2, g, 0.0, (0.0, 0.0, np.inf), found, 0)
    s, t = np.random.default_rng(0).uniform(-1, 1, (2, 20_000))
    inside = {(int(c), int(r)) for c, r in np.floor([0.3 + s * 2 - t * 0.5, -0.2 + s + t * 1.5]).T}
    marked = {tuple(tile) for tile in found.tiles[:count, :2].tolist()}
    assert marked >= inside and len(marked) < 36  # of the 6 × 6 tiles of its box


def test_readings_beside_the_road_fall_silent() -> None:
    kinds, ranges, counts = np.array([0, 7, 8, 2], np.uint8), np.array([5, 6, 7, 8], np.uint16), np.zeros(2, np.int64)
    keep_road(kinds, 7, ranges, counts)
    assert ranges.tolist() == [5, 0, 0, 8] and counts.tolist() == [1, 1]


def test_a_path_is_thinned_and_points_go_to_the_nearest_node() -> None:
    path, kept = np.column_stack([np.arange(0, 3, 0.3), np.zeros(10)]), np.zeros(10, bool)
    thin_path(path, 0.85, kept)
    assert np.flatnonzero(kept).tolist() == [0, 3, 6, 9]
    vertices, left = np.column_stack([np.arange(4.0), np.zeros(4)]), np.tile([0.0, 1.0], (4, 1))
    sums, counts = np.zeros((4, 3), np.int64), np.zeros((4, 3), np.int32)
    x, y = np.array([0.4, 0.6, 2.9, 1.0, 9.0]), np.array([0.0, 0.9, -1.1, 5.0, 0.0])
    height, hints = np.array([10, 20, 30, 40, 50], np.int32), np.zeros(5, np.int64)
    outside = accumulate_curved(x, y, height, hints, vertices, left, 1.0, -1.0, 1.0, sums, counts)
    assert outside == 2 and counts.sum() == 3
    assert (sums[0, 1], sums[1, 2], sums[3, 0]) == (10, 20, 30)


def test_sums_along_lines_and_how_deep_they_lie() -> None:
    heights = np.random.default_rng(1).integers(-99, 99, (9, 10)).astype(np.int32)
    line = np.array([[0, -1], [0, 0], [0, 1]])
    out = np.zeros((5, 6), np.int32)
    line_sums(heights, line, out)
    assert (out == ndimage.correlate(heights, np.ones((1, 3), np.int32), mode="constant")[2:7, 2:8]).all()
    depth, which = np.zeros((3, 4), np.int32), np.zeros((3, 4), np.int32)
    away = np.array([[0, 1], [0, 3]])
    deepen(heights, away, np.int32(5), np.int32(3), depth, which)
    for i in range(3):
        for j in range(4):
            a, b = heights[i + 3], j + 3
            left = a[b - 1] - min(max((a[b - 3] - a[b - 1]) >> 1, 0), 5)
            right = a[b + 1] - min(max((a[b + 3] - a[b + 1]) >> 1, 0), 5)
            expected = max(min(left, right) - a[b], 0)
            assert (depth[i, j], which[i, j]) == (expected, 3 if expected else 0)
    bend = np.full((3, 4), 100, np.int32)
    add_bend(heights, away[0], bend)
    assert (bend == 100 + np.abs(heights[3:6, 2:6] + heights[3:6, 4:8] - 2 * heights[3:6, 3:7])).all()


def test_holes_are_filled_ring_by_ring() -> None:
    heights = np.full((5, 5), 2.0)
    heights[1:4, 1:4] = np.nan
    heights[0, 0] = 7.0
    row, column = np.nonzero(np.isnan(heights))
    fill_holes(heights, row, column, 2)
    assert heights[1, 1] == 3.0 and heights[1, 2] == 2.0  # five known neighbours, one of which is 7
    assert heights[2, 2] == pytest.approx((3.0 + 7 * 2.0) / 8)


def test_better_medians_are_kept_and_windows_summed() -> None:
    f = np.float32
    least, best, own, way = np.array([1, 1], f), np.zeros(2), np.zeros(2, f), np.zeros(2, np.uint8)
    keep_better(np.array([2, 0.5], f), np.array([5.0, 6.0]), np.array([7, 8], f), np.uint8(3), least, best, own, way)
    assert (least.tolist(), best.tolist(), own.tolist(), way.tolist()) == ([1, 0.5], [0, 6], [0, 8], [0, 3])
    values = np.random.default_rng(2).integers(0, 9, (6, 7)).astype(f)
    across, total = np.zeros((6, 5), f), np.zeros((4, 5), f)
    window_sums(values, 1, across, total)
    assert (total == ndimage.correlate(values, np.ones((3, 3), f), mode="constant")[1:-1, 1:-1]).all()


def test_cells_go_by_their_neighbours() -> None:
    cells = np.zeros((5, 7), np.uint8)
    cells[2, 1:6] = 1
    row, column = np.nonzero(cells)
    ends = np.zeros((2, 256), np.uint8)
    ends[0, 1 << 2] = 1  # in the first half of a pass those whose only neighbour lies to the east
    thin(cells, row, column, ends, 2)
    assert np.flatnonzero(cells[2]).tolist() == [3, 4, 5]


@pytest.mark.parametrize(("latitude", "expected"), [(0.0, 9.7803253359), (90.0, 9.8321849378)])
def test_gravity_and_geodetic_coordinates(latitude: float, expected: float) -> None:
    """Normal gravity of WGS 84 at equator and pole (NIMA TR8350.2); PROJ's coordinates."""
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    at = np.array(to_ecef.transform(11.0, latitude, 0.0))
    found = np.zeros((1, 5))
    assert gravity_at(*at.tolist())[0] == pytest.approx(expected, abs=1e-8)
    geodetic_of(at[None], found)
    angles = np.radians([latitude, latitude, 11.0, 11.0])
    np.testing.assert_allclose(
        found[0, :4], [np.sin(angles[0]), np.cos(angles[1]), np.sin(angles[2]), np.cos(angles[3])], atol=1e-12
    )
    assert abs(found[0, 4]) < 1e-6


def test_a_frame_that_turns_evenly() -> None:
    turn, push = np.tile([0.0, 0.0, 0.1], (10, 1)), np.tile([1.0, 0.0, 0.0], (10, 1))
    quaternions, velocities = np.zeros((11, 4)), np.zeros((11, 3))
    turned_frame(turn, push, quaternions, velocities)
    np.testing.assert_allclose(
        Rotation.from_quat(quaternions, scalar_first=True).as_rotvec()[:, 2], 0.1 * np.arange(11), atol=1e-12
    )
    middles = 0.05 + 0.1 * np.arange(10)
    np.testing.assert_allclose(velocities[-1], [np.cos(middles).sum(), np.sin(middles).sum(), 0.0], atol=1e-12)


def test_readings_are_spread_over_four_cells() -> None:
    mass, height, carrier = np.zeros((4, 5)), np.zeros((4, 5)), np.full((4, 5), -1, np.int32)
    places = np.array([[10.25, 20.5, 3.0], [0.0, 0.0, 1.0], [11.0, 21.0, np.nan]])
    splat(places, np.array([7, 8, 9], np.int32), 10.0, 20.0, 0.5, mass, height, carrier)
    assert (mass[1, 0], mass[1, 1]) == (0.5, 0.5) and mass.sum() == 1.0
    np.testing.assert_array_equal(height, 3.0 * mass)
    assert carrier.max() == 7 and (carrier >= 0).sum() == 1


def test_readings_are_placed_by_the_pose_that_is_named() -> None:
    rng = np.random.default_rng(8)
    point, pose, position = rng.normal(size=(5, 3)), np.array([1, 0, 1, 1, 0], np.int32), rng.normal(size=(2, 3))
    rotation, own, lever = Rotation.random(2, random_state=1), Rotation.random(random_state=2), rng.normal(size=3)
    out = np.zeros((5, 3))
    place(point, pose, position, rotation.as_matrix(), own.as_matrix(), lever, out)
    np.testing.assert_allclose(out, position[pose] + rotation[pose].apply(own.apply(point) + lever), rtol=1e-12)


def test_ties_are_differences_of_places() -> None:
    rng = np.random.default_rng(4)
    n = 6
    body = np.array([0, 1, 0, 1, 0, 1])
    sides, places = [], []
    mountings = []
    for _ in range(2):
        point, position = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
        rotation = Rotation.random(n, random_state=5).as_matrix()
        own, lever = Rotation.random(random_state=6), rng.normal(size=3)
        sides.append((body, point, position, rotation))
        mountings.append((tuple(own.as_matrix().ravel()), tuple(lever), 0.0, (0.0, 0.0, 0.0)))
        places.append(position + np.einsum("nij,nj->ni", rotation, own.apply(point) + lever))
    shift, turn = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    weight = rng.normal(size=(n, 2, 3))
    residual, rows = np.zeros((n, 2)), np.zeros((n, 2, 2 * SIDE))
    ends = sides[0], mountings[0], sides[1], mountings[1]
    tie_residuals(*ends, shift, turn, weight, False, residual)
    np.testing.assert_allclose(residual, np.einsum("nka,na->nk", weight, places[0] - places[1]), rtol=1e-12)
    again = np.zeros((n, 2))
    tie_rows(*ends, shift, turn, weight, False, np.full(n, 4.0), again, rows)
    np.testing.assert_allclose(again, 2.0 * residual, rtol=1e-12)
    moved = (*mountings[0][:1], tuple(np.array(mountings[0][1]) + np.array([1e-6, 0, 0])), *mountings[0][2:])
    after = np.zeros((n, 2))
    tie_residuals(sides[0], moved, *ends[2:], shift, turn, weight, False, after)
    np.testing.assert_allclose(rows[:, :, 0], 2.0 * (after - residual) / 1e-6, atol=1e-6)


@pytest.mark.slow
def test_profiles_through_splines() -> None:
    """A plane stays a plane."""
    across = np.tile(np.arange(-1.0, 1.0001, 0.02), (4, 1))
    height, classes = 5.0 + 0.1 * across, np.zeros(across.shape, np.uint8)
    surface, origin = np.zeros((4, 21)), np.zeros((4, 21), np.uint8)
    spline_profiles(across, height, classes, 1, -10, 0.1, 0.3, 0.3, surface, origin)
    offsets = 0.1 * np.arange(-10, 11)
    np.testing.assert_allclose(surface, np.tile(5.0 + 0.1 * offsets, (4, 1)), atol=1e-12)


def test_sums_of_patches() -> None:
    rng = np.random.default_rng(5)
    surface, along = rng.normal(size=(3, 4)), np.array([0.2, 0.7, 1.3])
    surface[1, 2] = np.nan
    sums = np.zeros((2, 2, 10))
    sum_patches(along, surface, 0, 0.5, 1.0, 2, 0, 0, sums)
    own = surface[:2, 2:]
    seen = ~np.isnan(own)
    x, y = (np.broadcast_to(a, own.shape)[seen] for a in (along[:2, None], 0.5 * np.array([2, 3])))
    z = own[seen]
    expected = [z.size, x.sum(), y.sum(), z.sum(), x @ x, x @ y, y @ y, x @ z, y @ z, z @ z]
    np.testing.assert_allclose(sums[0, 1], expected, rtol=1e-12)


def test_flipped_edges_are_delaunays() -> None:
    points = np.array([[0, 0], [400, 50], [900, 0], [400, 400]])
    triangles, across = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[-1, 1, -1], [-1, -1, 0]])
    points[1] = [400, -50]
    assert flip_edges(points[:, 0].copy(), points[:, 1].copy(), triangles, across) == 1
    expected = {tuple(sorted(t)) for t in Delaunay(points).simplices.tolist()}
    assert {tuple(sorted(t)) for t in triangles.tolist()} == expected


@pytest.mark.slow
def test_filters_of_a_plane_act_nowhere_else_than_inside() -> None:
    i, j = np.mgrid[0:9, 0:10].astype(float)
    surface, measured = 3.0 + 0.01 * i - 0.02 * j, np.ones((9, 10))
    chosen, own, residual = (np.zeros((5, 6), np.float32) for _ in range(3))
    choose_filters(surface, measured, 1e-6, chosen, own, residual)
    assert (chosen == 5).all() and np.abs(residual).max() < 1e-6
    np.testing.assert_allclose(own, 28 / 56, rtol=1e-6)  # its neighbours have 28 parts of 56
    correction = np.zeros((13, 14), np.float32)
    wide = [np.pad(a, 4).astype(np.float32) for a in (chosen, own, residual)]
    zero, after = np.zeros_like(correction), correction.copy()
    descend(correction, *wide, zero, zero, zero, np.zeros((5, 7, 10), np.float32), after)
    assert not after.any()


@pytest.mark.slow
def test_ground_about_a_hole() -> None:
    heights = np.tile(0.01 * np.arange(21.0)[:, None], (1, 21))
    out = np.zeros((1, 2))
    slopes(heights, np.array([10]), np.array([10]), 9, np.array([[3, 0], [0, 3]]), 0.3, out)
    np.testing.assert_allclose(out, [[0.1, 0.0]], atol=0.001)
    assert highest(np.array([1.0, 2.0, np.nan, 5.0, 7.0])) == 6.0 and highest(np.full(4, np.nan)) == -np.inf
    assert rim(np.array([-0.1, -0.05, 0.0, 0.0, 0.0, 0.0]), 0.0, 0.004) == 2
    flat = np.zeros((15, 15))
    flat[6:9, 6:9] = -0.05
    steps = np.arange(1, 8)[:, None] * np.array([[[1, 0]], [[-1, 0]], [[0, 1]], [[0, -1]]]).reshape(4, 1, 2)
    depth = np.zeros((15, 15))
    depths(flat, np.zeros((15, 15, 2)), steps, 0.01, 0.02, depth)
    assert np.isnan(depth[0]).all() and depth[7, 7] == pytest.approx(0.05)
    ground = np.zeros(1)
    grounds(flat, np.zeros((15, 15, 2)), steps, np.array([7]), np.array([7]), ground)
    assert ground[0] == pytest.approx(0.0, abs=1e-12)


def test_the_nearer_picture_shows_a_point_and_its_colour_is_bilinear() -> None:
    point, best = np.array([[0.0, 0.0, 5.0]]), np.full(1, np.inf)
    chosen, pixel = np.full(1, -1, np.int32), np.zeros((1, 2))
    lens = np.array([100.0, 100, 10, 8, 0, 0, 0, 0, 0, 9, 21, 17, 0, *[0.0] * 6])
    limits, up, hidden = np.array([1e4, 0.0, 0.0]), np.array([0.0, 0.0, -1.0]), np.zeros((0, 0), bool)
    for number, eye in ((4, [0.0, 0.0, 0.0]), (5, [0.1, 0.0, 1.0]), (6, [0.0, 0.0, -3.0])):
        take_better(point, np.array(eye), np.eye(3), up, lens, limits, hidden, number, best, chosen, pixel)
    assert chosen[0] == 5 and pixel[0].tolist() == pytest.approx([10 - 100 * 0.1 / 4, 8.0])
    picture = np.zeros((17, 21, 3), np.uint8)
    picture[8, 8] = [200, 100, 0]
    colour = np.zeros((1, 3), np.uint8)
    sample(picture, pixel, colour)
    assert colour[0].tolist() == [100, 50, 0]  # half way between columns 7 and 8


def test_rings_of_a_triangulation() -> None:
    """A vertex with six neighbours around it."""
    angle = np.radians(60.0 * np.arange(6))
    x, y = np.append(0.0, 2 * np.cos(angle)), np.append(0.0, np.sin(angle))
    starts, neighbours = np.array([0, 6, *range(9, 27, 3)]), np.empty(24, np.int64)
    neighbours[:6] = np.arange(1, 7)
    for k in range(6):
        neighbours[6 + 3 * k : 9 + 3 * k] = [0, 1 + (k + 1) % 6, 1 + (k - 1) % 6]
    ring, seen = np.zeros(8, np.int64), np.full(7, -1)
    seen[0] = 0
    assert grow(starts, neighbours, ring, 0, 1, seen, 0) == 7 and sorted(ring[:7]) == list(range(7))
    assert not is_narrow(x, y, 0, ring[1:], 6) and is_narrow(x, 0.01 * y, 0, ring[1:], 6)
    white, axes = np.zeros(3), np.zeros(3)
    assert whitening(x, y, 0, ring[1:], 6, white)
    mean = np.cov(np.stack([x[1:], y[1:]]), bias=True)
    factor = np.array([[white[0], 0.0], white[1:]])
    np.testing.assert_allclose(factor @ factor.T, mean, atol=1e-12)
    units(x, y, 0, ring[1:], 6, axes)
    scale = np.array([[axes[0], 0.0], axes[1:]])
    np.testing.assert_allclose(scale @ scale.T, np.trace(mean) / 2 * 18.0 / 6 * np.eye(2), rtol=0.02, atol=1e-12)


def test_places_between_ticks_are_linear() -> None:
    at = np.random.default_rng(5).normal(size=(5, 3))
    number = np.array([0, 1, 2, 2, 3, 4])  # no epoch needs tick 73
    epochs = np.array([700, 705, 710, 719, 749, 740], np.int64)
    found = np.empty((3, epochs.size))
    between_ticks(read_only(epochs), 10, 70, number, at, found)
    for axis in range(3):
        np.testing.assert_allclose(found[axis], np.interp(epochs, [700, 710, 720, 740, 750], at[:, axis]))
