"""Kernels of upright things on tiny arrays, against NumPy, SciPy and geometry."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.kernels.buckets import count_buckets, fill_buckets
from roadscan.assets.kernels.columns import mark_corridor
from roadscan.assets.kernels.low_returns import low_moments
from roadscan.assets.kernels.shafts import fill_slices, fit_cylinder, radius_across, slices_above_one_another
from roadscan.assets.kernels.upright_voxels import (
    beside_line,
    gather_moments,
    grow_regions,
    in_stretches,
    near_middles,
    passing_lines,
    region_ranges,
    thin_elements,
)


def test_slices_count_returns() -> None:
    rng = np.random.default_rng(1)
    x, y, above = rng.uniform(0, 2, 300), rng.uniform(0, 2, 300), rng.uniform(-0.5, 1.5, 300)
    above[7] = np.nan
    above = above.astype(np.float32)
    counts, cell = np.zeros((3, 20, 20), np.uint16), np.empty(300, np.int64)
    fill_slices(x, y, above, np.array([0.0, 0.0, 0.2]), 0.1, 0.4, counts, cell)
    inside = (above >= 0.2) & (above < 1.4)
    expected, _ = np.histogramdd(
        np.column_stack([above, y, x])[inside], bins=(3, 20, 20), range=((0.2, 1.4), (0, 2), (0, 2))
    )
    assert (counts == expected).all() and (np.flatnonzero(cell >= 0) == np.flatnonzero(inside)).all()


def test_slices_above_one_another() -> None:
    row, column = np.array([5, 5, 6, 15, 5]), np.array([5, 6, 5, 15, 9])
    level = np.array([0, 1, 4, 30, 7])
    scores = np.empty(5, np.int64)
    slices_above_one_another(row, column, level, 2, 3, np.zeros((20, 20), np.int64), scores)
    assert scores.tolist() == [3, 3, 3, 0, 0]


def test_returns_by_cell() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-1, 5, 200), rng.uniform(-1, 4, 200)
    counted = rng.random(200) < 0.8
    starts = np.zeros(13, np.int64)
    count_buckets(x, y, counted, np.zeros(2), 1.0, (3, 4), starts)
    order = np.empty(int(starts[-1]), np.int64)
    fill_buckets(x, y, counted, np.zeros(2), 1.0, (3, 4), starts.copy(), order)
    cell = np.where(counted & (x >= 0) & (y >= 0) & (x < 4) & (y < 3), np.floor(y) * 4 + np.floor(x), -1)
    for k in range(12):
        assert order[starts[k] : starts[k + 1]].tolist() == np.flatnonzero(cell == k).tolist()


def test_a_wall_becomes_one_region_and_a_bush_none() -> None:
    rng = np.random.default_rng(3)
    t = rng.uniform(0, 4, 2000)
    wall = np.column_stack([1 + 0.8 * t, 1 + 0.6 * t, rng.uniform(0, 1.5, 2000)])
    wall[:, :2] += rng.normal(0, 0.01, 2000)[:, None] * [-0.6, 0.8]
    bush = rng.uniform([4, 0, 0], [5.5, 1.5, 1.5], (2000, 3))
    x, y, above = np.concatenate([wall, bush]).T.copy()
    index = np.full((3, 24, 24), -1, np.int32)
    moments, voxel = np.empty((4000, 10)), np.empty(4000, np.int32)
    found = gather_moments(x, y, above.astype(np.float32), np.zeros(3), np.array([0.25, 0.5]), index, moments, voxel)
    assert (voxel >= 0).all() and moments[:found, 0].sum() == 4000
    own = voxel == voxel[0]
    corner = moments[voxel[0], [9, 8]] * 0.25
    np.testing.assert_allclose(moments[voxel[0], 1:3], [(x[own] - corner[0]).sum(), (y[own] - corner[1]).sum()])
    elements = np.zeros((found, 6))
    good = thin_elements(index, moments, 0.25, np.array([6.0, 0.12, 0.06, 0.35]), elements)
    assert good == int(elements[:, 0].sum()) > 30
    np.testing.assert_allclose(np.abs(elements[elements[:, 0] > 0] @ [0, 0, 0, 0.8, 0.6, 0]), 1.0, atol=0.05)
    region, stack, second = np.zeros(found, np.int32), np.empty((found, 4), np.int32), np.full(found, -1, np.int32)
    number = grow_regions(index, second, elements, np.cos(0.35), 0.12, np.array([1, 1]), region, stack)
    assert number == 1
    members, starts = np.empty(found, np.int64), np.empty(3, np.int64)
    region_ranges(region, members, starts)
    assert starts.tolist() == [0, int((region == 0).sum()), found]
    assert sorted(members.tolist()) == list(range(found)) and (region[members[starts[1] :]] == 1).all()
    assert (region[voxel[2000:]] == 0).mean() > 0.95 and (region[voxel[:2000]] == 1).mean() > 0.9


def test_sight_lines_through_a_rectangle() -> None:
    rectangle, bands = np.array([[0.0, 5.0, 4.0, 5.0]]), np.array([[[1.0, 2.0], [2.5, 9.0]]])
    ends = np.array([[2.0, 10.0, 1.0], [2.0, 10.0, 4.0], [2.0, 4.0, 1.5], [9.0, 10.0, 1.5], [2.0, 5.1, 1.5]])
    passed = np.zeros((1, 4, 2), np.int64)
    passing_lines(*ends.T.copy(), np.full(5, 2.0), np.zeros(5), np.full(5, 2.0), rectangle, bands, 7.0, passed)
    assert passed.tolist() == [
        [[0, 0], [0, 0], [1, 1], [0, 0]]
    ]  # at 1.5 and 3 m; the others end before it, beside it, or close behind it


@pytest.mark.slow
def test_a_cylinder_seen_from_one_side() -> None:
    rng = np.random.default_rng(4)
    radius, n = 0.06, 600
    across = rng.uniform(-radius, radius, n)
    height = rng.uniform(-1, 1, n)
    depth = np.sqrt(radius**2 - across**2)
    sight = np.array([0.6, 0.8])
    axis = np.array([3.0, 4.0]) + 0.05 * height[:, None] * [1.0, 0.0]
    xy = axis + (depth + rng.normal(0, 0.015, n))[:, None] * sight + across[:, None] * [-0.8, 0.6]
    table = np.column_stack([xy, height, np.broadcast_to(sight, (n, 2))])
    sector = np.zeros(n, np.int64)
    assert abs(radius_across(across, np.ones(n), sector) - radius) < 0.003
    state = np.array([*np.median(xy, axis=0), 0.0, 0.0, 0.03])
    residual, kept = fit_cylinder(table, sector, True, state, np.empty((n, 3)))
    np.testing.assert_allclose(state, [3.0, 4.0, 0.05, 0.0, radius], atol=0.006)
    assert kept > 0.9 * n and abs(residual - 0.015) < 0.004


def test_cells_along_a_drive() -> None:
    inside = np.zeros((8, 20), np.bool_)
    mark_corridor(np.array([1.0, 3.0, 20.0]), np.full(3, 2.0), 1.0, np.zeros(2), 0.5, inside)
    row, column = np.mgrid[:8, :20]
    x, y = 0.5 * column + 0.25, 0.5 * row + 0.25
    wanted = np.hypot(x - np.clip(x, 1.0, 3.0), y - 2.0) <= 1.0  # the leap to 20 m is no way
    assert (inside == wanted).all()


def test_moments_of_what_lies_low() -> None:
    rng = np.random.default_rng(5)
    (x, y), (above, light) = rng.uniform(0, 1, (2, 100)), rng.random((2, 100), np.float32)
    counted = rng.random(100) < 0.7
    sums = np.zeros((2, 2, 4))
    low_moments(x, y, above, light, counted, np.array([0.1, 0.8]), np.zeros(2), 0.5, sums)
    own = counted & (x >= 0.5) & (y < 0.5) & (above >= 0.1) & (above <= 0.8)
    h = above[own].astype(np.float64)
    np.testing.assert_allclose(sums[0, 1], [own.sum(), h.sum(), (h * h).sum(), light[own].sum(dtype=np.float64)])


def test_places_along_a_line_and_near_its_middles() -> None:
    rng = np.random.default_rng(4)
    x, y, rows = rng.uniform(0, 9, 500), rng.uniform(0, 9, 500), np.sort(rng.choice(500, 300, replace=False))
    middle, along = np.array([4.0, 5.0]), np.array([0.8, 0.6])
    t, d, near = np.empty(300), np.empty(300), np.empty(300, np.bool_)
    beside_line(x, y, rows, middle, along, t, d)
    past = np.column_stack([x[rows], y[rows]]) - middle
    np.testing.assert_allclose(np.column_stack([t, d]), past @ np.array([[0.8, -0.6], [0.6, 0.8]]), atol=1e-12)
    for count in (1, 7):
        edges, stretch = np.linspace(-4.0, 3.0, count + 1), np.empty(300, np.int32)
        t[:count] = edges[:-1]  # where one begins belongs to it
        in_stretches(t, edges, stretch)
        assert (stretch == np.clip(np.searchsorted(edges, t, side="right") - 1, 0, count - 1)).all()
        held = rng.uniform(-1.0, 1.0, count)
        near_middles(t, d, stretch, edges, held, 0.5, near)
        assert (near == (np.abs(d - np.interp(t, (edges[:-1] + edges[1:]) / 2, held)) <= 0.5)).all()
