"""Clocks from shared motion, against the simulator's clocks and recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import NavigationError
from roadscan.navigation.clocks.motion import MotionFit, clock_from_motion
from roadscan.navigation.clocks.signals import driving, felt_by_encoder, felt_by_imu, turning, turning_of_imu
from roadscan.navigation.inertial.readings import ImuReadings, OdometerReadings
from roadscan.poses.trajectory import Trajectory
from tests.navigation.driven import Driven, scene_of

CLOCK = {"offset_s": -1.2345, "drift_ppm": 37.0}
NOISE = {"attitude_deg": 0.004, "position_m": 0.006, "time_constant_s": 60.0}


def by_imu(imu: ImuReadings, trajectory: Trajectory, **changes: object) -> MotionFit:
    motion = turning(trajectory)
    settings = {"search_s": 5.0, "drift": "auto", "what": "the head"} | changes
    return clock_from_motion(felt_by_imu(imu, motion.interval_s), motion, **settings)


def by_encoder(encoder: OdometerReadings, trajectory: Trajectory, **changes: object) -> MotionFit:
    motion = driving(trajectory, backwards_counts_down=False)
    settings = {"search_s": 5.0, "drift": "auto", "what": "the encoder"} | changes
    return clock_from_motion(felt_by_encoder(encoder), motion, **settings)


@pytest.fixture(scope="module")
def driven() -> Driven:
    """Four kilometres at 50 km/h: 4.8 minutes."""
    return Driven.of(scene_of(4000.0, 5, CLOCK, noise=NOISE))


@pytest.fixture(scope="module")
def trajectory(driven: Driven) -> Trajectory:
    return driven.trajectory()


@pytest.fixture(scope="module")
def head(driven: Driven, tmp_path_factory: pytest.TempPathFactory) -> ImuReadings:
    return driven.head(tmp_path_factory.mktemp("logs") / "head.csv")


# --- the bars -----------------------------------------------------------------------------------------


def test_offset_to_0_2_ms_and_drift_to_1_ppm_of_a_head(
    driven: Driven, trajectory: Trajectory, head: ImuReadings
) -> None:
    """A tactical-grade IMU in a head that is mounted askew, against a trajectory with errors."""
    fit = by_imu(head, trajectory)
    offset, worst, drift = driven.errors(fit.correction, driven.scene.profilers.clock)
    assert abs(offset) < 0.2e-3
    assert worst < 0.2e-3
    assert abs(drift) < 1e-6
    assert fit.correction.sigma_drift < 0.5e-6  # and it knows
    assert fit.explained > 0.99


def test_offset_to_0_2_ms_and_drift_to_1_ppm_of_an_encoder(driven: Driven, tmp_path: Path) -> None:
    """A wheel beside the middle, 0.6 % off in scale; ticks of a millimetre."""
    clean = Driven.of(driven.scene.changed(noise={"attitude_deg": 0.0, "position_m": 0.0}))
    fit = by_encoder(clean.encoder(tmp_path / "encoder.csv"), clean.trajectory())
    offset, worst, drift = clean.errors(fit.correction, clean.scene.encoder.clock)
    assert abs(offset) < 0.2e-3
    assert worst < 0.2e-3
    assert abs(drift) < 1e-6
    assert fit.gain == pytest.approx(1.006, abs=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "grade", "length_m", "noise"),
    [
        ("imu", "tactical", 300.0, {}),
        ("imu", "mems", 1000.0, NOISE),
        ("encoder", "tactical", 1000.0, NOISE),
    ],
)
def test_sigma_is_that_of_the_errors(
    tmp_path: Path, kind: str, grade: str, length_m: float, noise: dict[str, float]
) -> None:
    """Normalised errors of offset and drift over six drives: 12 squares, within the 99.9 % bounds of χ².

    `benchmarks/bench_clocks.py` does the same over many more. Ticks of a counter are not normal: there σ is too large.
    """
    squares = []
    for seed in range(6):
        draw = np.random.default_rng(seed)
        clock = {"offset_s": draw.uniform(-2, 2), "drift_ppm": draw.uniform(-60, 60)}
        one = Driven.of(scene_of(length_m, seed, clock, grade, noise=noise))
        if kind == "imu":
            fit = by_imu(one.head(tmp_path / "log.csv"), one.trajectory())
        else:
            fit = by_encoder(one.encoder(tmp_path / "log.csv"), one.trajectory())
        offset, _, drift = one.errors(fit.correction, one.scene.profilers.clock)
        squares += [(offset / fit.correction.sigma_offset_s) ** 2, (drift / fit.correction.sigma_drift) ** 2]
    assert 0.2 < sum(squares) < 32.9


# --- what helps ---------------------------------------------------------------------------------------


def test_another_imu_in_place_of_a_trajectory(driven: Driven, head: ImuReadings, tmp_path: Path) -> None:
    """Both heads share a clock, so between them there is no offset: no orientation is told to the estimator."""
    motion = turning_of_imu(driven.head(tmp_path / "left.csv", 0))
    fit = clock_from_motion(
        felt_by_imu(head, motion.interval_s), motion, search_s=5.0, drift="auto", what="the right head"
    )
    assert abs(fit.correction.offset_s) < 0.1e-3
    assert abs(fit.correction.offset_s) < 4 * fit.correction.sigma_offset_s
    assert abs(fit.correction.drift) < 4 * fit.correction.sigma_drift


def test_axes_scale_and_bias_do_not_matter(driven: Driven, trajectory: Trajectory, head: ImuReadings) -> None:
    turned = head.angular_rate_rad_per_s @ np.array([[0.0, 0.6, 0.8], [0.0, -0.8, 0.6], [1.0, 0.0, 0.0]])
    other = replace(head, angular_rate_rad_per_s=1.03 * turned + [0.02, -0.01, 0.03])
    plain, odd = by_imu(head, trajectory), by_imu(other, trajectory)
    ends = head.epochs_gps_ns[[0, -1]]
    assert np.abs(odd.correction.applied(ends) - plain.correction.applied(ends)).max() < 5_000  # a quarter of σ there
    assert odd.gain == pytest.approx(1.03 * plain.gain, rel=1e-3)


def test_gaps_of_both_logs_are_not_bridged(driven: Driven, trajectory: Trajectory, head: ImuReadings) -> None:
    first = head.epochs_gps_ns[0]
    heard = ~((head.epochs_gps_ns > first + 60 * 10**9) & (head.epochs_gps_ns < first + 95 * 10**9))
    imu = ImuReadings(*(getattr(head, f)[heard] for f in ImuReadings.__dataclass_fields__))
    start = trajectory.epochs_gps_ns[0]
    seen = ~((trajectory.epochs_gps_ns > start + 150 * 10**9) & (trajectory.epochs_gps_ns < start + 170 * 10**9))
    poses = Trajectory.of(
        trajectory.world,
        trajectory.epochs_gps_ns[seen],
        trajectory.position_world_m[seen],
        trajectory.quaternion_world_from_body[seen],
    )
    fit = by_imu(imu, poses)
    assert driven.errors(fit.correction, driven.scene.profilers.clock)[1] < 0.2e-3
    middles = fit.residuals.epochs_gps_ns
    assert not ((middles > first + 65 * 10**9) & (middles < first + 90 * 10**9)).any()


def test_a_clock_that_jumps_for_a_while_is_left_out(driven: Driven, trajectory: Trajectory, head: ImuReadings) -> None:
    first = head.epochs_gps_ns[0]
    jumped = (head.epochs_gps_ns > first + 100 * 10**9) & (head.epochs_gps_ns < first + 135 * 10**9)
    late = replace(head, epochs_gps_ns=head.epochs_gps_ns + np.where(jumped, 4_000_000, 0))
    fit = by_imu(late, trajectory)
    assert driven.errors(fit.correction, driven.scene.profilers.clock)[1] < 0.2e-3
    out = fit.residuals.epochs_gps_ns[~fit.residuals.used]
    assert 2 <= out.size <= 6
    assert (np.abs(out - first - 117 * 10**9) < 25 * 10**9).all()


def test_no_drift_is_estimated_when_told(driven: Driven, trajectory: Trajectory, head: ImuReadings) -> None:
    fit = by_imu(head, trajectory, drift="none")
    assert (fit.correction.drift, fit.correction.sigma_drift) == (0.0, 0.0)
    assert fit.scale > 5.0  # 37 ppm over five minutes do not look like noise
    assert driven.errors(fit.correction, driven.scene.profilers.clock)[0] == pytest.approx(0.0, abs=2e-3)


# --- what does not ------------------------------------------------------------------------------------


def test_periodic_motion_is_refused(trajectory: Trajectory) -> None:
    """One sine: every period is as good as the next."""
    epochs = trajectory.epochs_gps_ns
    angle = 0.05 * np.sin(2 * np.pi * 0.5 * (epochs - epochs[0]) / 1e9)
    quaternion = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], axis=-1)
    swinging = Trajectory.of("local", epochs, np.zeros((epochs.size, 3)), quaternion)
    rate = 0.05 * np.pi * np.cos(2 * np.pi * 0.5 * (epochs - epochs[0]) / 1e9 + 0.4)
    rates = np.stack([rate, 0 * rate, 0 * rate], axis=-1) + np.random.default_rng(1).normal(0, 1e-4, (rate.size, 3))
    imu = ImuReadings(epochs, rates, rates)
    with pytest.raises(NavigationError, match=r"does not tell.*explains 99% of what was felt, and one of"):
        by_imu(imu, swinging)
    fit = by_imu(imu, swinging, search_s=0.6)  # less than half a period to both sides
    assert fit.correction.offset_s == pytest.approx(0.4 / np.pi, abs=1e-4)


def test_a_vehicle_that_stands_is_refused(trajectory: Trajectory) -> None:
    epochs = trajectory.epochs_gps_ns
    still = Trajectory.of("local", epochs, np.zeros((epochs.size, 3)), np.tile([1.0, 0, 0, 0], (epochs.size, 1)))
    noise = np.random.default_rng(2).normal(0, 1e-3, (epochs.size, 3))
    with pytest.raises(NavigationError, match="does not tell the clock's offset"):
        by_imu(ImuReadings(epochs, noise, noise), still)


def test_an_offset_beyond_the_search_is_refused(trajectory: Trajectory, head: ImuReadings) -> None:
    with pytest.raises(NavigationError, match=r"raise search_s|does not tell"):
        by_imu(head, trajectory, search_s=0.8)


def test_recordings_of_other_drives_are_refused(trajectory: Trajectory, tmp_path: Path) -> None:
    other = Driven.of(scene_of(4000.0, 77, CLOCK))
    with pytest.raises(NavigationError):
        by_imu(replace(other.head(tmp_path / "b.csv"), epochs_gps_ns=_at(trajectory, other)), trajectory)


def _at(trajectory: Trajectory, other: Driven) -> np.ndarray:
    """Epochs of another drive's head an hour off the trajectory's."""
    first, last = other.drive.recorded_span_gps_ns
    step = 5_000_000
    count = (last - 2 * 2 * step - (first + 2 * 2 * step)) // step + 1
    return trajectory.epochs_gps_ns[0] + 3600 * 10**9 + step * np.arange(count)


def test_degrees_for_radians_are_named(trajectory: Trajectory, head: ImuReadings) -> None:
    wrong = replace(head, angular_rate_rad_per_s=np.degrees(head.angular_rate_rad_per_s))
    with pytest.raises(NavigationError, match=r"57\.\d times the motion.*degrees for radians"):
        by_imu(wrong, trajectory)


# --- recordings ---------------------------------------------------------------------------------------


def test_a_recorded_gyroscope_against_recorded_poses(recordings: Path) -> None:
    """A car on a highway (comma2k19): IMU and poses are stamped by one host, the poses post-processed.

    No truth is published. Independently of roadscan: the lag at which the rate about the vertical correlates best with
    that of the poses, by a spline of the poses' angles and a scan of shifts.
    """
    folder = recordings / "odometer"
    load = {n: np.load(folder / f"{n}.npy") for n in ("IMU_gyro_t", "IMU_gyro_value", "global_pose_frame_times")}
    poses = Trajectory.of(
        WORLD_OF_POSES,
        np.rint(load["global_pose_frame_times"] * 1e9).astype(np.int64),
        np.load(folder / "global_pose_frame_positions.npy"),
        np.load(folder / "global_pose_frame_orientations.npy"),
    )
    rates = load["IMU_gyro_value"]
    imu = ImuReadings(np.rint(load["IMU_gyro_t"] * 1e9).astype(np.int64), rates, np.zeros_like(rates))
    fit = by_imu(imu, poses, drift="none")
    assert fit.explained > 0.9
    assert fit.gain == pytest.approx(1.0, abs=0.05)
    assert fit.correction.offset_s == pytest.approx(scanned_lag_s(load, poses), abs=4e-3)
    assert fit.correction.sigma_offset_s < 2e-3


WORLD_OF_POSES = "EPSG:4978"


def scanned_lag_s(load: dict[str, np.ndarray], poses: Trajectory) -> float:
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    times = load["global_pose_frame_times"]
    turn = RotationSpline(times, Rotation.from_quat(poses.quaternion_world_from_body[:, [1, 2, 3, 0]]))
    at = load["IMU_gyro_t"]
    kernel = np.ones(9) / 9  # about the poses' interval
    felt = np.stack([np.convolve(c, kernel, "same") for c in load["IMU_gyro_value"].T], axis=-1)
    inside = (at > times[0] + 1) & (at < times[-1] - 1)
    shifts = np.arange(-0.05, 0.0501, 0.005)
    left = []
    for shift in shifts:
        rate = turn(at[inside] + shift, 1)
        design = np.column_stack([rate, np.ones(rate.shape[0])])
        solution = np.linalg.lstsq(design, felt[inside], rcond=None)[0]
        left.append(((felt[inside] - design @ solution) ** 2).sum())
    fine = np.linspace(-0.045, 0.045, 1801)
    return float(fine[np.argmin(CubicSpline(shifts, left)(fine))])
