"""Georeferences profiles whose readings are taken at one instant near the sensor.

All readings of such a profile have one pose and lie in one plane, a few metres across. There the map is linear to a
few µm (``georeference.charts`` limits the reach accordingly), so each map coordinate is

    value = anchor + p + q · y + r · z

with the sensor's y and z counted from the middle of the profile. The anchor is a whole number of cells (or quanta);
what is left fits 32-bit floats with a resolution below a tenth of a quantum, and sixteen readings fit a register.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.kernel_options import bare, bare_inlined, inlined, kernel
from roadscan.georeference.kernels.readings import (
    CLASS_NO_POSE,
    CLASS_NO_RETURN,
    CLASS_TOO_FAR,
    CLASS_TOO_HIGH,
    CLASS_TOO_LOW,
    CLASS_TOO_NEAR,
    HEIGHT,
    KEPT,
    NO_POSE,
    NO_RETURN,
    OUTSIDE,
    RANGE,
    box_of,
    chart_index,
    expansion,
    is_wanted,
    map_value,
    tile_and_rest,
    write_point,
)
from roadscan.poses.kernels.poses import attitude_at, find_interval, interval, position_at

HALF = np.float32(0.5)  # Added before rounding down, in the type of the heights.


class FlatProfiles(NamedTuple):
    """Rays of a profile relative to its middle."""

    rays: npt.NDArray[np.float32]
    """(4, m) y and z of the rays' origins from the middle (m), y and z of their directions."""
    middle: tuple[float, float]
    """y and z in the sensor's frame (m)."""
    scale: tuple[np.float32, np.float32]
    """Range of a raw 0 and step between raw ranges (m)."""
    raw_limits: tuple[np.uint16, np.uint16]
    """Lowest and highest raw range that is kept."""


@bare_inlined
def anchored(form, middle, quanta_per_m):
    """Return a form of ``profile_forms`` about the profile's middle (y, z): anchor in whole quanta, and (p, q, r)."""
    y, z = middle
    value = form_value(form, y, z) * quanta_per_m
    anchor = np.int64(math.floor(value))
    return anchor, (
        np.float32(value - anchor),
        np.float32((form[1] + 2.0 * form[3] * y + form[4] * z) * quanta_per_m),
        np.float32((form[2] + form[4] * y + 2.0 * form[5] * z) * quanta_per_m),
    )


@bare_inlined
def on_plane(plane, y, z):
    """Return the value of a plane (p, q, r) at y, z."""
    return plane[0] + plane[1] * y + plane[2] * z


@bare_inlined
def planes_of(epoch, k, middle, georeference):
    """Return the planes of a profile's easting, northing and height, and the height limits above the anchor.

    Returns
    -------
    placed : bool; anchors : (3,) tuple of int64, easting, northing and height (quanta); planes : three (p, q, r);
    heights : (2,) tuple of float32.
    """
    limits, quanta_per_m = georeference.limits, georeference.quanta_per_m
    placed, forms = profile_forms(epoch, k, georeference)
    east_anchor, east = anchored(forms[0], middle, quanta_per_m)
    north_anchor, north = anchored(forms[1], middle, quanta_per_m)
    up_anchor, up = anchored(forms[2], middle, quanta_per_m)
    body = forms[3][0]
    lowest = max(limits.height_min_m, body + limits.above_body_min_m) * quanta_per_m - up_anchor
    highest = min(limits.height_max_m, body + limits.above_body_max_m) * quanta_per_m - up_anchor
    return (
        placed,
        (east_anchor, north_anchor, up_anchor),
        (east, north, up),
        (np.float32(lowest), np.float32(highest)),
    )


@bare_inlined
def class_of(raw, height, raw_limits, heights):
    """Return the class of a reading that a filter leaves out; `height` counts from the anchor."""
    if raw == 0:
        return CLASS_NO_RETURN
    if raw < raw_limits[0]:
        return CLASS_TOO_NEAR
    if raw > raw_limits[1]:
        return CLASS_TOO_FAR
    return CLASS_TOO_LOW if height < heights[0] else CLASS_TOO_HIGH


@bare_inlined
def fate_of(kind):
    """Return the counter of a class other than kept."""
    if kind == CLASS_NO_RETURN:
        return NO_RETURN
    if kind == CLASS_NO_POSE:
        return NO_POSE
    return RANGE if kind in (CLASS_TOO_NEAR, CLASS_TOO_FAR) else HEIGHT


@bare
def georeference_flat_profiles(epochs, ranges, flat, georeference, window, out):
    """Georeference profiles and write the points in the window; return the number of points written.

    Parameters
    ----------
    epochs : (n,) int64, GPS ns; ranges : (n, m) uint16, raw, 0 no return; flat : FlatProfiles.
    georeference : Georeference; window : Window; out : Points, with a row for each reading.
    """
    made = 0
    count = ranges.shape[1]
    rays, middle, scale, raw_limits = flat
    fates, classes = out.fates, out.classes
    k = 0
    for i in range(epochs.size):
        k = find_interval(epochs[i], georeference.poses.knots, k)
        placed, anchors, planes, heights = planes_of(epochs[i], k, middle, georeference)
        for j in range(count):
            raw = ranges[i, j]
            distance = scale[0] + scale[1] * np.float32(raw)
            y = rays[0, j] + distance * rays[2, j]
            z = rays[1, j] + distance * rays[3, j]
            h = on_plane(planes[2], y, z)
            if not (placed and raw_limits[0] <= raw <= raw_limits[1] and heights[0] <= h <= heights[1]):
                kind = class_of(raw, h, raw_limits, heights) if placed or raw == 0 else CLASS_NO_POSE
                fates[fate_of(kind)] += 1
                if classes.size:
                    classes[i * count + j] = kind
                continue
            east = anchors[0] + np.int64(np.floor(on_plane(planes[0], y, z) + HALF))
            north = anchors[1] + np.int64(np.floor(on_plane(planes[1], y, z) + HALF))
            across, along = tile_and_rest(east, window.tile_quanta), tile_and_rest(north, window.tile_quanta)
            if not is_wanted(across[0], along[0], window.tiles):
                fates[OUTSIDE] += 1
                continue
            write_point(made, i, across, along, anchors[2] + np.int64(np.floor(h + HALF)), out)
            out.readings[made] = j
            made += 1
            fates[KEPT] += 1
    return made


NO_FORMS = ((0.0,) * 6,) * 4
"""Forms that stand in where there is no pose."""


@inlined
def profile_form(c, ox, oy, oz, axis_y, axis_z):
    """Return a map coordinate over the profile's plane as (constant, y, z, y², y z, z²) coefficients.

    c : expansion of the coordinate; ox, oy, oz : sensor origin from the chart's centre (m);
    axis_y, axis_z : the sensor's y and z axes in the world (its x does not occur in a profile).
    """
    gx = c[1] + 2.0 * c[4] * ox + c[5] * oy + c[6] * oz
    gy = c[2] + c[5] * ox + 2.0 * c[7] * oy + c[8] * oz
    gz = c[3] + c[6] * ox + c[8] * oy + 2.0 * c[9] * oz
    ax, ay, az = axis_y
    bx, by, bz = axis_z
    return (
        map_value(c, ox, oy, oz),
        gx * ax + gy * ay + gz * az,
        gx * bx + gy * by + gz * bz,
        ax * (c[4] * ax + c[5] * ay + c[6] * az) + ay * (c[7] * ay + c[8] * az) + c[9] * az * az,
        2.0 * (c[4] * ax * bx + c[7] * ay * by + c[9] * az * bz)
        + c[5] * (ax * by + ay * bx) + c[6] * (ax * bz + az * bx) + c[8] * (ay * bz + az * by),
        bx * (c[4] * bx + c[5] * by + c[6] * bz) + by * (c[7] * by + c[8] * bz) + c[9] * bz * bz,
    )  # fmt: skip


@inlined
def form_value(f, y, z):
    """Return the value of :func:`profile_form` at sensor coordinates y, z (m)."""
    return f[0] + y * (f[1] + f[3] * y + f[4] * z) + z * (f[2] + f[5] * z)


@kernel
def profile_forms(epoch, k, georeference):
    """Return the map coordinates of a profile's plane at one epoch (GPS ns), in trajectory interval `k`.

    Returns
    -------
    placed : bool, False where there is no pose.
    forms : easting, northing, height as :func:`profile_form`; last, the body's height in the first place.
    """
    poses, charts = georeference.poses, georeference.charts
    if k < 0 or not poses.valid[k]:
        return False, NO_FORMS
    c = interval(poses.coefficients, k)
    u = (epoch - poses.knots[k]) / (poses.knots[k + 1] - poses.knots[k])
    px, py, pz = position_at(c, u)
    chart = chart_index(box_of(px, py, pz, charts.lattice), charts.lattice, charts.table, charts.centres_world_m)
    if chart < 0:
        return False, NO_FORMS
    r = attitude_at(c, u)
    px -= charts.centres_world_m[chart, 0]
    py -= charts.centres_world_m[chart, 1]
    pz -= charts.centres_world_m[chart, 2]
    b = georeference.mounting
    ox = px + (r[0] * b[9] + r[1] * b[10] + r[2] * b[11])
    oy = py + (r[3] * b[9] + r[4] * b[10] + r[5] * b[11])
    oz = pz + (r[6] * b[9] + r[7] * b[10] + r[8] * b[11])
    axis_y = (
        r[0] * b[1] + r[1] * b[4] + r[2] * b[7],
        r[3] * b[1] + r[4] * b[4] + r[5] * b[7],
        r[6] * b[1] + r[7] * b[4] + r[8] * b[7],
    )
    axis_z = (
        r[0] * b[2] + r[1] * b[5] + r[2] * b[8],
        r[3] * b[2] + r[4] * b[5] + r[5] * b[8],
        r[6] * b[2] + r[7] * b[5] + r[8] * b[8],
    )
    height_chart = expansion(charts.coefficients, chart, 2)
    return True, (
        profile_form(expansion(charts.coefficients, chart, 0), ox, oy, oz, axis_y, axis_z),
        profile_form(expansion(charts.coefficients, chart, 1), ox, oy, oz, axis_y, axis_z),
        profile_form(height_chart, ox, oy, oz, axis_y, axis_z),
        (map_value(height_chart, px, py, pz), 0.0, 0.0, 0.0, 0.0, 0.0),
    )
