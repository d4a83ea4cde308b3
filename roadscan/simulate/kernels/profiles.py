"""Profiles of a triangulation head: finds where the parallel beams of its planes meet the road."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from roadscan.compute.array_types import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16
from roadscan.simulate.kernels.beams import ROOT_TOLERANCE_M, along_beam, clearance, into_defect, turn_to_road
from roadscan.simulate.kernels.options import compiled, inlined, inner, mixed
from roadscan.simulate.kernels.road import (
    DEFECTS,
    DEFECTS_END,
    STATION,
    RoadArrays,
    brightness,
    defect_depth,
    node_at,
    on_surface,
    project,
    texture_plane,
    worn_height,
)
from roadscan.simulate.kernels.things import meet, shade

WALL_STEP_M = 0.0005
"""Step along a line of sight out of a defect (m)."""
WALK_M = 0.5
"""Distance above the last guess at which a beam's search begins (m)."""


@compiled
def survey_planes(road: RoadArrays, easting: Float64, northing: Float64, near: Int64, out: Float64) -> None:
    """Write station and offset of points on the planes of profiles.

    easting, northing : (p, m); near : (p,) nodes to start from; out : (p, m, 2).
    """
    for p in range(easting.shape[0]):
        k = near[p]
        for i in range(easting.shape[1]):
            k, u, offset = project(road, easting[p, i], northing[p, i], k)
            out[p, i, 0] = road.nodes[k, STATION] + u
            out[p, i, 1] = offset


@inlined
def road_beam(planes: Float64, p: int, y: float, beam: Float64) -> None:
    """Write the beam of the reading at transverse position `y` of profile `p`, in road coordinates.

    planes : (p, 3, 9) for station, offset and height the coefficients of 1, y, y², y³, y⁴, r, y·r, y²·r, r², where r
    counts from the plane's middle range; beam : (3, 3), out.
    """
    for axis in range(3):
        beam[axis, 0] = planes[p, axis, 0] + y * (
            planes[p, axis, 1] + y * (planes[p, axis, 2] + y * (planes[p, axis, 3] + y * planes[p, axis, 4]))
        )
        beam[axis, 1] = planes[p, axis, 5] + y * (planes[p, axis, 6] + y * planes[p, axis, 7])
        beam[axis, 2] = planes[p, axis, 8]


@inlined
def map_beam(planes: Float64, p: int, y: float, beam: Float64) -> None:
    """Write the same beam in the map.

    planes : (p, 3, 6) for easting, northing and height the coefficients of 1, y, y², r, y·r, r².
    """
    for axis in range(3):
        beam[axis, 0] = planes[p, axis, 0] + y * (planes[p, axis, 1] + y * planes[p, axis, 2])
        beam[axis, 1] = planes[p, axis, 3] + y * planes[p, axis, 4]
        beam[axis, 2] = planes[p, axis, 5]


class Planes(NamedTuple):
    """Planes of p profiles as polynomials of a reading's y and of its range from their middle range."""

    in_road: Float64
    """(p, 3, 9) station, offset, height, see :func:`road_beam`."""
    in_map: Float64
    """(p, 3, 6) easting, northing, height, see :func:`map_beam`."""
    is_bent: Bool
    """(p,) whether the road bends so much here that `in_road` is only a first approximation."""
    middle_m: float
    """Middle range."""


class Bodies(NamedTuple):
    """Bodies that may block the beams."""

    standing: Float64
    """(b, 18) see :mod:`roadscan.simulate.kernels.things`; the last m rows are overwritten by moving bodies."""
    moving: Float64
    """(p, m, 18) moving bodies, as they are at each profile."""


class Head(NamedTuple):
    """A head's readings and errors."""

    y_sensor_m: Float64
    """(n,) transverse positions of the readings."""
    range_offset_m: float
    """Range of raw 0."""
    range_step_m: float
    lost_share: float
    """Share of readings without a return."""
    range_noise_m: float
    """1 σ."""
    intensity_noise: float
    """1 σ."""
    wrong_share: float
    """Share of wrong readings."""
    wrong_within_m: float
    """Largest error of wrong readings."""
    normal: Float32
    """(65536,) standard normal numbers by 16 random bits; (0,): no errors of any kind."""
    random_from: np.uint64
    """Key of the first reading's random numbers; reading i of profile p has its own key."""
    spot: Float64
    """(s, 2) places of the parts of a beam's spot, along and across its profile (m); (0, 2): no width."""
    camera: float
    """Tangent of the angle between the beams and the camera's line of sight, which leans forward; 0: it sees all."""


class Measured(NamedTuple):
    """Measured values; written by :func:`scan_profiles`."""

    ranges: UInt16
    """(p, n) raw."""
    intensity: UInt8
    """(p, n)"""
    true_range_m: Float64
    """(p, n); NaN where the beam misses. (0, 0): not wanted."""
    body_hit: Int32
    """(p, n) row of the body that the beam meets, −1: none. (0, 0): not wanted."""


@compiled
def scan_profiles(
    road: RoadArrays, planes: Planes, obstacles: Bodies, head: Head, beam: Float64, out: Measured
) -> None:
    """Measure profiles of a triangulation head; beam : (3, 3) scratch."""
    road_planes, map_planes, is_bent, middle_m = planes
    bodies, movers = obstacles
    y_sensor_m, normal, random_from = head.y_sensor_m, head.normal, head.random_from
    ranges, intensity, true_range_m, body_hit = out
    for p in range(road_planes.shape[0]):
        place_movers(bodies, movers, p)
        before = 0.0
        r = before
        fall = 1.0
        for i in range(y_sensor_m.size):
            y = y_sensor_m[i]
            start = 2.0 * r - before if i > 1 else r  # the road continues as before
            before = r
            road_beam(road_planes, p, y, beam)
            r, k, u, offset, fall = plain_range(road, beam, start, fall, i > 1)
            if is_bent[p]:
                map_beam(map_planes, p, y, beam)
                r, k, u, offset = polished_range(road, beam, r, fall, k)
                road_beam(road_planes, p, y, beam)
            found = middle_m + r
            depth = 0.0
            hidden = False
            if road.nodes[k, DEFECTS] < road.nodes[k, DEFECTS_END]:
                depth, _ = defect_depth(road, k, u, offset)
                if head.spot.shape[0]:
                    below, shown = seen_in_spot(road, planes, p, y, r, head)
                    found += below
                    hidden = shown == 0.0
                elif depth > 0.0:
                    map_beam(map_planes, p, y, beam)
                    turn_to_road(road, beam, r, 0.02, k)
                    further, depth = into_defect(road, beam, 0.0, fall)
                    found += further
                    road_beam(road_planes, p, y, beam)
            stone = 0.0
            if road.texture.size:
                stone = over_texture(road, beam, found - middle_m, road.nodes[k, STATION] + u, offset, r)
                found -= stone / fall
            seen = on_surface(road, k, u, offset) and not hidden
            value = brightness(road, k, u, offset, depth, stone)
            bits = mixed(random_from + np.uint64(p * y_sensor_m.size + i))
            body = -1
            if bodies.shape[0]:
                map_beam(map_planes, p, y, beam)
                body, found = in_the_way(bodies, beam, middle_m, found, bits)
                if body >= 0:
                    r_body = found - middle_m
                    value = shade(
                        bodies,
                        body,
                        along_beam(beam, 0, r_body),
                        along_beam(beam, 1, r_body),
                        along_beam(beam, 2, r_body),
                    )
                    seen = not math.isnan(value)
            if true_range_m.size:
                true_range_m[p, i] = found if seen else np.nan
                body_hit[p, i] = body
            if normal.size:
                found += head.range_noise_m * normal[bits & np.uint64(0xFFFF)]
                value += head.intensity_noise * normal[(bits >> np.uint64(16)) & np.uint64(0xFFFF)]
                seen = seen and float((bits >> np.uint64(32)) & np.uint64(0xFFFF)) >= head.lost_share * 65536.0
                if float(bits >> np.uint64(48)) < head.wrong_share * 65536.0:
                    found += head.wrong_within_m * (
                        2.0 * float(mixed(bits) >> np.uint64(11)) / 9007199254740992.0 - 1.0
                    )
            raw = math.floor((found - head.range_offset_m) / head.range_step_m + 0.5)
            seen = seen and 1.0 <= raw <= 65535.0
            ranges[p, i] = int(raw) if seen else 0
            intensity[p, i] = int(min(max(value + 0.5, 0.0), 255.0)) if seen else 0


@inlined
def seen_in_spot(road: RoadArrays, planes: Planes, p: int, y: float, r: float, head: Head) -> tuple[float, float]:
    """Return the mean depth that the parts of a beam's spot show, and the share of them that the camera sees.

    A triangulating head measures the centre of the visible part of the spot. What walls hide from the camera is lost;
    where all is, so is the reading. The parts are taken to fall upright: a beam that leans by half a degree meets a
    floor 100 mm down 1 mm beside. The road is taken as level as far as the camera's line of sight runs below it.
    """
    beam = planes.in_road
    station = beam[p, 0, 0] + y * (beam[p, 0, 1] + y * beam[p, 0, 2]) + r * beam[p, 0, 5]
    offset = beam[p, 1, 0] + y * (beam[p, 1, 1] + y * beam[p, 1, 2]) + r * beam[p, 1, 5]
    across = beam[p, 1, 1]  # of the road, per metre of the profile; negative against the road
    ahead = 1.0 if across > 0.0 else -1.0
    total, shown = 0.0, 0.0
    for s in range(head.spot.shape[0]):
        at_s, at_o = station + ahead * head.spot[s, 0], offset + across * head.spot[s, 1]
        depth = depth_at(road, at_s, at_o)
        if depth > 0.0 and head.camera > 0.0 and is_hidden(road, at_s, at_o, depth, ahead * head.camera):
            continue
        total += depth
        shown += 1.0
    if shown > 0.0:
        total /= shown
    return total, shown / head.spot.shape[0]


@inlined
def depth_at(road: RoadArrays, station: float, offset: float) -> float:
    """Return the depth of the deepest defect at a station and offset (m)."""
    k = node_at(road, station)
    depth, _ = defect_depth(road, k, station - road.nodes[k, STATION], offset)
    result: float = depth
    return result


@inlined
def is_hidden(road: RoadArrays, station: float, offset: float, depth: float, lean: float) -> bool:
    """Return whether a wall hides a place `depth` deep from a camera whose line of sight leans by `lean` (m/m)."""
    steps = max(int(abs(lean) * depth / WALL_STEP_M), 8)
    for i in range(1, steps):
        up = depth * i / steps
        if depth_at(road, station + lean * up, offset) < depth - up - WALL_STEP_M:
            return True
    return False


@inner
def place_movers(bodies: Float64, movers: Float64, p: int) -> None:
    """Overwrite the last of the bodies (b, 18) by the moving ones (p, m, 18), as they are at profile `p`."""
    first = bodies.shape[0] - movers.shape[1]
    for m in range(movers.shape[1]):
        for column in range(movers.shape[2]):
            bodies[first + m, column] = movers[p, m, column]


@compiled
def in_the_way(bodies: Float64, beam: Float64, middle_m: float, found_m: float, key: np.uint64) -> tuple[int, float]:
    """Return the first body that a beam meets before the range `found_m`, and the range there; −1: none.

    The beam is taken as straight: over the metres of a profiler the map bends by less than 10⁻⁷ m.
    """
    ox, oy, oz = along_beam(beam, 0, -middle_m), along_beam(beam, 1, -middle_m), along_beam(beam, 2, -middle_m)
    body, nearest = -1, found_m
    for b in range(bodies.shape[0]):
        r = meet(bodies, b, ox, oy, oz, beam[0, 1], beam[1, 1], beam[2, 1], key)
        if r < nearest:
            body, nearest = b, r
    return body, nearest


@inlined
def over_texture(road: RoadArrays, beam: Float64, r: float, station: float, offset: float, plain: float) -> float:
    """Return the height of the texture where a beam meets it (m).

    The beam meets the surface without texture at range `r`; its place was found for the range `plain` above a defect.
    Beams lean a few degrees at most, so the place moves by hundredths of a millimetre: the texture's slopes tell the
    rest (to 0.01 mm, where the beam passes a corner of the texture).
    """
    station += along_beam(beam, 0, r) - along_beam(beam, 0, plain)
    offset += along_beam(beam, 1, r) - along_beam(beam, 1, plain)
    height, along, across = texture_plane(road, station, offset)
    lean_s = beam[0, 1] + 2.0 * r * beam[0, 2]
    lean_o = beam[1, 1] + 2.0 * r * beam[1, 2]
    return height / (1.0 + along * lean_s + across * lean_o)


@inlined
def plain_range(
    road: RoadArrays, beam: Float64, start: float, fall: float, is_fall_known: bool
) -> tuple[float, int, float, float, float]:
    """Return range, node, u, offset where a road beam meets the surface without defects, and its fall there.

    The slope of a neighbouring reading is right to better than a tenth, so a last step of 10 µm leaves less than 1 µm.
    Where the secant does not settle (the face of a kerb), the beam is walked down.
    """
    r = start
    enough = 1e-5 if is_fall_known else ROOT_TOLERANCE_M
    last_gap, moved = 0.0, 0.0
    k, u, offset = 0, 0.0, 0.0
    settled = False
    for _ in range(12):
        gap, k, u, offset = road_clearance(road, beam, r)
        if abs(moved) > 1e-5:
            fall = min(max((last_gap - gap) / moved, 0.3), 2.0)
        moved = gap / fall
        r += moved
        if abs(moved) < enough:
            settled = True
            break
        last_gap = gap
    if not settled:
        r, k, u, offset = walked_range(road, beam, r)
        fall = 1.0
    return r, k, u, offset, fall


@inlined
def road_clearance(road: RoadArrays, beam: Float64, r: float) -> tuple[float, int, float, float]:
    """Return height above the surface without defects of a point of a road beam, its node, u and offset."""
    station, offset = along_beam(beam, 0, r), along_beam(beam, 1, r)
    k = node_at(road, station)
    u = station - road.nodes[k, STATION]
    return along_beam(beam, 2, r) - worn_height(road, k, u, offset), k, u, offset


@inner
def walked_range(road: RoadArrays, beam: Float64, near: float) -> tuple[float, int, float, float]:
    """Return range, node, u, offset where a road beam first meets the surface, within 0.5 m."""
    stride = 0.002
    low = near - WALK_M
    while road_clearance(road, beam, low)[0] <= 0.0 and low > near - 4.0 * WALK_M:
        low -= WALK_M
    high = low
    for _ in range(int(6.0 * WALK_M / stride)):
        high = low + stride
        if road_clearance(road, beam, high)[0] <= 0.0:
            break
        low = high
    for _ in range(40):
        middle = 0.5 * (low + high)
        if road_clearance(road, beam, middle)[0] > 0.0:
            low = middle
        else:
            high = middle
    _, k, u, offset = road_clearance(road, beam, high)
    return high, k, u, offset


@inner
def polished_range(
    road: RoadArrays, beam: Float64, start: float, fall: float, near: int
) -> tuple[float, int, float, float]:
    """Return range, node, u, offset where a map beam meets the surface without defects, near `start`."""
    r = start
    k, u, offset = near, 0.0, 0.0
    for _ in range(10):
        gap, k, u, offset = clearance(road, beam, r, k)
        r += gap / fall
        if abs(gap) < ROOT_TOLERANCE_M:
            break
    return r, k, u, offset
