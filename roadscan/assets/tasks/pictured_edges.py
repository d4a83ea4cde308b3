"""Edges of the road between grey surfaces: pictures show where they lie, and intensities whether they are any."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import scipy.ndimage
import scipy.spatial
import shapely

from roadscan.assets.edges.line_pieces import cut_at
from roadscan.assets.edges.road_edges import EDGE_COLUMNS, EDGE_LINES
from roadscan.assets.green.areas import in_raster
from roadscan.assets.green.cells import CELL_M
from roadscan.assets.green.colours import FINE, FINE_M
from roadscan.assets.paint.brightness import BrightSums
from roadscan.assets.scene import Box
from roadscan.assets.tasks.pictured_paint import Window
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import SIGMA_OF_MAD, scatter_about

GREY_EDGES: Final = EDGE_LINES
"""Columns of a piece of an edge, as those that returns show."""
_LEAST: Final = 2
"""Pictures that must show a fine cell."""
_ALONG_M, _EVERY_M = 4.0, 0.25
"""Pictures are compared this far along the road on both sides of a station (m), each so many metres."""
_OFFSETS_M: Final = (1.3, 11.0)
"""An edge lies this far from the drive (m)."""
_STEP, _STEP_SIGMAS = 0.02, 3.0
"""Least step of the brightness at an edge (share), also over its σ …"""
_PERSISTENT: Final = 0.7
"""… share of the ways across that must show it …"""
_SHOWN: Final = 0.6
"""… and share of them that pictures must show."""
_MEANS: Final = 5  # Fine cells on each side whose brightness is compared; the nearest one is left out.
_BLUR: Final = 1.5  # 1 σ of the Gauss of Canny's edges (fine cells).
_LIDAR_M, _BLOCK_M = 4.0, 2.0
"""Intensities are compared this far along the road on both sides (m), and by blocks of this length (m)."""
_NEAR_M: Final = (0.18, 0.85)
"""Ground this far from the edge tells the intensity of a side (m, from and to) …"""
_FAR_M: Final = 1.5
"""… and that up to this far (m) is like it."""
_STRIP_M, _BEHIND_M = 3.75, 0.75
"""A patch or a lane is no wider than this (m): behind it the road goes on, which strips of the second width show."""
_CHANGE, _CHANGE_SIGMAS = 0.08, 4.0
"""Least step of the intensity (share), also over its σ."""
_FEWEST: Final = 4  # Cells that tell an intensity.
_BLOCKS: Final = 3  # Blocks that have to be known, and to show the step.
_LIKE: Final = 0.5
"""What differs by less than this share of the step is the same surface."""
_ROAD: Final = 0.35
"""So does the ground driven over from that beside the edge."""
_WORSE: Final = 9.0
"""An edge is none where intensities fit one beside it by so much better (χ²)."""
_RIVAL: Final = 100.0  # One that fits no worse than this (χ²), and is near, makes the place uncertain.
_SLACK_M, _MODEL = 0.1, 0.2
"""So far (m) returns of a ring may lie from the middle of a cell, and this share of the step is its model's 1 σ."""
_SAME_M: Final = 0.35  # Edges in pictures so near to one another (m) are compared.
_NEXT_M: Final = 5.0
"""The next node of an edge lies within this (m) …"""
_ASIDE_M: Final = 0.15  # … and so far aside at the most (m).
_SMOOTHED: Final = 5  # Nodes of the median of an edge's place.
_SHORTEST_M: Final = 3.0  # Shorter edges are none (m).
_DASHES_M, _PAINT_M = 8.0, 0.15
"""Where a line of paint that returns show runs along it, lanes of other asphalt meet: so far along, and aside (m)."""
_OFF_PX, _LEAST_M = 1.5, 0.02
"""1 σ of the place of an edge that is common to all pictures, in pixels: a mounting off by 0.15°; and its least (m)."""


class _Lidar(NamedTuple):
    """Cells (n,) whose intensity is known."""

    tree: Any
    xy: Float64
    intensity: Float64
    weight: Float64


class _Station(NamedTuple):
    """A place of the road's first drive."""

    x: float
    y: float
    heading: float
    bend: float
    """Change of the heading (rad/m)."""

    def at(self, along_m: Float64, right_m: Float64) -> tuple[Float64, Float64]:
        """Returns x and y of places along the drive's arc and to the right of it."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        turned = self.heading + self.bend * along_m
        left = 0.5 * self.bend * along_m**2
        return (self.x + along_m * cos - left * sin + right_m * np.sin(turned),
                self.y + along_m * sin + left * cos - right_m * np.cos(turned))  # fmt: skip

    def of(self, xy: Float64) -> tuple[Float64, Float64]:
        """Returns how far along and to the right of the arc places (n, 2) lie, near the station."""
        step, cos, sin = xy - (self.x, self.y), np.cos(self.heading), np.sin(self.heading)
        along = step[:, 0] * cos + step[:, 1] * sin
        return along, step[:, 0] * sin - step[:, 1] * cos + 0.5 * self.bend * along**2


class Node(NamedTuple):
    """A place of an edge."""

    x: float
    y: float
    heading: float
    sigma_m: float
    evidence: float
    """Step of the intensity over its σ."""


def grey_edges(sums: BrightSums, window: Window, box: Box, planted: Bool) -> pa.Table:
    """Returns rows of `GREY_EDGES`: edges that pictures show in a box of the window (m, from its corner).

    planted : (rows, columns) fine cells of green ground, whose intensity tells nothing of pavements.
    """
    level, pixel_m = level_of(sums, window)
    aside, heading = (window.rows[name].to_numpy().astype(np.float64) for name in ("aside_m", "heading_rad"))
    ground = window.ground
    xy = np.column_stack([(at + 0.5) * CELL_M - corner for at, corner in
                          zip((ground.column, ground.row), window.corner_m, strict=True)])  # fmt: skip
    number = window.rows["returns"].to_numpy()
    lawn = np.zeros(len(xy), np.bool_)
    lawn[window.cell] = planted[FINE // 2 :: FINE, FINE // 2 :: FINE][window.at]
    paved = ~lawn & ~ground.stands & (number > 0)
    stated = np.flatnonzero(np.isfinite(ground.intensity) & (ground.intensity > 0.0) & paved)
    if not stated.size or np.ptp(ground.intensity[stated]) == 0.0 or not np.isfinite(level).any():
        return GREY_EDGES.empty_table()
    lidar = _Lidar(
        scipy.spatial.cKDTree(xy[stated]), xy[stated], ground.intensity[stated], np.minimum(number[stated], 4.0)
    )
    found: dict[bool, list[Node]] = {False: [], True: []}
    beyond = _OFFSETS_M[1] + 2.0
    for station in _stations(xy, (ground.column, ground.row), aside, heading):
        inside = box.x_min_m - beyond < station.x < box.x_max_m + beyond
        if inside and box.y_min_m - beyond < station.y < box.y_max_m + beyond:
            for right in (False, True):
                node = node_at(station, right, (level, pixel_m), lidar, window.known.lines)
                found[right] += [] if node is None else [node]
    rows: list[dict[str, Any]] = []
    for right, nodes in found.items():
        for line in lines_of(nodes):
            rows += _rows(line, right, window, box)
    return pa.Table.from_pylist(rows, schema=GREY_EDGES)


def level_of(sums: BrightSums, window: Window) -> tuple[Float64, Float64]:
    """Returns the logarithm of the brightness of fine cells over that of the ground driven over, and pixels' sizes (m).

    NaN where less than two pictures show them.
    """
    weight, level, number = (
        in_raster(np.asarray(v[window.cell], np.float64), window.at, window.shape)
        for v in (sums.weight, sums.level, sums.number)
    )
    mean = level / np.maximum(weight, 1e-9)
    known = (number >= _LEAST) & (weight > 0.0)
    pixel_m = np.sqrt(np.maximum(number, 1.0) / np.maximum(weight, 1e-9))
    return np.where(known, np.log1p(np.maximum(mean, -0.9)), np.nan), np.where(known, pixel_m, np.nan)


def _stations(xy: Float64, cell: tuple[Int64, Int64], aside: Float64, heading: Float64) -> Iterator[_Station]:
    """Yields places of the drives, where these cross every other column of cells, or row: any window has the same."""
    cos, sin = np.abs(np.cos(heading)), np.abs(np.sin(heading))
    crosses = np.where(cos >= sin, cell[0] % 2, cell[1] % 2) == 0
    half = 0.5 * CELL_M * np.maximum(cos, sin)
    on = np.flatnonzero(crosses & (aside > 1e-5 - half) & (aside <= half + 1e-5))
    if not on.size:
        return
    turn = heading[on]
    foot = xy[on] - aside[on, None] * np.column_stack([np.sin(turn), -np.cos(turn)])
    for k, near in enumerate(scipy.spatial.cKDTree(foot).query_ball_point(foot, 2.0 * _ALONG_M)):
        chosen = np.array(near)
        change = np.angle(np.exp(1j * (turn[chosen] - turn[k])))
        along = (foot[chosen] - foot[k]) @ np.array([np.cos(turn[k]), np.sin(turn[k])])
        like = np.abs(change) < 0.6
        bend = float(along[like] @ change[like]) / max(float(along[like] @ along[like]), 1.0)
        yield _Station(float(foot[k, 0]), float(foot[k, 1]), float(turn[k]), bend)


class Step(NamedTuple):
    """A step of the brightness on ways across the road."""

    offset_m: float
    significance: float


def steps_across(level: Float64, first_m: float) -> list[Step]:
    """Returns steps of levels (ways, fine cells from `first_m` outward) that lie at one offset on most ways.

    After Canny (1986): the greatest slopes, along a Gauss, of the ways' median, over two thresholds.
    """
    known = np.isfinite(level)
    enough = known.mean(axis=0) >= _SHOWN
    total = np.cumsum(np.pad(np.where(known, level, 0.0), ((0, 0), (1, 0))), axis=1)
    count = np.cumsum(np.pad(known.astype(np.float64), ((0, 0), (1, 0))), axis=1)
    size = level.shape[1]
    border = np.arange(_MEANS + 1, size - _MEANS)  # between cells border - 1 and border
    sides = []
    for begin in (border - 1 - _MEANS, border + 1):
        n = count[:, begin + _MEANS] - count[:, begin]
        s = total[:, begin + _MEANS] - total[:, begin]
        sides.append(np.where(n >= _MEANS - 2, s / np.maximum(n, 1.0), np.nan))
    each = _means_along(sides[1] - sides[0])
    seen = np.isfinite(each)
    usable = (seen.mean(axis=0) >= _SHOWN) & (seen.sum(axis=0) >= 3) & enough[border] & enough[border - 1]
    if not usable.any():
        return []
    kept = np.flatnonzero(usable)
    step = np.full(border.size, np.nan)
    step[kept] = np.nanmedian(each[:, kept], axis=0)
    scatter = 1.2533 * SIGMA_OF_MAD * np.nanmedian(np.abs(each[:, kept] - step[kept]), axis=0)
    sigma = np.full(border.size, np.nan)
    sigma[kept] = np.hypot(scatter / np.sqrt(seen[:, kept].sum(axis=0)), 0.005)
    middle = np.full(size, np.nan)
    middle[enough] = np.nanmedian(level[:, enough], axis=0)
    filled = np.interp(np.arange(size), np.flatnonzero(enough), middle[enough])
    slope = scipy.ndimage.gaussian_filter1d(filled, _BLUR, order=1)
    slope = np.abs(0.5 * (slope[border - 1] + slope[border]))
    found = []
    for k in kept.tolist():
        if not (0 < k < border.size - 1) or slope[k] < slope[max(k - 2, 0) : k + 3].max():
            continue
        size_k = abs(step[k])
        if size_k < max(_STEP, _STEP_SIGMAS * sigma[k]):
            continue
        same = seen[:, k] & (each[:, k] * np.sign(step[k]) > 0.3 * size_k)
        if same.sum() < _PERSISTENT * seen[:, k].sum():
            continue
        a, b, c = slope[k - 1 : k + 2]
        shift = 0.5 * (a - c) / (a - 2 * b + c) if a - 2 * b + c < 0.0 else 0.0
        found.append(Step(first_m + (border[k] + float(np.clip(shift, -0.5, 0.5))) * FINE_M, float(size_k / sigma[k])))
    return found


def _means_along(values: Float64) -> Float64:
    """Returns means (blocks, n) of values (ways, n) over a metre of the road; NaN where less than half is known."""
    ways = round(1.0 / _EVERY_M)
    blocks = values[: len(values) // ways * ways].reshape(-1, ways, values.shape[1])
    known = np.isfinite(blocks)
    mean = np.where(known, blocks, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return np.where(known.sum(axis=1) >= ways / 2, mean, np.nan)


class Change(NamedTuple):
    """A step of the intensity at an edge that pictures show."""

    significance: float
    worse: float
    """By how much better an edge beside it fits (χ²)."""


def change_at(offset_m: float, along: Float64, away: Float64, intensity: Float64, weight: Float64) -> Change | None:
    """Returns the step of the intensities of cells (n,) at an offset; None where there is none that parts two surfaces.

    along, away : (n,) where the cells lie along the road from a station, and outward from the drive (m).
    """
    beyond = away - offset_m

    def middle(of: tuple[float, float], among: Bool | None = None) -> tuple[float, Float64]:
        chosen = (beyond >= of[0]) & (beyond < of[1])
        values = intensity[chosen if among is None else chosen & among]
        return (float(np.median(values)), values) if values.size >= _FEWEST else (np.nan, values)

    (near, n_near), (out, n_out) = middle((-_NEAR_M[1], -_NEAR_M[0])), middle(_NEAR_M)
    if not np.isfinite(near + out) or near <= 0.0:
        return None
    step = out - near
    each = []
    for begin in np.arange(-_LIDAR_M, _LIDAR_M, _BLOCK_M):
        chosen = (along >= begin) & (along < begin + _BLOCK_M)
        each.append(middle(_NEAR_M, chosen)[0] - middle((-_NEAR_M[1], -_NEAR_M[0]), chosen)[0])
    blocks = np.array(each)
    blocks = blocks[np.isfinite(blocks)]
    if blocks.size < _BLOCKS or (blocks * np.sign(step) < _LIKE * abs(step)).any():
        return None
    scatter = [1.2533 * scatter_about(v, float(np.median(v))) / np.sqrt(v.size) for v in (n_near, n_out)]
    sigma = max(float(np.hypot(*scatter)), float(blocks.std(ddof=1)) / np.sqrt(blocks.size), 1e-3 * near)
    if abs(step) < max(_CHANGE * near, _CHANGE_SIGMAS * sigma):
        return None
    far, farther = middle((-_FAR_M - 0.3, -_NEAR_M[1]))[0], middle((_NEAR_M[1], _FAR_M))[0]
    driven = float(np.median(intensity[np.abs(away) <= 1.0])) if (np.abs(away) <= 1.0).sum() >= _FEWEST else np.nan
    if any(abs(road - near) > _ROAD * abs(step) for road in (far, driven)):
        return None
    if (farther - near) * np.sign(step) < _LIKE * abs(step):
        return None
    for begin in np.arange(_FAR_M, _STRIP_M, _BEHIND_M):
        if abs(middle((begin, begin + _BEHIND_M))[0] - near) < _LIKE * abs(step):
            return None
    return Change(abs(step) / sigma, _worse(beyond, intensity, weight))


def _worse(beyond: Float64, intensity: Float64, weight: Float64) -> float:
    """Returns by how much better (χ²) two even surfaces fit whose edge lies elsewhere within half a metre."""
    kept = np.abs(beyond) <= 1.0
    x, y, w = beyond[kept], intensity[kept], weight[kept]
    low, high = (float(np.median(y[side])) for side in (x < -_NEAR_M[0], x > _NEAR_M[0]))
    rest = []
    shifts = np.arange(-10, 11) * FINE_M
    for shift in shifts:
        share = np.clip((x - shift) / CELL_M + 0.5, 0.0, 1.0)
        rest.append(y - low - share * (high - low))
    scatter = max(scatter_about(rest[10], 0.0), _MODEL * abs(high - low))
    loss = np.array([w @ np.minimum(np.square(r / scatter), 9.0) for r in rest]) / max(float(w.mean()), 1e-9)
    return float(loss[np.abs(shifts) < _SLACK_M + 1e-6].min() - loss.min())


def node_at(
    station: _Station, right: bool, mosaic: tuple[Float64, Float64], lidar: _Lidar, paint: shapely.Geometry
) -> Node | None:
    """Returns where the first edge on a side of a station lies that intensities bear out; None without one.

    mosaic : levels and sizes of pixels of :func:`level_of`.
    """
    (level, pixel_m), sign = mosaic, 1.0 if right else -1.0
    along = np.arange(-_ALONG_M, _ALONG_M + 1e-6, _EVERY_M)
    first = _OFFSETS_M[0] - (_MEANS + 1) * FINE_M
    away = np.arange(first, _OFFSETS_M[1], FINE_M) + FINE_M / 2
    x, y = station.at(along[:, None], sign * away)
    row, column = (np.floor(v / FINE_M).astype(np.int64) for v in (y, x))
    inside = (row >= 0) & (column >= 0) & (row < level.shape[0]) & (column < level.shape[1])
    cell = np.where(inside, row, 0), np.where(inside, column, 0)
    values = np.where(inside, level[cell], np.nan)
    shown = steps_across(values, first)
    if not shown:
        return None
    near = np.array(lidar.tree.query_ball_point([station.x, station.y], np.hypot(_OFFSETS_M[1], _LIDAR_M)), np.int64)
    near.sort()
    along, aside = station.of(lidar.xy[near])
    kept = np.abs(along) <= _LIDAR_M
    cells = along[kept], sign * aside[kept], lidar.intensity[near[kept]], lidar.weight[near[kept]]
    stated = [(step, change) for step in shown if (change := change_at(step.offset_m, *cells)) is not None]
    good = [one for one in stated if one[1].worse <= _WORSE]
    if not good:
        return None
    same = [one for one in good if one[0].offset_m <= good[0][0].offset_m + _SAME_M]
    step, change = min(same, key=lambda one: one[1].worse)
    rivals = [abs(one.offset_m - step.offset_m) for one, change_there in stated if change_there.worse <= _RIVAL]
    apart = max(gap for gap in rivals if gap <= _SAME_M)
    at_x, at_y = station.at(np.array([-_DASHES_M, 0.0, _DASHES_M]), np.full(3, sign * step.offset_m))
    if not paint.is_empty and shapely.distance(paint, shapely.LineString(np.column_stack([at_x, at_y]))) < _PAINT_M:
        return None
    near_m = pixel_m[cell][:, np.abs(away - step.offset_m) <= 2.0 * FINE_M]
    off_m = max(_OFF_PX * float(np.nanmedian(near_m)), _LEAST_M)
    return Node(float(at_x[1]), float(at_y[1]), station.heading, float(np.hypot(off_m, 0.5 * apart)),
                change.significance)  # fmt: skip


def lines_of(nodes: list[Node]) -> Iterator[Float64]:
    """Yields lines (n, 5) of nodes that follow one another: x, y, heading, σ (m) and evidence."""
    if len(nodes) < 3:
        return
    table = np.array(nodes)
    way = np.column_stack([np.cos(table[:, 2]), np.sin(table[:, 2])])
    after, before, pairs = {}, {}, []
    for i, near in enumerate(scipy.spatial.cKDTree(table[:, :2]).query_ball_point(table[:, :2], _NEXT_M)):
        for j in near:
            step = table[j, :2] - table[i, :2]
            mean = (way[i] + way[j]) / 2.0
            ahead, aside = float(step @ mean), float(step @ np.array([mean[1], -mean[0]]))
            if ahead > 0.25 and way[i] @ way[j] > 0.8 and abs(aside) <= min(_ASIDE_M, 0.05 + 0.3 * ahead):
                pairs.append((ahead, i, j))
    for _, i, j in sorted(pairs):
        if i not in after and j not in before:
            after[i], before[j] = j, i
    for start in sorted(set(range(len(table))) - set(before)):
        at = [start]
        while at[-1] in after:
            at.append(after[at[-1]])
        line = table[at]
        if len(line) >= 3 and np.hypot(*np.diff(line[:, :2], axis=0).T).sum() >= _SHORTEST_M:
            yield _smoothed(line)


def _smoothed(line: Float64) -> Float64:
    """Returns a line whose nodes lie on the median of their neighbours, across it, with their scatter in σ."""
    out = line.copy()
    half = _SMOOTHED // 2
    for k in range(len(line)):
        near = line[max(k - half, 0) : k + half + 1]
        right = np.array([np.sin(line[k, 2]), -np.cos(line[k, 2])])
        across = (near[:, :2] - line[k, :2]) @ right
        off = float(np.median(across))
        out[k, :2] += off * right
        out[k, 3] = np.hypot(line[k, 3], scatter_about(across, off))
    return out


def _rows(line: Float64, right: bool, window: Window, box: Box) -> Iterator[dict[str, Any]]:
    """Yields rows of the parts of a line in a box."""
    nodes = np.zeros((len(line), len(EDGE_COLUMNS)))
    nodes[:, 3:5] = np.nan
    cell = window.nearest(line[:, 0], line[:, 1])
    columns: dict[str, Any] = {
        "easting_m": line[:, 0], "northing_m": line[:, 1], "height_m": window.ground.height_m[cell],
        "sigma_m": line[:, 3], "seen": 1.0, "by_surface": 1.0, "right": float(right),
        "evidence": np.minimum(line[:, 4], 12.0) / 4.0,
    }  # fmt: skip
    for name, values in columns.items():
        nodes[:, EDGE_COLUMNS.index(name)] = values
    for part in cut_at(nodes, box):
        placed = part.nodes.copy()
        near = np.unique(window.nearest(placed[:, 0], placed[:, 1]))
        seen = window.rows.select(["returns", "passes", "first_epoch_gps_ns", "last_epoch_gps_ns"]).take(pa.array(near))
        placed[:, :2] += window.corner_m
        passes = sorted({one for some in seen["passes"].to_pylist() for one in some})
        yield {
            **{name: placed[:, k].tolist() for k, name in enumerate(EDGE_COLUMNS)},
            "returns": int(seen["returns"].to_numpy().sum()), "passes": passes,
            "first_epoch_gps_ns": int(seen["first_epoch_gps_ns"].to_numpy().min()),
            "last_epoch_gps_ns": int(seen["last_epoch_gps_ns"].to_numpy().max()),
            "cut_first": part.cut_first, "cut_last": part.cut_last,
        }  # fmt: skip
