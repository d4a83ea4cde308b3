"""The smoother against masked GNSS of a real drive, and against the truth of simulated ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from roadscan.core.errors import NavigationError
from roadscan.core.frames import rotation_from_quaternion
from roadscan.core.rig import IMU_GRADES, ImuGrade
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial import smoother
from roadscan.navigation.inertial.kernels.kalman_smoother import smooth_backwards
from roadscan.navigation.inertial.kernels.kalman_states import NAVIGATION, WITHOUT_SCALES
from roadscan.navigation.inertial.readings import ImuReadings, Solution
from roadscan.navigation.inertial.smoother import solve
from tests.navigation.inertial_drives import (
    DRIVE_CONFIG,
    INSTANT,
    NO_GAPS,
    THREE_GAPS,
    Simulated,
    highway,
    recorded,
    rows,
    simulated,
    urban,
)

THINNED = INSTANT.model_copy(update={"poses_per_s": 10.0})


def part(imu: ImuReadings, keep: np.ndarray | slice) -> ImuReadings:
    return ImuReadings(imu.epochs_gps_ns[keep], imu.angular_rate_rad_per_s[keep], imu.specific_force_m_per_s2[keep])


def fields(solution: Solution) -> list[np.ndarray]:
    """All arrays of a solution."""
    found = [v for v in vars(solution).values() if isinstance(v, np.ndarray)]
    assert solution.innovations is not None
    found += [v for v in vars(solution.innovations).values() if isinstance(v, np.ndarray) and v.dtype.kind == "f"][1:]
    return found + [a for pair in solution.states.values() for a in pair]


def smoothed(made: Simulated, config: SmootherConfig = THINNED, *, odometer: bool = True) -> Solution:
    return solve(made.imu, made.gnss, made.odometer if odometer else None, made.vehicle, config)


def test_real_drive_through_eleven_outages(recordings: Path) -> None:
    """Bars: the data's README; its published forward filter has 0.46 m, 0.68 m, 0.053 m, 0.011 m."""
    drive = recorded(recordings)
    solution = solve(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG)
    stated, own = drive.vehicle.antenna_lever_arm_body_m, solution.states["antenna_lever_arm_body_m"][0][-1]
    assert np.abs(own - stated).max() < 0.05
    for arm in (stated, own):
        error, sigma, outage = drive.errors(solution, arm)
        horizontal = np.hypot(error[:, 0], error[:, 1])
        worst = [horizontal[outage == k].max() for k in range(11)]
        assert np.median(worst) <= 0.25
        assert max(worst) <= 0.45
        outside = outage < 0
        assert np.sqrt((horizontal[outside] ** 2).mean()) <= 0.05
        assert np.sqrt((error[outside, 2] ** 2).mean()) <= 0.02
    inside = np.abs(error) < 2.5 * sigma
    assert inside.mean() >= 0.95
    assert inside[~outside].mean() >= 0.95


def test_the_lag_of_the_drives_velocities_is_found(recordings: Path) -> None:
    """Half of the interval of 0.25 s: what differences of the log's own positions say (README of the data: 4 Hz)."""
    drive = recorded(recordings)
    config = DRIVE_CONFIG.model_copy(update={"gnss_velocity_lag_s": 0.0, "gnss_velocity_lag_sigma_s": 0.2})
    solution = solve(drive.imu, drive.gnss, None, drive.vehicle, config)
    lag, sigma = (a[-1] for a in solution.states["gnss_velocity_lag_s"])
    assert lag == pytest.approx(0.125, abs=0.01)
    assert 0.0 < sigma < 0.005


def test_odometer_scale_of_a_real_car(recordings: Path) -> None:
    """The poses' path over the wheels' integral: 1.009 ± 0.002 (README of the data)."""
    imu, gnss, odometer, vehicle = highway(recordings)
    solution = solve(imu, gnss, odometer, vehicle, SmootherConfig())
    scale, sigma = (a[-1] for a in solution.states["odometer_scale"])
    assert 1.0 + scale == pytest.approx(1.009, abs=0.002)
    assert 5e-5 < sigma < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_errors_agree_with_their_covariance(grade: ImuGrade) -> None:
    """Normalised squared errors over the drive, mean of six seeds; `benchmarks/bench_smoother.py` does 50.

    Errors of a second are not independent of the next: the bounds are those of 6 seeds with about four independent
    times each. Three times too small a covariance, or a third of it too large, leaves them.
    """
    seeds = range(1, 7)
    found = []
    for seed in seeds:
        made = simulated(urban(grade), seed)
        config = THINNED.model_copy(update={"land_vehicle": False})
        found.append(made.normalised(smoothed(made, config, odometer=False)).mean(axis=1))
    position, velocity, attitude = np.mean(found, axis=0)
    freedom = 3 * len(seeds) * 4
    low, high = chi2.ppf([0.001, 0.999], freedom) / freedom * 3.0
    for value in (position, velocity, attitude):
        assert low < value < high


@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_smoother_with_odometer_bridges_a_minute(grade: ImuGrade) -> None:
    """Against the forward filter without odometer: five times at least."""
    forward, both = [], []
    for seed in (1, 2, 3):
        made = simulated(urban(grade), seed)
        first = solve(made.imu, made.gnss, None, made.vehicle, THINNED, smooth=False)
        last = smoothed(made)
        forward.append(made.worst_m(first, *THREE_GAPS[-1]))
        both.append(made.worst_m(last, *THREE_GAPS[-1]))
        scale, sigma = (a[-1] for a in last.states["odometer_scale"])
        # Ticks by 1.006; a metre of the map is 0.99965 m on the ground here (UTM, 66 km from the central meridian).
        assert scale == pytest.approx(1.0 / (1.006 * 0.99965) - 1.0, abs=5e-4)
        assert sigma < 5e-4
    assert max(both) < max(forward) / 5.0
    assert max(both) < 0.35


def test_two_runs_are_the_same_bytes_and_nothing_is_lost() -> None:
    made = simulated(urban())
    first, second = smoothed(made), smoothed(made)
    for a, b in zip(fields(first), fields(second), strict=True):
        assert a.tobytes() == b.tobytes()
        assert np.isfinite(a).all() or a.dtype.kind != "f" or a is first.innovations.residual  # type: ignore[union-attr]
    assert np.all(np.diff(first.epochs_gps_ns) > 0)
    assert (np.linalg.eigvalsh(first.covariance_position_ned_m2) > 0).all()


@pytest.mark.parametrize("masked", [False, True])
def test_covariances_of_the_real_drive_are_positive(recordings: Path, masked: bool) -> None:
    drive = recorded(recordings)
    gnss = drive.masked if masked else drive.gnss
    solution = solve(drive.imu, gnss, None, drive.vehicle, DRIVE_CONFIG)
    assert_positive(solution, stated_exactly=frozenset({"gnss_velocity_lag_s"}))
    moving = np.linalg.norm(solution.velocity_ned_m_per_s, axis=1) > 0.5
    assert_begins_plausibly(solution, standing=slice(0, int(np.argmax(moving))))


@pytest.mark.parametrize("grade", ["navigation", "tactical", "mems"])
@pytest.mark.parametrize("odometer", [False, True])
@pytest.mark.parametrize("start_s", [None, 100.0])
def test_covariances_are_positive(grade: ImuGrade, odometer: bool, start_s: float | None) -> None:
    """From a standing start, and from the middle of a drive."""
    made = simulated(urban(grade))
    imu = made.imu if start_s is None else part(made.imu, made.seconds_of_imu >= start_s)
    config = THINNED.model_copy(update={"land_vehicle": odometer})
    solution = solve(imu, made.gnss, made.odometer if odometer else None, made.vehicle, config)
    assert_positive(solution)
    moving = np.linalg.norm(solution.velocity_ned_m_per_s, axis=1) > 0.5
    if start_s is None:
        assert_begins_plausibly(solution, standing=slice(0, int(np.argmax(moving))))


def assert_positive(solution: Solution, stated_exactly: frozenset[str] = frozenset()) -> None:
    """Covariances have positive eigenvalues, all σ are positive but those of states that were stated exactly."""
    for covariance in (
        solution.covariance_position_ned_m2,
        solution.covariance_velocity_ned,
        solution.covariance_attitude_rad2,
    ):
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert solution.sigma_rph_rad.min() > 0.0
    for name, (_, sigma) in solution.states.items():
        assert sigma.max() == 0.0 if name in stated_exactly else sigma.min() > 0.0


def assert_begins_plausibly(solution: Solution, standing: slice) -> None:
    """Nothing but gravity levels a standing IMU: its tilt is as little known as its accelerometers' biases.

    Nor does its first second know much more than the rest of the standstill.
    """
    tilt = solution.sigma_rph_rad[standing, :2]
    assert len(tilt) > 50
    assert (tilt >= 0.5 * np.median(tilt, axis=0)).all()
    bias = solution.states["accel_bias_imu_m_per_s2"][1][0, :2]
    assert (tilt.min(axis=0) >= 0.5 * bias.min() / 9.81).all()


def test_the_way_back_is_the_textbooks(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against Bierman's equations with full matrices: (I − KH)ᵀ Λ (I − KH) + Hᵀ S⁻¹ H before an update, ΦᵀΛΦ a step."""
    calls: list[tuple] = []

    def kept(*arguments) -> None:  # type: ignore[no-untyped-def]
        smooth_backwards(*arguments)
        calls.append(arguments)

    monkeypatch.setattr(smoother, "smooth_backwards", kept)
    drive = recorded(recordings)
    solve(drive.imu, drive.masked, None, drive.vehicle, DRIVE_CONFIG)
    nodes, layout, record, updates, _, covariance, _, _ = calls[-1]
    information, identity = np.zeros((layout.size, layout.size)), np.eye(layout.size)
    for k in range(nodes.bound.size - 1, -1, -1):
        p = record.rows[k]
        expected = p[:, :NAVIGATION] - p @ information @ p.T
        sigma = np.sqrt(np.diag(expected))
        assert (np.abs(covariance[k] - expected) <= 1e-4 * np.outer(sigma, sigma)).all()
        for u in range(record.first_update[k + 1] - 1, record.first_update[k] - 1, -1):
            row, gain = (a[u, : updates.size[u]] for a in (updates.row, updates.gain))
            kept_share = identity - gain.T @ row
            information = kept_share.T @ information @ kept_share + row.T @ row
        if k > 0:
            transition = identity.copy()
            transition[:NAVIGATION, : layout.inertial] = record.transition[k]
            biases = np.arange(NAVIGATION, WITHOUT_SCALES)
            transition[biases, biases] = record.keep[k]
            colour = np.arange(layout.colour, layout.colour + 3)
            transition[colour, colour] = nodes.colour_keep[k]
            information = transition.T @ information @ transition


def test_indefinite_covariances_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adjoint that went wrong: no σ of 0 comes out of it."""

    def spoilt(nodes, layout, record, updates, correction, covariance, values, sigmas) -> None:  # type: ignore[no-untyped-def]
        smooth_backwards(nodes, layout, record, updates, correction, covariance, values, sigmas)
        covariance[5, 6, 7] = covariance[5, 7, 6] = 2.0 * np.sqrt(covariance[5, 6, 6] * covariance[5, 7, 7])

    monkeypatch.setattr(smoother, "smooth_backwards", spoilt)
    with pytest.raises(NavigationError, match="not positive definite"):
        smoothed(simulated(urban("tactical", NO_GAPS)))


def test_outliers_count_less_and_are_listed() -> None:
    """Multipath jumps that the receiver says nothing of."""
    changes = {"gnss": {"on": True, "jumps_per_minute": 4.0, "jump_m": 1.0}}
    made = simulated(urban("tactical", NO_GAPS, **changes))
    clean = simulated(urban("tactical", NO_GAPS))
    solution = smoothed(made)
    innovations = solution.innovations
    assert innovations is not None
    positions = innovations.kind == "gnss position"
    jumped = np.linalg.norm(made.gnss.position_world_m - clean.gnss.position_world_m, axis=1) > 0.3
    listed = np.isin(made.gnss.epochs_gps_ns, innovations.epochs_gps_ns[positions & (innovations.weight < 1.0)])
    assert jumped.sum() > 50
    assert listed[jumped].mean() > 0.95
    assert listed[~jumped].mean() < 0.05
    error = np.abs(made.errors(solution)[0])
    assert error.max() < 0.12
    assert (innovations.normalised[positions & (innovations.weight == 1.0)]).mean() == pytest.approx(1.0, abs=0.3)


def test_innovations_are_in_the_axes_that_the_table_states() -> None:
    """One position moved 5 m to the east shows 5 m in the second component."""
    made = simulated(urban("tactical", NO_GAPS))
    at = 800
    moved = made.gnss.position_world_m.copy()
    moved[at] += 5.0 * _east(moved[at])
    solution = solve(made.imu, replace(made.gnss, position_world_m=moved), None, made.vehicle, THINNED)
    innovations = solution.innovations
    assert innovations is not None
    row = (innovations.kind == "gnss position") & (innovations.epochs_gps_ns == made.gnss.epochs_gps_ns[at])
    assert innovations.residual[row][0] == pytest.approx([0.0, 5.0, 0.0], abs=0.15)
    assert innovations.weight[row][0] < 0.01
    sideways = innovations.residual[innovations.kind == "non-holonomic"]
    assert np.isnan(sideways[:, 0]).all()
    assert np.isfinite(sideways[:, 1:]).all()


def _east(position: np.ndarray) -> np.ndarray:
    longitude = np.arctan2(position[1], position[0])
    return np.array([-np.sin(longitude), np.cos(longitude), 0.0])


def test_short_silence_of_the_imu_is_bridged() -> None:
    made = simulated(urban("tactical", NO_GAPS))
    s = made.seconds_of_imu
    imu = part(made.imu, (s < 120.0) | (s >= 120.4))
    solution = solve(imu, made.gnss, made.odometer, made.vehicle, INSTANT)
    assert len(solution.pieces) == 1
    near = np.abs(made.seconds(solution) - 120.2) < 5.0
    error = made.errors(solution)[0][near]
    sigma = np.sqrt(np.einsum("nii->ni", solution.covariance_position_ned_m2[near]))
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.abs(error).max() < 0.2


def test_long_silence_divides_the_solution_and_is_named() -> None:
    made = simulated(urban("tactical", NO_GAPS))
    s = made.seconds_of_imu
    imu = part(made.imu, (s < 120.0) | ((s >= 125.0) & (s < 127.0)) | (s >= 140.0))
    solution = solve(imu, made.gnss, made.odometer, made.vehicle, THINNED)
    assert len(solution.pieces) == 2
    assert len(solution.notes) == 3
    assert "no trajectory from" in solution.notes[2]
    begin = made.drive.start_gps_ns
    edges = np.array(solution.pieces) * 1e-9 - begin * 1e-9
    assert edges[0, 1] == pytest.approx(120.0, abs=0.02)
    assert edges[1, 0] == pytest.approx(140.0, abs=0.25)
    assert np.abs(made.errors(solution)[0][:, :2]).max() < 0.1


@pytest.mark.parametrize(("start_s", "grade"), [(40.0, "tactical"), (100.0, "mems")])
def test_alignment_in_motion(start_s: float, grade: ImuGrade) -> None:
    """The log begins while the vehicle drives."""
    made = simulated(urban(grade, NO_GAPS))
    s = made.seconds_of_imu
    imu = part(made.imu, s >= start_s)
    solution = solve(imu, made.gnss, made.odometer, made.vehicle, THINNED)
    attitude = np.degrees(np.abs(made.errors(solution)[2]))
    assert attitude.max() < 1.0
    assert made.normalised(solution).mean(axis=1).max() < 9.0


def test_reversing_is_no_special_case() -> None:
    """A hundred and sixty metres backwards round a curve, with an encoder that counts upwards both ways."""
    pieces = [{"length_m": 60.0}, {"length_m": 60.0, "radius_m": 40.0}, {"length_m": 40.0}]
    route = {"station_m": 20.0, "offset_m": 0.0, "pieces": pieces, "reverse": True}
    scene = urban("tactical", NO_GAPS, length_m=300.0, passes=[{"route": route, "speed_m_per_s": 4.0}])
    scene = scene.changed(road={"alignment": [{"kind": "straight", "length_m": 400.0}], "verge_width_m": 120.0})
    made = simulated(scene)
    solution = smoothed(made)
    assert np.degrees(np.abs(made.errors(solution)[2])).max() < 0.5
    assert np.abs(made.errors(solution)[0]).max() < 0.1
    assert abs(solution.states["odometer_scale"][0][-1]) < 0.01


def test_navigation_grade_finds_north_standing() -> None:
    """A minute's standstill, then a straight line at constant speed: nothing but the Earth's rate tells the heading."""
    road = {"alignment": [{"kind": "straight", "length_m": 500.0}], "lead_m": 90.0}
    scene = urban("navigation", NO_GAPS, length_m=200.0, road=road, passes=[{"lane": 2, "speed_m_per_s": 5.0}])
    made = simulated(scene.changed(vehicle={"standstill_s": 90.0}))
    standing = made.seconds_of_imu < -20.0
    config = THINNED.model_copy(update={"land_vehicle": False})
    solution = solve(part(made.imu, standing), made.gnss, None, made.vehicle, config)
    errors = made.errors(solution)[2]
    assert np.degrees(np.abs(errors)).max() < 0.5
    mems = replace(made.vehicle, imu_errors=IMU_GRADES["mems"])
    with pytest.raises(NavigationError, match="heading"):
        solve(part(made.imu, standing), made.gnss, None, mems, config)


def test_reference_point_and_axes_are_those_of_the_rig() -> None:
    """An IMU beside the reference point, turned: the same trajectory."""
    made = simulated(urban("tactical", NO_GAPS))
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    rate, force = made.imu.angular_rate_rad_per_s @ turned, made.imu.specific_force_m_per_s2 @ turned
    shift = np.array([0.4, -0.3, 0.2])
    vehicle = replace(
        made.vehicle,
        body_from_imu=turned,
        imu_lever_arm_body_m=shift,
        antenna_lever_arm_body_m=made.vehicle.antenna_lever_arm_body_m + shift,
        wheel_lever_arm_body_m=made.vehicle.wheel_lever_arm_body_m + shift,  # type: ignore[operator]
    )
    plain = smoothed(made)
    moved = solve(ImuReadings(made.imu.epochs_gps_ns, rate, force), made.gnss, made.odometer, vehicle, THINNED)
    arm = rotation_from_quaternion(moved.quaternion_world_from_body) @ shift
    assert np.abs(moved.position_world_m + arm - plain.position_world_m).max() < 2e-3
    dots = np.abs((moved.quaternion_world_from_body * plain.quaternion_world_from_body).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(dots, 1.0))).max() < 5e-3


@pytest.mark.parametrize(("every", "limit_m"), [(1, 0.3), (5, 0.3)])
def test_positions_alone_are_enough(every: int, limit_m: float) -> None:
    """A receiver that states neither velocities nor covariances, at 5 Hz and at 1 Hz, gaps included."""
    made = simulated(urban("mems"))
    nothing = np.full_like(made.gnss.velocity_ned_m_per_s, np.nan)
    unknown = np.full_like(made.gnss.covariance_ned_m2, np.nan)
    gnss = replace(
        made.gnss, covariance_ned_m2=unknown, velocity_ned_m_per_s=nothing, sigma_velocity_ned_m_per_s=nothing
    )
    solution = solve(made.imu, rows(gnss, slice(0, None, every)), made.odometer, made.vehicle, THINNED)
    assert np.hypot(*made.errors(solution)[0][:, :2].T).max() < limit_m
    assert made.normalised(solution).mean(axis=1).max() < 6.0


def test_half_a_sample_matters() -> None:
    """Samples that hold at their stamps, taken for means: all is felt 5 ms too early, which the clock's state finds."""
    made = simulated(urban("tactical", NO_GAPS))
    config = SmootherConfig(imu_samples="mean", imu_clock_sigma_s=0.02, poses_per_s=10.0)
    solution = solve(made.imu, made.gnss, made.odometer, made.vehicle, config)
    delay, sigma = (a[-1] for a in solution.states["imu_delay_s"])
    assert delay == pytest.approx(-0.005, abs=4 * sigma)
    assert 0.0 < sigma < 0.001


def test_refusals() -> None:
    made = simulated(urban("tactical", NO_GAPS))
    with pytest.raises(NavigationError, match="local frame"):
        solve(made.imu, replace(made.gnss, world="local"), None, made.vehicle, INSTANT)
    with pytest.raises(NavigationError, match="0 usable GNSS"):
        solve(made.imu, replace(made.gnss, epochs_gps_ns=made.gnss.epochs_gps_ns + 10**15), None, made.vehicle, INSTANT)
    none = replace(made.gnss, quality=np.full(made.gnss.quality.size, "dead_reckoning"))
    with pytest.raises(NavigationError, match="0 usable GNSS"):
        solve(made.imu, none, None, made.vehicle, INSTANT)
    sparse = rows(made.gnss, slice(0, None, 50))
    assert solve(made.imu, sparse, made.odometer, made.vehicle, THINNED).epochs_gps_ns.size > 1000
