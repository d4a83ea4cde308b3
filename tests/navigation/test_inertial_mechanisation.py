"""Strapdown mechanisation against another library, against motion in closed form, and against the simulator."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyins.earth
import pyins.strapdown
import pyins.transform
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from roadscan.compute.kernel_options import kernel
from roadscan.core.frames import ecef_from_ned, quaternion_from_rotation, rotation_from_rph
from roadscan.navigation.inertial.alignment import ecef_from_level, gravity_ecef
from roadscan.navigation.inertial.kernels.strapdown import gravity_field, increments, strapdown_step
from tests.navigation.inertial_drives import NO_GAPS, simulated, urban

TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


@kernel
def strapdown(steps, turn, push, quaternions, velocities, positions):
    """Run the free mechanisation from the first row of the outputs on.

    Parameters
    ----------
    steps, turn, push : as from :func:`increments`, s of them.
    quaternions : (s + 1, 4), velocities, positions : (s + 1, 3), ECEF; row 0 given, the others out.
    """
    q = (quaternions[0, 0], quaternions[0, 1], quaternions[0, 2], quaternions[0, 3])
    v = (velocities[0, 0], velocities[0, 1], velocities[0, 2])
    r = (positions[0, 0], positions[0, 1], positions[0, 2])
    for s in range(steps.size):
        field = gravity_field(r[0], r[1], r[2])
        a, b = (turn[s, 0], turn[s, 1], turn[s, 2]), (push[s, 0], push[s, 1], push[s, 2])
        q, v, r, _ = strapdown_step(q, v, r, a, b, steps[s], field)
        for j in range(4):
            quaternions[s + 1, j] = q[j]
        for j in range(3):
            velocities[s + 1, j] = v[j]
            positions[s + 1, j] = r[j]


def integrated(
    epochs: np.ndarray, rate: np.ndarray, force: np.ndarray, first: tuple[np.ndarray, ...], *, instant: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions, velocities and positions (ECEF) at all epochs."""
    n = epochs.size - 1
    steps, turn, push = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    increments(epochs, rate, force, instant, epochs, steps, turn, push)
    q, v, r = np.empty((n + 1, 4)), np.empty((n + 1, 3)), np.empty((n + 1, 3))
    q[0], v[0], r[0] = first
    strapdown(steps, turn, push, q, v, r)
    return q, v, r


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The copy keyword is deprecated")
@pytest.mark.parametrize("latitude", [48.0, -33.0, 84.0])
def test_mechanisation_agrees_with_pyins(latitude: float) -> None:
    """Two minutes of motion about all axes. pyins works in level axes at a first-order step, roadscan in ECEF."""
    t = np.arange(0.0, 120.0, 0.01)
    epochs = np.rint(t * 1e9).astype(np.int64)
    rate = np.stack([0.03 * np.sin(1.3 * t), 0.02 * np.cos(0.9 * t), 0.3 * np.sin(0.25 * t)], axis=-1)
    force = np.stack([1.5 * np.cos(0.4 * t), 0.8 * np.cos(0.7 * t), -9.81 + 0.5 * np.sin(2.1 * t)], axis=-1)
    rph, velocity_ned, height = np.array([-2.0, 0.5, 130.0]), np.array([12.0, -5.0, 0.3]), 80.0
    level = ecef_from_ned(np.radians(latitude), np.radians(11.0))
    position = np.array(TO_ECEF.transform(11.0, latitude, height))
    first = (quaternion_from_rotation(level @ rotation_from_rph(*np.radians(rph))), level @ velocity_ned, position)
    q, v, r = integrated(epochs, rate, force, first, instant=True)

    imu = pd.DataFrame(np.hstack([rate, force]), index=pd.Index(t, name="time"))
    imu.columns = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    start = [latitude, 11.0, height, *velocity_ned, *rph]
    names = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
    integrator = pyins.strapdown.Integrator(pd.Series(start, index=names, name=0.0))
    last = integrator.integrate(pyins.strapdown.compute_increments_from_imu(imu, "rate")).iloc[-1]

    there = np.array(TO_ECEF.transform(last.lon, last.lat, last.alt))
    moved = np.linalg.norm(there - position)
    assert moved > 500.0
    level = ecef_from_level(r[-1:])[0]
    # Its gravity leaves out how its fall with height depends on latitude: below 2e-6 m/s² within 300 m.
    assert abs(last.alt - height) < 300.0
    assert np.linalg.norm(r[-1] - there) < 0.01
    assert np.abs(v[-1] @ level - last[["VN", "VE", "VD"]].to_numpy(float)).max() < 5e-4
    other = Rotation.from_matrix(rotation_from_rph(*np.radians(last[["roll", "pitch", "heading"]].to_numpy(float))))
    own = Rotation.from_matrix(level.T @ Rotation.from_quat(q[-1], scalar_first=True).as_matrix())
    assert (other.inv() * own).magnitude() < 1e-6


@pytest.mark.parametrize(("latitude", "height"), [(0.0, 0.0), (45.0, 500.0), (-70.0, 3000.0), (90.0, 100.0)])
def test_normal_gravity_is_that_of_pyins(latitude: float, height: float) -> None:
    """pyins leaves out the second order in height: 1e-6 m/s² at 500 m, 5e-5 at 3000 m with the flattening's part."""
    gravity = gravity_ecef(np.array(TO_ECEF.transform(20.0, latitude, height)))
    assert np.linalg.norm(gravity) == pytest.approx(
        float(pyins.earth.gravity(latitude, height)), abs=1e-5 + 2e-8 * height
    )
    up = -gravity / np.linalg.norm(gravity)
    assert up @ ecef_from_ned(np.radians(latitude), np.radians(20.0))[:, 2] == pytest.approx(-1.0, abs=1e-12)


def test_standing_at_the_pole_stays() -> None:
    """No formula divides by the cosine of the latitude."""
    position = np.array(TO_ECEF.transform(0.0, 90.0, 10.0))
    epochs = np.arange(0, 60_000_000_000, 10_000_000)
    rate, force = np.tile([0.0, 0.0, 7.292115e-5], (6000, 1)), np.tile(-gravity_ecef(position), (6000, 1))
    q, v, r = integrated(epochs, rate, force, (np.array([1.0, 0, 0, 0]), np.zeros(3), position), instant=True)
    assert np.abs(v).max() < 1e-8
    assert np.abs(r - position).max() < 1e-6
    assert np.abs(q[-1] - q[0]).max() < 1e-12


def test_coning_is_compensated() -> None:
    """A body whose axis goes round a cone (Savage 1998, part 1): the mean rate alone drifts, the compensation does not.

    Samples are exact means, as an integrating IMU gives them.
    """
    step, tilt, turns = 0.01, np.radians(1.0), 2 * np.pi * 5.0
    t, fine = step * np.arange(2001), step / 50 * np.arange(2000 * 50 + 1)
    axis = np.stack([np.cos(turns * t), np.sin(turns * t), np.zeros_like(t)], axis=-1)
    attitude = Rotation.from_rotvec(tilt * axis)
    fine_axis = np.stack([np.cos(turns * fine), np.sin(turns * fine), np.zeros_like(fine)], axis=-1)
    turned = Rotation.from_rotvec(tilt * fine_axis)
    small = (turned[:-1].inv() * turned[1:]).as_rotvec()
    mean = small.reshape(-1, 50, 3).sum(axis=1) / step
    rate = np.vstack([mean[:1], mean])
    epochs = np.rint(t * 1e9).astype(np.int64)
    n = epochs.size - 1
    steps, turn, push = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    increments(epochs, rate, np.zeros_like(rate), False, epochs, steps, turn, push)

    def drift(rotations: np.ndarray) -> float:
        reached = attitude[0]
        for one in Rotation.from_rotvec(rotations):
            reached = reached * one
        return float((attitude[-1].inv() * reached).magnitude())

    plain, compensated = drift(mean * step), drift(turn)
    assert plain > np.radians(0.02)
    assert compensated < plain / 20


def test_perfect_imu_of_the_simulator_needs_no_gnss() -> None:
    """Two minutes of free mechanisation through a town, from samples at 200 Hz: the simulator's own derivatives."""
    scene = urban("perfect", NO_GAPS, imu={"on": True, "grade": "perfect", "rate_hz": 200.0})
    made = simulated(scene, noisy=False)
    n = 200 * 120
    part = slice(0, n)
    first = (
        made.truth.ecef_from_body[0].as_quat(scalar_first=True),
        made.velocity_ecef_m_per_s[0],
        made.truth.position_ecef_m[0],
    )
    imu = made.imu
    q, v, r = integrated(
        imu.epochs_gps_ns[part],
        imu.angular_rate_rad_per_s[part],
        imu.specific_force_m_per_s2[part],
        first,
        instant=True,
    )
    there = made.truth.position_ecef_m[n - 1]
    assert np.linalg.norm(there - r[0]) > 500.0
    assert np.linalg.norm(r[-1] - there) < 0.05
    assert np.linalg.norm(v[-1] - made.velocity_ecef_m_per_s[n - 1]) < 1e-3
    turn = made.truth.ecef_from_body[n - 1].inv() * Rotation.from_quat(q[-1], scalar_first=True)
    assert turn.magnitude() < 1e-5
