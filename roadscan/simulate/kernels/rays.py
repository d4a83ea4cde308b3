"""Rays of lidars, line scanners and cameras: what each meets first, the road or a body beside it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.simulate.kernels.beams import along_beam, through
from roadscan.simulate.kernels.chance import mixed
from roadscan.simulate.kernels.ground import CELL_M, TILE_CELLS, TILE_M, Cells, first_ground, into_hole
from roadscan.simulate.kernels.options import compiled, inlined
from roadscan.simulate.kernels.road import DEFECTS, DEFECTS_END, RoadArrays, brightness, defect_depth, on_surface
from roadscan.simulate.kernels.things import (
    BODY_COLUMNS,
    EASTING,
    HALF_LENGTH,
    HALF_WIDTH,
    HIGH,
    HIGH_END,
    KIND,
    LOW,
    LOW_END,
    NORTHING,
    meet,
    shade,
)

Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NOTHING, ROAD, LOST = -1, -2, -3
"""What a ray met, where it is not a body: nothing within reach; the road; the underside or the edge of the road."""
ON_GROUND, NO_OBJECT = 0, -1
"""Objects of rays that meet the road, and nothing."""

# Places in the scratch array of a ray's search.
BEST, HIT, NODE, PAST, OFFSET, DEPTH = 0, 1, 2, 3, 4, 5
STATE_SIZE = 6

MIXED_WITHIN_M = 0.15
"""Sub-rays that meet things nearer to one another than this see one and the same (m)."""
PULSE_M = 1.5
"""Echoes nearer to one another than this merge into one: half the length of a pulse of 10 ns (m)."""


class World(NamedTuple):
    """All that rays can meet and that stands still."""

    road: RoadArrays
    cells: Cells
    bodies: Float64
    """(n, 18), see :mod:`roadscan.simulate.kernels.things`."""
    object_id: Int32
    """(n,) object that each body belongs to."""


class Movers(NamedTuple):
    """Bodies that move, at the beginning of each slot of time; within a slot they move evenly."""

    bodies: Float64
    """(slots, n, 18)"""
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
    fan_rad: Float64
    """(s, 2) angles of the sub-rays from the ray, to two sides; (1, 2) zeros for rays without width."""
    weight: Float64
    """(s,) energy of each sub-ray."""
    limits_m: Float64
    """(2,) nearest and farthest range measured."""
    key: np.uint64
    """Random key of the first ray: each ray has its own."""


class Found(NamedTuple):
    """What rays have met."""

    place: Float64
    """(g, m, 5) range, easting, northing, height (m), intensity; range NaN: nothing; intensity NaN: glass."""
    object_id: Int32
    """(g, m) 0: the road, −1: nothing."""
    is_mixed: Flags
    """(g, m) the range is a mixture of several things', or another's than that in the ray's middle."""


# --- frames ------------------------------------------------------------------------------------------


@inlined
def bend(bases: Float64, axis: int, x: float, y: float, z: float) -> float:
    """Easting, northing or height (axis 0, 1, 2) of a point near an anchor: quadratic in its east, north, up.

    bases : (3, 10) coefficients of 1, x, y, z, x², xy, xz, y², yz, z².
    """
    east = x * (bases[axis, 1] + x * bases[axis, 4] + y * bases[axis, 5] + z * bases[axis, 6])
    north = y * (bases[axis, 2] + y * bases[axis, 7] + z * bases[axis, 8])
    value: float = bases[axis, 0] + east + north + z * (bases[axis, 3] + z * bases[axis, 9])
    return value


@inlined
def turned(poses: Poses, p: int, share: float, axis: int, x: float, y: float, z: float) -> float:
    """One component of a sensor's vector in the anchor's frame.

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
    """Lay the parabola of a ray through the map: easting, northing, height by its range.

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


@compiled
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
    body : (1, 18) scratch.
    state : (6,) out: range, what was met (a body's number, those of movers follow on the still ones'; or
        :data:`ROAD`, :data:`LOST`, :data:`NOTHING`), node, u, offset and depth of the road there.
    """
    state[BEST], state[HIT] = reach, NOTHING
    # The chord of the beam; bodies are met on it first, and where that counts on the beam itself.
    dx = beam[0, 1] + reach * beam[0, 2]
    dy = beam[1, 1] + reach * beam[1, 2]
    dz = beam[2, 1] + reach * beam[2, 2]
    meet_movers(world, movers, time_s, beam, dx, dy, dz, key, body, state)
    walk_tiles(world, beam, dx, dy, dz, reach, key, state)
    hit = int(state[HIT])
    if hit >= 0:
        still = world.bodies.shape[0]
        if hit >= still:
            place_mover(movers, time_s, hit - still, body)
        r = state[BEST]
        for _ in range(2):
            tx, ox = beam[0, 1] + 2.0 * r * beam[0, 2], beam[0, 0] - r * r * beam[0, 2]
            ty, oy = beam[1, 1] + 2.0 * r * beam[1, 2], beam[1, 0] - r * r * beam[1, 2]
            tz, oz = beam[2, 1] + 2.0 * r * beam[2, 2], beam[2, 0] - r * r * beam[2, 2]
            if hit >= still:
                again = meet(body, 0, ox, oy, oz, tx, ty, tz, key ^ np.uint64(hit))
            else:
                again = meet(world.bodies, hit, ox, oy, oz, tx, ty, tz, key)
            if abs(again - r) < 0.05:
                r = again
        state[BEST] = r


@compiled
def place_mover(movers: Movers, time_s: float, i: int, body: Float64) -> None:
    """Body `i` of the movers at a time. body : (1, 18), out."""
    slot = min(max(int(time_s / movers.slot_s), 0), movers.bodies.shape[0] - 1)
    past = time_s - slot * movers.slot_s
    for column in range(BODY_COLUMNS):
        body[0, column] = movers.bodies[slot, i, column]
    body[0, EASTING] += past * movers.velocity[slot, i, 0]
    body[0, NORTHING] += past * movers.velocity[slot, i, 1]
    rise = past * movers.velocity[slot, i, 2]
    for column in (LOW, HIGH, LOW_END, HIGH_END):
        body[0, column] += rise


@compiled
def meet_movers(
    world: World, movers: Movers, time_s: float, beam: Float64, dx: float, dy: float, dz: float, key: np.uint64,
    body: Float64, state: Float64,
) -> None:  # fmt: skip
    """Let the nearest moving body in the way stop a beam."""
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
    """Range at which a line leaves an interval of a row of equal ones."""
    if per_m > 0.0:
        return ((index + 1) * size - from_m) / per_m
    if per_m < 0.0:
        return (index * size - from_m) / per_m
    return np.inf


@inlined
def walk_tiles(
    world: World, beam: Float64, dx: float, dy: float, dz: float, reach: float, key: np.uint64, state: Float64
) -> None:
    """Walk a beam from tile to tile of the map (Amanatides and Woo 1987) up to what it meets first."""
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
    """The same from cell to cell of one tile."""
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
            found = meet(world.bodies, cells.members[m], beam[0, 0], beam[1, 0], beam[2, 0], dx, dy, dz, key)
            if found < state[BEST]:
                state[BEST], state[HIT] = found, cells.members[m]
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


@compiled
def meet_ground(
    world: World, index: int, middle_e: float, middle_n: float, beam: Float64, begin: float, end: float, state: Float64
) -> None:
    """Let the ground of a cell stop a beam, if it does so before anything else."""
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
    world: World, movers: Movers, bases: Float64, poses: Poses, rays: Rays, found: Found, beam: Float64, body: Float64,
    state: Float64, echoes: Float64,
) -> None:  # fmt: skip
    """Cast all rays.

    Parameters
    ----------
    bases : (3, 10), see :func:`bend`.
    found : out.
    beam, body, state, echoes : (3, 3), (1, 18), (6,), (s, 5) scratch.
    """
    groups, count = rays.direction.shape[0], rays.direction.shape[1]
    intervals = poses.begin_m.shape[0] // groups
    reach = rays.limits_m[1]
    for g in range(groups):
        for i in range(count):
            p = g * intervals + rays.interval[i]
            share = rays.share[i]
            time_s = poses.time_s[p, 0] + share * (poses.time_s[p, 1] - poses.time_s[p, 0])
            x, y, z = rays.direction[g, i, 0], rays.direction[g, i, 1], rays.direction[g, i, 2]
            number = np.uint64(g * count + i)
            # Two directions at right angles to the ray and to one another, by the axis that it is farthest from.
            ux, uy, uz = (-y, x, 0.0) if abs(z) < 0.7 else (0.0, -z, y)
            norm = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux * norm, uy * norm, uz * norm
            vx, vy, vz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
            for s in range(rays.fan_rad.shape[0] - 1, -1, -1):  # the middle last: its beam is used below
                a, b = rays.fan_rad[s, 0], rays.fan_rad[s, 1]
                scale = 1.0 / math.sqrt(1.0 + a * a + b * b)
                sx, sy, sz = (x + a * ux + b * vx) * scale, (y + a * uy + b * vy) * scale, (z + a * uz + b * vz) * scale
                lay_beam(bases, poses, p, share, rays.origin_m, i, sx, sy, sz, reach, beam)
                cast(world, movers, time_s, beam, reach, mixed(rays.key + number) + np.uint64(s), body, state)
                note_echo(world, movers, time_s, beam, rays.weight[s], body, state, echoes, s)
            write_found(rays, beam, echoes, found, g, i)


@compiled
def note_echo(
    world: World, movers: Movers, time_s: float, beam: Float64, weight: float, body: Float64, state: Float64,
    echoes: Float64, s: int,
) -> None:  # fmt: skip
    """Row `s` of the echoes: range (NaN: none), intensity, object, energy."""
    hit, r = int(state[HIT]), state[BEST]
    echoes[s, 0], echoes[s, 1], echoes[s, 2], echoes[s, 3] = np.nan, np.nan, NO_OBJECT, 0.0
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


@compiled
def write_found(rays: Rays, beam: Float64, echoes: Float64, found: Found, g: int, i: int) -> None:
    """What a receiver makes of the echoes of a ray."""
    r, value, number, is_mixed = echoes[0, 0], echoes[0, 1], echoes[0, 2], False
    if rays.fan_rad.shape[0] > 1:
        r, value, number, is_mixed = merged(echoes)
    is_seen = rays.limits_m[0] <= r <= rays.limits_m[1]
    found.place[g, i, 0] = r if is_seen else np.nan
    for axis in range(3):
        found.place[g, i, 1 + axis] = along_beam(beam, axis, r) if is_seen else np.nan
    found.place[g, i, 4] = value if is_seen else np.nan
    found.object_id[g, i] = int(number) if is_seen else NO_OBJECT
    found.is_mixed[g, i] = is_mixed and is_seen


@compiled
def merged(echoes: Float64) -> tuple[float, float, float, bool]:
    """Range, intensity, object and whether they are mixed, of the echoes (s, 5) of one ray; its middle comes first.

    Echoes within a pulse's length of one another merge, and the range is their mean by energy (mixed pixels of time of
    flight scanners: Ye and Borenstein 2002; Tuley, Vandapel, Hebert 2005). Of groups farther apart the strongest
    counts. Where a group lies within :data:`MIXED_WITHIN_M`, it is one surface, and the ray's middle tells its range.
    """
    energy, low, high = strongest_group(echoes)
    if energy == 0.0:
        return np.nan, np.nan, NO_OBJECT, False
    if high - low <= MIXED_WITHIN_M and low <= echoes[0, 0] <= high and echoes[0, 3] > 0.0:
        return echoes[0, 0], echoes[0, 1], echoes[0, 2], False
    r, value, number, strongest = 0.0, 0.0, -1.0, 0.0
    for s in range(echoes.shape[0]):
        if echoes[s, 3] > 0.0 and low <= echoes[s, 0] <= high:
            r += echoes[s, 3] * echoes[s, 0] / energy
            value += echoes[s, 3] * echoes[s, 1] / energy
            if echoes[s, 3] > strongest:
                number, strongest = echoes[s, 2], echoes[s, 3]
    return r, value, number, True


@compiled
def strongest_group(echoes: Float64) -> tuple[float, float, float]:
    """Energy, nearest and farthest range of the echoes that arrive together with the most energy; 0: there are none.

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


@compiled
def grown_group(echoes: Float64, s: int) -> tuple[float, float, float]:
    """Energy, nearest and farthest range of the echoes that merge with that of row `s`, directly or by others."""
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
