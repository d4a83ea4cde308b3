"""Rays of lidars, line scanners and cameras: finds what each meets first, the road or a body beside it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float64, Int32, Int64
from roadscan.simulate.kernels.beams import along_beam, through
from roadscan.simulate.kernels.ground import CELL_M, TILE_CELLS, TILE_M, Cells, first_ground, into_hole
from roadscan.simulate.kernels.options import compiled, inlined, inner, mixed
from roadscan.simulate.kernels.road import (
    DEFECTS,
    DEFECTS_END,
    GRASS,
    GRASS_FROM,
    PAVED_EDGE,
    RoadArrays,
    brightness,
    defect_depth,
    on_surface,
)
from roadscan.simulate.kernels.things import (
    BODY_COLUMNS,
    EASTING,
    GLARE_COSINE,
    GLARE_SHADE,
    HALF_LENGTH,
    HALF_WIDTH,
    HIGH,
    HIGH_END,
    KIND,
    LOW,
    LOW_END,
    MIRROR_SHARE,
    NORTHING,
    WEAK_SHADE,
    WEAK_SHARE,
    is_glass,
    meet,
    normal,
    shade,
)

NOTHING, ROAD, LOST = -1, -2, -3
"""Results of a ray that meets no body: nothing within reach; the road; the road's underside or edge."""
ON_GROUND, NO_OBJECT = 0, -1
"""Object numbers of rays that meet the road, and nothing."""

# Places in the scratch array of a ray's search.
BEST, HIT, NODE, PAST, OFFSET, DEPTH = 0, 1, 2, 3, 4, 5
STATE_SIZE = 6  # numbers of a ray's search state

GRASS_WAY_M = 1.0
"""Longest way of a beam through grass (m): on longer ones the ground's shape counts."""
GRASS_PATH_SHARE = 2.0
"""Mean free path of a beam in grass over the grass's height."""
MIXED_WITHIN_M = 0.15
"""Sub-rays that meet things closer together than this see the same thing (m)."""
BENT_SHARE = 0.5
"""Ranges across a beam, and from ray to ray, leave a plane by less than this share of their change where they lie on
one smooth surface: at a low angle they change fast, and small bumps move them far."""
LEAVE_M = 1e-4
"""Way from a pane at which a mirrored beam begins (m)."""
PULSE_M = 1.5
"""Echoes closer together than this merge (m): half the length of a pulse of 10 ns."""


class World(NamedTuple):
    """All standing things that rays can meet."""

    road: RoadArrays
    cells: Cells
    bodies: Float64
    """(n, 19), see :mod:`roadscan.simulate.kernels.things`."""
    object_id: Int32
    """(n,) object of each body."""


class Movers(NamedTuple):
    """Moving bodies at the beginning of each time slot; within a slot they move evenly."""

    bodies: Float64
    """(slots, n, 19)"""
    velocity: Float64
    """(slots, n, 3) east, north, up (m/s)."""
    object_id: Int32
    """(n,)"""
    slot_s: float
    """Length of a slot (s)."""


class Poses(NamedTuple):
    """Poses of a sensor at the beginning and end of each interval; between them it moves evenly."""

    begin_m: Float64
    """(p, 3) origin in the anchor's east, north, up."""
    end_m: Float64
    """(p, 3)"""
    begin: Float64
    """(p, 3, 3) rotation from the sensor's axes."""
    end: Float64
    """(p, 3, 3)"""
    time_s: Float64
    """(p, 2) beginning and end, since the first slot of the movers."""


class Rays(NamedTuple):
    """The rays of g groups (packets, turns of a mirror, pictures) of m rays."""

    direction: Float64
    """(g, m, 3) unit vectors in the sensor's axes."""
    origin_m: Float64
    """(m, 3) in the sensor's axes."""
    interval: Int64
    """(m,) interval of poses within the group: group g has the intervals g · n … g · n + n − 1."""
    share: Float64
    """(m,) time within the interval, as a share of its length."""
    beside: Int64
    """(m, 4) the group's ray that comes next on each side: after and before along the scan, above and below across it;
    −1: not known. Each is the neighbour of its neighbour."""
    steps: Int64
    """(2,) rays to examine on each side, along and across the scan, for edges within the width."""
    fan_rad: Float64
    """(5, 2) tangents of the sub-rays' angles from the ray, along and across the scan: the ray's middle, then towards
    the sides in the order of `beside`; (1, 2) zeros for rays without width."""
    weight: Float64
    """(s,) energy of each sub-ray."""
    limits_m: Float64
    """(2,) nearest and farthest range measured."""
    key: np.uint64
    """Random key of the first ray: each ray has its own."""


class Found(NamedTuple):
    """Results of rays."""

    place: Float64
    """(g, m, 5) range, easting, northing, height (m), intensity; range NaN: nothing; intensity NaN: glass."""
    object_id: Int32
    """(g, m) 0: the road, −1: nothing."""
    body: Int32
    """(g, m) the body met, numbers of moving ones follow on those of the world; −1: none."""
    is_mixed: Bool
    """(g, m) the range is a mixture of several things', or another's than that in the ray's middle."""


class Scratch(NamedTuple):
    """Scratch arrays; their content is valid for one ray, that of `centres` for one group."""

    beam: Float64
    """(3, 3) easting, northing and height by range."""
    body: Float64
    """(1, 19) a moving body at the time of a ray."""
    state: Float64
    """(6,) see :func:`cast`."""
    axes: Float64
    """(2, 3) see :func:`lay_axes`."""
    echoes: Float64
    """(s, 6) results of a ray's sub-rays, see :func:`note_echo`; column 4: whether it was cast, then its group."""
    centres: Float64
    """(m, 6) the same for the middles of a group's rays."""
    mirrored: Float64
    """(3, 3) easting, northing and height of a beam behind a pane that mirrors it."""


# --- frames ------------------------------------------------------------------------------------------


@inlined
def bend(bases: Float64, axis: int, x: float, y: float, z: float) -> float:
    """Return easting, northing or height (axis 0, 1, 2) of a point near an anchor, quadratic in its east, north, up.

    bases : (3, 10) coefficients of 1, x, y, z, x², xy, xz, y², yz, z².
    """
    east = x * (bases[axis, 1] + x * bases[axis, 4] + y * bases[axis, 5] + z * bases[axis, 6])
    north = y * (bases[axis, 2] + y * bases[axis, 7] + z * bases[axis, 8])
    value: float = bases[axis, 0] + east + north + z * (bases[axis, 3] + z * bases[axis, 9])
    return value


@inlined
def turned(poses: Poses, p: int, share: float, axis: int, x: float, y: float, z: float) -> float:
    """Return one component of a sensor's vector in the anchor's frame.

    Linear in time: over the 0.55 ms of a lidar's packet that is good to 10⁻⁸ at 10 degrees a second.
    """
    begin = poses.begin[p, axis, 0] * x + poses.begin[p, axis, 1] * y + poses.begin[p, axis, 2] * z
    end = poses.end[p, axis, 0] * x + poses.end[p, axis, 1] * y + poses.end[p, axis, 2] * z
    value: float = begin + share * (end - begin)
    return value


@inlined
def lay_beam(
    bases: Float64, poses: Poses, p: int, share: float, origin: Float64, i: int,
    dx: float, dy: float, dz: float, reach: float, beam: Float64,
) -> None:  # fmt: skip
    """Write the parabola of a ray through the map: easting, northing, height by its range.

    origin : (m, 3), of which ray `i` takes its own; beam : (3, 3), out.
    """
    half = 0.5 * reach
    ox, oy, oz = origin[i, 0], origin[i, 1], origin[i, 2]
    x = poses.begin_m[p, 0] + share * (poses.end_m[p, 0] - poses.begin_m[p, 0]) + turned(poses, p, share, 0, ox, oy, oz)
    y = poses.begin_m[p, 1] + share * (poses.end_m[p, 1] - poses.begin_m[p, 1]) + turned(poses, p, share, 1, ox, oy, oz)
    z = poses.begin_m[p, 2] + share * (poses.end_m[p, 2] - poses.begin_m[p, 2]) + turned(poses, p, share, 2, ox, oy, oz)
    ex = half * turned(poses, p, share, 0, dx, dy, dz)
    ey = half * turned(poses, p, share, 1, dx, dy, dz)
    ez = half * turned(poses, p, share, 2, dx, dy, dz)
    for axis in range(3):
        first = bend(bases, axis, x, y, z)
        second = bend(bases, axis, x + ex, y + ey, z + ez)
        third = bend(bases, axis, x + 2.0 * ex, y + 2.0 * ey, z + 2.0 * ez)
        through(beam, axis, half, first, second, third)


# --- one ray -----------------------------------------------------------------------------------------


@inner
def cast(
    world: World,
    movers: Movers,
    time_s: float,
    beam: Float64,
    reach: float,
    key: np.uint64,
    body: Float64,
    state: Float64,
) -> None:
    """Find what a beam meets first.

    Parameters
    ----------
    time_s : since the movers' first slot.
    beam : (3, 3) easting, northing and height by range.
    reach : how far to look (m).
    body : (1, 19) scratch.
    state : (6,) out: range, what was met (a body's number, those of movers follow on the still ones'; or
        :data:`ROAD`, :data:`LOST`, :data:`NOTHING`), node, u, offset and depth of the road there.
    """
    state[BEST], state[HIT] = reach, NOTHING
    # The chord of the beam; bodies are met on it first, and the hit is refined on the beam itself.
    dx = beam[0, 1] + reach * beam[0, 2]
    dy = beam[1, 1] + reach * beam[1, 2]
    dz = beam[2, 1] + reach * beam[2, 2]
    meet_movers(world, movers, time_s, beam, dx, dy, dz, key, body, state)
    walk_tiles(world, beam, dx, dy, dz, reach, key, state)
    hit = int(state[HIT])
    if hit == ROAD and world.road.section[GRASS] > 0.0:
        stop_in_grass(world.road, beam, key, state)
    if hit >= 0:
        still = world.bodies.shape[0]
        rows, i, own = world.bodies, hit, key
        if hit >= still:
            place_mover(movers, time_s, hit - still, body)
            rows, i, own = body, 0, key ^ np.uint64(hit)
        r = state[BEST]
        for _ in range(2):
            tx, ox = beam[0, 1] + 2.0 * r * beam[0, 2], beam[0, 0] - r * r * beam[0, 2]
            ty, oy = beam[1, 1] + 2.0 * r * beam[1, 2], beam[1, 0] - r * r * beam[1, 2]
            tz, oz = beam[2, 1] + 2.0 * r * beam[2, 2], beam[2, 0] - r * r * beam[2, 2]
            again = meet(rows, i, ox, oy, oz, tx, ty, tz, own)
            if abs(again - r) < 0.05:
                r = again
        state[BEST] = r


@inner
def stop_in_grass(road: RoadArrays, beam: Float64, key: np.uint64, state: Float64) -> None:
    """Stop a beam that meets the ground under grass among the blades: its free path there is exponential."""
    tall = road.section[GRASS]
    if abs(state[OFFSET]) < road.section[PAVED_EDGE] + road.section[GRASS_FROM]:
        return
    r = state[BEST]
    fall = max(-(beam[2, 1] + 2.0 * r * beam[2, 2]), 0.02)
    share = (float(mixed(key ^ np.uint64(0x14057B7EF767814F)) >> np.uint64(11)) + 0.5) / 9007199254740992.0
    stopped = r - min(tall / fall, GRASS_WAY_M) - GRASS_PATH_SHARE * tall * math.log(share)
    state[BEST] = min(max(stopped, 0.5 * r), r)


@inner
def place_mover(movers: Movers, time_s: float, i: int, body: Float64) -> None:
    """Write body `i` of the movers at a time. body : (1, 19), out."""
    slot = min(max(int(time_s / movers.slot_s), 0), movers.bodies.shape[0] - 1)
    past = time_s - slot * movers.slot_s
    for column in range(BODY_COLUMNS):
        body[0, column] = movers.bodies[slot, i, column]
    body[0, EASTING] += past * movers.velocity[slot, i, 0]
    body[0, NORTHING] += past * movers.velocity[slot, i, 1]
    rise = past * movers.velocity[slot, i, 2]
    for column in (LOW, HIGH, LOW_END, HIGH_END):
        body[0, column] += rise


@inner
def meet_movers(
    world: World, movers: Movers, time_s: float, beam: Float64, dx: float, dy: float, dz: float, key: np.uint64,
    body: Float64, state: Float64,
) -> None:  # fmt: skip
    """Stop a beam at the nearest moving body in its way."""
    count = movers.bodies.shape[1]
    if count == 0:
        return
    slot = min(max(int(time_s / movers.slot_s), 0), movers.bodies.shape[0] - 1)
    past = time_s - slot * movers.slot_s
    still = world.bodies.shape[0]
    flat2 = dx * dx + dy * dy
    for i in range(count):
        x = movers.bodies[slot, i, EASTING] + past * movers.velocity[slot, i, 0] - beam[0, 0]
        y = movers.bodies[slot, i, NORTHING] + past * movers.velocity[slot, i, 1] - beam[1, 0]
        half = movers.bodies[slot, i, HALF_LENGTH] + movers.bodies[slot, i, HALF_WIDTH] + 0.01
        aside = x * dy - y * dx
        if aside * aside > half * half * flat2 or movers.bodies[slot, i, KIND] < 0.0:
            continue
        place_mover(movers, time_s, i, body)
        r = meet(body, 0, beam[0, 0], beam[1, 0], beam[2, 0], dx, dy, dz, key ^ np.uint64(still + i))
        if r < state[BEST]:
            state[BEST], state[HIT] = r, still + i


@inlined
def next_border(from_m: float, per_m: float, index: int, size: float) -> float:
    """Return the range at which a line leaves an interval of a row of equal ones."""
    if per_m > 0.0:
        return ((index + 1) * size - from_m) / per_m
    if per_m < 0.0:
        return (index * size - from_m) / per_m
    return np.inf


@inlined
def walk_tiles(
    world: World, beam: Float64, dx: float, dy: float, dz: float, reach: float, key: np.uint64, state: Float64
) -> None:
    """Follow a beam from tile to tile of the map (Amanatides and Woo 1987) to what it meets first."""
    cells = world.cells
    x, y = beam[0, 0] - cells.corner[0], beam[1, 0] - cells.corner[1]
    rows, columns = cells.tiles.shape
    begin, end = 0.0, reach
    for axis in range(2):
        at, per_m, size = (x, dx, columns * TILE_M) if axis == 0 else (y, dy, rows * TILE_M)
        if per_m == 0.0:
            if not 0.0 <= at < size:
                return
            continue
        first, second = -at / per_m, (size - at) / per_m
        begin, end = max(begin, min(first, second)), min(end, max(first, second))
    if begin >= end:
        return
    i = min(max(int((x + begin * dx) / TILE_M), 0), columns - 1)
    j = min(max(int((y + begin * dy) / TILE_M), 0), rows - 1)
    step_i, step_j = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    r = begin
    while r < end and r < state[BEST]:
        to_x, to_y = next_border(x, dx, i, TILE_M), next_border(y, dy, j, TILE_M)
        leave = min(max(min(to_x, to_y), r), end)
        tile = cells.tiles[j, i]
        if tile >= 0 and min(along_beam(beam, 2, r), along_beam(beam, 2, leave)) <= cells.top[tile]:
            walk_cells(world, tile, i, j, beam, dx, dy, dz, r, leave, key, state)
        if to_x < to_y:
            i += step_i
        else:
            j += step_j
        if not (0 <= i < columns and 0 <= j < rows):
            return
        r = leave


@inlined
def walk_cells(
    world: World, tile: int, tile_i: int, tile_j: int, beam: Float64, dx: float, dy: float, dz: float,
    begin: float, end: float, key: np.uint64, state: Float64,
) -> None:  # fmt: skip
    """Follow a beam from cell to cell of one tile."""
    cells = world.cells
    x = beam[0, 0] - cells.corner[0] - tile_i * TILE_M
    y = beam[1, 0] - cells.corner[1] - tile_j * TILE_M
    i = min(max(int((x + begin * dx) / CELL_M), 0), TILE_CELLS - 1)
    j = min(max(int((y + begin * dy) / CELL_M), 0), TILE_CELLS - 1)
    step_i, step_j = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    corner_e = cells.corner[0] + tile_i * TILE_M + 0.5 * CELL_M
    corner_n = cells.corner[1] + tile_j * TILE_M + 0.5 * CELL_M
    to_x, to_y = next_border(x, dx, i, CELL_M), next_border(y, dy, j, CELL_M)
    r = begin
    while r < end and r < state[BEST]:
        leave = min(max(min(to_x, to_y), r), end)
        index = (tile * TILE_CELLS + j) * TILE_CELLS + i
        for m in range(cells.first[index], cells.first[index + 1]):
            member = int(np.int64(cells.members[m]))
            found = meet(world.bodies, member, beam[0, 0], beam[1, 0], beam[2, 0], dx, dy, dz, key)
            if found < state[BEST]:
                state[BEST], state[HIT] = found, member
        if cells.flags[index] and leave > r:
            meet_ground(world, index, corner_e + i * CELL_M, corner_n + j * CELL_M, beam, r, leave, state)
        if to_x < to_y:
            i += step_i
            to_x = next_border(x, dx, i, CELL_M)
        else:
            j += step_j
            to_y = next_border(y, dy, j, CELL_M)
        if not (0 <= i < TILE_CELLS and 0 <= j < TILE_CELLS):
            return
        r = leave


@inner
def meet_ground(
    world: World, index: int, middle_e: float, middle_n: float, beam: Float64, begin: float, end: float, state: Float64
) -> None:
    """Stop a beam at the ground of a cell, if it meets that before anything else."""
    road = world.road
    r, k, u, offset = first_ground(road, world.cells, index, middle_e, middle_n, beam, begin, end)
    if math.isnan(r):
        return
    if r < 0.0 or not on_surface(road, k, u, offset):
        r = max(r, begin)
        if r < state[BEST]:
            state[BEST], state[HIT] = r, LOST
        return
    depth = 0.0
    if road.nodes[k, DEFECTS] < road.nodes[k, DEFECTS_END]:
        depth, _ = defect_depth(road, k, u, offset)
        if depth > 0.0:
            r, depth, k, u, offset = into_hole(road, beam, r, k)
    if r < state[BEST]:
        state[BEST], state[HIT] = r, ROAD
        state[NODE], state[PAST], state[OFFSET], state[DEPTH] = k, u, offset, depth


# --- all rays ----------------------------------------------------------------------------------------


@compiled
def cast_rays(
    world: World, movers: Movers, bases: Float64, poses: Poses, rays: Rays, found: Found, scratch: Scratch
) -> None:
    """Cast all rays: the middles of a group's rays first, then sub-rays where an edge may lie within a ray's width.

    Parameters
    ----------
    bases : (3, 10), see :func:`bend`.
    found : out.
    """
    groups, count = rays.direction.shape[0], rays.direction.shape[1]
    centres, echoes = scratch.centres, scratch.echoes
    for g in range(groups):
        for i in range(count):
            cast_one(world, movers, bases, poses, rays, g, i, 0, scratch, centres, i)
            write_found(rays, scratch.beam, found, g, i, centres[i, 0], centres[i, 1], centres[i, 2], False)
            found.body[g, i] = int(centres[i, 5]) if found.object_id[g, i] != NO_OBJECT else NO_OBJECT
        if rays.fan_rad.shape[0] == 1:
            continue
        for i in range(count):
            if not may_meet_edge(centres, rays, i):
                continue
            for column in range(6):
                echoes[0, column] = centres[i, column]
            if meets_edge(world, movers, bases, poses, rays, g, i, scratch):
                for s in range(1, 5):
                    cast_once(world, movers, bases, poses, rays, g, i, s, scratch)
                r, value, number, is_mixed = merged(echoes)
                if is_mixed:
                    lay_ray(bases, poses, rays, g, i, 0, scratch)
                    write_found(rays, scratch.beam, found, g, i, r, value, number, True)
                    found.body[g, i] = strongest_body(echoes, number)


@inlined
def lay_axes(rays: Rays, g: int, i: int, axes: Float64) -> None:
    """Write directions along and across the scan, perpendicular to a ray and to each other.

    They point to the sides of the neighbours. A ray without any takes the axis that it is farthest from.

    axes : (2, 3), out.
    """
    x, y, z = rays.direction[g, i, 0], rays.direction[g, i, 1], rays.direction[g, i, 2]
    ux, uy, uz = between(rays, g, i, 0)
    vx, vy, vz = between(rays, g, i, 2)
    if ux == 0.0 and uy == 0.0 and uz == 0.0:
        ux, uy, uz = vy * z - vz * y, vz * x - vx * z, vx * y - vy * x
    if ux == 0.0 and uy == 0.0 and uz == 0.0:
        ux, uy, uz = (-y, x, 0.0) if abs(z) < 0.7 else (0.0, -z, y)
    ahead = ux * x + uy * y + uz * z
    ux, uy, uz = ux - ahead * x, uy - ahead * y, uz - ahead * z
    norm = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux * norm, uy * norm, uz * norm
    wx, wy, wz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    sign = -1.0 if wx * vx + wy * vy + wz * vz < 0.0 else 1.0
    axes[0, 0], axes[0, 1], axes[0, 2] = ux, uy, uz
    axes[1, 0], axes[1, 1], axes[1, 2] = sign * wx, sign * wy, sign * wz


@inlined
def between(rays: Rays, g: int, i: int, side: int) -> tuple[float, float, float]:
    """Return the vector from a ray's neighbour on the side after `side` (or itself) to that on `side` (or itself)."""
    on, back = rays.beside[i, side], rays.beside[i, side + 1]
    on, back = (on if on >= 0 else i), (back if back >= 0 else i)
    first, second = rays.direction[g, back], rays.direction[g, on]
    return second[0] - first[0], second[1] - first[1], second[2] - first[2]


@inlined
def lay_ray(bases: Float64, poses: Poses, rays: Rays, g: int, i: int, s: int, scratch: Scratch) -> float:
    """Write the beam of sub-ray `s`, given its axes; return its time since the movers' first slot (s)."""
    p = g * (poses.begin_m.shape[0] // rays.direction.shape[0]) + rays.interval[i]
    share = rays.share[i]
    x, y, z = rays.direction[g, i, 0], rays.direction[g, i, 1], rays.direction[g, i, 2]
    if s > 0:
        a, b = rays.fan_rad[s, 0], rays.fan_rad[s, 1]
        axes, scale = scratch.axes, 1.0 / math.sqrt(1.0 + a * a + b * b)
        x = (x + a * axes[0, 0] + b * axes[1, 0]) * scale
        y = (y + a * axes[0, 1] + b * axes[1, 1]) * scale
        z = (z + a * axes[0, 2] + b * axes[1, 2]) * scale
    lay_beam(bases, poses, p, share, rays.origin_m, i, x, y, z, rays.limits_m[1], scratch.beam)
    time_s: float = poses.time_s[p, 0] + share * (poses.time_s[p, 1] - poses.time_s[p, 0])
    return time_s


@inlined
def cast_one(
    world: World, movers: Movers, bases: Float64, poses: Poses, rays: Rays, g: int, i: int, s: int, scratch: Scratch,
    echoes: Float64, row: int,
) -> None:  # fmt: skip
    """Cast sub-ray `s` (0: the middle) of a ray, and write its result to a row of the echoes."""
    number = np.uint64(g * rays.direction.shape[1] + i)
    time_s = lay_ray(bases, poses, rays, g, i, s, scratch)
    key = mixed(rays.key + number) + np.uint64(s)
    beam, state = scratch.beam, scratch.state
    cast(world, movers, time_s, beam, rays.limits_m[1], key, scratch.body, state)
    note_echo(world, movers, time_s, beam, rays.weight[s], scratch.body, state, echoes, row)
    if state[HIT] >= 0.0 and meets_glass(world, movers, time_s, beam, scratch.body, state):
        see_glass(world, movers, time_s, rays.limits_m[1], key, rays.weight[s], scratch, echoes, row)


@inner
def meets_glass(world: World, movers: Movers, time_s: float, beam: Float64, body: Float64, state: Float64) -> bool:
    """Return whether a beam that met a body was stopped by glass; a moving body is then written to `body`."""
    hit, r, still = int(state[HIT]), state[BEST], world.bodies.shape[0]
    x, y, z = along_beam(beam, 0, r), along_beam(beam, 1, r), along_beam(beam, 2, r)
    if hit < still:
        return is_glass(world.bodies, hit, x, y, z)
    place_mover(movers, time_s, hit - still, body)
    return is_glass(body, 0, x, y, z)


@inner
def see_glass(
    world: World, movers: Movers, time_s: float, reach: float, key: np.uint64, weight: float, scratch: Scratch,
    echoes: Float64, row: int,
) -> None:  # fmt: skip
    """Replace the echo of a pane: it glares along its normal; else it is weak, mirrored, or nothing.

    What is mirrored appears on the beam behind the pane, as far off as the whole way is long, on no object.
    """
    beam, state, out = scratch.beam, scratch.state, scratch.mirrored
    hit, r, still = int(state[HIT]), state[BEST], world.bodies.shape[0]
    n = normal(world.bodies, hit) if hit < still else normal(scratch.body, 0)
    way = (beam[0, 1] + 2.0 * r * beam[0, 2], beam[1, 1] + 2.0 * r * beam[1, 2], beam[2, 1] + 2.0 * r * beam[2, 2])
    cosine = way[0] * n[0] + way[1] * n[1] + way[2] * n[2]
    share = float(mixed(key ^ np.uint64(0x5851F42D4C957F2D)) >> np.uint64(11)) / 9007199254740992.0
    value = np.nan
    if abs(cosine) > GLARE_COSINE:
        value = GLARE_SHADE
    elif share < WEAK_SHARE:
        value = WEAK_SHADE
    elif share < WEAK_SHARE + MIRROR_SHARE and reach - r > MIXED_WITHIN_M:
        for axis in range(3):
            out[axis, 0] = along_beam(beam, axis, r)
            out[axis, 1], out[axis, 2] = way[axis] - 2.0 * cosine * n[axis], 0.0
            out[axis, 0] += LEAVE_M * out[axis, 1]
        cast(world, movers, time_s, out, reach - r, key ^ np.uint64(1), scratch.body, state)
        note_echo(world, movers, time_s, out, weight, scratch.body, state, echoes, row)
        echoes[row, 2], echoes[row, 0], echoes[row, 5] = NO_OBJECT, echoes[row, 0] + r, -1.0
        if not math.isnan(echoes[row, 0]):
            value = 0.5 * echoes[row, 1]
    echoes[row, 1] = value
    total = echoes[row, 0]
    echoes[row, 3] = weight * max(value, 1.0) / (total * total) if value >= 0.0 else 0.0


@inner
def cast_once(
    world: World, movers: Movers, bases: Float64, poses: Poses, rays: Rays, g: int, i: int, s: int, scratch: Scratch
) -> None:
    """Cast a sub-ray unless that was already done."""
    if scratch.echoes[s, 4] == 0.0:
        cast_one(world, movers, bases, poses, rays, g, i, s, scratch, scratch.echoes, s)
        scratch.echoes[s, 4] = 1.0


@inner
def may_meet_edge(centres: Float64, rays: Rays, i: int) -> bool:
    """Return whether an edge may lie on any side of a ray."""
    found = False
    for side in range(4):
        found = found or may_lie_edge(centres, rays.beside, i, side, rays.steps[side // 2])
    return found


@inner
def meets_edge(
    world: World, movers: Movers, bases: Float64, poses: Poses, rays: Rays, g: int, i: int, scratch: Scratch
) -> bool:
    """Return whether sub-rays on sides with a possible edge meet another surface than the ray's middle.

    What is smaller than the distance between rays, and met by no middle, is missed.
    """
    echoes = scratch.echoes
    for s in range(1, 5):
        echoes[s, 4] = 0.0
    lay_axes(rays, g, i, scratch.axes)
    for s in range(1, 5):
        if not may_lie_edge(scratch.centres, rays.beside, i, s - 1, rays.steps[(s - 1) // 2]):
            continue
        cast_once(world, movers, bases, poses, rays, g, i, s, scratch)
        if is_other(echoes, s):
            return True
        # Without a hit ranges are NaN, and all comparisons fail.
        if abs(echoes[s, 0] - echoes[0, 0]) > MIXED_WITHIN_M:
            across = ((s - 1) ^ 1) + 1
            cast_once(world, movers, bases, poses, rays, g, i, across, scratch)
            if is_other(echoes, across) or is_bent(echoes, s, across):
                return True
    return False


@inlined
def may_lie_edge(centres: Float64, beside: Int64, i: int, side: int, steps: int) -> bool:
    """Return whether an edge may lie between a ray and the next ones on a side, by what their middles met.

    So it is where a neighbour is not known, where it sees another object, or where its range is explained neither by
    the ranges before, nor this ray's by the ranges beyond. Beside a neighbour that sees nothing, an edge costs the ray
    energy, but mixes nothing into it.
    """
    number = object_seen(centres, i)
    for step in range(1, steps + 1):
        j = stepped(beside, i, side, step)
        if j < 0:
            return True
        seen = object_seen(centres, j)
        if seen == NO_OBJECT:
            continue
        if seen != number:
            return True
        if abs(centres[j, 0] - centres[i, 0]) > MIXED_WITHIN_M:
            before, beyond = stepped(beside, i, side ^ 1, step), stepped(beside, j, side, step)
            near, here, there, far = centres[before, 0], centres[i, 0], centres[j, 0], centres[beyond, 0]
            is_before = before >= 0 and object_seen(centres, before) == number and is_smooth(near, here, there)
            is_beyond = beyond >= 0 and object_seen(centres, beyond) == number and is_smooth(here, there, far)
            if not is_before and not is_beyond:
                return True
    return False


@inlined
def stepped(beside: Int64, i: int, side: int, steps: int) -> int:
    """Return the ray that is some steps to a side of another; −1: unknown."""
    for _ in range(steps):
        if i >= 0:
            i = beside[i, side]
    return i


@inlined
def object_seen(echoes: Float64, row: int) -> int:
    """Return the object of an echo; :data:`NO_OBJECT`: none, as from glass."""
    return int(echoes[row, 2]) if echoes[row, 3] > 0.0 else NO_OBJECT


@inlined
def is_other(echoes: Float64, s: int) -> bool:
    """Return whether row `s` of a ray's echoes comes from another object than its middle.

    Nothing is no other object, and where two touch within :data:`MIXED_WITHIN_M` they are taken for one.
    """
    number, middle = object_seen(echoes, s), object_seen(echoes, 0)
    if number not in (NO_OBJECT, middle):
        return middle == NO_OBJECT or abs(echoes[s, 0] - echoes[0, 0]) > MIXED_WITHIN_M
    return False


@inlined
def is_bent(echoes: Float64, s: int, across: int) -> bool:
    """Return whether two opposite sub-rays see the object of the ray's middle, but not on one smooth surface."""
    middle = object_seen(echoes, 0)
    if object_seen(echoes, s) != middle or object_seen(echoes, across) != middle:
        return False
    return not is_smooth(echoes[s, 0], echoes[0, 0], echoes[across, 0])


@inlined
def is_smooth(before: float, middle: float, after: float) -> bool:
    """Return whether three ranges at equal angular steps lie on one smooth surface.

    On a plane, at however low an angle, the inverse ranges of rays from one place change evenly.
    """
    bent = abs(1.0 / before + 1.0 / after - 2.0 / middle) * middle * middle
    change = abs(1.0 / before - 1.0 / after) * middle * middle
    return bent <= max(MIXED_WITHIN_M, BENT_SHARE * change)


@inner
def note_echo(
    world: World, movers: Movers, time_s: float, beam: Float64, weight: float, body: Float64, state: Float64,
    echoes: Float64, s: int,
) -> None:  # fmt: skip
    """Write row `s` of the echoes: range (NaN: none), intensity, object, energy."""
    hit, r = int(state[HIT]), state[BEST]
    echoes[s, 0], echoes[s, 1], echoes[s, 2], echoes[s, 3] = np.nan, np.nan, NO_OBJECT, 0.0
    echoes[s, 5] = max(hit, -1)
    if hit in (NOTHING, LOST):
        return
    still = world.bodies.shape[0]
    if hit == ROAD:
        value = brightness(world.road, int(state[NODE]), state[PAST], state[OFFSET], state[DEPTH], 0.0)
        echoes[s, 2] = ON_GROUND
    elif hit < still:
        x, y, z = along_beam(beam, 0, r), along_beam(beam, 1, r), along_beam(beam, 2, r)
        value = shade(world.bodies, hit, x, y, z)
        echoes[s, 2] = world.object_id[hit]
    else:
        place_mover(movers, time_s, hit - still, body)
        value = shade(body, 0, along_beam(beam, 0, r), along_beam(beam, 1, r), along_beam(beam, 2, r))
        echoes[s, 2] = movers.object_id[hit - still]
    echoes[s, 0], echoes[s, 1] = r, value
    echoes[s, 3] = weight * max(value, 1.0) / (r * r) if value >= 0.0 else 0.0


@inner
def write_found(
    rays: Rays, beam: Float64, found: Found, g: int, i: int, r: float, value: float, number: float, is_mixed: bool
) -> None:
    """Write the receiver's range, intensity and object of a ray whose middle is `beam`."""
    is_seen = rays.limits_m[0] <= r <= rays.limits_m[1]
    found.place[g, i, 0] = r if is_seen else np.nan
    for axis in range(3):
        found.place[g, i, 1 + axis] = along_beam(beam, axis, r) if is_seen else np.nan
    found.place[g, i, 4] = value if is_seen else np.nan
    found.object_id[g, i] = int(number) if is_seen else NO_OBJECT
    found.is_mixed[g, i] = is_mixed and is_seen


@inner
def merged(echoes: Float64) -> tuple[float, float, float, bool]:
    """Return range, intensity, object and whether they are mixed, of the echoes (5, 5) of one ray, its middle first.

    Echoes within a pulse's length of one another merge, and the range is their mean by energy (mixed pixels of time of
    flight scanners: Ye and Borenstein 2002; Tuley, Vandapel, Hebert 2005). Of groups farther apart the strongest
    counts. Where a group comes from one surface, the ray's middle gives its range, however long the spot on it is.
    """
    energy, low, high = strongest_group(echoes)
    if energy == 0.0 or is_one_surface(echoes, low, high):
        return echoes[0, 0], echoes[0, 1], echoes[0, 2], False
    r, value, number, strongest = 0.0, 0.0, -1.0, 0.0
    for s in range(echoes.shape[0]):
        if is_within(echoes, s, low, high):
            r += echoes[s, 3] * echoes[s, 0] / energy
            value += echoes[s, 3] * echoes[s, 1] / energy
            if echoes[s, 3] > strongest:
                number, strongest = echoes[s, 2], echoes[s, 3]
    return r, value, number, True


@inner
def strongest_body(echoes: Float64, number: float) -> int:
    """Return the body of the strongest of a ray's echoes from an object; −1: none."""
    body, strongest = -1, 0.0
    for s in range(echoes.shape[0]):
        if echoes[s, 2] == number and echoes[s, 3] > strongest:
            body, strongest = int(echoes[s, 5]), echoes[s, 3]
    return body


@inlined
def is_within(echoes: Float64, s: int, low: float, high: float) -> bool:
    """Return whether row `s` of the echoes belongs to the group of these ranges."""
    inside: bool = echoes[s, 3] > 0.0 and low <= echoes[s, 0] <= high
    return inside


@inner
def is_one_surface(echoes: Float64, low: float, high: float) -> bool:
    """Return whether the echoes (5, 5) within ranges only come from the surface in the ray's middle.

    So it is where other objects are met only where they touch it, and ranges on it change evenly across the ray;
    where only one side of an axis belongs to the echoes, only the object decides.
    """
    if not is_within(echoes, 0, low, high):
        return False
    for s in range(1, 5):
        if is_within(echoes, s, low, high) and is_other(echoes, s):
            return False
    for s in (1, 3):
        if is_within(echoes, s, low, high) and is_within(echoes, s + 1, low, high) and is_bent(echoes, s, s + 1):
            return False
    return True


@inner
def strongest_group(echoes: Float64) -> tuple[float, float, float]:
    """Return energy, nearest and farthest range of the group of echoes with the most energy; 0: none.

    echoes : (s, 5), of which column 4 is scratch: the group.
    """
    count = echoes.shape[0]
    for s in range(count):
        echoes[s, 4] = -1.0
    best, best_low, best_high = 0.0, np.nan, np.nan
    for s in range(count):
        if echoes[s, 3] > 0.0 and echoes[s, 4] < 0.0:
            energy, low, high = grown_group(echoes, s)
            if energy > best:
                best, best_low, best_high = energy, low, high
    return best, best_low, best_high


@inner
def grown_group(echoes: Float64, s: int) -> tuple[float, float, float]:
    """Return energy, nearest and farthest range of the echoes that merge with row `s`, directly or through others."""
    energy, low, high = echoes[s, 3], echoes[s, 0], echoes[s, 0]
    echoes[s, 4] = s
    is_growing = True
    while is_growing:
        is_growing = False
        for t in range(echoes.shape[0]):
            if echoes[t, 3] > 0.0 and echoes[t, 4] < 0.0 and low - PULSE_M <= echoes[t, 0] <= high + PULSE_M:
                echoes[t, 4] = s
                energy += echoes[t, 3]
                low, high = min(low, echoes[t, 0]), max(high, echoes[t, 0])
                is_growing = True
    return energy, low, high
