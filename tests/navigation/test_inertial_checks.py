"""Bad logs are refused or repaired with the record named; good ones pass: a recorded drive, and simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roadscan.core.crs import geodetic_from_world, world_from_geodetic
from roadscan.core.errors import ConfigError, CrsError, NavigationError, RoadscanError, TimeSystemError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S, WEEK_S
from roadscan.core.rig import IMU_GRADES
from roadscan.core.settings.navigation import SmootherConfig
from roadscan.navigation.inertial.checks import Prepared, prepared
from roadscan.navigation.inertial.readings import GnssSolutions, ImuReadings, OdometerReadings, VehicleSensors
from roadscan.navigation.inertial.smoother import solve
from roadscan.navigation.tasks.solve_trajectory import check_outcome
from roadscan.simulate import Scene
from roadscan.simulate.drive import drives_of
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Earth
from roadscan.simulate.sensors.clock import WheelEncoder
from roadscan.simulate.sensors.gnss import FIXED, _SensorErrors, felt, first_gps_ns, imu_of
from roadscan.simulate.sensors.gnss import solve as solutions_of
from roadscan.simulate.surface import Surface
from tests.navigation.recorded_drive import recorded_drive

Logs = tuple[ImuReadings, GnssSolutions, OdometerReadings | None, VehicleSensors]
Change = Callable[[ImuReadings, GnssSolutions, OdometerReadings | None], tuple[Any, Any, Any]]
WORLD = "EPSG:4978"
TURNS = [
    {"length_m": 60.0},
    {"length_m": 30.0, "radius_m": 20.0},
    {"length_m": 50.0},
    {"length_m": 40.0, "radius_m": -25.0},
    {"length_m": 60.0},
]
STOP = {"at_m": 100.0, "duration_s": 5.0}


@pytest.fixture
def drive(recordings: Path) -> Logs:
    """The recorded drive: 549 s, MEMS IMU at 100 Hz, RTK at 4 Hz."""
    return recorded_drive(recordings)


def simulated(
    grade: str = "mems",
    route: list[dict[str, float]] | None = None,
    *,
    reverse: bool = False,
    gnss: dict[str, Any] | None = None,
    vehicle: dict[str, Any] | None = None,
    signed_encoder: bool = True,
    mount: np.ndarray | None = None,
    **scene: Any,
) -> Logs:
    """Logs of a simulated drive; the IMU is turned by `mount` (body from IMU) and the rig knows it."""
    lane = {"lane": 2} if route is None else {"route": {"station_m": 10.0, "offset_m": 0.0, "pieces": route}}
    if route is not None:
        lane["route"]["reverse"] = reverse  # type: ignore[index]
    whole = Scene().changed(
        length_m=scene.pop("length_m", 300.0),
        passes=[lane | {"stops": scene.pop("stops", [])}],
        profilers={"on": False},
        lidar={"on": False},
        road={"verge_width_m": 120.0, "lead_m": 200.0},
        vehicle={"standstill_s": 10.0, "speed_m_per_s": 13.9 if route is None else 8.0} | (vehicle or {}),
        imu={"on": True, "grade": grade, "rate_hz": 100.0},
        gnss={"on": True} | (gnss or {}),
        encoder={"on": True},
        **scene,
    )
    one = drives_of(whole, Earth(whole.map.crs), Surface(whole, ride=True))[0]
    on = imu_of(whole)
    last = one.recorded_span_gps_ns[1] - 2 * on.stride * on.step_ns
    epochs = np.arange(first_gps_ns(one, on), last + 1, on.step_ns)
    errors = _SensorErrors(on, stream(whole.seed, 0, "imu"), stream(whole.seed, 0, "imu bias"))
    rate, force = errors.applied(*felt(one, on.mount, epochs, on.step_ns, on.stride))
    turned = np.eye(3) if mount is None else mount
    s = solutions_of(whole, one)
    solutions = GnssSolutions(
        WORLD,
        s.epoch_gps_ns,
        world_from_geodetic(WORLD, s.geographic),
        np.einsum("ni,ij->nij", s.sigma_ned_m**2, np.eye(3)),
        np.where(s.quality == FIXED, "fixed", "float"),
        s.velocity_ned_m_per_s,
        np.full((s.quality.size, 3), 0.03),
    )
    when = np.arange(*one.recorded_span_gps_ns, 20_000_000)
    way = WheelEncoder(whole, one).ticks(when) / whole.encoder.ticks_per_m * (one.sign if signed_encoder else 1.0)
    arm = np.array(whole.gnss.lever_arm_body_m)
    sensors = VehicleSensors(turned, np.zeros(3), on.errors, arm, np.full(3, 0.01), np.zeros(3))
    return (
        ImuReadings(epochs, rate @ turned, force @ turned),
        solutions,
        OdometerReadings(when, way, np.full(way.size, np.nan)),
        sensors,
    )


@cache
def turning() -> Logs:
    return simulated("tactical", TURNS, stops=[STOP])


@cache
def straight() -> Logs:
    return simulated("mems", stops=[STOP])


def refused(logs: Logs, change: Change, kind: type[RoadscanError], match: str) -> str:
    with pytest.raises(kind, match=match) as caught:
        prepared(*change(*logs[:3]), logs[3])
    assert caught.value.expected or caught.value.change
    return str(caught.value)


def mended(logs: Logs, change: Change) -> Prepared:
    return prepared(*change(*logs[:3]), logs[3])


def rates(f: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda i, g, o: (replace(i, angular_rate_rad_per_s=f(i.angular_rate_rad_per_s.copy())), g, o)


def forces(f: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda i, g, o: (replace(i, specific_force_m_per_s2=f(i.specific_force_m_per_s2.copy())), g, o)


def imu_late(seconds: float) -> Change:
    return lambda i, g, o: (replace(i, epochs_gps_ns=i.epochs_gps_ns + round(seconds * NS_PER_S)), g, o)


def imu_rows(rows: Callable[[int], np.ndarray]) -> Change:
    def change(i, g, o):
        k = rows(i.epochs_gps_ns.size)
        return ImuReadings(i.epochs_gps_ns[k], i.angular_rate_rad_per_s[k], i.specific_force_m_per_s2[k]), g, o

    return change


def positions(f: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda i, g, o: (i, replace(g, position_world_m=f(g.position_world_m.copy())), o)


def velocities(f: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda i, g, o: (i, replace(g, velocity_ned_m_per_s=f(g.velocity_ned_m_per_s)), o)


def distances(f: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda i, g, o: (i, g, replace(o, distance_m=f(o.distance_m.copy())))


def mapped(matrix: list[list[float]], *, gyro: bool = True, accelerometer: bool = True) -> Change:
    """Axes of the log are exchanged or turned, without a word in the rig."""
    m = np.array(matrix, dtype=float).T
    return lambda i, g, o: (
        replace(
            i,
            angular_rate_rad_per_s=i.angular_rate_rad_per_s @ (m if gyro else np.eye(3)),
            specific_force_m_per_s2=i.specific_force_m_per_s2 @ (m if accelerometer else np.eye(3)),
        ),
        g,
        o,
    )


def put(array: np.ndarray, rows: Any, value: Any) -> np.ndarray:
    array[rows] = value
    return array


def same(i: Any, g: Any, o: Any) -> tuple[Any, Any, Any]:
    return i, g, o


def test_recorded_drive_passes_untouched(drive: Logs) -> None:
    found = prepared(*drive)
    assert found.repairs == []
    assert np.array_equal(found.imu.epochs_gps_ns, drive[0].epochs_gps_ns)
    assert np.array_equal(found.imu.angular_rate_rad_per_s, drive[0].angular_rate_rad_per_s)
    assert np.array_equal(found.gnss.position_world_m, drive[1].position_world_m)


@pytest.mark.parametrize("grade", list(IMU_GRADES))
@pytest.mark.parametrize("route", [None, TURNS], ids=["straight", "turns"])
def test_simulated_drives_of_every_grade_pass(grade: str, route: list[dict[str, float]] | None) -> None:
    logs = simulated(grade, route, stops=[STOP])
    found = prepared(*logs)
    assert found.repairs == []
    assert found.odometer is not None
    assert np.array_equal(found.odometer.distance_m, logs[2].distance_m)  # type: ignore[union-attr]


ROLLED = Rotation.from_euler("ZYX", [92.0, 4.0, -177.0], degrees=True).as_matrix()


@pytest.mark.parametrize(
    "logs",
    [
        pytest.param({"vehicle": {"lean_deg_per_m_per_s2": 2.0, "sway_deg": 2.0}, "route": TURNS}, id="soft springs"),
        pytest.param({"route": TURNS, "mount": ROLLED}, id="any mounting"),
        pytest.param({"gnss": {"rate_hz": 1.0}, "route": TURNS}, id="1 Hz"),
        pytest.param({"gnss": {"gaps": [{"start_s": 5.0, "duration_s": 12.0}]}, "route": TURNS}, id="outage"),
        pytest.param({"gnss": {"jumps_per_minute": 10.0, "jump_m": 1.0}}, id="multipath"),
        pytest.param({"gnss": {"sigma_horizontal_m": 2.0, "sigma_vertical_m": 4.0}, "route": TURNS}, id="code only"),
        pytest.param({"length_m": 20.0, "vehicle": {"standstill_s": 0.0}}, id="short, never standing"),
        pytest.param({"length_m": 1.0, "vehicle": {"standstill_s": 60.0}}, id="hardly moving"),
        pytest.param({"vehicle": {"standstill_s": 0.0, "speed_variation": 0.0}}, id="even speed"),
        pytest.param({"route": TURNS, "reverse": True}, id="driven backwards, the encoder counts down"),
        pytest.param({"gnss": {"lever_arm_body_m": (2.5, 0.8, -2.0)}, "route": TURNS}, id="long lever arm"),
    ],
)
@pytest.mark.parametrize("velocity", [True, False], ids=["velocities", "positions only"])
def test_no_false_alarm(logs: dict[str, Any], velocity: bool) -> None:
    imu, gnss, odometer, vehicle = simulated(**logs)
    if not velocity:
        gnss = replace(gnss, velocity_ned_m_per_s=gnss.velocity_ned_m_per_s * np.nan)
    assert prepared(imu, gnss, odometer, vehicle).repairs == []
    assert prepared(imu, gnss, None, vehicle, drove_backwards=logs.get("reverse", False)).odometer is None


def test_reverse_drive_without_witness_asks() -> None:
    imu, gnss, odometer, vehicle = simulated(route=TURNS, reverse=True, signed_encoder=False)
    with pytest.raises(ConfigError, match=r"drives backwards over 2.. m and forward over 0 m; .*drove_backwards"):
        prepared(imu, gnss, None, vehicle)
    with pytest.raises(ConfigError, match="and the odometer counts upwards"):
        prepared(imu, gnss, odometer, vehicle)
    found = prepared(imu, gnss, odometer, vehicle, drove_backwards=True)
    assert odometer is not None
    assert found.odometer is not None
    assert found.odometer.distance_m == pytest.approx(-odometer.distance_m)  # backwards, it falls


AXES = {
    "x and y exchanged": (mapped([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), "speed is felt by the accelerometer on the IMU's"),
    "turned by 90°": (mapped([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), "speed is felt by the accelerometer on the IMU's"),
    "turned by 180°": (mapped(np.diag([-1.0, -1, 1]).tolist()), "backwards|gravity lies 13"),
    "x up": (mapped([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]), "gravity lies (89|90)"),
    "z the other way": (mapped(np.diag([1.0, 1, -1]).tolist()), "gravity lies 1(6|7).*points up"),
    "up for down": (mapped(np.diag([1.0, -1, -1]).tolist()), "gravity lies 1(6|7)"),
}


@pytest.mark.parametrize("name", AXES)
@pytest.mark.parametrize("which", ["recorded", "turning", "straight"])
def test_axes_of_the_whole_imu(name: str, which: str, request: pytest.FixtureRequest) -> None:
    logs = {"turning": turning, "straight": straight}.get(which, lambda: request.getfixturevalue("drive"))()
    refused(logs, AXES[name][0], ConfigError, AXES[name][1])


@pytest.mark.parametrize("which", ["recorded", "turning"])
def test_axes_of_one_triad(which: str, request: pytest.FixtureRequest) -> None:
    logs = turning() if which == "turning" else request.getfixturevalue("drive")
    z, x, y = (np.diag(d).tolist() for d in ([1.0, 1, -1], [-1.0, 1, 1], [1.0, -1, 1]))
    refused(logs, mapped(z, accelerometer=False), ConfigError, "turn of the GNSS course is felt by the gyroscope on")
    refused(logs, mapped(y, gyro=False), ConfigError, "bends is felt by the accelerometer on the IMU's −y")
    refused(logs, mapped(x, gyro=False), ConfigError, "felt by the accelerometer on the IMU's −x|gravity lies 13")
    swapped = [[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]
    refused(logs, mapped(swapped, accelerometer=False), ConfigError, "felt by the gyroscope on the IMU's .x")


def test_horizontal_gyroscopes_of_a_real_vehicle(drive: Logs) -> None:
    """A simulated vehicle is too calm to tell them; the recorded one tips by a quarter of a degree."""
    x, y = np.diag([-1.0, 1, 1]).tolist(), np.diag([1.0, -1, 1]).tolist()
    refused(drive, mapped(x, accelerometer=False), ConfigError, "as if it leaned by 13°")
    refused(drive, mapped(y, accelerometer=False), ConfigError, "tilt ahead .* on the IMU's −y")
    swapped = [[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]
    refused(drive, mapped(swapped, accelerometer=False), ConfigError, "tilt to the side .* expected on the IMU's −x")


def test_mounting_the_wrong_way_round(drive: Logs) -> None:
    """The transposed rotation of the recording's rig: 13.4° off, and refused."""
    wrong = replace(drive[3], body_from_imu=drive[3].body_from_imu.T)
    with pytest.raises(ConfigError, match=r"gravity lies 13\.\d° from where the IMU's mounting has it"):
        prepared(*drive[:3], wrong)


def test_no_turn_no_statement_about_the_yaw_rate() -> None:
    """What a straight drive cannot tell is not judged."""
    z = np.diag([1.0, 1, -1]).tolist()
    assert mended(straight(), mapped(z, accelerometer=False)).repairs == []


@pytest.mark.parametrize("which", ["recorded", "turning", "straight"])
def test_units_of_forces(which: str, request: pytest.FixtureRequest) -> None:
    logs = {"turning": turning, "straight": straight}.get(which, lambda: request.getfixturevalue("drive"))()
    refused(logs, forces(lambda f: f / 9.80665), ConfigError, r"force of (1|0\.9).*seems to be in g")
    refused(logs, forces(lambda f: f * 0.01), ConfigError, "velocity increments")
    refused(logs, forces(lambda f: f - f.mean(axis=0)), ConfigError, "gravity")


def test_units_of_rates(drive: Logs) -> None:
    for logs in (drive, turning(), straight()):
        refused(logs, rates(np.degrees), ConfigError, "degrees")
    for logs in (drive, turning()):
        refused(logs, rates(lambda r: r * 0.01), ConfigError, "yaw rate .*increments")
        refused(logs, rates(np.radians), ConfigError, "yaw rate of the IMU is 0.017")


@pytest.mark.parametrize(
    ("seconds", "says"),
    [
        (WEEK_S, r"differ by \+1 GPS weeks"),
        (-1024 * WEEK_S, "differ by -1024 GPS weeks"),
        (86_400.0, r"\+1 days"),
        (-3600.0, "-1 hours"),
        (GPS_EPOCH_UNIX_S, "Unix time"),
    ],
)
def test_logs_that_do_not_overlap(seconds: float, says: str) -> None:
    said = refused(turning(), imu_late(seconds), TimeSystemError, says)
    assert "2026-05-04T09:29:43" in said


@pytest.mark.parametrize("seconds", [0.5, -0.5, 1.0, -5.0, 18.0, -18.0])
def test_lag_between_imu_and_gnss_is_named(drive: Logs, seconds: float) -> None:
    for logs in (drive, turning()):
        said = refused(logs, imu_late(seconds), TimeSystemError, "later" if seconds > 0 else "earlier")
        assert float(said.split("feels the motion ")[1].split(" s ")[0]) == pytest.approx(abs(seconds), abs=0.15)
        assert ("leap seconds" in said) == (abs(seconds) == 18.0)


def test_logs_of_different_drives(drive: Logs) -> None:
    """The recorded drive's IMU log, played from its end."""

    def reversed_log(i, g, o):
        rate, force = i.angular_rate_rad_per_s[::-1], i.specific_force_m_per_s2[::-1]
        return ImuReadings(i.epochs_gps_ns, rate.copy(), force.copy()), g, o

    refused(drive, reversed_log, NavigationError, r"not those of the GNSS path .*correlation -?0\.[01]")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: geodetic_from_world(WORLD, p), "longitude and latitude in degrees"),
        (lambda p: np.radians(geodetic_from_world(WORLD, p)), "radians"),
        (lambda p: p / 1e3, "in km"),
        (lambda p: p * 1e3, "in mm"),
        (lambda p: p / 0.3048, "in feet"),
        (lambda p: p * [0.0, 0, 0] + [691_000.0, 5_335_000.0, 560.0], "easting, northing and height"),
    ],
)
def test_positions_in_another_frame_or_unit(change: Callable[[np.ndarray], np.ndarray], says: str) -> None:
    said = refused(turning(), positions(change), CrsError, says)
    assert "record 0 (2026-05-04T09:29:43.4" in said


def test_mirrored_positions_without_velocities(drive: Logs) -> None:
    """x and y exchanged still lie on the Earth; the path turns the other way round than the IMU."""
    for logs in (drive, turning()):
        bare = (logs[0], replace(logs[1], velocity_ned_m_per_s=logs[1].velocity_ned_m_per_s * np.nan), *logs[2:])
        refused(bare, positions(lambda p: p[:, [1, 0, 2]]), ConfigError, "is felt by the")


def test_velocities_in_another_unit_or_frame(drive: Logs) -> None:
    for logs in (drive, turning()):
        refused(logs, velocities(lambda v: v * 3.6), ConfigError, "probably velocities are in km/h")
        refused(logs, velocities(lambda v: v[:, [1, 0, 2]]), ConfigError, "east and north exchanged")
        refused(logs, velocities(lambda v: v * [1, 1, -1]), ConfigError, "vertical velocity counts upwards")


@pytest.mark.parametrize("velocity", [True, False])
def test_leaps_of_positions(drive: Logs, velocity: bool) -> None:
    for logs in (drive, turning(), straight()):
        k = logs[1].epochs_gps_ns.size // 2
        one = logs
        if not velocity:
            one = (logs[0], replace(logs[1], velocity_ned_m_per_s=logs[1].velocity_ned_m_per_s * np.nan), *logs[2:])
        away = positions(lambda p, k=k: put(p, slice(k, k + 3), p[k : k + 3] + 60.0))
        found = mended(one, away)
        assert [r.records.tolist() for r in found.repairs] == [[k, k + 1, k + 2]]
        assert f"record {k} (20" in str(found.repairs[0])
        assert np.flatnonzero(np.isnan(found.gnss.position_world_m[:, 0])).tolist() == [k, k + 1, k + 2]
        refused(one, positions(lambda p, k=k: put(p, slice(k, None), p[k:] + 60.0)), NavigationError, f"record {k} ")


def test_receiver_that_repeats_a_position(drive: Logs) -> None:
    for logs in (drive, straight()):
        speed = np.linalg.norm(logs[1].velocity_ned_m_per_s, axis=1)
        k = int(np.flatnonzero(np.convolve(speed > 8.0, np.ones(12), "valid") == 12)[0])
        found = mended(logs, positions(lambda p, k=k: put(p, slice(k, k + 12), p[k])))
        assert [r.records.tolist() for r in found.repairs] == [list(range(k + 1, k + 12))]
        assert "repeat a position while the antenna moves" in str(found.repairs[0])


def test_odometer() -> None:
    for logs in (turning(), straight()):
        n = logs[2].epochs_gps_ns.size  # type: ignore[union-attr]
        refused(logs, distances(lambda d: d * 1e3), NavigationError, "faster than 100 m/s, .* at record")
        refused(logs, distances(lambda d: d / (2 * np.pi)), ConfigError, "radius instead of circumference")
        refused(logs, distances(lambda d: d * 3.6), ConfigError, r"counts 3\.\d+ times .*km/h")
        refused(logs, distances(lambda d, n=n: put(d, slice(n // 3, None), d[n // 3])), NavigationError, "stands still")
        down = mended(logs, distances(lambda d: -d))
        assert "counts downwards" in str(down.repairs[0])
        assert np.array_equal(down.odometer.distance_m, logs[2].distance_m)  # type: ignore[union-attr]
        anew = mended(logs, distances(lambda d, n=n: put(d, slice(n // 2, None), d[n // 2 :] - 1e4)))
        assert [r.records.tolist() for r in anew.repairs] == [[n // 2]]
        assert anew.odometer.distance_m == pytest.approx(logs[2].distance_m, abs=0.02)  # type: ignore[union-attr]
        late = lambda i, g, o: (i, g, replace(o, epochs_gps_ns=o.epochs_gps_ns + 3 * NS_PER_S))  # noqa: E731
        refused(logs, late, TimeSystemError, "odometer feels the drive 3.0 s later")


def test_odometer_that_hangs_is_left_out_there() -> None:
    logs = straight()
    epochs, way = logs[2].epochs_gps_ns, logs[2].distance_m  # type: ignore[union-attr]
    k = int(np.searchsorted(way, 180.0))
    found = mended(logs, distances(lambda d: put(d, slice(k, k + 150), d[k])))
    assert "stand still while the vehicle drives; they were left out" in str(found.repairs[-1])
    # What is left are speeds, none of them within the three seconds.
    assert np.isnan(found.odometer.distance_m).all()  # type: ignore[union-attr]
    when, speed = found.odometer.epochs_gps_ns, found.odometer.speed_m_per_s  # type: ignore[union-attr]
    assert not ((when > epochs[k]) & (when < epochs[k + 149])).any()
    assert speed == pytest.approx(np.interp(when, epochs, np.gradient(way, 0.02)), abs=0.15)


def test_no_numbers_and_gaps(drive: Logs) -> None:
    for logs in (drive, turning(), straight()):
        found = mended(logs, rates(lambda r: put(r, slice(1000, 1004), np.nan)))
        assert [r.records.tolist() for r in found.repairs] == [[1000, 1001, 1002, 1003], [999]]
        assert found.imu.epochs_gps_ns.size == logs[0].epochs_gps_ns.size - 4
        assert np.isfinite(found.imu.angular_rate_rad_per_s).all()
        refused(logs, rates(lambda r: r * np.nan), NavigationError, "no finite numbers, first record 0 ")
        # Gaps stay: a straight line over them would hide from the smoother that nothing was measured.
        for lost, seconds in ((5, 0.06), (300, 3.01)):
            gap = mended(logs, imu_rows(lambda n, lost=lost: np.r_[0:1000, 1000 + lost : n]))
            assert [r.records.tolist() for r in gap.repairs] == [[999]]
            assert float(str(gap.repairs[0]).split("gaps of up to ")[1].split(" s;")[0]) == pytest.approx(
                seconds, abs=0.01
            )
            assert gap.imu.epochs_gps_ns.size == logs[0].epochs_gps_ns.size - lost
        lossy = imu_rows(lambda n: np.flatnonzero(np.arange(n) % 20 > 2))
        refused(logs, lossy, NavigationError, r"samples are missing .*the first follows record 16 \(")


def test_order_and_repeated_epochs(drive: Logs) -> None:
    for logs in (drive, turning(), straight()):
        late = np.r_[0:500, 503, 500:503]
        found = mended(logs, imu_rows(lambda n, late=late: np.r_[late, 504:n]))
        assert [r.records.tolist() for r in found.repairs] == [[501, 502, 503]]
        assert "were sorted" in str(found.repairs[0])
        assert np.array_equal(found.imu.specific_force_m_per_s2, logs[0].specific_force_m_per_s2)
        twice = mended(logs, imu_rows(lambda n: np.sort(np.r_[0:n, 500, 700, 700])))
        assert [r.records.tolist() for r in twice.repairs] == [[501, 702, 703]]
        assert np.array_equal(twice.imu.epochs_gps_ns, logs[0].epochs_gps_ns)
        shuffled = mended(logs, imu_rows(lambda n: np.random.default_rng(1).permutation(n)))
        assert np.array_equal(shuffled.imu.angular_rate_rad_per_s, logs[0].angular_rate_rad_per_s)


@pytest.mark.parametrize("count", [3, 400])
def test_contradicting_epochs(drive: Logs, count: int) -> None:
    def change(i, g, o):
        epochs = i.epochs_gps_ns.copy()
        epochs[100 : 100 + 2 * count : 2] = epochs[101 : 101 + 2 * count : 2]
        return replace(i, epochs_gps_ns=epochs), g, o

    for logs in (drive, turning()):
        if count > 3:
            refused(logs, change, TimeSystemError, "share their epoch with a record of other values, first record 100 ")
            continue
        found = mended(logs, change)
        assert found.repairs[0].records.tolist() == list(range(100, 106))
        assert "all were dropped" in str(found.repairs[0])


@pytest.mark.parametrize("back_ns", [2_005_000_000, 2_000_000_000])
def test_clock_that_steps_back(drive: Logs, back_ns: int) -> None:
    def change(i, g, o):
        half = i.epochs_gps_ns.size // 2
        epochs = i.epochs_gps_ns.copy()
        epochs[half:] -= back_ns
        return replace(i, epochs_gps_ns=epochs), g, o

    for logs in (drive, turning(), straight()):
        k = logs[0].epochs_gps_ns.size // 2
        refused(logs, change, TimeSystemError, rf"steps back by (1\.99|2\.0).*record {k}\b")


def test_solutions_out_of_order_and_in_halves() -> None:
    imu, gnss, odometer, vehicle = turning()
    rows = np.r_[0:50, 51, 50, 52:300, 299, 300 : gnss.epochs_gps_ns.size]
    position, covariance = gnss.position_world_m[rows].copy(), gnss.covariance_ned_m2[rows].copy()
    position[10, 1], covariance[20] = np.nan, -np.eye(3)
    spoilt = GnssSolutions(
        WORLD, gnss.epochs_gps_ns[rows], position, covariance, gnss.quality[rows], gnss.velocity_ned_m_per_s[rows],
        gnss.sigma_velocity_ned_m_per_s[rows],
    )  # fmt: skip
    found = prepared(imu, spoilt, odometer, vehicle)
    assert [r.records.tolist() for r in found.repairs] == [[51], [300], [10], [20]]
    assert np.isnan(found.gnss.position_world_m[10]).all()
    assert np.isnan(found.gnss.covariance_ned_m2[20]).all()
    assert np.array_equal(found.gnss.epochs_gps_ns, gnss.epochs_gps_ns)


def test_saturated_and_stuck_sensors(drive: Logs) -> None:
    for logs in (drive, turning(), straight()):
        n = logs[0].epochs_gps_ns.size
        few = mended(logs, forces(lambda f, n=n: put(f, (slice(n // 2, n // 2 + 4), 2), 39.2266)))
        assert few.repairs[0].records.tolist() == list(range(n // 2, n // 2 + 4))
        many = forces(lambda f, n=n: put(f, (slice(n // 2, n // 2 + 30), 2), 39.2266))
        refused(logs, many, NavigationError, f"accelerometer z stands at the end of its scale.* record {n // 2} ")
        speed = np.linalg.norm(logs[1].velocity_ned_m_per_s, axis=1)
        k = int(np.searchsorted(logs[0].epochs_gps_ns, logs[1].epochs_gps_ns[np.flatnonzero(speed > 5.0)[0]])) + 100
        hangs = rates(lambda r, k=k: put(r, slice(k, k + 500), r[k]))
        refused(logs, hangs, NavigationError, f"gyroscope x shows .* s while the vehicle drives, from record {k} ")


def test_imu_that_turns_while_the_antenna_stands() -> None:
    imu, gnss, _, vehicle = turning()
    still = replace(
        gnss,
        position_world_m=np.tile(gnss.position_world_m[0], (gnss.epochs_gps_ns.size, 1)),
        velocity_ned_m_per_s=np.zeros_like(gnss.velocity_ned_m_per_s),
    )
    with pytest.raises(NavigationError, match=r"turns by .*° while the GNSS antenna stands still"):
        prepared(imu, still, None, vehicle)


def test_logs_without_content() -> None:
    imu, gnss, _, vehicle = turning()
    none = replace(gnss, position_world_m=gnss.position_world_m * np.nan)
    with pytest.raises(NavigationError, match=r"none of \d+ GNSS solutions has a position"):
        prepared(imu, none, None, vehicle)
    empty = ImuReadings(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(NavigationError, match="the IMU log is empty"):
        prepared(empty, gnss, None, vehicle)


def outcome(logs: Logs, change: Change) -> list[str]:
    imu, gnss, odometer, _ = mended(logs, change)
    return check_outcome(solve(imu, gnss, odometer, logs[3], SmootherConfig()), gnss, logs[3])


@pytest.mark.parametrize("axes", [[[-1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
                                  [[0, 1, 0], [1, 0, 0], [0, 0, 1]]])  # fmt: skip
def test_horizontal_gyroscopes_of_a_calm_vehicle_show_in_the_result(axes: list[list[float]]) -> None:
    """Nothing tells beforehand; the trajectory would be off by a metre, and is refused for it."""
    with pytest.raises(NavigationError, match=r"the measurements contradict the trajectory.*record"):
        outcome(turning(), mapped(axes, accelerometer=False))


def test_accelerometer_across_an_even_straight_drive_is_doubted() -> None:
    across = mapped(np.diag([1.0, -1, 1]).tolist(), gyro=False)
    assert "measurements of several kinds disagree" in outcome(straight(), across)[0]


def test_results_of_good_logs_are_not_doubted(drive: Logs) -> None:
    outage = {"gaps": [{"start_s": 5.0, "duration_s": 10.0}], "jumps_per_minute": 10.0}
    for logs in (drive, turning(), straight(), simulated(route=TURNS, gnss=outage)):
        assert outcome(logs, same) == []
