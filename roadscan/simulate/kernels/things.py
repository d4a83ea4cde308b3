"""Upright objects beside the road as simple bodies, and where a beam meets them.

A body is a row of numbers; lengths are metres, coordinates count from the scene's origin.
"""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.simulate.kernels.options import inlined, inner, mixed

BOX, CYLINDER, ELLIPSOID, WALL, DISC, TRIANGLE, OCTAGON, DIAMOND = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0
"""Kinds of bodies. Walls, discs and the four after them are thin, upright, and visible from both sides."""
SLOPE, LID, ROD, VOLUME, BUSH, PICKETS, GLAZED, PLATE = 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0
"""A leaning rectangle and ellipse; a cylinder in any direction; a box and an ellipsoid that stop beams within; a wall
with slots; a wall of glass, or with windows of it; a control target."""
DISC_STYLE, RING_STYLE, CHECKER_STYLE = 1.0, 2.0, 3.0  # styles of a control target
DISC_SHARE, RING_FROM, RING_TO = 0.2, 0.4, 0.8
"""Diameters of a disc's black centre, and of a ring's inner and outer edge, as shares of the target's edge."""
BLACK_SHARE = 1.0 / 12.0  # intensity of the black parts of a control target as a share of the white ones'

# Columns of a body.
KIND, EASTING, NORTHING, SINE, COSINE, HALF_LENGTH, HALF_WIDTH, LOW, HIGH = 0, 1, 2, 3, 4, 5, 6, 7, 8
LOW_END, HIGH_END, SKIRT, ALONG, BAY, WINDOW, STOREY = 9, 10, 11, 12, 13, 14, 15  # columns of walls
INTENSITY, DENSITY = 16, 17  # columns of all bodies
PART = 18  # column of what a body is of its object: see `roadscan.simulate.bodies`
BODY_COLUMNS = 19  # numbers of a body
_OCTAGON_CUT = math.sqrt(2.0)
"""Sum of the shares of the half width at which a regular octagon's slanting sides lie."""
# Easting, northing: its middle. Sine, cosine: of the grid heading of its length. Half length: radius of a cylinder, of
# an ellipsoid seen from above, of a disc. A wall runs along its length from LOW … HIGH at its start to LOW_END …
# HIGH_END; it goes on SKIRT below that, and if BAY > 0 it has windows of WINDOW by WINDOW in bays and storeys, whose
# pattern is ALONG past its beginning at the wall's start. DENSITY: share of beams that it stops each time they pass.
# SLOPE and LID: LOW is the height of the middle, ALONG and STOREY the rise ahead and to the right (m/m), WINDOW > 0: it
# is of glass; HIGH only bounds it. ROD: LOW and LOW_END are heights of its axis' ends, half its width is the radius.
# PLATE: WINDOW is its style.
# VOLUME and BUSH: DENSITY is the extinction along a beam (1/m). PICKETS: WINDOW of each BAY is solid. GLAZED: windows
# stop the share DENSITY; with BAY 0 the whole wall is one.
FRAME_M = 0.07
"""Width of the frame of a glazed wall's windows, which is solid (m)."""
FRAME_SHADE = 170.0
"""Intensity of a frame (digital numbers)."""
GLARE_COSINE = 0.996
"""Glass seen within 5 degrees of its normal glares."""
GLARE_SHADE, WEAK_SHADE = 255.0, 8.0  # intensities of glass: seen along its normal, and where dirt returns a beam
WEAK_SHARE = 0.3
"""Share of beams that glass returns weakly …"""
MIRROR_SHARE = 0.35
"""… and share that it mirrors, of those that it stops; the rest is lost."""


@inlined
def is_stopped(rows: Float64, i: int, key: np.uint64, side: int) -> bool:
    """Return whether the beam of a key is stopped on a side of body `i`, rather than passing through its gaps."""
    density = rows[i, DENSITY]
    if density >= 1.0:
        return True
    bits = mixed(key ^ mixed(np.uint64(2 * i + side + 1)))
    stopped: bool = float(bits >> np.uint64(11)) < density * 9007199254740992.0
    return stopped


@inlined
def slab(from_m: float, per_m: float, half: float) -> tuple[float, float]:
    """Return begin and end of the part of a line within ± `half` of a plane; begin > end: none."""
    if per_m == 0.0:
        return (-np.inf, np.inf) if abs(from_m) <= half else (np.inf, -np.inf)
    first, second = (-half - from_m) / per_m, (half - from_m) / per_m
    return min(first, second), max(first, second)


@inlined
def meet(
    rows: Float64, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, key: np.uint64
) -> float:
    """Return the range at which a line (origin, change per metre) first meets body `i` from outside; NaN: never."""
    kind = rows[i, KIND]
    x, y = ox - rows[i, EASTING], oy - rows[i, NORTHING]
    sine, cosine = rows[i, SINE], rows[i, COSINE]
    ahead, right = x * sine + y * cosine, x * cosine - y * sine
    if kind not in (CYLINDER, ELLIPSOID, BUSH):
        ahead_per_m, right_per_m = dx * sine + dy * cosine, dx * cosine - dy * sine
        if kind == BOX:
            return meet_box(rows, i, ahead, right, oz, ahead_per_m, right_per_m, dz)
        if kind in (SLOPE, LID):
            return meet_slope(rows, i, ahead, right, oz, ahead_per_m, right_per_m, dz, key)
        if kind == ROD:
            return meet_rod(rows, i, ahead, right, oz, ahead_per_m, right_per_m, dz)
        if kind == VOLUME:
            return meet_volume(rows, i, ahead, right, oz, ahead_per_m, right_per_m, dz, key)
        return meet_plate(rows, i, ahead, right, oz, ahead_per_m, right_per_m, dz, key)
    if kind == CYLINDER:
        return meet_cylinder(rows, i, x, y, oz, dx, dy, dz)
    if kind == BUSH:
        return meet_bush(rows, i, x, y, oz, dx, dy, dz, key)
    return meet_ellipsoid(rows, i, x, y, oz, dx, dy, dz, key)


@inlined
def meet_box(
    rows: Float64, i: int, ahead: float, right: float, oz: float, ahead_per_m: float, right_per_m: float, dz: float
) -> float:
    """Return the range to a box by the slab method (Kay and Kajiya 1986)."""
    half = 0.5 * (rows[i, HIGH] - rows[i, LOW])
    a0, a1 = slab(ahead, ahead_per_m, rows[i, HALF_LENGTH])
    b0, b1 = slab(right, right_per_m, rows[i, HALF_WIDTH])
    c0, c1 = slab(oz - rows[i, LOW] - half, dz, half)
    begin = max(a0, b0, c0)
    return begin if 0.0 < begin <= min(a1, b1, c1) else np.nan


@inlined
def meet_plate(
    rows: Float64,
    i: int,
    ahead: float,
    right: float,
    oz: float,
    ahead_per_m: float,
    right_per_m: float,
    dz: float,
    key: np.uint64,
) -> float:
    """Return the range to a wall or a disc, whose plane is crossed once."""
    if right_per_m == 0.0:
        return np.nan
    r = -right / right_per_m
    if not r > 0.0:
        return np.nan
    along, z = ahead + r * ahead_per_m, oz + r * dz
    half = rows[i, HALF_LENGTH]
    if abs(along) > half:
        return np.nan
    kind = rows[i, KIND]
    if DISC <= kind <= DIAMOND:
        aside, up = abs(along) / half, 2.0 * (z - rows[i, LOW]) / (rows[i, HIGH] - rows[i, LOW]) - 1.0
        if kind == DISC:
            up = z - 0.5 * (rows[i, LOW] + rows[i, HIGH])
            inside = along * along + up * up <= half * half
        elif kind == TRIANGLE:
            inside = up >= -1.0 and 2.0 * aside + up <= 1.0
        elif kind == DIAMOND:
            inside = aside + abs(up) <= 1.0
        else:
            inside = abs(up) <= 1.0 and aside + abs(up) <= _OCTAGON_CUT
    else:
        share = 0.5 + 0.5 * along / half
        low = rows[i, LOW] + share * (rows[i, LOW_END] - rows[i, LOW]) - rows[i, SKIRT]
        inside = low <= z <= rows[i, HIGH] + share * (rows[i, HIGH_END] - rows[i, HIGH])
        if kind == GLAZED and inside:
            return r if window_depth(rows, i, along, z) <= FRAME_M or is_stopped(rows, i, key, 0) else np.nan
        if kind == PICKETS:
            past = along + half + rows[i, ALONG]
            return r if inside and past % rows[i, BAY] < rows[i, WINDOW] else np.nan
    return r if inside and is_stopped(rows, i, key, 0) else np.nan


@inlined
def window_depth(rows: Float64, i: int, along: float, z: float) -> float:
    """Return how far a point of a wall lies within a window's outline (m); not positive: in no window."""
    half = rows[i, HALF_LENGTH]
    if rows[i, BAY] == 0.0:
        return np.inf
    up = z - rows[i, LOW] - (0.5 + 0.5 * along / half) * (rows[i, LOW_END] - rows[i, LOW])
    if up <= 0.0:
        return -1.0
    aside = (along + half + rows[i, ALONG]) % rows[i, BAY] - 0.5 * rows[i, BAY]
    level = up % rows[i, STOREY] - 0.5 * rows[i, STOREY]
    depth: float = 0.5 * rows[i, WINDOW] - max(abs(aside), abs(level))
    return depth


@inlined
def meet_slope(
    rows: Float64, i: int, ahead: float, right: float, oz: float, ahead_per_m: float, right_per_m: float, dz: float,
    key: np.uint64,
) -> float:  # fmt: skip
    """Return the range to a leaning rectangle or ellipse."""
    fall = rows[i, ALONG] * ahead_per_m + rows[i, STOREY] * right_per_m - dz
    if fall == 0.0:
        return np.nan
    r = (oz - rows[i, LOW] - rows[i, ALONG] * ahead - rows[i, STOREY] * right) / fall
    if not r > 0.0:
        return np.nan
    a, b = (ahead + r * ahead_per_m) / rows[i, HALF_LENGTH], (right + r * right_per_m) / rows[i, HALF_WIDTH]
    inside = a * a + b * b <= 1.0 if rows[i, KIND] == LID else max(abs(a), abs(b)) <= 1.0
    return r if inside and is_stopped(rows, i, key, 0) else np.nan


@inlined
def into_tube(c0: float, c1: float, a: float, b: float, c: float) -> float:
    """Return the range at which a beam meets a tube with both of its ends; NaN: it does not.

    c0, c1 : ranges between which it is between the ends. a r² + 2 b r + c : square of its distance from the axis at the
    range r, less that of the radius.
    """
    if a < 1e-18:
        return c0 if c <= 0.0 and 0.0 < c0 <= c1 else np.nan
    root = b * b - a * c
    if root < 0.0:
        return np.nan
    root = math.sqrt(root)
    begin = max(c0, (-b - root) / a)
    return begin if 0.0 < begin <= min(c1, (-b + root) / a) else np.nan


@inlined
def meet_rod(
    rows: Float64, i: int, ahead: float, right: float, oz: float, ahead_per_m: float, right_per_m: float, dz: float
) -> float:
    """Return the range to a cylinder around an axis in any direction, with both of its ends."""
    half, rise, radius = rows[i, HALF_LENGTH], 0.5 * (rows[i, LOW_END] - rows[i, LOW]), rows[i, HALF_WIDTH]
    length = math.sqrt(half * half + rise * rise)
    along, up = half / length, rise / length
    z = oz - 0.5 * (rows[i, LOW] + rows[i, LOW_END])
    past, past_per_m = along * ahead + up * z, along * ahead_per_m + up * dz
    aside, aside_per_m = along * z - up * ahead, along * dz - up * ahead_per_m
    c0, c1 = slab(past, past_per_m, length)
    a = aside_per_m * aside_per_m + right_per_m * right_per_m
    b = aside * aside_per_m + right * right_per_m
    c = aside * aside + right * right - radius * radius
    return into_tube(c0, c1, a, b, c)


@inlined
def within(rows: Float64, i: int, begin: float, end: float, key: np.uint64) -> float:
    """Return the range at which a porous body stops a beam that is in it from `begin` to `end`; NaN: it passes.

    The free path is exponential, with the mean of one over the extinction (Beer and Lambert).
    """
    share = (float(mixed(key ^ mixed(np.uint64(2 * i + 1))) >> np.uint64(11)) + 0.5) / 9007199254740992.0
    r = max(begin, 0.0) - math.log(share) / rows[i, DENSITY]
    return r if r <= end else np.nan


@inlined
def meet_volume(
    rows: Float64, i: int, ahead: float, right: float, oz: float, ahead_per_m: float, right_per_m: float, dz: float,
    key: np.uint64,
) -> float:  # fmt: skip
    """Return the range within a porous box."""
    half = 0.5 * (rows[i, HIGH] - rows[i, LOW])
    a0, a1 = slab(ahead, ahead_per_m, rows[i, HALF_LENGTH])
    b0, b1 = slab(right, right_per_m, rows[i, HALF_WIDTH])
    c0, c1 = slab(oz - rows[i, LOW] - half, dz, half)
    begin, end = max(a0, b0, c0), min(a1, b1, c1)
    return within(rows, i, begin, end, key) if begin <= end and end > 0.0 else np.nan


@inlined
def meet_bush(
    rows: Float64, i: int, x: float, y: float, oz: float, dx: float, dy: float, dz: float, key: np.uint64
) -> float:
    """Return the range within a porous ellipsoid."""
    flat = 1.0 / rows[i, HALF_LENGTH]
    half = 0.5 * (rows[i, HIGH] - rows[i, LOW])
    px, py, pz = x * flat, y * flat, (oz - rows[i, LOW] - half) / half
    vx, vy, vz = dx * flat, dy * flat, dz / half
    a = vx * vx + vy * vy + vz * vz
    b = px * vx + py * vy + pz * vz
    root = b * b - a * (px * px + py * py + pz * pz - 1.0)
    if root < 0.0 or -b + math.sqrt(root) <= 0.0:
        return np.nan
    root = math.sqrt(root)
    return within(rows, i, (-b - root) / a, (-b + root) / a, key)


@inlined
def meet_cylinder(
    rows: Float64, i: int, x: float, y: float, oz: float, dx: float, dy: float, dz: float
) -> float:  # fmt: skip
    """Return the range to an upright cylinder with both of its ends."""
    radius, low, high = rows[i, HALF_LENGTH], rows[i, LOW], rows[i, HIGH]
    half = 0.5 * (high - low)
    c0, c1 = slab(oz - low - half, dz, half)
    a = dx * dx + dy * dy
    b = x * dx + y * dy
    c = x * x + y * y - radius * radius
    return into_tube(c0, c1, a, b, c)


@inlined
def meet_ellipsoid(
    rows: Float64, i: int, x: float, y: float, oz: float, dx: float, dy: float, dz: float, key: np.uint64
) -> float:
    """Return the range to a tree's crown: a shell with gaps, which may stop a beam on its near or far side."""
    flat = 1.0 / rows[i, HALF_LENGTH]
    half = 0.5 * (rows[i, HIGH] - rows[i, LOW])
    px, py, pz = x * flat, y * flat, (oz - rows[i, LOW] - half) / half
    vx, vy, vz = dx * flat, dy * flat, dz / half
    a = vx * vx + vy * vy + vz * vz
    b = px * vx + py * vy + pz * vz
    root = b * b - a * (px * px + py * py + pz * pz - 1.0)
    if root < 0.0:
        return np.nan
    root = math.sqrt(root)
    near, far = (-b - root) / a, (-b + root) / a
    first: float = near if near > 0.0 and is_stopped(rows, i, key, 0) else np.nan
    if math.isnan(first) and far > 0.0 and is_stopped(rows, i, key, 1):
        first = far
    return first


@inner
def shade(rows: Float64, i: int, x: float, y: float, z: float) -> float:
    """Return the intensity of body `i` at a point of its outside; NaN in a window, which mirrors beams away."""
    kind = rows[i, KIND]
    if rows[i, BAY] > 0.0 and kind in (WALL, GLAZED):
        along = (x - rows[i, EASTING]) * rows[i, SINE] + (y - rows[i, NORTHING]) * rows[i, COSINE]
        share = 0.5 + 0.5 * along / rows[i, HALF_LENGTH]
        up = z - rows[i, LOW] - share * (rows[i, LOW_END] - rows[i, LOW])
        bay, storey, half = rows[i, BAY], rows[i, STOREY], 0.5 * rows[i, WINDOW]
        past = along + rows[i, HALF_LENGTH] + rows[i, ALONG]
        aside = past - bay * math.floor(past / bay) - 0.5 * bay
        level = up - storey * math.floor(up / storey) - 0.5 * storey
        if up > 0.0 and abs(aside) < half and abs(level) < half:
            return FRAME_SHADE if kind == GLAZED else np.nan
    value: float = rows[i, INTENSITY]
    if kind == PLATE:
        along = (x - rows[i, EASTING]) * rows[i, SINE] + (y - rows[i, NORTHING]) * rows[i, COSINE]
        up = z - 0.5 * (rows[i, LOW] + rows[i, HIGH])
        if is_black(rows[i, WINDOW], along / rows[i, HALF_LENGTH], up / rows[i, HALF_LENGTH]):
            value *= BLACK_SHARE
    return value


@inlined
def is_black(style: float, right: float, up: float) -> bool:
    """Return whether a control target is black at a place, given in half edges from its middle."""
    if style == CHECKER_STYLE:
        return right * up > 0.0
    away = math.sqrt(right * right + up * up)
    if style == RING_STYLE:
        return RING_FROM <= away <= RING_TO
    return style == DISC_STYLE and away <= DISC_SHARE


@inner
def is_glass(rows: Float64, i: int, x: float, y: float, z: float) -> bool:
    """Return whether body `i` is of glass that a beam may pass, at a point of its outside."""
    kind = rows[i, KIND]
    if kind == SLOPE:
        pane: bool = rows[i, WINDOW] > 0.0
        return pane
    along = (x - rows[i, EASTING]) * rows[i, SINE] + (y - rows[i, NORTHING]) * rows[i, COSINE]
    return kind == GLAZED and window_depth(rows, i, along, z) > FRAME_M


@inner
def normal(rows: Float64, i: int) -> tuple[float, float, float]:
    """Return the normal of a pane (east, north, up), of length 1."""
    sine, cosine = rows[i, SINE], rows[i, COSINE]
    if rows[i, KIND] != SLOPE:
        return cosine, -sine, 0.0
    ahead, right = rows[i, ALONG], rows[i, STOREY]
    norm = 1.0 / math.sqrt(1.0 + ahead * ahead + right * right)
    return -norm * (ahead * sine + right * cosine), -norm * (ahead * cosine - right * sine), norm
