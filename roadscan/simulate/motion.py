"""The vehicle's progress: driven length as a function of time, with changes of speed, stops and standstill.

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

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.simulate.scene import PassScene, Vehicle

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
