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

Coarse reconstruction: the profiles of a stretch of road are resampled to an even grid, profile by profile.

Along each profile a cubic spline runs through its road readings and is read off at even steps across the road; holes
up to a stated width are filled; a 3 × 3 median removes impulses (Yu and others 2007, 3.2.3). "Gridding and
interpolation is on individual profiles and not on the entire surface": rows of the grid are the profiles themselves,
at whatever distance the vehicle drove between them.

- **Knots** are the readings; where several lie nearest to one node of the grid, their mean, so that a profiler's dense
  readings are averaged rather than sampled. Between knots runs the natural cubic spline.
- **Holes** are gaps in which readings are missing (no return, not road). Splines end at them, because a
  cubic across a hole swings with the noise at its rims. Holes up to `fill_m` are filled by the straight line
  between the mean heights of the last three knots on each side. A gap between neighbouring readings is no hole,
  but the scanner's spacing; wider than `reach_m` it is left empty.
- **Origins**: `measured`, a knot lies nearest to this node; `interpolated`; `filled`; or nothing.
- The **median** is that of the nodes there are. It keeps origins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from pydantic import Field

from roadscan.compute.array_types import Bool, Float64, UInt8
from roadscan.compute.arrays import way_along
from roadscan.core.strict import Strict
from roadscan.surface.kernels import coarse as kernels
from roadscan.surface.kernels.coarse import PATCH_SUMS, sum_patches
from roadscan.surface.settings import RegionSettings

NOTHING: Final = kernels.NOTHING
MEASURED: Final = kernels.MEASURED
INTERPOLATED: Final = kernels.INTERPOLATED
FILLED: Final = kernels.FILLED
"""Origins of a node."""


class CoarseSettings(Strict):
    """Settings of the coarse model."""

    spacing_m: float = Field(default=0.01, gt=0.0005, le=1.0)
    """Step across the road (m); the paper's is 1 cm."""
    reach_m: float = Field(default=0.5, gt=0.0)
    """Widest gap between neighbouring readings that the spline crosses (m)."""
    fill_m: float = Field(default=0.3, ge=0.0)
    """Widest hole that is filled (m)."""
    every: int = Field(default=1, ge=1, le=16)
    """From one measured reading of a profile to the next: 2 for a mirror that measures every second one a turn."""


@dataclass(frozen=True)
class Stretch:
    """Profiles of one stretch of road, in the order driven."""

    along_m: Float64
    """(n,) position along the stretch, ascending."""
    across_m: Float64
    """(n, m) offset of each reading, right positive."""
    height_m: Float64
    """(n, m) in the map frame."""
    classes: UInt8
    """(n, m), 0 the road (``points.classes``); other readings are ignored."""
    zero_m: Float64
    """(n, 2) easting and northing of each profile's offset 0."""
    right: Float64
    """(n, 2) unit vector of the map along each profile, to the right."""

    @classmethod
    def of_points(
        cls, easting_m: Float64, northing_m: Float64, height_m: Float64, classes: UInt8, path_m: Float64
    ) -> Stretch:
        """Returns profiles from positions on the map.

        Each profile is a straight line on the map: the least-squares line of its road readings; offset 0 is the foot
        of the sensor on it, so that neighbouring profiles of a straight drive share their offsets.

        Parameters
        ----------
        easting_m, northing_m, height_m, classes : (n, m), of the readings; places count where the class is 0 only.
        path_m : (n, 2) easting and northing of the sensor. Which end of the profiles is the right one is decided once
        for all, by the path as a whole: a vehicle that stands has no direction.
        """
        along: Float64 = way_along(path_m)
        drive = np.gradient(path_m, axis=0) if len(path_m) > 1 else np.zeros_like(path_m)
        road = classes == 0
        count = np.maximum(road.sum(axis=1, keepdims=True), 1)
        middle = np.concatenate(
            [np.where(road, c, 0.0).sum(axis=1, keepdims=True) / count for c in (easting_m, northing_m)], axis=1
        )
        e = np.where(road, easting_m - middle[:, :1], 0.0)
        n = np.where(road, northing_m - middle[:, 1:], 0.0)
        angle = 0.5 * np.arctan2(2.0 * (e * n).sum(axis=1), (e * e).sum(axis=1) - (n * n).sum(axis=1))
        right = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        number = np.arange(classes.shape[1]) - (classes.shape[1] - 1) / 2.0
        right *= np.where((e @ number) * right[:, 0] + (n @ number) * right[:, 1] < 0.0, -1.0, 1.0)[:, None]
        if (right[:, 0] * drive[:, 1] - right[:, 1] * drive[:, 0]).sum() < 0.0:
            right *= -1.0
        foot = ((path_m - middle) * right).sum(axis=1, keepdims=True)
        zero = middle + foot * right
        across = e * right[:, :1] + n * right[:, 1:] - foot
        return cls(along, across, np.ascontiguousarray(height_m, np.float64), classes, zero, right)


@dataclass(frozen=True)
class CoarseModel:
    """The coarse surface of one stretch."""

    settings: CoarseSettings
    along_m: Float64
    """(n,) of the profiles."""
    zero_m: Float64
    """(n, 2) easting and northing of offset 0."""
    right: Float64
    """(n, 2) unit vector to the right."""
    first_node: int
    """Number of the first node: node k lies at the offset (first_node + k) · spacing_m."""
    spline_m: Float64
    """(n, K) heights as interpolated, NaN where there is none."""
    height_m: Float64
    """(n, K) heights after the median filter."""
    origin: UInt8
    """(n, K), one of the origins above."""

    @property
    def across_m(self) -> Float64:
        """Returns offsets (K,) of the nodes (m)."""
        return np.asarray((self.first_node + np.arange(self.height_m.shape[1])) * self.settings.spacing_m)

    def places_m(self) -> tuple[Float64, Float64]:
        """Returns easting and northing of the nodes, (n, K) each."""
        across = self.across_m
        return (
            self.zero_m[:, :1] + across * self.right[:, :1],
            self.zero_m[:, 1:] + across * self.right[:, 1:],
        )


def coarse_model(stretch: Stretch, settings: CoarseSettings) -> CoarseModel:
    """Returns the coarse surface of a stretch; a node depends only on its profile and the two beside it."""
    road = stretch.classes == 0
    across = stretch.across_m[road]
    first, end = 0, 0
    if across.size:
        first = int(np.floor(across.min() / settings.spacing_m + 0.5))
        end = int(np.floor(across.max() / settings.spacing_m + 0.5)) + 1
    surface = np.empty((stretch.along_m.size, end - first))
    origin = np.empty(surface.shape, np.uint8)
    kernels.spline_profiles(
        np.ascontiguousarray(stretch.across_m), np.ascontiguousarray(stretch.height_m),
        np.ascontiguousarray(stretch.classes), settings.every, first, settings.spacing_m, settings.reach_m,
        settings.fill_m, surface, origin,
    )  # fmt: skip
    height = np.empty_like(surface)
    kernels.median_filter(surface, height)
    return CoarseModel(settings, stretch.along_m, stretch.zero_m, stretch.right, first, surface, height, origin)


FOUND: Final = "found"

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
