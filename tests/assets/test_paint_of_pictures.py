"""Paint that pictures show: brightness without light and shadow, edges, and agreement with the lidar's intensity."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.green.cells import CELL_M
from roadscan.assets.green.colours import FINE, FINE_M, Ground
from roadscan.assets.kinds.lane_line import LaneLine, LaneLineOptions
from roadscan.assets.kinds.road_marking import PATCH_PIECES, RoadMarking
from roadscan.assets.paint.brightness import BrightSums, Seen, brightness_in
from roadscan.assets.paint.detection import LINE_PIECES
from roadscan.assets.scene import Box
from roadscan.assets.tasks.pictured_paint import Known, Window, canny_edges, pictured_paint

SIDE = 40
"""Edge of the window (cells): 10 m."""
LINE_M, WIDTH_M = 5.03, 0.14
"""Easting of the middle of a line, which is no multiple of a fine cell, and its width (m)."""
PAINT = 0.9
"""Contrast of paint in pictures."""
WHOLE = Box(0.0, 0.0, SIDE * CELL_M, SIDE * CELL_M)


def at_fine_cells() -> tuple[np.ndarray, np.ndarray]:
    """Easting and northing (cells, 25) of the middles of all fine cells."""
    row, column = (a.ravel()[:, None] for a in np.indices((SIDE, SIDE)))
    part = np.arange(FINE * FINE)
    x_m, y_m = (at * CELL_M + (n + 0.5) * FINE_M for at, n in ((column, part % FINE), (row, part // FINE)))
    return x_m, y_m


def shares() -> np.ndarray:
    """The share (cells, 25) of each fine cell that is painted."""
    x_m, y_m = at_fine_cells()
    across = np.clip((WIDTH_M / 2 + FINE_M / 2 - np.abs(x_m - LINE_M)) / FINE_M, 0.0, 1.0)
    return across * (np.abs(y_m - 5.0) < 3.0)


def ground(intensity: np.ndarray) -> Ground:
    row, column = (a.ravel() for a in np.indices((SIDE, SIDE)))
    none = np.zeros(row.size)
    drive_m = np.abs((column + 0.5) * CELL_M - 3.0)
    return Ground(column, row, none, intensity, drive_m, none > 0.0, np.zeros((row.size, 2)))


def rows_of(returns: np.ndarray) -> pa.Table:
    return pa.table({
        "returns": returns, "passes": pa.array([[1]] * returns.size, pa.list_(pa.int32())),
        "first_epoch_gps_ns": np.full(returns.size, 5), "last_epoch_gps_ns": np.full(returns.size, 9),
    })  # fmt: skip


def window(lidar: float | None, pieces: Sequence[pa.Table] = ()) -> Window:
    """The window, whose paint raises the lidar's intensity by a share; None: no returns."""
    random, count = np.random.default_rng(4), SIDE**2
    hit = random.random(count) < 0.6
    intensity = 40.0 * (1.0 + (lidar or 0.0) * shares().mean(axis=1)) * random.normal(1.0, 0.08, count)
    intensity[~hit | (lidar is None)] = np.nan
    returns = np.where(np.isfinite(intensity), 2, 0)
    rows = rows_of(returns)
    own, cells = np.arange(count), ground(intensity)
    return Window(
        own, (cells.row, cells.column), (SIDE, SIDE), cells, rows, (500.0, 900.0), Known.of(pieces, (500.0, 900.0))
    )


def sums(pictures: int = 3, paint: float = PAINT, lit: float | None = None, shown_by: int = 3) -> BrightSums:
    """Pictures of the line, the last of which do not show its paint; `lit`: level of the strip in the light."""
    random, out, own = np.random.default_rng(2), BrightSums(SIDE**2), np.arange(SIDE**2)
    for number in range(pictures):
        contrast = random.normal(0.0, 0.06, (SIDE**2, FINE * FINE))
        if number < shown_by:
            contrast += paint * shares()
        out.add(own, Seen(contrast, contrast if lit is None else np.full_like(contrast, lit)), np.full(own.size, 0.05))
    return out


def lines(table: pa.Table) -> list[dict]:
    assert all(row["patch"] is None for row in table.to_pylist())
    return [row["line"] for row in table.to_pylist()]


def test_a_line_lies_where_pictures_show_it_and_intensity_agrees() -> None:
    found = lines(pictured_paint(sums(), window(lidar=1.0), WHOLE))
    assert sum(abs(one["end_y_m"] - one["begin_y_m"]) for one in found) == pytest.approx(6.0, abs=0.15)
    for one in found:
        assert one["width_m"] == pytest.approx(WIDTH_M, abs=0.025)
        assert [one["begin_x_m"], one["end_x_m"]] == pytest.approx([500.0 + LINE_M] * 2, abs=0.02)
        assert one["probability"] > 0.9
        assert one["sigma_across_m"] >= 0.02
    table = pictured_paint(sums(), window(lidar=1.0), WHOLE)
    (line,) = LaneLine().objects(LaneLine().with_pictures(LINE_PIECES.empty_table(), table), LaneLineOptions(), {})
    assert line.returns == 0  # what tells that it is from pictures alone
    assert line.attributes["type"] == "dashed" or line.attributes["length_m"] == pytest.approx(6.0, abs=0.2)


def test_a_bright_strip_whose_intensity_does_not_rise_is_no_paint() -> None:
    assert not pictured_paint(sums(), window(lidar=0.0), WHOLE).num_rows


@pytest.mark.parametrize(("lit", "expected"), [(0.8, True), (0.0, False)])
def test_without_returns_paint_is_brighter_than_the_ground_driven_over(lit: float, expected: bool) -> None:
    """A strip of light between two shadows is only as bright as that."""
    found = lines(pictured_paint(sums(lit=lit), window(lidar=None), WHOLE))
    assert bool(found) is expected
    assert all(one["probability"] < 0.7 for one in found)


@pytest.mark.parametrize(("pictures", "shown_by"), [(1, 1), (4, 2)])
def test_one_picture_tells_nothing_nor_do_those_that_differ(pictures: int, shown_by: int) -> None:
    assert not pictured_paint(sums(pictures, paint=1.8, shown_by=shown_by), window(lidar=1.0), WHOLE).num_rows


def piece(first_m: float, last_m: float) -> pa.Table:
    """A line of the lidar on that of the pictures."""
    return pa.table({
        "begin_x_m": [500.0 + LINE_M], "begin_y_m": [first_m], "end_x_m": [500.0 + LINE_M], "end_y_m": [last_m],
        "width_m": [WIDTH_M],
    })  # fmt: skip


def test_what_the_lidar_found_is_not_found_again() -> None:
    assert not pictured_paint(sums(), window(1.0, [piece(901.9, 908.1)]), WHOLE).num_rows
    rest = lines(pictured_paint(sums(), window(1.0, [piece(904.0, 905.0)]), WHOLE))
    assert sum(abs(one["end_y_m"] - one["begin_y_m"]) for one in rest) == pytest.approx(4.76, abs=0.15)


def spots(*outlines: shapely.Geometry) -> pa.Table:
    """Markings of the lidar."""
    rest = {"in_crosswalk": False, "road_rad": 1.57, "height_m": 0.0, "slope_east": 0.0, "slope_north": 0.0,
            "contrast": 1.0, "sigma_height_m": 0.01, "probability": 0.9, "returns": 20, "passes": [1],
            "first_epoch_gps_ns": 5, "last_epoch_gps_ns": 9}  # fmt: skip
    return pa.Table.from_pylist([{"shape": shapely.to_wkb(one), **rest} for one in outlines], schema=PATCH_PIECES)


def test_spots_on_a_line_of_pictures_are_no_markings_and_a_bar_that_holds_it_stays() -> None:
    on_line, beside = shapely.box(504.9, 904.0, 505.2, 904.4), shapely.box(506.0, 904.0, 506.3, 904.4)
    known = spots(on_line, beside)
    table = pictured_paint(sums(), window(1.0, [known]), WHOLE)
    (left,) = RoadMarking().with_pictures(known, table).to_pylist()
    assert shapely.from_wkb(left["shape"]).equals(beside)
    area = spots(shapely.box(504.0, 901.0, 506.0, 909.0))
    assert not pictured_paint(sums(), window(1.0, [area]), WHOLE).num_rows


def test_squares_share_a_line_without_gap_or_overlap() -> None:
    """A box takes its own part of a line."""
    whole = window(lidar=1.0)
    parts = [lines(pictured_paint(sums(), whole, Box(0.0, a, 10.0, b))) for a, b in ((0.0, 4.4), (4.4, 10.0))]
    length = sum(abs(one["end_y_m"] - one["begin_y_m"]) for part in parts for one in part)
    assert length == pytest.approx(6.0, abs=0.15)
    assert max(max(one["begin_y_m"], one["end_y_m"]) for one in parts[0]) == pytest.approx(904.4, abs=1e-6)


LENGTH, ACROSS, MARGIN = 192, 24, 32
"""Cells of a longer street along the northings: 48 m by 6 m; squares are seen with 8 m around them."""


@functools.cache
def faded_line() -> tuple[np.ndarray, list[np.ndarray]]:
    """Intensity of cells and contrasts in three pictures: a faint line on a quiet pavement, then on a noisy one."""
    row, column = (a.ravel()[:, None] for a in np.indices((LENGTH, ACROSS)))
    part, random = np.arange(FINE * FINE), np.random.default_rng(11)
    x_m = column * CELL_M + (part % FINE + 0.5) * FINE_M
    y_m = row * CELL_M + (part // FINE + 0.5) * FINE_M
    line = np.clip((WIDTH_M / 2 + FINE_M / 2 - np.abs(x_m - LINE_M)) / FINE_M, 0.0, 1.0) * (y_m > 2.0)
    noise = np.where(y_m < 10.0, 0.02, 0.35)
    intensity = 40.0 * (1.0 + line.mean(axis=1)) * random.normal(1.0, 0.08, row.size)
    return intensity, [random.normal(0.0, noise) + 0.33 * line for _ in range(3)]


def paint_of_rows(first: int, last: int) -> pa.Table:
    """Paint in the box of some rows of cells (first, last) of the longer street."""
    intensity, pictures = faded_line()
    row, column = (a.ravel() for a in np.indices((LENGTH, ACROSS)))
    low, high = max(first - MARGIN, 0), min(last + MARGIN, LENGTH)
    held = np.flatnonzero((row >= low) & (row < high))
    row, column, none = row[held], column[held], np.zeros(held.size)
    drive_m = np.abs((column + 0.5) * CELL_M - 3.0)
    cells = Ground(column, row, none, intensity[held], drive_m, none > 0.0, np.zeros((held.size, 2)))
    own, total, corner_m = np.arange(held.size), BrightSums(held.size), (500.0, 900.0 + low * CELL_M)
    for one in pictures:
        total.add(own, Seen(one[held], one[held]), np.full(own.size, 0.05))
    seen = Window(
        own, (row - low, column), (high - low, ACROSS), cells, rows_of(np.full(own.size, 2)), corner_m,
        Known.of((), corner_m),
    )  # fmt: skip
    return pictured_paint(total, seen, Box(0.0, (first - low) * CELL_M, ACROSS * CELL_M, (last - low) * CELL_M))


@pytest.mark.parametrize("cuts", [(60,), (100,), (56, 148)])
def test_a_line_is_the_same_wherever_squares_are_cut(cuts: tuple[int, ...]) -> None:
    def ends_m(*cuts: int) -> np.ndarray:
        """Places where the line begins and ends, without those at cuts."""
        found = [lines(paint_of_rows(a, b)) for a, b in itertools.pairwise((0, *cuts, LENGTH))]
        ends = [sorted((one["begin_y_m"], one["end_y_m"])) for part in found for one in part]
        at_cut = 900.0 + np.array(cuts) * CELL_M
        return np.array([e for e in np.sort(np.ravel(ends)) if not np.isclose(e, at_cut, atol=1e-6).any()])

    whole = ends_m()
    assert whole[0] == pytest.approx(902.0, abs=0.05)
    assert 909.9 < whole[-1] < 940.0
    np.testing.assert_allclose(ends_m(*cuts), whole, atol=1e-6)


@pytest.mark.parametrize("noise", [0.03, 0.1])
def test_edges_follow_the_noise(noise: float) -> None:
    random = np.random.default_rng(8)
    flat = random.normal(0.0, noise, (120, 120))
    assert canny_edges(flat, np.full(flat.shape, noise)).mean() < 0.02
    flat[:, 60:] += 10.0 * noise
    assert canny_edges(flat, np.full(flat.shape, noise))[5:-5, 58:62].any(axis=1).mean() > 0.95


def test_exposure_and_shade_change_no_contrast_and_a_lit_strip_has_no_level() -> None:
    """Shade over the northern half, in which paint is as much brighter than the ground around."""
    x_m, y_m = at_fine_cells()
    value = 60.0 * (1.0 + PAINT * shares())
    dark = np.where(y_m > 5.0, 0.55, 1.0)
    none = np.zeros(SIDE**2)
    told = []
    for gain, light in ((1.0, 1.0), (1.6, 1.0), (1.0, dark)):
        colours = np.repeat(np.round(np.clip(value * gain * light, 0, 255)).astype(np.uint8).reshape(-1, 1), 3, axis=1)
        told.append(brightness_in(colours, np.ones(len(colours), np.bool_), np.arange(SIDE**2), ground(none)))
    on_paint, bare = shares() == 1.0, (shares() == 0.0) & (np.abs(y_m - 5.0) > 0.3)
    for one in told:
        assert np.median(one.contrast[on_paint]) == pytest.approx(PAINT, abs=0.06)
        assert np.abs(one.contrast[bare]).max() < 0.08
    strip = np.where(np.abs(x_m - 6.0) < 0.1, 1.0, np.where(np.abs(x_m - 6.0) < 1.2, 0.55, 1.0))
    colours = np.repeat(np.round(60.0 * strip).astype(np.uint8).reshape(-1, 1), 3, axis=1)
    lit = brightness_in(colours, np.ones(len(colours), np.bool_), np.arange(SIDE**2), ground(none))
    middle = np.abs(x_m - 6.0) < 0.05
    assert np.median(lit.contrast[middle]) > 0.5
    assert np.abs(lit.level[middle]).max() < 0.05
