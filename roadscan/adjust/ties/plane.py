"""Lidar ties: planes of the ground, of kerbs' faces and of walls in time windows, of one pass or of several.

Returns of a lidar are too sparse for pictures. In a cube, all windows together know how a plane lies, each window how
far along the plane's normal (point to plane; Chen and Medioni 1992). What a window tells is what one laser saw: how far
its ranges are off for good is an unknown of the adjustment. The normal is that of the returns about the mean
of their window, so windows that lie apart do not bend it.

Height ties: distance of the surface of one traverse above that of another, along the normal of the road.

A road falls to its side, so passes that lie a centimetre beside each other differ in height by a quarter of a
millimetre at 2.5 %. So what is tied is the distance along the surface's normal (point to plane; Chen and Medioni 1992),
and the adjustment knows of the fall through the direction of the tie.

How much the walls lean that a lidar sees along a road tells a roll that no tie within one drive shows. A stated roll of
the boresight that is too large by ρ (rad) lowers what is to the right: a wall whose normal has the component r to the
right of the vehicle gets a normal that points ρ r down. Walls that stand back from the road, as retaining walls do, are
no roll: how much all walls lean away from the road is a second unknown. Where a road has walls on one side alone, the
stated σ of that unknown is that of the roll. Safety barriers of concrete lean back by 5 to 10°, and cars lean too: what
is as low as these is no wall.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.adjust.kernels.places import add_moments, leave_out_far
from roadscan.adjust.places import (
    COUNTS,
    FEW_CELLS,
    HEIGHT,
    LASERS,
    PLANE,
    SCATTERED,
    STEEP,
    TOO_FAR,
    TWO_SURFACES,
    End,
    PassReadings,
    Patch,
    Place,
    Tie,
    Track,
    level_from_map,
    map_from_axes,
)
from roadscan.adjust.settings import TieSettings
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness

_FLAT: Final = 0.25
"""Greatest ratio of a plane's thickness to its shorter extent."""
_WIDE: Final = 0.1
"""Least 1 σ of a plane's returns along both of its axes, as a share of the cube."""
_TRIM: Final = 3.0  # Returns farther from the plane (σ) are left out.
_LEAST_VARIANCE_M2: Final = 1e-10  # Least variance of a plane (m²).
_FIRST: Final = (0, 0, 0, 1, 1, 2)  # Rows of the six products of a symmetric 3 × 3 matrix …
_SECOND: Final = (0, 1, 2, 1, 2, 2)  # … and their columns.
_SHARE: Final = 6
"""One in this many planes is kept for each direction, if there are that many."""
_SPARSE: Final = 16
"""Numbers are looked up in a table where their range is no larger than this many times their count."""


@dataclass(frozen=True)
class _Returns:
    """Returns of all traverses near a place."""

    point_m: Float64
    """(n, 3) from the place, map axes."""
    pose: Int64
    """(n,) row in the poses of its traverse."""
    laser: Int64
    """(n,)"""
    window: Int64
    """(n,) number of its window, by traverse and time."""
    traverse: Int64
    """(w,) of each window."""


@dataclass(frozen=True)
class _Planes:
    """Cubes with a plane, and the means of their g windows, by cube and time."""

    cube: Int64
    """(g,) number of the cube of each window."""
    mean_m: Float64
    """(g, 3)"""
    count: Int64
    """(g,)"""
    traverse: Int64
    pose: Int64
    normal: Float64
    """(c, 3) of the cubes."""
    thickness_m: Float64
    """(c,)"""
    tilt: Float64
    """(c,) variance of the plane's tilt (rad²), the worse axis, where it is a metre thick."""
    of_return: Int64
    """(n,) window of each return, −1: none."""
    laser: Int64
    """(g,) that saw it, −1: several."""

    def by_laser(self, near: _Returns, cubes: Sequence[int], least: int) -> _Planes:
        """Returns the windows of some cubes, each with the mean of the laser that has the most returns in it."""
        rank = np.where(np.isin(self.cube, cubes), np.cumsum(np.isin(self.cube, cubes)) - 1, -1)
        rows = np.flatnonzero(self.of_return >= 0)
        rows = rows[rank[self.of_return[rows]] >= 0]
        window, size = rank[self.of_return[rows]], int(rank.max(initial=-1)) + 1
        counts = np.bincount(window * LASERS + near.laser[rows], minlength=size * LASERS).reshape(size, LASERS)
        laser = counts.argmax(axis=1)
        own = near.laser[rows] == laser[window]
        rows, window = rows[own], window[own]
        count = np.bincount(window, minlength=size)
        values = (*near.point_m[rows].T, near.pose[rows])
        east, north, up, pose = (np.bincount(window, v, size) / np.maximum(count, 1) for v in values)
        old, kept, mean = np.flatnonzero(rank >= 0), count >= least, np.stack([east, north, up], axis=-1)
        cube = self.cube[old]
        away = np.einsum("ni,ni->n", near.point_m[rows] - mean[window], self.normal[cube[window]])
        spread = np.bincount(cube[window], away**2, self.thickness_m.size)
        free = np.bincount(cube, count - 1, self.thickness_m.size) - 2.0  # of the plane's tilt
        thickness = np.sqrt(np.maximum(spread / np.maximum(free, 1), _LEAST_VARIANCE_M2))
        return replace(
            self, cube=cube[kept], mean_m=mean[kept], count=count[kept], thickness_m=thickness,
            traverse=self.traverse[old[kept]], pose=np.rint(pose[kept]).astype(np.int64), laser=laser[kept],
        )  # fmt: skip


def plane_ties(place: Place, readings: Sequence[PassReadings], settings: TieSettings) -> list[Tie]:
    """Returns ties along the normals of planes between windows of `settings.window_s`, those of a cube in a ring.

    Redundant ties have larger σ: q ties of m windows have m − 1 independent values.
    """
    near = _near(place, readings, settings) if readings else None
    if near is None or near.pose.size == 0:
        return []
    planes = _planes(near, settings)
    cubes = _chosen(place, planes, settings.most_planes)
    planes = planes.by_laser(near, cubes, settings.least_returns)
    first, second, weaker = _pairs(planes, cubes)
    return _ties(place, readings, planes, (first, second), weaker, settings)


def _near(place: Place, readings: Sequence[PassReadings], settings: TieSettings) -> _Returns:
    """Returns the lidar returns within the square of a place."""
    length = round(settings.window_s * NS_PER_S)
    parts: list[tuple[Float64, Int64, Int64, Int64]] = []
    traverse: list[int] = []
    for number, one in enumerate(readings):
        windows, of_pose = np.unique(one.epoch_gps_ns // length, return_inverse=True)
        point = np.stack([one.easting_m - place.easting_m, one.northing_m - place.northing_m, one.height_m], axis=-1)
        near = (np.abs(point[:, :2]) <= place.radius_m).all(axis=1) & np.isfinite(point[:, 2])
        inside = np.flatnonzero(near)
        pose, laser = one.pose[inside].astype(np.int64), np.asarray(one.laser)[inside].astype(np.int64)
        parts.append((point[inside], pose, laser, len(traverse) + of_pose[pose]))
        traverse += [number] * windows.size
    points, poses, lasers, numbers = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _Returns(points, poses, lasers, numbers, np.array(traverse, np.int64))


def _planes(near: _Returns, settings: TieSettings) -> _Planes:
    """Returns cubes in which two windows or more see one plane."""
    edge_m, least = settings.plane_cell_m, settings.least_returns
    whole = np.floor(near.point_m / edge_m)
    cubes, cube = _numbered(_packed(whole.astype(np.int64)))
    keys, group = _numbered(cube * near.traverse.size + near.window)
    cube_of, window_of = np.divmod(keys, near.traverse.size)
    middle = np.empty((keys.size, 3))
    middle[group] = (whole + 0.5) * edge_m
    point, kept = near.point_m - middle[group], np.ones(group.size, np.bool_)
    windows = _Windows.of(point, group, kept, keys.size)
    for _ in range(2):
        number, values, vectors = windows.scattered(cube_of, cubes.size, least)
        normal = np.ascontiguousarray(vectors[:, :, 0])
        limit = np.where(windows.count >= least, _TRIM * np.sqrt(values[cube_of, 0]), -1.0)
        leave_out_far(point, group, windows.mean_m, normal[cube_of], limit, kept)
        windows = _Windows.of(point, group, kept, keys.size)
    flat = (values[:, 0] < _FLAT**2 * values[:, 1]) & (values[:, 1] > (_WIDE * edge_m) ** 2)
    flat &= (values[:, 0] <= settings.thickest_m**2) & (number > 0)
    used = flat[cube_of] & (windows.count >= least)
    used &= np.bincount(cube_of[used], minlength=cubes.size)[cube_of] > 1
    pose = np.bincount(group[kept], near.pose[kept], keys.size) / np.maximum(windows.count, 1)
    tilt = 1.0 / (np.maximum(number, 1) * values[:, 1])
    rank = np.where(used, np.cumsum(used) - 1, -1)
    return _Planes(
        cube_of[used], (windows.mean_m + middle)[used], windows.count[used], near.traverse[window_of[used]],
        np.rint(pose[used]).astype(np.int64), normal, np.sqrt(values[:, 0]), tilt,
        np.where(kept, rank[group], -1), np.full(int(used.sum()), -1),
    )  # fmt: skip


@dataclass(frozen=True)
class _Windows:
    """Moments of the returns of each of g windows of a cube."""

    count: Int64
    mean_m: Float64
    """(g, 3)"""
    scatter_m2: Float64
    """(g, 6) sums of products about the mean: xx, xy, xz, yy, yz, zz."""

    @classmethod
    def of(cls, point_m: Float64, group: Int64, kept: Bool, size: int) -> _Windows:
        """Returns moments from the kept points (n, 3) of each group."""
        count, total, squares = np.zeros(size, np.int64), np.zeros((size, 3)), np.zeros((size, 6))
        add_moments(point_m, group, kept, count, total, squares)
        mean = total / np.maximum(count, 1)[:, None]
        return cls(count, mean, squares - total[:, _FIRST] * mean[:, _SECOND])

    def scattered(self, cube_of: Int64, cubes: int, least: int) -> tuple[Int64, Float64, Float64]:
        """Counts (c,), ascending variances (c, 3) and axes (c, 3, 3; columns) of cubes, about their windows' means."""
        told = self.count >= least
        number = np.bincount(cube_of[told], self.count[told], cubes).astype(np.int64)
        covariance = np.empty((cubes, 3, 3))
        for k, (a, b) in enumerate(zip(_FIRST, _SECOND, strict=True)):
            sums = np.bincount(cube_of[told], self.scatter_m2[told, k], cubes)
            covariance[:, a, b] = covariance[:, b, a] = sums / np.maximum(number, 1)
        values, vectors = np.linalg.eigh(covariance)
        return number, np.maximum(values, _LEAST_VARIANCE_M2), vectors


def _packed(rows: Int64) -> Int64:
    """Returns one number (n,) for each of n rows (n, k), in the order of the rows."""
    out = np.zeros(len(rows), np.int64)
    for column in (rows - rows.min(axis=0)).T:
        out = out * (int(column.max()) + 1) + column
    return out


def _numbered(key: Int64) -> tuple[Int64, Int64]:
    """Returns distinct numbers, ascending, and the rank (n,) of each of n numbers among them; none is negative."""
    size = int(key.max()) + 1
    if size > _SPARSE * key.size:
        return np.unique(key, return_inverse=True)
    there = np.zeros(size, np.bool_)
    there[key] = True
    return np.flatnonzero(there), (np.cumsum(there) - 1)[key]


def _chosen(place: Place, planes: _Planes, most: int) -> list[int]:
    """Returns cubes whose planes make ties, in order: those with the most returns along, across and up, then of all.

    Otherwise the road beside the vehicle would displace the walls, which show other directions.
    """
    total = np.bincount(planes.cube, planes.count.astype(np.float64), len(planes.normal))
    order = np.argsort(-total, kind="stable")
    order = order[total[order] > 0]
    sine, cosine = math.sin(place.heading_rad), math.cos(place.heading_rad)
    axes = np.array([[sine, cosine, 0.0], [cosine, -sine, 0.0], [0.0, 0.0, 1.0]])
    direction = np.abs(planes.normal[order] @ axes.T).argmax(axis=1)
    first = np.concatenate([np.flatnonzero(direction == axis)[: most // _SHARE] for axis in range(3)])
    rest = np.setdiff1d(np.arange(order.size), first)
    return sorted(order[np.concatenate([first, rest])[:most]].tolist())


def _pairs(planes: _Planes, cubes: Sequence[int]) -> tuple[Int64, Int64, Float64]:
    """Returns pairs (t,) of windows of each cube, and the factors of their σ (t,).

    Each window is paired with the next, and with the one half the way through: neighbours, and those long after.
    """
    pairs, weaker = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for cube in cubes:
        windows = np.flatnonzero(planes.cube == cube)
        if windows.size < 2:
            continue
        half = windows.size // 2
        steps = (1, half) if half > 1 else (1,)
        own = np.concatenate([np.stack([windows[:-step], windows[step:]], axis=-1) for step in steps])
        pairs.append(own)
        weaker.append(np.full(len(own), math.sqrt(len(own) / (windows.size - 1))))
    first, second = np.concatenate(pairs).T
    return first, second, np.concatenate(weaker)


def _ties(
    place: Place,
    readings: Sequence[PassReadings],
    planes: _Planes,
    pairs: tuple[Int64, Int64],
    weaker: Float64,
    settings: TieSettings,
) -> list[Tie]:
    """Returns the ties of pairs of windows, each of one cube."""
    a, b = pairs
    cube = planes.cube[a]
    normal = planes.normal[cube]
    between = planes.mean_m[b] - planes.mean_m[a]
    value = np.einsum("ni,ni->n", normal, between)
    lateral2 = np.maximum(np.einsum("ni,ni->n", between, between) - value**2, 0.0)
    noise = 1.0 / planes.count[a] + 1.0 / planes.count[b] + lateral2 * planes.tilt[cube]
    sigma = weaker * np.sqrt(planes.thickness_m[cube] ** 2 * noise + 2.0 * settings.uneven_m**2)
    mean = planes.mean_m + np.array([place.easting_m, place.northing_m, 0.0])
    ends = [
        End(readings[traverse], pose, point, laser)
        for traverse, pose, point, laser in zip(
            planes.traverse.tolist(), planes.pose.tolist(), mean, planes.laser.tolist(), strict=True
        )
    ]
    direction = np.empty((a.size, 3))
    for traverse, one in enumerate(readings):
        own = planes.traverse[a] == traverse
        direction[own] = level_from_map(normal[own], one.convergence_rad)
    out = []
    for k, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        count = int(planes.count[i] + planes.count[j])
        why = TOO_FAR if abs(value[k]) > settings.most_apart_m else COUNTS
        measured = float(value[k]), float(sigma[k])
        out.append(Tie(PLANE, (ends[i], ends[j]), direction[k], *measured, count, math.nan, why, group=k))
    return out


_BLOCKS: Final = 6
"""Blocks along an edge whose means give the σ of a mean over the patch."""
_LEAST_BLOCKS: Final = 6  # From this many filled blocks on, the scatter of their means gives σ.
_UNEVEN: Final = 2.0
"""Slope hidden from the fitted plane by a step of unevenness, in RMS of the unevenness over the patch's edge."""


@dataclass(frozen=True)
class _Difference:
    """Height differences of two patches in the cells that both saw and that agree."""

    used: Bool
    """(k, k)"""
    share: float
    """Of the common cells."""
    scatter_m: float
    mean_m: float
    """Second − first."""
    sigma_m: float


def height_tie(first: Patch, second: Patch, settings: TieSettings) -> Tie:
    """Returns the tie of two patches of one place with equal cells; the direction is the normal, upwards.

    A tie that fails its tests states why: too few common cells, farther apart than the bound, too few cells that
    agree, differences that scatter, a surface that is too steep.
    """
    away = second.height_m - first.height_m
    common = np.isfinite(away)
    if int(common.sum()) < settings.least_cells:
        return _refused(first, second, FEW_CELLS, int(common.sum()))
    found = _difference(away, common, settings)
    mean = np.where(found.used, 0.5 * (first.height_m + second.height_m), np.nan)
    plane, uneven_m = _plane(first, mean, found.used)
    lift = 1.0 / math.sqrt(1.0 + plane[1] ** 2 + plane[2] ** 2)
    extent = len(mean) * first.cell_m
    aligned = _UNEVEN * uneven_m / extent * settings.misplaced_m
    sigma = lift * math.sqrt(found.sigma_m**2 + aligned**2 + settings.sigma_floor_m**2)
    ends = _ends(first, second, found.used)
    place, readings = first.place, first.readings
    up = map_from_axes(place, -plane[1:2], -plane[2:3], np.ones(1)) - [place.easting_m, place.northing_m, 0.0]
    direction = level_from_map(up * lift, readings.convergence_rad)[0]
    return Tie(
        HEIGHT, ends, direction, lift * found.mean_m, sigma, int(found.used.sum()), math.nan,
        _why_not(found, math.hypot(plane[1], plane[2]), settings),
    )  # fmt: skip


def _difference(away: Float64, common: Bool, settings: TieSettings) -> _Difference:
    """Robust mean of height differences, with a σ from the means of blocks, which shows correlated cells."""
    values = away[common]
    middle = float(np.median(values))
    scatter = scatter_about(values, middle)
    limit = settings.outlying * max(scatter, settings.sigma_floor_m)
    used = common & (np.abs(np.where(common, away, np.inf) - middle) <= limit)
    mean = float(away[used].mean())
    sums = np.bincount(_blocks(used), away[used] - mean, _BLOCKS**2)
    count = np.bincount(_blocks(used), minlength=_BLOCKS**2)
    filled, number = int((count > 0).sum()), int(used.sum())
    if filled >= _LEAST_BLOCKS:
        sigma = math.sqrt(float(sums @ sums) * filled / (filled - 1)) / number
    else:
        # The cells of a block count as one.
        sigma = scatter / math.sqrt(max(filled, 1))
    return _Difference(used, number / int(common.sum()), scatter, mean, sigma)


def _blocks(used: Bool) -> Int64:
    """Returns the block of each used cell."""
    row, column = np.nonzero(used)
    edge = len(used)
    return np.asarray(row * _BLOCKS // edge * _BLOCKS + column * _BLOCKS // edge)


def _plane(patch: Patch, height_m: Float64, used: Bool) -> tuple[Float64, float]:
    """Level and slopes (3,) along and across of a plane through heights, and its residuals' RMS by blocks (m)."""
    row, column = np.nonzero(used)
    along, across = patch.middle_m[row], patch.middle_m[column]
    design = np.stack([np.ones(row.size), along, across], axis=-1)
    level = height_m[used].mean()
    plane, *_ = np.linalg.lstsq(design, height_m[used] - level, rcond=None)
    left = height_m[used] - level - design @ plane
    count = np.bincount(_blocks(used), minlength=_BLOCKS**2)
    mean = np.bincount(_blocks(used), left, _BLOCKS**2)[count > 0] / count[count > 0]
    plane[0] += level
    return plane, float(np.sqrt(np.mean(mean**2)))


def _ends(first: Patch, second: Patch, used: Bool) -> tuple[End, End]:
    """Returns the middle of the used cells, as each traverse sees it."""
    row, column = np.nonzero(used)
    along, across = first.middle_m[row].mean(keepdims=True), first.middle_m[column].mean(keepdims=True)
    one, other = (
        End(p.readings, p.pose, map_from_axes(first.place, along, across, p.height_m[used].mean(keepdims=True))[0])
        for p in (first, second)
    )
    return one, other


def _why_not(found: _Difference, slope: float, settings: TieSettings) -> str:
    tests = (
        (abs(found.mean_m) > settings.most_apart_m, TOO_FAR),
        (int(found.used.sum()) < settings.least_cells, FEW_CELLS),
        (found.share < settings.least_share, TWO_SURFACES),
        (found.scatter_m > settings.most_scatter_m, SCATTERED),
        (slope > settings.steepest, STEEP),
    )
    return next((why for failed, why in tests if failed), COUNTS)


def _refused(first: Patch, second: Patch, why_not: str, count: int) -> Tie:
    """Returns a tie without a measurement."""
    nowhere = np.array([first.place.easting_m, first.place.northing_m, math.nan])
    one, other = (End(p.readings, p.pose, nowhere) for p in (first, second))
    return Tie(HEIGHT, (one, other), np.array([0.0, 0.0, -1.0]), math.nan, math.inf, count, math.nan, why_not)


_STEEP_RAD: Final = np.radians(6.0)
"""A plane that leans less than this from the vertical may be a wall: more than any roll that is worth a run, and less
than the sides of cars and of banks."""
_ALONG: Final = np.cos(np.radians(30.0))
"""The normal of a wall along the road has this component to the side, or more. Planes that face the drive are seen at
a low angle, and few: corners, trees, cars."""
_ABOVE_M: Final = 1.2
"""A plane is part of a wall from this height (m) above the ground beside it on: higher than safety barriers."""
_LEVEL: Final = np.cos(np.radians(18.0))
"""The normal of a plane of the ground has this component downwards, or more."""
_LEAST_WALLS: Final = 20
"""With fewer, one house that leans would decide."""
_LEAST_PLACES: Final = 3
"""Walls of fewer places may be one house's."""
_LEAST_SHARE: Final = 0.5
"""Where fewer of the planes agree, they are no walls, but hedges and banks."""
_HOUSE_RAD: Final = np.radians(0.1)
"""1 σ of the lean that all walls of a street have in common: houses are built upright to some mm a metre."""
_BACK_RAD: Final = np.radians(0.3)
"""1 σ of how far all walls of a street stand back from it, without retaining walls."""
_DOUBTED: Final = 3.0
"""A lean beyond this many σ is reported."""
_ROUNDS: Final = 20  # of weights; they settle in about ten
_NEAR: Final = 2.0  # Spread of the walls' leans beyond which one loses its weight (Cauchy's function, squared).
_LEAST_SPREAD_RAD: Final = 1e-4  # of walls without any noise
_NAMES: Final = ("place", "first_epoch_gps_ns", "easting_m", "northing_m", "direction_down", "first_by_right")

WALLS: Final = Witness(
    "walls_upright",
    input="rig file",
    fault="The roll of a lidar's boresight, or of the poses of a drive, is off.",
    asks="walls beside the road that the lidar saw: they stand upright",
    does="the lean that all of them have in common is told; nothing is corrected by it",
    told=("findings",),
)


class Lean(NamedTuple):
    """The lean that the walls that one lidar saw in one run have in common."""

    run: int
    sensor: str
    walls: int
    """That agree."""
    roll_rad: float
    """By which the stated roll is too large."""
    sigma_rad: float


def leans(columns: Mapping[str, npt.NDArray[Any]], tracks: Sequence[Track], runs: Sequence[str]) -> list[Lean]:
    """Returns the leans of walls by run and lidar, where there are enough walls; columns: of ties (n,), by name."""
    within = (columns["kind"] == PLANE) & (columns["first_run"] == columns["second_run"])
    within &= columns["first_sensor"] == columns["second_sensor"]
    within &= (np.abs(columns["direction_down"]) < np.sin(_STEEP_RAD)) & (np.abs(columns["first_by_right"]) > _ALONG)
    within[within] = _above_ground_m(columns, within) > _ABOVE_M
    found = []
    for track in tracks:
        own = within & (columns["first_run"] == runs[track.run]) & (columns["first_sensor"] == track.sensor)
        # All ties of a plane have its normal: the first of each counts.
        key = np.stack([columns[name][own] for name in ("place", "direction_north", "direction_down")])
        first = np.flatnonzero(own)[np.unique(key, axis=1, return_index=True)[1]]
        lean = _lean(track, {name: columns[name][first] for name in _NAMES})
        found += [] if lean is None else [lean]
    return found


def _above_ground_m(columns: Mapping[str, npt.NDArray[Any]], which: Bool) -> Float64:
    """Returns the heights (w,) of some ties above the ground of their place; NaN where no tie of the ground is."""
    level = np.flatnonzero(np.abs(columns["direction_down"]) > _LEVEL)
    rising = level[np.lexsort((columns["height_m"][level], columns["place"][level]))]
    places, first, count = np.unique(columns["place"][rising], return_index=True, return_counts=True)
    height_m = columns["height_m"][rising]
    if not places.size:
        return np.full(int(which.sum()), np.nan)
    ground_m = 0.5 * (height_m[first + (count - 1) // 2] + height_m[first + count // 2])
    place = columns["place"][which]
    at = np.searchsorted(places, place).clip(max=places.size - 1)
    return np.where(places[at] == place, columns["height_m"][which] - ground_m[at], np.nan)


def _lean(track: Track, walls: Mapping[str, npt.NDArray[Any]]) -> Lean | None:
    """Returns the lean of walls (w,) of one track; None where they are too few, or do not tell."""
    if walls["place"].size < _LEAST_WALLS or np.unique(walls["place"]).size < _LEAST_PLACES:
        return None
    at = np.searchsorted(track.epoch_gps_ns, walls["first_epoch_gps_ns"]).clip(max=track.epoch_gps_ns.size - 1)
    east, north = walls["easting_m"] - track.easting_m[at], walls["northing_m"] - track.northing_m[at]
    is_right = east * np.cos(track.heading_rad[at]) > north * np.sin(track.heading_rad[at])
    side = walls["first_by_right"]
    design = np.stack([side, np.where(is_right, side, -side)], axis=1)
    roll, sigma, agreeing = _robust(design, np.arcsin(walls["direction_down"]))
    if agreeing < max(_LEAST_SHARE * side.size, _LEAST_WALLS) or sigma > _STEEP_RAD / _DOUBTED:
        return None
    return Lean(track.run, track.sensor, agreeing, roll, float(np.hypot(sigma, _HOUSE_RAD)))


def _robust(design: Float64, observed: Float64) -> tuple[float, float, int]:
    """Returns the first unknown, its σ, and how many observations (n,) agree, by Cauchy's weights, squared.

    design : (n, 2).
    """
    values = np.zeros(2)
    for _ in range(_ROUNDS):
        residual = np.abs(observed - design @ values)
        spread = max(scatter_about(residual, 0.0), _LEAST_SPREAD_RAD)
        weight = (1.0 + (residual / (_NEAR * spread)) ** 2) ** -2.0
        prior = np.diag([0.0, (spread / _BACK_RAD) ** 2])
        inverse = np.linalg.inv(design.T @ (weight[:, None] * design) + prior)
        values = inverse @ design.T @ (weight * observed)
    return float(values[0]), float(spread * np.sqrt(inverse[0, 0])), int((residual < _DOUBTED * spread).sum())


def lean_findings(found: Sequence[Lean], runs: Sequence[str]) -> list[Finding]:
    """Returns findings on walls that lean by more than walls do."""
    return [
        WALLS.finds(
            f"{one.sensor} in run '{runs[one.run]}'",
            f"{one.walls} walls beside the road lean as if the stated roll were "
            f"{np.degrees(one.roll_rad):+.2f}° too large (σ {np.degrees(one.sigma_rad):.2f}°), that of the boresight "
            "in the rig file or that of the poses; nothing is corrected by it: calibrate the boresight, or look at the "
            "attitude of the poses",
        )
        for one in found
        if abs(one.roll_rad) > _DOUBTED * one.sigma_rad
    ]
