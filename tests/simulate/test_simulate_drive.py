"""How the vehicle drives, against integrals, differences and projections by SciPy, NumPy and pyproj."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, RotationSpline

from roadscan.core.errors import ConfigError
from roadscan.simulate.drive import RUN_UP_S, Drive, drives_of
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Mount, Scene
from roadscan.simulate.surface import Surface

ENU_FROM_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
STILL = {"heave_m": 0.0, "sway_deg": 0.0, "wander_m": 0.0}
STREET = [
    {"kind": "straight", "length_m": 40.0},
    {"kind": "spiral", "length_m": 20.0},
    {"kind": "arc", "length_m": 40.0, "radius_m": 60.0},
    {"kind": "spiral", "length_m": 20.0},
]


def street(**changed) -> Scene:
    """A curved street in the local frame, driven there and back."""
    return Scene.model_validate(
        {
            "length_m": 120.0,
            "pause_s": 60.0,
            "map": {"crs": "local", "easting_m": 100.0, "northing_m": 50.0, "height_m": 10.0},
            "road": {"alignment": STREET, "waves": [{"wavelength_m": 31.0, "amplitude_m": 0.03}]},
            "passes": [{"lane": 2}, {"lane": 1, "direction": "backward"}],
        }
    ).changed(**changed)


def yard(pieces: list[dict], *, speed: float = 4.0, vehicle: dict | None = None, **route) -> Scene:
    """A wide straight road in the local frame, and a route over it."""
    placed = {"station_m": 60.0, "offset_m": -5.0, "pieces": pieces, **route}
    return Scene.model_validate(
        {
            "length_m": 120.0,
            "map": {"crs": "local", "azimuth_deg": 30.0},
            "road": {"lane_width_m": 40.0, "lead_m": 60.0, "cross_slope": 0.02, "grade": 0.01},
            "passes": [{"speed_m_per_s": speed, "route": placed}],
            "vehicle": STILL | {"speed_variation": 0.0} | (vehicle or {}),
        }
    )


def drive_of(scene: Scene, number: int = 0) -> Drive:
    return Drive(scene, number, Earth(scene.map.crs), Surface(scene, ride=True))


def over(drive: Drive, *, per_s: int = 200) -> np.ndarray:
    """Epochs of the whole recorded span."""
    first, last = drive.recorded_span_gps_ns
    return np.arange(first, last + 1, 10**9 // per_s)


def angles(drive: Drive, epochs: np.ndarray) -> np.ndarray:
    """Heading, pitch, roll (n, 3) in the local frame (degrees)."""
    return (ENU_FROM_NED.inv() * drive.poses(epochs).ecef_from_body).as_euler("ZYX", degrees=True)


def feet(drive: Drive, epochs: np.ndarray, height_m: float = 0.95) -> np.ndarray:
    """Points (n, 3) of the local frame under the IMU, along the body's down axis."""
    poses = drive.poses(epochs)
    return poses.position_ecef_m + height_m * poses.ecef_from_body.apply([0.0, 0.0, 1.0])


# --- path --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "offset"), [(0, 1.75 + 0.4), (1, -1.75 - 0.3)])
def test_a_lane_is_followed_at_its_offset_and_lengths_are_those_of_the_path(number, offset):
    passes = [{"lane": 2, "offset_m": 0.4}, {"lane": 1, "direction": "backward", "offset_m": -0.3}]
    scene = street(passes=passes, vehicle=STILL)
    drive = drive_of(scene, number)
    epochs = drive.epoch_gps_ns(np.linspace(0.0, drive.length_m, 2001))
    points = feet(drive, epochs)
    surface = Surface(scene, ride=True)
    station, found = surface.station_offset_m(points[:, 0], points[:, 1])
    np.testing.assert_allclose(found, offset, atol=1e-6)
    np.testing.assert_allclose(station[[0, -1]], [0.0, 120.0] if number == 0 else [120.0, 0.0], atol=5e-6)
    np.testing.assert_allclose(drive.station_m(epochs), station, atol=5e-6)
    np.testing.assert_allclose(points[:, 2], surface.height_m(points[:, 0], points[:, 1]), atol=1e-6)
    chords = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert chords.sum() == pytest.approx(drive.length_m, abs=1e-5)
    # Twenty metres of clothoid each way and forty of arc turn by (20 + 40) / 60 to the right.
    assert drive.length_m == pytest.approx(120.0 - offset * 60.0 / 60.0, abs=1e-4)


def test_the_driver_wanders_about_the_lane():
    scene = street(vehicle=STILL | {"wander_m": 0.15})
    drive = drive_of(scene)
    epochs = over(drive)
    points = feet(drive, epochs)
    _, offset = Surface(scene, ride=True).station_offset_m(points[:, 0], points[:, 1])
    assert 0.05 < np.abs(offset - 1.75).max() <= 0.15 + 1e-6
    chords = np.hypot(*np.diff(points[:, :2], axis=0).T).sum()
    first, last = drive.driven_m(epochs[[0, -1]])
    assert chords == pytest.approx(last - first, abs=1e-4)


def test_a_full_circle_closes_and_has_its_radius():
    drive = drive_of(yard([{"length_m": 2 * math.pi * 12.0, "radius_m": 12.0}], heading_deg=20.0))
    driven = np.linspace(0.0, drive.length_m, 721)
    epochs = drive.epoch_gps_ns(driven)
    points = feet(drive, epochs)
    np.testing.assert_allclose(points[0], points[-1], atol=1e-6)
    # Azimuth 30° and 20° to its right: the centre lies 12 m at 140°.
    centre = points[0, :2] + 12.0 * np.array([math.sin(math.radians(140.0)), math.cos(math.radians(140.0))])
    np.testing.assert_allclose(np.hypot(*(points[:, :2] - centre).T), 12.0, atol=1e-6)
    heading = np.unwrap(angles(drive, epochs)[:, 0], period=360.0)
    np.testing.assert_allclose(heading, 50.0 + np.degrees(driven / 12.0), atol=1e-5)


def test_a_route_is_the_integral_of_its_eased_curvature():
    pieces = [{"length_m": 15.0}, {"length_m": 30.0, "radius_m": 10.0}, {"length_m": 20.0, "radius_m": -14.0}]
    drive = drive_of(yard(pieces, ease_m=4.0))
    driven = np.linspace(0.0, 65.0, 400)

    def curvature(s: float) -> float:  # joints at 15 and 45 m, eased over 2 m to each side
        return float(np.interp(s, [13.0, 17.0, 43.0, 47.0], [0.0, 0.1, 0.1, -1 / 14.0]))

    def rates(s: float, x: np.ndarray) -> list[float]:
        return [math.sin(x[2]), math.cos(x[2]), curvature(s)]

    epochs = drive.epoch_gps_ns(driven)
    points = feet(drive, epochs)
    start = [*points[0, :2], math.radians(30.0)]
    solved = solve_ivp(rates, (0.0, 65.0), start, t_eval=driven, rtol=1e-10, atol=1e-10, max_step=0.2)
    np.testing.assert_allclose(points[:, :2], solved.y[:2].T, atol=2e-6)
    heading = np.unwrap(angles(drive, epochs)[:, 0], period=360.0)
    np.testing.assert_allclose(heading, np.degrees(solved.y[2]), atol=0.005)
    turned = np.gradient(np.radians(heading), driven)
    arc = (driven > 20.0) & (driven < 40.0)
    np.testing.assert_allclose(turned[arc], 0.1, atol=1e-6)


def test_a_figure_of_eight_crosses_itself():
    circle = 2 * math.pi * 9.0
    drive = drive_of(yard([{"length_m": circle, "radius_m": 9.0}, {"length_m": circle, "radius_m": -9.0}], ease_m=5.0))
    driven = np.linspace(0.0, drive.length_m, 1001)
    heading = np.unwrap(angles(drive, drive.epoch_gps_ns(driven))[:, 0], period=360.0)
    assert heading[-1] == pytest.approx(heading[0], abs=1e-4)
    assert heading.max() - heading[0] == pytest.approx(360.0, abs=10.0)
    points = feet(drive, drive.epoch_gps_ns(driven))[:, :2]
    assert np.hypot(*(points[500] - points[0])) < 1.0
    assert np.ptp(points[:500], axis=0).max() == pytest.approx(18.0, abs=0.2)


def test_reversing_looks_back_along_the_same_path():
    pieces = [{"length_m": 12.0}, {"length_m": 25.0, "radius_m": 8.0}]
    ahead, back = (drive_of(yard(pieces, reverse=r)) for r in (False, True))
    epochs = over(ahead)
    np.testing.assert_array_equal(epochs, over(back))
    np.testing.assert_allclose(feet(ahead, epochs), feet(back, epochs), atol=1e-9)
    relative = ahead.poses(epochs).ecef_from_body.inv() * back.poses(epochs).ecef_from_body
    np.testing.assert_allclose(
        relative.as_matrix(), np.broadcast_to(np.diag([-1, -1, 1]), (epochs.size, 3, 3)), atol=1e-9
    )
    velocity = np.gradient(back.poses(epochs).position_ecef_m, 0.005, axis=0)
    along = back.poses(epochs).ecef_from_body.inv().apply(velocity)
    assert along[:, 0].max() < -3.5


# --- motion ------------------------------------------------------------------------------------------

TOWN = {
    "passes": [
        {
            "lane": 2,
            "speed_m_per_s": 12.0,
            "speeds": [{"at_m": 300.0, "speed_m_per_s": 6.0}, {"at_m": 500.0, "speed_m_per_s": 9.0}],
            "stops": [{"at_m": 120.0, "duration_s": 3.0}, {"at_m": 121.0, "duration_s": 0.5}],
        }
    ],
    "length_m": 600.0,
    "road": {"lead_m": 90.0},
    "vehicle": {"speed_variation": 0.1, "acceleration_m_per_s2": 1.8, "standstill_s": 4.0},
}


@pytest.fixture(scope="module")
def town() -> Drive:
    return drive_of(street(**TOWN))


def test_speed_keeps_below_what_is_stated_and_acceleration_within_its_limit(town):
    epochs = over(town)
    driven = town.driven_m(epochs)
    speed = np.gradient(driven, 0.005)
    assert np.diff(driven).min() > -1e-12
    slow = (driven > 300.0) & (driven < 500.0)
    assert speed.max() <= 1.1 * 12.0 + 1e-6
    assert speed.max() > 12.0
    assert speed[slow].max() <= 1.1 * 6.0 + 1e-3
    assert speed[slow].mean() == pytest.approx(6.0, rel=0.03)
    assert speed[driven > 500.0].max() <= 1.1 * 9.0 + 1e-6
    acceleration = np.gradient(speed, 0.005)
    wave = 0.1 * 12.0**2 * 2 * math.pi / 120.0
    assert np.abs(acceleration).max() <= 1.1 * 1.8 + wave
    assert acceleration.min() < -1.7
    # The full acceleration is reached over 0.8 s, as a smooth step that is 1.5 times as steep in its middle.
    jerk = np.gradient(acceleration, 0.005)
    assert np.abs(jerk).max() < 1.1 * 1.5 * 1.8 / 0.8 + 3 * wave


def test_stops_last_as_long_as_stated(town):
    epochs = over(town, per_s=1000)
    driven = town.driven_m(epochs)
    for at, lasts in ((120.0, 3.0), (121.0, 0.5)):
        arrives, leaves = (int(town.epoch_gps_ns(np.array([at + e]))[0]) for e in (0.0, 2e-9))
        # The vehicle creeps over the last and the first nanometres for some hundredths of a second.
        assert lasts <= (leaves - arrives) / 1e9 < lasts + 0.1
        exactly = np.abs(driven - at) < 1e-12
        assert exactly.sum() / 1000.0 == pytest.approx(lasts, abs=0.02)
    # From 12 m/s to a stop with 1.8 m/s², which takes 0.8 s to reach: 12² / (2 · 1.8) + 12 · 0.8 / 2 = 44.8 m.
    steady = drive_of(street(**TOWN | {"vehicle": TOWN["vehicle"] | {"speed_variation": 0.0}}))
    driven = steady.driven_m(over(steady, per_s=1000))
    speed = np.gradient(driven, 0.001)
    begins = driven[np.flatnonzero((driven < 120.0) & (speed > 12.0 - 1e-6))[-1]]
    assert 120.0 - begins == pytest.approx(44.8, abs=0.5)


def test_pose_stands_still_with_the_vehicle(town):
    arrives = int(town.epoch_gps_ns(np.array([120.0]))[0])
    epochs = arrives + np.arange(0, 2_900_000_000, 5_000_000)
    position = town.poses(epochs).position_ecef_m
    assert np.ptp(position, axis=0).max() == 0.0
    start = over(town)[:780]
    assert np.ptp(town.poses(start).position_ecef_m, axis=0).max() == 0.0
    assert np.isfinite(town.poses(over(town)).ecef_from_body.as_quat()).all()


def test_recorded_span_holds_standstill_and_run_up(town):
    first, last = town.recorded_span_gps_ns
    epochs = np.array([first, first + 4 * 10**9, town.start_gps_ns, last - 4 * 10**9, last])
    driven = town.driven_m(epochs)
    assert driven[0] == driven[1]
    assert driven[3] == driven[4]
    assert driven[2] == pytest.approx(0.0, abs=1e-9)
    run_up = town.start_gps_ns - round(RUN_UP_S * 1e9)
    cruising = town.driven_m(np.array([run_up, run_up + 10**7]))
    assert np.diff(cruising)[0] > 0.9 * 12.0 * 0.01
    plain = drive_of(street())
    span = np.array(plain.recorded_span_gps_ns) - plain.start_gps_ns
    np.testing.assert_allclose(span / 1e9, [-RUN_UP_S, plain.duration_s + RUN_UP_S], atol=1e-9)
    assert drive_of(street(), 1).start_gps_ns - plain.start_gps_ns == 60 * 10**9
    assert plain.duration_s == pytest.approx(plain.length_m / 13.9, rel=0.03)


def test_time_and_length_are_inverse(town):
    driven = np.arange(0.0, 600.0, 0.0005)
    epochs = town.epoch_gps_ns(driven)
    assert np.diff(epochs).min() > 0
    np.testing.assert_allclose(town.driven_m(epochs), driven, atol=1e-7)
    moving = over(town)
    speed = np.gradient(town.driven_m(moving), 0.005)
    moving = moving[speed > 0.5]
    assert np.abs(town.epoch_gps_ns(town.driven_m(moving)) - moving).max() <= 1
    assert town.epoch_gps_ns(np.array([0.0]))[0] == town.start_gps_ns
    assert town.epoch_gps_ns(np.array([town.length_m]))[0] - town.start_gps_ns == round(town.duration_s * 1e9)


def test_a_stop_right_after_the_start_is_kept():
    scene = street(passes=[{"lane": 2, "stops": [{"at_m": 1.0, "duration_s": 2.0}, {"at_m": 1.01, "duration_s": 1.0}]}])
    drive = drive_of(scene)
    driven = drive.driven_m(over(drive, per_s=1000))
    assert (np.abs(driven - 1.0) < 1e-9).sum() >= 2000
    assert (np.abs(driven - 1.01) < 1e-9).sum() >= 1000
    speed = np.gradient(driven, 0.001)
    assert np.abs(np.gradient(speed, 0.001)).max() < 1.06 * 1.5 + 0.7
    assert speed[driven < 0.9].max() < 5.0


# --- attitude ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [0, 1])
def test_the_body_stands_square_on_the_road(number):
    """Position, normal and direction by pyproj from points of the smooth surface around."""
    scene = street(map={"crs": "EPSG:32632", "easting_m": 691_000.0, "northing_m": 5_335_000.0}, vehicle=STILL)
    surface, drive = Surface(scene, ride=True), drive_of(scene, number)
    to_ecef = pyproj.Transformer.from_crs(pyproj.CRS("EPSG:32632").to_3d(), "EPSG:4978", always_xy=True)
    epochs = over(drive, per_s=7)[2:-2]
    sign = 1.0 if number == 0 else -1.0
    station = drive.station_m(epochs)

    def ecef(ahead: float, right: float) -> np.ndarray:
        e, n, _ = surface.place(station + sign * ahead, sign * (1.75 + right))
        return np.stack(to_ecef.transform(e, n, surface.height_m(e, n)), axis=-1)

    forward = ecef(0.5, 0.0) - ecef(-0.5, 0.0)
    down = np.cross(forward, ecef(0.0, 0.5) - ecef(0.0, -0.5))
    poses = drive.poses(epochs)
    body = poses.ecef_from_body.as_matrix()
    for axis, expected in ((0, forward), (2, down)):
        unit = expected / np.linalg.norm(expected, axis=1, keepdims=True)
        assert np.linalg.norm(body[:, :, axis] - unit, axis=1).max() < 5e-5
    np.testing.assert_allclose(poses.position_ecef_m + 0.95 * body[:, :, 2], ecef(0.0, 0.0), atol=2e-6)


def test_springs_stay_within_their_amplitudes():
    still, swaying = (
        drive_of(street(vehicle={"heave_m": heave, "sway_deg": sway})) for heave, sway in ((0.0, 0.0), (0.01, 0.5))
    )
    epochs = over(still, per_s=50)
    a, b = still.poses(epochs), swaying.poses(epochs)
    turned = np.degrees((a.ecef_from_body.inv() * b.ecef_from_body).as_rotvec())
    limits = np.abs(turned).max(axis=0)
    np.testing.assert_allclose(limits, [0.5, 0.35, 0.15], rtol=0.12)
    lifted = (a.position_ecef_m - b.position_ecef_m) @ [0.0, 0.0, 1.0]
    assert np.abs(lifted).max() == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("reverse", [False, True])
def test_the_body_leans_outwards_in_turns_and_dives_when_it_brakes(reverse):
    pieces = [{"length_m": 45.0}, {"length_m": 30.0, "radius_m": 15.0}, {"length_m": 30.0, "radius_m": -15.0}]
    scene = yard(pieces, speed=6.0, vehicle={"lean_deg_per_m_per_s2": 0.4}, reverse=reverse, offset_m=-15.0)
    scene = scene.changed(passes=[scene.passes[0].model_dump() | {"stops": [{"at_m": 20.0, "duration_s": 1.0}]}])
    upright = scene.changed(vehicle={"lean_deg_per_m_per_s2": 0.0})
    leaning, upright = drive_of(scene), drive_of(upright)
    epochs = over(leaning)
    _, pitch, roll = (angles(leaning, epochs) - angles(upright, epochs)).T
    driven = leaning.driven_m(epochs)
    lean = 0.4 * 6.0**2 / 15.0
    right, left = ((driven > low) & (driven < low + 14.0) for low in (53.0, 83.0))
    # Travelling backwards, the body's left is outside in a turn to the right of travel, and it squats when it brakes.
    sense = -1.0 if reverse else 1.0
    np.testing.assert_allclose(roll[right], -sense * lean, rtol=2e-3)
    np.testing.assert_allclose(roll[left], sense * lean, rtol=2e-3)
    before, after = (driven > 10.0) & (driven < 20.0), (driven > 20.0) & (driven < 30.0)
    assert (sense * pitch[before]).min() == pytest.approx(-0.4 * 1.5, rel=1e-3)
    assert (sense * pitch[after]).max() == pytest.approx(0.4 * 1.5, rel=1e-3)
    assert np.abs(sense * pitch[before]).max() == pytest.approx(0.4 * 1.5, rel=1e-3)
    standing = np.abs(driven - 20.0) < 1e-9
    assert np.abs(pitch[standing]).max() < 0.01
    assert np.abs(roll[driven < 30.0]).max() < 1e-3


def test_nose_follows_the_acceleration_of_the_path():
    scene = yard([{"length_m": 60.0}], speed=10.0, vehicle={"lean_deg_per_m_per_s2": 0.5, "speed_variation": 0.3})
    drive, upright = (drive_of(scene.changed(vehicle={"lean_deg_per_m_per_s2": k})) for k in (0.5, 0.0))
    epochs = over(drive)
    driven = drive.driven_m(epochs)
    acceleration = np.gradient(np.gradient(driven, 0.005), 0.005)
    pitch = angles(drive, epochs)[:, 1] - angles(upright, epochs)[:, 1]
    np.testing.assert_allclose(pitch[3:-3], 0.5 * acceleration[3:-3], atol=1e-3)
    assert np.ptp(pitch) > 0.2


def _gap_at_200_hz(drive: Drive) -> tuple[float, float]:
    """What interpolation between poses each 5 ms leaves: metres and radians."""
    epochs = over(drive)
    middles = epochs[2:-3] + np.array([1_100_000, 2_500_000])[:, None]
    middles = np.sort(middles.ravel())
    origin = drive.poses(epochs[:1]).position_ecef_m
    h = 1_000_000
    velocity = (drive.poses(epochs + h).position_ecef_m - drive.poses(epochs - h).position_ecef_m) / (2e-9 * h)
    seconds = (epochs - epochs[0]) * 1e-9
    here, true = drive.poses(epochs), drive.poses(middles)
    position = CubicHermiteSpline(seconds, here.position_ecef_m - origin, velocity)
    attitude = RotationSpline(seconds, here.ecef_from_body)
    at = (middles - epochs[0]) * 1e-9
    away = np.linalg.norm(position(at) + origin - true.position_ecef_m, axis=1)
    turned = (attitude(at).inv() * true.ecef_from_body).magnitude()
    return float(away.max()), float(turned.max())


def test_poses_at_200_hz_hold_the_whole_motion():
    """Interpolation leaves 0.02 mm and 0.002 mrad at most, also with stops, sharp turns and a live suspension."""
    lively = {"lean_deg_per_m_per_s2": 1.0, "sway_deg": 1.5, "heave_m": 0.015}
    stopping = drive_of(street(**TOWN | {"vehicle": TOWN["vehicle"] | lively}))
    pieces = [{"length_m": 10.0}, {"length_m": 40.0, "radius_m": 8.0}, {"length_m": 20.0, "radius_m": -12.0}]
    turning = drive_of(yard(pieces, speed=6.0, vehicle=lively, ease_m=3.0))
    for drive in (stopping, turning):
        metres, radians = _gap_at_200_hz(drive)
        assert metres < 2e-5
        assert radians < 2e-6


def test_sensor_has_its_true_mounting():
    drive = drive_of(street())
    epochs = over(drive, per_s=10)
    mount = Mount(lever_arm_body_m=(0.3, -0.8, -1.1), roll_deg=2.0, pitch_deg=-40.0, heading_deg=175.0)
    origin, rotation = drive.poses(epochs).sensor(mount, np.diag([1.0, -1.0, -1.0]))
    poses = drive.poses(epochs)
    boresight = Rotation.from_euler("z", 175.0, degrees=True) * Rotation.from_euler("y", -40.0, degrees=True)
    boresight = boresight * Rotation.from_euler("x", 2.0, degrees=True) * Rotation.from_euler("x", 180.0, degrees=True)
    np.testing.assert_allclose(rotation, (poses.ecef_from_body * boresight).as_matrix(), atol=1e-12)
    moved = poses.ecef_from_body.inv().apply(origin - poses.position_ecef_m)
    np.testing.assert_allclose(moved, np.broadcast_to([0.3, -0.8, -1.1], moved.shape), atol=1e-12)


def test_same_seed_same_poses_and_chunks_do_not_matter():
    one, again, other = drive_of(street()), drive_of(street()), drive_of(street(seed=2))
    epochs = over(one)
    whole = one.poses(epochs)
    parts = [again.poses(part) for part in np.array_split(epochs, 7)]
    np.testing.assert_array_equal(whole.position_ecef_m, np.concatenate([p.position_ecef_m for p in parts]))
    np.testing.assert_array_equal(
        whole.ecef_from_body.as_quat(), np.concatenate([p.ecef_from_body.as_quat() for p in parts])
    )
    assert np.abs(other.poses(epochs[100:200]).position_ecef_m - whole.position_ecef_m[100:200]).max() > 1e-3


# --- what cannot be driven ---------------------------------------------------------------------------


def test_a_route_off_the_surface_is_refused():
    with pytest.raises(ConfigError, match=r"route of pass 1 leaves the surface where .* m are driven"):
        drive_of(yard([{"length_m": 200.0}], heading_deg=90.0))


def test_a_lane_beside_the_surface_is_refused():
    road = {"alignment": STREET, "verge_width_m": 1.0}
    with pytest.raises(ConfigError, match=r"pass 1 drives up to 5\.85 m beside the reference line.*reaches 4\.50 m"):
        drive_of(street(road=road, passes=[{"lane": 2, "offset_m": 3.5}]))


def test_a_standing_start_needs_its_road():
    with pytest.raises(ConfigError, match=r"beyond the end of the road.*road\.lead_m"):
        drive_of(street(vehicle={"standstill_s": 5.0}))
    drive_of(street(vehicle={"standstill_s": 5.0}, road={"lead_m": 90.0}))


def test_short_pieces_are_refused():
    pieces = [{"length_m": 20.0}, {"length_m": 5.0, "radius_m": 10.0}, {"length_m": 20.0}]
    with pytest.raises(ConfigError, match="piece 2 of the route of pass 1 is 5 m long"):
        drive_of(yard(pieces, ease_m=6.0))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stops": [{"at_m": 30.0, "duration_s": 1.0}, {"at_m": 20.0, "duration_s": 1.0}]}, "not in the order driven"),
        ({"stops": [{"at_m": 130.0, "duration_s": 1.0}]}, "pass 1 has one of its stops at 130 m"),
        ({"speeds": [{"at_m": 300.0, "speed_m_per_s": 5.0}]}, "pass 1 has one of its speeds at 300 m"),
    ],
)
def test_stops_and_speeds_must_lie_on_the_pass_in_order(values, message):
    with pytest.raises(ConfigError, match=message):
        drive_of(street(passes=[{"lane": 2} | values]))


def test_passes_must_not_overlap():
    scene = street()
    earth, ride = Earth("local"), Surface(scene, ride=True)
    assert [d.number for d in drives_of(scene, earth, ride)] == [0, 1]
    stop = {"at_m": 60.0, "duration_s": 55.0}
    with pytest.raises(ConfigError, match=r"passes overlap in time.*give pause_s \d+ or more"):
        drives_of(street(passes=[{"lane": 2, "stops": [stop]}, {"lane": 1}]), earth, ride)


def test_poses_are_not_invented_outside_the_drive():
    drive = drive_of(street())
    first, last = drive.recorded_span_gps_ns
    drive.poses(np.array([first - 200_000_000, last + 200_000_000]))
    for epoch in (first - 300_000_000, last + 300_000_000):
        with pytest.raises(ValueError, match="poses of pass 1 are known from"):
            drive.poses(np.array([epoch]))
