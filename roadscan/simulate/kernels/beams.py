"""Beams: followed through road and map, and down into potholes and cracks."""

from __future__ import annotations

import math

from roadscan.compute.array_types import Float64
from roadscan.simulate.kernels.options import inlined, inner
from roadscan.simulate.kernels.road import STATION, RoadArrays, defect_depth, node_at, project, worn_height

ROOT_TOLERANCE_M = 1e-8
"""Largest distance of a beam's end from the surface (m), along the height."""

# A beam is followed in road coordinates: station, offset and height are parabolas of its range r, because map and
# road bend. beam (3, 3) holds the coefficients of 1, r, r² of each.


@inlined
def along_beam(beam: Float64, axis: int, r: float) -> float:
    """Station, offset or height (axis 0, 1, 2) at range `r` of a beam (3, 3)."""
    value: float = beam[axis, 0] + r * (beam[axis, 1] + r * beam[axis, 2])
    return value


@inlined
def through(beam: Float64, axis: int, step: float, first: float, second: float, third: float) -> None:
    """Lay the parabola of one axis of a beam through its values at r = 0, step and 2 · step."""
    beam[axis, 0] = first
    beam[axis, 1] = (4.0 * second - 3.0 * first - third) / (2.0 * step)
    beam[axis, 2] = (first - 2.0 * second + third) / (2.0 * step * step)


@inner
def into_defect(road: RoadArrays, beam: Float64, r: float, fall: float) -> tuple[float, float]:
    """Follow a beam from the rim's level at `r` down to the wall or floor of a pothole or crack.

    Walks in steps short against the defect's width (seen from above), so that the first wall in the way
    stops the beam, then closes in on it (Illinois variant of the false position, Dowell and Jarratt 1971).

    fall : loss of clearance per metre of range (positive). Returns range and depth there.
    """
    station, offset = along_beam(beam, 0, r), along_beam(beam, 1, r)
    k = node_at(road, station)
    depth, finest = defect_depth(road, k, station - road.nodes[k, STATION], offset)
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
        k = node_at(road, station)
        depth, _ = defect_depth(road, k, station - road.nodes[k, STATION], offset)
        floor = worn_height(road, k, station - road.nodes[k, STATION], offset) - depth
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


@inner
def clearance(road: RoadArrays, beam: Float64, r: float, near: int) -> tuple[float, int, float, float]:
    """Height of a beam's point above the surface without defects, and its node, u, offset.

    beam : (3, 3) of easting, northing, height.
    """
    k, u, offset = project(road, along_beam(beam, 0, r), along_beam(beam, 1, r), near)
    return along_beam(beam, 2, r) - worn_height(road, k, u, offset), k, u, offset


@inner
def turn_to_road(road: RoadArrays, beam: Float64, r: float, step: float, near: int) -> None:
    """Turn a beam in the map into road coordinates and count it from range `r`.

    Exact there and at `step` and 2 · `step` further on. beam : (3, 3), in and out.
    """
    k0, u0, offset0 = project(road, along_beam(beam, 0, r), along_beam(beam, 1, r), near)
    k1, u1, offset1 = project(road, along_beam(beam, 0, r + step), along_beam(beam, 1, r + step), k0)
    end = r + 2.0 * step
    k2, u2, offset2 = project(road, along_beam(beam, 0, end), along_beam(beam, 1, end), k1)
    height0, height1, height2 = along_beam(beam, 2, r), along_beam(beam, 2, r + step), along_beam(beam, 2, end)
    through(beam, 0, step, road.nodes[k0, STATION] + u0, road.nodes[k1, STATION] + u1, road.nodes[k2, STATION] + u2)
    through(beam, 1, step, offset0, offset1, offset2)
    through(beam, 2, step, height0, height1, height2)
