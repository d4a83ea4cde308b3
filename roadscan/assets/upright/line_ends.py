"""Where scan lines leave a plate: the places beside its returns that a sensor looked at, and did not hit it."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.returns import Returns

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

POINTS: Final = 7
"""A scan line that missed is known at so many places."""
_SWEEP_GAP_NS: Final = 20_000_000
_LINE_GAP_NS: Final = 2_000_000
_OFTEN: Final = 2
"""A laser that so many sweeps have as the outermost one, and none as an inner one, may be the last of its fan."""
_STRAIGHT: Final = 0.2
"""Where the way from return to return is longer than five times that from end to end, the returns draw no lines."""
_BESIDE: Final = 0.3
"""Lines that lie nearer to each other than this share of the widest gap are one."""


def misses_beside(returns: Returns, rows: Int64, places: Float64) -> Float64:
    """Scan lines (m, 7, 2) that went past a plate, each as seven places of its plane.

    Along a line the next pulse lies a step beyond the last return. Across lines the next laser, or the next scan of a
    mirror, lies as far beyond the outermost line as lines of the sweep lie apart. What has not come back is so known.
    Where returns draw no lines, there are none.

    Parameters
    ----------
    rows : (n,) returns on the plate.
    places : (n, 2) where they lie in its plane.
    """
    epoch, laser = returns.epoch_gps_ns[rows], returns.laser[rows].astype(np.int64)
    source = returns.pass_id[rows].astype(np.int64) * 256 + returns.sensor[rows]
    order = np.lexsort((laser, epoch, source))
    sweep = np.empty(rows.size, np.int64)
    sweep[order] = _numbers((np.diff(source[order]) != 0) | (np.diff(epoch[order]) > _SWEEP_GAP_NS))
    order = np.lexsort((epoch, laser, sweep))
    ends_here = (np.diff(sweep[order]) != 0) | (np.diff(laser[order]) != 0) | (np.diff(epoch[order]) > _LINE_GAP_NS)
    starts = np.concatenate([[0], np.flatnonzero(ends_here) + 1])
    last = np.concatenate([starts[1:], [rows.size]]) - 1
    places, away = places[order], returns.at(rows[order[starts]]).range_m
    line_sweep, line_laser = sweep[order][starts], laser[order][starts]
    first, end = places[starts], places[last]
    if not _draw_lines(places, starts, last):
        return np.zeros((0, POINTS, 2))
    steps = _steps(places, starts, last, away)
    along = np.concatenate([first - steps, end + steps])
    way = np.linalg.eigh((end - first).T @ (end - first) + 1e-12 * np.eye(2))[1][:, 1]
    across = np.array([-way[1], way[0]])
    beyond = _beyond((first + end) @ across / 2, line_sweep, line_laser, away)
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    lines = [first[k] + share * (end[k] - first[k]) + gap * across for k, gap in beyond]
    return np.concatenate([np.repeat(along[:, None], POINTS, axis=1), *[line[None] for line in lines]])


def _numbers(is_new: npt.NDArray[np.bool_]) -> Int64:
    """Number of the group of each of n + 1 elements, of which n may begin a new one."""
    return np.concatenate([[0], np.cumsum(is_new)])


def _draw_lines(places: Float64, starts: Int64, last: Int64) -> bool:
    """Whether returns follow one another along lines, rather than in an order that says nothing of a sensor."""
    step = np.concatenate([[0.0], np.hypot(*np.diff(places, axis=0).T)])
    step[starts] = 0.0
    return float(np.hypot(*(places[last] - places[starts]).T).sum()) > _STRAIGHT * float(step.sum())


def _steps(places: Float64, starts: Int64, last: Int64, away_m: Float64) -> Float64:
    """Step (k, 2) from pulse to pulse of each line; of lines of one return as wide an angle as that of the others."""
    steps = np.full((starts.size, 2), np.nan)
    for k in np.flatnonzero(last > starts).tolist():
        steps[k] = np.median(np.diff(places[starts[k] : last[k] + 1], axis=0), axis=0)
    known = np.isfinite(steps[:, 0])
    if not known.any():
        return np.zeros_like(steps)
    steps[~known] = np.median(steps[known] / away_m[known, None], axis=0) * away_m[~known, None]
    return steps


def _beyond(at: Float64, sweep: Int64, laser: Int64, away_m: Float64) -> list[tuple[int, float]]:
    """Outermost lines of each sweep, and how far across the next one lies (m, with its sign)."""
    groups = [np.flatnonzero(sweep == one) for one in np.unique(sweep).tolist()]
    groups = [g[np.argsort(at[g], kind="stable")] for g in groups]
    gaps = [_gap(at[g]) for g in groups]
    angles = [gap / float(np.median(away_m[g])) for gap, g in zip(gaps, groups, strict=True) if gap > 0.0]
    if not angles:
        return []
    angle, out = float(np.median(angles)), []
    for side in (0, -1):
        outer = np.array([laser[g[side]] for g in groups])
        inner = {n for g in groups for n in laser[np.delete(g, side)].tolist()}
        for gap, g in zip(gaps, groups, strict=True):
            own = int(laser[g[side]])
            if own in inner or (outer == own).sum() < _OFTEN:
                wide = gap if gap > 0.0 else angle * float(away_m[g[side]])
                out.append((int(g[side]), wide if side else -wide))
    return out


def _gap(at: Float64) -> float:
    """Distance between lines at ascending places; 0 where there is one."""
    gaps = np.diff(at)
    if not gaps.size or gaps.max() <= 0.0:
        return 0.0
    return float(np.median(gaps[gaps > _BESIDE * gaps.max()]))
