"""The rigid transformation onto control against SciPy and drawn truth, and the corrections that amount to it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.adjust.control import ControlPoint, Sighting
from roadscan.adjust.helmert import helmert, rigid_fit
from roadscan.core.errors import ConfigError
from roadscan.core.frames import ENU_FROM_NED
from roadscan.poses.trajectory import Trajectory

TURN, SHIFT = Rotation.from_euler("ZYX", [40.0, -8.0, 170.0], degrees=True), np.array([310.0, -20.0, 4.0])
POINTS = np.array([[0.0, 0.0, 0.0], [400.0, 0.0, 3.0], [0.0, 300.0, 1.0], [90.0, 40.0, 25.0], [400.0, 300.0, 9.0]])


def test_one_weight_a_point_is_what_scipy_finds() -> None:
    rng = np.random.default_rng(14)
    sigma = np.array([0.001, 0.002, 0.002, 0.003, 0.001])[:, None]
    seen = TURN.apply(POINTS) + SHIFT + sigma * rng.standard_normal(POINTS.shape)
    found = helmert(POINTS, seen, sigma)
    weights = sigma[:, 0] ** -2.0
    align, _ = Rotation.align_vectors(
        seen - np.average(seen, axis=0, weights=weights),
        POINTS - np.average(POINTS, axis=0, weights=weights),
        weights=weights,
    )
    np.testing.assert_allclose(found.rotation, align.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.apply(POINTS) + found.residual_m, seen, atol=1e-9)
    assert found.scale == 1.0


@pytest.mark.parametrize("with_scale", [False, True])
def test_covariance_is_that_of_drawn_errors(with_scale: bool) -> None:
    rng = np.random.default_rng(15)
    sigma = np.array([[0.003, 0.003, 0.002]]) * np.array([[1.0], [2.0], [1.0], [3.0], [1.0]])
    scale = 1.0002 if with_scale else 1.0
    errors, factors = [], []
    elsewhere = np.array([[700.0, -200.0, 5.0]])
    away = []
    for _ in range(300):
        seen = scale * TURN.apply(POINTS) + SHIFT + sigma * rng.standard_normal(POINTS.shape)
        found = helmert(POINTS, seen, sigma, with_scale=with_scale)
        turned = (Rotation.from_matrix(found.rotation) * TURN.inv()).as_rotvec()
        centre = found.centre_to_m - scale * TURN.apply(found.centre_from_m) - SHIFT
        errors.append([*centre, *turned, *([np.log(found.scale / scale)] if with_scale else [])])
        factors.append(found.variance_factor)
        away.append(found.apply(elsewhere)[0] - scale * TURN.apply(elsewhere)[0] - SHIFT)
    size = 7 if with_scale else 6
    normalised = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(found.covariance), errors)
    assert normalised.mean() == pytest.approx(size, rel=0.12)
    assert np.mean(factors) == pytest.approx(1.0, rel=0.06)
    np.testing.assert_allclose(np.std(away, axis=0), found.sigma_of(elsewhere)[0], rtol=0.15)


def sightings(rng: np.random.Generator, wrong_m: float) -> list[Sighting]:
    """Eight points along 300 m, each seen by three runs whose poses err by 20 mm; the survey of point 5 is wrong."""
    east = np.linspace(0.0, 300.0, 8)
    found = []
    for number, place in enumerate(np.stack([east, 10.0 * np.sin(east), 0.02 * east], axis=-1)):
        lift = wrong_m * (number == 5)
        survey = place + rng.normal(0.0, 0.002, 3) + [0.0, 0.0, lift]
        point = ControlPoint(number, f"G{number}", "gcp", "", *survey.tolist(), 0.002, 0.002, None)
        for run in range(3):
            seen = place + SHIFT + rng.normal(0.0, 0.02, 3)
            found.append(
                Sighting(
                    point, run, "p", "picked", "", 0, seen[0], seen[1], 1e-6 * np.eye(2), seen[2], 0.001, 0.0, 0.0, 9,
                    1.0, 1.0, np.zeros(3), np.eye(3), 0.0,
                )
            )  # fmt: skip
    return found


def test_a_point_that_contradicts_the_others_is_left_out_and_told_by_how_much() -> None:
    rng = np.random.default_rng(17)
    seen = sightings(rng, 0.1)
    found = rigid_fit(seen, np.full((len(seen), 3), 0.02))
    assert found.control.weight[:, 2].tolist() == [1, 1, 1, 1, 1, 0, 1, 1]
    sigma = found.control.left_out_sigma_m[5, 2]
    assert 0.02 / np.sqrt(3) < sigma < 0.02
    assert -found.control.left_out_m[5, 2] == pytest.approx(0.1, abs=3 * sigma)
    without = rigid_fit([one for one in seen if one.point.number != 5], np.full((len(seen) - 3, 3), 0.02))
    np.testing.assert_allclose(found.helmert.rotation, without.helmert.rotation, atol=1e-6)
    # Normalised left-out errors of right points over many draws.
    squares, dropped = [], 0
    for _ in range(40):
        fit = rigid_fit(sightings(rng, 0.0), np.full((24, 3), 0.02)).control
        squares.append(np.nanmean(np.square(fit.left_out_m / fit.left_out_sigma_m)))
        dropped += int((fit.weight[:, 2] == 0.0).sum())
    assert np.mean(squares) == pytest.approx(1.0, rel=0.15)
    assert dropped <= 2


def test_corrections_move_every_point_as_the_transformation_does() -> None:
    """Through the trajectory that applies them: a point of the body, before and after."""
    rng = np.random.default_rng(16)
    turn, shift = Rotation.from_rotvec([0.002, -0.001, 0.004]), np.array([0.3, -0.2, 0.05])
    found = helmert(POINTS, turn.apply(POINTS) + shift, 0.001)
    n = 20
    north_east_down = rng.uniform(-200.0, 200.0, (n, 3))
    level_from_body = Rotation.random(n, rng=rng)
    world_from_body = Rotation.from_matrix(ENU_FROM_NED) * level_from_body
    epochs = np.arange(n, dtype=np.int64) * 10**8 + 10**18
    trajectory = Trajectory.of(
        "local", epochs, north_east_down @ ENU_FROM_NED.T, world_from_body.as_quat(scalar_first=True)
    )
    moved = trajectory.corrected(found.corrections(epochs, north_east_down, level_from_body.as_matrix())).poses(epochs)
    arm = np.array([1.0, -2.0, 2.5])
    before = north_east_down + level_from_body.apply(arm)
    after = (moved.position_world_m + moved.world_from_body @ arm) @ ENU_FROM_NED
    np.testing.assert_allclose(after[:-1], (turn.apply(before) + shift)[:-1], atol=1e-9)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((2, 3)), "2 points"),
        (np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), "one line"),
        (np.full((4, 3), np.nan), "not a finite number"),
    ],
)
def test_points_that_hold_no_transformation(points: np.ndarray, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        helmert(points, points, 0.001)


def test_a_sigma_of_nought_is_refused() -> None:
    with pytest.raises(ConfigError, match="positive σ"):
        helmert(POINTS, POINTS, 0.0)
