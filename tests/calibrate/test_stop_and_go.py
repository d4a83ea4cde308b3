"""Orientation of profiler heads from the IMUs inside them: simulated drives that stop and go."""

from __future__ import annotations

import functools
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.csv as pa_csv
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from roadscan.calibrate.estimator import Prior, calibrate
from roadscan.calibrate.orientations import joint_covariance
from roadscan.calibrate.stop_and_go import HeadRun, find_orientation
from roadscan.core.crs import world_from_geodetic
from roadscan.core.errors import NavigationError
from roadscan.core.frames import ecef_from_ned, quaternion_from_rotation, rotation_from_rph
from roadscan.core.gpstime import NS_PER_S, WEEK_S
from roadscan.core.rig import IMU_GRADES, Mounting, Rig
from roadscan.core.settings.calibration import CalibrationSettings
from roadscan.navigation.inertial.readings import ImuReadings
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene, simulate

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="thousands of poses")

HEADS = ("profiler_left", "profiler_right")
TILT_RAD = np.radians(0.004)
LEVER_SIGMA_M = (0.03, 0.03, 0.03)


class Yard:
    """The calibration yard with head IMUs alone: logs as they were written, read without the readers."""

    def __init__(self, folder: Path, seed: int, grade: str = "tactical", *, passes=(0, 1, 2), **noise) -> None:
        scene, off = Scene.load("calibration_yard"), {"on": False}
        kept = [scene.passes[k].model_dump() for k in passes]
        scene = scene.changed(
            seed=seed, passes=kept, profilers={"spacing_m": 2.0, "readings": 2, "head_imus": grade}, lidar=off,
            sick=off, camera=off, imu=off, gnss=off, encoder=off, road={"texture": None}, noise=noise,
        )  # fmt: skip
        self.folder = simulate(scene, folder).folder
        self.errors = IMU_GRADES[grade]
        self.nominal = Rig.load(self.folder / "RIG.toml")
        self.true = Rig.load(self.folder / "truth" / "RIG.toml")
        self.runs = [f"run-{k + 1}" for k in range(len(kept))]

    def head_runs(self, head: str) -> list[HeadRun]:
        return [HeadRun(*self._read(run, head), (TILT_RAD, TILT_RAD, 2 * TILT_RAD)) for run in self.runs]

    def find(self, head: str, runs: list[HeadRun] | None = None):
        if runs is None:
            return self._of_all_runs(head)
        nominal = self.nominal.sensors[f"{head}_imu"].mounting()
        return find_orientation(runs, nominal, LEVER_SIGMA_M, self.errors)

    @functools.cache  # noqa: B019 - a few yards, as long as the tests
    def _of_all_runs(self, head: str):
        return self.find(head, self.head_runs(head))

    def true_rotation(self, head: str) -> Rotation:
        return Rotation.from_matrix(self.true.sensors[f"{head}_imu"].mounting().arrays()[0])

    def error(self, head: str, found) -> np.ndarray:
        return (self.true_rotation(head) * Rotation.from_matrix(found.body_from_imu).inv()).as_rotvec()

    def _read(self, run: str, head: str) -> tuple[ImuReadings, Trajectory]:
        table = pa_csv.read_csv(self.folder / "raw" / run / f"{head}_imu.csv")
        columns = [
            np.column_stack([table[name.format(axis)].to_numpy() for axis in "xyz"])
            for name in ("angular_rate_{}_rad_per_s", "specific_force_{}_m_per_s2")
        ]
        epochs = table["time_ns"].to_numpy().astype(np.int64)
        sbet = np.fromfile(self.folder / "raw" / run / "trajectory.sbet").reshape(-1, 17)
        week = epochs[0] // (WEEK_S * NS_PER_S)
        at = week * WEEK_S * NS_PER_S + np.rint(sbet[:, 0] * 1e9).astype(np.int64)
        latitude, longitude, height = sbet[:, 1], sbet[:, 2], sbet[:, 3]
        position = world_from_geodetic("EPSG:4978", np.column_stack([*np.degrees([longitude, latitude]), height]))
        level_from_body = rotation_from_rph(sbet[:, 7], sbet[:, 8], sbet[:, 9] - sbet[:, 10])
        attitude = ecef_from_ned(latitude, longitude) @ level_from_body
        trajectory = Trajectory.of("EPSG:4978", at, position, quaternion_from_rotation(attitude))
        return ImuReadings(epochs, *columns), trajectory


@pytest.fixture(scope="module")
def yards(tmp_path_factory) -> list[Yard]:
    return [Yard(tmp_path_factory.mktemp("yard") / "s", seed) for seed in (21, 22)]


@pytest.mark.slow
def test_orientations_come_back_with_honest_sigma(yards):
    squares = []
    for yard in yards:
        for head in HEADS:
            found = yard.find(head)
            error = yard.error(head, found)
            squares.append(error @ np.linalg.solve(found.covariance_rad2, error))
            assert np.degrees(np.abs(error)) == pytest.approx([0, 0, 0], abs=0.02)
            assert np.degrees(found.sigma_rad[:2]).max() < 0.004
            assert np.degrees(found.sigma_rad[2]) < 0.01
            # The rig file is off by up to 0.9 degrees.
            assert np.degrees(np.abs(found.correction_rad)).max() > 0.6
            assert found.standing >= 40
    # Both heads share the error of the trajectory: as many independent errors as drives at least, as heads at most.
    assert sum(squares) < chi2.ppf(0.995, 3 * len(yards)) * 2
    assert sum(squares) > chi2.ppf(0.005, 3 * len(squares))


@pytest.mark.slow
def test_sigma_stays_honest_with_cheap_imus(tmp_path):
    """Biases that wander by 0.2 mg a second: σ has to know that they do not average out within a curve."""
    yard = Yard(tmp_path / "s", 33, "mems")
    squares = []
    for head in HEADS:
        found = yard.find(head)
        error = yard.error(head, found)
        squares.append(error @ np.linalg.solve(found.covariance_rad2, error))
        assert 0.02 < np.degrees(found.sigma_rad[2]) < 0.05
    assert sum(squares) < chi2.ppf(0.995, 6)


@pytest.mark.slow
def test_it_is_the_rotation_that_aligns_the_turns_of_head_and_body(yards):
    """Rates of the head's gyroscopes against rates of the true trajectory, aligned by SciPy."""
    yard, head = yards[0], "profiler_right"
    run = yard.head_runs(head)[0]
    step = 20
    epochs = run.readings.epochs_gps_ns[200:-200:step]
    attitude = Rotation.from_matrix(run.trajectory.poses(epochs, strict=True).world_from_body)
    body = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    rate = run.readings.angular_rate_rad_per_s[200:-200]
    summed = np.cumsum(0.5 * (rate[1:] + rate[:-1]), axis=0) / 200.0
    felt = np.diff(np.vstack([np.zeros(3), summed])[::step][: len(epochs)], axis=0)
    strong = np.linalg.norm(body, axis=1) > np.radians(0.3)
    aligned, _ = Rotation.align_vectors(body[strong], felt[strong])
    found = yard.find(head)
    apart = (aligned * Rotation.from_matrix(found.body_from_imu).inv()).as_rotvec()
    # A mean over the vectors alone, without biases, accelerations and the Earth's rate, is the worse of the two.
    assert np.degrees(np.abs(apart)).max() < 0.08
    worse = np.linalg.norm((yard.true_rotation(head) * aligned.inv()).as_rotvec())
    assert np.linalg.norm(yard.error(head, found)) < worse


@pytest.mark.slow
def test_biases_are_found_too(yards):
    yard = yards[1]
    found = yard.find("profiler_left")
    sigma = IMU_GRADES["tactical"].accel_bias_mg * 1e-3 * 9.80665
    assert np.abs(found.accelerometer_bias_m_per_s2).max() < 4 * sigma
    assert np.std(found.accelerometer_bias_m_per_s2) > 0.2 * sigma
    # The clocks of these heads are right.
    assert np.abs(found.late_s).max() < 2e-4


@pytest.mark.slow
def test_a_late_clock_is_found(yards):
    yard, head = yards[1], "profiler_left"
    late_ns = 4_000_000
    runs = [
        replace(run, readings=replace(run.readings, epochs_gps_ns=run.readings.epochs_gps_ns + late_ns))
        for run in yard.head_runs(head)
    ]
    found = yard.find(head, runs)
    assert np.array(found.late_s) == pytest.approx(-0.004, abs=2e-4)
    assert np.degrees(np.abs(yard.error(head, found))).max() < 0.02


@pytest.mark.slow
def test_standing_alone_leaves_the_heading(yards):
    yard, head = yards[0], "profiler_left"
    runs = [replace(run, readings=_first(run.readings, 9.0)) for run in yard.head_runs(head)]
    found = yard.find(head, runs)
    assert found.standing == found.windows > 10
    sigma = np.degrees(found.sigma_rad)
    # Gravity through accelerometers with a bias of 1 mg each, in three runs: 0.057° / √3.
    assert sigma[:2] == pytest.approx(0.057 / np.sqrt(3), rel=0.15)
    # The Earth's rotation through gyroscopes with a bias of 1°/h: 9.1°/h point north at this latitude.
    assert sigma[2] == pytest.approx(np.degrees(1 / 9.1) / np.sqrt(3), rel=0.1)
    error = np.degrees(np.abs(yard.error(head, found)))
    assert (error[:2] < 4 * sigma[:2]).all()
    evidence = found.evidence(head, *(yard.nominal.sensors[s].mounting() for s in (head, f"{head}_imu")))
    result = calibrate({head: Prior.of(yard.nominal.sensors[head], CalibrationSettings())}, [evidence], {})
    assert f"heading of '{head}'" in result.observability.undetermined
    assert f"roll of '{head}'" not in result.observability.undetermined


@pytest.mark.slow
def test_the_head_takes_the_orientation_of_its_imu(yards):
    yard, head = yards[0], "profiler_right"
    found = yard.find(head)
    # As if the IMU sat in the head with other axes than the head's: back, right, up.
    turned = Rotation.from_matrix([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    nominal = yard.nominal.sensors[f"{head}_imu"].mounting()
    rotation, lever = nominal.arrays()
    sensor = Mounting(tuple(lever), tuple(map(tuple, (Rotation.from_matrix(rotation) * turned).as_matrix())))
    evidence = found.evidence(head, sensor, nominal)
    expected = Rotation.from_matrix(found.body_from_imu) * turned
    assert evidence.body_from_sensor == pytest.approx(expected.as_matrix(), abs=1e-12)
    assert evidence.covariance_rad2 is found.covariance_rad2


@pytest.mark.slow
def test_an_error_of_the_trajectory_turns_the_head_as_its_influence_says(yards):
    yard, head = yards[0], "profiler_left"
    run = yard.head_runs(head)[2]
    plain = yard.find(head, [run])
    (influence,) = plain.attitude
    seconds = (influence.epoch_gps_ns - influence.epoch_gps_ns[0]) / NS_PER_S
    # Changes of roll and pitch would be noise of the turns besides.
    error = 5e-5 * np.stack([np.ones_like(seconds), -np.ones_like(seconds), np.sin(seconds / 11.0)], axis=-1)
    path = run.trajectory
    at = [np.interp(path.epochs_gps_ns, influence.epoch_gps_ns, error[:, a]) for a in range(3)]
    turned = Rotation.from_quat(path.quaternion_world_from_body, scalar_first=True) * Rotation.from_rotvec(
        np.stack(at, axis=-1)
    )
    off = Trajectory.of(path.world, path.epochs_gps_ns, path.position_world_m, turned.as_quat(scalar_first=True))
    found = yard.find(head, [replace(run, trajectory=off)])
    change = Rotation.from_matrix(found.body_from_imu @ plain.body_from_imu.T).as_rotvec()
    # An error of the stated attitude turns the head the other way.
    expected = -np.einsum("ika,ka->i", influence.influence, error)
    assert np.abs(expected).max() > 1e-5
    assert change == pytest.approx(expected, abs=0.05 * np.abs(expected).max())


@pytest.mark.slow
def test_heads_share_the_error_of_the_trajectory(yards):
    heads = [yards[0].find(head) for head in HEADS]
    nominal = Mounting((0.0, 0.0, 0.0), tuple(map(tuple, np.eye(3).tolist())))
    members = [one.evidence(name, nominal, nominal) for name, one in zip(HEADS, heads, strict=True)]
    covariance = joint_covariance(members)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    sigma = np.sqrt(np.diag(covariance))
    correlation = (covariance / np.outer(sigma, sigma))[:3, 3:]
    # Tilts are known as well as the trajectory's; the heading is not, and errs with the head's own accelerometers.
    assert 0.5 < correlation[0, 0] < 0.99
    assert 0.5 < correlation[1, 1] < 0.99
    assert 0.0 < correlation[2, 2] < 0.7


@pytest.mark.slow
def test_gaps_and_damaged_samples_cost_their_windows(yards):
    yard, head = yards[1], "profiler_left"
    whole = yard.head_runs(head)[0]
    readings = whole.readings
    keep = np.ones(readings.epochs_gps_ns.size, dtype=bool)
    keep[5000:5400] = False
    force = readings.specific_force_m_per_s2.copy()
    force[9000] = np.nan
    damaged = ImuReadings(readings.epochs_gps_ns[keep], readings.angular_rate_rad_per_s[keep], force[keep])
    found, intact = (yard.find(head, [run]) for run in (replace(whole, readings=damaged), whole))
    assert intact.windows - 8 <= found.windows < intact.windows
    assert np.degrees(np.abs(yard.error(head, found))).max() < 0.02


@pytest.mark.slow
def test_wrong_axes_and_missing_poses_are_refused(yards):
    yard, head = yards[0], "profiler_left"
    run = yard.head_runs(head)[0]
    swapped = ImuReadings(
        run.readings.epochs_gps_ns,
        run.readings.angular_rate_rad_per_s[:, [1, 0, 2]] * [1, -1, 1],
        run.readings.specific_force_m_per_s2[:, [1, 0, 2]] * [1, -1, 1],
    )
    with pytest.raises(NavigationError, match=r"turned by 9[0-9.]+° against the rig file"):
        yard.find(head, [replace(run, readings=swapped)])
    later = replace(run.readings, epochs_gps_ns=run.readings.epochs_gps_ns + 10**12)
    with pytest.raises(NavigationError, match="no samples of the head's IMU have poses"):
        yard.find(head, [replace(run, readings=later)])


def _first(readings: ImuReadings, seconds: float) -> ImuReadings:
    keep = readings.epochs_gps_ns < readings.epochs_gps_ns[0] + round(seconds * NS_PER_S)
    return ImuReadings(
        readings.epochs_gps_ns[keep], readings.angular_rate_rad_per_s[keep], readings.specific_force_m_per_s2[keep]
    )
