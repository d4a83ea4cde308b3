"""Mountings by least squares: known mountings come back with honest σ, and what is not determined stays as it was."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from roadscan.calibrate.estimator import Estimate, ObjectPose, Prior, calibrate, priors_of
from roadscan.calibrate.evidence import Directions, Known, Orientation, Seen, Ties, Traverse
from roadscan.calibrate.in_words import mounting_rows, report
from roadscan.calibrate.observations import observations
from roadscan.calibrate.unknowns import Geometry, Unknowns
from roadscan.core.errors import ConfigError, NavigationError
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.rig import Mounting, Sensor
from roadscan.core.settings.calibration import CalibrationSettings
from roadscan.store.schema import table_schema

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="many ties")

LEVER_ARMS = {"left": (-2.3, -1.0, -1.1), "lidar": (-1.7, 0.1, -1.4)}
LEVER_SIGMA_M, BORESIGHT_SIGMA_RAD = 0.03, np.radians(1.0)
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.006, np.radians(0.004)
EVERY_SIDE = (0.0, 180.0, 90.0, 270.0)


def mounting(lever_arm_m, rotation=None) -> Mounting:
    matrix = np.eye(3) if rotation is None else rotation.as_matrix()
    return Mounting(tuple(map(float, lever_arm_m)), tuple(tuple(map(float, row)) for row in matrix))


def prior(lever_arm_m, lever_sigma_m=LEVER_SIGMA_M, boresight_sigma_rad=BORESIGHT_SIGMA_RAD, **more) -> Prior:
    return Prior(mounting(lever_arm_m), (lever_sigma_m,) * 3, (boresight_sigma_rad,) * 3, **more)


def traverse(run="run-1", sigma_m=POSE_SIGMA_M, sigma_rad=POSE_SIGMA_RAD, epoch_gps_ns=0) -> Traverse:
    return Traverse(run, epoch_gps_ns, (sigma_m,) * 3, (sigma_rad,) * 3, ENU_FROM_NED)


@dataclass
class Yard:
    """Places seen by sensors whose true mountings are known, from a vehicle whose poses are stated with errors."""

    rng: np.random.Generator
    sensors: tuple[str, ...] = ("left", "lidar")
    headings_deg: tuple[float, ...] = EVERY_SIDE
    flat: bool = False
    springs_deg: float = 1.0
    off: float = 1.0
    pose_sigma_m: float = POSE_SIGMA_M
    pose_sigma_rad: float = POSE_SIGMA_RAD
    one_place: bool = False
    """All is seen from one pose of a traverse."""

    def __post_init__(self) -> None:
        draw = self.rng.standard_normal
        self.priors = {name: prior(LEVER_ARMS[name]) for name in self.sensors}
        self.true = {
            name: (
                Rotation.from_rotvec(self.off * BORESIGHT_SIGMA_RAD * draw(3)),
                np.array(LEVER_ARMS[name]) + self.off * LEVER_SIGMA_M * draw(3),
            )
            for name in self.sensors
        }
        self.traverses = {
            10 + i: traverse(f"run-{i}", self.pose_sigma_m, self.pose_sigma_rad) for i in range(len(self.headings_deg))
        }
        self.pose_errors = {key: (self.pose_sigma_m * draw(3), self.pose_sigma_rad * draw(3)) for key in self.traverses}

    def seen(self, place, sensor, key) -> Seen:
        """Places (n, 3) east, north, up as a sensor saw them in a traverse, without noise."""
        n = len(place)
        heading = self.headings_deg[key - 10] + self.rng.normal(0, self.springs_deg, n)
        tilt = self.rng.normal(0, 0.0 if self.flat else self.springs_deg, (n, 2))
        body = Rotation.from_euler("ZYX", np.column_stack([heading, tilt]), degrees=True).as_matrix()
        world_from_body = ENU_FROM_NED @ body
        position = place + 2 * world_from_body[:, :, 0] + np.array([0, 0, 1.5])
        position += self.rng.normal(0, [0.5, 0.5, 0.02], (n, 3))
        if self.one_place:
            position[:] = position[0] = [0.0, 2.0, 1.5]
        rotation, lever = self.true[sensor]
        in_body = np.einsum("nji,nj->ni", world_from_body, place - position)
        point = rotation.inv().apply(in_body - lever)
        shift, turn = self.pose_errors[key]
        stated = world_from_body @ Rotation.from_rotvec(turn).inv().as_matrix()
        return Seen(sensor, point, position - ENU_FROM_NED @ shift, stated, np.full(n, key))

    def ties(self, count, sigma_m=0.002, stated_sigma_m=None, outliers=0.0, pairs=None) -> list[Ties]:
        """`count` ties of each pair of sensor and traverse."""
        stated_sigma_m = stated_sigma_m or sigma_m
        ends = [(s, k) for k in self.traverses for s in self.sensors]
        pairs = pairs or [(a, b) for i, a in enumerate(ends) for b in ends[i:] if a != b or a[1] != b[1]]
        found = []
        for (first, key), (second, other) in pairs:
            ground = [1.0, 1.0, 0.0 if self.flat else 1.0]
            place = self.rng.uniform([-3, -3, 0], [3, 3, 1], (count, 3)) * ground
            normal = self.rng.standard_normal((count, 3)) * ([0, 0, 1] if self.flat else [0.5, 0.5, 1.0])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            away = self.rng.normal(0, sigma_m, count)
            wrong = self.rng.random(count) < outliers
            away[wrong] += self.rng.choice([-1, 1], wrong.sum()) * self.rng.uniform(0.05, 0.3, wrong.sum())
            one, two = self.seen(place, first, key), self.seen(place, second, other)
            along = np.einsum("nji,nj->ni", one.world_from_body @ self.true[first][0].as_matrix(), normal)
            one = replace(one, point_sensor_m=one.point_sensor_m + away[:, None] * along)
            found.append(Ties("loops", one, two, (normal / stated_sigma_m)[:, None, :]))
        return found

    def errors(self, calibration) -> np.ndarray:
        """True less estimated, as the covariance orders them."""
        parts = []
        for name, (rotation, lever) in self.true.items():
            found, found_lever = calibration.mountings[name].arrays()
            parts += [lever - found_lever, (rotation * Rotation.from_matrix(found).inv()).as_rotvec()]
        return np.concatenate(parts)


@pytest.mark.slow
def test_derivatives_are_those_of_the_residuals():
    rng = np.random.default_rng(1)
    yard = Yard(rng)
    priors = {
        "left": prior(LEVER_ARMS["left"], range_offset_sigma_m=0.01, beam_axis_sensor=(0.0, 0.0, 1.0)),
        "lidar": prior(LEVER_ARMS["lidar"], range_offset_sigma_m=0.01),
    }
    pose = ObjectPose(np.array([1.0, 2.0, 0.1]), Rotation.from_rotvec([0.1, 0.2, -0.7]).as_matrix())
    unknowns = Unknowns(priors, yard.traverses, {"step": pose})
    ties = yard.ties(3)
    solid = [replace(t, weight=rng.normal(0, 300, (3, 3, 3))) for t in ties[:4]]
    seen = yard.seen(rng.uniform(-2, 2, (5, 3)), "lidar", 11)
    on_object = Ties("object", seen, Known(rng.uniform(-1, 1, (5, 3)), "step"), rng.normal(0, 300, (5, 2, 3)))
    fixed = Ties("reference", seen, Known(rng.uniform(-1, 1, (5, 3))), rng.normal(0, 300, (5, 1, 3)))
    unit = rng.normal(0, 1, (4, 2, 3))
    unit /= np.linalg.norm(unit, axis=2, keepdims=True)
    others = [
        Directions("gravity", "left", unit[:, 0], unit[:, 1], np.full(4, 0.01)),
        Orientation("head", "lidar", Rotation.from_rotvec([0.3, 0.1, 0.2]).as_matrix(), 1e-4 * np.diag([1.0, 2, 3])),
    ]
    z = rng.normal(0, 0.7, unknowns.size)
    for one in observations([*ties, *solid, on_object, fixed, *others], unknowns):
        weight = rng.uniform(0.2, 1.0, one.count)
        information, slope = np.zeros((unknowns.size, unknowns.size)), np.zeros(unknowns.size)
        now = unknowns.geometry(z)
        one.add(now, weight, information, slope)
        step = 1e-5
        columns = [
            (one.residuals(unknowns.geometry(z + d)) - one.residuals(unknowns.geometry(z - d))).ravel() / (2 * step)
            for d in step * np.eye(unknowns.size)
        ]
        counts = np.repeat(weight, one.rows)
        jacobian = np.stack(columns, axis=1)
        expected = jacobian.T @ (counts[:, None] * jacobian)
        found = now.derivative.T @ information @ now.derivative
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
        expected = jacobian.T @ (counts * one.residuals(now).ravel())
        assert np.abs(now.derivative.T @ slope - expected).max() < 1e-6 * np.abs(expected).max()


def test_agrees_with_another_least_squares():
    yard = Yard(np.random.default_rng(4), headings_deg=(0.0, 90.0))
    ties = yard.ties(12)
    calm = CalibrationSettings(robust_limit=50.0, reject_limit=100.0, determined_below=0.95)
    found = calibrate(yard.priors, ties, yard.traverses, calm)
    assert found.observability.undetermined == ()

    names, keys = list(yard.priors), list(yard.traverses)

    def place(seen, x, y):
        at, k = names.index(seen.sensor), keys.index(int(seen.traverse[0]))
        rotation = Rotation.from_rotvec(x[at, 3:] * BORESIGHT_SIGMA_RAD)
        body = rotation.apply(seen.point_sensor_m) + LEVER_ARMS[seen.sensor] + x[at, :3] * LEVER_SIGMA_M
        turn = Rotation.from_rotvec(y[k, 3:] * yard.pose_sigma_rad)
        world = Rotation.from_matrix(seen.world_from_body).apply(turn.apply(body))
        return seen.position_world_m + world + ENU_FROM_NED @ (y[k, :3] * yard.pose_sigma_m)

    def residuals(z):
        x, y = z[:12].reshape(2, 6), z[12:].reshape(2, 6)
        apart = [np.sum(t.weight[:, 0] * (place(t.first, x, y) - place(t.second, x, y)), axis=1) for t in ties]
        return np.concatenate([*apart, z])

    other = least_squares(residuals, np.zeros(24), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    x = other.x[:12].reshape(2, 6)
    covariance = np.linalg.inv(other.jac.T @ other.jac)[:12, :12]
    scale = np.tile(np.repeat([LEVER_SIGMA_M, BORESIGHT_SIGMA_RAD], 3), 2)
    for index, name in enumerate(names):
        rotation, lever = found.mountings[name].arrays()
        turn = Rotation.from_matrix(rotation).as_rotvec()
        assert np.abs(lever - LEVER_ARMS[name] - x[index, :3] * LEVER_SIGMA_M).max() < 1e-6
        assert np.abs(turn - x[index, 3:] * BORESIGHT_SIGMA_RAD).max() < 1e-6
    for key, y in zip(keys, other.x[12:].reshape(2, 6), strict=True):
        assert np.abs(found.corrections[key].shift_north_east_down_m - y[:3] * yard.pose_sigma_m).max() < 1e-6
    # SciPy's is of rotation vectors, ours of a rotation that follows.
    change = np.eye(12)
    for index in range(2):
        vector = x[index, 3:] * BORESIGHT_SIGMA_RAD
        turned = Rotation.from_rotvec(vector + 1e-6 * np.eye(3)) * Rotation.from_rotvec(vector).inv()
        change[6 * index + 3 : 6 * index + 6, 6 * index + 3 : 6 * index + 6] = turned.as_rotvec().T / 1e-6
    expected = change @ (scale[:, None] * covariance * scale) @ change.T
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((found.covariance - expected) / np.outer(sigma, sigma)).max() < 1e-4
    assert found.converged


def test_what_is_held_does_not_move_even_if_the_ties_would_have_it_elsewhere():
    yard = Yard(np.random.default_rng(4), headings_deg=(0.0, 90.0))
    ties = yard.ties(12)
    found = calibrate(yard.priors, ties, yard.traverses)
    (held,) = found.observability.undetermined
    assert held == "vertical lever arm of 'left', 'lidar' together"
    moved = [found.mountings[n].lever_arm_body_m[2] - LEVER_ARMS[n][2] for n in yard.sensors]
    (direction,) = found.observability.held.T
    assert abs(_in_sigmas(found, yard.sensors) @ direction) < 1e-12
    assert max(np.abs(moved)) > 0.001
    assert found.converged


def _in_sigmas(found, sensors) -> np.ndarray:
    """How far mountings have moved, in units of prior σ, with a range offset each."""
    return np.concatenate(
        [
            np.r_[
                (np.array(found.mountings[n].lever_arm_body_m) - LEVER_ARMS[n]) / LEVER_SIGMA_M,
                Rotation.from_matrix(found.mountings[n].arrays()[0]).as_rotvec() / BORESIGHT_SIGMA_RAD,
                0.0,
            ]
            for n in sensors
        ]
    )


def test_mountings_come_back_from_a_degree_and_five_centimetres_off():
    yard = Yard(np.random.default_rng(7), off=0.0, pose_sigma_m=1e-5, pose_sigma_rad=1e-7)
    yard.true = {
        "left": (Rotation.from_rotvec(np.radians([1.0, -1.0, 1.0])), np.array([-2.25, -1.05, -1.05])),
        "lidar": (Rotation.from_rotvec(np.radians([-1.0, 1.0, -1.0])), np.array([-1.75, 0.15, -1.45])),
    }
    ties = yard.ties(25, sigma_m=1e-9, stated_sigma_m=1e-5)
    found = calibrate({n: prior(LEVER_ARMS[n], 0.05, np.radians(1.0)) for n in yard.sensors}, ties, yard.traverses)
    error = yard.errors(found).reshape(2, 2, 3)
    assert np.abs(error[:, 0]).max() < 5e-5
    assert np.degrees(np.abs(error[:, 1]).max()) < 2e-5
    assert found.converged
    assert found.observability.undetermined == ()


@compiled
def test_errors_are_as_large_as_their_covariance_says():
    squares = []
    for seed in range(8):
        yard = Yard(np.random.default_rng(100 + seed))
        found = calibrate(yard.priors, yard.ties(15), yard.traverses)
        error = yard.errors(found)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.025, 0.975], 12 * len(squares))
    assert low < sum(squares) < high


@compiled
def test_wrong_ties_are_left_out_and_counted():
    yard = Yard(np.random.default_rng(11))
    found = calibrate(yard.priors, yard.ties(60, outliers=0.1), yard.traverses)
    (kind,) = found.kinds
    # Errors of 5 to 30 cm against a limit of 12 mm: all of them.
    assert 0.08 * kind.count < kind.rejected < 0.12 * kind.count
    assert kind.variance_factor < 1.1
    assert sum(f.rejected for f in found.figures) == kind.rejected
    error = yard.errors(found)
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.999, 12)
    assert max(f.rms_after for f in found.figures) < 1.3 < min(f.rms_before for f in found.figures)


@compiled
def test_sigma_grows_where_residuals_are_worse_than_stated():
    yard = Yard(np.random.default_rng(12), pose_sigma_m=1e-6, pose_sigma_rad=1e-8)
    right = calibrate(yard.priors, yard.ties(50), yard.traverses)
    yard.rng = np.random.default_rng(99)
    wrong = calibrate(yard.priors, yard.ties(50, stated_sigma_m=0.0005), yard.traverses)
    assert wrong.kinds[0].variance_factor == pytest.approx(16.0, rel=0.1)
    ratio = np.sqrt(np.diag(wrong.covariance) / np.diag(right.covariance))
    assert np.abs(ratio - 1.0).max() < 0.15


def test_a_million_readings_do_not_average_out_common_errors():
    yard = Yard(np.random.default_rng(13), pose_sigma_m=1e-6, pose_sigma_rad=1e-8)
    ties = yard.ties(20)
    all_count = calibrate(yard.priors, ties, yard.traverses)
    few = calibrate(yard.priors, ties, yard.traverses, CalibrationSettings(independent_ties=28.0))
    assert few.kinds[0].counted_as == pytest.approx(28.0)
    ratio = np.sqrt(np.diag(few.covariance) / np.diag(all_count.covariance))
    expected = np.sqrt(all_count.kinds[0].counted_as / 28.0)
    assert np.abs(ratio / expected - 1.0).max() < 0.2


def test_flat_level_ground_does_not_tell_the_vertical_lever_arm():
    yard = Yard(np.random.default_rng(21), sensors=("left",), flat=True)
    found = calibrate(yard.priors, yard.ties(40), yard.traverses)
    one = found.sensors["left"]
    assert "vertical lever arm of 'left'" in found.observability.undetermined
    assert one.mounting.lever_arm_body_m[2] == pytest.approx(LEVER_ARMS["left"][2], abs=1e-12)
    assert one.sigma[2] == pytest.approx(LEVER_SIGMA_M, rel=1e-6)
    # Roll and pitch are determined all the same.
    error = np.degrees(yard.errors(found)[3:5])
    assert np.abs(error).max() < 0.03
    assert np.degrees(one.sigma[3:5]).max() < 0.02


@compiled
def test_errors_of_normals_are_no_relief():
    """Flat ground with estimated normals: they seem to tell where on it a place lies, but only that it was tied to the
    nearest reading."""
    yard = Yard(np.random.default_rng(27), sensors=("left",), flat=True)
    sigma = np.radians(0.5)
    tilted, stated = [], []
    for ties in yard.ties(300):
        normal = ties.weight[:, 0] * 0.002 + yard.rng.normal(0, sigma, (300, 3)) * [1, 1, 0]
        rows = (normal / np.linalg.norm(normal, axis=1, keepdims=True) / 0.002)[:, None, :]
        tilted.append(replace(ties, weight=rows))
        stated.append(replace(ties, weight=rows, normal_sigma_rad=np.full(300, sigma)))
    misled = calibrate(yard.priors, tilted, yard.traverses).observability.undetermined
    assert "forward lever arm of 'left'" not in misled
    found = calibrate(yard.priors, stated, yard.traverses)
    axes = ("forward lever arm", "right lever arm", "vertical lever arm", "heading")
    assert set(found.observability.undetermined) == {f"{axis} of 'left'" for axis in axes}
    assert np.array(found.mountings["left"].lever_arm_body_m) == pytest.approx(LEVER_ARMS["left"], abs=1e-12)


@compiled
def test_relief_is_seen_in_spite_of_errors_of_normals():
    yard = Yard(np.random.default_rng(28))
    plain = yard.ties(40)
    stated = [replace(t, normal_sigma_rad=np.full(40, np.radians(0.5))) for t in plain]
    found, expected = (calibrate(yard.priors, ties, yard.traverses) for ties in (stated, plain))
    assert found.observability.undetermined == ()
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.sqrt(np.diag(expected.covariance)), rel=0.01)


def test_one_bump_ties_heading_to_the_forward_lever_arm():
    """A profiler (points in its plane x = 0) sees a step across the road at 1 m to its right only: a turn about the
    vertical moves the step forward by −1 m per radian, which a lever arm takes back."""
    rng = np.random.default_rng(22)
    n = 60
    station = rng.uniform(0, 30, n)
    position = np.column_stack([np.zeros(n), station, np.full(n, 1.1)])
    north = np.broadcast_to(ENU_FROM_NED, (n, 3, 3))
    true_forward = 0.02
    point = np.column_stack([np.zeros(n), np.full(n, 1.0), np.full(n, 1.1)])
    step = position + np.array([1.0, true_forward, -1.1]) + rng.normal(0, [0, 1e-4, 0], (n, 3))
    ties = Ties(
        "reference",
        Seen("left", point, position, north, np.zeros(n, dtype=np.int64)),
        Known(step),
        np.broadcast_to([[[0.0, 1.0 / 1e-4, 0.0]]], (n, 1, 3)),
    )
    exact = {0: traverse(sigma_m=0.0, sigma_rad=0.0)}
    sigma = np.radians(1.0)
    found = calibrate({"left": Prior(mounting((0, 0, 0)), (0.03,) * 3, (0.0, 0.0, sigma))}, [ties], exact)
    held = [d for d in found.observability.directions if not d.determined]
    assert {"right lever arm of 'left'", "vertical lever arm of 'left'"} <= {d.words for d in held}
    (mixed,) = [d for d in held if len(d.parts) == 2]
    amounts = {part.axis: part.amount for part in mixed.parts}
    # Forward by heading: +1 m a radian, 17.45 mm a degree.
    assert amounts[0] / amounts[5] == pytest.approx(1.0, rel=1e-4)
    assert "17.5 mm a degree" in mixed.words or "0.573° for 10 mm" in mixed.words
    # What is determined is the step's place; it is shared by both as their priors say, and nothing else moves.
    rotation, lever = found.mountings["left"].arrays()
    heading = Rotation.from_matrix(rotation).as_rotvec()[2]
    assert lever[0] - heading == pytest.approx(true_forward, abs=1e-4)
    assert lever[0] / heading == pytest.approx(-(0.03**2) / sigma**2, rel=1e-3)
    assert np.abs(lever[1:]).max() < 1e-12


def test_sensors_tied_to_each_other_alone_share_an_unknown_mounting():
    yard = Yard(np.random.default_rng(23), headings_deg=(0.0,), springs_deg=0.0, one_place=True)
    ties = yard.ties(80, pairs=[(("left", 10), ("lidar", 10))])
    found = calibrate(yard.priors, ties, yard.traverses)
    held = [d for d in found.observability.directions if not d.determined]
    assert len(held) == 6
    together = {d.words for d in held}
    for axis in ("roll", "pitch", "heading"):
        assert any(words.startswith(f"{axis} of") and "'left'" in words and "'lidar'" in words for words in together)
    # Seen from one sensor, the other sits where it truly does.
    found_pose, true_pose = (
        _seen_from(left, lidar)
        for left, lidar in (
            [(Rotation.from_matrix(m.arrays()[0]), m.arrays()[1]) for m in found.mountings.values()],
            list(yard.true.values()),
        )
    )
    assert np.degrees((found_pose[0].inv() * true_pose[0]).magnitude()) < 0.06
    assert np.abs(found_pose[1] - true_pose[1]).max() < 0.003
    start = _seen_from(*[(Rotation.identity(), np.array(LEVER_ARMS[n])) for n in yard.sensors])
    assert np.degrees((start[0].inv() * true_pose[0]).magnitude()) > 0.5
    # And no direction that is held has moved.
    assert np.abs(found.observability.held.T @ _in_sigmas(found, yard.sensors)).max() < 1e-12


def test_loops_in_one_direction_leave_the_lever_arm_alone():
    yard = Yard(np.random.default_rng(24), sensors=("lidar",), headings_deg=(30.0, 30.0, 30.0), springs_deg=0.0)
    found = calibrate(yard.priors, yard.ties(60), yard.traverses)
    assert set(found.observability.undetermined) == {
        f"{axis} lever arm of 'lidar'" for axis in ("forward", "right", "vertical")
    }
    assert found.sensors["lidar"].not_determined == found.observability.undetermined
    assert np.abs(np.array(found.mountings["lidar"].lever_arm_body_m) - LEVER_ARMS["lidar"]).max() < 1e-8
    error = np.degrees(yard.errors(found)[3:])
    assert np.abs(error).max() < 4 * np.degrees(found.sensors["lidar"].sigma[3:].max()) < 0.5


def test_ties_are_found_anew_until_the_mountings_stay():
    yard = Yard(np.random.default_rng(31))
    everything = yard.ties(40, outliers=0.02)
    seen: list[Estimate] = []

    def finder(estimate: Estimate) -> list[Ties]:
        """Only what lies within 6 cm with the mountings at hand."""
        seen.append(estimate)
        near = []
        for ties in everything:
            first, second = (_world(end, estimate.mountings[end.sensor]) for end in (ties.first, ties.second))
            index = np.flatnonzero(np.linalg.norm(first - second, axis=1) < 0.06)
            first, second = _some(ties.first, index), _some(ties.second, index)
            near.append(Ties(ties.kind, first, second, ties.weight[index]))
        return near

    found = calibrate(yard.priors, finder, yard.traverses)
    assert found.converged
    assert found.rounds == len(seen) >= 3
    assert seen[0].mountings == {n: p.mounting for n, p in yard.priors.items()}
    last = sum(f.count for f in found.figures)
    assert last > 0.95 * sum(len(t.weight) for t in everything)
    error = yard.errors(found)
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.999, 12)


def _seen_from(left, lidar):
    """Rotation and origin of one sensor in another's axes."""
    return left[0].inv() * lidar[0], left[0].inv().apply(lidar[1] - left[1])


def _world(seen: Seen, mounting: Mounting) -> np.ndarray:
    rotation, lever = mounting.arrays()
    return seen.position_world_m + np.einsum(
        "nij,nj->ni", seen.world_from_body, seen.point_sensor_m @ rotation.T + lever
    )


def _some(seen: Seen, index) -> Seen:
    return Seen(
        seen.sensor, seen.point_sensor_m[index], seen.position_world_m[index], seen.world_from_body[index],
        seen.traverse[index],
    )  # fmt: skip


def test_a_known_object_at_an_unknown_place_ties_two_heads():
    rng = np.random.default_rng(41)
    yard = Yard(rng, headings_deg=(0.0,), springs_deg=0.3)
    turn, place = Rotation.from_euler("z", 12.0, degrees=True), np.array([0.3, -0.2, 0.05])
    corners = rng.uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 0.06], (60, 3))
    ties = []
    for name in yard.sensors:
        seen = yard.seen(turn.apply(corners) + place, name, 10)
        seen = replace(seen, point_sensor_m=seen.point_sensor_m + rng.normal(0, 0.0002, (60, 3)))
        ties.append(Ties("object", seen, Known(corners, "step"), np.broadcast_to(np.eye(3) / 0.0002, (60, 3, 3))))
    start = ObjectPose(place + np.array([0.2, -0.1, 0.05]), Rotation.from_euler("z", 5.0, degrees=True).as_matrix())
    found = calibrate(yard.priors, ties, yard.traverses, objects={"step": start})
    error = yard.errors(found)
    relative = np.abs(error[:6] - error[6:])
    # One head against the other, as far as the object's size lets lever arms be told from rotations.
    difference = np.hstack([np.eye(6), -np.eye(6)])
    sigma = np.sqrt(np.diag(difference @ found.covariance @ difference.T))
    assert (relative < 4 * sigma).all()
    assert sigma[:3].max() < 0.001
    assert np.linalg.norm(found.objects["step"].position_world_m - place) < 0.1
    assert all(0.8 < f.rms_after < 1.2 for f in found.figures)


def test_directions_give_the_rotation_that_aligns_vectors():
    rng = np.random.default_rng(51)
    true = Rotation.from_rotvec(np.radians([0.9, -0.5, 1.3]))
    body = rng.standard_normal((30, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    sigma = rng.uniform(0.001, 0.004, 30)
    head = true.inv().apply(Rotation.from_rotvec(sigma[:, None] * rng.standard_normal((30, 3))).apply(body))
    expected, _ = Rotation.align_vectors(body, head, weights=sigma**-2)
    loose = {"left": prior((0, 0, 0), boresight_sigma_rad=1.0)}
    calm = CalibrationSettings(robust_limit=50.0, reject_limit=100.0)
    found = calibrate(loose, [Directions("field", "left", head, body, sigma)], {}, calm)
    apart = expected * Rotation.from_matrix(found.mountings["left"].arrays()[0]).inv()
    assert np.degrees(apart.magnitude()) < 1e-3
    assert (np.abs((true * expected.inv()).as_rotvec()) < 4 * found.sensors["left"].sigma[3:]).all()
    assert len(found.observability.undetermined) == 3


def test_gravity_alone_leaves_the_heading():
    down = np.tile([0.0, 0.0, 1.0], (10, 1))
    head = Rotation.from_rotvec(np.radians([0.5, -0.4, 0.8])).inv().apply(down)
    found = calibrate({"left": prior((0, 0, 0))}, [Directions("gravity", "left", head, down, np.full(10, 1e-4))], {})
    turn = np.degrees(Rotation.from_matrix(found.mountings["left"].arrays()[0]).as_rotvec())
    assert "heading of 'left'" in found.observability.undetermined
    assert turn[:2] == pytest.approx([0.5, -0.4], abs=0.01)
    assert abs(turn[2]) < 1e-9


def test_an_orientation_counts_with_its_covariance():
    observed = Rotation.from_rotvec(np.radians([0.3, 0.2, -0.4]))
    covariance = np.diag(np.radians([0.01, 0.02, 1.0])) ** 2
    evidence = Orientation("head", "left", observed.as_matrix(), covariance)
    found = calibrate({"left": prior((0, 0, 0))}, [evidence], {})
    one = found.sensors["left"]
    # Heading is known from both alike: it is not determined better than half the prior, and stays.
    assert "heading of 'left'" in one.not_determined
    turn = np.degrees(Rotation.from_matrix(one.mounting.arrays()[0]).as_rotvec())
    assert turn[:2] == pytest.approx([0.3, 0.2], abs=2e-3)
    assert np.degrees(one.sigma[3:]) == pytest.approx([0.01, 0.02, 1.0], rel=2e-3)


def test_pieces_of_a_run_share_their_slow_error():
    pieces = {k: traverse("a", epoch_gps_ns=k * 6_000_000_000) for k in range(3)} | {9: traverse("b")}
    unknowns = Unknowns({"left": prior((0, 0, 0))}, pieces)
    covariance = unknowns.root @ unknowns.root.T
    at = [unknowns.body_slice(b).start for b in range(4)]
    correlation = covariance[np.ix_(at, at)] / 0.006**2
    expected = np.exp(-np.abs(np.subtract.outer([0, 6, 12], [0, 6, 12])) / 60.0)
    assert correlation[:3, :3] == pytest.approx(expected, abs=1e-6)
    assert np.abs(correlation[3, :3]).max() == 0.0


def test_priors_come_from_the_rig_file_or_the_settings():
    stated = Sensor(kind="lidar", lever_arm_sigma_m=(0.01, 0.02, 0.03), boresight_sigma_deg=(1.0, 2.0, 3.0))
    one = Prior.of(stated, CalibrationSettings())
    assert one.lever_arm_sigma_m == (0.01, 0.02, 0.03)
    assert np.degrees(one.boresight_sigma_rad) == pytest.approx([1.0, 2.0, 3.0])
    assert one.beam_axis_sensor is None
    default = Prior.of(Sensor(kind="profiler"), CalibrationSettings(lever_arm_sigma_m=(0.1, 0.1, 0.1)))
    assert default.lever_arm_sigma_m == (0.1, 0.1, 0.1)
    assert default.beam_axis_sensor == (0.0, 0.0, 1.0)
    offsets = CalibrationSettings(range_offset_sigma_m={"lidar": 0.01})
    both = priors_of({"lidar": stated, "left": Sensor(kind="profiler")}, offsets)
    assert {name: one.range_offset_sigma_m for name, one in both.items()} == {"lidar": 0.01, "left": 0.0}
    with pytest.raises(ConfigError, match="names the sensor 'lidar', which is not calibrated"):
        priors_of({"left": stated}, offsets)


def test_a_range_offset_is_found_where_it_may_be():
    yard = Yard(np.random.default_rng(61), sensors=("lidar",), pose_sigma_m=1e-5, pose_sigma_rad=1e-7)
    priors = {"lidar": replace(yard.priors["lidar"], range_offset_sigma_m=0.02)}
    rng, n = yard.rng, 150
    place = rng.uniform(-8, 8, (n, 3))
    seen = yard.seen(place, "lidar", 10)
    away = seen.point_sensor_m / np.linalg.norm(seen.point_sensor_m, axis=1, keepdims=True)
    short = replace(seen, point_sensor_m=seen.point_sensor_m - 0.015 * away + rng.normal(0, 0.001, (n, 3)))
    ties = Ties("reference", short, Known(place), np.broadcast_to(np.eye(3) / 0.001, (n, 3, 3)))
    found = calibrate(priors, [ties], yard.traverses)
    one = found.sensors["lidar"]
    assert one.range_offset_m == pytest.approx(0.015, abs=5 * one.range_offset_sigma_m)
    assert one.range_offset_sigma_m < 0.001
    assert calibrate(yard.priors, [ties], yard.traverses).sensors["lidar"].range_offset_m == 0.0


def test_ties_that_are_no_numbers_are_counted():
    yard = Yard(np.random.default_rng(71))
    ties = yard.ties(30)
    point = ties[0].first.point_sensor_m.copy()
    point[3] = np.nan
    ties[0] = replace(ties[0], first=replace(ties[0].first, point_sensor_m=point))
    found = calibrate(yard.priors, ties, yard.traverses)
    assert sum(f.unusable for f in found.figures) == 1
    assert np.isfinite(found.covariance).all()


def test_no_evidence_keeps_everything():
    found = calibrate({"left": prior(LEVER_ARMS["left"])}, [], {})
    assert found.mountings["left"] == mounting(LEVER_ARMS["left"])
    assert len(found.observability.undetermined) == 6
    assert found.sensors["left"].sigma == pytest.approx(np.repeat([LEVER_SIGMA_M, BORESIGHT_SIGMA_RAD], 3))


def test_evidence_of_strangers_is_refused():
    yard = Yard(np.random.default_rng(81))
    ties = yard.ties(5)
    with pytest.raises(ConfigError, match="sensor 'lidar', which is not calibrated"):
        calibrate({"left": yard.priors["left"]}, ties, yard.traverses)
    with pytest.raises(ConfigError, match="unknown traverse 13"):
        calibrate(yard.priors, ties, {k: t for k, t in yard.traverses.items() if k != 13})
    lost = replace(ties[0], second=Known(np.zeros((5, 3)), "pyramid"))
    with pytest.raises(ConfigError, match="unknown calibration object 'pyramid'"):
        calibrate(yard.priors, [lost], yard.traverses)
    with pytest.raises(NavigationError, match="4 of weight; expected 5"):
        calibrate(yard.priors, [replace(ties[0], weight=ties[0].weight[:4])], yard.traverses)
    with pytest.raises(ConfigError, match="without sensors"):
        calibrate({}, [], {})
    flat = Orientation("head", "left", np.eye(3), np.zeros((3, 3)))
    with pytest.raises(NavigationError, match="not positive definite"):
        calibrate(yard.priors, [flat], {})


def test_geometry_places_points_as_scipy_does():
    yard = Yard(np.random.default_rng(91))
    unknowns = Unknowns(yard.priors, yard.traverses)
    now: Geometry = unknowns.geometry(np.zeros(unknowns.size))
    assert now.body_from_sensor == pytest.approx(np.broadcast_to(np.eye(3), (2, 3, 3)))
    z = np.random.default_rng(5).normal(0, 1, unknowns.size)
    estimate = unknowns.estimate(z)
    turn = (unknowns.root @ z)[3:6]
    assert estimate.mountings["left"].arrays()[0] == pytest.approx(Rotation.from_rotvec(turn).as_matrix())


def test_a_sensor_held_fixed_does_not_move():
    yard = Yard(np.random.default_rng(17))
    fixed = yard.priors | {"left": Prior(mounting(LEVER_ARMS["left"]), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))}
    yard.true["left"] = (Rotation.identity(), np.array(LEVER_ARMS["left"]))
    found = calibrate(fixed, yard.ties(10), yard.traverses)
    assert found.mountings["left"] == mounting(LEVER_ARMS["left"])
    assert not found.sensors["left"].covariance.any()
    error = yard.errors(found)[6:]
    assert error @ np.linalg.solve(found.sensors["lidar"].covariance, error) < chi2.ppf(0.999, 6)
    assert not any("'left'" in words for words in found.observability.undetermined)


def test_rows_and_report_say_what_was_found():
    yard = Yard(np.random.default_rng(21), sensors=("left",), flat=True)
    found = calibrate(yard.priors, yard.ties(20), yard.traverses)
    (row,) = mounting_rows(found, run="*", valid_from_gps_ns=5, estimated_at="2026-03-02T12:00:00Z", key="abc")
    assert set(row) == {column.name for column in table_schema("mountings").columns}
    turned = Rotation.from_quat([row["qw"], row["qx"], row["qy"], row["qz"]], scalar_first=True)
    assert turned.as_matrix() == pytest.approx(found.mountings["left"].arrays()[0])
    assert np.reshape(row["covariance"], (6, 6)) == pytest.approx(found.sensors["left"].covariance)
    assert row["sigma_lever_down_m"] == pytest.approx(LEVER_SIGMA_M)
    assert "vertical lever arm of 'left'" in row["not_determined"]
    lines = report(found).splitlines()
    (vertical,) = [line for line in lines if line.strip().startswith("vertical lever arm ") and "σ" in line]
    assert "+0.00 mm" in vertical.replace("-0.00", "+0.00") and vertical.endswith("not determined")
    (roll,) = [line for line in lines if line.strip().startswith("roll")]
    assert not roll.endswith("not determined")
    assert any(line.startswith("loops: 120 observations, 0 rejected") for line in lines)
    assert "There is no evidence." in report(calibrate(yard.priors, [], {}))
