"""Which picture shows a point, against OpenCV's projection; what is sampled, against SciPy's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Interior
from roadscan.pictures.lens import Lens
from roadscan.pictures.views import NO_VIEW, PictureRule, Views, best_views, sampled

LENSES = (
    Interior(width_px=640, height_px=400, focal_px=(410.0, 405.0), principal_px=(322.0, 195.0),
             distortion=(-0.21, 0.06, 0.0015, -0.002, -0.01)),
    Interior(width_px=900, height_px=700, focal_px=(900.0, 905.0), principal_px=(440.0, 355.0)),
)  # fmt: skip
HIDDEN = ((100.0, 300.0), (540.0, 300.0), (540.0, 399.0), (100.0, 399.0))
RULE = PictureRule((), reach_m=9.0, least_angle_deg=12.0, border_px=20)


def views(rng: np.random.Generator, count: int) -> Views:
    """Cameras two metres above a road, looking down at all angles, in two world frames 1,000 km from their origins."""
    eye = np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.uniform(1.8, 2.4, count)])
    heading, pitch, roll = rng.uniform(0, 360, count), rng.uniform(10, 60, count), rng.normal(0, 3, count)
    sensor = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll]), degrees=True).as_matrix()
    # x ahead, y left, z up → x right, y down, z ahead.
    turn = np.stack([-sensor[:, :, 1], -sensor[:, :, 2], sensor[:, :, 0]], axis=1)
    world = rng.integers(0, 2, count)
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    lenses = (Lens.of(LENSES[0], (HIDDEN,)), Lens.of(LENSES[1]))
    return Views(eye + 1e6 * world[:, None], turn, up, world, rng.integers(0, 2, count), lenses)


def by_opencv(point_m: np.ndarray, seen: Views) -> tuple[np.ndarray, np.ndarray]:
    """Number and pixel of the picture of least distance over focal length, by brute force."""
    best, number, pixel = np.full(len(point_m), np.inf), np.full(len(point_m), NO_VIEW), np.full((len(point_m), 2), 0.0)
    for k in range(len(seen)):
        interior = LENSES[seen.lens[k]]
        (fx, fy), (cx, cy) = interior.focal_px, interior.principal_px
        eye = seen.eye_world_m[k] - 1e6 * seen.world[k]
        local = (point_m - eye) @ seen.opencv_from_world[k].T
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        found, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), matrix, np.array(interior.distortion))
        u, v = found.reshape(-1, 2).T
        distance = np.linalg.norm(point_m - eye, axis=1)
        dip = np.degrees(np.arcsin((eye[2] - point_m[:, 2]) / distance))
        inside = (u >= 20) & (v >= 20) & (u <= interior.width_px - 21) & (v <= interior.height_px - 21)
        # Away from the axis by no more than the picture's corners: farther out the model folds back.
        ahead = (local[:, 2] > 0.1) & (np.hypot(*local[:, :2].T) < 1.2 * local[:, 2])
        hidden = (seen.lens[k] == 0) & (np.abs(np.rint(u) - 320) <= 220) & (np.rint(v) >= 300)
        score = distance**2 / (fx * fy)
        take = ahead & inside & ~hidden & (dip >= 12.0) & (distance <= 9.0) & (score < best)
        best[take], number[take], pixel[take] = score[take], k, np.column_stack([u, v])[take]
    return number, pixel


def test_the_finest_picture_that_shows_a_point() -> None:
    rng = np.random.default_rng(4)
    point = np.column_stack([rng.uniform(-12, 12, (4000, 2)), rng.normal(0.0, 0.05, 4000)])
    seen = views(rng, 25)
    shown = best_views([point, point + 1e6], seen, RULE)
    number, pixel = by_opencv(point, seen)
    assert np.array_equal(shown.view, number)
    assert 0.1 < np.mean(number == NO_VIEW) < 0.9 and np.unique(number).size > 20
    found = number != NO_VIEW
    assert np.abs(shown.pixel[found] - pixel[found]).max() < 1e-6  # metres at 1,000 km hold 1e-10
    # What a point gets does not depend on the others, nor a picture that it is not taken from.
    some = rng.permutation(4000)[:700]
    again = best_views([point[some], point[some] + 1e6], seen, RULE)
    assert again.view.tobytes() == shown.view[some].tobytes() and again.pixel.tobytes() == shown.pixel[some].tobytes()
    worst = int(np.bincount(number[found]).argmax())
    without = best_views([point, point + 1e6], seen, RULE, {worst})
    kept = shown.view != worst
    assert np.array_equal(without.view[kept], shown.view[kept]) and worst not in without.view


def test_of_equals_the_first_stays() -> None:
    one = views(np.random.default_rng(2), 6)
    point = one.eye_world_m + 3.0 * one.opencv_from_world[:, 2]
    worlds = [point - 1e6 * one.world[:, None], point + 1e6 * (1 - one.world[:, None])]
    twice = one.picked(np.repeat(np.arange(6), 2))
    shown = best_views(worlds, twice, PictureRule((), 9.0, 5.0, 1))
    assert (shown.view % 2 == 0).all() and shown.view.min() >= 0


def test_a_lens_that_folds_shows_nothing_beyond() -> None:
    interior = LENSES[0].model_copy(update={"distortion": (-0.3, 0.0, 0.0, 0.0, 0.0)})
    up = np.array([[0.0, 0.0, 1.0]])
    down = np.array([[[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]])
    number = np.zeros(1, np.int64)
    seen = Views(np.array([[0.0, 0.0, 2.0]]), down, up, number, number, (Lens.of(interior),))
    point = np.array([[0.5, 0.0, 0.0], [3.4, 0.0, 0.0]])  # r − 0.3 r³ is 0.25 at r = 0.25, and again beyond the fold
    rule = PictureRule((), 9.0, 5.0, 1)
    assert best_views([point], seen, rule).view.tolist() == [0, NO_VIEW]
    pinhole = Views(np.array([[0.0, 0.0, 2.0]]), down, up, number, number, (Lens.of(LENSES[1]),))
    assert best_views([point[:1]], pinhole, rule).view.tolist() == [0]


def test_samples_are_bilinear() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    pixel = np.column_stack([rng.uniform(0, 59, 500), rng.uniform(0, 39, 500)])
    pixel[0] = (59.0, 39.0)
    expected = [map_coordinates(picture[:, :, c].astype(float), pixel.T[::-1], order=1) for c in range(3)]
    assert np.abs(sampled(picture, pixel) - np.stack(expected, axis=-1)).max() <= 0.5 + 1e-9


def test_a_pinhole_has_no_fold() -> None:
    assert np.isinf(Lens.of(LENSES[1]).parameters[9])
    assert Lens.of(LENSES[0], (HIDDEN,)).hidden.sum() == 441 * 100


def test_a_picture_of_360_degrees_shows_what_lies_all_around() -> None:
    """Against the angles of spherical trigonometry; the finest of two such pictures and a pinhole is taken."""
    size = {"width_px": 1600, "height_px": 800}
    ball = Interior.parse({"model": "equirectangular", **size})
    assert ball.focal_px == pytest.approx((800 / np.pi, 800 / np.pi)) and ball.principal_px == (799.5, 399.5)
    rng = np.random.default_rng(6)
    sensor = Rotation.from_euler("ZYX", [130.0, 7.0, -4.0], degrees=True).as_matrix()
    turn = np.stack([-sensor[:, 1], -sensor[:, 2], sensor[:, 0]])
    eye = np.array([[1.0, 2.0, 2.3], [7.0, 2.0, 2.3]])
    number = np.zeros(2, np.int64)
    seen = Views(eye, np.stack([turn, turn]), np.tile([0.0, 0.0, 1.0], (2, 1)), number, number, (Lens.of(ball),))
    point = eye[rng.integers(0, 2, 3000)] + rng.normal(0.0, 3.0, (3000, 3))
    shown = best_views([point], seen, PictureRule((), 9.0, -90.0, 1))
    nearer = np.linalg.norm(point[:, None] - eye, axis=2).argmin(axis=1)
    local = np.einsum("ij,nj->ni", turn, point - eye[nearer])
    zenith = np.degrees(np.arccos(-local[:, 1] / np.linalg.norm(local, axis=1)))
    azimuth = np.degrees(np.arctan2(local[:, 0], local[:, 2]))
    expected = np.column_stack([(azimuth + 180.0) / 360.0 * 1600 - 0.5, zenith / 180.0 * 800 - 0.5])
    inside = ((expected >= 1) & (expected <= [1598, 798])).all(axis=1) & (np.linalg.norm(local, axis=1) < 9.0)
    assert inside.mean() > 0.95 and (local[inside, 2] < 0).mean() > 0.3
    assert np.array_equal(shown.view[inside], nearer[inside])
    assert np.abs(shown.pixel[inside] - expected[inside]).max() < 1e-6


@pytest.mark.parametrize(
    ("values", "wrong"),
    [
        (
            {"model": "equirectangular", "width_px": 800, "height_px": 400, "distortion": [0.1, 0, 0, 0, 0]},
            "distortion",
        ),
        (
            {"model": "equirectangular", "width_px": 800, "height_px": 400, "focal_px": [100.0, 127.0]},
            "more than a turn",
        ),
        ({"width_px": 800, "height_px": 400}, "focal_px"),
    ],
)
def test_an_interior_orientation_that_cannot_be_is_refused(values: dict[str, object], wrong: str) -> None:
    with pytest.raises(ConfigError, match=wrong):
        Interior.parse(values)
