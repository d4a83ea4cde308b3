"""Kernels of colours, against OpenCV's projection, NumPy, and planes whose distances are known."""

from __future__ import annotations

import cv2
import numpy as np

from roadscan.colours.kernels.depths import grow, nearest_in_pixels, slopes
from roadscan.colours.kernels.looks import (
    ALIKE,
    EVEN,
    GONE,
    MOVED,
    MOVED_M,
    OTHER,
    STEPS,
    UNKNOWN,
    VOTED,
    VOTED_M,
    Camera,
    Depths,
    Limits,
    blend,
    keep_best,
    leave_doubtful,
    leave_moved,
    look,
    project,
    weighted_medians,
)

WIDTH, HEIGHT, FOCAL = 160, 120, 100.0
DISTORTION = (-0.1, 0.02, 0.001, -0.002, 0.0)
EYE = np.array([1.0, 2.0, 3.0])
LENS = np.array([FOCAL, FOCAL, 79.5, 59.5, *DISTORTION, 3.0, WIDTH, HEIGHT, 0.0, *[0.0] * 6])
AXES = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0]
CAMERA = Camera(EYE, AXES, LENS)


def spread(count: int) -> np.ndarray:
    """Points (n, 3) before the camera."""
    rng = np.random.default_rng(3)
    seen = np.column_stack([rng.uniform(-4, 4, count), rng.uniform(-3, 3, count), rng.uniform(4, 20, count)])
    return (seen @ AXES + EYE).astype(np.float32)


def open_view(value: float = 0.0) -> Depths:
    shape = (HEIGHT, WIDTH)
    return Depths(np.zeros(shape, np.uint16), np.full(shape, UNKNOWN, np.uint16), np.full(shape, value, np.uint16), 1.0)


def test_project_is_opencvs() -> None:
    points = spread(500)
    pixel, distance = np.empty((500, 2), np.float32), np.empty(500, np.float32)
    project(points, CAMERA, 15.0, pixel, distance)
    turn = cv2.Rodrigues(AXES)[0]
    matrix = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points.astype(float) - EYE, turn, np.zeros(3), matrix, np.array(DISTORTION))
    away = np.linalg.norm(points.astype(float) - EYE, axis=1)
    inside = (expected[:, 0] >= -0.5).all(axis=1) & (expected[:, 0] < (WIDTH - 0.5, HEIGHT - 0.5)).all(axis=1)
    shown = inside & (away <= 15.0)
    assert 50 < shown.sum() < 450
    assert np.array_equal(~np.isnan(distance), shown)
    assert np.abs(pixel[shown] - expected[shown, 0]).max() < 1e-3
    assert np.abs(distance[shown] - away[shown]).max() < 1e-4


def test_look_takes_what_is_neither_hidden_nor_at_an_edge_nor_gone() -> None:
    points = spread(400)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[..., 0], picture[..., 1] = np.arange(WIDTH), np.arange(HEIGHT)[:, None]
    normal = np.full((400, 3), np.nan, np.float32)
    epoch = np.zeros(400, np.int64)
    limits = Limits(30.0, 4.0, 0.0, 0.0, 10, 1.0, window_ns=11)
    pixel, distance = np.empty((400, 2), np.float32), np.empty(400, np.float32)
    project(points, CAMERA, 30.0, pixel, distance)

    state = np.empty(400, np.uint8)

    def weights(depths: Depths, own_epoch: int = 0, hidden: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        colour, weight = np.zeros((400, 3), np.float32), np.empty(400, np.float32)
        masked = np.zeros((0, 0), np.bool_) if hidden is None else hidden
        look(points, epoch, normal, CAMERA, own_epoch, depths, limits, masked, picture, colour, weight, state)
        return colour, weight

    colour, weight = weights(open_view())
    inside = (pixel >= 4).all(axis=1) & (pixel[:, 0] <= WIDTH - 5) & (pixel[:, 1] <= HEIGHT - 5)
    assert np.array_equal(weight > 0, inside)
    assert np.abs(colour[inside, :2] - pixel[inside]).max() < 1e-3  # bilinear on two ramps
    assert np.allclose(weight[inside] * distance[inside] ** 2, 0.5 * FOCAL**2, rtol=1e-4)
    middle = np.uint16(STEPS * np.log(10.0 / 0.1))
    behind = open_view()
    behind.farthest[:] = middle
    assert np.array_equal(weights(behind)[1] > 0, inside & (distance <= 10.0 + 2e-3))
    edge = open_view()
    edge.nearest[:] = middle
    assert np.array_equal(weights(edge)[1] > 0, inside & (distance >= 10.0 - 2e-3))
    gone = open_view(middle)
    assert np.array_equal(weights(gone, own_epoch=11)[1] > 0, inside & (distance >= 10.0 - 2e-3))
    behind = 10.0 * (1.0 + MOVED) + MOVED_M  # so far away something was seen then
    through = inside & (distance * (1.0 + VOTED) + VOTED_M < behind)
    assert np.abs((state & GONE > 0) ^ through).sum() <= 1  # stored distances have steps
    assert np.array_equal(state & OTHER > 0, inside & (distance >= 10.0 - 2e-3))
    assert not (weights(gone, own_epoch=12) and state & GONE).any()  # too long before it
    assert np.array_equal(weights(gone, own_epoch=10)[1] > 0, inside)  # seen at the moment itself
    left = np.zeros((HEIGHT, WIDTH), np.bool_)
    left[:, :80] = True
    assert np.array_equal(weights(open_view(), hidden=left)[1] > 0, inside & (np.rint(pixel[:, 0]) >= 80))
    weights(open_view())
    assert (state[inside] == EVEN).all()  # ramps of one value a pixel
    picture[:, 60:, 2] = ALIKE + 1  # an edge of colours between two columns
    weights(open_view())
    column = np.rint(pixel[inside, 0])
    assert np.array_equal(state[inside] == EVEN, (column < 59) | (column > 60))


def test_keep_best_keeps_the_largest_weights() -> None:
    rng = np.random.default_rng(5)
    weights = rng.permutation(12).reshape(12, 1).astype(np.float32)
    held = (
        np.zeros((1, 4, 3), np.uint8), np.zeros((1, 4), np.float32), np.zeros((1, 4), np.uint8),
        np.full((1, 4), -1, np.int32), np.zeros((1, 2), np.uint8),
    )  # fmt: skip
    for number, weight in enumerate(weights):
        colour, state = np.full((1, 3), 10.0 * number, np.float32), np.array([OTHER * (number % 2)], np.uint8)
        keep_best(colour, weight, state, np.array([1.0, 2.0, 9.0]), number, *held)
    best = np.argsort(weights[:, 0])[-4:]
    keep_best(colour, np.zeros(1, np.float32), np.array([GONE], np.uint8), np.ones(3), 12, *held)
    assert held[4].tolist() == [[1, int((weights[1::2] > 0).sum())]]
    assert sorted(held[3][0].tolist()) == sorted(best.tolist())
    for k, number in enumerate(held[3][0]):
        assert held[2][0, k] == OTHER * (number % 2)
        assert held[0][0, k].tolist() == [10 * number, 20 * number, min(255, 90 * number)]
        assert held[1][0, k] == weights[number, 0]


def test_weighted_medians_are_those_of_repeated_values() -> None:
    rng = np.random.default_rng(6)
    colour = rng.integers(0, 256, (300, 5, 3)).astype(np.uint8)
    weight = rng.integers(0, 6, (300, 5)).astype(np.float32)
    found, count = np.empty((300, 3), np.uint8), np.empty(300, np.uint8)
    weighted_medians(colour, weight, found, count)
    assert np.array_equal(count, (weight > 0).sum(axis=1))
    for i in range(300):
        many = np.sort(np.repeat(colour[i], weight[i].astype(int), axis=0), axis=0)
        expected = many[(len(many) - 1) // 2] if len(many) else np.zeros(3)
        assert np.array_equal(found[i], expected)


def test_a_colour_that_one_look_at_an_edge_tells_is_none() -> None:
    """One look; an uneven one beside others that agree, and that differ; an even one that the median is not of."""
    colour = np.zeros((5, 3, 3), np.uint8)
    colour[:, :, 0] = [[90, 0, 0], [90, 0, 0], [90, 95, 10], [90, 150, 210], [90, 150, 210]]
    weight = np.array([[1, 0, 0], [1, 0, 0], [2, 1, 2], [1, 1, 1], [1, 1, 1]], np.float32)
    even = np.array([[0, 1, 1], [1, 0, 0], [0, 0, 1], [0, 0, 0], [1, 0, 1]], np.uint8)
    median, count = np.empty((5, 3), np.uint8), np.empty(5, np.uint8)
    weighted_medians(colour, weight, median, count)
    leave_doubtful(colour, weight, even, median, count)
    assert count.tolist() == [0, 1, 3, 0, 0]
    assert median[:, 0].tolist() == [0, 90, 90, 0, 0]


def test_what_moved_has_the_looks_of_its_moment() -> None:
    weight = np.ones((3, 3), np.float32)
    state = np.array([[OTHER, EVEN, OTHER | EVEN]] * 3, np.uint8)
    leave_moved(weight, state, np.array([[2, 1], [1, 1], [0, 3]], np.uint8))
    assert weight.tolist() == [[0, 1, 0], [1, 1, 1], [1, 1, 1]]


def test_nearest_in_pixels_is_the_least_of_each() -> None:
    rng = np.random.default_rng(7)
    pixel = rng.uniform(0, 40, (500, 2)).astype(np.float32)
    distance = rng.uniform(1, 9, 500).astype(np.float32)
    distance[::7] = np.nan
    image, which = np.full((20, 20), np.inf, np.float32), np.zeros((20, 20), np.int32)
    rows = np.arange(0, 500, 2)
    nearest_in_pixels(pixel, distance, rows, 2.0, image, which)
    for i in range(20):
        for j in range(20):
            own = [k for k in rows if (((pixel[k] + 0.5) // 2) == (j, i)).all() and not np.isnan(distance[k])]
            assert image[i, j] == min((distance[k] for k in own), default=np.inf)
            assert not own or distance[which[i, j]] == image[i, j]


def test_discs_lie_as_the_plane_that_they_are_of() -> None:
    """A plane seen at a slant: a disc about one sample has the distances of the plane, but for its allowance."""
    normal = np.array([0.3, 0.8, -0.5]) / np.linalg.norm([0.3, 0.8, -0.5])
    axes, eye = np.eye(3), np.zeros(3)
    v, u = np.indices((41, 41), dtype=float)
    ray = np.stack([(u - 20) / 200.0, (v - 20) / 200.0, np.ones_like(u)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    plane = np.dot([0.0, 0.0, 5.0], normal) / (ray @ normal)
    sample, which = np.full((41, 41), np.inf, np.float32), np.zeros((41, 41), np.int32)
    sample[20, 20] = 5.0
    point, normals = np.array([[0.0, 0.0, 5.0]], np.float32), normal[None].astype(np.float32)
    slope = np.empty((41, 41, 3), np.float32)
    slopes(sample, which, point, normals, eye, axes, 1 / 200.0, 20.0, 2.7, slope)
    allowed = slope[20, 20, 2]
    slope[20, 20, 2] = 0.0
    out = np.empty((41, 41), np.float32)
    grow(sample, slope, np.full((3, 3), 8.0, np.float32), 16, out)
    disc = np.hypot(u - 20, v - 20) <= 8.0
    assert np.array_equal(np.isfinite(out), disc)
    assert np.abs(out[disc] - plane[disc]).max() < 0.01
    assert np.ptp(plane[disc]) > 0.5
    slope[20, 20, 2] = allowed
    grow(sample, slope, np.full((3, 3), 8.0, np.float32), 16, out)
    assert (out[disc] >= plane[disc] - 0.01).all()
    assert out[20, 28] > plane[20, 28] + 0.03


def test_blend_leaves_out_what_moved() -> None:
    colour = np.array([[[100, 100, 100], [104, 104, 104], [102, 102, 102], [10, 200, 10]]] * 2, np.uint8)
    weight = np.array([[1.0, 1.0, 1.0, 50.0], [0.0, 1.0, 0.0, 50.0]], np.float32)
    number = np.array([[5, 6, 7, 8]] * 2, np.int32)
    median, count = np.empty((2, 3), np.uint8), np.empty(2, np.uint8)
    weighted_medians(colour, np.minimum(weight, 1.0), median, count)
    out, best = np.empty((2, 3), np.uint8), np.empty(2, np.int32)
    blend(colour, weight, number, median, count, out, best)
    assert out[0].tolist() == [102, 102, 102]
    assert best[0] == 5
    assert out[1].tolist() == [10, 200, 10]  # two looks do not outvote one another: the better one counts
    assert best[1] == 8
