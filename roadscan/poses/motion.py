"""Checks the poses of a log against each other: heading and course, pitch and slope, constant values, speed scale.

A vehicle drives along its body's forward axis. So its heading is the course over ground where it drives straight, its
pitch follows the slope of its path, and the velocities that a log states are the change of its positions. A real
instrument never gives one value for long. The path between poses that are far apart is less certain than their σ: the
additional error is estimated by leaving poses out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of, scatter_about
from roadscan.core.crs import LOCAL_WORLD, geodetic_from_world
from roadscan.core.frames import rotation_from_quaternion, rph_from_rotation
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.leaps import PoseTrack
from roadscan.poses.trajectory import Trajectory, world_from_ned

ANGLES: Final = ("roll", "pitch", "heading")
VALUES: Final = ("height", *ANGLES)
"""Values that must change while a vehicle drives."""

_WINDOW_M: Final = 5.0
"""Distance over which course and slope are taken: two wheelbases."""
_LEAST_SPEED_M_PER_S: Final = 2.0
"""Below this speed, noise of the positions is a large part of the distance."""
_STRAIGHT_RAD: Final = float(np.radians(2.0))
"""A window that turns by less is straight: a point 4 m before the rear axle then moves aside by less than 1.6°."""
_LEAST_WINDOWS: Final = 8
"""With fewer windows nothing is reported."""
_LEAST_TOLD: Final = 0.25
"""Sine of half the angle (29°) between two axes that can be distinguished by how they rise."""
_LEAST_SLOPES: Final = 15
"""With fewer windows nothing is reported about pitch: over 70 m, heights of a drifting fix rise and fall once."""
_SIGMAS: Final = 3.0  # Multiples of σ by which a difference has to exceed a limit before it is reported.
_LEAST_OFF_RAD: Final = float(np.radians(2.0))
"""A unit is mounted along a vehicle to a degree, and a vehicle on a crossfall drifts by half of one."""
_LEAST_SLOPE_RAD: Final = 0.003
"""Slopes have to vary by so much (1 σ) before pitch can follow them."""
_SLOPE_NOISE_TIMES: Final = 2.0
"""And by this multiple of the slopes' noise, which then lowers the apparent response of pitch by at most a fifth."""
_LEAST_FOLLOWED: Final = 0.5
"""Pitch that follows a smaller share of the slope is wrong; a soft suspension loses a tenth."""
_SAME_M: Final = 1e-7
"""Heights that differ by less count as equal: a conversion by way of geocentric coordinates leaves this much."""
_SAME_RAD: Final = 1e-9  # Angles that differ by less (rad) count as equal.
_LEAST_SAME: Final = 20
"""Least number of equal poses in a row that is reported, where other values of the log are not rounded."""
_SAME_WAY_M: Final = 5.0  # A run of equal values is reported if the vehicle drives farther (m) in it.
_ROUNDED: Final = 0.05
"""Where a larger share of the other neighbours is equal, the values are rounded."""
_ALL_SAME_WAY_M: Final = 50.0
"""A log with one value throughout is reported if it drives farther."""
_HARD_M_PER_S2: Final = 12.0
"""Greatest acceleration of a vehicle: more than the tyres of a car transmit (1.2 g)."""
_FROZEN_M: Final = 0.5
"""The leap after frozen poses is longer than this: coarse positions repeat as well."""
_EVEN_SHARE: Final = 0.05
"""The way since the first frozen pose is that of the mean speed to this share, apart from braking."""
_LEAST_SCALE: Final = 0.003
"""Least reported error of scale: in a good log, speeds and changes of position agree to a thousandth over a drive."""
_LEAST_STEP_M: Final = 0.25
"""Where poses are closer than this, interpolation errs by less than a millimetre."""
_LEAST_LEFT_OUT: Final = 3
"""With fewer left-out places no error is estimated."""
_DOUBTED: Final = 0.02
"""Velocities whose scale is off by more are not used for the path between poses."""
_BEYOND: Final = 0.02
"""Share of the largest errors that is left out: a step is no error of interpolation."""
_ORDERS: Final = (4.0, 256.0)
"""Growth of the squared error where the spacing of poses doubles: at least linear, at most fourth order."""


class _Windows(NamedTuple):
    """Windows along the way; each array has shape (k,)."""

    way_m: Float64
    speed_m_per_s: Float64
    acceleration_m_per_s2: Float64
    off_rad: Float64
    """Heading minus course."""
    turn_rad: Float64
    """How far the heading turns."""
    slope_rad: Float64
    down_forward: Float64
    """Downward component of the body's forward axis."""
    down_right: Float64
    """Downward component of the body's right axis."""


class HeadingOff(NamedTuple):
    """A heading that differs from the course over ground."""

    off_rad: float
    """Median of heading minus course, clockwise."""
    scatter_rad: float
    """1 σ of a single window about the median."""
    way_m: float
    """Straight way on which it is compared."""
    is_mounted: bool | None
    """True where the axis that points along the way rises with the slope, and so is mounted turned; False where the
    forward axis does, and the angle alone is wrong; None where neither shows."""


class PitchOff(NamedTuple):
    """A pitch that does not follow the slope of the path."""

    followed: float
    """Change of pitch per change of slope: 1 for a sound log."""
    sigma: float
    roll_followed: float
    """Change of roll per change of slope; 0 where roll does not follow it."""
    slope_rad: float
    """1 σ of the slopes."""
    way_m: float


class Same(NamedTuple):
    """A value that does not change while the vehicle drives."""

    value: str
    """One of `VALUES`."""
    poses: int
    way_m: float
    first_gps_ns: int
    last_gps_ns: int
    """Last epoch of the longest run."""
    everywhere: bool


class Scale(NamedTuple):
    """Stated speeds that contradict the change of the positions."""

    ratio: float
    """Way of the positions along the stated velocities over the way of the velocities; infinite where these are 0."""
    way_m: float


class Between(NamedTuple):
    """Error of the interpolated path between poses."""

    error_m: Float64
    """(2,) 1 σ in the middle between two poses: horizontal, vertical."""
    sigma_m: float
    """Median of the stated σ of all three axes together; 0 where none is stated."""
    step_s: float
    """Usual time between poses."""


@dataclass
class PoseMotion:
    """Collects evidence from blocks of a log's poses, which are given in order of time."""

    world: str
    _windows: list[_Windows] = field(default_factory=list)
    _ways: list[tuple[float, float, float]] = field(default_factory=list)
    """Way of positions along the stated velocities, way of the velocities, and way of the positions."""
    _runs: dict[str, list[tuple[int, float, int, int]]] = field(default_factory=lambda: {name: [] for name in VALUES})
    """Poses, way, first and last epoch of each run of equal values."""
    _alike: dict[str, list[int]] = field(default_factory=lambda: {name: [0, 0] for name in VALUES})
    """Number of equal neighbours outside such runs, and of all neighbours."""
    _ends: dict[str, list[float]] = field(default_factory=lambda: {name: [np.inf, -np.inf] for name in VALUES})
    """Least and largest value."""
    _way_m: float = 0.0
    _span: list[int] = field(default_factory=list)
    _poses: int = 0
    _between: list[Between] = field(default_factory=list)

    def take(self, track: PoseTrack) -> None:
        """Add a block of poses."""
        if track.epochs_gps_ns.size < 3:
            return
        axes = world_from_ned(self.world, track.position_world_m)
        level_from_body = np.transpose(axes, (0, 2, 1)) @ rotation_from_quaternion(track.quaternion)
        elapsed = np.diff(track.epochs_gps_ns) / NS_PER_S
        steps = np.diff(track.position_world_m, axis=0)
        links = np.linalg.norm(steps, axis=1)
        links = np.where(links > _LEAST_SPEED_M_PER_S * elapsed, links, 0.0)  # standing still adds no way
        way = np.concatenate([[0.0], np.cumsum(links)])
        self._way_m += float(way[-1])
        self._poses += track.epochs_gps_ns.size
        self._span += [int(track.epochs_gps_ns[0]), int(track.epochs_gps_ns[-1])]
        self._same(track, level_from_body, way)
        if (windows := _windows(track, axes, level_from_body, way)) is not None:
            self._windows.append(windows)
        if track.velocity_world_m_per_s is not None:
            self._ways.append(_ways(track.velocity_world_m_per_s, steps, links, elapsed))
        if (between := _between(track, self.world, axes, links)) is not None:
            self._between.append(between)

    def heading(self) -> HeadingOff | None:
        """Return how the heading differs from the course; None where it agrees, or where the log cannot show it."""
        rows = self._rows()
        rows = _Windows(*(each[np.abs(rows.turn_rad) < _STRAIGHT_RAD] for each in rows))
        if rows.off_rad.size < _LEAST_WINDOWS:
            return None
        middle, scatter = _middle(rows.off_rad)
        doubt = _SIGMAS * scatter / np.sqrt(rows.off_rad.size)
        if abs(middle) < _LEAST_OFF_RAD + doubt:
            return None
        return HeadingOff(middle, scatter, float(rows.way_m.sum()), self._is_mounted(middle))

    def pitch(self) -> PitchOff | None:
        """Return how the pitch differs from the slope; None where it agrees, or where the log cannot show it."""
        rows = self._rows()
        if rows.slope_rad.size < _LEAST_SLOPES:
            return None
        if (varies := _varies(rows)) is None:
            return None
        course, _ = _middle(rows.off_rad)
        along, beside = (_risen(rows, -turn) for turn in (0.0, course))
        if any(followed + _SIGMAS * sigma > _LEAST_FOLLOWED for followed, sigma in (along, beside)):
            return None
        other, other_sigma = _risen(rows, np.pi / 2.0)
        is_roll = abs(other) - _SIGMAS * other_sigma > _LEAST_FOLLOWED
        return PitchOff(*along, other if is_roll else 0.0, varies, float(rows.way_m.sum()))

    def _is_mounted(self, off_rad: float) -> bool | None:
        """See :attr:`HeadingOff.is_mounted`."""
        rows = self._rows()
        if rows.slope_rad.size < _LEAST_SLOPES or _varies(rows) is None or abs(np.sin(off_rad / 2.0)) < _LEAST_TOLD:
            return None
        follows = [
            one - _SIGMAS * sigma > _LEAST_FOLLOWED for one, sigma in (_risen(rows, 0.0), _risen(rows, -off_rad))
        ]
        return None if follows[0] == follows[1] else follows[1]

    def same(self) -> list[Same]:
        """Return the values that do not change while the vehicle drives."""
        found = list[Same]()
        for name in VALUES:
            tolerance = _SAME_M if name == "height" else _SAME_RAD
            low, high = self._ends[name]
            if self._poses >= _LEAST_SAME and high - low < tolerance and self._way_m > _ALL_SAME_WAY_M:
                found.append(Same(name, self._poses, self._way_m, min(self._span), max(self._span), True))
                continue
            runs, (alike, neighbours) = self._runs[name], self._alike[name]
            if runs and neighbours >= _LEAST_SAME and alike <= _ROUNDED * neighbours:
                longest = max(runs, key=lambda run: run[1])
                poses, way = sum(run[0] for run in runs), sum(run[1] for run in runs)
                found.append(Same(name, poses, way, longest[2], longest[3], False))
        return found

    def scale(self) -> Scale | None:
        """Return the stated speeds' scale where it contradicts the change of the positions."""
        along, stated, way = (sum(one[k] for one in self._ways) for k in range(3))
        if way < _ALL_SAME_WAY_M or abs(stated - along) < _LEAST_SCALE * way:
            return None
        return Scale(along / stated if stated > 0 else np.inf, way)

    def between(self) -> Between | None:
        """Return the error between poses, from the block where it is largest."""
        return max(self._between, key=lambda one: float(np.max(one.error_m)), default=None)

    def _rows(self) -> _Windows:
        if not self._windows:
            return _Windows(*[np.zeros(0)] * len(_Windows._fields))
        return _Windows(*(np.concatenate(each) for each in zip(*self._windows, strict=True)))

    def _same(self, track: PoseTrack, level_from_body: Float64, way: Float64) -> None:
        """Return the runs of equal values in a block."""
        height = track.position_world_m[:, 2]
        if self.world != LOCAL_WORLD:
            height = geodetic_from_world(self.world, track.position_world_m)[:, 2]
        values = (height, *rph_from_rotation(level_from_body))
        for name, own in zip(VALUES, values, strict=True):
            self._ends[name][:] = [min(self._ends[name][0], own.min()), max(self._ends[name][1], own.max())]
            alike = np.abs(np.diff(own)) < (_SAME_M if name == "height" else _SAME_RAD)
            inside = np.zeros(alike.size, bool)
            for first, last in runs_of(alike).tolist():
                along = float(way[last] - way[first])
                if last - first + 1 >= _LEAST_SAME and along > _SAME_WAY_M:
                    inside[first:last] = True
                    span = int(track.epochs_gps_ns[first]), int(track.epochs_gps_ns[last])
                    self._runs[name].append((last - first + 1, along, *span))
            moves = np.diff(way) > 0
            self._alike[name][0] += int((alike & ~inside & moves).sum())
            self._alike[name][1] += int((~inside & moves).sum())


def frozen(track: PoseTrack) -> Bool:
    """(n,) poses that repeat the one before them to the bit, and after which the next lies where driving on leads.

    Position and attitude repeat, the vehicle drives before or after, and what it would have to leap from the last of
    them it drives in the time since the first.
    """
    epochs, position = track.epochs_gps_ns, track.position_world_m
    out = np.zeros(epochs.size, bool)
    repeats = (np.diff(position, axis=0) == 0).all(axis=1) & (np.diff(track.quaternion, axis=0) == 0).all(axis=1)
    for first, last in runs_of(repeats).tolist():
        if first < 1 or last + 2 >= epochs.size:
            continue
        after_s, before_s = ((epochs[b] - epochs[a]) / NS_PER_S for a, b in ((last + 1, last + 2), (first - 1, first)))
        after = float(np.linalg.norm(position[last + 2] - position[last + 1])) / after_s
        before = float(np.linalg.norm(position[first] - position[first - 1])) / before_s
        link_s, whole_s = ((epochs[last + 1] - epochs[k]) / NS_PER_S for k in (last, first))
        leap = float(np.linalg.norm(position[last + 1] - position[last]))
        explained = after * link_s + 0.5 * _HARD_M_PER_S2 * link_s**2 + _FROZEN_M
        even = 0.5 * (before + after) * whole_s
        if leap > explained and abs(leap - even) < _HARD_M_PER_S2 * whole_s**2 / 4.0 + _EVEN_SHARE * even + _FROZEN_M:
            out[first + 1 : last + 1] = True
    return out


def _ways(velocity: Float64, steps: Float64, links: Float64, elapsed_s: Float64) -> tuple[float, float, float]:
    """Return ways: of the positions along the stated velocities where stated, of the velocities, of the positions.

    Noise lengthens the way of the positions, and not what lies along the velocities.
    """
    mean = 0.5 * (velocity[:-1] + velocity[1:])
    speed = np.linalg.norm(mean, axis=1)
    usual = (links > 0) & np.isfinite(speed) & (elapsed_s < 2.5 * np.median(elapsed_s))
    along = np.einsum("ki,ki->k", steps, mean)[usual] / np.maximum(speed[usual], 1e-9)
    return float(along.sum()), float((speed * elapsed_s)[usual].sum()), float(links[usual].sum())


def _middle(angles: Float64) -> tuple[float, float]:
    """Return the circular median of angles, and the scatter about it (1.4826 MAD), rad."""
    centre = float(np.angle(np.mean(np.exp(1j * angles))))
    away = np.angle(np.exp(1j * (angles - centre)))
    middle = float(np.median(away))
    return float(np.angle(np.exp(1j * (centre + middle)))), scatter_about(away, middle)


def _windows(track: PoseTrack, axes: Float64, level_from_body: Float64, way: Float64) -> _Windows | None:
    """Return course, slope and attitude over windows of `_WINDOW_M`, or over one link where poses are farther apart."""
    at = np.flatnonzero(np.diff(np.floor(way / _WINDOW_M), prepend=-1.0) > 0)
    if at.size < 4:
        return None
    a, b = at[:-1], at[1:]
    count = (b - a + 1).astype(np.float64)
    sums = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(level_from_body, axis=0)])
    mean = (sums[b + 1] - sums[a]) / count[:, None, None]
    chord = np.einsum("kij,ki->kj", axes[a], track.position_world_m[b] - track.position_world_m[a])
    across = np.hypot(chord[:, 0], chord[:, 1])
    elapsed = (track.epochs_gps_ns[b] - track.epochs_gps_ns[a]) / NS_PER_S
    speed = np.linalg.norm(chord, axis=1) / elapsed
    acceleration = np.gradient(speed) / np.maximum(np.gradient(np.cumsum(elapsed)), 1e-3)
    heading = np.arctan2(mean[:, 1, 0], mean[:, 0, 0])
    turns = [np.arctan2(level_from_body[k, 1, 0], level_from_body[k, 0, 0]) for k in (a, b)]
    course = np.arctan2(chord[:, 1], chord[:, 0])
    sound = (speed > _LEAST_SPEED_M_PER_S) & (across > 0.5 * _WINDOW_M) & (elapsed < 2.0 * _WINDOW_M)
    found = _Windows(
        way[b] - way[a], speed, acceleration, np.angle(np.exp(1j * (heading - course))),
        np.angle(np.exp(1j * (turns[1] - turns[0]))), np.arctan2(-chord[:, 2], across),
        mean[:, 2, 0], mean[:, 2, 1],
    )  # fmt: skip
    return _Windows(*(each[sound] for each in found))


def _varies(rows: _Windows) -> float | None:
    """Return 1 σ of the slopes; None where they vary too little, or are noise."""
    spread = float(np.std(rows.slope_rad))
    noise = scatter_about(np.diff(rows.slope_rad), 0.0) / np.sqrt(6.0)
    return spread if spread > max(_LEAST_SLOPE_RAD, _SLOPE_NOISE_TIMES * noise) else None


def _risen(rows: _Windows, turn_rad: float) -> tuple[float, float]:
    """Return how much a body axis, turned to the right of the forward one, rises with the slope; and its σ."""
    down = np.cos(turn_rad) * rows.down_forward + np.sin(turn_rad) * rows.down_right
    return _followed(-np.arcsin(np.clip(down, -1.0, 1.0)), rows)


def _followed(angle: Float64, rows: _Windows) -> tuple[float, float]:
    """Return the change of an angle per change of slope, and its σ, with the effect of braking removed."""
    parts = np.column_stack([np.ones(angle.size), rows.slope_rad, rows.acceleration_m_per_s2])
    inverse = np.linalg.pinv(parts.T @ parts)
    solved = inverse @ (parts.T @ angle)
    rest = angle - parts @ solved
    scores = parts * rest[:, None]
    spread = scores.T @ scores
    for k in range(1, 5):  # errors of neighbouring windows are correlated (Newey and West)
        both = scores[k:].T @ scores[:-k]
        spread += (1.0 - k / 5.0) * (both + both.T)
    covariance = inverse @ spread @ inverse
    return float(solved[1]), float(np.sqrt(max(covariance[1, 1], 0.0)))


def _between(track: PoseTrack, world: str, axes: Float64, links: Float64) -> Between | None:
    """Return the error of the path between poses; None where they are close, or too few."""
    epochs = track.epochs_gps_ns
    elapsed = np.diff(epochs)
    step_ns = float(np.median(elapsed))
    if not (links > 0).any() or float(np.median(links[links > 0])) < _LEAST_STEP_M:
        return None
    squares = _against_velocities(track, world, axes, links, step_ns)
    if squares is None:
        squares = _against_left_out(track, world, axes, links, step_ns)
    return None if squares is None else Between(np.sqrt(squares), float(np.median(track.sigma_m)), step_ns / NS_PER_S)


def _against_velocities(track: PoseTrack, world: str, axes: Float64, links: Float64, step_ns: float) -> Float64 | None:
    """Return squared errors (2,) at the middle of links, against a cubic through the stated velocities at both ends."""
    velocity = track.velocity_world_m_per_s
    elapsed = np.diff(track.epochs_gps_ns)
    if velocity is None:
        return None
    own = np.flatnonzero(
        (links > 0) & (elapsed < 1.5 * step_ns) & np.isfinite(velocity[:-1] + velocity[1:]).all(axis=1)
    )
    speed = np.linalg.norm(velocity[own] + velocity[own + 1], axis=1) / 2.0
    if own.size < _LEAST_LEFT_OUT or abs(float(np.sum(speed * elapsed[own] / NS_PER_S - links[own]))) > (
        _DOUBTED * float(np.sum(links[own]))
    ):
        return None
    middle = track.epochs_gps_ns[own] + elapsed[own] // 2
    seconds = elapsed[own, None] / NS_PER_S
    position = track.position_world_m
    true = 0.5 * (position[own] + position[own + 1]) + seconds / 8.0 * (velocity[own] - velocity[own + 1])
    return _squares(_placed(track, world, slice(None), step_ns, middle) - true, axes[own])


def _against_left_out(track: PoseTrack, world: str, axes: Float64, links: Float64, step_ns: float) -> Float64 | None:
    """Return squared errors (2,) between poses, from poses left out at two, four and eight times the spacing.

    Noise of the poses is the same at all three; what grows is interpolation.
    """
    size = track.epochs_gps_ns.size
    found = list[Float64]()
    for apart in (2, 4, 8):
        asked = np.arange(apart + apart // 2, size - 2 * apart, apart)
        asked = asked[links[asked] > 0]
        placed = _placed(track, world, slice(None, None, apart), apart * step_ns, track.epochs_gps_ns[asked])
        if (squares := _squares(placed - track.position_world_m[asked], axes[asked])) is not None:
            found.append(squares)
    if len(found) < 2:
        return None
    near = np.maximum(found[1] - found[0], 0.0)
    grows = found[1] / np.maximum(found[0], _SAME_M**2)  # noise is subtracted
    if len(found) > 2:
        grows = np.maximum(grows, (found[2] - found[1]) / np.maximum(near, _SAME_M**2))
    grows = np.clip(grows, *_ORDERS)
    return np.asarray(np.minimum(near / (grows - 1.0), found[0]) / grows)


def _placed(track: PoseTrack, world: str, rows: slice, step_ns: float, epochs: Int64) -> Float64:
    """Interpolate positions (k, 3) at epochs from the poses of some rows."""
    each = (track.epochs_gps_ns[rows], track.position_world_m[rows], track.quaternion[rows])
    return Trajectory.of(world, *each, max_gap_s=1.5 * step_ns / NS_PER_S).poses(epochs).position_world_m


def _squares(away: Float64, axes: Float64) -> Float64 | None:
    """Return mean squares (2,), horizontal and vertical, of errors (k, 3) less the largest; None for too few."""
    level = np.einsum("kij,ki->kj", axes, away)
    level = level[np.isfinite(level).all(axis=1)]
    if len(level) < _LEAST_LEFT_OUT:
        return None
    both = np.column_stack([np.sum(level[:, :2] ** 2, axis=1), level[:, 2] ** 2])
    kept = int(np.ceil(len(both) * (1.0 - _BEYOND)))
    return np.asarray(np.sort(both, axis=0)[:kept].mean(axis=0))
