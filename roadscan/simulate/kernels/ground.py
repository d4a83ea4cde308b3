"""Finds where a beam first meets the road: a map of cells with height bounds, and the search within a cell.

A cell knows a plane near which its ground lies, how far the ground reaches above it, and how strongly it bends. Beams
above the bound pass on without looking; where the bend allows it, a root of the clearance is known to be the first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float32, Float64, Int32, UInt8
from roadscan.simulate.kernels.beams import along_beam, clearance
from roadscan.simulate.kernels.options import compiled, inner
from roadscan.simulate.kernels.road import (
    DEFECTS,
    DEFECTS_END,
    KERB_FACE,
    KERB_LEFT,
    KERB_RIGHT,
    PATCHES,
    PATCHES_END,
    PAVED_EDGE,
    STATION,
    RoadArrays,
    clothoid,
    defect_depth,
    edge_distance,
    node_at,
    patch_height,
    project,
    smooth_step,
    worn_height,
)

CELL_M = 1.0
"""Side of a cell of the map (m)."""
TILE_CELLS = 32
"""Cells along a tile's side."""
TILE_M = CELL_M * TILE_CELLS
SAMPLE_M = 0.1
"""Distance of the samples from which the bounds are made (m)."""
WITHIN_M = 0.11
"""A sample counts for the cells within this distance (m): more than half the diagonal between samples."""
SLACK_M = 0.003
"""Margin of the bounds (m) for the ground between samples and the map's bend along a beam."""

GROUND, STEEP, EDGE = 1, 2, 4
"""Flags of a cell: it has ground; kerb faces or edges of patches; the surface's edge."""
GAP_TOLERANCE_M = 1e-7
"""Largest distance of a beam's end from the surface (m), along the height."""
LAST_STEP_M = 1e-5
"""Largest last step along the beam without a check (m)."""
UNSEEN_M = 1e-5
"""Largest height of a crest that a beam may cut off (m)."""
STRIDE_M = 0.25
"""Longest step of the search along a beam, seen from above (m)."""
KERB_BEND = 6.0
"""Largest second derivative of the cubic step from 0 to 1."""
HOLE_SLOPE = 2.5
"""Upper limit of wall slope over depth / radius, of potholes and cracks: 2.42 for potholes."""


class Cells(NamedTuple):
    """The map in tiles of 32 × 32 cells of a metre, stored where there is road or a body."""

    corner: Float64
    """(2,) easting and northing of the first tile's corner."""
    tiles: Int32
    """(ty, tx) number of the tile, −1: empty."""
    top: Float64
    """(t,) upper limit of everything in a tile (m)."""
    plane: Float32
    """(t · 1024, 5) height at the cell's middle, rise to the east and to the north (m/m), how far the ground reaches
    above that plane (m), its curvature at most (1/m)."""
    flags: UInt8
    """(t · 1024,)"""
    node: Int32
    """(t · 1024,) node of the road near it."""
    first: Int32
    """(t · 1024 + 1,) first body of each cell in `members`."""
    members: Int32
    """(m,) bodies, cell by cell."""


# --- bounds ------------------------------------------------------------------------------------------


@compiled
def bound_cells(road: RoadArrays, cells: Cells, station: Float64, offset: Float64, plain: Float64) -> None:
    """Raise the bounds of the cells under samples of the road.

    station : (s,) evenly spaced, offset : (o,) evenly spaced; the outermost of both only serve for differences;
    plain : (s, o) scratch.
    """
    step_s, step_o = station[1] - station[0], offset[1] - offset[0]
    first_m, last_m = road.nodes[0, STATION], road.nodes[road.nodes.shape[0] - 1, STATION]
    edge_m = offset[offset.size - 2]
    for i in range(station.size):
        k = node_at(road, station[i])
        for j in range(offset.size):
            u = station[i] - road.nodes[k, STATION]
            plain[i, j] = worn_height(road, k, u, offset[j]) - steps_height(road, k, u, offset[j])
    for i in range(1, station.size - 1):
        k = node_at(road, station[i])
        u = station[i] - road.nodes[k, STATION]
        along, right, sine, cosine = clothoid(road.nodes[k, 4], road.nodes[k, 5], u)
        s, c = road.nodes[k, 2], road.nodes[k, 3]
        sin_here, cos_here = s * cosine + c * sine, c * cosine - s * sine
        at_end = station[i] < first_m + 0.5 * step_s or station[i] > last_m - 0.5 * step_s
        for j in range(1, offset.size - 1):
            easting = road.nodes[k, 0] + along * s + right * c + offset[j] * cos_here
            northing = road.nodes[k, 1] + along * c - right * s - offset[j] * sin_here
            height = plain[i, j] + steps_height(road, k, u, offset[j])
            ss = (plain[i + 1, j] - 2.0 * plain[i, j] + plain[i - 1, j]) / (step_s * step_s)
            oo = (plain[i, j + 1] - 2.0 * plain[i, j] + plain[i, j - 1]) / (step_o * step_o)
            so = plain[i + 1, j + 1] - plain[i + 1, j - 1] - plain[i - 1, j + 1] + plain[i - 1, j - 1]
            so /= 4.0 * step_s * step_o
            # A line that is straight in the map bends in road coordinates by the road's curvature.
            slope = (plain[i, j + 1] - plain[i, j - 1]) / (2.0 * step_o)
            bend = math.sqrt(ss * ss + oo * oo + 2.0 * so * so) + abs(slope * road.nodes[k, 4])
            flags = GROUND
            if is_near_steps(road, k, u, offset[j], WITHIN_M):
                flags |= STEEP
            if at_end or abs(offset[j]) > edge_m - 0.5 * step_o:
                flags |= EDGE
            raise_bounds(road, cells, easting, northing, height, 1.5 * bend + 0.02, flags, k)


@inner
def raise_bounds(
    road: RoadArrays,
    cells: Cells,
    easting: float,
    northing: float,
    height: float,
    bend: float,
    flags: int,
    near: int,
) -> None:
    """Apply one sample to its cell, and to those within :data:`WITHIN_M`."""
    x, y = easting - cells.corner[0], northing - cells.corner[1]
    for ci in range(int((x - WITHIN_M) / CELL_M), int((x + WITHIN_M) / CELL_M) + 1):
        for cj in range(int((y - WITHIN_M) / CELL_M), int((y + WITHIN_M) / CELL_M) + 1):
            tile = cells.tiles[cj // TILE_CELLS, ci // TILE_CELLS]
            index = (tile * TILE_CELLS + cj % TILE_CELLS) * TILE_CELLS + ci % TILE_CELLS
            middle_e = cells.corner[0] + (ci + 0.5) * CELL_M
            middle_n = cells.corner[1] + (cj + 0.5) * CELL_M
            if cells.flags[index] == 0:
                lay_plane(road, cells, index, middle_e, middle_n, near)
            plane = cells.plane
            level = plane[index, 0] + plane[index, 1] * (easting - middle_e) + plane[index, 2] * (northing - middle_n)
            # Half the diagonal between samples is 0.1 m at most: the ground bends up by less than this over it.
            room = height - level + SLACK_M + 0.005 * bend
            plane[index, 3] = max(plane[index, 3], room)
            plane[index, 4] = max(plane[index, 4], bend)
            cells.flags[index] |= flags
            highest = level + plane[index, 3] + CELL_M * (abs(plane[index, 1]) + abs(plane[index, 2]))
            cells.top[tile] = max(cells.top[tile], highest)


@inner
def lay_plane(road: RoadArrays, cells: Cells, index: int, easting: float, northing: float, near: int) -> None:
    """Fit a cell's plane to the ground around its centre."""
    reach = 0.35 * CELL_M
    k, _, _ = project(road, easting, northing, near)
    cells.node[index] = k
    east0, east1, north0, north1 = 0.0, 0.0, 0.0, 0.0
    for side in range(4):
        move = reach if side % 2 else -reach
        n, v, aside = project(road, easting + (move if side < 2 else 0.0), northing + (0.0 if side < 2 else move), k)
        height = worn_height(road, n, v, aside)
        if side == 0:
            east0 = height
        elif side == 1:
            east1 = height
        elif side == 2:
            north0 = height
        else:
            north1 = height
    cells.plane[index, 0] = 0.25 * (east0 + east1 + north0 + north1)
    cells.plane[index, 1] = (east1 - east0) / (2.0 * reach)
    cells.plane[index, 2] = (north1 - north0) / (2.0 * reach)
    cells.plane[index, 3] = -np.inf
    cells.plane[index, 4] = 0.0


@inner
def kerb_height(road: RoadArrays, k: int, u: float, offset: float) -> float:
    """Return the height of the kerb on this side (m); 0: none."""
    column = KERB_RIGHT if offset > 0.0 else KERB_LEFT
    value: float = road.nodes[k, column] + u * road.nodes[k, column + 1]
    return value


@inner
def steps_height(road: RoadArrays, k: int, u: float, offset: float) -> float:
    """Return the height that kerbs and patches add (m)."""
    section, patches = road.section, road.patches
    height = 0.0
    away = abs(offset) - section[PAVED_EDGE]
    if away > 0.0:
        height += kerb_height(road, k, u, offset) * smooth_step(away / section[KERB_FACE])
    station = road.nodes[k, STATION] + u
    for i in range(int(road.nodes[k, PATCHES]), int(road.nodes[k, PATCHES_END])):
        inward = edge_distance(patches, i, station, offset)
        if inward > 0.0:
            height += patch_height(patches, i, station) * smooth_step(inward * patches[i, 6])
    return height


@inner
def is_near_steps(road: RoadArrays, k: int, u: float, offset: float, reach: float) -> bool:
    """Return whether a kerb's face or the edge of a patch is within reach."""
    section, patches = road.section, road.patches
    away = abs(offset) - section[PAVED_EDGE]
    if kerb_height(road, k, u, offset) > 0.0 and -reach <= away <= section[KERB_FACE] + reach:
        return True
    station = road.nodes[k, STATION] + u
    near = False
    for n in range(max(k - 1, 0), min(k + 2, road.nodes.shape[0] - 1)):
        for i in range(int(road.nodes[n, PATCHES]), int(road.nodes[n, PATCHES_END])):
            inward = edge_distance(patches, i, station, offset)
            near = near or -reach <= inward <= 1.0 / patches[i, 6] + reach
    return near


# --- search ------------------------------------------------------------------------------------------


@inner
def steps_between(
    road: RoadArrays, k0: int, u0: float, offset0: float, k1: int, u1: float, offset1: float, level: float
) -> tuple[float, float]:
    """Return curvature (1/m) and rise (m) that kerb faces and patches may add between two nearby points.

    level : their distance seen from above.
    """
    section, patches = road.section, road.patches
    bend, rise = 0.0, 0.0
    low, high = min(offset0, offset1) - 0.001, max(offset0, offset1) + 0.001
    inner, outer = section[PAVED_EDGE], section[PAVED_EDGE] + section[KERB_FACE]
    for side in range(2):
        if (high > inner and low < outer) if side == 0 else (low < -inner and high > -outer):
            aside = 1.0 if side == 0 else -1.0
            kerb = max(kerb_height(road, k0, u0, aside), kerb_height(road, k1, u1, aside))
            bend = max(bend, KERB_BEND * kerb / (section[KERB_FACE] * section[KERB_FACE]))
            rise = max(rise, kerb)
    station = road.nodes[k0, STATION] + u0
    for end in range(1 if k0 == k1 else 2):
        k = k0 if end == 0 else k1
        for i in range(int(road.nodes[k, PATCHES]), int(road.nodes[k, PATCHES_END])):
            inward = edge_distance(patches, i, station, offset0)
            if -level < inward < 1.0 / patches[i, 6] + level:
                bend += KERB_BEND * abs(patches[i, 5]) * patches[i, 6] * patches[i, 6]
                rise += abs(patches[i, 5])
    return bend, rise


@inner
def first_ground(
    road: RoadArrays,
    cells: Cells,
    index: int,
    middle_e: float,
    middle_n: float,
    beam: Float64,
    begin: float,
    end: float,
) -> tuple[float, int, float, float]:
    """Return range, node, u and offset where a beam first meets the ground of a cell between two ranges; NaN: never.

    −1: the beam comes from below the ground. The surface here is the one without potholes, cracks and joints, and it
    goes on beyond its edges.
    """
    plane = cells.plane
    k = int(np.int64(cells.node[index]))
    x0, x1 = along_beam(beam, 0, begin) - middle_e, along_beam(beam, 0, end) - middle_e
    y0, y1 = along_beam(beam, 1, begin) - middle_n, along_beam(beam, 1, end) - middle_n
    east, north, room, bend = plane[index, 1], plane[index, 2], plane[index, 3], plane[index, 4]
    over0 = along_beam(beam, 2, begin) - (plane[index, 0] + east * x0 + north * y0)
    over1 = along_beam(beam, 2, end) - (plane[index, 0] + east * x1 + north * y1)
    if over0 > room and over1 > room:
        return np.nan, k, 0.0, 0.0
    start = begin if over0 <= room else begin + (end - begin) * (over0 - room) / (over0 - over1)
    level = math.hypot(x1 - x0, y1 - y0) / (end - begin)
    if cells.flags[index] == GROUND and over0 >= 0.0 >= over1 and over0 > over1:
        fall = (over0 - over1) / (end - begin)
        r, found_fall, k, u, offset = chased(road, beam, begin + over0 / fall, fall, k)
        # Before the root the clearance is at least fall · y − bend · y² / 2, y metres of range before it.
        if begin - 1e-9 <= r <= end and 1.9 * found_fall > bend * level * level * (r - start):
            return r, k, u, offset
    return searched(road, beam, start, end, bend, level, k)


@inner
def chased(
    road: RoadArrays, beam: Float64, guess: float, fall: float, near: int
) -> tuple[float, float, int, float, float]:
    """Return range, fall of the clearance, node, u and offset where a beam meets the ground, by the secant method.

    NaN where the secant does not settle. fall : loss of clearance per metre of range at first.
    """
    k, u, offset = near, 0.0, 0.0
    r, last_gap, moved = guess, 0.0, 0.0
    least = 0.3 * fall
    for _ in range(6):
        gap, k, u, offset = clearance(road, beam, r, k)
        is_known = abs(moved) > 1e-5
        if is_known:
            fall = (last_gap - gap) / moved
            if fall < least:
                break
        last_gap = gap
        moved = gap / fall
        r += moved
        # The secant's slope is right to a hundredth, and so is a last step.
        if abs(gap) < GAP_TOLERANCE_M or (is_known and abs(moved) < LAST_STEP_M):
            return r, fall, k, u, offset
    return np.nan, fall, k, u, offset


@inner
def searched(
    road: RoadArrays, beam: Float64, start: float, end: float, bend: float, level: float, near: int
) -> tuple[float, int, float, float]:
    """Return the same for any ground, step by step: steps are limited by the bend of the ground.

    bend : curvature of the ground, kerb faces and patches left out (1/m); level : metres seen from above per metre of
    range.
    """
    a = start
    gap_a, k, u, offset = clearance(road, beam, a, near)
    if gap_a <= 0.0:  # a root on the border between two cells
        a = max(start - 0.05, 0.0)
        gap_a, k, u, offset = clearance(road, beam, a, k)
        if gap_a <= 0.0:
            return -1.0, k, u, offset
    flat = max(level, 1e-9)
    longest = STRIDE_M / flat
    step = min(longest, max(end - a, 1e-9))
    for _ in range(20_000):
        if a >= end:
            break
        b = min(a + step, end)
        gap_b, k_b, u_b, offset_b = clearance(road, beam, b, k)
        span = flat * (b - a)
        more, rise = steps_between(road, k, u, offset, k_b, u_b, offset_b, span)
        arch = 0.125 * bend * span * span
        arch = min(arch + 0.125 * more * span * span, arch + rise)
        if gap_b <= 0.0:
            is_falling = (gap_a - gap_b) >= (bend + more) * span * span
            if is_falling or arch < UNSEEN_M:
                return between_signs(road, beam, a, gap_a, b, gap_b, k)
        elif min(gap_a, gap_b) > arch or arch < UNSEEN_M:
            a, gap_a, k, u, offset = b, gap_b, k_b, u_b, offset_b
            step = min(2.0 * step, longest)
            continue
        step = 0.5 * (b - a)
    return np.nan, k, u, offset


@inner
def between_signs(
    road: RoadArrays, beam: Float64, low: float, low_gap: float, high: float, high_gap: float, near: int
) -> tuple[float, int, float, float]:
    """Return the root of the clearance between ranges of opposite signs: Illinois method (Dowell and Jarratt 1971)."""
    r, k, u, offset = high, near, 0.0, 0.0
    side = 0
    for _ in range(100):
        r = (low * high_gap - high * low_gap) / (high_gap - low_gap)
        gap, k, u, offset = clearance(road, beam, r, k)
        if abs(gap) < GAP_TOLERANCE_M or high - low < 1e-9:
            break
        if gap > 0.0:
            low, low_gap = r, gap
            if side == 1:
                high_gap *= 0.5
            side = 1
        else:
            high, high_gap = r, gap
            if side == -1:
                low_gap *= 0.5
            side = -1
    return r, k, u, offset


# --- potholes, cracks, joints --------------------------------------------------------------------------


@inner
def hole_clearance(road: RoadArrays, beam: Float64, r: float, near: int) -> tuple[float, float, int, float, float]:
    """Return height of a beam's point above the floor, depth of the floor, node, u and offset."""
    k, u, offset = project(road, along_beam(beam, 0, r), along_beam(beam, 1, r), near)
    depth, _ = defect_depth(road, k, u, offset)
    return along_beam(beam, 2, r) - worn_height(road, k, u, offset) + depth, depth, k, u, offset


@inner
def steepest(road: RoadArrays, k: int, offset: float) -> float:
    """Return the largest slope of the ground near a node: defects' walls, a kerb's face, edges of patches (m/m)."""
    section, nodes, defects, patches = road.section, road.nodes, road.defects, road.patches
    slope = 0.0
    for n in range(max(k - 1, 0), min(k + 2, nodes.shape[0] - 1)):
        for i in range(int(nodes[n, DEFECTS]), int(nodes[n, DEFECTS_END])):
            slope = max(slope, HOLE_SLOPE * defects[i, 1] * max(defects[i, 2], defects[i, 7]))
        for i in range(int(nodes[n, PATCHES]), int(nodes[n, PATCHES_END])):
            slope = max(slope, HOLE_SLOPE * (abs(patches[i, 5]) + abs(patches[i, 8]) * patches[i, 3]) * patches[i, 6])
    if abs(abs(offset) - section[PAVED_EDGE]) < STRIDE_M + section[KERB_FACE]:
        slope += 1.5 * kerb_height(road, k, 0.0, offset) / section[KERB_FACE]
    return 0.4 + slope


@inner
def into_hole(road: RoadArrays, beam: Float64, r: float, near: int) -> tuple[float, float, int, float, float]:
    """Follow a beam from the rim's level at `r` to the wall or floor of a pothole, crack or joint.

    No step is longer than the clearance and the steepest slope around allow, so that the first wall in the way stops
    the beam. Returns range, depth, node, u and offset there.
    """
    gap, depth, k, u, offset = hole_clearance(road, beam, r, near)
    level = math.hypot(beam[0, 1] + 2.0 * r * beam[0, 2], beam[1, 1] + 2.0 * r * beam[1, 2])
    descent = -(beam[2, 1] + 2.0 * r * beam[2, 2])
    for _ in range(100_000):
        if gap < GAP_TOLERANCE_M:
            break
        fastest = max(descent + level * steepest(road, k, offset), 1e-3)
        step = min(max(gap / fastest, 2e-5), 0.1)
        low, low_gap = r, gap
        r += step
        gap, depth, k, u, offset = hole_clearance(road, beam, r, k)
        if gap >= 0.0:
            continue
        high, high_gap = r, gap
        side = 0
        for _ in range(60):
            r = (low * high_gap - high * low_gap) / (high_gap - low_gap)
            gap, depth, k, u, offset = hole_clearance(road, beam, r, k)
            if abs(gap) < GAP_TOLERANCE_M:
                break
            if gap > 0.0:
                low, low_gap = r, gap
                if side == 1:
                    high_gap *= 0.5
                side = 1
            else:
                high, high_gap = r, gap
                if side == -1:
                    low_gap *= 0.5
                side = -1
        break
    return r, depth, k, u, offset
