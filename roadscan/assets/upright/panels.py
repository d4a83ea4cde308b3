"""Upright surfaces in stretches of a metre: their lines, their heights, and what passes through them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.upright_voxels import beside_line, in_stretches, near_middles, passing_lines
from roadscan.assets.quantiles import median, quantiles
from roadscan.assets.scene import Box, Scene, once_a_scene
from roadscan.assets.upright.regions import LOWEST_M, Region, regions_of
from roadscan.assets.upright.slices import places_of
from roadscan.compute.array_types import Bool, Float64, Int64

STRETCH_M: Final = 1.0  # Length of a stretch (m), about.
_LINES_PER_M2: Final = 32.0
"""About so many sight lines for each square metre of the survey are compared with surfaces."""
SIGHT_M: Final = 13.0
"""Lines that end farther from a stretch (m) are not counted: squares of any cut see the others."""
_HIGHEST: Final = (0.98, 0.95)
"""The highest beam is at this share of the elevations above that share of all: 0.999 of all lie below."""
_STRETCH_LEAST_M: Final = 1.0  # Lower and higher parts of a surface that are shorter (m) are not told apart.
_END_M: Final = 0.25  # A surface ends with the last part of it so long (m) …
_END_RETURNS: Final = 3  # … that holds so many returns.
_LAST_M: Final = 0.5  # So long a part at an end tells how high a surface ends (m).
_LOWEST_TOP_M, _GARDEN_M = 0.5, 1.6
"""A low surface, whose ends are followed, is so high at the least and at the most (m) …"""
_STEPS, _HALF_M = 8, 0.5
"""… and is followed so many steps, each so long (m), …"""
_MOST_MISSED: Final = 3  # … over so many that do not show it.
_AROUND_M, _THIN_M, _SLICE_M = 0.45, 0.1, 0.1
"""Returns so near to a place and, on its line, so near to that tell of slices so high (m)."""
_SLICES: Final = 15  # So many lie below the greatest height.
_CLEARLY: Final = 3.0
"""A surface ends where slices hold fewer returns than those below by so many standard deviations of a count."""
_LEAST_TOP_M: Final = 0.3  # Tops of lower stretches (m) are not followed.
_FACE_M: Final = 0.05  # Returns of a face scatter no more about its line (m).
_TOP_SLICE_M, _TOP_SLICES = 0.05, 40
"""The face is followed in slices so high (m), up to 2.15 m above the ground."""
_MOSTLY: Final = 0.7  # Share of the returns in front of and on the line that lie on it.
_SHIFTS_M: Final = np.linspace(-0.2, 0.2, 11)  # The line may go on so far beside itself (m).
_SPREAD_M: Final = 0.04  # Returns of a thin surface scatter no more across it (m).
_FEWEST: Final = 5  # Fewer returns of a step do not tell.
_HIGH_M: Final = 4.0
"""Sight lines through higher surfaces (m) are not counted."""
_BESIDE_M: Final = 0.2
"""Returns of a region up to this distance beside its line (m) make the surface."""
_RIM_M: Final = 0.08
"""Sight lines nearer than this to an edge of a surface (m) do not count."""
COLUMNS: Final = 4
"""A stretch has so many columns beside one another, …"""
LEAST_LINES: Final = 8
"""… each of which so many sight lines tell of: all end by chance on what lets a fifth through in 17 % of the cases."""
_ABOVE_GROUND_M: Final = 0.12
"""Sight lines below this height above the ground (m) do not tell whether the space below a surface is free."""
_OPEN_DEG: Final = 1.2  # The top of a surface is open within this angle of the highest beam (degrees).
_NEAR_M: Final = 3.0
"""Returns within this distance of its line (m) may belong to a surface."""


@dataclass(frozen=True, eq=False)
class Panel:
    """A surface of k stretches, along its line."""

    xy_m: Float64
    """(k + 1, 2) ends of the stretches, from the corner of the returns."""
    ground_m: Float64
    """(k,) height of the ground in the map frame."""
    low_m: Float64
    """(k,) lower edge: 2 % of the returns lie below; NaN where there are none."""
    high_m: Float64
    """(k,) upper edge of what lies on its plane."""
    top_m: Float64
    """(k,) the same, or higher where its face goes on to a top that is seen from above."""
    bulk_m: Float64
    """(k,) height below which 15 % of the returns lie: the posts of a guardrail have fewer."""
    returns: Int64
    """(k,)"""
    stopped: Int64
    """(k,) sight lines of the sample that end on it, between its edges; `passed` is the number of those through it
    there, and `under` of those between the ground and its lower edge. Lines that end before it are in none."""
    passed: Int64
    under: Int64
    foot: Int64
    """(k,) sight lines of the sample that end on its place below its lower edge."""
    columns: Int64
    """(k,) quarters of its length that eight sight lines or more met; `open_columns` is the number of those that let
    one through. Parts of its height do not tell: what rises above the horizon goes on to nothing."""
    open_columns: Int64
    open_top: Bool
    """(k,) True where the highest laser still meets it: its top is not seen."""
    leaves: Int64
    """(k,) returns that are classed as vegetation."""
    across_m: float
    seen_from_m: tuple[float, float]
    """Mean place of the sensor."""
    rows: Int64
    stretch: npt.NDArray[np.int32]
    """Stretch of each row."""

    def comes_near(self, tile: Box) -> bool:
        """Returns whether a tile may contain a part of it, or a return that belongs to it."""
        return tile.comes_near(self.xy_m, _NEAR_M)


@once_a_scene
def panels_of(scene: Scene) -> list[Panel]:
    """Returns panels of all upright surfaces of a scene with its halo."""
    highest = highest_elevation_deg(scene)
    panels = [_panel(scene, region, highest) for region in regions_of(scene)]
    return _with_sight(scene, [p for p in panels if p is not None])


def highest_elevation_deg(scene: Scene) -> float:
    """Returns the elevation that hardly any sight line of the survey exceeds (degrees)."""

    def from_nadir() -> Float64:
        r, some = scene.returns, _sampled(scene)
        flat = np.hypot(r.x_m[some] - r.sensor_x_m[some], r.y_m[some] - r.sensor_y_m[some])
        angle = 90.0 + np.degrees(np.arctan2(r.height_m[some] - r.sensor_height_m[some], flat))
        angle = angle[np.isfinite(angle)]
        return angle[angle >= np.quantile(angle, _HIGHEST[0])] if angle.size else angle

    found = scene.statistics.of("highest_beam_from_nadir_deg", _HIGHEST[1], from_nadir)
    return 90.0 if found is None else found - 90.0


def _sampled(scene: Scene) -> Bool:
    """Returns a mask (n,) of the returns whose sight lines are compared with surfaces."""
    returns, density = scene.returns, scene.statistics.of("returns_per_m2", 0.5, lambda: np.zeros(0))
    one_of = max(round((density or 0.0) / _LINES_PER_M2), 1)
    bits = returns.epoch_gps_ns.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    bits ^= np.rint(1e4 * returns.height_m).astype(np.int64).astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    bits = (bits ^ returns.laser) * np.uint64(0xBF58476D1CE4E5B9)
    return np.asarray((bits >> np.uint64(32)) % np.uint64(one_of) == 0)


def _panel(scene: Scene, region: Region, highest_deg: float) -> Panel | None:
    returns, rows = scene.returns, _with_ends(scene, region)
    beside = np.array([-region.along[1], region.along[0]])
    t, d, stretch = np.empty(rows.size), np.empty(rows.size), np.empty(rows.size, np.int32)
    beside_line(returns.x_m, returns.y_m, rows, region.middle_xy_m, region.along, t, d)
    begin, end = _ends(t)
    edges = _edges(t, scene.above_ground_m[rows], begin, end)
    count = edges.size - 1
    in_stretches(t, edges, stretch)
    middle, near = _medians(d, stretch, count), np.empty(rows.size, np.bool_)
    near_middles(t, d, stretch, edges, middle, _BESIDE_M, near)
    if near.sum() < 10:
        return None
    rows, stretch = rows[near], stretch[near]
    at_edges = np.interp(edges, (edges[:-1] + edges[1:]) / 2, middle)
    if count >= 2:
        at_edges[0], at_edges[-1] = 1.5 * middle[0] - 0.5 * middle[1], 1.5 * middle[-1] - 0.5 * middle[-2]
    xy = region.middle_xy_m + edges[:, None] * region.along + at_edges[:, None] * beside
    centre = (xy[:-1] + xy[1:]) / 2
    ground = scene.ground.height_at(centre[:, 0], centre[:, 1])
    low, bulk, high, top = (np.full(count, np.nan) for _ in range(4))
    open_top = np.zeros(count, np.bool_)
    starts, order = in_bins(stretch, count)
    for k in range(count):
        own = rows[order[starts[k] : starts[k + 1]]]
        if own.size >= 4:
            heights = returns.height_m[own]
            low[k], bulk[k], high[k] = quantiles(heights, [0.02, 0.15, 0.98])
            top[k] = max(high[k], _top_m(scene, xy[k : k + 2], float(high[k] - ground[k])))
            last = own[np.argmax(heights)]
            east, north = returns.x_m[last] - returns.sensor_x_m[last], returns.y_m[last] - returns.sensor_y_m[last]
            flat = math.hypot(east, north)
            rise = float(returns.height_m[last] - returns.sensor_height_m[last])
            open_top[k] = math.degrees(math.atan2(rise, flat)) > highest_deg - _OPEN_DEG
    none = np.zeros(count, np.int64)
    sensor = float(np.mean(returns.sensor_x_m[rows])), float(np.mean(returns.sensor_y_m[rows]))
    leaves = np.bincount(stretch[np.isin(scene.classes[rows], classes.VEGETATION)], minlength=count)
    return Panel(
        xy, ground, low, high, top, bulk,
        np.bincount(stretch, minlength=count), none, none, none, none, none, none, open_top, leaves, region.across_m,
        sensor, rows, stretch,
    )  # fmt: skip


def _top_m(scene: Scene, ends_m: Float64, above_m: float) -> float:
    """Returns the height of the upper edge (m) of a low surface that goes on above what is known; −inf if it does not.

    From above, the top of a wall is seen with its face, so that no plane is thin there. The face goes on, slice by
    slice, while half as many returns as usual lie on it, and no more lie before it, as of leaves.

    ends_m : (2, 2) of a stretch. above_m : how high above the ground it is known.
    """
    returns = scene.returns
    if not _LEAST_TOP_M <= above_m <= _GARDEN_M:
        return -math.inf
    middle, way = ends_m.mean(axis=0), ends_m[1] - ends_m[0]
    along = way / max(float(np.hypot(*way)), 1e-9)
    near = places_of(scene).within(float(middle[0]), float(middle[1]), _AROUND_M)
    t, d = np.empty(near.size), np.empty(near.size)
    beside_line(returns.x_m, returns.y_m, near, middle, along, t, d)
    level = np.floor((scene.above_ground_m[near] - LOWEST_M) / _TOP_SLICE_M)
    here = (np.abs(t) <= _HALF_M / 2) & (level >= 0) & (level < _TOP_SLICES)
    near, d, level = near[here], d[here], level[here].astype(np.int64)
    on = np.abs(d) <= _FACE_M
    if on.sum() < _FEWEST:
        return -math.inf
    sensor = np.array([np.mean(returns.sensor_x_m[near[on]]), np.mean(returns.sensor_y_m[near[on]])]) - middle
    before = d * math.copysign(1.0, float(along[0] * sensor[1] - along[1] * sensor[0])) > _FACE_M
    mine, others = (np.bincount(level[some], minlength=_TOP_SLICES) for some in (on, before))
    last = int((above_m - LOWEST_M) / _TOP_SLICE_M)
    goes_on = (mine[last + 1 :] >= max(0.5 * median(mine[:last]), 1.0)) & (mine[last + 1 :] >= others[last + 1 :])
    more = int(np.argmin(np.append(goes_on, False)))
    if not more:
        return -math.inf
    return quantiles(returns.height_m[near[on & (level <= last + more)]], [0.98])[0]


def _with_ends(scene: Scene, region: Region) -> Int64:
    """Returns the returns of a region, with those of a low surface that goes on at its ends.

    Where leaves stand close behind a fence or a wall, or where it meets another one, no plane is thin. So half a metre
    is followed after half a metre, as long as most returns below its upper edge, slice by slice, lie on its line.
    """
    returns, rows = scene.returns, region.rows
    more = [rows]
    along = region.along
    t, d = np.empty(rows.size), np.empty(rows.size)
    beside_line(returns.x_m, returns.y_m, rows, region.middle_xy_m, along, t, d)
    for sign, end in zip((-1.0, 1.0), _ends(t), strict=True):
        last = np.abs(t - end) <= _LAST_M
        top = float(scene.above_ground_m[rows[last]].max(initial=0.0))
        if not _LOWEST_TOP_M <= top <= _GARDEN_M:
            continue
        middle, missed = median(d[last]), 0
        for step in range(_STEPS):
            at = end + sign * (step + 0.5) * _HALF_M
            x, y = region.middle_xy_m + at * along + middle * np.array([-along[1], along[0]])
            own, middle = _on_line(scene, (float(x), float(y)), along, middle)
            more.append(own)
            missed = 0 if own.size else missed + 1
            if missed > _MOST_MISSED:
                break
    return np.unique(np.concatenate(more)) if sum(map(len, more)) > rows.size else rows


def _on_line(scene: Scene, place: tuple[float, float], along: Float64, middle_m: float) -> tuple[Int64, float]:
    """Returns the returns of half a metre of a low surface about a place, and how far left of its line they lie.

    Nothing where the returns scatter across the line, as leaves do, or where too little is as high as a fence. What is
    behind the line, seen from the sensor, says nothing against a surface.
    """
    returns = scene.returns
    near = places_of(scene).within(*place, _AROUND_M)
    t, d = np.empty(near.size), np.empty(near.size)
    beside_line(returns.x_m, returns.y_m, near, np.array(place), along, t, d)
    above = scene.above_ground_m[near]
    here = (np.abs(t) <= _HALF_M / 2) & (above > LOWEST_M) & (above <= _GARDEN_M)
    near, t, d, above = near[here], t[here], d[here], above[here]
    if near.size < _FEWEST:
        return near[:0], middle_m
    sensor = np.array([np.mean(returns.sensor_x_m[near]), np.mean(returns.sensor_y_m[near])]) - place
    before = -1.0 if float(along[0] * sensor[1] - along[1] * sensor[0]) > 0.0 else 1.0  # d times this grows backwards
    held = [int((np.abs(d - shift) <= _THIN_M).sum()) for shift in _SHIFTS_M]
    shift = float(_SHIFTS_M[int(np.argmax(held))])
    on = np.abs(d - shift) <= _THIN_M
    in_front = ~on & ((d - shift) * before < 0.0)
    level = ((above - LOWEST_M) / _SLICE_M).astype(np.int64)
    mine, others = (np.bincount(level[some], minlength=_SLICES + 2) for some in (on, in_front))
    usual = np.array([median(mine[: k + 1]) for k in range(_SLICES)])
    fewest = np.maximum(usual - _CLEARLY * np.sqrt(usual), 0.0)
    good = (mine[:_SLICES] > fewest) & (mine[:_SLICES] >= others[:_SLICES])
    good = np.append(good, [False, False])
    ends = np.flatnonzero(~good[:-1] & ~good[1:])  # two slices above one another that show no surface
    top = int(ends[ends > np.argmax(good)][0]) if good.any() else 0
    on &= level < top
    if not _LOWEST_TOP_M <= LOWEST_M + _SLICE_M * top < _GARDEN_M or on.sum() < _FEWEST:
        return near[:0], middle_m
    past, off = t[on] - t[on].mean(), d[on] - d[on].mean()
    off -= past * float(past @ off) / max(float(past @ past), 1e-9)
    if (in_front & (level < top)).sum() > (1.0 - _MOSTLY) * on.sum() or float(np.std(off)) > _SPREAD_M:
        return near[:0], middle_m
    return near[on], middle_m + median(d[on])


def _ends(t: Float64) -> tuple[float, float]:
    """Returns where returns begin and end along a line, without single ones: a gate beside a house has few of all."""
    first = float(t.min())
    bins = ((t - first) / _END_M).astype(np.int64)
    held = np.flatnonzero(np.bincount(bins) >= _END_RETURNS)
    if not held.size:
        return first, float(t.max())
    return float(t[bins == held[0]].min()), float(t[bins == held[-1]].max())


def _edges(t: Float64, above_m: npt.NDArray[np.float32], begin: float, end: float) -> Float64:
    """Returns where stretches begin along a line, and where the last one ends: none holds a low and a high part."""
    count = max(int((end - begin) / _END_M), 1)
    bins = np.clip(((t - begin) / _END_M).astype(np.int64), 0, count - 1)
    top = np.full(count, -np.inf, np.float32)
    np.maximum.at(top, bins, above_m)
    some = np.flatnonzero(np.isfinite(top))
    low = (top[some] <= _GARDEN_M).astype(np.int64)
    first = np.flatnonzero(np.append(True, np.diff(low) != 0))
    long = np.diff(np.append(some[first], count)) * _END_M >= _STRETCH_LEAST_M
    first = first[long]
    first = first[np.append(True, np.diff(low[first]) != 0)][1:] if first.size else first
    cuts = np.concatenate([[begin], begin + some[first] * _END_M, [end]])
    parts = [np.linspace(a, b, max(1, round((b - a) / STRETCH_M)), endpoint=False) for a, b in itertools.pairwise(cuts)]
    return np.concatenate([*parts, [end]])


def _medians(d: Float64, stretch: npt.NDArray[np.int32], count: int) -> Float64:
    """Returns the median of d in each stretch (count,); where fewer than 5 are known, that of its neighbours."""
    out = np.full(count, np.nan)
    starts, order = in_bins(stretch, count)
    for k in range(count):
        own = d[order[starts[k] : starts[k + 1]]]
        if own.size >= 5:
            out[k] = median(own)
    known = np.isfinite(out)
    if not known.any():
        return np.full(count, float(np.median(d)))
    filled: Float64 = np.interp(np.arange(count), np.flatnonzero(known), out[known])
    return filled


def _with_sight(scene: Scene, panels: list[Panel]) -> list[Panel]:
    """Returns the panels with the numbers of sight lines that end on them, and that pass through."""
    returns = scene.returns
    taken = _sampled(scene)
    some = np.flatnonzero(taken)
    asked = [(p.high_m - p.ground_m <= _HIGH_M) & p.comes_near(scene.tile) for p in panels]
    lines = np.concatenate([np.zeros((0, 4)), *(
        np.column_stack([p.xy_m[:-1], p.xy_m[1:]])[low] for p, low in zip(panels, asked, strict=True)
    )])  # fmt: skip
    bands = np.concatenate([
        np.zeros((0, 2, 2)), *(_bands(p)[low] for p, low in zip(panels, asked, strict=True)),
    ])  # fmt: skip
    found = np.zeros((len(lines), COLUMNS, 2), np.int64)
    passing_lines(
        returns.x_m[some], returns.y_m[some], returns.height_m[some], returns.sensor_x_m[some],
        returns.sensor_y_m[some], returns.sensor_height_m[some], lines, bands, SIGHT_M, found,
    )  # fmt: skip
    out, first = [], 0
    for p, low in zip(panels, asked, strict=True):
        own = slice(first, first + int(low.sum()))
        passed, under = np.zeros((2, p.returns.size, COLUMNS), np.int64)
        passed[low], under[low] = found[own, :, 0], found[own, :, 1]
        ends = _stopped(scene, p, taken[p.rows])
        told = low[:, None] & (passed + ends >= LEAST_LINES)
        out.append(replace(
            p, stopped=ends.sum(axis=1), passed=passed.sum(axis=1), under=under.sum(axis=1),
            columns=told.sum(axis=1), open_columns=(told & (passed > 0)).sum(axis=1),
            foot=_at_foot(scene, p, taken, low & (under.sum(axis=1) > 0)),
        ))  # fmt: skip
        first = own.stop
    return out


def _at_foot(scene: Scene, panel: Panel, taken: Bool, asked: Bool) -> Int64:
    """Returns how many sight lines (k,) of the sample end on the place of a surface below its lower edge."""
    out, returns = np.zeros(panel.returns.size, np.int64), scene.returns
    middle, way = (panel.xy_m[:-1] + panel.xy_m[1:]) / 2, np.diff(panel.xy_m, axis=0)
    for k in np.flatnonzero(asked).tolist():
        long = float(np.hypot(*way[k]))
        rows = places_of(scene).within(float(middle[k, 0]), float(middle[k, 1]), long / 2 + _BESIDE_M)
        rows = rows[taken[rows]]
        t, d = np.empty(rows.size), np.empty(rows.size)
        beside_line(returns.x_m, returns.y_m, rows, middle[k], way[k] / max(long, 1e-9), t, d)
        height = returns.height_m[rows]
        below = (height > panel.ground_m[k] + _ABOVE_GROUND_M) & (height < panel.low_m[k] - _RIM_M)
        out[k] = np.count_nonzero(below & (np.abs(t) <= long / 2) & (np.abs(d) <= _BESIDE_M))
    return out


def _bands(panel: Panel) -> Float64:
    """Returns the lower and upper edges (k, 2, 2) of its stretches, and those of what is below them."""
    own = np.stack([panel.low_m + _RIM_M, panel.high_m - _RIM_M], axis=1)
    below = np.stack([panel.ground_m + _ABOVE_GROUND_M, panel.low_m - _RIM_M], axis=1)
    return np.stack([own, below], axis=1)


def _stopped(scene: Scene, panel: Panel, taken: Bool) -> Int64:
    """Returns how many sight lines (k, 4) of the sample end in each column of its stretches."""
    rows, stretch = panel.rows[taken], panel.stretch[taken]
    way = np.diff(panel.xy_m, axis=0)
    past = np.column_stack([scene.returns.x_m[rows], scene.returns.y_m[rows]]) - panel.xy_m[stretch]
    along = (past * way[stretch]).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-9)[stretch]
    height = scene.returns.height_m[rows]
    between = (height > (panel.low_m + _RIM_M)[stretch]) & (height < (panel.high_m - _RIM_M)[stretch])
    column = (along[between] * COLUMNS).astype(np.int64).clip(0, COLUMNS - 1)
    cell = stretch[between].astype(np.int64) * COLUMNS + column
    return np.bincount(cell, minlength=panel.returns.size * COLUMNS).reshape(-1, COLUMNS)
