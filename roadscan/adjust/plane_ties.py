"""Lidar ties: planes of the ground, of kerbs' faces and of walls that windows of time saw, of one pass or of several.

Returns of a lidar are too sparse for pictures. In a cube, all windows together know how a plane lies, each window how
far along the plane's normal (point to plane; Chen and Medioni 1992). The normal is that of the returns about the mean
of their own window, so windows that lie apart do not bend it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.adjust.patches import PassReadings, level_from_map
from roadscan.adjust.places import Place
from roadscan.adjust.tie import COUNTS, PLANE, TOO_FAR, End, Tie
from roadscan.model.gpstime import NS_PER_S
from roadscan.model.settings.tie_settings import TieSettings
from roadscan.navigation.calibration.surfels import plane_moments

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

_FLAT: Final = 0.25
"""A plane's thickness is below this share of its shorter extent."""
_WIDE: Final = 0.1
"""Its returns spread (1 σ) over this share of the cube along both of its axes."""
_TRIM: Final = 3.0


@dataclass(frozen=True)
class _Returns:
    """Returns of all traverses near a place."""

    point_m: Float64
    """(n, 3) from the place, map axes."""
    traverse: Int64
    """(n,)"""
    pose: Int64
    """(n,) row in the poses of its traverse."""
    epoch_gps_ns: Int64


@dataclass(frozen=True)
class _Planes:
    """Cubes that hold a plane, and the means of their windows, g, by cube and time."""

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
    """(c,) variance of the plane's tilt (rad²), the worse axis."""


def plane_ties(place: Place, readings: Sequence[PassReadings], settings: TieSettings) -> list[Tie]:
    """Ties along the normals of planes between windows of `settings.window_s`, those of a cube in a ring.

    Where more ties hold windows together than are needed, their σ are larger: q ties of m windows say m − 1 things.
    """
    near = _near(place, readings) if readings else None
    if near is None or near.pose.size == 0:
        return []
    planes = _planes(near, settings)
    out: list[Tie] = []
    for cube in _largest(planes, settings.most_planes):
        windows = np.flatnonzero(planes.cube == cube)
        pairs = _pairs(windows.size)
        weaker = math.sqrt(len(pairs) / (windows.size - 1))
        for a, b in pairs:
            tie = _tie(place, readings, planes, (int(windows[a]), int(windows[b])), settings)
            out.append(replace(tie, sigma_m=tie.sigma_m * weaker, group=len(out)))
    return out


def _near(place: Place, readings: Sequence[PassReadings]) -> _Returns:
    """Returns within the radius of a place."""
    parts = []
    for number, one in enumerate(readings):
        point = np.stack([one.easting_m - place.easting_m, one.northing_m - place.northing_m, one.height_m], axis=-1)
        inside = np.flatnonzero((np.abs(point[:, :2]) <= place.radius_m).all(axis=1) & np.isfinite(point[:, 2]))
        pose = one.pose[inside].astype(np.int64)
        parts.append((point[inside], np.full(inside.size, number), pose, one.epoch_gps_ns[pose]))
    return _Returns(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _planes(near: _Returns, settings: TieSettings) -> _Planes:
    """Cubes in which two windows or more see one plane."""
    window = near.epoch_gps_ns // round(settings.window_s * NS_PER_S)
    whole = np.floor(near.point_m / settings.plane_cell_m).astype(np.int64)
    cubes, cube = np.unique(_packed(whole), return_inverse=True)
    keys, group = np.unique(_packed(np.stack([cube, near.traverse, window], axis=-1)), return_inverse=True)
    first = np.empty(keys.size, np.int64)
    first[group[::-1]] = np.arange(group.size)[::-1]
    cube_of, traverse_of = cube[first], near.traverse[first]
    kept = np.ones(len(near.point_m), np.bool_)
    for _ in range(2):
        count = np.bincount(group[kept], minlength=keys.size)
        kept &= count[group] >= settings.least_returns
        mean = _means(near.point_m, group, kept, keys.size)
        centred = near.point_m - mean[group]
        number, _, values, vectors = plane_moments(centred[kept], cube_of[group[kept]], cubes.size)
        values = np.maximum(values, 1e-10)
        away = np.abs(np.einsum("ni,ni->n", centred, vectors[cube_of[group], :, 0]))
        kept &= away <= _TRIM * np.sqrt(values[cube_of[group], 0])
    flat = (values[:, 0] < _FLAT**2 * values[:, 1]) & (values[:, 1] > (_WIDE * settings.plane_cell_m) ** 2)
    flat &= (values[:, 0] <= settings.thickest_m**2) & (number > 0)
    count = np.bincount(group[kept], minlength=keys.size)
    used = flat[cube_of] & (count >= settings.least_returns)
    used &= np.bincount(cube_of[used], minlength=cubes.size)[cube_of] > 1
    pose = np.bincount(group[kept], near.pose[kept], keys.size) / np.maximum(count, 1)
    tilt = values[:, 0] / (np.maximum(number, 1) * values[:, 1])
    return _Planes(
        cube_of[used], _means(near.point_m, group, kept, keys.size)[used], count[used], traverse_of[used],
        np.rint(pose[used]).astype(np.int64), vectors[:, :, 0], np.sqrt(values[:, 0]), tilt,
    )  # fmt: skip


def _packed(rows: Int64) -> Int64:
    """One number (n,) for each of n rows (n, k), in the order of the rows."""
    out = np.zeros(len(rows), np.int64)
    for column in (rows - rows.min(axis=0)).T:
        out = out * (int(column.max()) + 1) + column
    return out


def _means(point_m: Float64, group: Int64, kept: Bool, size: int) -> Float64:
    count = np.maximum(np.bincount(group[kept], minlength=size), 1)
    sums = [np.bincount(group[kept], point_m[kept, a], size) for a in range(3)]
    return np.asarray(np.stack(sums, axis=-1) / count[:, None])


def _largest(planes: _Planes, most: int) -> list[int]:
    """Cubes with the most returns, in their own order."""
    total = np.bincount(planes.cube, planes.count.astype(np.float64))
    order = np.argsort(-total, kind="stable")[:most]
    return sorted(int(c) for c in order if total[c] > 0)


def _pairs(count: int) -> list[tuple[int, int]]:
    """Each window with the next, and with the one half the way through: neighbours, and those long after."""
    half = count // 2
    far = [(k, k + half) for k in range(count - half)] if half > 1 else []
    return [*pairwise(range(count)), *far]


def _tie(
    place: Place, readings: Sequence[PassReadings], planes: _Planes, windows: tuple[int, int], settings: TieSettings
) -> Tie:
    """The tie of two windows of one cube."""
    a, b = windows
    cube = planes.cube[a]
    normal = planes.normal[cube]
    between = planes.mean_m[b] - planes.mean_m[a]
    value = float(normal @ between)
    lateral2 = max(float(between @ between) - value**2, 0.0)
    noise = planes.thickness_m[cube] ** 2 * (1.0 / planes.count[a] + 1.0 / planes.count[b])
    sigma = math.sqrt(float(noise + lateral2 * planes.tilt[cube]) + 2.0 * settings.uneven_m**2)
    offset = np.array([place.easting_m, place.northing_m, 0.0])
    one, other = (
        End(readings[planes.traverse[k]], int(planes.pose[k]), planes.mean_m[k] + offset) for k in (a, b)
    )  # fmt: skip
    direction = level_from_map(normal[None], one.readings.convergence_rad)[0]
    why = TOO_FAR if abs(value) > settings.most_apart_m else COUNTS
    return Tie(PLANE, (one, other), direction, value, sigma, int(planes.count[a] + planes.count[b]), math.nan, why)
