"""Roughness regions, on sections whose patches, vehicles and markings are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.ndimage
import shapely

from roadscan.condition.roughness_rasters import (
    RoadPoints,
    closed,
    fit,
    normalised_intensity,
    pyramid,
    road_below,
    rotated_back,
    three_classes,
)
from roadscan.condition.roughness_regions import SectionRegions, find_regions
from roadscan.condition.settings import RoughnessRegionsConfig
from roadscan.core.errors import ProfileError
from tests.condition.road_section import ALL, ORIGIN, PATCH, SLANTED, SQUARE, TRENCH, Section

SETTINGS = RoughnessRegionsConfig()
CARS = [(0.5, -3.0, 15.0), (5.2, 13.0, 15.0), (5.0, -4.5, 240.0)]
"""Dark ones on both sides, and a bright one."""


def found(section: Section, settings: RoughnessRegionsConfig = SETTINGS) -> SectionRegions:
    return find_regions(RoadPoints.of(*section.points()[:4]), ORIGIN, section.heading_rad, settings)


def overlaps(section: Section, at: SectionRegions) -> list[tuple[float, float]]:
    """Of each patch: share of it inside its region, and what both share of what either covers."""
    held = []
    for patch in (section.patch_on_map(p) for p in section.patches):
        own = max(at.regions, key=lambda r: r.outline.intersection(patch).area)
        shared = own.outline.intersection(patch).area
        held.append((shared / patch.area, shared / own.outline.union(patch).area))
    return held


@pytest.mark.parametrize("cars", [[], CARS])
def test_every_patch_is_found_and_no_car(cars: list[tuple[float, float, float]]) -> None:
    section = Section(patches=ALL, cars=cars)
    at = found(section)
    assert len(at.regions) == len(ALL)
    shares = overlaps(section, at)
    dense = [share for patch, share in zip(ALL, shares, strict=True) if patch.bounds[1] > 0]
    assert len(dense) == 4
    assert min(inside for inside, _ in dense) >= 0.9
    assert min(both for _, both in dense) >= 0.85
    assert min(inside for inside, _ in shares) >= 0.8
    for region in at.regions:
        assert region.severity.residual_mean_m == pytest.approx(-0.008, abs=0.0015)
        assert region.severity.residual_sigma_m == pytest.approx(np.hypot(0.004, 0.002), abs=0.001)
        assert region.severity.around_sigma_m == pytest.approx(0.002, abs=0.0005)
    fates = [one.fate for one in at.clusters if one.fate != "reported"]
    assert fates.count("off_the_surface") == (2 if cars else 0)


@pytest.mark.slow
@pytest.mark.parametrize("markings", [True, False])
def test_nothing_on_a_sound_road(markings: bool) -> None:
    assert found(Section(markings=markings)).regions == []
    assert found(Section(markings=markings, cars=[(0.5, -3.0, 15.0), (5.2, 12.0, 60.0)])).regions == []


def test_a_small_patch_alone() -> None:
    """Otsu's classes part the road itself there; its cells are parted again."""
    section = Section(patches=[SQUARE], markings=False)
    at = found(section)
    assert len(at.regions) == 1
    assert overlaps(section, at)[0][0] >= 0.9


def test_intensity_that_falls_with_range_is_normalised() -> None:
    section = Section(patches=ALL, sensor_y_m=2.0)
    *points, xy = section.points()
    zero = np.zeros(len(xy))
    beams = np.column_stack([xy[:, 0], zero + 2.0, zero + 2.2]) - np.column_stack([xy, zero])
    reach = np.linalg.norm(beams, axis=1)
    angle = np.arccos(beams[:, 2] / reach)
    level = normalised_intensity(points[3], reach, angle, 5.0)
    at = find_regions(RoadPoints.of(*points[:3], level), ORIGIN, section.heading_rad, SETTINGS)
    assert len(at.regions) == len(ALL)
    assert min(inside for inside, _ in overlaps(section, at)[:4]) >= 0.9


def test_only_on_the_road() -> None:
    section = Section(patches=ALL)
    road = section.patch_on_map(shapely.box(0, 0, 10, 8))
    at = find_regions(RoadPoints.of(*section.points()[:4]), ORIGIN, section.heading_rad, SETTINGS, road)
    assert len(at.regions) == 2
    assert at.measured_m2 == pytest.approx(80.0, rel=0.03)


def test_order_of_points_changes_no_bit() -> None:
    section = Section(patches=[PATCH, SLANTED], thin=40.0, dense=200.0)
    columns = np.array(section.points()[:4])
    mixed = columns[:, np.random.default_rng(0).permutation(columns.shape[1])]
    one, other = (find_regions(RoadPoints.of(*c), ORIGIN, section.heading_rad, SETTINGS) for c in (columns, mixed))
    assert [shapely.to_wkb(r.outline) for r in one.clusters] == [shapely.to_wkb(r.outline) for r in other.clusters]
    assert [r.severity for r in one.regions] == [r.severity for r in other.regions]


@pytest.mark.slow
def test_density_and_height_leave_regions_out() -> None:
    section = Section(patches=[TRENCH, PATCH])
    fates = {one.fate for one in found(section, RoughnessRegionsConfig(least_density_per_m2=2000.0)).clusters}
    assert "sparse" in fates
    assert "reported" not in fates
    assert found(section, RoughnessRegionsConfig(largest_height_sigma_m=0.005)).regions == []
    assert found(section, RoughnessRegionsConfig(least_contrast=0.6)).regions == []
    assert len(found(section, RoughnessRegionsConfig(least_area_m2=2.0)).regions) == 1


def test_too_little_to_say_anything() -> None:
    empty = find_regions(RoadPoints.of([], [], [], []), ORIGIN, 0.0, SETTINGS)
    assert (empty.regions, empty.raster, empty.readings) == ([], None, 0.0)
    flat = Section(dense=60.0, thin=60.0)
    e, n, h, _, _ = flat.points()
    assert found_flat(e, n, h).thresholds is None
    with pytest.raises(ProfileError, match="not finite"):
        RoadPoints.of(e, n, h, h * np.nan)
    with pytest.raises(ProfileError, match="arrays of one size"):
        RoadPoints.of(e, n, h[:-1], h)


def found_flat(e: np.ndarray, n: np.ndarray, h: np.ndarray) -> SectionRegions:
    return find_regions(RoadPoints.of(e, n, h, np.full(e.size, 7.0)), ORIGIN, 0.0, SETTINGS)


def test_three_classes_by_trying_all() -> None:
    """The variance between classes, as Otsu (1979) writes it, for every pair of thresholds."""
    rng = np.random.default_rng(4)
    values = np.concatenate([rng.normal(m, 3, n) for m, n in ((12, 300), (25, 900), (40, 150))]).clip(0, 49)
    values = values.astype(np.uint8)

    def between(first: int, second: int) -> float:
        parts = [values[values <= first], values[(values > first) & (values <= second)], values[values > second]]
        if min(p.size for p in parts) == 0:
            return -1.0
        return sum(p.size * (float(p.mean()) - float(values.mean())) ** 2 for p in parts)

    best = max(itertools.combinations(range(50), 2), key=lambda pair: between(*pair))
    assert three_classes(values) == best
    assert three_classes(np.array([3, 3, 9], np.uint8)) is None


def test_closing_is_that_of_scipy() -> None:
    grey = np.random.default_rng(2).integers(0, 256, (40, 60)).astype(np.uint8)
    inner = (slice(3, -3), slice(3, -3))
    whole = np.ones(grey.shape, bool)
    assert np.array_equal(closed(grey, whole, 3)[inner], scipy.ndimage.grey_closing(grey, (3, 3))[inner])
    whole[10:20, 10:20] = False
    assert not closed(grey, whole, 3)[10:20, 10:20].any()


def test_pyramid_keeps_what_is_nearest_to_the_mean() -> None:
    rng = np.random.default_rng(1)
    points = RoadPoints.of(
        *rng.uniform(0, 2, (2, 500)), np.zeros(500), rng.integers(0, 200, 500), rng.integers(1, 4, 500)
    )
    levels = pyramid(points, 0.1, 2)
    for before, after, window in ((levels[0], levels[1], 0.2), (levels[1], levels[2], 0.4)):
        cells = {}
        for k in range(len(before)):
            cells.setdefault((int(before.x_m[k] // window), int(before.y_m[k] // window)), []).append(k)
        assert len(after) == len(cells)
        assert after.readings.sum() == points.readings.sum()
        for k in range(len(after)):
            own = cells[int(after.x_m[k] // window), int(after.y_m[k] // window)]
            mean = np.average(before.intensity[own], weights=before.readings[own])
            assert abs(after.intensity[k] - mean) == pytest.approx(np.abs(before.intensity[own] - mean).min())


def test_rotation_and_back() -> None:
    points = RoadPoints.of([ORIGIN[0] + 3.0], [ORIGIN[1] + 4.0], [0.0], [1.0])
    ahead = points.rotated(ORIGIN, np.arctan2(3.0, 4.0))
    assert (ahead.x_m[0], ahead.y_m[0]) == pytest.approx((5.0, 0.0))
    right = points.rotated(ORIGIN, 0.0)
    assert (right.x_m[0], right.y_m[0]) == pytest.approx((4.0, -3.0))
    back = rotated_back(np.array([[4.0, -3.0]]), ORIGIN, 0.0)
    assert back[0] == pytest.approx((ORIGIN[0] + 3.0, ORIGIN[1] + 4.0))


def test_normalised_to_the_reference() -> None:
    """Twice as far a quarter comes back; at 60 degrees a half."""
    level = normalised_intensity(
        np.array([100.0, 25.0, 50.0]), np.array([5.0, 10.0, 5.0]), np.radians([0, 0, 60.0]), 5.0
    )
    assert level == pytest.approx([100.0, 100.0, 100.0])


def test_robust_surfaces() -> None:
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0, 8, (2, 4000))
    true = 2.0 + 0.03 * x - 0.02 * y + 0.001 * x * y
    height = true + rng.normal(0, 0.002, x.size)
    parked = (x > 4) & (x < 7) & (y > 5) & (y < 7)
    sunk = (x > 1) & (x < 2)
    for surface in (
        fit(x, y, np.where(sunk, height - 0.02, height)),
        road_below(x, y, np.where(parked, height + 1.4, height)),
    ):
        assert surface is not None
        assert np.abs(surface.residuals_m(x, y, true)).max() < 0.005
    assert fit(x, x, height) is None
    assert fit(x[:5], y[:5], height[:5]) is None
