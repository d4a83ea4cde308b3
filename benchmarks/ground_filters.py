"""Published filters of bare earth in their plain forms, to hold ours against: SMRF, PMF, progressive TIN, cloth.

Each takes a sample and a setting, and returns a mask (n,) of the points on the ground. Returns in pits, deeper than 8 m
in a surface of cells of 1 m, are left out first: all four ask for data without low outliers. Openings and membranes
are ours, because these are tested on their own.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import sys
from collections.abc import Iterator
from typing import Any

import CSF
import numpy as np
import numpy.typing as npt
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import Delaunay

from roadscan.assets.ground.surface import Grid, filled, opened

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_PIT_M = 8.0
_FEW = 0.002
"""Densification ends when a smaller share of the points joins."""


class Sample:
    """Points (n, 3) in metres from their lowest x and y, and the surface of the lowest of them in cells of 1 m."""

    def __init__(self, points: Float64) -> None:
        self.points = points
        column, row = np.floor(points[:, :2]).astype(int).T
        self.cell: tuple[Any, Any] = row, column
        lowest = np.full((row.max() + 1, column.max() + 1), np.inf)
        np.minimum.at(lowest, self.cell, points[:, 2])
        self.known = np.isfinite(lowest)
        self.lowest_m: Float32 = lowest.astype(np.float32)
        self.grid = Grid(0.0, 0.0, 1.0, *lowest.shape)
        whole = filled(self.lowest_m, self.known, self.grid)
        self.known &= -whole - opened(-whole, 1) <= _PIT_M
        self.surface_m = filled(self.lowest_m, self.known, self.grid)

    @functools.cached_property
    def sound(self) -> Bools:
        """Returns a mask (n,) of points that lie in no pit."""
        return self.points[:, 2] >= self.surface_m[self.cell] - 0.01

    @functools.cache  # noqa: B019
    def opened(self, radius: int) -> Float32:
        """Returns the surface opened by a disk of so many cells; 0 leaves it as it is."""
        return opened(self.surface_m, radius) if radius else self.surface_m


def smrf(sample: Sample, *, slope: float, window_m: float, threshold_m: float, scaling: float) -> Bools:
    """Simple morphological filter (Pingel, Clarke, McBride 2013, section 2)."""
    stands = np.zeros(sample.known.shape, np.bool_)
    for radius in range(1, round(window_m) + 1):
        stands |= sample.opened(radius - 1) - sample.opened(radius) > slope * radius
    ground = filled(sample.lowest_m, sample.known & ~stands, sample.grid)
    steepness = np.hypot(*np.gradient(ground))
    above = np.abs(sample.points[:, 2] - sampled(ground, sample.points))
    return np.asarray(above <= threshold_m + scaling * sampled(steepness, sample.points))


def pmf(sample: Sample, *, slope: float, window_m: float, most_m: float) -> Bools:
    """Progressive morphological filter (Zhang et al. 2003, section III), windows doubling."""
    found, radius, limit = sample.sound.copy(), 1, 0.3
    while radius <= window_m:
        found &= sample.points[:, 2] - sample.opened(radius)[sample.cell] <= limit
        radius, limit = 2 * radius, min(slope * 2.0 * radius + 0.3, most_m)
    return found


def progressive_tin(sample: Sample, *, building_m: float, angle_deg: float, distance_m: float) -> Bools:
    """Progressive densification of a TIN (Axelsson 2000): by distance to a facet and angles to its corners, and by
    the mirror point of a return about the nearest corner of a steep facet."""
    points, sound = sample.points, sample.sound
    cell = np.floor(points[:, :2] / building_m).astype(int)
    order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
    order = order[sound[order]]
    first = np.ones(order.size, np.bool_)
    first[1:] = (np.diff(cell[order], axis=0) != 0).any(axis=1)
    found = np.zeros(len(points), np.bool_)
    found[order[first]] = True
    seeds = points[found]
    low, high = points[:, :2].min(axis=0) - 10.0, points[:, :2].max(axis=0) + 10.0
    frame = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    nearest = ((frame[:, None] - seeds[:, :2]) ** 2).sum(axis=2).argmin(axis=1)
    corners = np.column_stack([frame, seeds[nearest, 2]])
    for _ in range(50):
        tin = np.vstack([points[found], corners])
        net = Delaunay(tin[:, :2])
        rest = np.flatnonzero(~found & sound)
        joins = fits(points[rest], tin, net, angle_deg, distance_m)
        if joins.sum() < _FEW * len(points):
            break
        found[rest[joins]] = True
    return found


def fits(points: Float64, tin: Float64, net: Delaunay, angle_deg: float, distance_m: float) -> Bools:
    """Returns a mask (n,) of points whose facet they fit, or whose mirror points do."""

    def close(xyz: Float64) -> tuple[Bools, Float64, Bools]:
        facet = net.find_simplex(xyz[:, :2])
        a, b, c = np.moveaxis(tin[net.simplices[facet]], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        away = np.abs(((xyz - a) * normal).sum(axis=1))
        spans = np.stack([np.linalg.norm(xyz - v, axis=1) for v in (a, b, c)])
        angle = np.degrees(np.arcsin(np.minimum(away / np.maximum(spans, 1e-9), 1.0))).max(axis=0)
        steep = np.abs(normal[:, 2]) < math.cos(math.radians(angle_deg))
        corner = np.stack([a, b, c])[spans.argmin(axis=0), np.arange(len(xyz))]
        return (facet >= 0) & (away <= distance_m) & (angle <= angle_deg), corner, steep

    joins, corner, steep = close(points)
    mirror = np.column_stack([2.0 * corner[:, :2] - points[:, :2], points[:, 2]])
    return joins | (steep & close(mirror)[0])


def cloth(sample: Sample, *, cell_m: float, rigidness: int, threshold_m: float) -> Bools:
    """Cloth simulation (Zhang et al. 2016), by the authors' package."""
    sound = np.flatnonzero(sample.sound)
    csf = CSF.CSF()
    csf.params.bSloopSmooth = True
    csf.params.cloth_resolution, csf.params.rigidness, csf.params.class_threshold = cell_m, rigidness, threshold_m
    csf.setPointCloud(sample.points[sound])
    ground, others = CSF.VecInt(), CSF.VecInt()
    with silent():
        csf.do_filtering(ground, others, False)
    found = np.zeros(len(sample.points), np.bool_)
    found[sound[np.array(ground)]] = True
    return found


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Let compiled code print nothing."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def sampled(surface: Float32, points: Float64) -> Float64:
    """Returns heights at points, bilinear between the middles of cells."""
    axes = [np.arange(side) + 0.5 for side in surface.shape]
    at = [np.clip(points[:, k], axis[0], axis[-1]) for k, axis in ((1, axes[0]), (0, axes[1]))]
    return np.asarray(RegularGridInterpolator(axes, surface)(np.column_stack(at)))
