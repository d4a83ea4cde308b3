"""Coarse model against SciPy's spline and median, a known surface, and itself over other stretches."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.ndimage import generic_filter

from roadscan.surface.kernels.coarse import median_filter, natural_spline
from roadscan.surface.regions import (
    FILLED,
    FOUND,
    INTERPOLATED,
    MEASURED,
    NOTHING,
    CoarseSettings,
    RegionSettings,
    Stretch,
    coarse_model,
    find_regions,
)

EAST, NORTH = 2_683_200.0, 1_247_900.0


def test_spline_is_scipy_s_natural_one() -> None:
    draw = np.random.default_rng(1)
    for count in (2, 3, 4, 60):
        x, z = np.cumsum(draw.uniform(0.01, 0.3, count)), draw.normal(size=count)
        bend, work = np.empty(count), np.empty(count)
        natural_spline(x, z, 0, count, bend, work)
        expected = CubicSpline(x, z, bc_type="natural")(x, 2) if count > 2 else np.zeros(2)
        assert np.allclose(bend, expected, rtol=1e-9, atol=1e-7)


def test_median_is_scipy_s() -> None:
    draw = np.random.default_rng(2)
    for gaps in (0.0, 0.2):
        surface = draw.normal(size=(9, 40))
        surface[draw.random(surface.shape) < gaps] = np.nan
        found = np.empty_like(surface)
        median_filter(surface, found)
        with np.errstate(all="ignore"):
            expected = generic_filter(np.nan_to_num(surface, nan=np.inf), _nan_median, 3, mode="constant", cval=np.inf)
        expected[np.isnan(surface)] = np.nan
        assert np.array_equal(found, expected, equal_nan=True)


def _nan_median(values: np.ndarray) -> float:
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else np.nan


def surface_m(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Height of a smooth road: crossfall and a long wave."""
    return 455.0 + 0.02 * along - 0.025 * across + 0.01 * np.sin(2.0 * np.pi * across / 3.0)


def street(profiles: int = 60, seed: int = 3, noise_m: float = 0.0) -> tuple[np.ndarray, ...]:
    """Easting, northing, height, classes (n, m) and path (n, 2) of a drive to the north-east, read right to left."""
    draw = np.random.default_rng(seed)
    angle = np.radians(60.0 - np.arange(241) / 2.0)
    across = 2.0 * np.tan(angle) + np.zeros((profiles, 1))
    along = 0.1 * np.arange(profiles)[:, None] + np.zeros_like(across)
    course = np.radians(40.0)
    easting = EAST + along * np.sin(course) + across * np.cos(course)
    northing = NORTH + along * np.cos(course) - across * np.sin(course)
    height = surface_m(along, across) + noise_m * draw.standard_normal(across.shape)
    path = np.stack([EAST + along[:, 0] * np.sin(course), NORTH + along[:, 0] * np.cos(course)], axis=-1)
    return easting, northing, height, np.zeros(across.shape, np.uint8), path


def test_heights_and_origins_of_a_known_road() -> None:
    easting, northing, height, classes, path = street()
    classes[:, 100:104] = 1  # a hole of about 9 cm
    classes[:, 180:215] = 9  # one of a metre and more
    height[classes > 0] += 1.0
    stretch = Stretch.of_points(easting, northing, height, classes, path)
    model = coarse_model(stretch, CoarseSettings())
    assert np.allclose(stretch.along_m, 0.1 * np.arange(60))
    assert np.allclose(stretch.right, [np.cos(np.radians(40.0)), -np.sin(np.radians(40.0))], atol=1e-9)
    there = model.origin != NOTHING
    assert np.array_equal(there, np.isfinite(model.height_m))
    truth = surface_m(model.along_m[:, None], model.across_m)
    for origin, most in ((MEASURED, 1e-4), (INTERPOLATED, 1e-4), (FILLED, 1e-3)):
        assert (model.origin == origin).any()
        assert np.abs(model.spline_m - truth)[model.origin == origin].max() < most
    hole = np.sort(2.0 * np.tan(np.radians(60.0 - np.array([99, 104]) / 2.0)))
    filled = model.across_m[(model.origin == FILLED).any(axis=0)]
    assert filled.min() > hole[0] and filled.max() < hole[1]
    assert filled.size == pytest.approx((hole[1] - hole[0]) / 0.01, abs=2)
    wide = np.sort(2.0 * np.tan(np.radians(60.0 - np.array([179, 215]) / 2.0)))
    inside = (model.across_m > wide[0] + 0.01) & (model.across_m < wide[1] - 0.01)
    assert not there[:, inside].any()
    assert there[:, (model.across_m > 0.3) & (model.across_m < 3.4)].all()


def test_places_are_those_of_the_readings() -> None:
    easting, northing, height, classes, path = street(profiles=5)
    model = coarse_model(Stretch.of_points(easting, northing, height, classes, path), CoarseSettings())
    east, north = model.places_m()
    nearest = np.abs(easting[2][:, None] + 1j * northing[2][:, None] - (east[2] + 1j * north[2])).min(axis=1)
    assert nearest.max() < 0.006


def test_nodes_do_not_depend_on_the_stretch() -> None:
    """Profiles of a part, all but its first and last, have the heights that they have within the whole."""
    easting, northing, height, classes, path = street(noise_m=0.006)
    classes[np.random.default_rng(4).random(classes.shape) < 0.05] = 10
    stretch = Stretch.of_points(easting, northing, height, classes, path)
    whole = coarse_model(stretch, CoarseSettings())
    rows = slice(20, 41)
    part = Stretch(*(getattr(stretch, one.name)[rows] for one in fields(Stretch)))
    other = coarse_model(part, CoarseSettings())
    shift = other.first_node - whole.first_node
    columns = slice(shift, shift + other.height_m.shape[1])
    for name in ("height_m", "origin"):
        own, again = getattr(whole, name)[rows, columns], getattr(other, name)
        np.testing.assert_array_equal(own[1:-1], again[1:-1])
    error = (whole.height_m - surface_m(whole.along_m[:, None], whole.across_m))[whole.origin > 0]
    assert (whole.origin > 0).mean() > 0.9
    assert np.sqrt(np.mean(error**2)) < 0.004  # noise of 6 mm


def test_regions_are_found_where_the_road_is_broken_and_nowhere_else() -> None:
    easting, northing, height, classes, path = street(profiles=120, noise_m=0.003)
    stretch = Stretch.of_points(easting, northing, height, classes, path)
    assert find_regions(coarse_model(stretch, CoarseSettings()), RegionSettings()) == []
    where = np.hypot(stretch.along_m[:, None] - 6.0, stretch.across_m - 1.0)
    height -= 0.05 * np.clip(1.0 - (where / 0.3) ** 4, 0.0, None) ** 2
    stretch = Stretch.of_points(easting, northing, height, classes, path)
    found = find_regions(coarse_model(stretch, CoarseSettings()), RegionSettings())
    assert [one.origin for one in found] == [FOUND]
    course = np.radians(40.0)
    middle = [EAST + 6.0 * np.sin(course) + np.cos(course), NORTH + 6.0 * np.cos(course) - np.sin(course)]
    assert found[0].holds(np.array([middle[0]]), np.array([middle[1]])).all()
    assert 0.4 < found[0].polygon.area < 4.0
    assert found[0].roughness_m > 0.01


def test_noise_that_is_largest_below_the_scanner_is_no_region(monkeypatch: pytest.MonkeyPatch) -> None:
    easting, northing, height, classes, path = street(profiles=500)
    angle = np.radians(60.0 - np.arange(241) / 2.0)
    # Of ranges, so that heights far aside have less of it; the road there is read less often.
    height += 0.008 * np.cos(angle) ** 2 * np.random.default_rng(2).standard_normal(height.shape)
    model = coarse_model(Stretch.of_points(easting, northing, height, classes, path), CoarseSettings())
    assert find_regions(model, RegionSettings(factor=2.0)) == []
    monkeypatch.setattr("roadscan.surface.regions._BESIDE", 1000)  # the street as a whole
    assert find_regions(model, RegionSettings(factor=2.0)) != []


@pytest.mark.parametrize("profiles", [1, 200])
def test_a_vehicle_that_stands_finds_no_region(profiles: int) -> None:
    across = np.linspace(-4.0, 4.0, 361)
    east = np.broadcast_to(across, (profiles, across.size))
    path = np.zeros((profiles, 2))
    kerb = 0.3 * np.clip(east - 2.0, 0.0, 1.0)
    stretch = Stretch.of_points(east, np.zeros(east.shape), kerb, np.zeros(east.shape, np.uint8), path)
    assert find_regions(coarse_model(stretch, CoarseSettings()), RegionSettings()) == []


def test_a_stretch_without_road_is_empty() -> None:
    easting, northing, height, classes, path = street(profiles=4)
    classes[:] = 9
    model = coarse_model(Stretch.of_points(easting, northing, height, classes, path), CoarseSettings())
    assert model.height_m.shape == (4, 0)
    assert find_regions(model, RegionSettings()) == []
