"""Lenses on arrays, against OpenCV and differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from roadscan.core.rig import Interior
from roadscan.pictures.lens import Lens, changed, derivatives, pixels_of, rays_of

LENS = Interior(
    width_px=1024, height_px=640, focal_px=(784.0, 781.0), principal_px=(515.2, 317.1),
    distortion=(-0.11, 0.024, 0.0004, -0.0003, 0.002),
)  # fmt: skip
SPHERE = Interior(model="equirectangular", width_px=2000, height_px=1000)  # type: ignore[call-arg]
PIXELS = np.array([[0.0, 0.0], [1023.0, 639.0], [515.2, 317.1], [100.5, 500.25], [900.0, 20.0]])


def test_points_fall_where_opencv_projects_them() -> None:
    point = np.random.default_rng(0).uniform((-4.0, -2.0, 6.0), (4.0, 2.0, 30.0), (50, 3))
    matrix = np.array([[784.0, 0.0, 515.2], [0.0, 781.0, 317.1], [0.0, 0.0, 1.0]])
    expected, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(LENS.distortion))
    np.testing.assert_allclose(pixels_of(Lens.of(LENS), point), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", [LENS, SPHERE])
def test_rays_lead_back_to_their_pixels(lens: Interior) -> None:
    ray = rays_of(Lens.of(lens), PIXELS)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(pixels_of(Lens.of(lens), 17.0 * ray), PIXELS, atol=1e-7)


def test_a_pixel_beyond_the_fold_has_no_ray() -> None:
    folded = LENS.model_copy(update={"distortion": (-0.4, 0.0, 0.0, 0.0, 0.0)})
    found = rays_of(Lens.of(folded), np.array([[515.2, 317.1], [4000.0, 3000.0]]))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


def test_points_behind_a_lens_have_no_pixel() -> None:
    assert np.isnan(pixels_of(Lens.of(LENS), np.array([[0.0, 0.0, -1.0]]))).all()


@pytest.mark.parametrize("lens", [LENS, SPHERE])
def test_derivatives_are_those_of_differences(lens: Interior) -> None:
    point = np.random.default_rng(1).uniform((-4.0, -2.0, 6.0), (4.0, 2.0, 30.0), (20, 3))
    _, by_point, by_lens = derivatives(Lens.of(lens), point)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        found = (pixels_of(Lens.of(lens), point + step) - pixels_of(Lens.of(lens), point - step)) / 2e-6
        np.testing.assert_allclose(by_point[:, :, axis], found, rtol=1e-6, atol=1e-5)
    for k in range(9 if lens is LENS else 4):
        change = np.zeros(11)
        change[k] = 1e-5
        more, less = (pixels_of(Lens.of(changed(lens, s * change)), point) for s in (1.0, -1.0))
        np.testing.assert_allclose(by_lens[:, :, k], (more - less) / 2e-5, rtol=1e-5, atol=1e-4)
