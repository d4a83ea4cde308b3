"""Upright surfaces in stretches of a metre: their lines, their heights, and what passes through them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import cells_of, in_bins
from roadscan.assets.kernels.upright_voxels import beside_line, in_stretches, near_middles, passing_lines
from roadscan.assets.memory import once_a_scene
from roadscan.assets.quantiles import median, quantiles
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.kernels.stretches import count_about
from roadscan.assets.upright.regions import Region, fine_regions_of
from roadscan.assets.upright.slices import standing_above_m

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

STRETCH_M: Final = 1.0  # Length of a stretch (m).
_MOST_LINES: Final = 150_000
"""Sight lines that are compared with surfaces: every k-th return, so that there are no more."""
_HIGH_M: Final = 4.0
"""Sight lines through higher surfaces (m) are not counted."""
_BESIDE_M: Final = 0.2
"""Returns of a region up to this distance beside its line (m) make the surface."""
_RIM_M: Final = 0.08
"""Sight lines nearer than this to an edge of a surface (m) do not count."""
_ABOVE_GROUND_M: Final = 0.12
"""Sight lines below this height above the ground (m) do not tell whether the space below a surface is free."""
_OPEN_DEG: Final = 1.2  # The top of a surface is open within this angle of the highest beam (degrees).
_NEAR_M: Final = 3.0
"""Returns within this distance of its line (m) may belong to a surface."""
_ABOUT_M: Final = (0.15, 0.7, 0.15, 2.5)
"""Returns up to so far beside a surface lie on it, up to so far before or behind it; from so high to so high above its
upper edge they are above it (m): leaves of a hedge, floors of a house."""
_MOST_STEPS: Final = 12.0
"""Returns of a laser more firings apart than this do not follow one another on a surface."""
_CELL_M: Final = 1.0
"""Edge of the cells in which they are looked for (m)."""
_VEGETATION: Final = (classes.LOW_VEGETATION, classes.MEDIUM_VEGETATION, classes.HIGH_VEGETATION)


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
    """(k,) upper edge."""
    bulk_m: Float64
    """(k,) height below which 15 % of the returns lie: the posts of a guardrail have fewer."""
    returns: Int64
    """(k,)"""
    stopped: Int64
    """(k,) sight lines of the sample that end on it, between its edges; `passed` is the number of those through it
    there, and `under` of those between the ground and its lower edge. Lines that end before it are in none."""
    passed: Int64
    under: Int64
    open_top: npt.NDArray[np.bool_]
    """(k,) True where the highest laser still meets it: its top is not seen."""
    leafy: Int64
    """(k,) returns that are classed as vegetation, and …"""
    users: Int64
    """… as vehicles or people."""
    about: Float64
    """(k, 5) all returns on it, before it, behind it and above it, and the sum of the distances of those on it (m)."""
    beams: Float64
    """(k,) firings of each laser from its first return on the surface to its last, where these follow closely, and …"""
    missed: Float64
    """… those of them without a return on it: they passed, whether or not something stands behind."""
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
    highest = _highest_elevation_deg(scene)
    period_ns = _periods_ns(scene)
    panels = [_panel(scene, region, highest, period_ns) for region in fine_regions_of(scene)]
    return _with_sight(scene, [p for p in panels if p is not None])


def _highest_elevation_deg(scene: Scene) -> float:
    """Returns the elevation that hardly any sight line exceeds (degrees)."""
    returns = scene.returns
    if len(returns) == 0:
        return 90.0
    some = slice(None, None, max(1, len(returns) // _MOST_LINES))
    flat = np.hypot(returns.x_m[some] - returns.sensor_x_m[some], returns.y_m[some] - returns.sensor_y_m[some])
    rise = returns.height_m[some] - returns.sensor_height_m[some]
    return float(np.degrees(np.quantile(np.arctan2(rise, flat), 0.999)))


def _periods_ns(scene: Scene) -> Float64:
    """Returns the time between two firings of a laser (sensors,): most returns on the ground follow one another so."""
    returns, found = scene.returns, np.full(256, np.nan)
    for sensor in np.unique(returns.sensor).tolist():
        own = returns.sensor == sensor
        busiest = np.bincount(returns.laser[own]).argmax()
        gap = np.diff(np.sort(returns.epoch_gps_ns[own & (returns.laser == busiest)]))
        found[sensor] = np.median(gap[gap > 0]) if (gap > 0).any() else np.nan
    return found


def _missed(
    scene: Scene, rows: Int64, stretch: npt.NDArray[np.int32], count: int, period_ns: Float64
) -> tuple[Float64, Float64]:
    """Returns firings (count,) between successive returns of a laser on a surface, and those that missed it."""
    returns = scene.returns
    epoch, laser, sensor = returns.epoch_gps_ns[rows], returns.laser[rows], returns.sensor[rows]
    order = np.lexsort((epoch, laser, sensor))
    steps = np.rint(np.diff(epoch[order]) / period_ns[sensor[order[1:]]])
    same = (np.diff(laser[order].astype(np.int64)) == 0) & (np.diff(sensor[order].astype(np.int64)) == 0)
    same &= (steps >= 1.0) & (steps <= _MOST_STEPS)
    at, firings = stretch[order[1:]][same], steps[same]
    beams = np.bincount(at, firings, count).astype(np.float64)
    return beams, np.asarray(beams - np.bincount(at, minlength=count), np.float64)


def _panel(scene: Scene, region: Region, highest_deg: float, period_ns: Float64) -> Panel | None:
    returns, rows = scene.returns, region.rows
    beside = np.array([-region.along[1], region.along[0]])
    t, d, stretch = np.empty(rows.size), np.empty(rows.size), np.empty(rows.size, np.int32)
    beside_line(returns.x_m, returns.y_m, rows, region.middle_xy_m, region.along, t, d)
    begin, end = quantiles(t, [0.003, 0.997])
    count = max(1, round((end - begin) / STRETCH_M))
    edges = np.linspace(begin, end, count + 1)
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
    low, bulk, high = (np.full(count, np.nan) for _ in range(3))
    open_top = np.zeros(count, np.bool_)
    starts, order = in_bins(stretch, count)
    for k in range(count):
        own = rows[order[starts[k] : starts[k + 1]]]
        if own.size >= 4:
            heights = returns.height_m[own]
            low[k], bulk[k], high[k] = quantiles(heights, [0.02, 0.15, 0.98])
            top = own[np.argmax(heights)]
            flat = math.hypot(returns.x_m[top] - returns.sensor_x_m[top], returns.y_m[top] - returns.sensor_y_m[top])
            rise = float(returns.height_m[top] - returns.sensor_height_m[top])
            open_top[k] = math.degrees(math.atan2(rise, flat)) > highest_deg - _OPEN_DEG
    centre = (xy[:-1] + xy[1:]) / 2
    none = np.zeros(count, np.int64)
    sensor = float(np.mean(returns.sensor_x_m[rows])), float(np.mean(returns.sensor_y_m[rows]))
    leafy, users = (
        np.bincount(stretch[np.isin(scene.classes[rows], codes)], minlength=count)
        for codes in (_VEGETATION, (classes.VEHICLE, classes.PERSON))
    )
    return Panel(
        xy, scene.ground.height_at(centre[:, 0], centre[:, 1]), low, high, bulk,
        np.bincount(stretch, minlength=count), none, none, none, open_top, leafy, users, np.zeros((count, 5)),
        *_missed(scene, rows, stretch, count, period_ns), region.across_m,
        sensor, rows, stretch,
    )  # fmt: skip


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
    """Returns the panels with the numbers of sight lines that end on them and pass through, and of returns about them.

    Only low stretches of panels near the tile are counted.
    """
    returns = scene.returns
    step = max(1, -(-len(returns) // _MOST_LINES))
    some = slice(None, None, step)
    taken = np.zeros(len(returns), np.bool_)
    taken[some] = True
    asked = [(p.high_m - p.ground_m <= _HIGH_M) & p.comes_near(scene.tile) for p in panels]
    count = int(sum(a.sum() for a in asked))

    def lines(edges: Callable[[Panel], tuple[Float64, Float64]]) -> Int64:
        """Returns the sight lines through each stretch between two heights."""
        rectangles, found = _rectangles(panels, asked, edges), np.zeros(count, np.int64)
        passing_lines(
            returns.x_m[some], returns.y_m[some], returns.height_m[some], returns.sensor_x_m[some],
            returns.sensor_y_m[some], returns.sensor_height_m[some], rectangles, found,
        )  # fmt: skip
        return found

    passed = lines(lambda p: (p.low_m + _RIM_M, p.high_m - _RIM_M))
    under = lines(lambda p: (p.ground_m + _ABOVE_GROUND_M, p.low_m - _RIM_M))
    about = _about(scene, panels, asked)
    out, first = [], 0
    for p, own in zip(panels, asked, strict=True):
        height = returns.height_m[p.rows]
        between = (height > p.low_m[p.stretch] + _RIM_M) & (height < p.high_m[p.stretch] - _RIM_M)
        stopped = np.bincount(p.stretch[taken[p.rows] & between], minlength=own.size)
        last = first + int(own.sum())
        parts = [np.zeros((own.size, *v.shape[1:]), v.dtype) for v in (passed, under, about)]
        for part, values in zip(parts, (passed, under, about), strict=True):
            part[own] = values[first:last]
        out.append(replace(p, stopped=stopped, passed=parts[0], under=parts[1], about=parts[2]))
        first = last
    return out


def _rectangles(
    panels: list[Panel], asked: list[npt.NDArray[np.bool_]], edges: Callable[[Panel], tuple[Float64, Float64]]
) -> Float64:
    """Returns upright rectangles (s, 6) of the stretches asked for: both ends, lower and upper edge."""
    parts = [np.column_stack([p.xy_m[:-1], p.xy_m[1:], *edges(p)])[a] for p, a in zip(panels, asked, strict=True)]
    return np.concatenate([np.zeros((0, 6)), *parts])


def _about(scene: Scene, panels: list[Panel], asked: list[npt.NDArray[np.bool_]]) -> Float64:
    """Returns counts (s, 5) of the returns about the stretches asked for."""
    returns, window = scene.returns, scene.extent
    above = standing_above_m(scene)
    shape = (
        math.ceil((window.y_max_m - window.y_min_m) / _CELL_M),
        math.ceil((window.x_max_m - window.x_min_m) / _CELL_M),
    )
    grid = (window.x_min_m, window.y_min_m, _CELL_M)
    cell = np.where(np.isfinite(above), cells_of(returns.x_m, returns.y_m, grid, shape), -1)
    starts, order = in_bins(cell, shape[0] * shape[1])
    segments = _rectangles(panels, asked, lambda p: (p.low_m, p.high_m))
    sensor = np.concatenate([np.zeros((0, 2)), *(np.tile(p.seen_from_m, (int(a.sum()), 1))
                                                 for p, a in zip(panels, asked, strict=True))])  # fmt: skip
    way, there = segments[:, 2:4] - segments[:, :2], sensor - segments[:, :2]
    left = np.where(way[:, 0] * there[:, 1] - way[:, 1] * there[:, 0] > 0.0, 1.0, -1.0)
    counts = np.zeros((len(segments), 5))
    count_about(
        returns.x_m[order], returns.y_m[order], returns.height_m[order], starts, np.array([*grid, *shape]),
        np.column_stack([segments, left]), _ABOUT_M, counts,
    )  # fmt: skip
    return counts
