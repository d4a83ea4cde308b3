"""Beams at the plane of a plate: those that it stopped, and those that passed."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.scene import Scene

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

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
_LEAST_GAP: Final = 1e-4
"""Lasers nearer to one another (rad) draw the same line."""


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
    """(m,) intensity of what a passing beam met behind the plane as a share of the plate's; 0 where it met nothing."""


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
    """Returns (k,) about a plate, by sweep, laser and epoch."""

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
    """Epoch, in firings of a laser."""


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
    light = scene.returns.intensity[fan.rows].astype(np.float64)
    lit = np.zeros(len(passed))
    lit[: np.count_nonzero(behind)] = light[behind] / max(float(np.median(light[hit])), 1.0)
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
    epoch, laser = returns.epoch_gps_ns[rows], returns.laser[rows].astype(np.int64)
    device = returns.pass_id[rows].astype(np.int64) * 256 + returns.sensor[rows]
    by_laser = np.lexsort((epoch, laser, device))
    same = (np.diff(device[by_laser]) == 0) & (np.diff(laser[by_laser]) == 0)
    apart = np.diff(epoch[by_laser])[same]
    if not (apart > 0).any():
        return None
    period = float(np.quantile(apart[apart > 0], 0.1))
    starts = np.flatnonzero(np.append(True, (np.diff(device) != 0) | (np.abs(np.diff(epoch)) > _SWEEP * period)))
    first = np.maximum(rows[starts] - _AROUND, 0)
    last = np.minimum(rows[np.append(starts[1:], rows.size) - 1] + _AROUND, len(returns) - 1)
    sweep = np.repeat(np.arange(starts.size), last - first + 1)
    about = np.concatenate([np.arange(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True)])
    laser, epoch = returns.laser[about].astype(np.int64), returns.epoch_gps_ns[about]
    order = np.lexsort((epoch, laser, sweep))
    about, sweep, laser = about[order], sweep[order], laser[order]
    line = np.cumsum(np.append(0, (np.diff(sweep) != 0) | (np.diff(laser) != 0)))
    step = (epoch[order] - epoch[order[0]]) / period
    half_rad = returns.half_beam_rad(about)
    return _Fan(about, *beam(about), half_rad, np.isin(about, rows), sweep, laser, line, step)


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
    lasers, laser = np.unique(fan.laser, return_inverse=True)
    on = np.flatnonzero(fan.on)
    starts = np.flatnonzero(np.append(True, np.diff(fan.line[on]) != 0))
    ends = np.append(starts[1:], on.size) - 1
    longest = np.lexsort((starts - ends, fan.sweep[on[starts]]))
    longest = longest[np.append(True, np.diff(fan.sweep[on[starts[longest]]]) != 0)]
    first, last = on[starts[longest]], on[ends[longest]]
    drawn = fan.way[last] - fan.way[first]
    across = np.cross(fan.way[first] + fan.way[last], drawn)
    length = np.sqrt((across**2).sum(axis=1))
    across /= np.where(length > 0.0, length, np.nan)[:, None]
    late = np.abs(fan.step - (fan.step[first] + fan.step[last])[fan.sweep] / 2)
    near = np.lexsort((late, fan.line))
    near = near[np.append(True, np.diff(fan.line[near]) != 0)]
    near = near[late[near] < 2.0]
    angle = np.full((first.size, lasers.size), np.nan)
    angle[fan.sweep[near], laser[near]] = np.arcsin((fan.way[near] * across[fan.sweep[near]]).sum(axis=1))
    between = angle[:, None, :] - angle[:, :, None]
    known = np.isfinite(between)
    gaps = np.where(known, between, 0.0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    met, answered = np.zeros(angle.shape, np.bool_), np.zeros(angle.shape, np.bool_)
    met[fan.sweep[on], laser[on]] = True
    answered[fan.sweep, laser] = True
    sweeps = np.arange(len(angle))
    sensor, way, half = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for side in (1.0, -1.0):
        outermost = np.where(met & np.isfinite(angle), side * angle, -np.inf).argmax(axis=1)
        apart = np.where(side * gaps > _LEAST_GAP, side * gaps, np.inf)[outermost]
        following = apart.argmin(axis=1)
        gap = apart[sweeps, following]
        void = np.isfinite(gap) & ~answered[sweeps, following] & np.isfinite(angle[sweeps, outermost])
        line = on[void[fan.sweep[on]] & (laser[on] == outermost[fan.sweep[on]])]
        axis, turn = across[fan.sweep[line]], gap[fan.sweep[line]][:, None]
        aside = axis - (fan.way[line] * axis).sum(axis=1)[:, None] * fan.way[line]
        aside *= side / np.sqrt((aside**2).sum(axis=1))[:, None]
        sensor.append(fan.sensor[line])
        way.append(np.cos(turn) * fan.way[line] + np.sin(turn) * aside)
        half.append(fan.half_rad[line])
    return np.concatenate(sensor), np.concatenate(way), np.concatenate(half)
