"""Tie points: matches by the poses' geometry, tracks, and the places where their rays meet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from roadscan.pictures.ties.matching import Relative, features_of, matches
from roadscan.pictures.ties.tracks import places_of, spread, tracks_of, widest_parallax_rad

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]

PIXEL_RAD = 1.0 / 700.0


def test_features_are_spread_and_keep_off_what_is_hidden() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (40, 60), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    hidden = np.zeros(picture.shape, bool)
    hidden[200:] = True
    found = features_of(picture, 300, hidden)
    assert len(found) == 300
    assert found.pixel[:, 1].max() < 200
    columns = np.bincount((found.pixel[:, 0] * 6 / picture.shape[1]).astype(int), minlength=6)
    assert columns.min() > 30
    again = features_of(picture, 300, hidden)
    np.testing.assert_array_equal(found.descriptor, again.descriptor)


def test_a_black_picture_has_no_feature() -> None:
    assert len(features_of(np.zeros((200, 300), np.uint8), 100)) == 0


def _two_pictures(false: float, seed: int) -> tuple[Float64, Float64, UInt8, UInt8]:
    """Rays of 400 places in two cameras, with descriptors; a share of those of the second belongs to other places."""
    rng = np.random.default_rng(seed)
    place = rng.uniform((-8.0, -3.0, 5.0), (8.0, 2.0, 40.0), (400, 3))
    turn, base = Rotation.from_rotvec([0.01, 0.02, -0.005]).as_matrix(), np.array([0.05, 0.02, 1.2])
    first, second = place, (place - base) @ turn.T
    one, other = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
    other += 0.3 * PIXEL_RAD * rng.normal(size=other.shape)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    alike = rng.integers(0, 200, (400, 128), dtype=np.uint8)
    noisy = np.clip(alike + rng.integers(-15, 15, alike.shape), 0, 255).astype(np.uint8)
    wrong = rng.permutation(400)[: round(400 * false)]
    noisy[wrong] = noisy[np.roll(wrong, 1)]
    return one, other, alike, noisy


@pytest.mark.parametrize("false", [0.0, 0.3])
def test_matches_hold_though_the_stated_pose_is_off(false: float) -> None:
    one, other, alike, noisy = _two_pictures(false, 1)
    off = Rotation.from_rotvec(np.radians([0.2, -0.15, 0.1])).as_matrix()
    turn = off @ Rotation.from_rotvec([0.01, 0.02, -0.005]).as_matrix()
    stated = Relative(turn, np.array([0.09, -0.01, 1.2]), np.radians(0.2), 0.05)
    found, against = matches((one, alike), (other, noisy), stated, PIXEL_RAD)
    right = found[:, 0] == found[:, 1]
    assert right.sum() > 0.9 * (1.0 - false) * 400
    # What lies on the epipolar line by chance stays: a few in a hundred.
    assert (~right).sum() <= 0.05 * len(found)
    assert against <= 400 - len(found)


def test_two_pictures_of_other_streets_have_no_match() -> None:
    one, _, alike, _ = _two_pictures(0.0, 2)
    _, other, _, noisy = _two_pictures(0.0, 3)
    stated = Relative(np.eye(3), np.array([0.0, 0.0, 1.2]), np.radians(0.2), 0.05)
    assert len(matches((one, alike), (other, noisy), stated, PIXEL_RAD)[0]) == 0


def test_tracks_join_pairs_and_leave_out_what_is_ambiguous() -> None:
    picture = np.array([0, 0, 1, 1, 2, 2])
    # 0–2–4 is one place; 1–3 and 3–5 and 1–4 would put two features of picture 2 into one track.
    features, track = tracks_of(np.array([0, 2]), np.array([2, 4]), picture)
    np.testing.assert_array_equal(features, [0, 2, 4])
    np.testing.assert_array_equal(track, [0, 0, 0])
    features, _ = tracks_of(np.array([1, 3, 1]), np.array([3, 5, 4]), picture)
    assert features.size == 0


def test_rays_meet_in_their_place() -> None:
    rng = np.random.default_rng(4)
    place = rng.uniform((-5.0, 5.0, 0.0), (5.0, 30.0, 3.0), (30, 3))
    track = np.repeat(np.arange(30), 3)
    eye = np.tile([[0.0, 0.0, 1.5], [0.0, 1.0, 1.5], [0.3, 2.0, 1.5]], (30, 1))
    ray = place[track] - eye
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    found = places_of(track, eye, ray)
    np.testing.assert_allclose(found.place_m, place, atol=1e-6)
    np.testing.assert_allclose(found.distance_m, np.linalg.norm(place[track] - eye, axis=1), atol=1e-6)
    assert np.nanmax(found.residual_rad) < 1e-7
    to_eye = eye[:3] - place[0]
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    expected = np.arccos(to_eye @ to_eye[0]).max()
    assert widest_parallax_rad(track, eye, place)[0] == pytest.approx(expected, abs=1e-9)


def test_parallel_rays_meet_nowhere() -> None:
    found = places_of(np.zeros(2, np.int64), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[0.0, 1, 0]] * 2))
    assert np.isnan(found.place_m).all()


def test_long_tracks_come_first_and_cells_get_their_share() -> None:
    rng = np.random.default_rng(5)
    length = rng.integers(2, 9, 500)
    track = np.repeat(np.arange(500), length)
    picture = np.concatenate([np.arange(n) for n in length])
    pixel = rng.uniform((0, 0), (1000, 600), (500, 2))[track]
    kept = spread(track, picture, pixel, np.tile([1000.0, 600.0], (track.size, 1)), 60)
    assert length[kept].mean() > length.mean() + 1.0
    counts = np.bincount(picture[kept[track]])
    assert counts.max() <= 2 * 60
