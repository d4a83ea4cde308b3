"""Least-squares matching of patches against textures that were warped by known amounts."""

from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from roadscan.core.rig import Interior
from roadscan.pictures.kernels.patch_matching import match_patches
from roadscan.pictures.lens import Lens, pixels_of
from roadscan.pictures.ties.refining import _forms
from roadscan.pictures.ties.tracks import Chains
from roadscan.pictures.ties.work import TieWork

SIZE = 400


def texture(rng: np.random.Generator) -> np.ndarray:
    """Random grey values with detail from 2 to 20 px."""
    parts = [cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), s) * s for s in (1.5, 3.0, 8.0)]
    grey = np.sum(parts, axis=0)
    return np.clip(128.0 + 35.0 * grey / grey.std(), 0.0, 255.0)


def warped(first: np.ndarray, form: np.ndarray) -> np.ndarray:
    """The picture whose pixel q shows the pixel of the first one that a form (2, 3; of column, row) takes to q."""
    back = np.linalg.inv(form[::-1, 1::-1])  # rows first
    return np.asarray(ndimage.affine_transform(first, back, -back @ form[::-1, 2], order=5, mode="reflect"))


def smoothed(picture: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "turn", "shear"), [(1.0, 0.0, 0.0), (1.15, 0.05, 0.1), (0.9, -0.05, -0.08)])
def test_places_are_found_to_a_few_hundredths_of_a_pixel(scale: float, turn: float, shear: float) -> None:
    rng = np.random.default_rng(7)
    first = texture(rng)
    middle = np.array([SIZE / 2, SIZE / 2])
    form = scale * np.array([[np.cos(turn), -np.sin(turn) + shear], [np.sin(turn), np.cos(turn)]])
    move = middle - form @ middle + [3.37, -2.81]
    second = 0.8 * warped(first, np.column_stack([form, move])) + 12.0 + rng.normal(0.0, 1.0, first.shape)
    places = rng.uniform(80.0, SIZE - 80.0, (150, 2))
    true = places @ form.T + move
    guesses = true + rng.uniform(-0.6, 0.6, true.shape)
    found = np.empty_like(true)
    match_patches(smoothed(first), smoothed(second), places, guesses, np.tile(scale * np.eye(2), (150, 1, 1)), found)
    off = np.hypot(*(found - true).T)
    assert np.isfinite(off).mean() > 0.95
    assert np.sqrt(np.nanmean(off**2)) < 0.05
    # No common error, which is what bends a drive.
    assert np.abs(np.nanmean(found - true, axis=0)).max() < 0.01


def test_what_shows_something_else_is_not_found() -> None:
    rng = np.random.default_rng(8)
    first, other = smoothed(texture(rng)), smoothed(texture(rng))
    places, found = rng.uniform(80.0, SIZE - 80.0, (100, 2)), np.empty((100, 2))
    match_patches(first, other, places, places.copy(), np.tile(np.eye(2), (100, 1, 1)), found)
    assert np.isnan(found[:, 0]).mean() > 0.95
    flat = np.full((SIZE, SIZE), 90.0, np.float32)
    match_patches(flat, flat, places, places.copy(), np.tile(np.eye(2), (100, 1, 1)), found)
    assert np.isnan(found).all()
    edge = np.array([[2.0, 200.0], [396.0, 200.0], [200.0, 1.0]])
    match_patches(first, first, edge, edge.copy(), np.tile(np.eye(2), (3, 1, 1)), found[:3])
    assert np.isnan(found[:3]).all()


def test_the_form_of_a_patch_is_that_of_the_two_cameras() -> None:
    """One is rolled by a quarter and has the longer lens: a thing that faces the first is moved by little steps."""
    lenses = [Lens.of(Interior(width_px=800, height_px=500, focal_px=(f, f), principal_px=(400.0, 250.0),
                               distortion=(-0.1, 0.02, 0.0, 0.0, 0.0))) for f in (500.0, 900.0)]  # fmt: skip
    turns = [np.eye(3), Rotation.from_euler("zyx", [90.0, 8.0, -5.0], degrees=True).as_matrix()]
    eyes = [np.zeros(3), np.array([0.3, -0.2, 4.0])]
    places = np.array([[1.0, 0.5, 15.0], [-3.0, 1.5, 20.0], [0.2, -1.0, 12.0]])
    both = [(places - eye) @ turn for eye, turn in zip(eyes, turns, strict=True)]
    pixel = [pixels_of(lens, seen) for lens, seen in zip(lenses, both, strict=True)]
    poses = SimpleNamespace(
        cameras=[SimpleNamespace(lens=lens) for lens in lenses], camera=np.array([0, 1]),
        at=lambda rows: SimpleNamespace(world_from_opencv=np.array(turns)[rows]),
    )  # fmt: skip
    chains = Chains(np.tile([0, 1, 2], 2), np.repeat([0, 1], 3), np.concatenate(pixel), np.ones(6))
    work = cast(TieWork, SimpleNamespace(exposures=poses))
    form = _forms(work, chains, np.concatenate(both), np.arange(3), np.arange(3, 6))
    for k, place in enumerate(places):
        across = np.linalg.svd(place[None])[2][1:]  # two directions across the ray from the first camera
        moved = [[pixels_of(lens, ((place + 1e-4 * a - eye) @ turn)[None])[0] for a in across]
                 for eye, turn, lens in zip(eyes, turns, lenses, strict=True)]  # fmt: skip
        first, second = (np.array(m) - pixel[i][k] for i, m in enumerate(moved))
        np.testing.assert_allclose(first @ form[k].T, second, atol=2e-3 * np.abs(second).max())
