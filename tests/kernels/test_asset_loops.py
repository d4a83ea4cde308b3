"""Loops over returns and rasters of assets against NumPy, SciPy and sums by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from roadscan.assets.kernels.beams import ground_heights, log_gains, meet_ground
from roadscan.assets.kernels.buckets import by_number, raster_cells, rows_within
from roadscan.assets.kernels.columns import mark_strip
from roadscan.assets.kernels.cubes import ALONE, LEAFY, WALL, WIRE, standing_classes
from roadscan.assets.kernels.ground import least_over_disk
from roadscan.assets.kernels.paint_levels import (
    contrasts,
    distinct_in_groups,
    paint_sums,
    scan_lines,
    seen_on_ground,
)
from roadscan.assets.kernels.plates import nearest_sides
from roadscan.assets.kernels.step_filter import convolve, sizes_of, take_excess, window_means
from roadscan.compute.kernel_options import read_only

RNG = np.random.default_rng(23)


def test_things_are_sorted_by_their_number_as_a_stable_sort_does() -> None:
    number = RNG.integers(-1, 5, 60).astype(np.int32)
    starts, order = np.zeros(6, np.int64), np.empty(60, np.int64)
    by_number(number, starts, order)
    kept = np.flatnonzero(number >= 0)
    assert order[: starts[-1]].tolist() == kept[np.argsort(number[kept], kind="stable")].tolist()
    assert np.diff(starts).tolist() == np.bincount(number[kept], minlength=5).tolist()


def test_places_find_their_cell_and_those_outside_none() -> None:
    cell = np.empty(4, np.int32)
    raster_cells(np.array([0.05, 0.25, -0.01, 0.1]), np.array([0.05, 0.15, 0.0, 0.2]), (0.0, 0.0, 0.1), (2, 3), cell)
    assert cell.tolist() == [0, 5, -1, -1]


def test_rows_within_a_box_hold_its_least_edges_and_not_its_greatest() -> None:
    x, y = np.array([0, 9, 10, 5, -1], np.int32), np.array([0, 9, 5, 10, 5], np.int32)
    rows = np.empty(5, np.int64)
    count = rows_within(x, y, np.array([0, 0, 10, 10], np.int64), rows)
    assert rows[:count].tolist() == [0, 1]


def test_ground_between_cells_is_that_of_scipy() -> None:
    height = RNG.normal(size=(7, 9)).astype(np.float32)
    x, y = RNG.uniform(0.0, 4.5, 40), RNG.uniform(0.0, 3.5, 40)
    out = np.empty(40)
    ground_heights(read_only(x), read_only(y), (0.0, 0.0, 0.5), height, out)
    expected = scipy.ndimage.map_coordinates(height, [y / 0.5 - 0.5, x / 0.5 - 0.5], np.float64, 1, "nearest")
    assert out == pytest.approx(expected, abs=1e-12)


def test_a_beam_that_comes_down_one_in_one_meets_level_ground_at_45_degrees() -> None:
    place = tuple(map(read_only, (np.array([0.5, 0.5]), np.array([0.5, 0.5]), np.zeros(2))))
    sensor = tuple(map(read_only, (np.array([3.5, 3.5]), np.array([0.5, 0.5]), np.array([3.0, 3.0]))))
    slope = np.zeros((1, 1))
    range_m, cosine = np.empty(2), np.empty(2)
    meet_ground(place, sensor, (0.0, 0.0, 1.0), slope, slope, np.array([True, False]), range_m, cosine)
    assert range_m == pytest.approx([3.0 * np.sqrt(2.0)] * 2)
    assert cosine == pytest.approx([np.sqrt(0.5), 1.0])
    # On ground that rises to the sensor as steeply as the beam comes down, it runs along the ground.
    meet_ground(place, sensor, (0.0, 0.0, 1.0), slope + 1.0, slope, np.array([True, False]), range_m, cosine)
    assert cosine[0] == pytest.approx(0.0, abs=1e-12)


def test_gains_between_nodes_are_those_of_numpy() -> None:
    nodes, levels = np.array([1.0, 2.0, 4.0, 9.0]), RNG.normal(size=4)
    value, degrees = np.append(RNG.uniform(0.0, 10.0, 48), [2.0, 9.0]), RNG.uniform(0.0, 10.0, 50)
    mine, ground = RNG.random(50) < 0.7, RNG.random(50) < 0.5
    laser, by_laser = RNG.integers(0, 3, 50).astype(np.uint16), np.array([0.1, 0.2, 0.4])
    out = np.zeros(50)
    log_gains(mine, laser, value, degrees, ground, by_laser, (nodes, levels), (nodes, 2.0 * levels), out)
    expected = by_laser[laser] + np.interp(value, nodes, levels)
    expected += np.where(ground, np.interp(degrees, nodes, 2.0 * levels), 0.0)
    assert (out == np.where(mine, expected, 0.0)).all()


def test_contrasts_are_those_to_a_surface_between_cells() -> None:
    level, upper = RNG.uniform(50.0, 60.0, (5, 6)), RNG.uniform(61.0, 70.0, (5, 6))
    x, y = RNG.uniform(-0.2, 3.2, 60), RNG.uniform(-0.2, 2.7, 60)
    intensity, contrast, noise = RNG.uniform(10.0, 200.0, 60), np.empty(60), np.empty(60)
    contrasts(x, y, intensity, (0.0, 0.0, 0.5), level, upper, (-0.5, 2.0, 0.06), contrast, noise)
    place = [y / 0.5 - 0.5, x / 0.5 - 0.5]
    here, most = (scipy.ndimage.map_coordinates(a, place, order=1, mode="nearest") for a in (level, upper))
    assert contrast == pytest.approx(np.clip(intensity / here - 1.0, -0.5, 2.0))
    assert noise == pytest.approx(np.maximum(most / here - 1.0, 0.06))


def test_sums_of_paint_are_those_of_its_cells() -> None:
    cell = np.array([0, 2, 2])
    sums = np.zeros((3, 5), np.float32)
    heights = np.array([1.0, 2.0, 3.0], np.float32)
    paint_sums(cell, np.array([0.5, 1.0, 2.0]), np.array([0.1, 0.2, 0.3]), heights, sums)
    assert sums[0] == pytest.approx([1.0, 0.5, 0.01, 1.0, 1.0])
    assert sums[1].tolist() == [0.0] * 5
    assert sums[2] == pytest.approx([2.0, 3.0, 0.13, 5.0, 13.0])


def test_least_heights_over_a_disk_are_those_of_scipy() -> None:
    z = RNG.uniform(0.0, 9.0, (13, 17)).astype(np.float32)
    for radius in (1, 4, 15):
        reach = np.arange(-radius, radius + 1)
        disk = reach**2 + reach[:, None] ** 2 <= radius**2
        widths = np.array([np.count_nonzero(row) // 2 for row in disk[radius:]])
        out = np.full(z.shape, np.inf, np.float32)
        least_over_disk(z, widths, np.empty(17, np.float32), out)
        assert (out == scipy.ndimage.minimum_filter(z, footprint=disk, mode="constant", cval=np.inf)).all()


def test_returns_on_the_ground_are_those_met_steeply() -> None:
    place = tuple(read_only(np.array(v)) for v in ([5.0, 5.0, 5.0, 10.0, 5.0, 5.0], [0.0] * 6, [0.0] * 6))
    up = np.array([2.0, 2.0, 0.4, 2.0, np.nan, 2.0])  # sines 0.37, 0.37, 0.08 (flat), beyond the box, not known, 0.37
    sensor = tuple(map(read_only, (np.zeros(6), np.zeros(6), up)))
    above = np.array([0.05, 0.2, 0.0, 0.0, -0.1, 0.0], np.float32)  # the second one lies too high
    wanted, rows = np.array([True] * 5 + [False]), np.empty(6, np.int64)
    count = seen_on_ground(place, sensor, above, wanted, (0.11, 0.1), (0.0, 0.0, 10.0, 1.0), rows)
    assert rows[:count].tolist() == [0, 4]


def test_a_scan_line_is_one_laser_within_a_step_of_time() -> None:
    epoch = read_only(np.array([5, 19, 21, -3, 5, 5], np.int64))
    sensor, laser = np.array([0, 0, 0, 0, 1, 0], np.uint8), np.array([3, 3, 3, 3, 3, 4], np.uint16)
    out = np.empty(5, np.int64)
    scan_lines(np.array([0, 1, 2, 4, 5]), epoch, sensor, laser, 20, out)
    assert len(set(out.tolist())) == 4
    assert out[0] == out[1]
    scan_lines(np.array([3, 0, 3, 2, 1]), epoch, sensor, laser, 20, out)
    assert out[0] == out[2] == out[1] - (1 << 24) == out[3] - (2 << 24)
    assert out[4] == out[1]


@pytest.mark.slow
def test_values_of_a_group_count_once() -> None:
    out = np.empty(3, np.int64)
    distinct_in_groups(np.array([0, 3, 3, 5]), np.array([4, 0, 2, 1, 3]), np.array([7, 9, 7, 9, 8]), out)
    assert out.tolist() == [2, 0, 1]


def test_a_strip_marks_the_returns_inside_it() -> None:
    x, y, marked = np.array([1.0, 1.0, 3.0, 1.0]), np.array([0.0, 0.6, 0.0, -0.4]), np.zeros(6, np.bool_)
    box = np.array([0.0, 2.0, -0.5, 0.5])
    mark_strip(x, y, np.array([5, 4, 3, 2]), np.zeros(2), np.eye(2), box, marked)
    assert np.flatnonzero(marked).tolist() == [2, 5]


def test_means_of_windows_and_weights_are_those_of_scipy() -> None:
    value = RNG.normal(size=(23, 31))
    out, between = np.empty(value.shape), np.zeros((25, 31))
    window_means(value, 6, (2, 20), between, np.zeros(31 + 6), out)
    assert (out[2:20] == scipy.ndimage.uniform_filter(value, 6, mode="constant")[2:20]).all()
    weights = np.array([0.4, 0.2, 0.1])
    convolve(read_only(value), weights, np.empty(31 + 4), np.empty(value.shape), out)
    whole = np.concatenate([weights[:0:-1], weights])
    expected = scipy.ndimage.correlate1d(scipy.ndimage.correlate1d(value, whole, axis=0), whole, axis=1)
    assert (out == expected).all()


def test_steps_that_scatter_everywhere_count_less() -> None:
    evidence = np.array([[0.0, 3.0, -6.0]])
    still, counted, size = np.array([[True, False, False]]), np.empty((1, 3)), np.empty((1, 3))
    sizes_of(evidence, still, (0.5, 4.0), counted, size)
    assert counted.tolist() == [[1.0, 1.0, 1.0]]
    assert size.tolist() == [[0.5, 3.0, 4.0]]
    take_excess(evidence, np.full((1, 3), 0.5), np.full((1, 3), 2.0), (0.0, 0.0), 0.8)
    assert evidence[0] == pytest.approx([0.0, 3.0 / 5.0, -6.0 / 5.0])


def test_what_stands_has_the_class_of_its_cube() -> None:
    above = np.array([0.1, 0.1, 0.6, 3.0, 1.0, 5.0, 1.0, 1.0, 1.0], np.float32)
    number = np.array([-1, 0, 1, 1, 2, 3, 4, 4, 0], np.int32)
    cubes = np.array([0, LEAFY, LEAFY | WALL, WALL | WIRE, ALONE], np.uint8)
    place = tuple(read_only(np.zeros(9)) for _ in range(3))
    sensor = (read_only(np.array([0.0] * 6 + [5.0, 20.0, 0.0])), *place[1:])
    out = np.ones(9, np.uint8)
    out[8] = 64
    standing_classes(above, number, cubes, place, sensor, (0.3, 0.5, 2.0, 15.0), (1, 3, 4, 5, 6, 14, 18), out)
    assert out.tolist() == [3, 1, 4, 5, 6, 14, 18, 1, 64]


def test_the_nearest_side_of_a_beam_is_that_of_numpy_bit_for_bit() -> None:
    rng = np.random.default_rng(7)
    along, reach, sides = rng.normal(size=(40, 5)), rng.uniform(0.0, 0.1, (40, 5)), rng.normal(size=5)
    along[3], reach[3], sides[:] = 0.25, 0.0, 0.5  # all sides are equal: the first counts
    nearest, away, grows = np.empty(40, np.int64), np.empty(40), np.empty(40)
    nearest_sides(along, reach, -0.2, sides, nearest, away, grows)
    past, rows = along + -0.2 * reach - sides, np.arange(40)
    assert nearest[3] == 0
    np.testing.assert_array_equal(nearest, past.argmax(axis=1))
    np.testing.assert_array_equal(away, past.max(axis=1))
    np.testing.assert_array_equal(grows, reach[rows, nearest])
