"""The kernel that follows rays, against NumPy and results known by hand."""

from __future__ import annotations

import numpy as np

from roadscan.assets.kernels.sight import Places, Rays, follow_rays, rays_at_plates, rays_at_shafts, rays_near
from roadscan.compute.kernel_options import read_only

CELL_M = 0.5
BANDS_M = np.array([-0.3, 0.5, 1.5, 3.0])


def places(rows: int, columns: int, ground: float = 100.0) -> Places:
    heights = np.full((rows, columns), ground, np.float32)
    return Places(np.array([-3.0, 2.0]), CELL_M, heights, BANDS_M)


def followed(rays: np.ndarray, of: Places, reach_m: float, hit_m: float) -> tuple[np.ndarray, np.ndarray]:
    shape = (*of.ground.shape, BANDS_M.size - 1)
    passed, hidden = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    follow_rays(Rays(*np.ascontiguousarray(rays.T)), of, reach_m, hit_m, passed, hidden)
    return passed, hidden


def test_rays_count_where_they_pass_and_behind_what_they_hit() -> None:
    random = np.random.default_rng(3)
    of = places(24, 30)
    of.ground[:] += random.normal(0, 0.2, of.ground.shape)
    of.ground[3, 4] = np.nan
    starts = np.column_stack([random.uniform(-8, 16, 500), random.uniform(-3, 18, 500), np.full(500, 102.0)])
    ends = np.column_stack([random.uniform(-3, 12, 500), random.uniform(2, 14, 500), random.uniform(99.9, 104, 500)])
    ends[7] = starts[7]
    passed, hidden = followed(np.hstack([starts, ends]), of, 12.0, 0.4)

    expected = np.zeros((2, *passed.shape), np.uint32)
    for start, end in zip(np.delete(starts, 7, 0), np.delete(ends, 7, 0), strict=True):
        length = float(np.linalg.norm(end - start))
        along = (np.arange(24) + 0.5) * CELL_M  # 12 m
        at = start + along[:, None] * (end - start) / length
        column, row = (np.floor((at[:, :2] - of.corner) / CELL_M).astype(int)).T
        inside = (column >= 0) & (row >= 0) & (column < 30) & (row < 24)
        column, row, at, along = column[inside], row[inside], at[inside], along[inside]
        above = at[:, 2] - of.ground[row, column].astype(float)
        held = (above >= BANDS_M[0]) & (above < BANDS_M[-1])
        band = np.searchsorted(BANDS_M, above[held], side="right") - 1
        behind = (along[held] > length + 0.4).astype(int)
        np.add.at(expected, (behind, row[held], column[held], band), 1)
    assert expected.sum() > 5000 and expected[1].sum() > 500
    # a sample on the edge of the raster may fall to either side of it
    assert np.array_equal(passed, expected[0]) and np.array_equal(hidden, expected[1])


def test_a_level_ray_passes_each_cell_of_a_row_once_until_it_hits() -> None:
    passed, hidden = followed(np.array([[-3.0, 3.25, 101.0, 1.0, 3.25, 101.0]]), places(4, 20), 9.0, 0.0)
    assert passed[2, :8, 1].tolist() == [1] * 8 and passed.sum() == 8
    assert hidden[2, 8:18, 1].tolist() == [1] * 10 and hidden.sum() == 10


def test_rays_near_a_place_are_those_that_numpy_finds_and_those_sent_at_the_moment() -> None:
    random = np.random.default_rng(5)
    starts, ends = random.uniform(-2, 2, (600, 3)), random.uniform(-30, 30, (600, 3))
    ends[9] = starts[9]
    starts[10] = np.nan
    epochs, lasers = np.arange(600) * 10, random.integers(0, 8, 600).astype(np.uint16)
    spans, middles = np.array([[0, 250], [240, 599]]), np.array([1000, 4000])
    place, reach_m, wide, late = np.array([12.0, -5.0, 3.0]), 3.0, 0.2, 25.0
    rows, spanned, answered = np.empty(700, np.int64), np.empty(700, np.int64), np.zeros((2, 8), np.bool_)
    count = rays_near(
        Rays(*np.ascontiguousarray(np.hstack([starts, ends]).T)), epochs, lasers, spans, place, reach_m, wide, middles,
        late, rows, spanned, answered,
    )  # fmt: skip

    way = ends - starts
    with np.errstate(invalid="ignore"):
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        to = place - starts
        beside = np.linalg.norm(np.cross(way, to), axis=1)
        near = ((way * to).sum(axis=1) > 0.0) & (beside < reach_m + wide * np.linalg.norm(to, axis=1))
    wanted = [(k, s) for s, (a, b) in enumerate(spans) for k in range(a, b + 1)
              if near[k] or abs(epochs[k] - middles[s]) < late]  # fmt: skip
    assert 30 < len(wanted) < 300 and not near[9] and not near[10]
    assert list(zip(rows[:count].tolist(), spanned[:count].tolist(), strict=True)) == wanted
    assert {(s, int(lasers[k])) for k, s in wanted} == set(
        zip(*map(np.ndarray.tolist, np.nonzero(answered)), strict=True)
    )


def test_rays_at_leaning_shafts_are_those_that_numpy_counts() -> None:
    random = np.random.default_rng(7)
    starts = np.column_stack([random.uniform(-12, 12, (30_000, 2)), np.full(30_000, 2.0)])
    ends = np.column_stack([random.uniform(-12, 12, (30_000, 2)), random.uniform(-1, 6, 30_000)])
    ends[:3_000, :2] = random.normal([3.0, 3.2], 0.2, (3_000, 2))
    starts[4] = np.nan
    ends[5] = starts[5]
    shafts = np.array([
        [0.0, 0.0, 1.5, 0.0, 0.0, 0.1, 0.5, 3.0, 0.5], [3.0, 3.2, 1.0, 0.15, -0.1, 0.3, 0.2, 4.0, 1.25],
        [-4.0, 5.0, 2.0, -0.2, 0.0, 0.05, 0.0, 5.0, 1.05],
    ])  # fmt: skip
    reach_m, limits = 6.0, (0.6, 0.15, 0.3, 0.1, 0.4)
    middle, before, behind, least, most = limits
    rays = Rays(*map(read_only, np.ascontiguousarray(np.hstack([starts, ends]).T)))
    cell_m, edge = 3.0, 10  # each shaft is listed for all cells: the list may hold more than is near
    cells = np.arange(edge * edge + 1) * len(shafts), np.tile(np.arange(len(shafts)), edge * edge), edge, edge
    counts = np.zeros((len(shafts), 3, 2), np.int64)
    rays_at_shafts(rays, shafts, cells, np.array([-15.0, -15.0]), cell_m, 2.0, reach_m, limits, counts)

    way = ends - starts
    length = np.hypot(way[:, 0], way[:, 1])
    with np.errstate(invalid="ignore"):
        unit = way / length[:, None]
    expected = np.zeros_like(counts)
    for k, (x, y, middle_m, slope_x, slope_y, radius, low, top, _) in enumerate(shafts.tolist()):
        at, height = np.broadcast_to([x, y], (len(ends), 2)), np.zeros(len(ends))
        for _ in range(2):
            along = ((at - starts[:, :2]) * unit[:, :2]).sum(axis=1)
            height = starts[:, 2] + along * unit[:, 2]
            at = np.array([x, y]) + (height - middle_m)[:, None] * [slope_x, slope_y]
        to = at - starts[:, :2]
        along, across = (to * unit[:, :2]).sum(axis=1), to[:, 1] * unit[:, 0] - to[:, 0] * unit[:, 1]
        told = (along > 0.0) & (height >= low) & (height <= top)
        told &= np.hypot(ends[:, 0] - x, ends[:, 1] - y) <= reach_m
        beside = (np.abs(across) - radius > least) & (np.abs(across) - radius <= most)
        for part, own in enumerate(
            [np.abs(across) <= middle * radius, beside & (across < 0.0), beside & (across >= 0.0)]
        ):
            passed = told & own & (length - along > radius + behind)
            ended = told & own & ~passed & (length - along >= -radius - (behind if part else before))
            expected[k, part] = np.count_nonzero(ended), np.count_nonzero(passed)
    assert (expected[1] > 20).all() and expected[..., 1].min() > 5
    assert counts.tolist() == expected.tolist()


def test_rays_at_plates_are_those_that_numpy_counts() -> None:
    random = np.random.default_rng(11)
    starts = random.uniform([-10, -10, 1], [10, 10, 4], (40_000, 3))
    ends = random.uniform([-10, -10, -1], [10, 10, 6], (40_000, 3))
    facing, tilt = np.radians([20.0, -130.0]), np.radians([0.0, 6.0])
    normal = np.column_stack([np.cos(tilt) * np.sin(facing), np.cos(tilt) * np.cos(facing), np.sin(tilt)])
    right = np.column_stack([-np.cos(facing), np.sin(facing), np.zeros(2)])
    middle, half = np.array([[0.5, -1.0, 2.4], [2.0, 3.0, 2.8]]), np.array([[0.9, 0.6], [1.4, 1.0]])
    up = np.cross(normal, right)
    onto = random.uniform(-1.6, 1.6, (2, 8_000, 3)) * [1.0, 1.0, 0.2]  # many rays end at a plate
    for k in range(2):
        ends[8_000 * k : 8_000 * (k + 1)] = middle[k] + onto[k] @ np.stack([right[k], up[k], normal[k]])
    starts[3], ends[4] = np.nan, starts[4]
    reach_m, limits = 6.0, (0.08, 1.0, 0.1, 0.5, 0.2)
    thick, far, least, most, cosine = limits
    counts = np.zeros((2, 6, 3), np.int64)
    plates = np.column_stack([middle, normal, right, half])
    rays_at_plates(Rays(*np.ascontiguousarray(np.hstack([starts, ends]).T)), plates, reach_m, limits, counts)

    way = ends - starts
    expected = np.zeros_like(counts)
    for k in range(2):
        rate, first, last = way @ normal[k], (starts - middle[k]) @ normal[k], (ends - middle[k]) @ normal[k]
        with np.errstate(invalid="ignore", divide="ignore"):
            steep = np.abs(rate) >= cosine * np.linalg.norm(way, axis=1)
            past = np.where(rate > 0.0, last, -last)
            told = steep & (np.abs(rate) > 0.0) & (past >= -thick) & (np.where(rate > 0.0, first, -first) <= -thick)
            told &= np.hypot(*(ends - middle[k])[:, :2].T) <= reach_m
            meets = ends - np.where(past > thick, last / rate, 0.0)[:, None] * way - middle[k]
        u, v = meets @ right[k], meets @ up[k]
        (wide, tall), beside, beyond = half[k], np.abs(u) - half[k, 0], np.abs(v) - half[k, 1]
        strip_u, strip_v = (beside > least) & (beside <= most), (beyond > least) & (beyond <= most)
        level, upright = np.abs(v) <= tall, np.abs(u) <= wide
        parts = (level & upright, level & strip_u & (u < 0), level & strip_u & (u > 0), upright & strip_v & (v > 0),
                 upright & strip_v & (v < 0), (3.0 * np.abs(v) <= tall) & (3.0 * np.abs(u) <= wide))  # fmt: skip
        for part, own in enumerate(parts):
            for sort, some in enumerate((past <= thick, (past > thick) & (past <= far), past > far)):
                expected[k, part, sort] = np.count_nonzero(told & own & some)
    assert expected.min() > 5
    assert counts.tolist() == expected.tolist()
