"""Kernels of edges against least squares, a search of all paths, and steps drawn by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from roadscan.assets.kernels.edge_links import MAX_LINKS, best_ways, find_links, trace
from roadscan.assets.kernels.low_returns import low_heights
from roadscan.assets.kernels.step_filter import CHUNK, FRAME, WORK, step_response, strips, thin
from roadscan.assets.kernels.step_profiles import (
    END,
    FACE,
    OBSTACLE,
    OFFSET,
    RESULTS,
    SIGMA_STEP,
    SLOPE,
    STEP,
    STEP_DOWN,
    TOP,
    TRANSECT_RESULTS,
    UNSEEN,
    WIDTH,
    fit_nodes,
    walk,
)
from roadscan.compute.kernels.edge_across import best_path, best_places, step_and_bend

RNG = np.random.default_rng(8)


def test_low_heights_leave_out_what_stands_above() -> None:
    cell = np.array([0, 0, 0, 1, -1, 0], np.int32)
    z = np.array([1.0, 1.06, 1.5, 2.0, 9.0, 0.1])
    used = np.array([True, True, True, True, True, False])
    count, mean, variance = np.zeros(2, np.int32), np.zeros(2), np.zeros(2)
    low_heights(cell, z, used, 0.12, count, mean, variance)
    assert count.tolist() == [2, 1]
    assert mean == pytest.approx([1.03, 2.0])
    assert variance == pytest.approx([0.03**2, 0.0])
    assert used.tolist() == [True, True, False, True, False, False]


def test_the_filter_measures_a_step_and_is_strongest_at_it() -> None:
    """A step of 10 cm between columns 9 and 10 on ground that rises by 3 % along the edge and by 2 % across it."""
    row, column = np.mgrid[0:25, 0:20]
    height = 0.1 * 0.03 * row + 0.1 * 0.02 * column + np.where(column >= 10, 0.1, 0.0)
    height = height + RNG.normal(0.0, 0.002, height.shape)
    weight = np.full(height.shape, 0.005**-2)
    slope_x, slope_y = np.full(height.shape, 0.02), np.full(height.shape, 0.03)
    frame = ((FRAME, FRAME), (FRAME, FRAME + CHUNK - 20))
    inner = (slice(None), slice(FRAME, -FRAME), slice(FRAME, FRAME + 20))
    k = np.arange(-5, 6)
    along = np.column_stack([0 * k, k, 0.0 * k, 0.1 * k])
    field = [np.pad(raster, frame) for raster in (weight, height, slope_x, slope_y)]
    framed, work = np.zeros((3, *field[0].shape)), np.empty((WORK, CHUNK))
    strips(*field, along, np.ones((25, 1), np.bool_), work, framed)
    strip = framed[inner]
    assert strip[1, 12, 5] == pytest.approx(np.mean(height[7:18, 5] - 0.003 * k), abs=1e-12)
    assert strip[0, 12, 5] == pytest.approx(11 * 0.005**-2)
    j = np.arange(1, 5)
    across = np.column_stack([j, 0 * j, 0.1 * j])
    wide = (25, CHUNK)
    step, evidence = np.empty(wide), np.empty(wide)
    freedom, active = np.full(wide, 80.0), np.zeros(wide, np.bool_)
    active[:, :20] = True
    slopes = (np.full(wide, 0.02), np.full(wide, 0.03), (1.0, 0.0))
    step_response(framed, freedom, active, slopes, across, (0.05**-2, 0.005), work, step, evidence)
    assert (step[:, 20:] == 0.0).all()
    step, evidence = step[:, :20].copy(), evidence[:, :20].copy()
    assert np.abs(step[12, 9:11]) == pytest.approx([0.1, 0.1], abs=0.015)
    assert evidence[12, 9:11].min() > 8.0
    assert np.abs(evidence[12, 4]) < 3.0
    best = np.zeros((4, *height.shape))
    thin(step, evidence, 3.0, (1.0, 0.0), (4.0, 0.015, 0.3), (0, 0), best)
    assert set(np.argmax(best[0, 5:-5], axis=1).tolist()) <= {9, 10}
    assert best[2, 12].max() == 3.0


def brute(evidence: np.ndarray, reach: int, cost: float) -> float:
    stations, offsets = evidence.shape
    best = -np.inf
    for path in itertools.product(range(offsets), repeat=stations):
        moves = np.abs(np.diff(path))
        if moves.max() <= reach:
            best = max(best, evidence[np.arange(stations), path].sum() - cost * moves.sum())
    return best


def test_the_best_path_is_that_of_a_search_of_all() -> None:
    evidence = RNG.normal(size=(5, 6))
    total, before, path = np.empty((5, 6)), np.empty((5, 6), np.int64), np.zeros(5, np.int64)
    best_path(evidence, 2, 0.4, total, before, path)
    value = evidence[np.arange(5), path].sum() - 0.4 * np.abs(np.diff(path)).sum()
    assert value == pytest.approx(brute(evidence, 2, 0.4))


def test_a_place_of_a_path_is_that_of_the_best_path_about_it() -> None:
    evidence = RNG.normal(size=(9, 5))
    path = np.zeros(9, np.int64)
    best_places(evidence, 1, 0.4, 2, np.empty((2, 5)), np.empty(5), path)
    for station in range(9):
        near = slice(max(station - 2, 0), station + 3)
        through = []
        for offset in range(5):
            only = np.where(np.arange(5) == offset, evidence[station], -100.0)
            around = evidence[near].copy()
            around[station - near.start] = only
            through.append(brute(around, 1, 0.4))
        assert path[station] == int(np.argmax(through))


def test_steps_and_bends_across_are_those_of_straight_lines() -> None:
    """Least squares by NumPy on both sides of a cell."""
    height = RNG.normal(0.0, 0.01, (5, 12)) + 0.02 * np.arange(12) + np.where(np.arange(12) > 6, 0.05, 0.0)
    weight = np.full(height.shape, 1e4)
    step, bend = np.empty(height.shape), np.empty(height.shape)
    step_and_bend(height, weight, 0.1, (1, 4), (0.0, 0.0), step, bend)
    found, rest, sums = [], 0.0, []
    for side in (-1, 1):
        j = np.arange(1, 5)
        z = (height[1:4][:, 6 + side * j] - height[1:4, 6][:, None]).ravel()
        design = np.column_stack([np.ones(12), np.tile(side * 0.1 * j, 3)])
        solution, square = np.linalg.lstsq(design, z, rcond=None)[:2]
        rest += square[0] * 1e4
        found.append(solution)
        sums.append(np.diag(np.linalg.inv(design.T @ design)) / 1e4)
    spread = max(1.0, rest / 20.0)
    expected = (found[1] - found[0]) / np.sqrt((sums[0] + sums[1]) * spread)
    assert [step[2, 6], bend[2, 6]] == pytest.approx(expected)
    assert np.isnan(step[2, 0])


def test_links_lead_forward_and_the_strongest_chain_is_traced() -> None:
    """Places along x, one that looks back, and a weak one beside them."""
    n = 12
    place = np.column_stack([0.2 * np.arange(n), np.zeros(n), np.ones(n), np.zeros(n)])
    place = np.concatenate([place, [[1.0, 0.3, -1.0, 0.0], [1.0, -0.1, 1.0, 0.0]]])
    quality = np.append(np.full(n, 4.0), [4.0, 0.5])
    m = len(place)
    links, lengths, gains = np.full((m, MAX_LINKS), -1), np.zeros((m, MAX_LINKS)), np.zeros((m, MAX_LINKS))
    order, starts = np.arange(m), np.array([0, m])
    bins = (-1.0, -1.0, 10.0, 1.0, 1.0)
    find_links(place, quality, order, starts, bins, (0.5, 1.5), (0.3, 0.85, 1.0, 5.0), links, lengths, gains)
    assert set(links[3][links[3] >= 0].tolist()) == {4, 5, n + 1}
    assert links[3, 0] in {4, 5}
    assert links[n][0] == -1
    ahead, behind = np.zeros(m), np.zeros(m)
    following, preceding = np.full(m, -1), np.full(m, -1)
    best_ways(links, lengths, gains, 5.0, 50, (1.0, 9.0), ahead, following, behind, preceding)
    # Each link of 0.2 m gains 0.8, and what follows fades with e^(−0.2 / 5).
    expected = sum(0.8 * np.exp(-0.2 / 5.0 * k) for k in range(n - 1))
    assert ahead[0] == pytest.approx(expected, rel=0.05)
    total = ahead + behind
    chain, owner = np.zeros((m, 2), np.int64), np.full(m, -1)
    number, length = trace(
        place, total, following, preceding, np.argsort(-total, kind="stable"), order, starts, bins,
        (3.0, 1.0, 0.25, 0.6), chain, owner,
    )  # fmt: skip
    assert number >= 1
    assert set(chain[:length, 1].tolist()) >= set(range(0, n, 2)) or set(chain[:length, 1].tolist()) >= set(
        range(2, n - 2)
    )
    assert owner[n + 1] == 0


def test_a_step_is_found_where_it_was_drawn() -> None:
    """A step of 9 cm with a face of 6 cm, 12 cm to the right of the node, on a cross slope of 3 %."""
    t, d = RNG.uniform(-0.5, 0.5, 4000), RNG.uniform(-1.2, 1.2, 4000)
    z = 50.0 + 0.02 * t + 0.03 * d + 0.09 * np.clip((d - 0.12) / 0.06 + 0.5, 0.0, 1.0)
    z = z + RNG.normal(0.0, 0.004, z.size)
    node = np.array([[0.0, 0.0, 1.0, 0.0, 50.0, 0.02, 0.03]])
    out = np.empty((1, RESULTS))
    fit_nodes(
        node, t, -d, z, np.array([0, 4000]), (-2.0, -2.0, 10.0, 1.0, 1.0), 0.5, (0.2, 0.02, 0.24, 0.35), (0.05, 0.015),
        out,
    )  # fmt: skip
    assert out[0, STEP] == pytest.approx(0.09 + 0.06 * 0.03, abs=0.004)
    assert out[0, OFFSET] - 0.5 * out[0, FACE] == pytest.approx(0.12, abs=0.011)
    assert out[0, FACE] == pytest.approx(0.06, abs=0.025)
    assert out[0, TOP] == pytest.approx(0.09 + 0.15 * 0.03, abs=0.004)
    assert 0.0 < out[0, SIGMA_STEP] < 0.002


def test_a_walk_ends_at_what_stands_and_at_an_edge() -> None:
    height = np.tile(0.02 * 0.1 * np.arange(60), (3, 1))
    rough, blocked = np.zeros(height.shape), np.zeros(height.shape, np.bool_)
    edge_x, edge_y = np.zeros(height.shape), np.zeros(height.shape)
    blocked[0, 35] = True
    edge_x[1, 25] = -1.0
    height[2, 40:] = np.nan
    node = np.array([[0.05, 0.05 + 0.1 * r, 1.0, 0.0] for r in range(3)])
    out = np.empty((3, TRANSECT_RESULTS))
    walk(node, height, rough, blocked, edge_x, edge_y, (0.0, 0.0, 0.1), (0.3, 5.0, 0.8, 0.15, 0.03), out)
    assert out[:, END].tolist() == [OBSTACLE, STEP_DOWN, UNSEEN]
    assert out[:, WIDTH] == pytest.approx([3.4, 2.5, 3.9], abs=0.11)
    assert out[:, SLOPE] == pytest.approx([0.02, 0.02, 0.02], abs=1e-6)


def test_the_best_ways_are_those_over_all_places_in_their_order() -> None:
    draw = np.random.default_rng(4)
    n = 300
    links, lengths, gains = np.full((n, MAX_LINKS), -1), np.zeros((n, MAX_LINKS)), np.zeros((n, MAX_LINKS))
    for i in range(n - 1):
        to = np.unique(np.minimum(i + draw.integers(1, 20, draw.integers(0, MAX_LINKS)), n - 1))
        links[i, : to.size], lengths[i, : to.size] = to, draw.uniform(0.1, 1.5, to.size)
        gains[i, : to.size] = draw.normal(0.0, 1.0, to.size)
    ahead, behind = np.zeros(n), np.zeros(n)
    following, preceding = np.full(n, -1), np.full(n, -1)
    best_ways(links, lengths, gains, 6.0, n, (0.0, 9.0), ahead, following, behind, preceding)
    first, last = np.zeros(n), np.zeros(n)  # all links lead on: each place once tells
    for i in range(n - 1, -1, -1):
        for k in np.flatnonzero(links[i] >= 0).tolist():
            first[i] = max(first[i], gains[i, k] + first[links[i, k]] * np.exp(-lengths[i, k] / 6.0))
    for i in range(n):
        for k in np.flatnonzero(links[i] >= 0).tolist():
            j = links[i, k]
            last[j] = max(last[j], gains[i, k] + last[i] * np.exp(-lengths[i, k] / 6.0))
    np.testing.assert_allclose(ahead, first, atol=5e-3)
    np.testing.assert_allclose(behind, last, atol=5e-3)
    # The next place is that of the best way of 9 m, of which a link takes up whole tenths of a metre.
    left = np.zeros((n, 91))
    for i in range(n - 1, -1, -1):
        for k in np.flatnonzero(links[i] >= 0).tolist():
            span = math.ceil(10.0 * lengths[i, k])
            there = gains[i, k] + left[links[i, k], : 91 - span] * np.exp(-lengths[i, k] / 6.0)
            left[i, span:] = np.maximum(left[i, span:], there)
            if left[i, 90] == there[-1]:
                first[i] = links[i, k]
    goes_on = left[:, 90] > 0.0
    assert ((following >= 0) == goes_on).all() and goes_on.mean() > 0.8
    np.testing.assert_array_equal(following[goes_on], first[goes_on])
