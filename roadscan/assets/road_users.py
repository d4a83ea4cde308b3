"""Vehicles and people: those that move, and parked vehicles, which a judge tells from all else that stands about."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kernels import columns
from roadscan.assets.kernels import cubes as voxels
from roadscan.assets.moving import (
    BODY,
    CELL_M,
    LEVEL_M,
    TALL,
    Columns,
    columns_of,
    driven_cells,
    moving_cells,
    returns_of,
    sides_m,
    tracks,
)
from roadscan.assets.quantiles import quantiles
from roadscan.assets.scene import Box, Returns
from roadscan.assets.straight_lines import Lines, are_no_flanks, lines_of
from roadscan.assets.surroundings import Cubes
from roadscan.compute.array_types import Bool, Float64, Int32
from roadscan.core.extras import cv2

VEHICLE: Final = Judge("vehicle", "9028bd8bc57751fb")
"""Is a group of cells a vehicle, a part of one, or a row of them?"""
_LEAST: Final = 0.3
"""Probability from which a group is a vehicle: a car that is left over makes an asset that does not exist, and a bush
that is taken is only vegetation less."""
_LEAST_LEAFY: Final = 0.7
"""The same of a group of the size of a bush that scatters like leaves."""
_LEAST_CELLS: Final = 6
"""Smaller groups of cells (0.24 m²) are no vehicle."""
_BANDS: Final = ((1, 2), (2, 4), (4, 6), (6, 8), (8, 10), (10, 14), (14, 22))
"""Levels of the profile, each from the first up to the second: 0.2–0.4, 0.4–0.8 … 2.8–4.4 m."""
_CABIN_M: Final = 1.1
"""A cabin, or another part of a vehicle that is higher than most of it, is as long and as wide as this, or more (m)."""
_WAIST: Final = 6
"""Level above the body: 1.2 m."""
_COLUMN_LEVELS: Final = 8
"""A cell in which so many levels are seen is one of a column: a trunk's, a hedge's; a car's sides lean."""
_ROUNDS: Final = 3
"""Straight lines are sought so many times: a guard rail, a mesh and a wall may stand before one another."""
_PLANAR, _LEAFY = 0.5, 0.42
"""Planarity from which a cube is one of a surface, and scattering from which it is one of leaves."""
_BUSH_M: Final = 1.5
"""Groups longer than this (m) are as large as bushes; people are smaller."""
_STEEP, _LEVEL = 0.3, 0.9
"""Upward part of the normal of a surface: below the first it is upright, above the second level."""


class Users(NamedTuple):
    """Masks (n,) of the returns of road users."""

    vehicle: Bool
    person: Bool


class Bodies(NamedTuple):
    """Returns that may be those of parked vehicles."""

    returns: Returns
    above_m: npt.NDArray[np.float32]
    on_ground: Bool
    cubes: Cubes


class Groups(NamedTuple):
    """Connected cells of what stands on the ground and is not tall."""

    label: Int32
    """(rows, columns) number of the group; 0 of none."""
    number: npt.NDArray[np.int64]
    """(k,) the numbers of the groups that may be vehicles, ascending."""
    boxes: Int32
    """(k, 4) first column and row, columns, rows."""
    reached: Int32
    """(k,) level that nine tenths of a group's cells do not exceed."""
    features: dict[str, Float64]
    """(k,) by name."""


def road_users(
    returns: Returns, above_m: npt.NDArray[np.float32], on_ground: Bool, cubes: Cubes, window: Box,
    drive_xyh_m: Float64,
) -> Users:  # fmt: skip
    """Returns masks of vehicles and people among the returns that do not lie on the ground."""
    raster = columns_of(returns, above_m, on_ground, window)
    moving = moving_cells(raster) | driven_cells(raster, drive_xyh_m)
    vehicle, person = tracks(raster, moving)
    parked = parked_cells(raster, moving, Bodies(returns, above_m, on_ground, cubes))
    return Users(
        returns_of(np.where(parked > 0, parked, vehicle), raster, returns, above_m) & ~on_ground,
        returns_of(person, raster, returns, above_m) & ~on_ground,
    )


def parked_cells(raster: Columns, moving: Bool, bodies: Bodies) -> Int32:
    """Returns the level of parked vehicles, in their cells (rows, columns); 0 elsewhere.

    What stands beside cars may touch them: a vehicle with straight lines is judged once more without them, part by
    part, and again, since one line may hide the next.
    """
    groups = groups_of(raster, moving, bodies)
    is_vehicle = _are_vehicles(groups)
    apart = np.zeros(raster.top.shape, np.bool_)
    for _ in range(_ROUNDS):
        lines = lines_in(groups, is_vehicle, raster)
        if not (others := are_no_flanks(lines)).any():
            break
        mask = lines.mask(others, apart.shape).view(np.uint8)
        apart |= cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0  # a mesh scatters into the next cells
        groups = groups_of(raster, moving, bodies, apart)
        is_vehicle = _are_vehicles(groups)
    found = np.zeros(raster.top.shape, np.int32)
    for k in np.flatnonzero(is_vehicle).tolist():
        part = _part(groups.boxes[k], 3)
        label, reached = groups.label[part], int(groups.reached[k])
        inside = label == groups.number[k]
        wider = cv2.dilate(inside.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        wider &= (label == 0) | inside
        wider &= raster.top[part] <= reached + 1  # what is taller stands beside it
        found[part][wider] = np.maximum(found[part][wider], reached + 1)
        upper, highest = _upper_part(raster.levels[part], label == 0, wider)
        found[part][upper] = np.maximum(found[part][upper], highest[upper] + 1)
    return found


def _are_vehicles(groups: Groups) -> Bool:
    """Returns which groups (k,) are vehicles."""
    if not groups.number.size:
        return np.zeros(0, np.bool_)
    is_bush = (groups.features["scattering"] > _LEAFY) & (groups.features["length_m"] > _BUSH_M)
    return VEHICLE.probability(groups.features) >= np.where(is_bush, _LEAST_LEAFY, _LEAST)


def lines_in(groups: Groups, which: Bool, raster: Columns) -> Lines:
    """Returns the straight lines in some of the groups; which : (k,)."""
    cells = []
    for k in np.flatnonzero(which).tolist():
        part = _part(groups.boxes[k], 0)
        cells.append((groups.label[part] == groups.number[k], part[0].start, part[1].start))
    return lines_of(cells, raster)


def _upper_part(levels: npt.NDArray[np.uint32], free: Bool, body: Bool) -> tuple[Bool, Int32]:
    """Returns the cells (rows, columns) of what is higher than the body of a vehicle and belongs to it, and its level.

    The ends of a cabin rise behind a bonnet: nothing of them is seen at the height of the body. They belong to it where
    they touch it and are as wide and long as a cabin; a post and a plate beside a car are narrower.
    """
    highest = np.frexp(levels.astype(np.float64))[1].astype(np.int32) - 1
    upper = free & ((levels & np.uint32(BODY)) == 0) & (highest >= _WAIST) & (highest < TALL)
    _, label = cv2.connectedComponents(upper.view(np.uint8), connectivity=8)
    near = cv2.dilate(body.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    touching = np.unique(label[near & upper]).tolist()
    return np.isin(label, [k for k in touching if min(sides_m(label == k)) >= _CABIN_M]), highest


def groups_of(raster: Columns, moving: Bool, bodies: Bodies, apart: Bool | None = None) -> Groups:
    """Returns the groups of a window, with their features: lengths in metres, shares of cells and of returns.

    None of them counts returns, so that they mean the same for any scanner and any number of passes. Cells that are set
    apart (rows, columns) belong to none.
    """
    low = (raster.top >= 1) & (raster.top < TALL) & ~moving
    body = low & ((raster.levels & np.uint32(BODY)) > 0)
    held = body if apart is None else body & ~apart
    count, label, boxes, _ = cv2.connectedComponentsWithStats(held.view(np.uint8), connectivity=8)
    label[body & ~held] = count
    number = 1 + np.flatnonzero(boxes[1:count, cv2.CC_STAT_AREA] >= _LEAST_CELLS)
    tall = (raster.top >= TALL) & ~moving
    beside = cv2.dilate(tall.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    plan = [_plan_of(raster, label, int(k), _part(boxes[k], 3)) for k in number]
    features = {name: np.array([one[name] for one in plan]) for name in (plan[0] if plan else ())}
    area = boxes[number, cv2.CC_STAT_AREA].astype(np.float64)
    features["tall_beside"] = np.bincount(label[beside], minlength=count)[number] / area
    features |= {
        name: values[number] for name, values in _scatter(label.astype(np.int32), raster, bodies, count + 1).items()
    }
    reached = features.pop("reached", np.zeros(0)).astype(np.int32)
    return Groups(label, number, boxes[number, :4], reached, features)


def _part(box: npt.NDArray[np.int32], more: int) -> tuple[slice, slice]:
    """Returns the part of a raster about a box, so many cells wider."""
    left, lower, width, height = map(int, box[:4])
    return slice(max(lower - more, 0), lower + height + more), slice(max(left - more, 0), left + width + more)


def _plan_of(raster: Columns, label: Int32, number: int, part: tuple[slice, slice]) -> dict[str, float]:
    """Returns the features of a group that its cells show."""
    inside = label[part] == number
    levels, top = raster.levels[part][inside], raster.top[part][inside]
    cells, grounds = float(levels.size), np.asarray(raster.grounds[part].any(axis=-1))
    length_m, width_m = sides_m(inside)
    seen = [(levels & np.uint32((1 << last) - (1 << first))) > 0 for first, last in _BANDS]
    at_body, at_windows = seen[1] | seen[2], seen[4] | seen[5]
    in_column = np.bitwise_count(levels & np.uint32((1 << TALL) - 2)) >= _COLUMN_LEVELS
    at_top = np.zeros(inside.shape, np.bool_)
    at_top[inside] = at_windows
    upper_m = sides_m(at_top) if at_top.any() else (0.0, 0.0)
    reached = quantiles(top, [0.1, 0.5, 0.9, 1.0])
    low, middle, high, highest = ((level + 1.0) * LEVEL_M for level in reached)
    return {
        "reached": float(int(reached[2]) + 1),
        "length_m": length_m, "width_m": width_m, "top_m": high, "middle_top_m": middle, "low_top_m": low,
        "highest_m": highest, "fill": cells * CELL_M**2 / (length_m * width_m),
        "ground_around": ground_around(inside, grounds),
        "ground_within": float(np.mean(grounds[inside])),
        **{f"from_{first * 2}_dm": float(np.mean(one)) for (first, _), one in zip(_BANDS, seen, strict=True)},
        "windows_to_body": float(np.count_nonzero(at_windows)) / max(int(np.count_nonzero(at_body)), 1),
        "upper_length_m": upper_m[0], "upper_width_m": upper_m[1], "in_columns": float(np.mean(in_column)),
        "levels_seen": float(np.mean(np.bitwise_count(levels & np.uint32((1 << TALL) - 2)) / np.maximum(top, 1))),
        "enclosed": _enclosed(inside),
    }  # fmt: skip


def _enclosed(inside: Bool) -> float:
    """Returns the share of the cells of a group whose eight neighbours belong to it: 0 of thin, branched groups."""
    return float(cv2.erode(inside.view(np.uint8), np.ones((3, 3), np.uint8)).sum() / np.count_nonzero(inside))


def ground_around(inside: Bool, ground: Bool) -> float:
    """Returns the share of the cells in a ring about some cells (rows, columns) in which ground was seen."""
    near = cv2.dilate(inside.view(np.uint8), np.ones((3, 3), np.uint8))
    ring = cv2.dilate(inside.view(np.uint8), np.ones((7, 7), np.uint8)) > near
    return float(np.count_nonzero(ground & ring)) / float(max(int(np.count_nonzero(ring)), 1))


def _scatter(label: Int32, raster: Columns, bodies: Bodies, count: int) -> dict[str, Float64]:
    """Returns means (count,) over the cubes of each group: of their scatter, and of what shows the way surfaces face.

    A cube counts once, however many returns it has.
    """
    at = np.empty(len(bodies.returns), np.int32)
    lowest, highest = np.full(count, LEVEL_M), np.full(count, TALL * LEVEL_M)
    x, y = bodies.returns.x_m, bodies.returns.y_m
    columns.marked(x, y, bodies.above_m, raster.grid.origin, 1.0 / CELL_M, label, lowest, highest, at)
    number = bodies.cubes.number
    chosen = (at > 0) & ~bodies.on_ground & (number >= 0)
    pairs = np.unique(at[chosen].astype(np.int64) * (1 << 32) + number[chosen])
    group, cube = pairs >> 32, pairs & ((1 << 32) - 1)
    features = bodies.cubes.features[cube].astype(np.float64)
    total = np.bincount(group, minlength=count)

    def mean(values: Float64) -> Float64:
        sums = np.bincount(group, weights=values, minlength=count)
        return np.asarray(np.divide(sums, total, out=np.full(count, np.nan), where=total > 0))

    planar = (features[:, voxels.PLANARITY] > _PLANAR).astype(np.float64)
    up = features[:, voxels.NORMAL_UP]
    return {
        "scattering": mean(features[:, voxels.SCATTERING]), "planarity": mean(features[:, voxels.PLANARITY]),
        "linearity": mean(features[:, voxels.LINEARITY]), "thickness": mean(features[:, voxels.THICKNESS]),
        "upright": mean(planar * (up < _STEEP)), "level": mean(planar * (up > _LEVEL)),
        "slanting": mean(planar * (up >= _STEEP) * (up <= _LEVEL)),
        "leafy": mean((features[:, voxels.SCATTERING] > _LEAFY) * 1.0),
    }  # fmt: skip
