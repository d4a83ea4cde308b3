"""Roughness regions of a section of road, after Kumar and Angelats (2017).

The steps are those of "An automated road roughness detection from mobile laser scanning data" (ISPRS Archives
XLII-1/W1, section 2): road surface, rotation by the mean heading, first level of the point-thinning pyramid, intensity
raster by natural neighbours, 8 bits, closing, three-class Otsu thresholds, connected dim cells, convex hulls, filters
by density and by the deviation of heights, rotation back.

Beyond the paper: heights are judged against the section's road surface, so that a grade has no effect; thresholds are
taken from cells on that surface, so that vehicles do not move them; a region has to be dimmer than the road around it,
and its edge runs where the intensity is halfway between both; a cluster that is no dimmer is the road itself, and its
cells are parted again, so that a small patch is found on a road without another; and a region's roughness is measured
against the surface of the road around it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import scatter_about
from roadscan.condition.roughness_rasters import (
    IntensityRaster,
    RoadPoints,
    RoadSurface,
    closed,
    fit,
    intensity_raster,
    pyramid,
    road_below,
    rotated_back,
    three_classes,
)
from roadscan.condition.settings import RoughnessRegionsConfig
from roadscan.core.extras import cv2


class Severity(NamedTuple):
    """Measures of a region; NaN where the road around was not measured."""

    contrast: float
    """Share by which its median intensity is lower than that of the road around."""
    intensity: float
    """Median intensity of its points."""
    residual_mean_m: float
    """Mean height above the surface of the road around: negative where it has sunk."""
    residual_sigma_m: float
    """Standard deviation of these heights: the roughness (Kumar et al. 2015)."""
    around_sigma_m: float
    """The same for the road around, by the median of its absolute residuals: noise and texture."""


UNKNOWN: Final = Severity(*5 * (float("nan"),))  # Nothing was measured around it.


def severity(own: RoadPoints, around: RoadPoints) -> Severity:
    """Compute measures of a region's points relative to those of the road around it.

    The surface is one of the second degree, by a robust fit (Tukey's biweight) to the road around: Kumar et al. (2015)
    fit a grid of the points themselves, which follows what it is to measure.
    """
    lacking = float("nan")
    if not len(own):
        return UNKNOWN
    intensity = float(np.median(own.intensity))
    beside = float(np.median(around.intensity)) if len(around) else 0.0
    contrast = 1.0 - intensity / beside if beside > 0.0 else lacking
    surface = fit(around.x_m, around.y_m, around.height_m)
    if surface is None:
        return Severity(contrast, intensity, lacking, lacking, lacking)
    above = surface.residuals_m(own.x_m, own.y_m, own.height_m)
    rest = surface.residuals_m(around.x_m, around.y_m, around.height_m)
    readings = float(own.readings.sum())
    mean = float(np.sum(own.readings * above)) / readings
    sigma = float(np.sqrt(np.sum(own.readings * (above - mean) ** 2) / readings))
    return Severity(contrast, intensity, mean, sigma, scatter_about(rest, float(np.median(rest))))


NO_CONTRAST: Final = "no_contrast"
_ROUNDS: Final = 8
"""Most times that cells which turn out to be the road itself are classified again."""
_NONE: Final = np.empty(0, np.uint8)  # Values of no cell.


@dataclass(frozen=True, eq=False)
class Section:
    """Data by which the clusters of a section are judged."""

    raster: IntensityRaster
    points: RoadPoints
    thinned: RoadPoints
    surface: RoadSurface
    settings: RoughnessRegionsConfig


@dataclass(frozen=True, eq=False)
class Region:
    """A dim cluster and its measures; the outline is its convex hull."""

    outline: shapely.Polygon
    """Outline in the frame of the section; on the map once it is rotated back."""
    fate: str
    """reported, small, sparse, off_the_surface or no_contrast."""
    area_m2: float
    """Area of the hull."""
    dim_area_m2: float
    """Area of the dim cells."""
    readings: float
    density_per_m2: float
    height_sigma_m: float
    """Root mean square of the points' heights above the section's road surface."""
    severity: Severity


@dataclass(frozen=True, eq=False)
class SectionRegions:
    """Result for a section."""

    clusters: tuple[Region, ...]
    """All dim clusters of at least the least area, with their outcomes, from dim cells nearest the section's start."""
    small: int
    """Number of dim clusters below the least area."""
    dim_below: float
    """Threshold t₁ as an intensity; NaN without one."""
    bright_above: float
    """Threshold t₂ as an intensity; NaN without one."""
    thresholds: tuple[int, int] | None
    """t₁ and t₂ on the 8-bit scale."""
    measured_m2: float
    """Measured area of the raster."""
    readings: float
    raster: IntensityRaster | None
    """The closed raster."""
    origin_m: tuple[float, float]
    """Easting and northing about which the section was rotated."""
    heading_rad: float

    @property
    def regions(self) -> list[Region]:
        """Return the reported regions."""
        return [one for one in self.clusters if one.fate == "reported"]

    def local_outlines(self) -> list[Float64]:
        """Return corners (k, 2) of their outlines in the frame of the raster (m)."""
        corners = [shapely.get_coordinates(one.outline) for one in self.regions]
        ones = np.ones(1)
        return [
            np.column_stack([t.x_m, t.y_m])
            for t in (
                RoadPoints(c[:, 0], c[:, 1], ones, ones, ones).rotated(self.origin_m, self.heading_rad) for c in corners
            )
        ]


def find_regions(
    points: RoadPoints,
    origin_m: tuple[float, float],
    heading_rad: float,
    settings: RoughnessRegionsConfig,
    road: shapely.Geometry | None = None,
) -> SectionRegions:
    """Find the roughness regions of a section.

    Parameters
    ----------
    points : of the section, on the map (m), intensity on any scale that begins at 0.
    origin_m : easting and northing of a place in the section; raster cells are counted from it.
    heading_rad : mean heading of the vehicle, clockwise from north.
    road : polygons of the road's surface on the map; points outside are left out. None: all points are on the road.
    """
    if road is not None and len(points):
        points = points.take(shapely.contains_xy(road, points.x_m, points.y_m))
    turned = points.rotated(origin_m, heading_rad)
    thinned = pyramid(turned, settings.cell_m, 1)[1]
    raster = intensity_raster(turned, thinned, settings.cell_m, settings.largest_gap_m, settings.clip_share)
    surface = road_below(thinned.x_m, thinned.y_m, thinned.height_m)
    nothing = SectionRegions(
        (), 0, np.nan, np.nan, None, 0.0, float(turned.readings.sum()), None, origin_m, heading_rad
    )
    if raster is None or surface is None:
        return nothing
    raster = replace(raster, values=closed(raster.values, raster.measured, settings.closing_cells))
    measured_m2 = float(raster.measured.sum()) * settings.cell_m**2
    on_road = raster.measured & ~_off_surface(raster, thinned, surface, settings.largest_height_sigma_m)
    thresholds = three_classes(raster.values[on_road])
    if thresholds is None:
        return replace(nothing, raster=raster, measured_m2=measured_m2)
    clusters, small = clusters_of(raster, thresholds[0], settings.least_area_m2)
    section = Section(raster, turned, thinned, surface, settings)
    found: list[Region] = []
    for _ in range(_ROUNDS):
        judged = [_judged(one, section) for one in clusters]
        found += [one for one in judged if one.fate != NO_CONTRAST]
        road_cells = [one for one, of in zip(clusters, judged, strict=True) if of.fate == NO_CONTRAST]
        deeper = three_classes(np.concatenate([raster.values[one.rows, one.columns] for one in road_cells] or [_NONE]))
        if deeper is None:
            break
        clusters, _ = clusters_of(raster, deeper[0], settings.least_area_m2, road_cells)
    return replace(
        nothing,
        clusters=tuple(_back(one, origin_m, heading_rad) for one in found),
        small=small,
        dim_below=raster.intensity(thresholds[0]),
        bright_above=raster.intensity(thresholds[1]),
        thresholds=thresholds,
        measured_m2=measured_m2,
        raster=raster,
    )


def _off_surface(
    raster: IntensityRaster, thinned: RoadPoints, surface: RoadSurface, limit_m: float
) -> npt.NDArray[np.bool_]:
    """Return (rows, columns) cells with a thinned point off the road's surface, and their neighbours."""
    above = np.abs(surface.residuals_m(thinned.x_m, thinned.y_m, thinned.height_m)) > limit_m
    mask = np.zeros(raster.values.shape, np.uint8)
    x, y = thinned.x_m[above], thinned.y_m[above]
    row, column = raster.cells_at(x, y)
    mask[row, column] = 1
    near: npt.NDArray[np.bool_] = cv2.dilate(mask, np.ones((5, 5), np.uint8)).astype(bool)
    return near


def _judged(cluster: Cluster, section: Section) -> Region:
    raster, settings, thinned = section.raster, section.settings, section.thinned
    hull = cluster.hull(raster)
    near = thinned.take(_within(thinned, hull.buffer(settings.around_m)))
    inside = shapely.contains_xy(hull, near.x_m, near.y_m)
    dim, beside = near.intensity[inside], near.intensity[~inside]
    contrast = 1.0 - float(np.median(dim) / np.median(beside)) if dim.size and beside.size else np.nan
    if contrast < settings.least_contrast:
        return Region(hull, NO_CONTRAST, float(hull.area), cluster.area_m2(raster), np.nan, np.nan, np.nan, UNKNOWN)
    if dim.size and beside.size:
        half = 0.5 * float(np.median(dim) + np.median(beside))
        cluster = cluster.at_half(raster, half)
        hull = cluster.hull(raster, half)
    points = section.points.take(_within(section.points, hull.buffer(settings.around_m)))
    inside = shapely.contains_xy(hull, points.x_m, points.y_m)
    own, around = points.take(inside), points.take(~inside)
    above = section.surface.residuals_m(own.x_m, own.y_m, own.height_m)
    readings = float(own.readings.sum())
    sigma = float(np.sqrt(np.sum(own.readings * above * above) / readings)) if readings else np.nan
    density, measured, fate = readings / float(hull.area), UNKNOWN, "reported"
    if hull.area < settings.least_area_m2:
        fate = "small"
    elif density < settings.least_density_per_m2 or not readings:
        fate = "sparse"
    elif sigma > settings.largest_height_sigma_m:
        fate = "off_the_surface"
    else:
        measured = severity(own, around)
        fate = NO_CONTRAST if measured.contrast < settings.least_contrast else fate
    return Region(hull, fate, float(hull.area), cluster.area_m2(raster), readings, density, sigma, measured)


def _within(points: RoadPoints, shape: shapely.Polygon) -> npt.NDArray[np.bool_]:
    """Return (n,) which points lie in a polygon."""
    west, south, east, north = shape.bounds
    box = (points.x_m >= west) & (points.x_m <= east) & (points.y_m >= south) & (points.y_m <= north)
    inside: npt.NDArray[np.bool_] = np.zeros(len(points), bool)
    inside[box] = shapely.contains_xy(shape, points.x_m[box], points.y_m[box])
    return inside


def _back(one: Region, origin_m: tuple[float, float], heading_rad: float) -> Region:
    outline = shapely.transform(one.outline, lambda xy: rotated_back(xy, origin_m, heading_rad))
    return replace(one, outline=shapely.orient_polygons(outline))


_EDGE_CELLS: Final = 3
"""Largest movement of a cluster's edge outward to halfway between its intensity and that of the road."""


@dataclass(frozen=True, eq=False)
class Cluster:
    """Cells that are connected over edges and corners."""

    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]

    def area_m2(self, raster: IntensityRaster) -> float:
        """Return the area of the cells."""
        return float(self.rows.size * raster.cell_m**2)

    def hull(self, raster: IntensityRaster, edge_intensity: float | None = None) -> shapely.Polygon:
        """Return the convex hull of the cells in the frame of the raster (m).

        edge_intensity : its corners lie where the local mean, linear from centre to centre, has this intensity.
        """
        if edge_intensity is None:
            ends = [np.column_stack([self.columns + a, self.rows + b]) for a in (0.0, 1.0) for b in (0.0, 1.0)]
        else:
            ends = list(self._ends(raster, edge_intensity))
        return shapely.convex_hull(shapely.MultiPoint(raster.corner_m + raster.cell_m * np.concatenate(ends)))

    def _ends(self, raster: IntensityRaster, edge: float) -> Iterator[npt.NDArray[np.float64]]:
        """Return places (n, 2), in cells, where the cluster ends on each of four sides."""
        own = np.pad(np.zeros(raster.values.shape, bool), 1)
        own[self.rows + 1, self.columns + 1] = True
        value = np.pad(raster.local_mean, 1, constant_values=np.nan)
        for side in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            beyond = (self.rows + 1 + side[0], self.columns + 1 + side[1])
            last = ~own[beyond]
            outer, inner = value[beyond][last], value[self.rows + 1, self.columns + 1][last]
            crossed = outer > edge  # not where nothing was measured beyond
            way = np.where(crossed, (edge - inner) / np.where(crossed, outer - inner, 1.0), 0.5)
            yield np.column_stack([self.columns[last] + 0.5 + way * side[1], self.rows[last] + 0.5 + way * side[0]])

    def at_half(self, raster: IntensityRaster, intensity: float) -> Cluster:
        """Return the cluster with its edge where the local mean has an intensity, at most three cells farther out.

        It stays as it is if none is left.
        """
        top, left = max(int(self.rows.min()) - _EDGE_CELLS, 0), max(int(self.columns.min()) - _EDGE_CELLS, 0)
        bottom, right = int(self.rows.max()) + _EDGE_CELLS + 1, int(self.columns.max()) + _EDGE_CELLS + 1
        values = raster.local_mean[top:bottom, left:right]
        mask = np.zeros(values.shape, np.uint8)
        mask[self.rows - top, self.columns - left] = 1
        edge = 2 * _EDGE_CELLS + 1
        wide = cv2.dilate(mask, np.ones((edge, edge), np.uint8)).astype(bool)
        rows, columns = np.nonzero(wide & (values <= intensity))
        return Cluster(rows + top, columns + left) if rows.size else self


def clusters_of(
    raster: IntensityRaster, dim_below: int, least_area_m2: float, among: Sequence[Cluster] | None = None
) -> tuple[list[Cluster], int]:
    """Return the clusters of dim cells that reach an area, by their first row, and how many smaller ones there are.

    among : clusters; only their cells are used.
    """
    dim = raster.measured & (raster.values <= dim_below)
    if among is not None:
        asked = np.zeros(dim.shape, bool)
        for one in among:
            asked[one.rows, one.columns] = True
        dim &= asked
    count, label, stats, _ = cv2.connectedComponentsWithStats(dim.astype(np.uint8), connectivity=8)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] * raster.cell_m**2 >= least_area_m2)
    found = []
    for k in large[large > 0].tolist():
        left, top, width, height = (int(v) for v in stats[k, :4])
        rows, columns = np.nonzero(label[top : top + height, left : left + width] == k)
        found.append(Cluster(rows + top, columns + left))
    return found, count - 1 - len(found)
