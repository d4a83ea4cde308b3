"""What pictures show, of scenes made by hand; and the gains of pictures whose exposures are known."""

from __future__ import annotations

import numpy as np

from roadscan.colours.depth import DepthRule, Seen, depth_images, seen_through
from roadscan.colours.gains import PictureSample, gains_of
from roadscan.colours.kernels.looks import STEPS, UNKNOWN, Camera
from roadscan.colours.tasks.depths import _kept

FOCAL, WIDTH, HEIGHT = 400.0, 480, 320
LENS = np.array([FOCAL, FOCAL, 239.5, 159.5, 0, 0, 0, 0, 0, np.inf, WIDTH, HEIGHT, 0.0, *[0.0] * 6])
CAMERA = Camera(np.zeros(3), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), LENS)
"""It looks to the north; the map's x is to the right."""
RULE = DepthRule(moment_ns=60_000_000, grazing_deg=3.0, edge_px=2.0)
LATER = 2_000_000_000


def wall(away_m: float, half_m: float, across_m: float, upwards_m: float) -> np.ndarray:
    """Points of an upright wall to the north, in lines."""
    x, z = np.meshgrid(np.arange(-half_m, half_m, across_m), np.arange(-half_m, half_m, upwards_m))
    return np.column_stack([x.ravel(), np.full(x.size, away_m), z.ravel()])


def shown(*parts: tuple[np.ndarray, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (m) of points with their epochs: at an edge below, hidden above, gone below; inf for any."""
    point = np.concatenate([p for p, _ in parts]).astype(np.float32)
    epoch = np.concatenate([np.full(len(p), t) for p, t in parts])
    normal = np.tile(np.array([0, -1, 0], np.float32), (len(point), 1))
    images = depth_images(Seen(point, normal, epoch), CAMERA, 0, 60.0, RULE)
    found = []
    for codes in (images.nearest, images.farthest, images.moved):
        metres = np.where(codes == UNKNOWN, np.inf, np.where(codes == 0, 0.0, 0.1 * np.exp(codes / STEPS)))
        found.append(metres)
    return found[0], found[1], found[2]


def test_a_wall_hides_what_is_behind_it_between_its_lines() -> None:
    """Lines 8 pixels apart; a wall behind is seen densely through the gaps, by the lidar alone."""
    _, hidden, _ = shown((wall(10.0, 2.0, 0.02, 0.2), 0), (wall(20.0, 6.0, 0.05, 0.05), 0))
    middle = hidden[100:220, 180:300]
    assert middle.min() > 10.0
    assert middle.max() < 11.0
    assert (hidden[20:40, 20:40] > 19.9).all()  # beside it the wall behind is seen


def test_beside_an_edge_nothing_near_counts() -> None:
    edge, _, _ = shown((wall(10.0, 2.0, 0.02, 0.05), 0), (wall(20.0, 8.0, 0.05, 0.05), 0))
    assert (edge[150:170, 225:255] == 0.0).all()  # in its middle
    assert 10.0 < edge[160, 318] < 20.0  # the last points of the near wall lie at column 319
    assert edge[160, 318 - 12] == 0.0


def test_behind_an_edge_what_the_same_pixel_shows_is_hidden() -> None:
    """The near wall ends at column 319; the discs of its points reach a gap beyond."""
    _, hidden, _ = shown((wall(10.0, 2.0, 0.02, 0.02), 0), (wall(20.0, 8.0, 0.02, 0.02), 0))
    last = int(np.flatnonzero(hidden[160] < 15.0)[-1])
    assert 321 <= last <= 324  # the wall's end, a disc of one pixel, and the two of `edge_px`
    assert (hidden[160, last + 1 : last + 40] > 19.9).all()


def test_what_another_picture_saw_through_hides_nothing() -> None:
    """The moment saw nothing around a board that was there later: others tell; one of the moment hides more around."""
    board = wall(5.0, 1.0, 0.02, 0.02).astype(np.float32)
    behind = wall(20.0, 8.0, 0.05, 0.05).astype(np.float32)
    count = len(board) + len(behind)
    normal = np.tile(np.array([0, -1, 0], np.float32), (count, 1))
    points, moved = Seen(np.concatenate([board, behind]), normal, np.full(count, LATER)), np.arange(count) < len(board)

    def farthest(seen: Seen, gone: np.ndarray | None) -> np.ndarray:
        return 0.1 * np.exp(depth_images(seen, CAMERA, 0, 60.0, RULE, gone).farthest[160] / STEPS)

    assert farthest(points, None)[240] < 6.0
    assert farthest(points, moved)[240] > 19.9
    now = Seen(points.point_m, points.normal, np.where(moved, 0, LATER))
    wide = np.flatnonzero(farthest(now, moved) < 6.0).size - np.flatnonzero(farthest(now, None) < 6.0).size
    assert 20 <= wide <= 32  # 16 pixels to each side, in place of a disc and the margin
    through, there = seen_through(Seen(points.point_m, points.normal, np.where(moved, LATER, 0)), CAMERA, 0, 60.0, RULE)
    assert through[: len(board)].all() and not there[: len(board)].any()


def test_what_was_seen_through_hides_nothing_and_has_moved() -> None:
    """A board 5 m away was seen 2 s later; at the moment of the picture the wall behind was seen all over."""
    behind = wall(20.0, 8.0, 0.05, 0.05)
    _, hidden, gone = shown((behind, 0), (wall(5.0, 1.0, 0.02, 0.02), LATER))
    assert (hidden[100:220, 180:300] > 19.9).all()
    assert (gone[100:220, 180:300] > 15.0).all()  # so a point of the board has no colour here
    _, hidden, _ = shown((behind, LATER), (wall(5.0, 1.0, 0.02, 0.02), LATER))
    assert (hidden[100:220, 180:300] < 6.0).all()  # nothing speaks against the board


def test_gains_undo_exposures() -> None:
    rng = np.random.default_rng(4)
    colour = rng.uniform(40, 120, (600, 3))
    exposure = np.exp(rng.normal(0.0, 0.2, (12, 3)))
    samples = []
    for number in range(12):
        cell = np.arange(40 * number, 40 * number + 120)
        seen = colour[cell] * exposure[number] * np.exp(rng.normal(0.0, 0.02, (120, 3)))
        seen[::6] = rng.uniform(40, 120, (20, 3))  # something else stands there
        samples.append(PictureSample(cell, seen.astype(np.float32)))
    gain, compared = gains_of(samples)
    left = np.log(gain * exposure)
    assert np.abs(left - left.mean(axis=0)).max() < 0.03
    assert np.abs(np.log(gain).mean(axis=0)).max() < 1e-9
    assert (compared > 0).all()
    alone, never = gains_of(samples[:1])
    assert np.array_equal(alone, np.ones((1, 3)))
    assert never.tolist() == [0]


def test_a_share_of_points_is_spread_evenly() -> None:
    rng = np.random.default_rng(8)
    epoch, quanta = np.arange(100_000) * 1000, rng.integers(-1000, 1000, (100_000, 3)).astype(np.int32)
    kept = _kept(epoch, quanta, 0.3)
    assert abs(kept.mean() - 0.3) < 0.01
    assert np.abs(kept.reshape(100, -1).mean(axis=1) - 0.3).max() < 0.07
    assert np.array_equal(_kept(epoch[::2], quanta[::2], 0.3), kept[::2])
    assert _kept(epoch, quanta, 1.0).all()
