"""Orientations beside other evidence: in full or not at all, and with the errors they share."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from roadscan.calibrate.estimator import Prior, calibrate
from roadscan.calibrate.evidence import AttitudeInfluence, Directions, Orientation
from roadscan.calibrate.observations import observations
from roadscan.calibrate.orientations import joint_covariance
from roadscan.calibrate.unknowns import Unknowns
from roadscan.core.errors import NavigationError
from roadscan.core.rig import Mounting

HEADS = ("left", "right")
COARSE_RAD, FINE_RAD = np.radians(0.03), np.radians(0.0006)
"""σ of many directions together, and of an orientation."""
PRIORS = {
    name: Prior(Mounting((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))), (0.0,) * 3, (0.02,) * 3)
    for name in HEADS
}


def directions(name, rotation, rng, count=200) -> Directions:
    """Directions that an orientation of σ 0.03° (each axis about) can be told from."""
    body = rng.standard_normal((count, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    sigma = COARSE_RAD * np.sqrt(2 * count / 3)
    noisy = Rotation.from_rotvec(rng.normal(0, sigma, (count, 3))).apply(body)
    return Directions("coarse", name, rotation.inv().apply(noisy), body, np.full(count, sigma))


def orientation(name, rotation, sigma_rad=FINE_RAD) -> Orientation:
    return Orientation("head", name, rotation.as_matrix(), sigma_rad**2 * np.eye(3))


def found_of(calibration, name) -> Rotation:
    return Rotation.from_matrix(calibration.sensors[name].mounting.arrays()[0])


@pytest.mark.parametrize("seed", range(4))
def test_a_good_orientation_counts_where_others_differ(seed):
    """Gravity differs by three σ in roll and pitch, which is no reason to follow coarse directions in the heading."""
    rng = np.random.default_rng(seed)
    evidence, true = [], {}
    down = np.tile([0.0, 0.0, 1.0], (50, 1))
    for name in HEADS:
        true[name] = Rotation.from_rotvec(rng.normal(0, 0.01, 3))
        off = Rotation.from_rotvec(2 * COARSE_RAD * np.array([0.0, 0.0, rng.choice([-1, 1])]))
        tilt = Rotation.from_rotvec(3 * FINE_RAD * np.r_[rng.choice([-1, 1], 2), 0.0])
        felt = (tilt * true[name]).inv().apply(down)
        evidence += [
            Directions("gravity", name, felt, down, np.full(50, FINE_RAD * np.sqrt(50))),
            directions(name, off * true[name], rng),
            orientation(name, true[name]),
        ]
    found = calibrate(PRIORS, evidence, {})
    (head,) = (kind for kind in found.kinds if kind.kind == "head")
    assert (head.count, head.rejected, head.down_weighted, head.variance_factor) == (2, 0, 0, 1.0)
    for name in HEADS:
        error = (found_of(found, name) * true[name].inv()).as_rotvec()
        assert np.abs(error[:2]).max() < 2.0 * FINE_RAD
        assert abs(error[2]) < 0.2 * FINE_RAD
        assert found.sensors[name].sigma[5] == pytest.approx(FINE_RAD, rel=0.01)


def test_an_orientation_that_contradicts_all_else_is_left_out_and_counted():
    rng = np.random.default_rng(3)
    true = {name: Rotation.from_rotvec(rng.normal(0, 0.01, 3)) for name in HEADS}
    wrong = Rotation.from_rotvec([0.0, 10 * COARSE_RAD, 0.0])
    evidence = [directions(name, true[name], rng) for name in HEADS]
    evidence += [orientation("left", wrong * true["left"]), orientation("right", true["right"])]
    found = calibrate(PRIORS, evidence, {})
    (head,) = (kind for kind in found.kinds if kind.kind == "head")
    assert (head.count, head.rejected) == (2, 1)
    assert {f.sensors: f.rejected for f in found.figures if f.kind == "head"} == {"left": 1, "right": 0}
    error = (found_of(found, "left") * true["left"].inv()).as_rotvec()
    assert error @ error / COARSE_RAD**2 < chi2.ppf(0.999, 3)
    assert found.sensors["left"].sigma[4] > 10 * FINE_RAD
    assert np.abs((found_of(found, "right") * true["right"].inv()).as_rotvec()).max() < FINE_RAD


def test_what_nothing_else_knows_is_not_contradicted():
    """The prior alone is no evidence against an orientation, be it ever so good."""
    rotation = Rotation.from_rotvec([0.01, -0.02, 0.015])
    found = calibrate(PRIORS, [orientation("left", rotation, 1e-7), orientation("right", rotation, 1e-7)], {})
    assert found.kinds[0].rejected == 0
    assert (found_of(found, "left") * rotation.inv()).magnitude() < 1e-8


def shared(epochs_s, rng, sigma=(1e-5, 2e-5, 4e-5), start_s=0.0) -> AttitudeInfluence:
    epochs = np.rint((np.asarray(epochs_s) + start_s) * 1e9).astype(np.int64)
    return AttitudeInfluence(epochs, rng.normal(0, 0.3, (3, epochs.size, 3)), sigma, 60.0)


def test_the_joint_covariance_is_that_of_the_errors_put_through():
    """Against the covariance of all errors at all epochs, put through both influences at once."""
    rng = np.random.default_rng(8)
    runs = [(shared([0, 2, 4, 6], rng), shared([1, 3, 5], rng)), (shared([0, 5], rng, start_s=500), None)]
    own = 1e-10 * np.eye(3)
    matrix, power = [], []
    for first, second in runs:
        both = [one for one in (first, second) if one is not None]
        epochs = np.concatenate([one.epoch_gps_ns for one in both]) / 1e9
        alike = np.exp(-np.abs(epochs[:, None] - epochs) / 60.0)
        power.append(np.kron(alike, np.diag(np.square(first.sigma_roll_pitch_heading_rad))))
        rows = [np.zeros((3, 3 * epochs.size)) for _ in HEADS]
        begin = 0
        for row, one in zip(rows, both, strict=False):
            row[:, begin : begin + 3 * one.epoch_gps_ns.size] = one.influence.reshape(3, -1)
            begin += 3 * one.epoch_gps_ns.size
        matrix.append(np.concatenate(rows))
    influence = np.concatenate(matrix, axis=1)
    expected = influence @ block_diag(*power) @ influence.T + block_diag(own, own)
    attitudes = [tuple(pair[i] for pair in runs if pair[i] is not None) for i in range(2)]
    members = [
        Orientation("head", name, np.eye(3), expected[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], attitudes[i])
        for i, name in enumerate(HEADS)
    ]
    assert joint_covariance(members) == pytest.approx(expected, rel=1e-9, abs=1e-20)


def test_heads_do_not_average_out_what_they_share():
    """Two heads that are known against each other: their mean is as good as the trajectory, not better by √2."""
    rng = np.random.default_rng(9)
    one = shared([0, 2, 4], rng)
    alike = np.exp(-np.abs(np.subtract.outer([0, 2, 4], [0, 2, 4])) / 60.0)
    power = np.kron(alike, np.diag(np.square(one.sigma_roll_pitch_heading_rad)))
    common = one.influence.reshape(3, -1) @ power @ one.influence.reshape(3, -1).T
    covariance = common + 1e-12 * np.eye(3)
    found = calibrate(PRIORS, [Orientation("head", n, np.eye(3), covariance, (one,)) for n in HEADS], {})
    mean = np.hstack([np.eye(3), np.eye(3)]) / 2
    turns = np.r_[3:6, 9:12]
    expected = common + 0.5e-12 * np.eye(3)
    assert mean @ found.covariance[np.ix_(turns, turns)] @ mean.T == pytest.approx(expected, rel=1e-4, abs=1e-16)


def test_derivatives_of_orientations_that_share_errors():
    rng = np.random.default_rng(10)
    one = shared([0, 2, 4], rng)
    members = [
        Orientation("head", n, Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), 1e-8 * np.eye(3), (one,))
        for n in HEADS
    ]
    unknowns = Unknowns(PRIORS, {})
    (observed,) = observations(members, unknowns)
    z = rng.normal(0, 0.7, unknowns.size)
    now = unknowns.geometry(z)
    information, slope = np.zeros((unknowns.size,) * 2), np.zeros(unknowns.size)
    observed.add(now, np.ones(2), information, slope)
    step = 1e-5 * np.eye(unknowns.size)
    sides = [[observed.residuals(unknowns.geometry(z + w * d)).ravel() for d in step] for w in (1, -1)]
    jacobian = (np.array(sides[0]) - np.array(sides[1])).T / 2e-5
    found = now.derivative.T @ information @ now.derivative
    assert np.abs(found - jacobian.T @ jacobian).max() < 1e-6 * np.abs(found).max()
    expected = jacobian.T @ observed.residuals(now).ravel()
    assert np.abs(now.derivative.T @ slope - expected).max() < 1e-6 * np.abs(expected).max()


def test_shares_that_are_larger_than_the_whole_are_refused():
    one = shared([0, 2], np.random.default_rng(11), sigma=(0.1, 0.1, 0.1))
    members = [Orientation("head", n, np.eye(3), 1e-10 * np.eye(3), (one,)) for n in HEADS]
    with pytest.raises(NavigationError, match="errors they share"):
        observations(members, Unknowns(PRIORS, {}))
