"""Lines of sight: places that rays pass, before a hit and behind it, and occlusion between a camera and a place."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import inlined, inner, kernel


class Rays(NamedTuple):
    """n rays from a sensor to a hit; x, y from a corner of the map and height (m)."""

    from_x: npt.NDArray[np.float64]
    from_y: npt.NDArray[np.float64]
    from_height: npt.NDArray[np.float64]
    to_x: npt.NDArray[np.float64]
    to_y: npt.NDArray[np.float64]
    to_height: npt.NDArray[np.float64]


class Places(NamedTuple):
    """Cells of a raster, each divided into bands of height above the ground."""

    corner: npt.NDArray[np.float64]
    """(2,) x and y of the raster's south-western corner (m)."""
    cell_m: float
    """Edge of a cell, and the step along a ray."""
    ground: npt.NDArray[np.float32]
    """(rows, columns) height of the ground at the middles of cells (m), row 0 the southern one; NaN where unknown."""
    bands: npt.NDArray[np.float64]
    """(b + 1,) ascending heights above the ground between which the bands lie (m)."""


@inlined
def part_within(start, way, least, most, first, last):
    """Part of first … last along a ray where its coordinate lies between least and most; empty: first > last."""
    if way == 0.0:
        return (first, last) if least <= start <= most else (1.0, 0.0)
    one, other = (least - start) / way, (most - start) / way
    return max(first, min(one, other)), min(last, max(one, other))


@kernel
def follow_rays(rays, places, reach_m, hit_m, passed, hidden):
    """Count rays by the places that they pass, and by those behind their hits.

    A ray counts once for each `cell_m` of its way. The hit counts as passed, `hit_m` to both sides.

    Parameters
    ----------
    rays : Rays; those of no length are left out.
    places : Places
    reach_m : how far from the sensor rays are followed.
    passed, hidden : (rows, columns, b) uint32; counts are added.
    """
    rows, columns = places.ground.shape
    step, top = places.cell_m, places.bands.size - 1
    west, south = places.corner[0], places.corner[1]
    for k in range(rays.from_x.size):
        x, y, z = rays.from_x[k], rays.from_y[k], rays.from_height[k]
        way_x, way_y, way_z = rays.to_x[k] - x, rays.to_y[k] - y, rays.to_height[k] - z
        length = np.sqrt(way_x * way_x + way_y * way_y + way_z * way_z)
        if not length > 0.0:
            continue
        way_x, way_y, way_z = way_x / length, way_y / length, way_z / length
        first, last = part_within(x, way_x, west, west + columns * step, 0.0, reach_m)
        first, last = part_within(y, way_y, south, south + rows * step, first, last)
        if first > last:
            continue
        for number in range(int(np.ceil(first / step - 0.5)), int(np.floor(last / step - 0.5)) + 1):
            along = (number + 0.5) * step
            column, row = int((x + along * way_x - west) / step), int((y + along * way_y - south) / step)
            if column < 0 or row < 0 or column >= columns or row >= rows:
                continue
            above = z + along * way_z - places.ground[row, column]
            if not (above >= places.bands[0] and above < places.bands[top]):
                continue
            band = 0
            while above >= places.bands[band + 1]:
                band += 1
            if along <= length + hit_m:
                passed[row, column, band] += 1
            else:
                hidden[row, column, band] += 1


@kernel
def rays_near(rays, epochs, lasers, spans, place, reach_m, wide, middles, late, rows, spanned, answered):
    """Write the rows, within spans of them, of the rays that pass near a place, or that were sent at a moment.

    Returns their number. A null ray, and one whose beginning is not known, passes nowhere.

    Parameters
    ----------
    rays : Rays. epochs : (n,) when each was sent. lasers : (n,) which sent it.
    spans : (s, 2) first and last row of each span.
    place : (3,) x, y, height (m). reach_m, wide : a ray is near within reach_m and `wide` times the place's distance.
    middles, late : (s,) moment of each span; rays that were sent less than `late` before or after it count, of 0 none.
    rows, spanned : (m,) int64, filled with the rows, ascending in each span, and the number of their span.
    answered : (s, lasers) bool, set where a laser sent one of these rays of a span.
    """
    count = 0
    for span in range(len(spans)):
        for k in range(spans[span, 0], spans[span, 1] + 1):
            way_x, way_y = rays.to_x[k] - rays.from_x[k], rays.to_y[k] - rays.from_y[k]
            way_z = rays.to_height[k] - rays.from_height[k]
            x, y, z = place[0] - rays.from_x[k], place[1] - rays.from_y[k], place[2] - rays.from_height[k]
            away = x * x + y * y + z * z
            along = x * way_x + y * way_y + z * way_z
            limit = reach_m + wide * np.sqrt(away)
            near = along > 0.0 and away - along * along / (way_x**2 + way_y**2 + way_z**2) < limit * limit
            if near or abs(epochs[k] - middles[span]) < late:
                rows[count], spanned[count] = k, span
                answered[span, lasers[k]] = True
                count += 1
    return count


@kernel
def find_hidden(eye_m, place_m, epoch_gps_ns, keys, spans_gps_ns, shape, edge_m, limits_m, hidden):
    """Mark the places that are hidden from cameras.

    Parameters
    ----------
    eye_m, place_m : (n, 3) float64, from the corner of the voxels (m).
    epoch_gps_ns : (n,) int64, when each picture was taken.
    keys : (k,) int64 in ascending order, numbers (column · rows + row) · levels + level of voxels that hide; a number
        may occur twice.
    spans_gps_ns : (k, 2) int64, from when to when each does.
    shape : columns, rows and levels of the voxels.
    edge_m : edge of a voxel (m).
    limits_m : the line is walked from so far beyond the camera to so far before the place, and its step (m).
    hidden : (n,) bool, written.
    """
    for i in range(eye_m.shape[0]):
        dx, dy, dz = place_m[i, 0] - eye_m[i, 0], place_m[i, 1] - eye_m[i, 1], place_m[i, 2] - eye_m[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        hidden[i] = False
        before = -1
        steps = int((length - limits_m[1] - limits_m[0]) / limits_m[2])
        for step in range(max(steps, 0)):
            share = (limits_m[0] + step * limits_m[2]) / length
            column = math.floor((eye_m[i, 0] + share * dx) / edge_m)
            row = math.floor((eye_m[i, 1] + share * dy) / edge_m)
            level = math.floor((eye_m[i, 2] + share * dz) / edge_m)
            if not (0 <= column < shape[0] and 0 <= row < shape[1] and 0 <= level < shape[2]):
                continue
            key = (column * shape[1] + row) * shape[2] + level
            if key == before:
                continue
            before = key
            at = np.searchsorted(keys, key)
            while at < keys.size and keys[at] == key:
                if spans_gps_ns[at, 0] <= epoch_gps_ns[i] <= spans_gps_ns[at, 1]:
                    hidden[i] = True
                at += 1
            if hidden[i]:
                break


@kernel
def rays_at_shafts(rays, shafts, cells, corner, cell_m, step_m, reach_m, limits_m, counts):
    """Count the rays at upright cylinders: those that end on one, that go through it, and that pass on either side.

    A ray that ends before a cylinder tells nothing of it.

    Parameters
    ----------
    rays : Rays; those of no length, and those whose beginning is not known, are left out.
    shafts : (s, 9) x, y at a height, slopes in x and y, radius, heights of the lower and upper end, and how far from
        that place a ray passes at most, seen from above (m).
    cells : shafts near each cell of a raster: (rows · columns + 1,) where those of a cell begin in a list, the list,
        the numbers of rows and of columns.
    corner : (2,) x and y of the raster's south-western corner (m).
    cell_m : edge of a cell.
    step_m : rays are looked at in such steps; a cylinder is listed for each cell in which a ray near it may be.
    reach_m : rays that end farther from a cylinder, seen from above, do not count.
    limits_m : share of the radius within which rays meet a cylinder; how far before the surface a ray ends on it; how
        far behind the surface it passed; inner and outer edge of the strips on both sides, from the surface.
    counts : (s, 3, 2) int64, added to: rays at the cylinder, on its left as seen from the sensor, on its right; those
        that end there, those that pass.
    """
    starts, listed, rows, columns = cells
    last, per_cell = np.full(len(shafts), -1), 1.0 / cell_m
    steps = int(reach_m / step_m) + 3
    for i in range(rays.from_x.size):
        way_x, way_y = rays.to_x[i] - rays.from_x[i], rays.to_y[i] - rays.from_y[i]
        length = math.sqrt(way_x * way_x + way_y * way_y)
        if not length > 0.0:
            continue
        way_x, way_y = way_x / length, way_y / length
        back_x, back_y = step_m * way_x * per_cell, step_m * way_y * per_cell
        x = (rays.to_x[i] - corner[0]) * per_cell + back_x
        y = (rays.to_y[i] - corner[1]) * per_cell + back_y
        for _ in range(steps):
            if 0.0 <= x < columns and 0.0 <= y < rows:
                cell = int(y) * columns + int(x)
                for n in range(starts[cell], starts[cell + 1]):
                    k = listed[n]
                    if last[k] != i:
                        last[k] = i
                        across = (shafts[k, 1] - rays.to_y[i]) * way_x - (shafts[k, 0] - rays.to_x[i]) * way_y
                        if abs(across) <= shafts[k, 8]:
                            _count_at(rays, i, (way_x, way_y, length), shafts[k], reach_m, limits_m, counts[k])
            x, y = x - back_x, y - back_y


@inner
def _count_at(rays, i, way, shaft, reach_m, limits_m, counts):
    """Add a ray to the counts (3, 2) of a cylinder."""
    if math.hypot(rays.to_x[i] - shaft[0], rays.to_y[i] - shaft[1]) > reach_m:
        return
    way_x, way_y, length = way
    rise = (rays.to_height[i] - rays.from_height[i]) / length
    x, y, along, height = shaft[0], shaft[1], 0.0, 0.0
    for _ in range(2):  # the second time where the axis is at the height of the ray
        along = (x - rays.from_x[i]) * way_x + (y - rays.from_y[i]) * way_y
        height = rays.from_height[i] + along * rise
        x, y = shaft[0] + (height - shaft[2]) * shaft[3], shaft[1] + (height - shaft[2]) * shaft[4]
    along = (x - rays.from_x[i]) * way_x + (y - rays.from_y[i]) * way_y
    across = (y - rays.from_y[i]) * way_x - (x - rays.from_x[i]) * way_y
    if along <= 0.0 or height < shaft[6] or height > shaft[7]:
        return
    middle, before, behind, least, most = limits_m
    radius, part = shaft[5], -1
    if abs(across) <= middle * radius:
        part = 0
    elif least < abs(across) - radius <= most:
        part, before = (1 if across < 0.0 else 2), behind
    if part >= 0 and length - along > radius + behind:
        counts[part, 1] += 1
    elif part >= 0 and length - along >= -radius - before:
        counts[part, 0] += 1


@kernel
def rays_at_plates(rays, plates, reach_m, limits, counts):
    """Count the rays at upright plates: those that end in the plane, close behind it, and far behind it.

    A ray counts from either side. One that ends before the plane, or that grazes it, tells nothing.

    Parameters
    ----------
    rays : Rays; those of no length, and those whose beginning is not known, are left out.
    plates : (p, 11) x, y, height of the middle, unit vectors along the normal and to the right, half the width and half
        the height (m); up is across both.
    reach_m : rays that end farther from the middle, seen from above, do not count.
    limits : how far off the plane a ray ends in it, and from where on it ends far behind it; inner and outer edge of
        the strips around the plate, from its outline (m); least cosine between a ray and the normal.
    counts : (p, 6, 3) int64, added to: rays at the plate, at the strips on its left, on its right, above, below, and at
        the plate's middle third across and upwards, which lies in plates of any shape; those that end in the plane,
        close behind it, far behind it.
    """
    thick, far, least, most, cosine = limits
    for i in range(rays.from_x.size):
        way_x, way_y = rays.to_x[i] - rays.from_x[i], rays.to_y[i] - rays.from_y[i]
        way_z = rays.to_height[i] - rays.from_height[i]
        length = math.sqrt(way_x * way_x + way_y * way_y + way_z * way_z)
        if not length > 0.0:
            continue
        for k in range(len(plates)):
            normal_x, normal_y, normal_z = plates[k, 3], plates[k, 4], plates[k, 5]
            x, y, z = rays.to_x[i] - plates[k, 0], rays.to_y[i] - plates[k, 1], rays.to_height[i] - plates[k, 2]
            rate = way_x * normal_x + way_y * normal_y + way_z * normal_z
            behind = x * normal_x + y * normal_y + z * normal_z
            if rate < 0.0:
                rate, behind = -rate, -behind
            if behind < -thick or rate < cosine * length or behind - rate > -thick or math.hypot(x, y) > reach_m:
                continue
            if behind > thick:
                x, y, z = (x - way_x * behind / rate, y - way_y * behind / rate, z - way_z * behind / rate)
            right_x, right_y, right_z = plates[k, 6], plates[k, 7], plates[k, 8]
            right = x * right_x + y * right_y + z * right_z
            up = (
                x * (normal_y * right_z - normal_z * right_y)
                + y * (normal_z * right_x - normal_x * right_z)
                + z * (normal_x * right_y - normal_y * right_x)
            )
            part = _part_of_plate(right, up, plates[k, 9], plates[k, 10], least, most)
            if part < 0:
                continue
            depth = 0 if behind <= thick else (1 if behind <= far else 2)
            counts[k, part, depth] += 1
            if 3.0 * abs(right) <= plates[k, 9] and 3.0 * abs(up) <= plates[k, 10]:
                counts[k, 5, depth] += 1


@inlined
def _part_of_plate(right, up, wide, tall, least, most):
    """Part of a plate and the strips around it in which a place lies; −1: none."""
    if abs(up) <= tall:
        past = abs(right) - wide
        if past <= 0.0:
            return 0
        return (2 if right > 0.0 else 1) if least < past <= most else -1
    if abs(right) <= wide and least < abs(up) - tall <= most:
        return 3 if up > 0.0 else 4
    return -1
