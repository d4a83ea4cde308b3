"""Compares stamps of a sensor that counts wheel ticks with the distance that the poses travel in the same time.

Both measure one motion, but by different clocks. Where one clock steps, ticks and distance disagree across a single
link, by speed times step. Where one is off as a whole, they disagree wherever the speed changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.gpstime import NS_PER_S
from roadscan.poses.leaps import rotation_vectors

SAMPLES_PER_S: Final = 200
"""Most samples per second that are compared: a link then lasts 5 ms, as in a usual trajectory."""
LEAST_SAMPLES: Final = 200
"""With fewer samples nothing is reported."""
_LEAST_WAY_M: Final = 10.0
"""Over a shorter way nothing is reported."""
_LEAST_SPEED_M_PER_S: Final = 1.0
"""Below this speed, a distance has little information about time."""
_WIDE: Final = 1.5
"""Poses farther apart than this many usual intervals do not show the motion between them."""
_LEAST_JUMP_M: Final = 0.02
"""Least disagreement that is a jump: navigation filters shift by centimetres where a fix comes in."""
_NOISE_TIMES: Final = 12.0
"""Least jump, as a multiple of the usual disagreement there (1.4826 MAD)."""
_WAY_SHARE: Final = 0.03
"""Least jump as a share of the way across a gap: slip, and bends that the poses cut, explain less."""
_QUANTA: Final = 3.0
"""Least jump in ticks: rounding explains less."""
_NEIGHBOURS: Final = 64
"""Links on either side from which the usual disagreement is computed."""
_BESIDE: Final = 4
"""A wheel that slips disagrees over many links, a clock that steps over no more than two; links that lie closer to one
another than this are of one event."""
_LONG_LINK_S: Final = 0.1
"""In a shorter time no vehicle changes its speed by a tenth."""
_WINDOW_S: Final = 0.5
"""Length of the windows over which way and ticks are compared: slip changes slowly and cancels."""
_LEAST_WINDOWS: Final = 12  # Least number of windows.
_LEAST_TURN_RAD: Final = 1e-4
"""Smaller turns a window move a wheel by less than 0.3 mm; on a straight road the level itself turns with the way."""
_FARTHEST_S: Final = 20.0
"""Largest offset that is searched: a larger one leaves readings without poses, or on another road."""
_LAG_STEP_S: Final = 0.05  # Step of the coarse search.
_LEAST_OVERLAP: Final = 0.4
"""Least share of the windows that a shifted clock has in common with the poses."""
_SIGMAS: Final = 5.0  # An offset is proved beyond this many σ.
_LEAST_OFFSET_S: Final = 0.004
"""Least offset that is reported: latched counters and filtered wheels are late by a few milliseconds."""
_ROUNDS: Final = 8  # Most rounds of the refinement.
_EXPLAINS: Final = 4.0
"""Least ratio of the variances that the best small offset and a large offset leave."""


class WheelTicks(NamedTuple):
    """Stamps and counts of one sensor in one run."""

    epochs_gps_ns: Int64
    """(n,) ascending."""
    ticks: Int64
    """(n,)."""


class PoseWay(NamedTuple):
    """Poses of the run."""

    epochs_gps_ns: Int64
    """(m,) strictly ascending."""
    position_world_m: Float64
    """(m, 3)."""
    quaternion: Float64
    """(m, 4) world from body, scalar first."""


@dataclass(frozen=True)
class ClockJump:
    """One link across which ticks and poses disagree."""

    epoch_gps_ns: int
    """Stamp after the link."""
    way_m: float
    """Way of the poses minus that of the ticks."""
    step_s: float
    """Step of the sensor's stamps relative to those of the poses."""
    sigma_s: float


@dataclass(frozen=True)
class ClockOffset:
    """A constant offset of a clock."""

    offset_s: float
    """The sensor's stamps minus those of the poses for the same motion."""
    sigma_s: float


@dataclass(frozen=True)
class TickVerdict:
    """Result of comparing ticks and poses."""

    jumps: tuple[ClockJump, ...]
    offset: ClockOffset | None
    """Offset; None where the speed does not change enough to determine it, and where clocks step."""
    still_m: float = 0.0
    """Distance of the poses over which the ticks do not count at all; 0 where they do."""

    @property
    def is_off(self) -> bool:
        """True where an offset is proved."""
        return self.offset is not None and abs(self.offset.offset_s) > max(
            _SIGMAS * self.offset.sigma_s, _LEAST_OFFSET_S
        )


NOTHING: Final = TickVerdict((), None)


def judge_ticks(wheel: WheelTicks, poses: PoseWay) -> TickVerdict:
    """Compare ticks with poses; the result is empty where there is too little of either."""
    if poses.epochs_gps_ns.size < LEAST_SAMPLES:
        return NOTHING
    way = _Way.of(poses)
    thinned = _thinned(wheel)
    seen = way.is_known(thinned.epochs_gps_ns)
    epochs, ticks = thinned.epochs_gps_ns[seen], thinned.ticks[seen]
    if epochs.size < LEAST_SAMPLES:
        return NOTHING
    distance = way.at(epochs)
    steps_m, steps_ticks = np.diff(distance), np.diff(ticks).astype(np.float64)
    if not steps_ticks.any():
        way_m = float(np.sum(steps_m[steps_m > _LEAST_SPEED_M_PER_S * np.diff(epochs) / NS_PER_S]))
        return TickVerdict((), None, way_m if way_m > _LEAST_WAY_M else 0.0)
    scale = _metres_per_tick(steps_m, steps_ticks)
    if scale is None or distance[-1] - distance[0] < _LEAST_WAY_M:
        return NOTHING
    jumps = _jumps(epochs, steps_m, scale * steps_ticks, abs(scale))
    offset = None if jumps else _offset(thinned, way)
    return TickVerdict(jumps, offset)


@dataclass(frozen=True)
class _Way:
    """Distance and turns of the poses since the first."""

    epochs_gps_ns: Int64
    distance_m: Float64
    turned_rad: Float64
    """(m, 2) about the body's axes right and down: a wheel beside or below the poses' point travels another way."""
    is_wide: Bool
    """(m − 1,) True for intervals that are longer than usual."""

    @classmethod
    def of(cls, poses: PoseWay) -> _Way:
        steps = np.linalg.norm(np.diff(poses.position_world_m, axis=0), axis=1)
        turns = rotation_vectors(poses.quaternion[:-1], poses.quaternion[1:])[:, 1:]
        elapsed = np.diff(poses.epochs_gps_ns)
        wide = elapsed > _WIDE * np.median(elapsed)
        begin = np.zeros(1)
        return cls(
            poses.epochs_gps_ns, np.concatenate([begin, np.cumsum(steps)]),
            np.concatenate([np.zeros((1, 2)), np.cumsum(turns, axis=0)]), wide,
        )  # fmt: skip

    def is_known(self, epochs: Int64) -> Bool:
        """Return whether poses lie close on both sides of epochs (n,)."""
        after = np.searchsorted(self.epochs_gps_ns, epochs, side="left")
        inside = (after > 0) & (after < self.epochs_gps_ns.size)
        exact = np.isin(epochs, self.epochs_gps_ns)
        interval = np.clip(after - 1, 0, self.is_wide.size - 1)
        return np.asarray(exact | (inside & ~self.is_wide[interval]))

    def at(self, epochs: Int64) -> Float64:
        """Return the distance (n,) at epochs (n,)."""
        return self._at(epochs, self.distance_m)

    def turn_at(self, epochs: Int64) -> Float64:
        """Return turns (n, 2) since the first pose about the body's axes right and down."""
        return np.stack([self._at(epochs, one) for one in self.turned_rad.T], axis=-1)

    def _at(self, epochs: Int64, values: Float64) -> Float64:
        since, own = ((e - self.epochs_gps_ns[0]).astype(np.float64) for e in (epochs, self.epochs_gps_ns))
        return np.asarray(np.interp(since, own, values))


def _thinned(wheel: WheelTicks) -> WheelTicks:
    """Return the first sample of each period of `SAMPLES_PER_S`."""
    period = wheel.epochs_gps_ns // (NS_PER_S // SAMPLES_PER_S)
    kept = np.concatenate([[True], np.diff(period) > 0]) if period.size else np.zeros(0, bool)
    return WheelTicks(wheel.epochs_gps_ns[kept], wheel.ticks[kept])


def _metres_per_tick(steps_m: Float64, steps_ticks: Float64) -> float | None:
    """Return the length of a tick, negative where the count falls; None where the count does not follow the way."""
    moving = (steps_ticks != 0) & (steps_m > 0)
    if moving.sum() < LEAST_SAMPLES // 2:
        return None
    ratio = steps_m[moving] / steps_ticks[moving]
    scale = float(np.median(ratio))
    follows = np.abs(ratio - scale) < 0.5 * abs(scale)
    return scale if follows.mean() > 0.5 else None


def _jumps(epochs: Int64, steps_m: Float64, by_ticks_m: Float64, tick_m: float) -> tuple[ClockJump, ...]:
    """Return single links across which the poses travel farther or less far than the ticks."""
    away = steps_m - by_ticks_m
    elapsed = np.diff(epochs) / NS_PER_S
    known = by_ticks_m >= 0  # a counter that restarts has no information on the link
    usual, noise = _usual(np.where(known, away, np.nan), elapsed)
    bound = np.maximum(_LEAST_JUMP_M, _NOISE_TIMES * noise) + _WAY_SHARE * np.maximum(by_ticks_m, 0) + _QUANTA * tick_m
    beyond = known & (np.abs(away - usual) > bound)
    found: list[ClockJump] = []
    at = np.flatnonzero(beyond)
    for links in np.split(at, np.flatnonzero(np.diff(at) > _BESIDE) + 1):
        if not links.size or links[-1] - links[0] > 1:
            continue  # wheel slip
        first, last = int(links[0]), int(links[-1])
        own = slice(first, last + 1)
        speed = _speed(slice(max(first - _NEIGHBOURS, 0), last + _NEIGHBOURS + 1), own, (steps_m, by_ticks_m), elapsed)
        if speed < _LEAST_SPEED_M_PER_S:
            continue
        way = float((away - usual)[own].sum())
        slip = _WAY_SHARE * float(by_ticks_m[own].sum())
        found.append(ClockJump(int(epochs[last + 1]), way, way / speed, float(noise[first] + tick_m + slip) / speed))
    return tuple(found)


def _speed(near: slice, own: slice, ways_m: tuple[Float64, Float64], elapsed_s: Float64) -> float:
    """Return the speed (m/s) while a clock steps: over a long link that of the longer way, whose clock continued."""
    if (duration := float(elapsed_s[own].sum())) > _LONG_LINK_S:
        return max(float(way[own].sum()) for way in ways_m) / duration
    return float(np.median(ways_m[1][near] / elapsed_s[near]))


def _usual(away: Float64, elapsed_s: Float64) -> tuple[Float64, Float64]:
    """Return the median (n,) disagreement of ticks and poses over a link, and its scatter (1.4826 MAD), by blocks."""
    middle, noise = np.zeros(away.size), np.zeros(away.size)
    for start in range(0, away.size, _NEIGHBOURS):
        own = slice(start, start + _NEIGHBOURS)
        near = away[max(start - _NEIGHBOURS, 0) : start + 2 * _NEIGHBOURS]
        near = near[np.isfinite(near)]
        if near.size:
            middle[own] = np.median(near)
            noise[own] = scatter_about(near, middle[own.start])
    return middle, noise


# --- a clock that is off as a whole -------------------------------------------------------------------


def _offset(wheel: WheelTicks, way: _Way) -> ClockOffset | None:
    """Return the offset of the sensor's stamps; None where the speed does not determine it."""
    window_ns = round(_WINDOW_S * NS_PER_S)
    edges = np.arange(wheel.epochs_gps_ns[0], wheel.epochs_gps_ns[-1], window_ns)
    if edges.size <= _LEAST_WINDOWS:
        return None
    at = (wheel.epochs_gps_ns - wheel.epochs_gps_ns[0]).astype(np.float64)
    ticks = np.interp((edges - wheel.epochs_gps_ns[0]).astype(np.float64), at, wheel.ticks.astype(np.float64))
    steps = np.diff(ticks)
    near, best = (
        None if start is None else _settled(edges, steps, way, start)
        for start in (0.0, _coarse_lag(edges, steps, way))
    )  # fmt: skip
    if best is None:
        return None
    # A drive with periodic speed fits equally well one period later.
    found = near if near is not None and near.left_m2 < _EXPLAINS * best.left_m2 else best
    return ClockOffset(-found.lag_s, found.sigma_s)


class _Fit(NamedTuple):
    """Fit of the ticks to the way at a lag."""

    lag_s: float
    """Lag to be added to the sensor's stamps."""
    sigma_s: float
    left_m2: float
    """Variance of the way that is not explained."""


def _settled(edges: Int64, ticks: Float64, way: _Way, start_s: float) -> _Fit | None:
    """Return the lag that explains the way best, from a first guess on; None where too little is in common."""
    lag, fit = start_s, None
    for _ in range(_ROUNDS):
        fit = _refined(edges, ticks, way, lag)
        if fit is None:
            return None
        lag = fit.lag_s
    return fit


def _design(edges: Int64, ticks: Float64, way: _Way, lag_s: float) -> tuple[Float64, Float64] | None:
    """Return the way (k,) of each window at a lag, and its regressors (k, 4): ticks, turns, change of speed."""
    moved = edges + round(lag_s * NS_PER_S)
    inside = (moved[:-1] > way.epochs_gps_ns[0]) & (moved[1:] < way.epochs_gps_ns[-1]) & (ticks != 0)
    if inside.sum() < max(_LEAST_WINDOWS, _LEAST_OVERLAP * ticks.size):
        return None
    speed = (way.at(moved + NS_PER_S // 20) - way.at(moved - NS_PER_S // 20)) / 0.1
    turns = np.diff(way.turn_at(moved), axis=0)
    turns[:, np.sqrt(np.mean(turns[inside] ** 2, axis=0)) < _LEAST_TURN_RAD] = 0.0
    parts = np.column_stack([ticks, turns, np.diff(speed)])
    return np.diff(way.at(moved))[inside], parts[inside]


def _left(edges: Int64, ticks: Float64, way: _Way, lag_s: float) -> float | None:
    """Return the variance of the way that ticks and turns leave at a lag."""
    found = _design(edges, ticks, way, lag_s)
    if found is None:
        return None
    y, parts = found
    known = parts[:, :3]
    rest = y - known @ np.linalg.lstsq(known, y, rcond=None)[0]
    return float(np.mean(rest**2))


def _coarse_lag(edges: Int64, ticks: Float64, way: _Way) -> float | None:
    """Return the lag (s), to be added to the sensor's stamps, at which ticks explain the way best."""
    lags = np.arange(-_FARTHEST_S, _FARTHEST_S + _LAG_STEP_S, _LAG_STEP_S)
    left = [np.inf if (one := _left(edges, ticks, way, float(lag))) is None else one for lag in lags]
    best = int(np.argmin(left))
    return float(lags[best]) if np.isfinite(left[best]) else None


def _refined(edges: Int64, ticks: Float64, way: _Way, lag_s: float) -> _Fit | None:
    """Return the fit at a lag, with an improved lag."""
    found = _design(edges, ticks, way, lag_s)
    if found is None:
        return None
    y, parts = found
    size = np.linalg.norm(parts, axis=0)
    if not size[-1] > 0:
        return None
    parts = parts[:, size > 0] / size[size > 0]  # on a straight road there are no turns
    inverse = np.linalg.pinv(parts.T @ parts)
    rest = y - parts @ (inverse @ (parts.T @ y))
    free_m2 = float(np.sum(rest**2)) / max(len(y) - parts.shape[1] - 1, 1)
    # Errors of neighbouring windows are correlated (Newey and West), so σ of independent ones would be too small.
    scores = parts * rest[:, None]
    spread = scores.T @ scores
    reach = min(8, len(y) // 4)
    for k in range(1, reach + 1):
        both = scores[k:].T @ scores[:-k]
        spread += (1.0 - k / (reach + 1)) * (both + both.T)
    covariance = inverse @ spread @ inverse * len(y) / max(len(y) - parts.shape[1], 1)
    # If the lag is too small by d, the way is too short by the change of speed times d.
    change, sigma = float((inverse @ (parts.T @ y))[-1]), float(np.sqrt(max(covariance[-1, -1], 0.0)))
    return _Fit(lag_s - change / float(size[-1]), sigma / float(size[-1]), free_m2)
