"""Upright surfaces in voxels: elements on one plane, joined over gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.bins import in_bins
from roadscan.assets.kernels.two_faces import ask_for_faces, gather_faces, part_faces
from roadscan.assets.kernels.upright_voxels import gather_moments, grow_regions, region_ranges, thin_elements
from roadscan.assets.quantiles import quantiles
from roadscan.assets.scene import Scene, once_a_scene
from roadscan.assets.upright.slices import usable_above_m
from roadscan.compute.array_types import Bool, Float64, Int64

SIDE_M: Final = 0.25  # Side of a voxel (m).
LAYER_M: Final = 0.5  # Height of a voxel (m).
LOWEST_M: Final = 0.15  # Height above the ground at which voxels start (m).
LAYERS: Final = 40
"""Number of layers: up to 20 m above the ground."""
_LIMITS: Final = np.array([6.0, 0.12, 0.06, 0.35])
"""Limits of an element: returns, spread along and across its plane (m), ratio of both."""
_TURN_DEG: Final = 20.0  # Greatest angle between neighbouring elements of one plane (degrees).
_APART_M: Final = 0.12
"""Neighbouring elements lie on one plane if each is this near to the other's (m)."""
_LEAST_LENGTH_M: Final = 0.7  # Least length of a surface (m).
_JOIN_TURN_DEG: Final = 8.0  # Greatest angle between two lines that join (degrees).
_JOIN_APART_M: Final = 0.15  # Greatest lateral distance between them (m).
_JOIN_GAP_M: Final = 1.6  # Longest gap between them (m).


@dataclass(frozen=True, eq=False)
class Region:
    """An upright surface: returns of a scene that lie on it."""

    rows: Int64
    middle_xy_m: Float64
    along: Float64
    """(2,) unit vector of its direction seen from above."""
    span_m: tuple[float, float]
    """Extent along it, from its middle."""
    across_m: float
    """Median standard deviation of its elements across their planes."""
    low_above_m: float
    """Height above the ground below which 2 % of its returns lie, and …"""
    top_above_m: float
    """… above."""

    @property
    def length_m(self) -> float:
        """Returns its length from end to end."""
        return self.span_m[1] - self.span_m[0]

    def distance_m(self, x_m: float, y_m: float, beyond_m: float) -> float:
        """Returns the distance of a place beside its line, `beyond_m` past its ends at the most; infinite elsewhere."""
        dx, dy = x_m - float(self.middle_xy_m[0]), y_m - float(self.middle_xy_m[1])
        along = dx * float(self.along[0]) + dy * float(self.along[1])
        if not self.span_m[0] - beyond_m <= along <= self.span_m[1] + beyond_m:
            return math.inf
        return abs(dy * float(self.along[0]) - dx * float(self.along[1]))


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Voxels of the returns that may belong to something upright, and their elements: one, or two faces."""

    index: npt.NDArray[np.int32]
    """(layers, rows, columns) number of a voxel, and of its element; −1: empty."""
    second: npt.NDArray[np.int32]
    """(voxels,) number of the element of a second face; −1: none."""
    elements: Float64
    """(elements, 6) as :func:`thin_elements` has them, places from the corner of the voxels."""
    element: npt.NDArray[np.int32]
    """(n,) element of each return; −1: none."""
    corner_m: Float64


@once_a_scene
def _voxels(scene: Scene) -> _Voxels:
    window, returns = scene.extent, scene.returns
    columns = int(np.ceil((window.x_max_m - window.x_min_m) / SIDE_M - 1e-9))
    rows = int(np.ceil((window.y_max_m - window.y_min_m) / SIDE_M - 1e-9))
    index = np.full((LAYERS, rows, columns), -1, np.int32)
    above = usable_above_m(scene)
    most = min(int(np.count_nonzero(np.isfinite(above))), int(index.size))
    moments, voxel = np.empty((max(most, 1), 10)), np.empty(len(returns), np.int32)
    corner = np.array([window.x_min_m, window.y_min_m, LOWEST_M])
    sizes = np.array([SIDE_M, LAYER_M])
    found = gather_moments(returns.x_m, returns.y_m, above, corner, sizes, index, moments, voxel)
    elements, second = np.zeros((2 * found, 6)), np.full(found, -1, np.int32)
    thin_elements(index, moments, SIDE_M, _LIMITS, elements)
    asked, normals = np.zeros(found, np.bool_), np.full((found, 2), np.nan)
    if ask_for_faces(index, moments, SIDE_M, elements, asked, normals):
        faces, face = np.zeros((2 * found, 6)), np.empty(len(returns), np.int8)
        x, y, sensor = returns.x_m, returns.y_m, (returns.sensor_x_m, returns.sensor_y_m)
        gather_faces(x, y, *sensor, voxel, normals, corner, SIDE_M, moments, faces, face)
        turn = math.cos(math.radians(_TURN_DEG))
        elements = elements[: part_faces(index, asked, normals, faces, SIDE_M, _LIMITS, turn, elements, second)]
        other = np.append(second, -1)[voxel]  # voxel −1 is the last entry
        voxel = np.where((face > 0) & (other >= 0), other, voxel).astype(np.int32)
    return _Voxels(index, second, elements, voxel, corner)


def on_thin(scene: Scene) -> Bool:
    """Returns a mask (n,) of the returns in voxels that, with those beside them, lie on an upright plane."""
    v = _voxels(scene)
    return np.append(v.elements[:, 0] > 0.0, False)[v.element]  # element −1 is the last entry


@once_a_scene
def regions_of(scene: Scene) -> list[Region]:
    """Returns upright surfaces at least 0.7 m long, with pieces on one plane joined over gaps of 1.6 m."""
    seen = _voxels(scene)
    elements, count = seen.elements.copy(), len(seen.elements)
    region, stack = np.zeros(count, np.int32), np.empty((count, 4), np.int32)
    turn = math.cos(math.radians(_TURN_DEG))
    found = grow_regions(seen.index, seen.second, elements, turn, _APART_M, np.array([1, 1]), region, stack)
    members, starts = np.empty(count, np.int64), np.empty(found + 2, np.int64)
    region_ranges(region, members, starts)
    elements[:, 1:3] += seen.corner_m[:2]
    groups = [members[starts[k] : starts[k + 1]] for k in range(1, found + 1)]
    groups = [g for g in groups if g.size >= 3]
    joined = _joined(elements, groups)
    group_of = np.full(count + 1, -1, np.int32)
    for number, group in enumerate(joined):
        group_of[group] = number
    first, order = in_bins(group_of[seen.element], len(joined))  # element −1 is the last entry, which belongs to none
    regions = (_region(scene, elements[group], order[first[k] : first[k + 1]]) for k, group in enumerate(joined))
    return [one for one in regions if one is not None]


def _line(elements: Float64) -> tuple[Float64, Float64, float, float]:
    """Returns middle (2,), direction (2,) and span of elements (n, 6) seen from above."""
    middle = elements[:, 1:3].mean(axis=0)
    past = elements[:, 1:3] - middle
    if past.shape[0] < 3:
        along = elements[0, 3:5]
    else:
        _, _, axes = np.linalg.svd(past, full_matrices=False)
        along = axes[0]
    if along[0] < 0.0 or (along[0] == 0.0 and along[1] < 0.0):
        along = -along
    t = past @ along
    return middle, along, float(t.min()) - SIDE_M, float(t.max()) + SIDE_M


def _joined(elements: Float64, groups: list[Int64]) -> list[Int64]:
    """Returns groups of elements, those on one plane beside one another joined; in the order of their first element."""
    lines = [_line(elements[g]) for g in groups]
    parent = list(range(len(groups)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    ends = np.array([[*(m + a * s), *(m + a * t)] for m, a, s, t in lines]).reshape(-1, 4)
    for i in range(len(groups)):
        near = _boxes_near(ends, i)
        for j in near[near > i].tolist():
            if _on_one_line(lines[i], lines[j]):
                parent[max(root(i), root(j))] = min(root(i), root(j))
    out: dict[int, list[Int64]] = {}
    for i, group in enumerate(groups):
        out.setdefault(root(i), []).append(group)
    return [np.sort(np.concatenate(parts)) for parts in out.values()]


def _boxes_near(ends: Float64, i: int) -> Int64:
    """Returns lines whose boxes come within the joining gap of line `i`'s."""
    x0, x1 = np.minimum(ends[:, 0], ends[:, 2]), np.maximum(ends[:, 0], ends[:, 2])
    y0, y1 = np.minimum(ends[:, 1], ends[:, 3]), np.maximum(ends[:, 1], ends[:, 3])
    gap = _JOIN_GAP_M
    return np.flatnonzero((x0 <= x1[i] + gap) & (x1 >= x0[i] - gap) & (y0 <= y1[i] + gap) & (y1 >= y0[i] - gap))


def _on_one_line(first: tuple[Float64, Float64, float, float], second: tuple[Float64, Float64, float, float]) -> bool:
    """Whether two lines continue each other: nearly parallel, the nearer parts within 0.15 m, a short gap or none."""
    (m1, a1, s1, t1), (m2, a2, s2, t2) = first, second
    if abs(float(a1 @ a2)) < math.cos(math.radians(_JOIN_TURN_DEG)):
        return False
    if t2 - s2 > t1 - s1:
        (m1, a1, s1, t1), (m2, a2, s2, t2) = second, first
    ends = np.array([m2 + a2 * s2, m2 + a2 * t2]) - m1
    along, across = ends @ a1, np.abs(a1[0] * ends[:, 1] - a1[1] * ends[:, 0])
    gap = max(float(along.min()) - t1, s1 - float(along.max()))
    nearer = float(across[np.argmin(np.abs(along - 0.5 * (s1 + t1)))])
    return gap <= _JOIN_GAP_M and nearer <= _JOIN_APART_M


def _region(scene: Scene, elements: Float64, rows: Int64) -> Region | None:
    middle, along, low, high = _line(elements)
    if high - low < _LEAST_LENGTH_M + 2 * SIDE_M:
        return None
    bottom, top = quantiles(scene.above_ground_m[rows].astype(np.float64), [0.02, 0.98])
    across = float(np.median(elements[:, 5]))
    return Region(rows, middle, along, (low, high), across, bottom, top)
