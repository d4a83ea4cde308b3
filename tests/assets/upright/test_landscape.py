"""Landscape areas: beds of plants beside a road, against their outlines; what is narrow or smooth is none."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.kinds.landscape_area import LandscapeArea, roughness_of_road_m
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene, Statistics
from tests.assets.edges.streets import returns_of

BED = shapely.box(6.0, 5.0, 14.0, 8.0)
KIND = LandscapeArea()


@functools.cache
def street(every_m: float = 0.05, shade_m: float = 0.0, apart_m: float = 0.0, share: float = 0.5) -> Scene:
    """A road of 16 m width seen with 5 mm of noise; on its side a bed 0.1–0.3 m high, and a rail above it.

    every_m : from ring to ring, which lie along the road; a ring has a return each 5 cm. shade_m : so far behind the
    bed no return reaches the ground; one in ten is a mixture of the bed's top and of the ground behind. apart_m : a
    second pass, of which a share of the returns is, sees all beyond 4 m along the road so much higher.
    """
    rng = np.random.default_rng(3)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 20.0, 0.05), np.arange(-10.0, 10.0, every_m)))
    x, y = x + rng.uniform(-0.02, 0.02, x.size), y + rng.uniform(-0.02, 0.02, y.size)
    behind = y - BED.bounds[3]
    shaded = (x > BED.bounds[0]) & (x < BED.bounds[2]) & (behind > 0.0) & (behind < shade_m)
    seen = ~shaded | (rng.random(x.size) < 0.1)
    x, y, behind, shaded = x[seen], y[seen], behind[seen], shaded[seen]
    z = 100.0 - 0.02 * np.abs(y) + rng.normal(0.0, 0.005, x.size)
    z += np.where(shapely.contains_xy(BED, x, y), rng.uniform(0.0, 0.3, x.size), 0.0)
    z += np.where(shaded, rng.uniform(0.0, 0.2, x.size) * (1.0 - behind / max(shade_m, 0.1)), 0.0)
    rail = np.column_stack([np.arange(0.0, 20.0, 0.01), np.full(2000, -6.0), 99.9 + rng.uniform(0.0, 0.7, 2000)])
    points = np.concatenate([np.column_stack([x, y, z]), rail])
    second = (points[:, 0] > 4.0) & (rng.random(len(points)) < share) & (apart_m != 0.0)
    points[second, 2] += apart_m
    sensor = np.column_stack([points[:, 0], np.full(len(points), -2.0), np.full(len(points), 102.0)])
    returns = returns_of(points, np.full(len(points), 1000.0), np.arange(len(points)), sensor, 1.0 + second)
    drive = np.column_stack([np.arange(0.0, 20.0), np.full(20, -2.0), np.full(20, 102.0), np.ones(20)])
    box = Box(0.0, -10.0, 20.0, 10.0)
    return make_scene(returns, box, box, drive)


def areas(pieces: pa.Table) -> list[AssetObject]:
    return list(KIND.objects(pieces, KIND.options(), {}))


def test_a_bed_is_found_and_neither_the_road_nor_a_rail() -> None:
    (one,) = areas(KIND.evidence(street(), KIND.options()).pieces)
    both = shapely.force_2d(one.geometry).intersection(BED).area
    assert both / BED.area >= 0.90
    assert both / one.geometry.area >= 0.90
    assert one.attributes["area_m2"] == pytest.approx(24.0, rel=0.1)
    assert one.probability > 0.9 and one.passes == 1


def test_an_area_does_not_depend_on_where_tiles_are_cut() -> None:
    scene = street()
    (whole,) = areas(KIND.evidence(scene, KIND.options()).pieces)
    parts = []
    for low, high in ((0.0, 10.0), (10.0, 20.0)):
        tile = replace(scene, tile=Box(low, -10.0, high, 10.0), window=Box(low - 4.0, -14.0, high + 4.0, 14.0))
        parts.append(KIND.evidence(tile, KIND.options()).pieces)
    (joined,) = areas(pa.concat_tables(parts))
    assert shapely.force_2d(joined.geometry).symmetric_difference(shapely.force_2d(whole.geometry)).area < 0.3


@pytest.mark.parametrize("every_m", [0.2, 0.6, 0.8])
def test_a_bed_is_found_between_the_rings_of_a_sparse_scanner(every_m: float) -> None:
    (one,) = areas(KIND.evidence(street(every_m), KIND.options()).pieces)
    both = shapely.force_2d(one.geometry).intersection(BED).area
    # Each long side lies somewhere between two rings.
    assert both / BED.area >= 0.97 - every_m / (BED.bounds[3] - BED.bounds[1])
    assert both / one.geometry.area >= 0.90
    assert one.geometry.is_valid


def test_mixed_returns_behind_a_bed_are_none_of_it() -> None:
    (one,) = areas(KIND.evidence(street(0.05, 1.0), KIND.options()).pieces)
    both = shapely.force_2d(one.geometry).intersection(BED).area
    assert both / BED.area >= 0.90
    assert both / one.geometry.area >= 0.95


def twice(every_m: float, apart_m: float, share: float = 0.5) -> tuple[float, float]:
    """Shares of the bed that are found, and of what is found that are right, where two passes see it.

    Most of the survey was driven once, and tells how rough its road is. share : of the returns that are of the second.
    """
    rough = roughness_of_road_m(street(every_m))
    assert rough is not None
    scene = street(every_m, apart_m=apart_m, share=share)
    known = replace(scene, statistics=Statistics({"road_roughness_m": rough}))
    (one,) = areas(KIND.evidence(known, KIND.options()).pieces)
    both = shapely.force_2d(one.geometry).intersection(BED).area
    return both / BED.area, both / one.geometry.area


@pytest.mark.parametrize("apart_m", [0.03, 0.06, 0.075])
@pytest.mark.parametrize(("every_m", "found", "right"), [(0.05, 0.95, 0.99), (0.2, 0.95, 0.95), (0.6, 0.55, 0.9)])
def test_ground_that_two_passes_see_at_different_heights_is_not_grown_over(
    every_m: float, found: float, right: float, apart_m: float
) -> None:
    shares = twice(every_m, apart_m)
    assert shares[0] >= found and shares[1] >= right


@pytest.mark.parametrize("share", [0.01, 0.05, 0.15])
@pytest.mark.parametrize("apart_m", [-0.06, 0.06])
def test_a_pass_that_sees_little_takes_no_bed_away(share: float, apart_m: float) -> None:
    assert min(twice(0.05, apart_m, share)) >= 0.95


def test_bare_ground_beside_plants_that_two_passes_see_differently_is_not_grown_over() -> None:
    scene = street()
    second = np.random.default_rng(8).random(len(scene.returns)) < 0.5
    x, y = scene.returns.x_m, scene.returns.y_m
    # One pass sees the tops of the plants, the other what is below them.
    above = np.where(shapely.contains_xy(BED, x, y), np.where(second, 0.3, 1.0) * scene.above_ground_m, 0.0)
    above = np.where(above != 0.0, above, scene.above_ground_m).astype(np.float32)
    returns = replace(scene.returns, pass_id=(1 + second).astype(np.uint16))
    (one,) = areas(KIND.evidence(replace(scene, returns=returns, above_ground_m=above), KIND.options()).pieces)
    assert shapely.force_2d(one.geometry).intersection(BED).area / one.geometry.area >= 0.95
