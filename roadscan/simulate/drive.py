"""The vehicle's motion over the road: position and attitude at any time of a pass.

The vehicle's progress: driven length as a function of time, with changes of speed, stops and standstill.

The speed is a *pace*, piecewise polynomial in time, times the driver's wave, a sine of the path: the path length
``driven = way + wave(way)``, where ``way`` is the integral of the pace. The pace keeps limits of acceleration and
jerk: acceleration rises and falls as a smooth step, so the way is three times continuously differentiable.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import PPoly
from scipy.spatial.transform import Rotation

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import NS_PER_S, gps_ns_from_utc
from roadscan.simulate.noise import stream
from roadscan.simulate.path import Earth, Stand, path_of
from roadscan.simulate.scene import Mount, PassScene, Scene, Vehicle
from roadscan.simulate.surface import Surface

RUN_UP_S: Final = 0.6
"""Time driven before the first and after the last profile (s); the trajectory covers it."""
MARGIN_S: Final = 0.25
"""Margin of the motion beyond the recorded span (s), for derivatives and sensors' last turns."""
_WAVE_M: Final = 120.0  # wavelength of the driver's speed variation
_EASE_S: Final = 0.8
"""Time in which the driver reaches the full acceleration (s)."""
_SHORTEST_S: Final = 1e-10  # shorter pieces are left out
_SNAP_M: Final = 1e-9
"""Distance from a stop within which the vehicle has reached it (m)."""


@dataclass(frozen=True)
class _Node:
    """A place with a limited pace, where the vehicle may stand."""

    at_m: float
    """Distance along the way (m)."""
    pace: float
    """Greatest pace there (m/s)."""
    wait_s: float = 0.0


@dataclass(frozen=True)
class _Change:
    """A change of pace within the limits: acceleration eases in, holds, eases out."""

    before: float
    after: float
    ease_s: float
    hold_s: float
    acceleration: float
    """Peak acceleration (m/s²)."""

    @classmethod
    def of(cls, before: float, after: float, limit: float) -> _Change:
        """Return the quickest change with an acceleration up to `limit` and a jerk up to 1.5 limit / _EASE_S."""
        step = abs(after - before)
        ease = _EASE_S if step >= limit * _EASE_S else math.sqrt(step * _EASE_S / limit)
        peak = limit * ease / _EASE_S
        hold = step / peak - ease if step >= limit * _EASE_S else 0.0
        return cls(before, after, ease, hold, math.copysign(peak, after - before))

    @property
    def way_m(self) -> float:
        """Return the distance that it takes: its mean pace is the average of both ends."""
        return (self.before + self.after) / 2 * (2 * self.ease_s + self.hold_s)

    def pieces(self) -> list[tuple[float, list[float]]]:
        """Return durations and coefficients of τ, from τ¹ to τ⁵, of its three parts."""
        a, t = self.acceleration, self.ease_s
        if t == 0.0:
            return []
        late = self.before + a * (t / 2 + self.hold_s)
        bend, twist = a / (4 * t * t), -a / (10 * t**3)
        return [
            (t, [self.before, 0.0, 0.0, bend, twist]),
            (self.hold_s, [self.before + a * t / 2, a / 2, 0.0, 0.0, 0.0]),
            (t, [late, a / 2, 0.0, -bend, -twist]),
        ]


class Motion:
    """Driven length, speed and acceleration as functions of the time since the first profile, and the inverse.

    Parameters
    ----------
    one, vehicle : the pass, and how the vehicle moves.
    number : of the pass, for messages, counted from 0.
    length_m : driven from the first to the last profile.
    phase : of the speed's wave (rad).
    """

    def __init__(self, one: PassScene, vehicle: Vehicle, number: int, length_m: float, phase: float) -> None:
        self._variation, self._phase = vehicle.speed_variation, phase
        self._k = 2 * math.pi / _WAVE_M
        _check(one, number, length_m)
        limit = vehicle.acceleration_m_per_s2
        nodes, caps = self._plan(one, vehicle, length_m)
        times, ways, coefficients = _joined(_reachable(nodes, caps, limit), caps, limit, vehicle.standstill_s)
        self._ways = np.array(ways)
        self._way = PPoly(np.array(coefficients).T, np.array(times))
        zero = float(self._time_at(np.zeros(1))[0])
        self._way.x = self._way.x - zero
        self.duration_s = float(self.time_s(np.array([length_m]))[0])
        """Time from the first to the last profile (s)."""
        standing = vehicle.standstill_s > 0.0
        # The first and the last piece are unlimited; where the vehicle stands they are as long as it does.
        start, end = (self._way.x[0], self._way.x[-1]) if standing else (-RUN_UP_S, self.duration_s + RUN_UP_S)
        self.recorded_span_s = float(start), float(end)
        """First and last recorded time, including standstill (s)."""

    def driven_m(self, time_s: Float64) -> Float64:
        """Return driven length (n,) at times (n,)."""
        return self._driven(self._way(time_s))

    def state(self, time_s: Float64) -> tuple[Float64, Float64, Float64]:
        """Return driven length (m), speed (m/s) and acceleration along the path (m/s²), (n,) each."""
        way, pace, change = (self._way(time_s, nu) for nu in range(3))
        phase = self._k * way + self._phase
        factor = 1.0 + self._variation * np.cos(phase)
        swing = self._variation * self._k * np.sin(phase)
        return self._driven(way), factor * pace, factor * change - swing * pace * pace

    def time_s(self, driven_m: Float64) -> Float64:
        """Return times (n,) at which lengths (n,) are first reached."""
        return self._time_at(self._way_m(driven_m))

    def _driven(self, way_m: Float64) -> Float64:
        wave = np.sin(self._k * way_m + self._phase) - math.sin(self._phase)
        driven: Float64 = way_m + self._variation / self._k * wave
        return driven

    def _way_m(self, driven_m: Float64) -> Float64:
        """Return the inverse of :meth:`_driven`, by Newton's method."""
        way = driven_m
        for _ in range(6):
            way = way - (self._driven(way) - driven_m) / (1.0 + self._variation * np.cos(self._k * way + self._phase))
        return way

    def _time_at(self, way_m: Float64) -> Float64:
        """Return times (n,) at which ways are first reached."""
        piece = np.searchsorted(self._ways[1:-1], way_m - _SNAP_M, side="left")
        coefficients = self._way.c[:, piece]
        ahead, pace = way_m - self._ways[piece], coefficients[4]
        is_even = ~coefficients[:4].any(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            after = np.where(pace > 0.0, ahead / pace, np.where(ahead > 0.0, np.diff(self._way.x)[piece], 0.0))
        curved = np.flatnonzero(~is_even)
        after[curved] = _solved(coefficients[:, curved], np.diff(self._way.x)[piece[curved]], ahead[curved])
        out: Float64 = self._way.x[piece] + after
        return out

    def _plan(self, one: PassScene, vehicle: Vehicle, length_m: float) -> tuple[list[_Node], list[float]]:
        """Return the nodes in the order driven, and the pace between them."""
        first = one.speed_m_per_s or vehicle.speed_m_per_s
        speeds = [first, *(change.speed_m_per_s for change in one.speeds)]
        stops = [_Node(self._of(stop.at_m), 0.0, stop.duration_s) for stop in one.stops]
        changes = [
            _Node(self._of(change.at_m), min(before, after))
            for change, (before, after) in zip(one.speeds, itertools.pairwise(speeds), strict=True)
        ]
        between = sorted([*stops, *changes], key=lambda node: node.at_m)
        caps = [speeds[sum(change.at_m <= node.at_m for change in changes)] for node in between]
        limit, standing = vehicle.acceleration_m_per_s2, vehicle.standstill_s > 0.0

        def lead(pace: float) -> float:
            return pace * RUN_UP_S + (_Change.of(0.0, pace, limit).way_m if standing else pace * MARGIN_S)

        begin = _Node(-lead(first), 0.0 if standing else first)
        end = _Node(self._of(length_m) + lead(speeds[-1]), 0.0 if standing else speeds[-1])
        return [begin, *between, end], [first, *caps]

    def _of(self, driven_m: float) -> float:
        return float(self._way_m(np.array([driven_m]))[0])


def _check(one: PassScene, number: int, length_m: float) -> None:
    listed: list[tuple[str, Iterable[float]]] = [
        ("stops", [stop.at_m for stop in one.stops]),
        ("speeds", [change.at_m for change in one.speeds]),
    ]
    for name, places in listed:
        if any(b <= a for a, b in itertools.pairwise(places)):
            raise ConfigError(f"the {name} of pass {number + 1} are not in the order driven", expected="growing at_m")
        beyond = max(places, default=0.0)
        if beyond > length_m:
            raise ConfigError(
                f"pass {number + 1} has one of its {name} at {beyond:g} m",
                expected=f"at_m up to the {length_m:.2f} m that the pass drives",
            )


def _reachable(nodes: list[_Node], caps: list[float], limit: float) -> list[_Node]:
    """Return the nodes with paces that can be reached from their neighbours within the limits."""
    ways = [b.at_m - a.at_m for a, b in itertools.pairwise(nodes)]
    paces = [node.pace for node in nodes]
    for i in reversed(range(len(ways))):
        paces[i] = min(paces[i], _fastest(paces[i + 1], paces[i], ways[i], limit))
    for i in range(len(ways)):
        paces[i + 1] = min(paces[i + 1], _fastest(paces[i], paces[i + 1], ways[i], limit))
    return [_Node(node.at_m, pace, node.wait_s) for node, pace in zip(nodes, paces, strict=True)]


def _fastest(pace: float, wanted: float, way_m: float, limit: float) -> float:
    """Return the greatest pace up to `wanted` that can be reached from `pace` over a distance."""
    if wanted <= pace:
        return wanted
    return _greatest(lambda w: _Change.of(pace, w, limit).way_m <= way_m, pace, wanted)


def _greatest(fits: Callable[[float], bool], low: float, high: float) -> float:
    """Return the greatest fitting value in [low, high] by bisection: `low` fits, and all below a fitting one."""
    if fits(high):
        return high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _joined(
    nodes: list[_Node], caps: list[float], limit: float, standstill_s: float
) -> tuple[list[float], list[float], list[list[float]]]:
    """Return breaks (m + 1) in time and way, and coefficients (m, 6) of τ⁵ … τ⁰ of the pieces between.

    The first and the last piece are even: the vehicle stands, or drives on at the same pace.
    """
    outside = standstill_s or 1.0
    times, ways = [0.0], [nodes[0].at_m - nodes[0].pace * outside]
    coefficients: list[list[float]] = []

    def add(duration_s: float, powers: list[float]) -> None:
        if duration_s > _SHORTEST_S:
            coefficients.append([*reversed(powers), ways[-1]])
            times.append(times[-1] + duration_s)
            ways.append(ways[-1] + sum(p * duration_s ** (i + 1) for i, p in enumerate(powers)))

    add(outside, [nodes[0].pace, 0.0, 0.0, 0.0, 0.0])
    for (here, there), cap in zip(itertools.pairwise(nodes), caps, strict=True):
        up, down = _leg(here, there, cap, limit)
        for duration, powers in up.pieces():
            add(duration, powers)
        if up.after > 0.0:
            rest = there.at_m - here.at_m - up.way_m - down.way_m
            add(rest / up.after, [up.after, 0.0, 0.0, 0.0, 0.0])
        for duration, powers in down.pieces():
            add(duration, powers)
        ways[-1] = there.at_m
        add(there.wait_s, [0.0] * 5)
    add(outside, [nodes[-1].pace, 0.0, 0.0, 0.0, 0.0])
    return times, ways, coefficients


def _leg(here: _Node, there: _Node, cap: float, limit: float) -> tuple[_Change, _Change]:
    """Return the changes of pace after one node and before the next, to the greatest pace that the distance allows."""
    way = there.at_m - here.at_m

    def changes(pace: float) -> tuple[_Change, _Change]:
        return _Change.of(here.pace, pace, limit), _Change.of(pace, there.pace, limit)

    peak = _greatest(lambda p: sum(c.way_m for c in changes(p)) <= way, max(here.pace, there.pace), cap)
    return changes(peak)


def _solved(coefficients: Float64, longest_s: Float64, ahead_m: Float64) -> Float64:
    """Return τ (n,) from 0 to `longest_s` where growing polynomials (6, n), without constants, reach `ahead_m`.

    Newton's method in a bracket that shrinks; where it leaves the bracket, halving.
    """
    out = np.zeros(ahead_m.size)
    at = np.arange(ahead_m.size)
    c, low, high, goal = coefficients[:5], np.zeros(at.size), longest_s.copy(), ahead_m
    tau = high / 2
    for _ in range(100):
        value = tau * (c[4] + tau * (c[3] + tau * (c[2] + tau * (c[1] + tau * c[0])))) - goal
        slope = c[4] + tau * (2 * c[3] + tau * (3 * c[2] + tau * (4 * c[1] + tau * 5 * c[0])))
        low, high = np.where(value < 0.0, tau, low), np.where(value < 0.0, high, tau)
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = tau - value / slope
        moved = np.where((moved >= low) & (moved <= high), moved, (low + high) / 2)
        out[at] = moved
        going = np.abs(moved - tau) > 1e-14 * longest_s
        if not going.any():
            break
        at, c, low, high, goal = at[going], c[:, going], low[going], high[going], goal[going]
        tau, longest_s = moved[going], longest_s[going]
    return out


_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ = 1.3, 0.9, 1.6, 0.35  # frequencies of the body's motion on its springs
_PITCH_SHARE: Final = 0.7  # amplitude of pitch as a share of that of roll
_YAW_SHARE: Final = 0.3  # amplitude of yaw as a share of that of roll
_CALM_M_PER_S: Final = 1.0
"""Speed (m/s) at which the road moves the springs half as much as at high speed."""


@dataclass(frozen=True)
class Poses:
    """n poses: p_ecef = position + ecef_from_body · p_body (body forward, right, down)."""

    position_ecef_m: Float64
    """(n, 3)"""
    ecef_from_body: Rotation
    """n rotations"""

    def sensor(self, mount: Mount, body_from_axes: Float64) -> tuple[Float64, Float64]:
        """Return the ECEF origin (n, 3) and ecef_from_sensor (n, 3, 3) of a sensor with its true mounting.

        body_from_sensor = R(roll, pitch, heading) · body_from_axes, Z-Y-X.
        """
        angles = [mount.heading_deg, mount.pitch_deg, mount.roll_deg]
        body_from_sensor = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix() @ body_from_axes
        rotation = self.ecef_from_body.as_matrix() @ body_from_sensor
        return self.position_ecef_m + self.ecef_from_body.apply(np.array(mount.lever_arm_body_m)), rotation


class Drive:
    """One pass: path length as a function of time, and the pose there.

    The path follows a lane with the driver's wander, or a route; the body stands on a smooth version of the road (long
    waves, crown and grade) and moves on its springs, which add to roll, pitch and heading of the road under it. Time
    is seconds from the first profile; *driven* is the path's length in the map from there (m).

    Raises
    ------
    ConfigError
        where the path leaves the road, or stops and changes of speed do not fit the pass.
    """

    def __init__(self, scene: Scene, number: int, earth: Earth, ride: Surface) -> None:
        one = scene.passes[number]
        phases = stream(scene.seed, number, "drive").uniform(0, 2 * math.pi, 8)
        path = path_of(scene, number, ride, phases[1:3])
        self.number = number
        self.earth = earth
        self.start_gps_ns = gps_ns_from_utc(scene.start) + round(number * scene.pause_s * NS_PER_S)
        """Epoch of the first profile."""
        self.length_m = path.length_m
        """Path length from the first to the last profile (m)."""
        self._motion = Motion(one, scene.vehicle, number, path.length_m, float(phases[0]))
        self._springs = _Springs(scene.vehicle, phases[3:7])
        self._imu_height_m = scene.vehicle.imu_height_m
        self._sign = -1.0 if one.route is not None and one.route.reverse else 1.0
        first, last = self._motion.recorded_span_s
        self._known_s = first - MARGIN_S, last + MARGIN_S
        begin, end = self._motion.driven_m(np.array(self._known_s))
        self._stand = Stand(path, earth, float(begin), float(end), self._sign)
        self._ecef_from_level = Rotation.from_matrix(self._stand.ecef_from_level)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last profile (s)."""
        return self._motion.duration_s

    @property
    def sign(self) -> float:
        """1 where the body looks along the path, −1 where it drives backwards."""
        return self._sign

    @property
    def recorded_span_gps_ns(self) -> tuple[int, int]:
        """First and last epoch of trajectory, IMU, GNSS and encoder: with run-up, run-out and standstill."""
        first, last = self._motion.recorded_span_s
        return self.start_gps_ns + round(first * NS_PER_S), self.start_gps_ns + round(last * NS_PER_S)

    def epoch_gps_ns(self, driven_m: Float64) -> Int64:
        """Return the epochs (n,) at which path lengths are first reached."""
        return self.start_gps_ns + np.rint(self._motion.time_s(driven_m) * NS_PER_S).astype(np.int64)

    def driven_m(self, epoch_gps_ns: Int64) -> Float64:
        """Return path lengths at epochs (n,): the inverse of :meth:`epoch_gps_ns` where the vehicle moves."""
        return self._motion.driven_m(self._seconds(epoch_gps_ns))

    def station_m(self, epoch_gps_ns: Int64) -> Float64:
        """Return the station of the IMU reference point (n,)."""
        return self._stand.station_m(self.driven_m(epoch_gps_ns))

    def poses(self, epoch_gps_ns: Int64) -> Poses:
        """Return true poses at epochs (n,), up to a quarter of a second outside the recorded span.

        Raises ValueError further outside: what the vehicle does there is not known.
        """
        time_s = self._seconds(epoch_gps_ns)
        if time_s.size and (time_s.min() < self._known_s[0] or time_s.max() > self._known_s[1]):
            raise ValueError(
                f"poses of pass {self.number + 1} are known from {self._known_s[0]:.3f} s to {self._known_s[1]:.3f} s "
                f"after its first profile, not from {time_s.min():.3f} s to {time_s.max():.3f} s"
            )
        driven, speed, acceleration = self._motion.state(time_s)
        north, east, down, heading, pitch, roll, bend = self._stand.at(driven)
        along, aside = self._sign * acceleration, self._sign * speed**2 * bend
        heave, yaw, nod, sway = self._springs.at(time_s, speed, along, aside)
        quaternion, body_down = _attitude(heading + yaw, pitch + nod, roll + sway)
        in_level = np.stack([north, east, down]) - (self._imu_height_m + heave) * body_down
        position = self._stand.origin_ecef_m + in_level.T @ self._stand.ecef_from_level.T
        return Poses(position, Rotation.from_quat((_times(self._ecef_from_level) @ quaternion).T))

    def _seconds(self, epoch_gps_ns: Int64) -> Float64:
        """Return seconds since the first profile (n,)."""
        seconds: Float64 = (epoch_gps_ns - self.start_gps_ns).astype(np.float64) / NS_PER_S
        return seconds


def drives_of(scene: Scene, earth: Earth, ride: Surface) -> list[Drive]:
    """Return all passes of a scene.

    Raises
    ------
    ConfigError
        where a path leaves the road, stops do not fit, or a pass starts before the one before it has ended.
    """
    drives = [Drive(scene, number, earth, ride) for number in range(len(scene.passes))]
    longest = 0.0
    for one, following in itertools.pairwise(drives):
        overlap_s = (one.recorded_span_gps_ns[1] - following.recorded_span_gps_ns[0]) / NS_PER_S + 2 * MARGIN_S
        longest = max(longest, overlap_s)
    if longest > 0.0:
        raise ConfigError(
            f"passes overlap in time: with run-up, run-out, stops and standstill one takes {longest:.1f} s longer "
            f"than pause_s leaves ({scene.pause_s:g} s from start to start)",
            change=f"give pause_s {math.ceil(scene.pause_s + longest)} or more",
        )
    return drives


class _Springs:
    """The body on its suspension: waves that fade at low speed, and lean."""

    def __init__(self, vehicle: Vehicle, phases: Float64) -> None:
        self._waves = list(zip((_HEAVE_HZ, _ROLL_HZ, _PITCH_HZ, _YAW_HZ), phases, strict=True))
        self._heave_m = vehicle.heave_m
        self._sway_rad = math.radians(vehicle.sway_deg)
        self._lean = math.radians(vehicle.lean_deg_per_m_per_s2)

    def at(
        self, time_s: Float64, speed: Float64, along: Float64, aside: Float64
    ) -> tuple[Float64, Float64, Float64, Float64]:
        """Return heave (m, upwards), yaw, pitch and roll (rad), (n,) each.

        speed : (m/s); along, aside : acceleration of the body forward and to its right (m/s²).
        """
        shaken = speed**2 / (speed**2 + _CALM_M_PER_S**2)
        waves = (np.sin(2 * math.pi * hertz * time_s + phase) for hertz, phase in self._waves)
        heave, roll, pitch, yaw = (shaken * wave for wave in waves)
        sway = self._sway_rad
        return (
            self._heave_m * heave,
            _YAW_SHARE * sway * yaw,
            _PITCH_SHARE * sway * pitch + self._lean * along,
            sway * roll - self._lean * aside,
        )


def _attitude(heading: Float64, pitch: Float64, roll: Float64) -> tuple[Float64, Float64]:
    """Return quaternions (4, n: x, y, z, w) of Z-Y-X angles, and the body's down axis (3, n)."""
    sh, ch, sp, cp, sr, cr = (f(a / 2) for a in (heading, pitch, roll) for f in (np.sin, np.cos))
    x, y = sr * cp * ch - cr * sp * sh, cr * sp * ch + sr * cp * sh
    z, w = cr * cp * sh - sr * sp * ch, cr * cp * ch + sr * sp * sh
    return np.stack([x, y, z, w]), np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def _times(rotation: Rotation) -> Float64:
    """Return the matrix (4, 4) that multiplies quaternions (x, y, z, w) by a rotation from the left."""
    x, y, z, w = rotation.as_quat()
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
