"""Upright surfaces in stretches of a metre: their lines, their heights, and what passes through them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets import classes
from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.upright_voxels import beside_line, in_stretches, near_middles, passing_lines
from roadscan.assets.memory import once_a_scene
from roadscan.assets.quantiles import median, quantiles
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.regions import Region, regions_of

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
    across_m: float
    vegetation: float
    """Share of its returns that are classed as vegetation."""
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
    panels = [_panel(scene, region, highest) for region in regions_of(scene)]
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


def _panel(scene: Scene, region: Region, highest_deg: float) -> Panel | None:
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
    vegetation = float(np.bincount(scene.classes[rows], minlength=256)[list(_VEGETATION)].sum() / rows.size)
    return Panel(
        xy, scene.ground.height_at(centre[:, 0], centre[:, 1]), low, high, bulk,
        np.bincount(stretch, minlength=count), none, none, none, open_top, region.across_m, vegetation, sensor, rows,
        stretch,
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
    """Returns the panels with the numbers of sight lines that end on them, and that pass through."""
    returns = scene.returns
    step = max(1, -(-len(returns) // _MOST_LINES))
    some = slice(None, None, step)
    taken = np.zeros(len(returns), np.bool_)
    taken[some] = True
    low = [p.comes_near(scene.tile) and _is_low(p) for p in panels]
    known = [p for p, asked in zip(panels, low, strict=True) if asked]

    lines = np.concatenate([np.zeros((0, 4)), *(np.column_stack([p.xy_m[:-1], p.xy_m[1:]]) for p in known)])
    bands = np.concatenate([np.zeros((0, 4)), *(
        np.column_stack([p.low_m + _RIM_M, p.high_m - _RIM_M, p.ground_m + _ABOVE_GROUND_M, p.low_m - _RIM_M])
        for p in known
    )])  # fmt: skip
    found = np.zeros((len(lines), 2), np.int64)
    passing_lines(
        returns.x_m[some], returns.y_m[some], returns.height_m[some], returns.sensor_x_m[some],
        returns.sensor_y_m[some], returns.sensor_height_m[some], lines, bands.reshape(-1, 2, 2), found,
    )  # fmt: skip
    passed, under = found.T
    out, first = [], 0
    for p, asked in zip(panels, low, strict=True):
        count = p.returns.size
        height = returns.height_m[p.rows]
        between = (height > p.low_m[p.stretch] + _RIM_M) & (height < p.high_m[p.stretch] - _RIM_M)
        stopped = np.bincount(p.stretch[taken[p.rows] & between], minlength=count)
        own = slice(first, first + count) if asked else slice(0, 0)
        none = np.zeros(0 if asked else count, np.int64)
        out.append(replace(p, stopped=stopped, passed=np.append(passed[own], none), under=np.append(under[own], none)))
        first += count if asked else 0
    return out


def _is_low(panel: Panel) -> bool:
    """Returns whether sight lines through a surface are counted."""
    above = panel.high_m - panel.ground_m
    known = above[np.isfinite(above)]
    return known.size > 0 and float(np.median(known)) <= _HIGH_M
