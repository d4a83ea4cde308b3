"""Errors of the poses of two pictures, told at some epochs, held against processes whose covariance is known."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.pictures.lens import JOINT, JointCovariances

NS = 1_000_000_000
SIZE = np.array([0.02, 0.02, 0.03, 1e-3, 1e-3, 2e-3])
MIXED = np.linalg.qr(np.random.default_rng(3).normal(size=(6, 6)))[0] * SIZE[:, None]
STEPS = MIXED @ MIXED.T
"""Covariance (6, 6) that a random walk of the poses gains in a second."""
START = np.diag((3.0 * SIZE) ** 2)


def walked(first_s: float, second_s: float) -> np.ndarray:
    """The covariance of a random walk (Wiener process) with itself: that which it had at the earlier time."""
    return START + min(first_s, second_s) * STEPS


def told(seconds: list[float], count: int) -> JointCovariances:
    epochs = np.round(np.array(seconds) * NS).astype(np.int64)
    covariance = np.zeros((len(seconds), JOINT, JOINT))
    covariance[:, :6, :6] = [walked(s, s) for s in seconds]
    later = tuple(
        np.array([walked(s, t) for t in seconds[k + 1 : k + 1 + count]]).reshape(-1, 6, 6)
        for k, s in enumerate(seconds)
    )
    return JointCovariances(epochs, covariance, later)


@pytest.mark.parametrize("pair", [(0.0, 0.5), (0.2, 0.4), (0.4, 0.4), (0.7, 2.1), (1.6, 0.3), (2.2, 2.2), (0.0, 2.6)])
def test_between_epochs_errors_are_those_of_a_random_walk(pair: tuple[float, float]) -> None:
    joint = told([0.0, 0.5, 1.2, 1.7, 2.2, 2.6], 5)
    found = joint.between(*(round(s * NS) for s in pair), 60.0)
    np.testing.assert_allclose(found / np.outer(SIZE, SIZE), walked(*pair) / np.outer(SIZE, SIZE), atol=1e-6)


def test_a_pose_hangs_together_with_itself_as_its_own_covariance_says() -> None:
    joint = told([0.0, 0.5, 1.2], 2)
    for epoch in (0, 200_000_000, 500_000_000, 1_000_000_000, 1_200_000_000):
        own = joint.at(np.array([epoch]))[0, :6, :6]
        np.testing.assert_allclose(joint.between(epoch, epoch, 60.0), own, atol=1e-12)


def test_beyond_what_is_told_errors_of_poses_fade_and_those_of_the_mounting_stay() -> None:
    seconds = [0.0, 1.0, 2.0, 3.0, 4.0]
    joint = told(seconds, 2)
    # A mounting error that each pose takes up wholly beside its own errors.
    joint.covariance[:, 6:9, 6:9] = np.diag([0.01**2] * 3)
    joint.covariance[:, :3, 6:9] = joint.covariance[:, 6:9, :3] = -np.diag([0.01**2] * 3)
    joint.covariance[:, :3, :3] += np.diag([0.01**2] * 3)
    for own in joint.later:
        own[:, :3, :3] += np.diag([0.01**2] * 3)
    found = joint.between(0, 4 * NS, 2.0)
    expected = np.exp(-1.0) * START
    expected[:3, :3] += np.diag([0.01**2] * 3)
    np.testing.assert_allclose(found / np.outer(SIZE, SIZE), expected / np.outer(SIZE, SIZE), atol=1e-6)


def test_without_covariances_of_pairs_nothing_is_told() -> None:
    joint = told([0.0, 1.0], 1)
    assert JointCovariances(joint.epochs_gps_ns, joint.covariance).between(0, NS, 60.0) is None
