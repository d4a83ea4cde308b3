"""The road as a function: alignment, height, depth of defects, texture and intensity.

Coordinates are easting, northing and height in metres from the scene's origin. *Nodes* lie each half metre along the
reference line; ``u`` is the station past a node.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Float32, Float64, Int64
from roadscan.simulate.kernels.options import compiled, inlined, inner, mixed

NODE_STEP_M = 0.5
"""Distance from node to node of the reference line."""
NODE_TOLERANCE_M = 1e-9  # tolerance of a node's ends

# Columns of the nodes.
STATION = 12
DEFECTS, DEFECTS_END, PATCHES, PATCHES_END, ITEMS, ITEMS_END = 13, 14, 15, 16, 17, 18  # row numbers
FALL_LEFT, FALL_RIGHT, KERB_LEFT, KERB_RIGHT = 19, 21, 23, 25  # columns of falls and kerbs
HUMPS, HUMPS_END = 27, 28  # columns of humps

# Places in the section.
CROWN, LANES_EDGE, SHOULDER_SLOPE, PAVED_EDGE, VERGE_SLOPE, ROUNDING, SURFACE_EDGE, KERB_FACE = 0, 1, 2, 3, 4, 5, 6, 7
TRACK_FIRST, TRACK_PER_M, TRACK_STATION, TRACK_STATION_PER_M, TEXTURE_PER_M, CONTRAST = 8, 9, 10, 11, 12, 13  # tracks
ASPHALT, PAINT, DEFECT, SHOULDER, VERGE, KERB = 14, 15, 16, 17, 18, 19  # places of the intensities of materials
GRASS, GRASS_FROM, GRASS_SHADE = 20, 21, 22  # height of grass, where it begins beyond the paved edge, its intensity
RUTS = 23  # place of the first rut
RUT_COLUMNS = 6  # numbers of a rut
WEAR_PLACE_M = 0.6
"""Size of places where paint is worn more or less than its mean (m)."""
FLAKE_M = 0.03
"""Size of a flake of worn paint (m)."""
KERB_TOP_M = 0.15
"""Width of a kerb's top, which differs in intensity."""


class RoadArrays(NamedTuple):
    """The road's arrays for the kernels."""

    nodes: Float64
    """(n, 29), the last node only ends the line: easting, northing (m, from the origin), sine and cosine of the grid
    heading, curvature (1/m, right positive), its change per metre up to the next node; from column 6 on the
    reference line's height as coefficients of u⁰ … u⁵; station; first row and end row in `defects`, `patches` and
    `items`; fall to the left (m/m) and its change per metre, fall to the right, height of the left kerb (m; 0: none)
    and of the right kerb, likewise; first row and end row in `humps`."""
    section: Float64
    """(23 + 6m,) constants, see the names above; then offset, 1 / half width, depth, variation, its wave number
    (rad/m) and phase of each rut."""
    defects: Float64
    """(m, 8) by node, repeated where one reaches over several. Pothole: 0, depth, 1 / radius, station, offset, 0, 0;
    piece of a crack: 1, depth, 1 / half width, station and offset of both ends; then 1 / width of the walls (0: the
    rounded form)."""
    patches: Float64
    """(m, 9) by node. Rectangle (0) or circle (1), station, offset, half length, half width, height in the middle,
    1 / edge, intensity, slope along the road."""
    lines: Float64
    """(m, 8) offset, half width, dash and period (0: solid), first and last station of each marking, the share of its
    paint that is worn off, its intensity."""
    humps: Float64
    """(m, 4) by node. Station, half of the top with both ramps, 1 / length of a ramp, height."""
    items: Float64
    """(m, 8) by node, what is painted or spilt: kind, intensity, station, offset, and
    0 rectangle: half length, half width, share of the paint that is worn off; 1 ellipse with a soft edge: half length,
    half width; 2 ring: inner and outer radius; 3 band: half width, 0, station and offset of its other end; 4 the black
    squares of a chequered target: half edge."""
    tracks: Float64
    """(t, s) unevenness (m) at even offsets and stations; (0, 0): none."""
    texture: Float32
    """(c, c) macrotexture (m) over station and offset, periodic; (0, 0): none."""


# --- alignment ---------------------------------------------------------------------------------------


@compiled
def clothoid(curvature: float, rate: float, u: float) -> tuple[float, float, float, float]:
    """Return point and direction on a short clothoid: along and right (m), sine and cosine of the turned angle.

    Power series of the Fresnel integrals; for radii over 20 m and u up to 0.5 m good to 1e-12 m.
    """
    turned = curvature * u + 0.5 * rate * u * u
    square = turned * turned
    sine = turned * (1.0 - square / 6.0 * (1.0 - square / 20.0))
    cosine = 1.0 - square / 2.0 * (1.0 - square / 12.0 * (1.0 - square / 30.0))
    u3 = u * u * u
    k2 = curvature * curvature
    along = u - u3 * (k2 / 6.0 + u * (curvature * rate / 8.0 + u * (rate * rate / 40.0 - k2 * k2 / 120.0)))
    right = u * u * curvature / 2.0 + u3 * (rate / 6.0 - u * k2 * (curvature / 24.0 + u * rate / 20.0))
    return along, right, sine, cosine


@inner
def project(road: RoadArrays, easting: float, northing: float, near: int) -> tuple[int, float, float]:
    """Return node, station past it and offset of the foot of a map point on the reference line.

    `near` is a node to start from. Beyond both ends the line continues with its last curvature.
    """
    nodes = road.nodes
    last = nodes.shape[0] - 2
    k = min(max(near, 0), last)
    u = 0.0
    offset = 0.0
    for _ in range(64):
        de = easting - nodes[k, 0]
        dn = northing - nodes[k, 1]
        ahead = de * nodes[k, 2] + dn * nodes[k, 3]
        right = de * nodes[k, 3] - dn * nodes[k, 2]
        curvature = nodes[k, 4]
        rate = nodes[k, 5]
        u = ahead / max(1.0 - curvature * right, 0.2)
        offset = right
        if -2.0 * NODE_STEP_M < u < 3.0 * NODE_STEP_M or (u < 0.0 and k == 0) or (u > 0.0 and k == last):
            for _ in range(6):
                along, aside, sine, cosine = clothoid(curvature, rate, u)
                gap = (ahead - along) * cosine + (right - aside) * sine
                offset = (right - aside) * cosine - (ahead - along) * sine
                move = gap / (1.0 - (curvature + rate * u) * offset)
                u += move
                if abs(move) < 1e-4:  # converges quadratically: the remainder is below 1e-9
                    break
            if -NODE_TOLERANCE_M <= u <= NODE_STEP_M + NODE_TOLERANCE_M:
                break
        moved = min(max(k + math.floor(u / NODE_STEP_M), 0), last)
        if moved == k:
            break
        k = moved
    return k, u, offset


@inlined
def node_at(road: RoadArrays, station: float) -> int:
    """Return the node at or before a station."""
    before = int((station - road.nodes[0, STATION]) / NODE_STEP_M)
    last: int = road.nodes.shape[0] - 2
    return min(max(before, 0), last)


@compiled
def place(road: RoadArrays, station: Float64, offset: Float64, out: Float64) -> None:
    """Write map points of stations and offsets.

    station, offset : (n,); out : (n, 3) easting, northing (m, from the origin), grid heading (rad).
    """
    nodes = road.nodes
    for i in range(station.size):
        k = node_at(road, station[i])
        u = station[i] - nodes[k, STATION]
        along, right, sine, cosine = clothoid(nodes[k, 4], nodes[k, 5], u)
        s, c = nodes[k, 2], nodes[k, 3]
        sin_here = s * cosine + c * sine
        cos_here = c * cosine - s * sine
        out[i, 0] = nodes[k, 0] + along * s + right * c + offset[i] * cos_here
        out[i, 1] = nodes[k, 1] + along * c - right * s - offset[i] * sin_here
        out[i, 2] = math.atan2(sin_here, cos_here)


# --- height ------------------------------------------------------------------------------------------


@inlined
def softened(x: float, half: float) -> float:
    """Return max(x, 0), with the bend rounded by a parabola within `half` of it."""
    if x >= half:
        return x
    if x <= -half:
        return 0.0
    return (x + half) * (x + half) / (4.0 * half)


@inlined
def smooth_step(x: float) -> float:
    """Return 0 below 0, 1 above 1, a cubic between."""
    y = min(max(x, 0.0), 1.0)
    return y * y * (3.0 - 2.0 * y)


@inlined
def section_height(road: RoadArrays, k: int, u: float, offset: float) -> float:
    """Return the cross-section's height above the reference line: crossfall, shoulder, verge, kerb and ruts (m)."""
    nodes, section = road.nodes, road.section
    fall_left = nodes[k, FALL_LEFT] + u * nodes[k, FALL_LEFT + 1]
    fall_right = nodes[k, FALL_RIGHT] + u * nodes[k, FALL_RIGHT + 1]
    crown = section[CROWN]
    height = -fall_right * softened(offset, crown) - fall_left * softened(-offset, crown)
    away = abs(offset)
    is_right = offset > 0.0
    fall = fall_right if is_right else fall_left
    bend = section[ROUNDING]
    if away > section[LANES_EDGE] - bend:
        if section[PAVED_EDGE] > section[LANES_EDGE]:
            height -= (section[SHOULDER_SLOPE] - fall) * softened(away - section[LANES_EDGE], bend)
            fall = section[SHOULDER_SLOPE]
        if away > section[PAVED_EDGE] - bend:
            height -= (section[VERGE_SLOPE] - fall) * softened(away - section[PAVED_EDGE], bend)
            if away > section[PAVED_EDGE]:
                column = KERB_RIGHT if is_right else KERB_LEFT
                kerb = nodes[k, column] + u * nodes[k, column + 1]
                height += kerb * smooth_step((away - section[PAVED_EDGE]) / section[KERB_FACE])
    for i in range(RUTS, section.size, RUT_COLUMNS):
        x = (offset - section[i]) * section[i + 1]
        wall = 1.0 - x * x
        if wall > 0.0:
            depth = section[i + 2]
            if section[i + 3] > 0.0:
                depth *= 1.0 + section[i + 3] * math.sin(section[i + 4] * (nodes[k, STATION] + u) + section[i + 5])
            height -= depth * wall * wall * wall
    result: float = height
    return result


@inlined
def cubic_weights(x: float) -> tuple[float, float, float, float]:
    """Return weights of the four values around a place `x` (0–1) between the middle two: Catmull and Rom (1974)."""
    x2 = x * x
    x3 = x2 * x
    return (
        -0.5 * x3 + x2 - 0.5 * x,
        1.5 * x3 - 2.5 * x2 + 1.0,
        -1.5 * x3 + 2.0 * x2 + 0.5 * x,
        0.5 * x3 - 0.5 * x2,
    )


@inlined
def along_track(tracks: Float64, i: int, j: int, weights: tuple[float, float, float, float]) -> float:
    """Return the height of track `i` between its samples `j` and `j` + 1 (m)."""
    value: float = (
        weights[0] * tracks[i, j - 1]
        + weights[1] * tracks[i, j]
        + weights[2] * tracks[i, j + 1]
        + weights[3] * tracks[i, j + 2]
    )
    return value


@inlined
def unevenness(road: RoadArrays, station: float, offset: float) -> float:
    """Return random unevenness (m): bicubic between the tracks, constant beyond the outermost."""
    tracks, section = road.tracks, road.section
    along = (station - section[TRACK_STATION]) * section[TRACK_STATION_PER_M]
    across = (offset - section[TRACK_FIRST]) * section[TRACK_PER_M]
    j = min(max(int(along), 1), tracks.shape[1] - 3)
    last = tracks.shape[0] - 1
    across = min(max(across, 0.0), float(last))
    i = min(int(across), last - 1)
    weights = cubic_weights(along - j)
    v0, v1, v2, v3 = cubic_weights(across - i)
    before, after = max(i - 1, 0), min(i + 2, last)
    value: float = v0 * along_track(tracks, before, j, weights) + v1 * along_track(tracks, i, j, weights)
    value += v2 * along_track(tracks, i + 1, j, weights) + v3 * along_track(tracks, after, j, weights)
    return value


@inlined
def edge_distance(patches: Float64, i: int, station: float, offset: float) -> float:
    """Return the distance inwards from the outline of patch `i` (m); negative outside."""
    ds = station - patches[i, 1]
    do = offset - patches[i, 2]
    if patches[i, 0] == 1.0:
        inward: float = patches[i, 3] - math.sqrt(ds * ds + do * do)
        return inward
    nearest: float = min(patches[i, 3] - abs(ds), patches[i, 4] - abs(do))
    return nearest


@inlined
def patch_height(patches: Float64, i: int, station: float) -> float:
    """Return the height of patch `i` above the road around it, within its edge (m)."""
    height: float = patches[i, 5] + patches[i, 8] * (station - patches[i, 1])
    return height


@inlined
def worn_height(road: RoadArrays, k: int, u: float, offset: float) -> float:
    """Return the height without potholes, cracks, joints and texture. Everywhere smooth and defined (m)."""
    nodes = road.nodes
    height: float = nodes[k, 6] + u * (
        nodes[k, 7] + u * (nodes[k, 8] + u * (nodes[k, 9] + u * (nodes[k, 10] + u * nodes[k, 11])))
    )
    height += section_height(road, k, u, offset)
    station = nodes[k, STATION] + u
    if road.tracks.size:
        height += unevenness(road, station, offset)
    humps = road.humps
    for i in range(int(nodes[k, HUMPS]), int(nodes[k, HUMPS_END])):
        x = min(max((humps[i, 1] - abs(station - humps[i, 0])) * humps[i, 2], 0.0), 1.0)
        height += humps[i, 3] * x * x * x * (10.0 - x * (15.0 - 6.0 * x))
    patches = road.patches
    for i in range(int(nodes[k, PATCHES]), int(nodes[k, PATCHES_END])):
        inward = edge_distance(patches, i, station, offset)
        if inward > 0.0:
            height += patch_height(patches, i, station) * smooth_step(inward * patches[i, 6])
    return height


@inner
def defect_depth(road: RoadArrays, k: int, u: float, offset: float) -> tuple[float, float]:
    """Return the depth of the deepest pothole, crack or joint, and the smallest radius or half width nearby (m)."""
    nodes, defects = road.nodes, road.defects
    deepest = 0.0
    finest = 1e9
    station = nodes[k, STATION] + u
    for i in range(int(nodes[k, DEFECTS]), int(nodes[k, DEFECTS_END])):
        is_crack = defects[i, 0] == 1.0
        sharpness = defects[i, 2]
        ds = station - defects[i, 3]
        do = offset - defects[i, 4]
        if is_crack:
            length_s = defects[i, 5] - defects[i, 3]
            length_o = defects[i, 6] - defects[i, 4]
            share = (ds * length_s + do * length_o) / (length_s * length_s + length_o * length_o)
            share = min(max(share, 0.0), 1.0)
            ds -= share * length_s
            do -= share * length_o
        x = (ds * ds + do * do) * sharpness * sharpness
        per_m = defects[i, 7]
        finest = min(finest, 1.0 / max(sharpness, per_m))
        if x < 1.0 and per_m > 0.0:
            deepest = max(deepest, defects[i, 1] * smooth_step((1.0 - math.sqrt(x)) / sharpness * per_m))
        elif x < 1.0:
            wall = 1.0 - (x if is_crack else x * x)
            deepest = max(deepest, defects[i, 1] * wall * wall)
    return deepest, finest


@inlined
def texture_height(road: RoadArrays, station: float, offset: float) -> float:
    """Return the macrotexture (m) of the paved surface, bilinear; 0 beside it."""
    return texture_plane(road, station, offset)[0]


@inlined
def texture_plane(road: RoadArrays, station: float, offset: float) -> tuple[float, float, float]:
    """Return the macrotexture (m) of the paved surface, bilinear, and its slopes along and across; 0 beside it."""
    texture, section = road.texture, road.section
    if texture.size == 0 or abs(offset) > section[PAVED_EDGE]:
        return 0.0, 0.0, 0.0
    last = texture.shape[0] - 1
    per_m = section[TEXTURE_PER_M]
    along = station * per_m
    across = offset * per_m
    i, j = math.floor(along), math.floor(across)
    x, y = along - i, across - j
    i0, j0 = i & last, j & last
    i1, j1 = (i0 + 1) & last, (j0 + 1) & last
    here, right = texture[i0, j0], texture[i0, j1]
    ahead, beyond = texture[i1, j0], texture[i1, j1]
    low = here + y * (right - here)
    high = ahead + y * (beyond - ahead)
    slope_right = (right - here) + x * ((beyond - ahead) - (right - here))
    return low + x * (high - low), (high - low) * per_m, slope_right * per_m


@inlined
def on_surface(road: RoadArrays, k: int, u: float, offset: float) -> bool:
    """Return whether the surface is defined here."""
    last = road.nodes.shape[0] - 2
    inside: bool = abs(offset) <= road.section[SURFACE_EDGE]
    return inside and (k > 0 or u >= -NODE_TOLERANCE_M) and (k < last or u <= NODE_STEP_M + NODE_TOLERANCE_M)


# --- intensity ---------------------------------------------------------------------------------------


@inlined
def material(road: RoadArrays, k: int, u: float, offset: float) -> float:
    """Return the intensity of the surface material, without paint and spills."""
    nodes, section, patches = road.nodes, road.section, road.patches
    away = abs(offset)
    value = section[ASPHALT]
    if away > section[PAVED_EDGE]:
        value = section[VERGE] if away < section[PAVED_EDGE] + section[GRASS_FROM] else section[GRASS_SHADE]
        column = KERB_RIGHT if offset > 0.0 else KERB_LEFT
        if nodes[k, column] > 0.0 and away < section[PAVED_EDGE] + KERB_TOP_M:
            value = section[KERB]
    elif away > section[LANES_EDGE]:
        value = section[SHOULDER]
    station = nodes[k, STATION] + u
    for i in range(int(nodes[k, PATCHES]), int(nodes[k, PATCHES_END])):
        if edge_distance(patches, i, station, offset) > 0.0:
            value = patches[i, 7]
    result: float = value
    return result


@inlined
def brightness(road: RoadArrays, k: int, u: float, offset: float, depth: float, stone: float) -> float:
    """Return the intensity (digital numbers) of a surface with a defect `depth` deep and texture `stone` high (m)."""
    nodes, section, lines, items = road.nodes, road.section, road.lines, road.items
    if depth > 0.0:
        inside: float = section[DEFECT]
        return inside
    value = material(road, k, u, offset)
    station = nodes[k, STATION] + u
    if abs(offset) <= section[PAVED_EDGE]:
        for i in range(lines.shape[0]):
            if abs(offset - lines[i, 0]) <= lines[i, 1] and lines[i, 4] <= station <= lines[i, 5]:
                period = lines[i, 3]
                is_dash = period == 0.0 or station % period < lines[i, 2]
                if is_dash and not is_worn(lines[i, 6], station, offset):
                    value = lines[i, 7]
    for i in range(int(nodes[k, ITEMS]), int(nodes[k, ITEMS_END])):
        value = painted(items, i, station, offset, value)
    shade: float = value + section[CONTRAST] * stone
    return shade


@inlined
def lattice(i: int, j: int) -> float:
    """Return the random number, 0 to 1, of a node of a lattice."""
    bits = mixed(mixed(np.uint64(i + (1 << 30))) ^ np.uint64(j + (1 << 30)))
    value: float = float(bits >> np.uint64(11)) / 9007199254740992.0
    return value


@inlined
def is_worn(share: float, station: float, offset: float) -> bool:
    """Return whether paint of which a share is worn off is lost here: in flakes, in some places more than in others."""
    if share <= 0.0:
        return False
    u, v = station / WEAR_PLACE_M, offset / WEAR_PLACE_M
    i, j = math.floor(u), math.floor(v)
    u, v = u - i, v - j
    place = (1.0 - v) * ((1.0 - u) * lattice(i, j) + u * lattice(i + 1, j))
    place += v * ((1.0 - u) * lattice(i, j + 1) + u * lattice(i + 1, j + 1))
    return lattice(math.floor(station / FLAKE_M), math.floor(offset / FLAKE_M)) < share + place - 0.5


@inlined
def painted(items: Float64, i: int, station: float, offset: float, under: float) -> float:
    """Return the intensity where item `i` covers a surface of intensity `under`."""
    kind = items[i, 0]
    ds = station - items[i, 2]
    do = offset - items[i, 3]
    cover = 0.0
    if kind == 0.0:
        inside = abs(ds) <= items[i, 4] and abs(do) <= items[i, 5]
        cover = 1.0 if inside and not is_worn(items[i, 6], station, offset) else 0.0
    elif kind == 1.0:
        x = (ds / items[i, 4]) ** 2 + (do / items[i, 5]) ** 2
        cover = (1.0 - x * x) if x < 1.0 else 0.0
    elif kind == 2.0:
        away = math.sqrt(ds * ds + do * do)
        cover = 1.0 if items[i, 4] <= away <= items[i, 5] else 0.0
    elif kind == 4.0:
        cover = 1.0 if max(abs(ds), abs(do)) <= items[i, 4] and ds * do > 0.0 else 0.0
    else:
        length_s = items[i, 6] - items[i, 2]
        length_o = items[i, 7] - items[i, 3]
        share = (ds * length_s + do * length_o) / (length_s * length_s + length_o * length_o)
        share = min(max(share, 0.0), 1.0)
        ds -= share * length_s
        do -= share * length_o
        cover = 1.0 if ds * ds + do * do <= items[i, 4] * items[i, 4] else 0.0
    value: float = under + cover * (items[i, 1] - under)
    return value


# --- at map points -----------------------------------------------------------------------------------


@compiled
def survey_points(road: RoadArrays, easting: Float64, northing: Float64, near: Int64, out: Float64) -> None:
    """Write the exact surface properties at map points.

    easting, northing : (n,) m from the origin; near : (n,) nodes to start from;
    out : (n, 6) height without texture (NaN off the surface), station, offset, depth of defects, intensity, texture.
    """
    for i in range(easting.size):
        k, u, offset = project(road, easting[i], northing[i], int(np.int64(near[i])))
        station = road.nodes[k, STATION] + u
        depth, _ = defect_depth(road, k, u, offset)
        known = on_surface(road, k, u, offset)
        out[i, 0] = worn_height(road, k, u, offset) - depth if known else np.nan
        out[i, 1] = station
        out[i, 2] = offset
        out[i, 3] = depth
        out[i, 5] = texture_height(road, station, offset)
        out[i, 4] = brightness(road, k, u, offset, depth, out[i, 5])


@compiled
def heights_along(road: RoadArrays, station: Float64, offset: Float64, out: Float64) -> None:
    """Write the height without potholes, cracks, joints and texture at stations and offsets. All arrays (n,), m."""
    for i in range(station.size):
        k = node_at(road, station[i])
        out[i] = worn_height(road, k, station[i] - road.nodes[k, STATION], offset[i])
