"""Poses that no vehicle can have taken are found, and nothing else is; steps are named and kept."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from roadscan.poses.leaps import PoseTrack, find_leaps, rotation_vectors

Float64 = npt.NDArray[np.float64]
RATES_HZ = [1.0, 5.0, 10.0, 50.0, 100.0, 200.0]


def drive(hz: float = 100.0, poses: int = 400, still: bool = False) -> PoseTrack:
    """Half at 130 km/h in a curve, half braking at 8 m/s²; geocentric, and the body rolls and pitches."""
    t = np.arange(poses) / hz
    speed, braking, until = 36.0, 8.0, poses / hz / 2
    since = np.clip(t - until, 0, speed / braking)
    way = np.where(t < until, speed * t, speed * until + speed * since - 0.5 * braking * since**2) * (not still)
    along = way / 300.0
    local = np.stack([300.0 * np.sin(along), 300.0 * (1 - np.cos(along)), 0.02 * way], axis=-1)
    body = Rotation.from_euler(
        "ZYX", np.stack([-along, np.radians(1.0) * np.cos(10 * t), np.radians(0.5) * np.sin(12 * t)], axis=-1)
    )
    place = np.array([4.22e6, 0.668e6, 4.717e6])
    up = place / np.linalg.norm(place)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    axes = np.stack([np.cross(up, east), east, -up], axis=-1)
    enu = np.stack([np.cross(up, east), east, up], axis=-1)
    quaternion = (Rotation.from_matrix(axes) * body).as_quat(scalar_first=True)
    return PoseTrack(
        np.round(t * 1e9).astype(np.int64), place + local @ enu.T, quaternion, np.zeros(poses), np.zeros(poses), False
    )


def moved(track: PoseTrack, rows: slice, shift_m: Float64 | None = None, turn_rad: Float64 | None = None) -> PoseTrack:
    """A track of which some poses lie elsewhere, or are turned."""
    position, quaternion = track.position_world_m.copy(), track.quaternion.copy()
    if shift_m is not None:
        position[rows] += shift_m
    if turn_rad is not None:
        turned = Rotation.from_quat(quaternion[rows], scalar_first=True) * Rotation.from_rotvec(turn_rad)
        quaternion[rows] = turned.as_quat(scalar_first=True)
    return track._replace(position_world_m=position, quaternion=quaternion)


def rows_of(mask: npt.NDArray[np.bool_]) -> list[int]:
    return np.flatnonzero(mask).tolist()


@pytest.mark.parametrize("hz", RATES_HZ)
@pytest.mark.parametrize("still", [False, True])
def test_a_sound_drive_has_none(hz: float, still: bool) -> None:
    track = drive(hz, still=still)
    rng = np.random.default_rng(1)
    noisy = track._replace(position_world_m=track.position_world_m + rng.normal(0, 0.01, (400, 3)))
    flipped = track._replace(quaternion=track.quaternion * rng.choice([-1.0, 1.0], (400, 1)))
    for one in (track, noisy, flipped):
        found = find_leaps(one)
        assert not found.position.any() and not found.attitude.any() and found.steps == () and found.covered == ()


@pytest.mark.parametrize("seed", range(12))
def test_drawn_bursts_are_left_out_and_nothing_else(seed: int) -> None:
    """20 draws each: position, height or attitude; 1 to 20 poses; 1 m to 1,000 km; anywhere; at 10 Hz and above."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        hz, still = float(rng.choice(RATES_HZ[2:])), bool(rng.random() < 0.3)
        track, count = drive(hz, still=still), int(rng.choice([1, 1, 2, 5, 20]))
        at = int(rng.choice([0, 400 - count, rng.integers(30, 350)])) if count <= 5 else int(rng.integers(30, 350))
        rows, size_m = slice(at, at + count), 10 ** rng.uniform(0, 6)
        direction = rng.normal(size=3)
        kind = rng.choice(["position", "height", "attitude"])
        if kind == "attitude":
            turn = np.radians(rng.uniform(15, 170)) * np.eye(3)[rng.integers(3)]
            wrong = moved(track, rows, turn_rad=turn)
        else:
            up = track.position_world_m[0] / np.linalg.norm(track.position_world_m[0])
            shift = up if kind == "height" else direction / np.linalg.norm(direction)
            wrong = moved(track, rows, shift_m=size_m * shift)
        found = find_leaps(wrong)
        assert rows_of(found.position | found.attitude) == list(range(at, at + count)), (kind, hz, still, at, count)
        assert found.steps == ()


def test_a_spike_of_a_decimetre_at_a_hundred_hertz() -> None:
    track = drive(100.0)
    for at in (0, 1, 200, 398, 399):
        found = find_leaps(moved(track, slice(at, at + 1), np.array([0.2, 0.2, 0.1])))
        assert rows_of(found.position) == [at]
        assert found.shift_m[at] == pytest.approx(0.3, abs=0.02)


def test_a_stated_sigma_that_allows_a_leap_keeps_the_pose() -> None:
    """0.5 m at σ 0.6 m is named with its σ; 5 m at that σ is left out."""
    track = drive(100.0)._replace(sigma_m=np.full(400, 0.6))
    near, far = (find_leaps(moved(track, slice(200, 201), np.array([size, 0.0, 0.0]))) for size in (0.5, 5.0))
    assert not near.position.any() and near.covered and near.covered[0].sigma_m == 0.6
    assert rows_of(far.position) == [200] and far.covered == ()


@pytest.mark.parametrize("size_m", [0.5, 30.0, 5000.0])
def test_a_step_keeps_both_sides(size_m: float) -> None:
    found = find_leaps(moved(drive(100.0), slice(150, 400), np.array([0.0, size_m, 0.0])))
    assert not found.position.any()
    ((before, after, shift_m, _, _),) = found.steps
    assert (before, after) == (149, 150) and shift_m == pytest.approx(size_m, rel=0.1)


def test_a_step_within_its_sigma_is_named_with_it() -> None:
    track = drive(100.0)._replace(sigma_m=np.full(400, 0.6))
    found = find_leaps(moved(track, slice(150, 400), np.array([0.0, 0.5, 0.0])))
    assert not found.position.any() and found.steps == () and len(found.covered) == 1


def test_beside_a_gap() -> None:
    """The first poses after a gap, and the last before it."""
    track = drive(100.0)
    late = np.where(np.arange(400) >= 200, 5_000_000_000, 0)
    track = track._replace(epochs_gps_ns=track.epochs_gps_ns + late)
    for rows in (slice(200, 203), slice(198, 200)):
        found = find_leaps(moved(track, rows, np.array([0.0, 0.0, 900.0])))
        assert rows_of(found.position) == list(range(rows.start, rows.stop)) and found.steps == ()


def test_many_spikes_and_a_long_burst_far_away() -> None:
    track = drive(200.0, 2_000)
    for at in range(50, 1_950, 100):
        track = moved(track, slice(at, at + 1), np.array([3.0, 0.0, 0.0]))
    assert rows_of(find_leaps(track).position) == list(range(50, 1_950, 100))
    away = find_leaps(moved(drive(200.0, 2_000), slice(700, 900), np.array([0.0, 1e5, 0.0])))
    assert rows_of(away.position) == list(range(700, 900))


def test_a_log_that_leaps_everywhere_is_named_and_kept() -> None:
    """Half of the poses lie elsewhere: which half is right, nothing shows."""
    track, rng = drive(10.0), np.random.default_rng(2)
    levels = np.repeat(rng.uniform(-20, 20, (40, 3)), 10, axis=0)
    found = find_leaps(track._replace(position_world_m=track.position_world_m + levels))
    assert found.position.sum() <= 100 and len(found.steps) >= 20


def test_few_poses() -> None:
    for count in range(4):
        found = find_leaps(drive(100.0, max(count, 1)))
        assert not found.position.any()


def test_rotation_vectors_are_those_of_scipy() -> None:
    rng = np.random.default_rng(3)
    before, after = (Rotation.from_quat(rng.normal(size=(50, 4))) for _ in range(2))
    expected = (before.inv() * after).as_rotvec()
    got = rotation_vectors(before.as_quat(scalar_first=True), -after.as_quat(scalar_first=True))
    np.testing.assert_allclose(got, expected, atol=1e-9)


def stated(track: PoseTrack) -> PoseTrack:
    """The track with the velocities of its positions, as a navigation solution states them."""
    velocity = np.gradient(track.position_world_m, track.epochs_gps_ns / 1e9, axis=0)
    return track._replace(velocity_world_m_per_s=velocity)


@pytest.mark.parametrize(("hz", "step_m", "without_m"), [(1.0, 2.5, 6.0), (5.0, 0.25, 0.4), (100.0, 0.12, 0.13)])
@pytest.mark.parametrize("seed", range(4))
def test_stated_velocities_tell_smaller_leaps(hz: float, step_m: float, without_m: float, seed: int) -> None:
    """Bursts of one to five poses, and steps, in any direction; larger ones without velocities."""
    rng = np.random.default_rng(seed)
    sound = drive(hz)
    for track, size_m in ((stated(sound), step_m), (sound, without_m)):
        direction = rng.normal(size=3)
        direction *= size_m / np.linalg.norm(direction)
        at, count = int(rng.integers(30, 350)), int(rng.integers(1, 6))
        burst = find_leaps(moved(track, slice(at, at + count), direction))
        assert rows_of(burst.position) == list(range(at, at + count))
        step = find_leaps(moved(track, slice(at, None), direction))
        assert [one.after for one in step.steps] == [at] and not step.position.any()
        assert step.steps[0].shift_m == pytest.approx(size_m, abs=0.3 * size_m)


@pytest.mark.parametrize("hz", [1.0, 10.0, 100.0])
def test_a_wrong_velocity_is_no_leap_of_positions(hz: float) -> None:
    """A velocity that is anywhere, velocities that are zero for a while, and those of another frame."""
    track = stated(drive(hz))
    assert track.velocity_world_m_per_s is not None
    rng = np.random.default_rng(3)
    for rows, factor in ((slice(120, 121), -3.0), (slice(100, 160), 0.0), (slice(None), 0.0), (slice(None), -1.0)):
        velocity = track.velocity_world_m_per_s.copy()
        velocity[rows] *= factor
        found = find_leaps(track._replace(velocity_world_m_per_s=velocity))
        assert not found.position.any() and found.steps == ()
    lost = np.where(rng.random((400, 1)) < 0.5, np.nan, track.velocity_world_m_per_s)
    assert find_leaps(track._replace(velocity_world_m_per_s=lost)).steps == ()


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_a_driver_who_brakes_and_swerves_as_hard_as_tyres_hold_leaps_nowhere(hz: float) -> None:
    """Drawn drives: brakes of up to 9.8 m/s² that begin within 0.1 s, stops, and 8 m/s² to either side."""
    rng, dt, seconds = np.random.default_rng(11), 0.01, 120
    t = np.arange(0.0, seconds, dt)
    for _ in range(25):
        asked = np.zeros(t.size)
        at = 0
        while at < t.size:
            until = at + int(rng.uniform(0.3, 8.0) / dt)
            asked[at:until] = rng.choice(
                [0.0, -9.8, -rng.uniform(2.0, 9.8), rng.uniform(0.5, 4.0)], p=[0.5, 0.1, 0.1, 0.3]
            )
            at = until
        asked = np.convolve(asked, np.ones(10) / 10, "same")
        speed = np.empty(t.size)
        now = rng.uniform(5.0, 35.0)
        for k in range(t.size):
            now = min(max(0.0, now + asked[k] * dt), 40.0)
            speed[k] = now
        turning = np.repeat(rng.uniform(-1.0, 1.0, seconds // 4), 400) * np.minimum(8.0 / np.maximum(speed, 2.0), 0.8)
        course = np.cumsum(np.convolve(turning, np.ones(30) / 30, "same")) * dt
        velocity = np.stack([speed * np.cos(course), speed * np.sin(course), 0.0 * t], axis=-1)
        own = slice(int(rng.integers(int(1 / hz / dt))), None, int(1 / hz / dt))
        count = t[own].size
        track = PoseTrack(
            np.round(t[own] * 1e9).astype(np.int64), np.cumsum(velocity, axis=0)[own] * dt,
            np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.zeros(count), np.zeros(count), True,
        )  # fmt: skip
        for one in (track, track._replace(velocity_world_m_per_s=velocity[own])):
            found = find_leaps(one)
            assert not found.position.any() and found.steps == ()
