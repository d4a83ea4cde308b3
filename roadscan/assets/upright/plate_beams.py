"""Beams at the plane of a plate: those that it stopped, and those that passed.

A sign stands free, so that lines of sight pass beside, above and below it and end far behind. The front of a house, a
window in it and the rear of a van go on beside what looks like a plate, or something lies close behind it. Lines show
that without any class of what stands there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from roadscan.assets.kernels.sight import Rays, rays_at_plates, rays_near
from roadscan.assets.scene import LINES_M, Scene, once_a_scene
from roadscan.assets.upright.brightness import brightness
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.kernel_options import read_only

_LEAST_COSINE: Final = 0.3
"""Least cosine between a beam and the normal: grazing beams show poorly where they meet the plane."""
_SWEEP: Final = 100
"""Number of firings of a laser without a return from the plate after which the next one belongs to another sweep."""
_AROUND: Final = 40
"""Number of returns before and after a sweep that are used."""
_ABOUT_M: Final = 0.6
"""Beams that pass farther from the returns (m) are left out."""
_BEHIND_M: Final = 0.15
"""Returns this far behind the plane (m) passed it."""
_LEAST_OF_LINE, _STRAIGHT_M = 4, 0.04
"""Lines of so many returns are looked at; they are straight within this standard deviation (m)."""
_WIDE: Final = 0.035
"""What lies beside a plate within this share of its distance is kept: one and a half firings of slow scanners (rad)."""
_AT_ONCE: Final = 2.0  # Lasers fire together that fire within this number of firings of a laser.
_OF_A_FIRING: Final = 2
"""A laser has this many returns of one stamp at the most where stamps are those of firings."""
_LEAST_LIGHT: Final = 0.05
"""Plates are at least so bright, as a multiple of upright things."""
_LEAST_GAP: Final = 1e-4
"""Lasers nearer to one another (rad) draw the same line."""
_SIGHT_LIMITS: Final = (0.08, 1.0, 0.08, 0.5, 0.2)
"""Lines end in the plane within the first distance of it; what they find beyond the second is nothing of the plate, for
a wall, a box or a van is nearer; strips around a plate lie between the next two distances from its outline (m); lines
whose cosine to the normal is less than the last show poorly where they meet the plane."""
_LEAST_LINES: Final = 6
"""Fewer lines at a strip tell nothing."""


class Beams(NamedTuple):
    """Beams on the plane of a plate: to the right as seen from the front, and up, from a point of it (m)."""

    hits: Float64
    """(n, 2)"""
    line: Int64
    """(n,) number of the line that one laser drew in one sweep, ascending."""
    passed: Float64
    """(m, 2)"""
    hit_spot: Spots
    passed_spot: Spots
    lit: Float64
    """(m,) light that came back from behind the plane as a share of the plate's, less with the square of the distance;
    0 where nothing did."""


class Spots(NamedTuple):
    """Spots of beams on a plane, ellipses about the places where their middles meet it."""

    half_m: Float64
    """(n,) half the width of each beam (m); NaN where it is not known."""
    slope: Float64
    """(n, 2) tangents of the angles between a beam and the plane's normal, to the right and up."""

    def reach(self, ways: Float64) -> Float64:
        """Returns how far the spots reach (n, k) in some directions (k, 2) of the plane (m); 0 where not known."""
        out = np.nan_to_num(self.half_m)[:, None] * np.sqrt(1.0 + (self.slope @ ways.T) ** 2)
        return np.asarray(out)


class _Fan(NamedTuple):
    """The k returns near a plate, ordered by sweep, laser and epoch."""

    rows: Int64
    sensor: Float64
    """(k, 3)"""
    way: Float64
    """(k, 3) unit vectors of the beams."""
    range_m: Float64
    half_rad: Float64
    """Half the angle of the beams."""
    on: Bool
    """Mask of those on the plane."""
    sweep: Int64
    laser: Int64
    line: Int64
    """Number of sweep and laser."""
    step: Float64
    """When a beam was sent, in firings of a laser."""
    late: Float64
    """Time from the middle of the longest line of its sweep, in firings of a laser."""
    across: Float64
    """(sweeps, 3) unit vectors across the longest lines, and across the beams."""
    lasers: Int64
    """(l,) lasers that answered, ascending."""
    answered: Bool
    """(sweeps, l) where a laser answered during the sweep."""


def beams_of(scene: Scene, edge: Int64, rows: Int64, middle: Float64, axes: tuple[Float64, Float64]) -> Beams | None:
    """Returns beams that meet the plane of a plate near it; None where lasers draw no lines on it.

    Returns from behind the plane passed it. Without a return, two kinds of beams are known from their neighbours:
    those of the firings next to a line on the plate, and those of the lasers next to the outermost lines.

    Parameters
    ----------
    edge : rows of the returns that tell the outline. rows : of all that lie on the plane, ascending.
    middle : a point of the plane. axes : unit vectors to the right and up.
    """
    normal = np.cross(*axes)
    fan = _fan(scene, rows, normal)
    if fan is None:
        return None

    plane = np.column_stack(axes)

    def met(sensor: Float64, way: Float64, half_rad: Float64) -> tuple[Float64, Float64, Spots]:
        """Returns where beams meet the plane (n, 2), the distance from the sensor, and spots; NaN for grazing ones."""
        rate = way @ normal
        rate = np.where(np.abs(rate) > _LEAST_COSINE, rate, np.nan)
        away = ((middle - sensor) @ normal) / rate
        spots = Spots(np.abs(away) * np.tan(half_rad), (way @ plane) / rate[:, None])
        return (sensor + away[:, None] * way - middle) @ plane, away, spots

    at, away, spots = met(fan.sensor, fan.way, fan.half_rad)
    hit = fan.on & np.isin(fan.rows, edge)
    if not hit.any() or not _are_lines(at[hit], fan.line[hit]):
        return None
    single = scene.returns.number_of_returns[fan.rows] == 1
    behind = ~fan.on & single & (away > 0.0) & (fan.range_m > away + _BEHIND_M)
    void = [met(*_beside_lines(fan)), met(*_beside_lasers(fan))]
    passed = np.concatenate([at[behind], *(v[0] for v in void)])
    beside = Spots._make(np.concatenate([own[behind], *(v[2][k] for v in void)]) for k, own in enumerate(spots))
    light = brightness(scene)[fan.rows].astype(np.float64)
    lit = np.zeros(len(passed))
    farther = (away[behind] / fan.range_m[behind]) ** 2
    lit[: np.count_nonzero(behind)] = farther * light[behind] / max(float(np.median(light[hit])), _LEAST_LIGHT)
    low, high = at[hit].min(axis=0) - _ABOUT_M, at[hit].max(axis=0) + _ABOUT_M
    near = ((passed > low) & (passed < high)).all(axis=1)
    return Beams(at[hit], fan.line[hit], passed[near], Spots._make(v[hit] for v in spots),
                 Spots._make(v[near] for v in beside), lit[near])  # fmt: skip


def _are_lines(at: Float64, line: Int64) -> bool:
    """Returns whether most lines are straight: the returns of a reader without laser numbers are not sorted in any."""
    bent = []
    for own in np.split(at, np.flatnonzero(np.diff(line)) + 1):
        if len(own) >= _LEAST_OF_LINE:
            _, spread, _ = np.linalg.svd(own - own.mean(axis=0), full_matrices=False)
            bent.append(float(spread[1]) / math.sqrt(len(own)) > _STRAIGHT_M)
    return not bent or float(np.mean(bent)) < 0.5


def _fan(scene: Scene, rows: Int64, normal: Float64) -> _Fan | None:
    """Returns the returns of the sweeps over a plate, from rows on its plane that do not graze it."""
    returns = scene.returns

    def beam(rows: Int64) -> tuple[Float64, Float64, Float64]:
        sensor = np.column_stack([returns.sensor_x_m[rows], returns.sensor_y_m[rows], returns.sensor_height_m[rows]])
        way = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]]) - sensor
        length = np.sqrt((way**2).sum(axis=1))
        return sensor, way / np.where(length > 0.0, length, np.nan)[:, None], length  # a null return has no direction

    rows = rows[np.abs(beam(rows)[1] @ normal) > _LEAST_COSINE]
    order = _order_of(scene, rows)
    if order is None:
        return None
    laser = returns.laser[rows].astype(np.int64)
    first, last = rows[_longest_lines(np.cumsum(order.starts) - 1, laser, order.moments(rows))].T
    about, sweep, answered = _around(scene, rows, order, (first, last))
    laser, moment = returns.laser[about].astype(np.int64), order.moments(about)
    sorted_ = np.lexsort((moment, laser, sweep))
    about, sweep, laser, moment = about[sorted_], sweep[sorted_], laser[sorted_], moment[sorted_]
    line = np.cumsum(np.append(0, (np.diff(sweep) != 0) | (np.diff(laser) != 0)))
    begun, ended = beam(first)[1], beam(last)[1]
    across = np.cross(begun + ended, ended - begun)
    length = np.sqrt((across**2).sum(axis=1))
    across /= np.where(length > 0.0, length, np.nan)[:, None]
    middle = (order.moments(first) + order.moments(last)) / 2.0
    lasers = np.flatnonzero(answered.any(axis=0))
    return _Fan(
        about, *beam(about), returns.half_beam_rad(about), np.isin(about, rows), sweep, laser, line,
        moment / order.period, np.abs(moment - middle[sweep]) / order.period, across, lasers, answered[:, lasers],
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Order:
    """The order of the beams over a plate: by time, or along the scan lines where a sweep has one stamp."""

    scene: Scene
    begin: int
    """First of the rows on the plate."""
    starts: Bool
    """Mask of the rows with which a sweep begins."""
    timed: bool
    period: float = math.nan
    """From a firing of a laser to its next one (ns, or rad as seen from the sensor)."""

    def moments(self, rows: Int64) -> Float64:
        """Returns when beams were sent (n,), from the first on the plate (ns), or how far right of it they go (rad)."""
        r = self.scene.returns
        if self.timed:
            return np.asarray(r.epoch_gps_ns[rows] - r.epoch_gps_ns[self.begin], np.float64)
        east, north = r.x_m[rows] - r.sensor_x_m[rows], r.y_m[rows] - r.sensor_y_m[rows]
        x, y = (own[self.begin] - at[self.begin] for own, at in ((r.x_m, r.sensor_x_m), (r.y_m, r.sensor_y_m)))
        return np.asarray(np.arctan2(east * y - north * x, east * x + north * y))


@once_a_scene
def _ends_of_stamps(scene: Scene) -> Int64:
    """Returns the last row (k,) of each run of rows with one stamp, ascending."""
    epochs = scene.returns.epoch_gps_ns
    return np.flatnonzero(np.diff(epochs, append=epochs[-1:] + 1))


def _order_of(scene: Scene, rows: Int64) -> _Order | None:
    """Returns the order of the beams to some rows; None where no laser met two of them in one sweep."""
    if not rows.size:
        return None
    returns, ends = scene.returns, _ends_of_stamps(scene)
    epoch, laser = returns.epoch_gps_ns[rows], returns.laser[rows].astype(np.int64)
    device = returns.pass_id[rows].astype(np.int64) * 256 + returns.sensor[rows]
    run = np.searchsorted(ends, rows)
    together = ends[run] - np.where(run > 0, ends[run - 1], -1)
    timed = bool(np.median(together) <= _OF_A_FIRING * (1 + int(returns.laser.max())))
    begun, later = np.diff(device, prepend=-1) != 0, np.abs(np.diff(epoch, prepend=epoch[:1]))
    order = _Order(scene, int(rows[0]), begun | (later > 0), timed)
    sweep = device if timed else np.cumsum(order.starts)
    moment = order.moments(rows)
    by_laser = np.lexsort((moment, laser, sweep))
    same = (np.diff(sweep[by_laser]) == 0) & (np.diff(laser[by_laser]) == 0)
    apart = np.diff(moment[by_laser])[same]
    if not (apart > 0).any():
        return None
    period = float(np.quantile(apart[apart > 0], 0.1))
    return replace(order, starts=begun | (later > (_SWEEP * period if timed else 0)), period=period)


def _longest_lines(sweep: Int64, laser: Int64, moment: Float64) -> Int64:
    """Returns the first and the last (sweeps, 2) of the returns that the busiest laser of each sweep has on a plate."""
    order = np.lexsort((moment, laser, sweep))
    starts = np.flatnonzero(np.append(True, (np.diff(sweep[order]) != 0) | (np.diff(laser[order]) != 0)))
    ends = np.append(starts[1:], order.size) - 1
    longest = np.lexsort((starts - ends, sweep[order[starts]]))
    longest = longest[np.append(True, np.diff(sweep[order[starts[longest]]]) != 0)]
    return np.column_stack([order[starts[longest]], order[ends[longest]]])


def _around(
    scene: Scene, rows: Int64, order: _Order, longest: tuple[Int64, Int64]
) -> tuple[Int64, Int64, Bool]:  # fmt: skip
    """Returns rows (k,) near a plate or of its longest lines, their sweeps, and which lasers answered (sweeps, lasers).

    longest : the first and the last return (sweeps,) of the longest line of each sweep.
    """
    returns = scene.returns
    starts = np.flatnonzero(order.starts)
    first, last = rows[starts], rows[np.append(starts[1:], rows.size) - 1]
    if order.timed:
        first, last = np.maximum(first - _AROUND, 0), np.minimum(last + _AROUND, len(returns) - 1)
    else:  # the rows of a sweep have the order of their places: it is looked at as a whole
        ends = _ends_of_stamps(scene)
        sweep = np.searchsorted(ends, first)
        first, last = np.append(-1, ends)[sweep] + 1, ends[sweep]
    spans = np.column_stack([first, last])
    middles = returns.epoch_gps_ns[longest[0]] + np.diff(returns.epoch_gps_ns[np.array(longest)], axis=0)[0] // 2
    late_ns = _AT_ONCE * order.period if order.timed else 0.0
    places = np.column_stack([returns.x_m[rows], returns.y_m[rows], returns.height_m[rows]])
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
    reach_m = 0.5 * float(np.linalg.norm(np.ptp(places, axis=0))) + 2.0 * _ABOUT_M
    rays = Rays(returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m,
                returns.x_m, returns.y_m, returns.height_m)  # fmt: skip
    about, sweep = (np.empty(int((last - first + 1).sum()), np.int64) for _ in range(2))
    answered = np.zeros((len(spans), int(returns.laser.max()) + 1), np.bool_)
    count = rays_near(
        rays, returns.epoch_gps_ns, returns.laser, spans, middle, reach_m, _WIDE, middles, late_ns, about, sweep,
        answered,
    )  # fmt: skip
    return about[:count], sweep[:count], answered


def _beside_lines(fan: _Fan) -> tuple[Float64, Float64, Float64]:
    """Returns sensor, direction (n, 3), half the angle (n,) of firings without a return beside lines on the plate."""
    on = np.flatnonzero(fan.on)
    starts = np.flatnonzero(np.append(True, np.diff(fan.line[on]) != 0))
    sensor, way, half = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for ends, inwards in ((starts, 1), (np.append(starts[1:], on.size) - 1, -1)):
        long = np.append(starts[1:], on.size) - starts > 1
        end, inner = on[ends[long]], on[ends[long] + inwards]
        outer = np.clip(end - inwards, 0, fan.line.size - 1)
        answered = (fan.line[outer] == fan.line[end]) & (np.abs(fan.step[outer] - fan.step[end]) < 1.5)
        end, inner = end[~answered], inner[~answered]
        steps = np.maximum(np.abs(fan.step[end] - fan.step[inner]), 0.5)
        sensor.append(fan.sensor[end])
        way.append(fan.way[end] + (fan.way[end] - fan.way[inner]) / steps[:, None])
        half.append(fan.half_rad[end])
    return np.concatenate(sensor), np.concatenate(way), np.concatenate(half)


def _beside_lasers(fan: _Fan) -> tuple[Float64, Float64, Float64]:
    """Sensor, direction (n, 3) and half the angle (n,) of lasers next to the outermost ones, where they saw nothing.

    The angles between lasers are those of sweeps in which both saw something, on the plate or elsewhere.
    """
    laser, on = np.searchsorted(fan.lasers, fan.laser), np.flatnonzero(fan.on)
    near = np.lexsort((fan.late, fan.line))
    near = near[np.append(True, np.diff(fan.line[near]) != 0)]
    near = near[fan.late[near] < _AT_ONCE]
    angle = np.full(fan.answered.shape, np.nan)
    angle[fan.sweep[near], laser[near]] = np.arcsin((fan.way[near] * fan.across[fan.sweep[near]]).sum(axis=1))
    between = angle[:, None, :] - angle[:, :, None]
    known = np.isfinite(between)
    gaps = np.where(known, between, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    met = np.zeros(angle.shape, np.bool_)
    met[fan.sweep[on], laser[on]] = True
    sweeps = np.arange(len(angle))
    sensor, way, half = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for side in (1.0, -1.0):
        outermost = np.where(met & np.isfinite(angle), side * angle, -np.inf).argmax(axis=1)
        apart = np.where(side * gaps > _LEAST_GAP, side * gaps, np.inf)[outermost]
        following = apart.argmin(axis=1)
        gap = apart[sweeps, following]
        void = np.isfinite(gap) & ~fan.answered[sweeps, following] & np.isfinite(angle[sweeps, outermost])
        line = on[void[fan.sweep[on]] & (laser[on] == outermost[fan.sweep[on]])]
        axis, turn = fan.across[fan.sweep[line]], gap[fan.sweep[line]][:, None]
        aside = axis - (fan.way[line] * axis).sum(axis=1)[:, None] * fan.way[line]
        aside *= side / np.sqrt((aside**2).sum(axis=1))[:, None]
        sensor.append(fan.sensor[line])
        way.append(np.cos(turn) * fan.way[line] + np.sin(turn) * aside)
        half.append(fan.half_rad[line])
    return np.concatenate(sensor), np.concatenate(way), np.concatenate(half)


def sight_at(scene: Scene, plates: Float64) -> dict[str, Float64]:
    """Returns features (p,) of the sight lines at plates (p, 11), as the kernel has them; NaN where too few tell it.

    `passed` is the share of the lines at the plate's middle third that end far behind the plane. `open_top` and
    `open_below` are those of the lines above and below, `open_less` the smaller one of both sides and `open_more` the
    greater one. `backed` is the share of the lines about the plate, and at it, that end close behind the plane, `level`
    that of the lines about it that end in the plane.
    """
    returns = scene.returns
    ends = returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m, returns.x_m, returns.y_m, returns.height_m
    counts = np.zeros((len(plates), 6, 3), np.int64)
    for lines in (ends, scene.beyond_m):
        rays_at_plates(Rays(*map(read_only, lines)), plates, LINES_M, _SIGHT_LIMITS, counts)
    left, right, top, below, passed = (_share(counts[:, k], 2) for k in range(1, 6))
    return {
        "passed": passed, "open_more": np.fmax(left, right), "open_less": np.minimum(left, right),
        "open_top": top, "open_below": below,
        "backed": _share(counts[:, :5].sum(axis=1), 1), "level": _share(counts[:, 1:5].sum(axis=1), 0),
    }  # fmt: skip


def _share(some: Int64, which: int) -> Float64:
    """Returns the share (n,) of one sort of lines (n, 3); NaN of too few."""
    every = some.sum(axis=1)
    return np.where(every >= _LEAST_LINES, some[:, which] / np.maximum(every, 1), np.nan)
