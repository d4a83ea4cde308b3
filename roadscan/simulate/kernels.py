"""The simulator's loops: alignment, height of the road, and where beams meet it.

All compiled functions stand in this one file, because Numba's cache does not notice a change in another one.
Coordinates are easting, northing and height in metres from the scene's origin. *Nodes* lie each half metre along the
reference line; ``u`` is the station past a node.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]
UInt16 = npt.NDArray[np.uint16]
UInt32 = npt.NDArray[np.uint32]
UInt8 = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]

LIDAR_TOLERANCE_M = 1e-7
"""The same for the lidar."""
BYTES_SIGMA = 104.51
"""Standard deviation of the sum of two random bytes: sqrt(2 · (256² − 1) / 12)."""

_Function = TypeVar("_Function", bound=Callable[..., Any])

NODE_STEP_M = 0.5
"""Distance from node to node of the reference line."""
NODE_TOLERANCE_M = 1e-9
ROOT_TOLERANCE_M = 1e-8
"""A beam's end lies this near to the surface (m), measured along the height."""


def compiled(function: _Function) -> _Function:
    """Compile serially, without the GIL; `fastmath` stays off so that results do not change.

    Numba's memory manager is off: counting references to the arrays of these short functions took half of the time.
    So nothing can be allocated inside; scratch arrays are handed in.
    """
    options = {"nogil": True, "cache": True, "error_model": "numpy", "_nrt": False}
    return cast("_Function", numba.njit(**options)(function))


class RoadArrays(NamedTuple):
    """The road as the kernels see it.

    Inner functions take the arrays they need one by one: handing on a tuple costs two locked instructions an array.
    """

    nodes: Float64
    """(n, 15), the last node only ends the line: easting, northing (m, from the origin), sine and cosine of the grid
    heading, curvature (1/m, right positive), its change per metre up to the next node; from column 6 on the
    reference line's height as coefficients of u⁰ … u⁵; station; first row and end row in `defects`."""
    section: Float64
    """(6 + 3m,) cross slope, crown rounding, half width of the lanes, verge slope − cross slope, verge rounding,
    offset of the surface's edge; then offset, 1 / half width and depth of each rut."""
    defects: Float64
    """(m, 7) by node, repeated where one reaches over several. Pothole: 0, depth, 1 / radius, station, offset, 0, 0;
    piece of a crack: 1, depth, 1 / half width, station and offset of both ends."""
    paint: Float64
    """(m + 1, 4) intensity of asphalt, marking, defect and verge; then offset, half width, dash and period (0: solid)
    of each marking."""


# --- alignment ---------------------------------------------------------------------------------------


@compiled
def clothoid(curvature: float, rate: float, u: float) -> tuple[float, float, float, float]:
    """Point and direction on a short clothoid: along and right (m), sine and cosine of the turned angle.

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


@compiled
def project(nodes: Float64, easting: float, northing: float, near: int) -> tuple[int, float, float]:
    """Node, station past it and offset of the foot of a map point on the reference line.

    `near` is a node to start from. Beyond both ends the line goes on with its last curvature.
    """
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
                if abs(move) < 1e-4:  # converges quadratically: what is left is below 1e-9
                    break
            if -NODE_TOLERANCE_M <= u <= NODE_STEP_M + NODE_TOLERANCE_M:
                break
        moved = min(max(k + math.floor(u / NODE_STEP_M), 0), last)
        if moved == k:
            break
        k = moved
    return k, u, offset


@compiled
def node_at(nodes: Float64, station: float) -> int:
    """Node at or before a station."""
    before = int((station - nodes[0, 12]) / NODE_STEP_M)
    last: int = nodes.shape[0] - 2
    return min(max(before, 0), last)


@compiled
def place(road: RoadArrays, station: Float64, offset: Float64, out: Float64) -> None:
    """Map points of stations and offsets.

    station, offset : (n,); out : (n, 3) easting, northing (m, from the origin), grid heading (rad).
    """
    nodes = road.nodes
    for i in range(station.size):
        k = node_at(nodes, station[i])
        u = station[i] - nodes[k, 12]
        along, right, sine, cosine = clothoid(nodes[k, 4], nodes[k, 5], u)
        s, c = nodes[k, 2], nodes[k, 3]
        sin_here = s * cosine + c * sine
        cos_here = c * cosine - s * sine
        out[i, 0] = nodes[k, 0] + along * s + right * c + offset[i] * cos_here
        out[i, 1] = nodes[k, 1] + along * c - right * s - offset[i] * sin_here
        out[i, 2] = math.atan2(sin_here, cos_here)


# --- surface -----------------------------------------------------------------------------------------


@compiled
def worn_height(nodes: Float64, section: Float64, k: int, u: float, offset: float) -> float:
    """Height without potholes and cracks: profile, crown, verge and ruts. Everywhere smooth and defined."""
    height: float = nodes[k, 6] + u * (
        nodes[k, 7] + u * (nodes[k, 8] + u * (nodes[k, 9] + u * (nodes[k, 10] + u * nodes[k, 11])))
    )
    away = abs(offset)
    if away < section[1]:
        away = (offset * offset + section[1] * section[1]) / (2.0 * section[1])
    height -= section[0] * away
    beyond = away - section[2]
    if beyond > -section[4]:
        if beyond < section[4]:
            beyond = (beyond + section[4]) ** 2 / (4.0 * section[4])
        height -= section[3] * beyond
    for i in range(6, section.size, 3):
        x = (offset - section[i]) * section[i + 1]
        wall = 1.0 - x * x
        if wall > 0.0:
            height -= section[i + 2] * wall * wall * wall
    return height


@compiled
def defect_depth(nodes: Float64, defects: Float64, k: int, u: float, offset: float) -> tuple[float, float]:
    """Depth of the deepest pothole or crack here, and the smallest radius or half width near this node (m)."""
    deepest = 0.0
    finest = 1e9
    station = nodes[k, 12] + u
    for i in range(int(nodes[k, 13]), int(nodes[k, 14])):
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
        finest = min(finest, 1.0 / sharpness)
        if x < 1.0:
            wall = 1.0 - (x if is_crack else x * x)
            deepest = max(deepest, defects[i, 1] * wall * wall)
    return deepest, finest


@compiled
def on_surface(nodes: Float64, section: Float64, k: int, u: float, offset: float) -> bool:
    """Whether the surface is defined here."""
    last = nodes.shape[0] - 2
    inside: bool = abs(offset) <= section[5]
    return inside and (k > 0 or u >= -NODE_TOLERANCE_M) and (k < last or u <= NODE_STEP_M + NODE_TOLERANCE_M)


@compiled
def brightness(section: Float64, paint: Float64, station: float, offset: float, depth: float) -> float:
    """Intensity of the surface (digital numbers)."""
    material = 0
    if depth > 0.0:
        material = 2
    elif abs(offset) > section[2]:
        material = 3
    else:
        for i in range(1, paint.shape[0]):
            if abs(offset - paint[i, 0]) <= paint[i, 1]:
                period = paint[i, 3]
                if period == 0.0 or station % period < paint[i, 2]:
                    material = 1
    found: float = paint[0, material]
    return found


@compiled
def survey_points(road: RoadArrays, easting: Float64, northing: Float64, near: Int64, out: Float64) -> None:
    """What lies at map points, exactly.

    easting, northing : (n,) m from the origin; near : (n,) nodes to start from;
    out : (n, 5) height (NaN off the surface), station, offset, depth of defects, intensity.
    """
    nodes, section, defects, paint = road
    for i in range(easting.size):
        k, u, offset = project(nodes, easting[i], northing[i], near[i])
        depth, _ = defect_depth(nodes, defects, k, u, offset)
        known = on_surface(nodes, section, k, u, offset)
        out[i, 0] = worn_height(nodes, section, k, u, offset) - depth if known else np.nan
        out[i, 1] = nodes[k, 12] + u
        out[i, 2] = offset
        out[i, 3] = depth
        out[i, 4] = brightness(section, paint, nodes[k, 12] + u, offset, depth)


@compiled
def heights_along(road: RoadArrays, station: Float64, offset: Float64, out: Float64) -> None:
    """Height without potholes and cracks at stations and offsets. All arrays (n,), m."""
    nodes, section, _, _ = road
    for i in range(station.size):
        k = node_at(nodes, station[i])
        out[i] = worn_height(nodes, section, k, station[i] - nodes[k, 12], offset[i])


# --- beams -------------------------------------------------------------------------------------------
# A beam is followed in road coordinates: station, offset and height are parabolas of its range r, because map and
# road bend. beam (3, 3) holds the coefficients of 1, r, r² of each.


@compiled
def along_beam(beam: Float64, axis: int, r: float) -> float:
    """Station, offset or height (axis 0, 1, 2) at range `r` of a beam (3, 3)."""
    value: float = beam[axis, 0] + r * (beam[axis, 1] + r * beam[axis, 2])
    return value


@compiled
def through(beam: Float64, axis: int, step: float, first: float, second: float, third: float) -> None:
    """Lay the parabola of one axis of a beam through its values at r = 0, step and 2 · step."""
    beam[axis, 0] = first
    beam[axis, 1] = (4.0 * second - 3.0 * first - third) / (2.0 * step)
    beam[axis, 2] = (first - 2.0 * second + third) / (2.0 * step * step)


@compiled
def into_defect(
    nodes: Float64, section: Float64, defects: Float64, beam: Float64, r: float, fall: float
) -> tuple[float, float]:
    """Follow a beam from the rim's level at `r` down to the wall or floor of a pothole or crack.

    Walks in steps short against the defect's width (seen from above), so that the first wall in the way
    stops the beam, then closes in on it (Illinois variant of the false position, Dowell and Jarratt 1971).

    fall : loss of clearance per metre of range (positive). Returns range and depth there.
    """
    station, offset = along_beam(beam, 0, r), along_beam(beam, 1, r)
    k = node_at(nodes, station)
    depth, finest = defect_depth(nodes, defects, k, station - nodes[k, 12], offset)
    level = math.hypot(beam[0, 1] + 2.0 * r * beam[0, 2], beam[1, 1] + 2.0 * r * beam[1, 2])
    stride = max(min(depth / fall, 0.25 * finest / (level + 1e-6)), 1e-5)
    low, low_gap = r, depth
    high, high_gap = r, depth
    middle = r
    side = 0
    walking = True
    for _ in range(200_000):
        middle = low + stride if walking else (low * high_gap - high * low_gap) / (high_gap - low_gap)
        station, offset = along_beam(beam, 0, middle), along_beam(beam, 1, middle)
        k = node_at(nodes, station)
        depth, _ = defect_depth(nodes, defects, k, station - nodes[k, 12], offset)
        floor = worn_height(nodes, section, k, station - nodes[k, 12], offset) - depth
        gap = along_beam(beam, 2, middle) - floor
        if walking and gap > 0.0:
            low, low_gap = middle, gap
            continue
        if abs(gap) < ROOT_TOLERANCE_M or (not walking and high - low < ROOT_TOLERANCE_M):
            break
        if gap > 0.0:
            low, low_gap = middle, gap
            if side == 1:
                high_gap *= 0.5
            side = 1
        else:
            high, high_gap = middle, gap
            if side == -1:
                low_gap *= 0.5
            side = 0 if walking else -1
            walking = False
    return middle, depth


@compiled
def clearance(nodes: Float64, section: Float64, beam: Float64, r: float, near: int) -> tuple[float, int, float, float]:
    """Height of a beam's point above the surface without defects, and its node, u, offset.

    beam : (3, 3) of easting, northing, height.
    """
    k, u, offset = project(nodes, along_beam(beam, 0, r), along_beam(beam, 1, r), near)
    return along_beam(beam, 2, r) - worn_height(nodes, section, k, u, offset), k, u, offset


@compiled
def turn_to_road(nodes: Float64, beam: Float64, r: float, step: float, near: int) -> None:
    """Turn a beam in the map into road coordinates and count it from range `r`.

    Exact there and at `step` and 2 · `step` further on. beam : (3, 3), in and out.
    """
    k0, u0, offset0 = project(nodes, along_beam(beam, 0, r), along_beam(beam, 1, r), near)
    k1, u1, offset1 = project(nodes, along_beam(beam, 0, r + step), along_beam(beam, 1, r + step), k0)
    end = r + 2.0 * step
    k2, u2, offset2 = project(nodes, along_beam(beam, 0, end), along_beam(beam, 1, end), k1)
    height0, height1, height2 = along_beam(beam, 2, r), along_beam(beam, 2, r + step), along_beam(beam, 2, end)
    through(beam, 0, step, nodes[k0, 12] + u0, nodes[k1, 12] + u1, nodes[k2, 12] + u2)
    through(beam, 1, step, offset0, offset1, offset2)
    through(beam, 2, step, height0, height1, height2)


# --- profilers ---------------------------------------------------------------------------------------


@compiled
def survey_planes(nodes: Float64, easting: Float64, northing: Float64, near: Int64, out: Float64) -> None:
    """Station and offset of points on the planes of profiles.

    easting, northing : (p, m); near : (p,) nodes to start from; out : (p, m, 2).
    """
    for p in range(easting.shape[0]):
        k = near[p]
        for i in range(easting.shape[1]):
            k, u, offset = project(nodes, easting[p, i], northing[p, i], k)
            out[p, i, 0] = nodes[k, 12] + u
            out[p, i, 1] = offset


@compiled
def road_beam(planes: Float64, p: int, y: float, beam: Float64) -> None:
    """Beam of the reading at transverse position `y` of profile `p`, in road coordinates.

    planes : (p, 3, 9) for station, offset and height the coefficients of 1, y, y², y³, y⁴, r, y·r, y²·r, r², where r
    counts from the plane's middle range; beam : (3, 3), out.
    """
    for axis in range(3):
        beam[axis, 0] = planes[p, axis, 0] + y * (
            planes[p, axis, 1] + y * (planes[p, axis, 2] + y * (planes[p, axis, 3] + y * planes[p, axis, 4]))
        )
        beam[axis, 1] = planes[p, axis, 5] + y * (planes[p, axis, 6] + y * planes[p, axis, 7])
        beam[axis, 2] = planes[p, axis, 8]


@compiled
def map_beam(planes: Float64, p: int, y: float, beam: Float64) -> None:
    """The same in the map.

    planes : (p, 3, 6) for easting, northing and height the coefficients of 1, y, y², r, y·r, r².
    """
    for axis in range(3):
        beam[axis, 0] = planes[p, axis, 0] + y * (planes[p, axis, 1] + y * planes[p, axis, 2])
        beam[axis, 1] = planes[p, axis, 3] + y * planes[p, axis, 4]
        beam[axis, 2] = planes[p, axis, 5]


@compiled
def scan_profiles(
    road: RoadArrays,
    road_planes: Float64,
    map_planes: Float64,
    is_bent: Flags,
    y_sensor_m: Float64,
    scale: Float64,
    noise_m: Float32,
    bits: UInt32,
    beam: Float64,
    ranges: UInt16,
    intensity: UInt8,
    true_range_m: Float64,
) -> None:
    """Measure profiles of a triangulation head.

    Parameters
    ----------
    road_planes, map_planes : (p, 3, 9), see :func:`road_beam`, and (p, 3, 6), see :func:`map_beam`.
    is_bent : (p,) whether the road bends so much here that `road_planes` are only a first approximation.
    y_sensor_m : (n,) transverse positions of the readings.
    scale : (5,) middle range of the planes (m), range of raw 0 (m), range step (m), share of lost readings,
        intensity noise.
    noise_m : (p, n) range noise, or (0, 0) for none.
    bits : (p, n) random bits for losses and intensity noise, or (0, 0) for none of both.
    beam : (3, 3) scratch.
    ranges, intensity : (p, n), out.
    true_range_m : (p, n), out; NaN where the beam misses. (0, 0): not wanted.
    """
    nodes, section, defects, paint = road
    middle_range = scale[0]
    lost_below = scale[3] * 65536.0
    jitter = scale[4] / BYTES_SIGMA
    for p in range(road_planes.shape[0]):
        before = 0.0
        r = before
        fall = 1.0
        for i in range(y_sensor_m.size):
            y = y_sensor_m[i]
            start = 2.0 * r - before if i > 1 else r  # the road goes on as it did
            before = r
            road_beam(road_planes, p, y, beam)
            r, k, u, offset, fall = plain_range(nodes, section, beam, start, fall, i > 1)
            if is_bent[p]:
                map_beam(map_planes, p, y, beam)
                r, k, u, offset = polished_range(nodes, section, beam, r, fall, k)
            found = middle_range + r
            depth = 0.0
            if nodes[k, 13] < nodes[k, 14]:
                depth, _ = defect_depth(nodes, defects, k, u, offset)
                if depth > 0.0:
                    map_beam(map_planes, p, y, beam)
                    turn_to_road(nodes, beam, r, 0.02, k)
                    further, depth = into_defect(nodes, section, defects, beam, 0.0, fall)
                    found += further
            seen = on_surface(nodes, section, k, u, offset)
            if true_range_m.size:
                true_range_m[p, i] = found if seen else np.nan
            value = brightness(section, paint, nodes[k, 12] + u, offset, depth)
            if bits.size:
                seen = seen and (bits[p, i] >> 16) >= lost_below
                value += jitter * (float(bits[p, i] & 255) + float((bits[p, i] >> 8) & 255) - 255.0)
            if noise_m.size:
                found += noise_m[p, i]
            raw = math.floor((found - scale[1]) / scale[2] + 0.5)
            seen = seen and 1.0 <= raw <= 65535.0
            ranges[p, i] = int(raw) if seen else 0
            intensity[p, i] = int(min(max(value, 0.0), 255.0)) if seen else 0


@compiled
def plain_range(
    nodes: Float64, section: Float64, beam: Float64, start: float, fall: float, is_fall_known: bool
) -> tuple[float, int, float, float, float]:
    """Range, node, u, offset where a beam in road coordinates meets the surface without defects, and its fall there.

    The slope of a neighbouring reading is right to better than a tenth, so a last step of 1 µm leaves less than 0.1 µm.
    """
    r = start
    enough = 1e-6 if is_fall_known else ROOT_TOLERANCE_M
    last_gap, moved = 0.0, 0.0
    k, u, offset = 0, 0.0, 0.0
    for _ in range(30):
        station, offset = along_beam(beam, 0, r), along_beam(beam, 1, r)
        k = node_at(nodes, station)
        u = station - nodes[k, 12]
        gap = along_beam(beam, 2, r) - worn_height(nodes, section, k, u, offset)
        if abs(moved) > 1e-5:
            fall = min(max((last_gap - gap) / moved, 0.3), 2.0)
        moved = gap / fall
        r += moved
        if abs(moved) < enough:
            break
        last_gap = gap
    return r, k, u, offset, fall


@compiled
def polished_range(
    nodes: Float64, section: Float64, beam: Float64, start: float, fall: float, near: int
) -> tuple[float, int, float, float]:
    """Range, node, u, offset where a beam in the map meets the surface without defects, near `start`."""
    r = start
    k, u, offset = near, 0.0, 0.0
    for _ in range(10):
        gap, k, u, offset = clearance(nodes, section, beam, r, k)
        r += gap / fall
        if abs(gap) < ROOT_TOLERANCE_M:
            break
    return r, k, u, offset


# --- lidar -------------------------------------------------------------------------------------------


@compiled
def bend(bases: Float64, axis: int, x: float, y: float, z: float) -> float:
    """Easting, northing or height (axis 0, 1, 2) of a point near an anchor: quadratic in its east, north, up.

    bases : (3, 10) coefficients of 1, x, y, z, x², xy, xz, y², yz, z².
    """
    east = x * (bases[axis, 1] + x * bases[axis, 4] + y * bases[axis, 5] + z * bases[axis, 6])
    north = y * (bases[axis, 2] + y * bases[axis, 7] + z * bases[axis, 8])
    value: float = bases[axis, 0] + east + north + z * (bases[axis, 3] + z * bases[axis, 9])
    return value


@compiled
def turned(rotations: Float64, p: int, share: float, axis: int, x: float, y: float, z: float) -> float:
    """One component of a sensor's vector in the anchor's frame, between the rotations of packet `p` and the next.

    Linear in time: over the 0.55 ms of a packet that is good to 10⁻⁸ at 10 degrees a second.
    """
    begin = rotations[p, axis, 0] * x + rotations[p, axis, 1] * y + rotations[p, axis, 2] * z
    end = rotations[p + 1, axis, 0] * x + rotations[p + 1, axis, 1] * y + rotations[p + 1, axis, 2] * z
    value: float = begin + share * (end - begin)
    return value


@compiled
def between(origins_m: Float64, p: int, share: float, axis: int) -> float:
    """One coordinate of the sensor between the beginning of packet `p` and the next."""
    value: float = origins_m[p, axis] + share * (origins_m[p + 1, axis] - origins_m[p, axis])
    return value


@compiled
def fire_lidar(
    road: RoadArrays,
    bases: Float64,
    origins_m: Float64,
    rotations: Float64,
    near: Int64,
    elevation: Float64,
    azimuth_rad: Float64,
    firing_share: Float64,
    limits_m: Float64,
    memory: Float64,
    beam: Float64,
    on_road: Float64,
    out: Float64,
) -> None:
    """Ranges of a spinning lidar's firings.

    Parameters
    ----------
    bases : (3, 10), see :func:`bend`.
    origins_m, rotations, near : (p + 1, 3) and (p + 1, 3, 3) pose of the sensor (x forward, y left, z up) in the
        anchor's east, north, up at the packets' beginnings and the last one's end, and (p + 1,) the node under it.
    elevation : (l, 3) sine and cosine of each laser's elevation, and its origin's height along the sensor's z (m).
    azimuth_rad : (p, c, l) clockwise from the sensor's x, seen from above.
    firing_share : (c, l) time of each firing within its packet, as a share of the packet's time.
    limits_m : (2,) nearest and farthest range measured.
    memory : (l, 3) NaN at first, see :func:`first_hit`.
    beam, on_road : (3, 3) scratch.
    out : (p, c, l, 5) range, easting, northing, height (m), intensity; all NaN: no return.
    """
    nodes, section, defects, paint = road
    packets, cycles, lasers = azimuth_rad.shape
    reach = 0.5 * limits_m[1]
    for p in range(packets):
        for c in range(cycles):
            for j in range(lasers):
                for i in range(5):
                    out[p, c, j, i] = np.nan
                share = firing_share[c, j]
                forward = elevation[j, 1] * math.cos(azimuth_rad[p, c, j])
                left = -elevation[j, 1] * math.sin(azimuth_rad[p, c, j])
                up = elevation[j, 0]
                rise = elevation[j, 2]
                dx = reach * turned(rotations, p, share, 0, forward, left, up)
                dy = reach * turned(rotations, p, share, 1, forward, left, up)
                dz = reach * turned(rotations, p, share, 2, forward, left, up)
                if dz > -0.01 * reach:
                    memory[j, 0] = np.nan
                    continue
                x = between(origins_m, p, share, 0) + turned(rotations, p, share, 0, 0.0, 0.0, rise)
                y = between(origins_m, p, share, 1) + turned(rotations, p, share, 1, 0.0, 0.0, rise)
                z = between(origins_m, p, share, 2) + turned(rotations, p, share, 2, 0.0, 0.0, rise)
                for axis in range(3):
                    first = bend(bases, axis, x, y, z)
                    second = bend(bases, axis, x + dx, y + dy, z + dz)
                    third = bend(bases, axis, x + 2.0 * dx, y + 2.0 * dy, z + 2.0 * dz)
                    through(beam, axis, reach, first, second, third)
                found, k, u, offset, depth = first_hit(
                    nodes, section, defects, beam, on_road, limits_m, near[p], memory, j
                )
                if math.isnan(found) or not on_surface(nodes, section, k, u, offset):
                    continue
                out[p, c, j, 0] = found
                for axis in range(3):
                    out[p, c, j, 1 + axis] = along_beam(beam, axis, found)
                out[p, c, j, 4] = brightness(section, paint, nodes[k, 12] + u, offset, depth)


@compiled
def first_hit(
    nodes: Float64,
    section: Float64,
    defects: Float64,
    beam: Float64,
    on_road: Float64,
    limits_m: Float64,
    near: int,
    memory: Float64,
    laser: int,
) -> tuple[float, int, float, float, float]:
    """Range at which a beam meets the road, with node, u, offset and depth of the defect there; NaN: it does not.

    The surface without defects is met once by beams steeper than its slopes; the shallower ones are out of range.

    beam : (3, 3) of easting, northing, height, in place of station, offset, height; on_road : (3, 3) scratch;
    limits_m : (2,) nearest and farthest range; near : node to start from;
    memory : (lasers, 3) where the laser's last two beams met that surface (m, NaN: nowhere), and its slope along the
    last; in and out.
    """
    guess = 2.0 * memory[laser, 0] - memory[laser, 1]
    if math.isnan(guess):
        guess = memory[laser, 0]
    r, k, u, offset = chased_range(nodes, section, beam, limits_m, near, guess, memory, laser)
    if math.isnan(r):
        r, k, u, offset = bracketed_range(nodes, section, beam, limits_m, near)
        memory[laser, 2] = 0.0
    memory[laser, 1] = memory[laser, 0]
    memory[laser, 0] = r
    if math.isnan(r):
        return r, k, u, offset, 0.0
    depth, _ = defect_depth(nodes, defects, k, u, offset)
    found = r
    if depth > 0.0:
        fall = -(beam[2, 1] + 2.0 * r * beam[2, 2])
        for row in range(3):
            for column in range(3):
                on_road[row, column] = beam[row, column]
        turn_to_road(nodes, on_road, r, 0.1, k)
        further, depth = into_defect(nodes, section, defects, on_road, 0.0, fall)
        found = r + further
        _, k, u, offset = clearance(nodes, section, beam, found, k)
    return found, k, u, offset, depth


@compiled
def chased_range(
    nodes: Float64,
    section: Float64,
    beam: Float64,
    limits_m: Float64,
    near: int,
    guess_m: float,
    memory: Float64,
    laser: int,
) -> tuple[float, int, float, float]:
    """Range, node, u and offset where a beam meets the surface without defects, by the secant from a guess.

    NaN where there is no guess, or it leads nowhere within a few steps.
    """
    k, u, offset = near, 0.0, 0.0
    r = guess_m
    descent = -(beam[2, 1] + 2.0 * r * beam[2, 2])
    fall = descent + memory[laser, 2]
    last_gap, moved = 0.0, 0.0
    for _ in range(6):
        if not limits_m[0] <= r <= limits_m[1] or fall < 0.02:
            break
        gap, k, u, offset = clearance(nodes, section, beam, r, k)
        if abs(moved) > 1e-5:
            fall = (last_gap - gap) / moved
            memory[laser, 2] = fall - descent
        if abs(gap) < LIDAR_TOLERANCE_M:
            return r, k, u, offset
        last_gap = gap
        moved = gap / fall
        r += moved
    return np.nan, k, u, offset


@compiled
def bracketed_range(
    nodes: Float64, section: Float64, beam: Float64, limits_m: Float64, near: int
) -> tuple[float, int, float, float]:
    """Range, node, u and offset where a beam meets the surface without defects; NaN: not within the limits."""
    low, high = limits_m[0], limits_m[1]
    high_gap, k, u, offset = clearance(nodes, section, beam, high, near)
    if high_gap > 0.0:
        return np.nan, k, u, offset
    low_gap, k, u, offset = clearance(nodes, section, beam, low, near)
    if low_gap <= 0.0:
        return np.nan, k, u, offset
    r = low
    side = 0
    for _ in range(60):
        r = (low * high_gap - high * low_gap) / (high_gap - low_gap)
        gap, k, u, offset = clearance(nodes, section, beam, r, k)
        if abs(gap) < ROOT_TOLERANCE_M or high - low < ROOT_TOLERANCE_M:
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
