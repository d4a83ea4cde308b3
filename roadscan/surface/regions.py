"""Regions of interest: where a coarse model varies in depth more than its street does, and where the user states one.

"By observing the coarse models, and looking at the variation of 3D depth measurements, cracks in smaller regions can be
identified" (Yu and others 2007, 3.2.3). Here that is a rule. The stretch is cut into square patches. A patch's
roughness is the root mean square of its heights about the plane that fits it and its neighbours along the road,
`level_patches` in all, so grade, crossfall, crown, ruts and long waves do not count. It is compared with the street's
own: the median of all patches within the same section, or of those at about the same offset in it, where that is more.
A patch stands out where its roughness exceeds `factor` times that and `least_m`, on the surface before the median
(narrow cracks) or after it (potholes in noisy ranges). Patches that touch, or lie within `join_m`, are one region; its
box along and across the road, padded, is its outline.

Patches and sections are counted from multiples of their length along the stretch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Bool, Float64
from roadscan.surface.coarse import CoarseModel
from roadscan.surface.kernels.coarse import PATCH_SUMS, sum_patches
from roadscan.surface.settings import RegionSettings

FOUND: Final = "found"
STATED: Final = "stated"

_FEWEST: Final = 12
"""Least number of nodes in a patch."""
_BESIDE: Final = 4
"""Patches to either side with about the same offset: a crack along the road is far narrower."""


@dataclass(frozen=True)
class Region:
    """A part of the road that is reconstructed in detail."""

    outline_m: Float64
    """(k, 2) corners, easting and northing, not closed."""
    origin: str
    """``found`` or ``stated``."""
    roughness_m: float = float("nan")
    """Largest roughness of its patches; NaN for those that were stated."""
    span_m: tuple[float, float] = (float("nan"), float("nan"))
    """Begin and end along the stretch in which it was found (m)."""

    @property
    def polygon(self) -> shapely.Polygon:
        """Returns the outline as a polygon."""
        return shapely.Polygon(self.outline_m)

    def holds(self, easting_m: Float64, northing_m: Float64) -> Bool:
        """Returns a mask of the places (any shape) within it."""
        polygon = self.polygon
        shapely.prepare(polygon)
        inside: Bool = shapely.intersects_xy(polygon, easting_m, northing_m)
        return inside


def stated_regions(polygons: Iterable[npt.ArrayLike]) -> list[Region]:
    """Returns regions that the user states: corners (k, 2) of each, easting and northing in the survey's map (m)."""
    return [Region(np.asarray(one, np.float64), STATED) for one in polygons]


def find_regions(model: CoarseModel, settings: RegionSettings) -> list[Region]:
    """Returns regions where the coarse model varies in depth, in the order of the drive."""
    from scipy.ndimage import binary_dilation, find_objects, label

    if not model.height_m.size or model.along_m[0] == model.along_m[-1]:
        return []  # a vehicle that stood still gives one line
    patches = _Patches.of(model, settings.patch_m)
    interesting = np.zeros(patches.shape, bool)
    most = np.zeros(patches.shape)
    for surface in (model.spline_m, model.height_m):
        rough = patches.roughness_m(surface, settings.level_patches)
        own = patches.street_m(rough, settings.section_m)
        interesting |= np.nan_to_num(rough) > np.maximum(settings.factor * own, settings.least_m)
        most = np.fmax(most, rough)
    reach = int(np.ceil(settings.join_m / patches.edge_m / 2.0))
    joined = binary_dilation(interesting, np.ones((2 * reach + 1, 2 * reach + 1), bool)) if reach else interesting
    numbers, _ = label(joined, np.ones((3, 3), int))
    numbers[~interesting] = 0
    boxes = [
        patches.box_m(where, settings.pad_m, float(most[where][numbers[where] == number].max()))
        for number, where in enumerate(find_objects(numbers), start=1)
        if where is not None and np.count_nonzero(numbers[where] == number) >= settings.patches_min
    ]
    return [_region(model, box) for box in sorted(_merged(boxes))]


@dataclass(frozen=True)
class _Patches:
    """Square patches of a stretch."""

    model: CoarseModel
    nodes: int
    """Number of steps across in a patch."""
    first_row: int
    first_column: int
    shape: tuple[int, int]

    @classmethod
    def of(cls, model: CoarseModel, patch_m: float) -> _Patches:
        nodes = max(round(patch_m / model.settings.spacing_m), 1)
        edge = nodes * model.settings.spacing_m
        rows = np.floor(model.along_m[[0, -1]] / edge).astype(int)
        columns = np.array([model.first_node, model.first_node + model.height_m.shape[1] - 1]) // nodes
        return cls(model, nodes, rows[0], columns[0], (rows[1] - rows[0] + 1, columns[1] - columns[0] + 1))

    @property
    def edge_m(self) -> float:
        """Returns the edge of a patch (m)."""
        return self.nodes * self.model.settings.spacing_m

    def roughness_m(self, surface_m: Float64, level_patches: int) -> Float64:
        """Returns the RMS (rows, columns) of a surface's heights about the plane around each patch (m), or NaN."""
        from scipy.ndimage import uniform_filter1d

        sums = np.zeros((*self.shape, PATCH_SUMS))
        sum_patches(
            self.model.along_m, surface_m, self.model.first_node, self.model.settings.spacing_m, self.edge_m,
            self.nodes, self.first_row, self.first_column, sums,
        )  # fmt: skip
        around = uniform_filter1d(sums, level_patches, axis=0, mode="constant") * level_patches
        plane = _planes(around)
        n = np.maximum(sums[..., 0], 1.0)
        a, b, c = np.moveaxis(plane, -1, 0)
        _, x, y, z, xx, xy, yy, xz, yz, zz = np.moveaxis(sums / n[..., None], -1, 0)
        square = (
            zz - 2.0 * (a * z + b * xz + c * yz)
            + a * a + b * b * xx + c * c * yy + 2.0 * (a * b * x + a * c * y + b * c * xy)
        )  # fmt: skip
        rough: Float64 = np.where(sums[..., 0] >= _FEWEST, np.sqrt(np.maximum(square, 0.0)), np.nan)
        return rough

    def street_m(self, rough_m: Float64, section_m: float) -> Float64:
        """Returns the roughness (rows, columns) of the street around each patch (m); 0 where there is none.

        The median of the section, or, where that is more, of the patches at about the same offset: a scanner's noise in
        height is largest below it, and far aside its readings are few.
        """
        section = ((self.first_row + np.arange(self.shape[0])) * self.edge_m // section_m).astype(int)
        own = np.zeros(self.shape)
        for one in np.unique(section):
            rough = rough_m[section == one]
            beside = [rough[:, max(k - _BESIDE, 0) : k + _BESIDE + 1] for k in range(self.shape[1])]
            own[section == one] = np.maximum(_median(rough), [_median(part) for part in beside])
        return own

    def box_m(self, where: tuple[slice, slice], pad_m: float, roughness_m: float) -> tuple[float, ...]:
        """Returns first and end along, first and end across, roughness."""
        rows, columns = where
        return (
            (self.first_row + rows.start) * self.edge_m - pad_m, (self.first_row + rows.stop) * self.edge_m + pad_m,
            (self.first_column + columns.start) * self.edge_m - pad_m,
            (self.first_column + columns.stop) * self.edge_m + pad_m, roughness_m,
        )  # fmt: skip


def _median(values: Float64) -> float:
    """Returns the median of the numbers that are not NaN, 0 without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def _planes(sums: Float64) -> Float64:
    """Returns least-squares planes (…, 3), z = a + b x + c y, of sums (…, 10); level where the nodes are collinear."""
    n = np.maximum(sums[..., 0], 1.0)
    _, x, y, z, xx, xy, yy, xz, yz, _ = np.moveaxis(sums / n[..., None], -1, 0)
    vxx, vxy, vyy = xx - x * x, xy - x * y, yy - y * y
    vxz, vyz = xz - x * z, yz - y * z
    determinant = vxx * vyy - vxy * vxy
    sound = determinant > 1e-6 * np.maximum(vxx * vyy, 1e-12)
    safe = np.where(sound, determinant, 1.0)
    b = np.where(sound, (vxz * vyy - vyz * vxy) / safe, 0.0)
    c = np.where(sound, (vyz * vxx - vxz * vxy) / safe, 0.0)
    return np.stack([z - b * x - c * y, b, c], axis=-1)


def _merged(boxes: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Returns boxes that do not overlap, each the hull of overlapping ones."""
    left, done = list(boxes), []
    while left:
        one = left.pop()
        for k, other in enumerate(left):
            if one[0] < other[1] and other[0] < one[1] and one[2] < other[3] and other[2] < one[3]:
                hull = (
                    min(one[0], other[0]), max(one[1], other[1]), min(one[2], other[2]), max(one[3], other[3]),
                    max(one[4], other[4]),
                )  # fmt: skip
                left[k] = hull
                break
        else:
            done.append(one)
    return done


def _region(model: CoarseModel, box: tuple[float, ...]) -> Region:
    """Returns a box along and across the road as an outline on the map; it bends with the road."""
    start, end, left, right, roughness = box
    along = model.along_m
    inside = np.flatnonzero((along > start) & (along < end))
    # A corner each metre or so follows any road.
    every = max(int(inside.size / max(end - start, 1.0)), 1)
    stations = np.unique(np.clip(np.concatenate([[start], along[inside[::every]], [end]]), along[0], along[-1]))
    zero, unit = (
        np.stack([np.interp(stations, along, a) for a in pair.T], axis=-1) for pair in (model.zero_m, model.right)
    )
    outline = np.concatenate([zero + left * unit, (zero + right * unit)[::-1]])
    return Region(outline, FOUND, roughness, (start, end))
