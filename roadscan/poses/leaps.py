"""Detects poses that no vehicle can have taken: short leaps away and back, and steps after which the drive continues.

A pose is excluded only if its neighbours, the motion of a vehicle, and the σ that the log states all contradict it. A
link between two poses is compared with the velocities just before and just after it, with a polynomial of degree four
through three poses on each side, and with the integral of the velocities that the log states. A link that contradicts
them by more than a vehicle's acceleration explains is cut, and what lies between two cuts is a segment. The explanation
of least cost determines which segments are the drive: a pose left out costs 1, a step that is accepted costs
`STEP_COST`. So a short burst between two pieces that fit each other is left out, and where two long pieces do not fit,
both stay: nothing shows which of them is right.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import runs_of
from roadscan.core.gpstime import NS_PER_S

FASTEST_M_PER_S: Final = 70.0
"""No survey vehicle is faster (252 km/h)."""
FAR_M: Final = 10.0
"""A position farther beyond the reach of the fastest vehicle than this is a wrong place, not an error of a good fix."""
_FASTEST_TURN_RAD_PER_S: Final = 3.5
"""No survey vehicle turns faster (200°/s)."""
_FAR_RAD: Final = float(np.radians(30.0))
"""An attitude turned farther beyond the reach of the fastest vehicle than this is wrong, not an error of a good one."""
STEP_COST: Final = 20.5
"""Cost of believing one step, in poses left out: a burst at an end has at most 20 poses, one between two pieces 40."""
END_POSES: Final = 5
"""At an end of a piece at most this many poses are left out for a near leap, which could be a real step."""

_ACCELERATION_M_PER_S2: Final = 12.0
"""Greatest acceleration of a vehicle: more than the tyres of a car transmit (1.2 g)."""
_STATED: Final = 0.175
"""Times that acceleration and the squared time of a link: what it moves beyond the mean of the velocities at both ends.
A change in the middle gives 1/8; 1,200 drawn drives that brake with 9.8 m/s², stop, and swerve with 8 m/s² reach
0.169."""
_UNEVEN: Final = 0.42
"""The same beyond a polynomial through three poses on each side, where acceleration comes and goes within the window:
those drives reach 0.398. The time is that of the longest link; links differ by up to `_EVEN_LINKS` times."""
_EVEN_LINKS: Final = 2.0  # Links of a window are compared where the longest is at most this many times the shortest.
_WINDOW: Final = 6
"""Poses in the window of such a polynomial and its step."""
_AGREEING: Final = 0.5
"""What stated velocities contradict is a leap where positions alone show at least this share of it; where they do not,
it is the velocity that is wrong."""
_TURN_RAD_PER_S2: Final = np.array([30.0, 30.0, 10.0])
"""Greatest angular acceleration: roll and pitch over a pothole, heading of a vehicle that swerves."""
_MOST_TURN_RAD: Final = np.radians([10.0, 10.0, 60.0])
"""Greatest turn between two poses beyond a uniform rotation, however far apart they are: roll, pitch, heading."""
_STEEPEST: Final = 0.3
"""Greatest rise or fall of a vehicle per metre of its way, beyond a uniform slope."""
_UNCLEAR_COST: Final = 3.0
"""Cost of a bridge that does not fit far better than what it leaves out, in poses left out."""
_LEAST_LEAP_M: Final = 0.10
"""Least leap of a position: navigation filters shift positions by centimetres when a fix comes in."""
_LEAST_LEAP_RAD: Final = float(np.radians(0.3))
"""Least leap of an attitude."""
_NOISE_TIMES: Final = 8.0
"""A contradiction below this multiple of the median contradiction of neighbouring links is no leap."""
_JITTER_TIMES: Final = 4.0
"""Stamps are wrong by at most this multiple of the median deviation of the time steps from the usual step."""
_IRREGULAR: Final = 0.1
"""Where time steps usually deviate by more than this share, a short one may be a late stamp."""
_SIGMA_TIMES: Final = 3.0
"""A contradiction below this multiple of the stated σ is no leap."""
_NOISE_LINKS: Final = 128
"""Number of links over which one median is taken."""
_GAP_STEPS: Final = 5.0
"""A link longer than this many usual ones, and than `_LEAST_GAP_S`, is a gap: velocities say little about it."""
_LEAST_GAP_S: Final = 1.0  # Shorter links (s) are no gap, however many usual ones they span.
_VELOCITY_LINKS: Final = 3
"""Number of links over which the velocity at the end of a segment is taken."""
_LEAST_STALL_M: Final = 0.5
"""The way across a gap is reported if it is shorter than the least way of a vehicle by at least this."""
_STALL_M_PER_S: Final = 2.0
"""A slower vehicle may have stood still in the gap."""
_MOST_SHARE: Final = 0.25
"""Where more than this share of the poses would be left out, the whole log is like that and none is left out."""
_MOST_SEGMENTS: Final = 1_000
"""More segments than this, with fewer than 50 poses on average, are noise."""
_LOOK_BACK: Final = 44
"""At most this many segments are left out together."""


class PoseTrack(NamedTuple):
    """The poses of a log in order of time."""

    epochs_gps_ns: Int64
    """(n,) strictly ascending."""
    position_world_m: Float64
    """(n, 3)."""
    quaternion: Float64
    """(n, 4) world from body, unit, scalar first."""
    sigma_m: Float64
    """(n,) stated 1 σ of the position; 0 where none is stated."""
    sigma_rad: Float64
    """(n,) stated 1 σ of the attitude; 0 where none is stated."""
    is_local: bool
    """True where z of the world frame points up; else it is geocentric."""
    velocity_world_m_per_s: Float64 | None = None
    """(n, 3) stated velocities, NaN where one is missing; None of a log without any."""

    def of(self, kept: Bool) -> PoseTrack:
        """The poses of a mask (n,)."""
        if kept.all():
            return self
        return PoseTrack(
            self.epochs_gps_ns[kept], self.position_world_m[kept], self.quaternion[kept], self.sigma_m[kept],
            self.sigma_rad[kept], self.is_local,
            None if self.velocity_world_m_per_s is None else self.velocity_world_m_per_s[kept],
        )  # fmt: skip


class Step(NamedTuple):
    """A link after which positions or attitudes continue at another level."""

    before: int
    """Row of the pose before it."""
    after: int
    """Row of the pose after it."""
    shift_m: float
    """Difference between the step of the position and what the velocities around it give."""
    turn_rad: float
    """The same of the attitude."""
    sigma_m: float
    """Stated 1 σ of the positions there, 0 where none is stated."""


class Stall(NamedTuple):
    """A gap in time after which the poses continue where no vehicle can be: the stamps jump, the vehicle does not."""

    after: int
    """Row of the pose after it."""
    gap_s: float
    way_m: float
    """Way across it."""
    least_m: float
    """Least way of a vehicle that brakes and drives off again as hard as it can."""
    speed_m_per_s: float
    """Mean of the speeds before and after."""


@dataclass(frozen=True)
class Leaps:
    """The poses of a track that leap, and the steps and stalls that no vehicle explains."""

    position: Bool
    """(n,) poses to leave out for their position."""
    attitude: Bool
    """(n,) poses to leave out for their attitude alone."""
    shift_m: Float64
    """(n,) by how much the position of such a pose leaps, 0 for the others."""
    turn_rad: Float64
    """(n,) the same of the attitude."""
    steps: tuple[Step, ...]
    """Steps of which nothing shows which side is right; the stated σ excludes them."""
    covered: tuple[Step, ...]
    """Leaps of position that a vehicle excludes and the stated σ does not."""
    stalls: tuple[Stall, ...] = ()
    """Gaps in time that a vehicle excludes."""


def find_leaps(track: PoseTrack) -> Leaps:
    """Return the leaping poses and the steps of a track; nothing for fewer than three poses."""
    n = track.epochs_gps_ns.size
    if n < 3:
        none = np.zeros(n, dtype=bool)
        return Leaps(none, none, np.zeros(n), np.zeros(n), (), ())
    links = _Links.of(track)
    segments = _segments(links, n)
    kept = _kept(links, segments)
    return replace(_leaps(links, segments, kept, n), stalls=tuple(_stalls(links, segments)))


def _stalls(links: _Links, segments: Sequence[_Segment]) -> Iterator[Stall]:
    """Return the gaps whose way is too short for a vehicle to brake from the speed before and to drive off again."""
    for a, b in itertools.pairwise(segments):
        link = a.last
        before, after = (_velocity(links.track, a, at_end=True), _velocity(links.track, b, at_end=False))
        if not links.gap[link] or before is None or after is None:
            continue
        first, last = (float(np.linalg.norm(velocity)) for velocity, _ in (before, after))
        elapsed, track = float(links.elapsed_s[link]), links.track
        slowest = max(first + last - _ACCELERATION_M_PER_S2 * elapsed, 0.0) / 2.0
        least = (first**2 + last**2 - 2.0 * slowest**2) / (2.0 * _ACCELERATION_M_PER_S2)
        way = float(np.linalg.norm(track.position_world_m[b.first] - track.position_world_m[a.last]))
        sigma = float(np.hypot(track.sigma_m[a.last], track.sigma_m[b.first]))
        if way + _SIGMA_TIMES * sigma + _LEAST_STALL_M < least and min(first, last) > _STALL_M_PER_S:
            yield Stall(b.first, elapsed, way, least, (first + last) / 2.0)


def rotation_vectors(before: Float64, after: Float64) -> Float64:
    """Return rotation vectors (k, 3) in rad, body axes, from attitudes (k, 4) to others: the shorter way round."""
    w1, v1 = before[:, :1], before[:, 1:]
    w2, v2 = after[:, :1], after[:, 1:]
    scalar = w1 * w2 + np.sum(v1 * v2, axis=1, keepdims=True)
    vector = w1 * v2 - w2 * v1 - np.cross(v1, v2)
    vector = np.where(scalar < 0, -vector, vector)
    sine = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    turned: Float64 = vector * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0)
    return turned


class _Misfit(NamedTuple):
    """Sizes of the contradictions between links and the motion around them."""

    shift_m: Float64
    """(k,) position."""
    turn_rad: Float64
    """(k,) attitude."""


@dataclass(frozen=True)
class _Links:
    """Links between neighbouring poses, with the contradictions that no vehicle explains."""

    track: PoseTrack
    elapsed_s: Float64
    """(n − 1,)."""
    gap: Bool
    """(n − 1,) longer than velocities reach."""
    far: Bool
    """(n − 1,) farther, or turned by more, than the fastest vehicle comes or turns."""
    leap: _Misfit
    """(n − 1,) size of the leap, 0 where there is none."""
    covered: Bool
    """(n − 1,) leaps of position within the stated σ."""
    noise_m: Float64
    """(n − 1,) usual contradiction of the positions there."""
    noise_rad: Float64
    """(n − 1, 3) usual contradiction of the attitudes there, about body axes."""
    stated: _StatedMotion
    """What the stated velocities say."""

    @classmethod
    def of(cls, track: PoseTrack) -> _Links:
        """Compare each link with the velocities before and after it."""
        elapsed = np.diff(track.epochs_gps_ns) / NS_PER_S
        shift = np.diff(track.position_world_m, axis=0)
        turn = rotation_vectors(track.quaternion[:-1], track.quaternion[1:])
        gap = elapsed > max(_LEAST_GAP_S, _GAP_STEPS * float(np.median(elapsed)))
        length = np.linalg.norm(shift, axis=1)
        far = length > FASTEST_M_PER_S * elapsed + FAR_M
        turned = np.linalg.norm(turn, axis=1) > _FASTEST_TURN_RAD_PER_S * elapsed + _FAR_RAD
        before_m, after_m = _against_neighbours(shift, elapsed, gap)
        before_rad, after_rad = _against_neighbours(turn, elapsed, gap)
        noise_m = _noise(np.linalg.norm(_mean(before_m, after_m), axis=1)[:, None])[:, 0]
        noise_rad = _noise(np.abs(_mean(before_rad, after_rad)))
        both = np.isfinite(before_m[:, 0]) & np.isfinite(after_m[:, 0])
        usual = _medians(elapsed[:, None])[:, 0]
        jitter = _noise(np.abs(elapsed - usual)[:, None])[:, 0]
        late_s = _JITTER_TIMES * jitter
        reach = np.where(jitter > _IRREGULAR * usual, _greatest(elapsed, 1), elapsed)
        late_m = late_s * _slower(shift, elapsed)
        noise_m += late_m / _NOISE_TIMES
        noise_rad += (late_s * _slower(turn, elapsed) / _NOISE_TIMES)[:, None]
        bound_m = _bound_m(reach, both) + _NOISE_TIMES * noise_m
        bound_rad = _bound_rad(reach, both) + _NOISE_TIMES * noise_rad
        up = _up(track)
        leap_m = np.maximum(
            _leap_sizes(before_m, after_m, bound_m[:, None], whole=True),
            _leap_sizes(*_rises(before_m, after_m, up), _slope_bound_m(shift, up) + _NOISE_TIMES * noise_m[:, None]),
        )
        leap_rad = _leap_sizes(before_rad, after_rad, bound_rad)
        uneven = _unevenness(track, elapsed, gap)
        stated = _StatedMotion.of(track, elapsed, gap, late_m)
        leap_m, leap_rad = np.where(gap, 0.0, leap_m), np.where(gap, 0.0, leap_rad)
        leap_m = np.where(far, np.maximum(leap_m, length), leap_m)
        sigma_m, sigma_rad = (np.maximum(s[:-1], s[1:]) for s in (track.sigma_m, track.sigma_rad))
        excluded = leap_m > bound_m + _SIGMA_TIMES * sigma_m
        for size, bound in (
            stated.leaps(shift, uneven, before_m, after_m), _uneven_leaps(uneven, elapsed, late_m, leap_m > 0)
        ):  # fmt: skip
            excluded |= size > bound + _SIGMA_TIMES * sigma_m
            leap_m = np.where(leap_m > 0, leap_m, size)
        covered = (leap_m > 0) & ~excluded & (sigma_m > 0)
        leap_rad = np.where(leap_rad <= _SIGMA_TIMES * sigma_rad, 0.0, leap_rad)
        leap = _Misfit(np.where(covered, 0.0, leap_m), leap_rad)
        sizes = np.where(covered, leap_m, 0.0)
        return cls(track, elapsed, gap, (far & ~covered) | turned, leap, sizes > 0, noise_m, noise_rad, stated)

    @property
    def cut(self) -> Bool:
        """(n − 1,) True for links that no vehicle explains, and for gaps."""
        return (self.leap.shift_m > 0) | (self.leap.turn_rad > 0) | self.gap

    def step(self, before: int, after: int) -> Step:
        """The step between two poses."""
        shift, turn = (float(np.max(values[before:after])) for values in self.leap)
        return Step(before, after, shift, turn, float(max(self.track.sigma_m[before], self.track.sigma_m[after])))


@dataclass(frozen=True)
class _StatedMotion:
    """The motion along each link according to the stated velocities."""

    way_m: Float64
    """(n − 1, 3) integral of the velocities, NaN where there is none."""
    bound_m: Float64
    """(n − 1,) what a change of acceleration and the usual contradiction explain."""

    @classmethod
    def of(cls, track: PoseTrack, elapsed_s: Float64, gap: Bool, late_m: Float64) -> _StatedMotion:
        """Integrate the stated velocities along all links except gaps."""
        velocity = track.velocity_world_m_per_s
        if velocity is None:
            return cls(np.full((elapsed_s.size, 3), np.nan), np.full(elapsed_s.size, np.inf))
        way = np.where(gap[:, None], np.nan, 0.5 * elapsed_s[:, None] * (velocity[:-1] + velocity[1:]))
        away = np.linalg.norm(np.diff(track.position_world_m, axis=0) - way, axis=1)
        known = np.flatnonzero(np.isfinite(away))
        bound = np.full(elapsed_s.size, np.inf)
        if known.size:
            noise = _noise(away[known][:, None])[:, 0]
            physical = _STATED * _ACCELERATION_M_PER_S2 * elapsed_s[known] ** 2
            bound[known] = _LEAST_LEAP_M + np.maximum(physical, _NOISE_TIMES * noise) + late_m[known]
        return cls(way, bound)

    def leaps(self, shift: Float64, uneven: Float64, before: Float64, after: Float64) -> tuple[Float64, Float64]:
        """Sizes (k,) of links that contradict the stated velocities, and of which positions alone show a part; bounds.

        The size of the others is 0.
        """
        away = np.nan_to_num(shift - self.way_m)
        size = np.linalg.norm(away, axis=1)
        seen = np.where(np.isfinite(uneven), uneven, _mean(before, after))
        agreeing = np.einsum("ij,ij->i", seen, away) >= _AGREEING * size**2
        return np.where((size > self.bound_m) & agreeing, size, 0.0), self.bound_m

    def misses(self, inside: slice, shift: Float64) -> tuple[float, float]:
        """Return how far a shift (3,) over links contradicts their velocities, and its bound; inf if there are none."""
        away = float(np.linalg.norm(shift - self.way_m[inside].sum(axis=0)))
        return (away, float(self.bound_m[inside].sum())) if np.isfinite(away) else (np.inf, 0.0)


def _unevenness(track: PoseTrack, elapsed_s: Float64, gap: Bool) -> Float64:
    """Step (k, 3) at each link beside the polynomial of degree four through three poses on each side of it, in m.

    It is the divided difference of order five over its response to a step of 1. NaN where poses are missing, or do not
    follow one another evenly.
    """
    found = np.full((elapsed_s.size, 3), np.nan)
    count = elapsed_s.size + 1 - (_WINDOW - 1)
    if count < 1:
        return found
    t = (track.epochs_gps_ns - track.epochs_gps_ns[0]) / NS_PER_S
    at = t[: count + _WINDOW - 1]
    nodes = [at[i : i + count] for i in range(_WINDOW)]
    scale = (nodes[-1] - nodes[0]) / (_WINDOW - 1)
    weights = [
        1.0 / np.prod([(nodes[i] - nodes[j]) / scale for j in range(_WINDOW) if j != i], axis=0) for i in range(_WINDOW)
    ]
    position = track.position_world_m - np.median(track.position_world_m, axis=0)
    total = sum(weights[i][:, None] * position[i : i + count] for i in range(_WINDOW))
    links = np.lib.stride_tricks.sliding_window_view(elapsed_s, _WINDOW - 1)
    broken = np.lib.stride_tricks.sliding_window_view(gap, _WINDOW - 1).any(axis=1)
    uneven = broken | (links.max(axis=1) > _EVEN_LINKS * links.min(axis=1))
    middle = _WINDOW // 2
    found[middle - 1 : middle - 1 + count] = np.where(uneven[:, None], np.nan, total / sum(weights[middle:])[:, None])
    return found


def _uneven_leaps(
    uneven: Float64, elapsed_s: Float64, late_m: Float64, found: Bool
) -> tuple[Float64, Float64]:  # fmt: skip
    """Sizes (k,) of links that step beside a polynomial through their neighbours, and the bounds of all links.

    A step shows at the two links on each side of it too: so it is the greatest of five, its neighbours are known, and
    none of the five was `found` to leap otherwise. The size of the others is 0.
    """
    size = np.linalg.norm(uneven, axis=1)
    known = np.flatnonzero(np.isfinite(size))
    if not known.size:
        return np.zeros(size.size), np.full(size.size, np.inf)
    longest = _greatest(elapsed_s, 2)
    bound = np.full(size.size, np.inf)
    physical = _UNEVEN * _ACCELERATION_M_PER_S2 * longest[known] ** 2
    noise = _NOISE_TIMES * _noise(size[known][:, None])[:, 0]  # at a low rate it is the motion itself
    bound[known] = _LEAST_LEAP_M + np.maximum(physical, noise) + 2.0 * late_m[known]
    leaps = (size > bound) & (size >= (1.0 - 1e-6) * _greatest(np.nan_to_num(size), 2))
    leaps &= (_greatest(np.isnan(size).astype(float), 1) == 0) & (_greatest(found.astype(float), 2) == 0)
    return np.where(leaps, size, 0.0), bound


def _greatest(values: Float64, beside: int) -> Float64:
    """The greatest (k,) of each value and so many on each side."""
    padded = np.pad(values, beside, mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * beside + 1).max(axis=1))


def _against_neighbours(steps: Float64, elapsed_s: Float64, gap: Bool) -> tuple[Float64, Float64]:
    """Return what links (k, 3) differ by from uniform motion at the velocity before, and after; NaN without one."""
    velocity = np.where(gap[:, None], np.nan, steps / elapsed_s[:, None])
    none = np.full((1, 3), np.nan)
    before = steps - elapsed_s[:, None] * np.concatenate([none, velocity[:-1]])
    after = steps - elapsed_s[:, None] * np.concatenate([velocity[1:], none])
    return before, after


def _mean(before: Float64, after: Float64) -> Float64:
    """Return the mean of both, or the one that exists; 0 where both are missing."""
    total = np.nan_to_num(before) + np.nan_to_num(after)
    count = np.isfinite(before).astype(float) + np.isfinite(after)
    mean: Float64 = total / np.maximum(count, 1.0)
    return mean


def _slower(steps: Float64, elapsed_s: Float64) -> Float64:
    """Return the lower speed (k,) of the links before and after, so that a leap is not measured by itself."""
    speed = np.linalg.norm(steps, axis=1) / elapsed_s
    padded = np.concatenate([[np.inf], speed, [np.inf]])
    slower = np.minimum(padded[:-2], padded[2:])
    return np.where(np.isfinite(slower), slower, 0.0)


def _block_medians(values: Float64) -> Float64:
    """Return the medians (b, c) of values (k, c) for each block of links."""
    whole, rest = divmod(len(values), _NOISE_LINKS)
    medians: Float64 = np.median(values[: len(values) - rest].reshape(whole, _NOISE_LINKS, values.shape[1]), axis=1)
    if not rest:
        return medians
    # A burst would be half of few links.
    last = medians[-1] if whole and rest < _NOISE_LINKS // 2 else np.median(values[-rest:], axis=0)
    return np.concatenate([medians, last[None]])


def _medians(values: Float64) -> Float64:
    """Median (k, c) of values (k, c) about each link."""
    return np.asarray(_block_medians(values)[np.arange(len(values)) // _NOISE_LINKS])


def _noise(contradiction: Float64) -> Float64:
    """Return the usual contradiction (k, c) around each link: the greatest of three neighbouring medians."""
    medians = _block_medians(contradiction)
    wide = np.stack([_greatest(column, 1) for column in medians.T], axis=-1)
    return np.asarray(wide[np.arange(len(contradiction)) // _NOISE_LINKS])


def _bound_m(elapsed_s: Float64, both: Bool) -> Float64:
    """Return the deviation (m) that a vehicle's acceleration explains, with velocities on both sides or on one."""
    return _LEAST_LEAP_M + np.where(both, 0.5, 1.0) * _ACCELERATION_M_PER_S2 * elapsed_s**2


def _bound_rad(elapsed_s: Float64, both: Bool) -> Float64:
    """Return the deviation (k, 3; rad, about body axes) that a vehicle's turning explains."""
    physical = np.where(both, 0.5, 1.0)[:, None] * _TURN_RAD_PER_S2 * elapsed_s[:, None] ** 2
    bound: Float64 = _LEAST_LEAP_RAD + np.minimum(physical, _MOST_TURN_RAD)
    return bound


def _up(track: PoseTrack) -> Float64:
    """Return the unit vector (3,) that points up where the track lies, on a spherical Earth."""
    if track.is_local:
        return np.array([0.0, 0.0, 1.0])
    middle = np.median(track.position_world_m, axis=0)
    return np.asarray(middle / max(float(np.linalg.norm(middle)), 1.0))


def _rises(before: Float64, after: Float64, up: Float64) -> tuple[Float64, Float64]:
    """Vertical part (k, 1) of contradictions."""
    return (before @ up)[:, None], (after @ up)[:, None]


def _slope_bound_m(shift: Float64, up: Float64) -> Float64:
    """Return the rise (k, 1) in m that road slopes explain, from the way of each link and of its neighbours."""
    level = np.linalg.norm(shift - (shift @ up)[:, None] * up, axis=1)
    padded = np.concatenate([level[:1], level, level[-1:]])
    bound: Float64 = _LEAST_LEAP_M + _STEEPEST * (level + 0.5 * (padded[:-2] + padded[2:]))
    return bound[:, None]


def _leap_sizes(before: Float64, after: Float64, bound: Float64, *, whole: bool = False) -> Float64:
    """Sizes (k,) of links that contradict the motion before and after by more than a bound (k, c); 0 of the others.

    Parameters
    ----------
    whole : judge the length of the vectors by a bound (k, 1), instead of each component.
    """

    def beyond(values: Float64) -> Bool:
        if whole:
            over: Bool = np.linalg.norm(values, axis=1) > bound[:, 0]
            return over
        return np.asarray((np.abs(values) > bound).any(axis=1))

    known_before, known_after = np.isfinite(before[:, 0]), np.isfinite(after[:, 0])
    first = np.where(known_before[:, None], before, after)
    second = np.where(known_after[:, None], after, before)
    leaps = (known_before | known_after) & beyond(first) & beyond(second) & beyond(_mean(first, second))
    size = np.minimum(np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1))
    return np.where(leaps, size, 0.0)


class _Segment(NamedTuple):
    """A run of poses that agree with one another."""

    first: int
    last: int

    @property
    def poses(self) -> int:
        """How many."""
        return self.last - self.first + 1


def _segments(links: _Links, n: int) -> list[_Segment]:
    ends = np.flatnonzero(links.cut)
    return [_Segment(f, e) for f, e in zip([0, *(ends + 1).tolist()], [*ends.tolist(), n - 1], strict=True)]


def _kept(links: _Links, segments: Sequence[_Segment]) -> list[int]:
    """Return the numbers of the segments that form the drive: the explanation of least cost."""
    count, poses = len(segments), sum(s.poses for s in segments)
    everything = list(range(count))
    if count == 1 or (count > _MOST_SEGMENTS and count * 50 > poses):
        return everything
    totals = np.cumsum([0, *(s.poses for s in segments)])
    best = np.full(count, np.inf)
    previous = np.full(count, -1)
    for j in everything:
        best[j] = _end_cost(links, segments, 0, j - 1, j)
        for i in range(j - 1, max(j - 2 - _LOOK_BACK, -1), -1):
            cost = best[i] + _cost(links, segments, i, j, int(totals[j] - totals[i + 1]))
            if cost < best[j]:
                best[j], previous[j] = cost, i
    ends = [best[j] + _end_cost(links, segments, j + 1, count - 1, j) for j in everything]
    kept, at = list[int](), int(np.argmin(ends))
    while at >= 0:
        kept.append(at)
        at = int(previous[at])
    lost = poses - sum(segments[k].poses for k in kept)
    return kept[::-1] if lost <= _MOST_SHARE * poses else everything


def _cost(links: _Links, segments: Sequence[_Segment], i: int, j: int, skipped: int) -> float:
    """Return the cost of going from segment i to j without the `skipped` poses between them."""
    a, b = segments[i], segments[j]
    if j == i + 1:
        link = a.last
        is_leap = links.leap.shift_m[link] > 0 or links.leap.turn_rad[link] > 0
        return STEP_COST if is_leap else 0.0
    if 2 * skipped > a.poses + b.poses and skipped > 1:
        return float("inf")
    fits, clearly = _bridge(links, a, b)
    inner = [segments[i + 1].first - 1, segments[j - 1].last]
    hard = all(links.far[link] for link in inner)
    if clearly and skipped < 2 * STEP_COST:
        return float(skipped)
    if fits and hard and skipped < min(a.poses, b.poses):
        return min(float(skipped), 2 * STEP_COST - 0.5)
    near_end = skipped <= END_POSES or (skipped < STEP_COST and any(links.far[link] for link in inner))
    return skipped + (_UNCLEAR_COST if fits else STEP_COST) if near_end else float("inf")


def _end_cost(links: _Links, segments: Sequence[_Segment], first: int, last: int, beside: int) -> float:
    """Return the cost of leaving out segments `first` to `last` at an end of the track, beside the segment `beside`."""
    if first > last:
        return 0.0
    skipped = sum(segments[k].poses for k in range(first, last + 1)) if last - first < _LOOK_BACK else STEP_COST
    link = segments[last].last if last < beside else segments[beside].last
    is_leap = links.leap.shift_m[link] > 0 or links.leap.turn_rad[link] > 0
    if not is_leap or 2 * skipped > segments[beside].poses:
        return float("inf")
    if skipped <= END_POSES or (skipped < STEP_COST and links.far[link]):
        return float(skipped)
    return float("inf")


def _bridge(links: _Links, a: _Segment, b: _Segment) -> tuple[bool, bool]:
    """Return whether a vehicle can go from segment a to b, and whether they fit far better than what lies between."""
    track = links.track
    elapsed = np.array([(track.epochs_gps_ns[b.first] - track.epochs_gps_ns[a.last]) / NS_PER_S])
    shift = track.position_world_m[b.first] - track.position_world_m[a.last]
    turn = rotation_vectors(track.quaternion[a.last][None], track.quaternion[b.first][None])
    if np.linalg.norm(shift) > FASTEST_M_PER_S * elapsed[0] + FAR_M:
        return False, False
    before, after = _velocity(track, a, at_end=True), _velocity(track, b, at_end=False)
    known = [one for one in (before, after) if one is not None]
    if not known or links.gap[a.last : b.first].any():  # velocities say nothing about a gap
        return True, False
    both = np.array([len(known) == 2])
    inside = slice(a.last, b.first)
    wider = 1.0 + float(elapsed[0] / np.median(links.elapsed_s[inside]))
    miss_m = float(np.linalg.norm(shift - elapsed * np.mean([v for v, _ in known], axis=0)))
    miss_rad = np.abs(turn[0] - elapsed * np.mean([w for _, w in known], axis=0))
    sigma_m = float(max(track.sigma_m[a.last], track.sigma_m[b.first]))
    sigma_rad = float(max(track.sigma_rad[a.last], track.sigma_rad[b.first]))
    most_m = float(_bound_m(elapsed, both)[0]) + _NOISE_TIMES * wider * float(links.noise_m[inside].max())
    most_rad = _bound_rad(elapsed, both)[0] + _NOISE_TIMES * wider * links.noise_rad[inside].max(axis=0)
    stated_m, explained_m = links.stated.misses(inside, shift)
    near = miss_m <= most_m + _SIGMA_TIMES * sigma_m or stated_m <= explained_m + _SIGMA_TIMES * sigma_m
    fits = near and bool((miss_rad <= most_rad + _SIGMA_TIMES * sigma_rad).all())
    return fits, fits and _far_better(links, inside, min(miss_m, stated_m), float(np.linalg.norm(miss_rad)))


def _far_better(links: _Links, inside: slice, miss_m: float, miss_rad: float) -> bool:
    """Whether a bridge misses by less than half of what the links at its two ends leap."""
    ends = [inside.start, inside.stop - 1]
    shift, turn = min(links.leap.shift_m[ends]), min(links.leap.turn_rad[ends])
    return bool((shift > 0 and miss_m < 0.5 * shift) or (turn > 0 and miss_rad < 0.5 * turn))


def _velocity(track: PoseTrack, segment: _Segment, *, at_end: bool) -> tuple[Float64, Float64] | None:
    """Return velocity (3,) and turn rate (3,) at an end of a segment; None for a single pose."""
    over = min(_VELOCITY_LINKS, segment.poses - 1)
    if not over:
        return None
    a, b = (segment.last - over, segment.last) if at_end else (segment.first, segment.first + over)
    elapsed = (track.epochs_gps_ns[b] - track.epochs_gps_ns[a]) / NS_PER_S
    turn = rotation_vectors(track.quaternion[a][None], track.quaternion[b][None])[0]
    return (track.position_world_m[b] - track.position_world_m[a]) / elapsed, turn / elapsed


def _leaps(links: _Links, segments: Sequence[_Segment], kept: Sequence[int], n: int) -> Leaps:
    """Return the poses that were left out and the steps that remain."""
    out = np.ones(n, dtype=bool)
    for k in kept:
        out[segments[k].first : segments[k].last + 1] = False
    shift, turn = (_beside_links(values, out) for values in links.leap)
    steps = list[Step]()
    for i, j in itertools.pairwise(kept):
        a, b = segments[i], segments[j]
        link = links.step(a.last, b.first)
        if (j == i + 1 and (link.shift_m > 0 or link.turn_rad > 0)) or (j > i + 1 and not _bridge(links, a, b)[0]):
            steps.append(link)
    moved = shift > 0
    covered = tuple(
        Step(k, k + 1, float(np.linalg.norm(np.diff(links.track.position_world_m[k : k + 2], axis=0))), 0.0,
             float(max(links.track.sigma_m[k], links.track.sigma_m[k + 1])))
        for k in np.flatnonzero(links.covered).tolist()
    )  # fmt: skip
    return Leaps(out & moved, out & ~moved, shift, turn, tuple(steps), covered)


def _beside_links(sizes: Float64, out: Bool) -> Float64:
    """Return the smaller leap (n,) at the two ends of each run of poses that are left out; 0 elsewhere."""
    found = np.zeros(out.size)
    for first, end in runs_of(out).tolist():
        ends = np.array([sizes[k] for k in (first - 1, end - 1) if 0 <= k < sizes.size])
        found[first:end] = ends[ends > 0].min() if (ends > 0).any() else 0.0
    return found
