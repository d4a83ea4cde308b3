"""Sidewalks, medians, road edges and shoulders against the surface that they were made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.kinds.kerb import Kerb, KerbOptions
from roadscan.assets.kinds.median import Median, MedianOptions
from roadscan.assets.kinds.road_edge import RoadEdge, RoadEdgeOptions
from roadscan.assets.kinds.shoulder import Shoulder, ShoulderOptions
from roadscan.assets.kinds.sidewalk import Sidewalk, SidewalkOptions
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.compute.edges import counted, evidence_across, path_along
from roadscan.simulate import Scene as SimulatedScene
from roadscan.simulate.surface import Surface
from tests.assets.edges.simulated import SimulatedStreet, town_street
from tests.assets.edges.streets import returns_of
from tests.assets.edges.test_kerbs import truth_line

Float64 = npt.NDArray[np.float64]

FACADE_M = 9.2


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    return town_street(30.0, 4)


@pytest.fixture(scope="module")
def town(street: SimulatedStreet) -> Scene:
    x, y = truth_line(street, 1.0, 0.0, np.array([0.0, 29.0])).T
    box = Box(x.min() - 9.0, y.min() - 9.0, x.max() + 9.0, y.max() + 9.0)
    inside = box.holds(street.street.returns.x_m, street.street.returns.y_m)
    return make_scene(street.street.returns.at(inside), box, box, street.street.drive)


def ribbon(street: SimulatedStreet, side: float, near_m: float, far_m: float) -> shapely.Polygon:
    station = np.arange(2.0, 28.0, 0.5)
    ring = [truth_line(street, side, near_m, station), truth_line(street, side, far_m, station[::-1])]
    return shapely.Polygon(np.concatenate(ring))


@pytest.mark.nightly
def test_sidewalks_reach_from_the_kerb_to_the_facade(street: SimulatedStreet, town: Scene) -> None:
    kind = Sidewalk()
    found = list(kind.objects(kind.evidence(town, SidewalkOptions()).pieces, SidewalkOptions(), {}))
    whole = shapely.union_all([shapely.force_2d(s.geometry) for s in found])
    truth = shapely.union_all([ribbon(street, side, 5.27, FACADE_M) for side in (-1.0, 1.0)])
    stretch = shapely.union_all([ribbon(street, side, 3.0, 14.0) for side in (-1.0, 1.0)])
    assert whole.intersection(truth).area / truth.area >= 0.90
    assert whole.intersection(truth).area / whole.intersection(stretch).area >= 0.90
    largest = max(found, key=lambda s: s.geometry.area)
    assert largest.attributes["width_m"] == pytest.approx(FACADE_M - 5.27, abs=0.45)
    # The verge falls 2 % away from the road in this scene's sign: it rises outward.
    assert largest.attributes["cross_slope"] == pytest.approx(0.02, abs=0.005)
    assert largest.attributes["kerb_height_m"] == pytest.approx(0.12, abs=0.008)


@pytest.mark.nightly
def test_road_edges_lie_at_the_kerbs_on_their_sides(street: SimulatedStreet, town: Scene) -> None:
    kind = RoadEdge()
    found = list(kind.objects(kind.joined(kind.evidence(town, RoadEdgeOptions()).pieces), RoadEdgeOptions(), {}))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        lines = [np.array(o.geometry.coords) for o in found if o.attributes["side"] == side]
        places = np.concatenate(lines)
        _, offset = street.surface.station_offset_m(
            places[:, 0] + street.corner_m[0], places[:, 1] + street.corner_m[1]
        )
        assert np.median(offset) == pytest.approx(sign * 5.26, abs=0.05)
        assert np.mean(np.abs(offset - sign * 5.26) <= 0.1) >= 0.95
        assert sum(o.attributes["length_m"] for o in found if o.attributes["side"] == side) > 25.0
        assert {o.attributes["type"] for o in found} == {"kerb"}


def seen_surface(size_m: tuple[float, float, float], height_m: Callable[[Float64, Float64], Float64]) -> Scene:
    """A surface of a length and half a width, seen from a drive at an offset: a return each 5 cm, 5 mm of noise."""
    length, half, drive_y = size_m
    rng = np.random.default_rng(5)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, length, 0.05), np.arange(-half, half, 0.05)))
    x, y = x + rng.uniform(-0.02, 0.02, x.size), y + rng.uniform(-0.02, 0.02, y.size)
    z = height_m(x, y) + rng.normal(0.0, 0.005, x.size)
    sensor = np.column_stack([x, np.full(x.size, drive_y), np.full(x.size, 102.0)])
    returns = returns_of(np.column_stack([x, y, z]), np.full(x.size, 1000.0), np.arange(x.size), sensor)
    places = np.arange(0.0, length)
    drive = np.column_stack([places, *(np.full(places.size, v) for v in (drive_y, 102.0, 1.0))])
    box = Box(0.0, -half, length, half)
    return make_scene(returns, box, box, drive)


def island(width_m: float, height_m: float) -> Scene:
    """A road of 16 m with a raised strip in its middle."""
    return seen_surface(
        (30.0, 8.0, -4.0),
        lambda x, y: 100.0 + 0.01 * x - 0.02 * np.abs(y) + np.where(np.abs(y) < width_m / 2, height_m, 0.0),
    )


@pytest.mark.slow
def test_a_median_has_width_and_height() -> None:
    scene, kind = island(2.4, 0.15), Median()
    found = list(kind.objects(kind.evidence(scene, MedianOptions()).pieces, MedianOptions(), {}))
    assert len(found) == 1
    assert found[0].attributes["width_m"] == pytest.approx(2.4, abs=0.15)
    assert found[0].attributes["asset_height_m"] == pytest.approx(0.15, abs=0.008)
    assert found[0].geometry.area == pytest.approx(2.4 * 30.0, rel=0.1)
    walks = Sidewalk()
    assert not list(walks.objects(walks.evidence(scene, SidewalkOptions()).pieces, SidewalkOptions(), {}))


@pytest.mark.slow
def test_the_length_of_an_island_is_not_that_of_its_kerb() -> None:
    """A refuge of 8 m by 2 m with round ends, whose kerb of 18 m is one closed line."""
    scene = seen_surface(
        (30.0, 8.0, -4.0),
        lambda x, y: (
            100.0 - 0.02 * np.abs(y) + np.where(np.hypot(np.maximum(np.abs(x - 15.0) - 3.0, 0.0), y) < 1.0, 0.12, 0.0)
        ),
    )
    kind = Median()
    (found,) = kind.objects(kind.evidence(scene, MedianOptions()).pieces, MedianOptions(), {})
    assert found.attributes["length_m"] == pytest.approx(8.0, abs=0.3)
    assert found.attributes["width_m"] == pytest.approx(2.0, abs=0.15)


@pytest.mark.slow
def test_the_ends_of_an_island_are_no_sidewalk() -> None:
    """An island of 20 m by 4 m: from its ends no surface is followed to the other."""
    scene = seen_surface(
        (30.0, 8.0, -4.0),
        lambda x, y: 100.0 - 0.02 * np.abs(y) + np.where((np.abs(x - 15.0) < 10.0) & (np.abs(y) < 2.0), 0.12, 0.0),
    )
    kind = Sidewalk()
    assert not list(kind.objects(kind.evidence(scene, SidewalkOptions()).pieces, SidewalkOptions(), {}))


def walkway(ramp: bool) -> Scene:
    """A road that rises by 3 % with a kerb of 12 cm to its left, 2.5 m of a walkway that rises by 2 % away from the
    road, and a wall behind it; with a ramp, the kerb is 2 cm high for 4 m.
    """
    rng = np.random.default_rng(6)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 24.0, 0.05), np.arange(-5.0, 5.5, 0.05)))
    x, y = x + rng.uniform(-0.02, 0.02, x.size), y + rng.uniform(-0.02, 0.02, y.size)
    step = np.where(ramp & (np.abs(x - 12.0) < 2.0), 0.02, 0.12)
    z = 100.0 + 0.03 * x + np.where(y > 3.0, step + 0.02 * (y - 3.0), -0.02 * np.abs(y) + 0.06)
    wall_x, wall_z = (a.ravel() for a in np.meshgrid(np.arange(0.0, 24.0, 0.05), np.arange(0.0, 3.0, 0.05)))
    wall_z += 100.17 + 0.03 * wall_x
    x, y, z = np.append(x, wall_x), np.append(y, np.full(wall_x.size, 5.55)), np.append(z, wall_z)
    z += rng.normal(0.0, 0.004, z.size)
    sensor = np.column_stack([x, np.zeros(x.size), np.full(x.size, 102.4)])
    returns = returns_of(np.column_stack([x, y, z]), np.full(x.size, 1000.0), np.arange(x.size), sensor)
    drive = np.column_stack([np.arange(0.0, 24.0), np.zeros(24), np.full(24, 102.4), np.ones(24)])
    box = Box(0.0, -5.0, 24.0, 6.0)
    return make_scene(returns, box, box, drive)


@pytest.mark.slow
@pytest.mark.parametrize("ramp", [False, True])
def test_a_sidewalk_has_slopes_a_kerb_and_a_ramp_where_its_kerb_is_dropped(ramp: bool) -> None:
    kind = Sidewalk()
    pieces = kind.evidence(walkway(ramp), SidewalkOptions()).pieces
    one = max(kind.objects(pieces, SidewalkOptions(), {}), key=lambda o: o.geometry.area)
    assert one.attributes["width_m"] == pytest.approx(2.5, abs=0.2)
    assert one.attributes["kerb_height_m"] == pytest.approx(0.12, abs=0.01)
    assert one.attributes["cross_slope"] == pytest.approx(0.02, abs=0.006)
    assert one.attributes["ramp"] is ramp
    if not ramp:
        assert abs(one.attributes["running_slope"]) == pytest.approx(0.03, abs=0.006)


@pytest.mark.slow
def test_a_road_may_have_edges_on_one_side_alone() -> None:
    kind = RoadEdge()
    pieces = kind.joined(kind.evidence(island(2.4, 0.15), RoadEdgeOptions()).pieces)
    for right in (False, True):
        own = pieces.filter(pa.array([(row[0] > 0.5) == right for row in pieces["right"].to_pylist()], pa.bool_()))
        assert {o.attributes["side"] for o in kind.objects(own, RoadEdgeOptions(), {})} <= {
            "right" if right else "left"
        }
    assert len(pieces)
    kerbs = [o for o in kind.objects(pieces, RoadEdgeOptions(), {}) if o.attributes["type"] == "kerb"]
    assert sum(o.attributes["length_m"] for o in kerbs) > 27.0
    assert {o.attributes["side"] for o in kerbs} == {"left"}
    # The edge is that of the carriageway: it lies at the foot of the kerb of 15 cm.
    places = np.concatenate([np.array(o.geometry.coords)[:-1] for o in kerbs])
    foot = 100.0 + 0.01 * places[:, 0] - 0.02 * np.abs(places[:, 1])
    assert np.abs(places[:, 2] - foot).max() < 0.015


def street_with_walks() -> Scene:
    """A road of 8 m with kerbs of 12 cm on both sides, which climbs by 3 % and falls by 3 % to both sides.

    The left kerb (y > 0) is lowered to 2 cm between x = 8 and 12; a metre behind it the sidewalk has its height again.
    """

    def height_m(x: Float64, y: Float64) -> Float64:
        behind = np.maximum(np.abs(y) - 4.0, 0.0)
        z = 100.0 + 0.03 * x - 0.03 * np.minimum(np.abs(y), 4.0) + np.where(behind > 0.0, 0.12 + 0.02 * behind, 0.0)
        lowered = (behind > 0.0) & (y > 0.0) & (x > 8.0) & (x < 12.0)
        return z - np.where(lowered, 0.1 * np.maximum(1.0 - behind, 0.0), 0.0)

    return seen_surface((20.0, 7.5, -1.5), height_m)


def test_sides_slopes_and_heights_beside_a_road_that_climbs() -> None:
    scene, walk, edge, kerb = street_with_walks(), Sidewalk(), RoadEdge(), Kerb()
    walks = list(walk.objects(walk.evidence(scene, SidewalkOptions()).pieces, SidewalkOptions(), {}))
    assert len(walks) == 2
    for one in walks:
        # It falls to the road, and climbs: the same on both sides of it.
        assert one.attributes["cross_slope"] == pytest.approx(0.02, abs=0.002)
        has_ramp = one.geometry.centroid.y > 0.0
        assert one.attributes["running_slope"] == pytest.approx(0.03, abs=0.008 if has_ramp else 0.003)
        assert one.attributes["ramp"] == has_ramp
    kerbs = list(kerb.objects(kerb.evidence(scene, KerbOptions()).pieces, KerbOptions(), {}))
    assert sorted((o.attributes["type"], round(o.geometry.centroid.y)) for o in kerbs) == [
        ("dropped", 4), ("upright", -4), ("upright", 4), ("upright", 4),
    ]  # fmt: skip
    for one in kerbs:
        x, y, z = shapely.get_coordinates(one.geometry, include_z=True).T
        # The higher side, beyond |y| = 4, lies to the right; the line is at the height of the upper edge.
        assert (x[-1] > x[0]) == (y[0] < 0.0)
        step = 0.02 if one.attributes["type"] == "dropped" else 0.12
        assert one.attributes["step_m"] == pytest.approx(step, abs=0.008)
        assert np.median(z - (99.88 + 0.03 * x)) == pytest.approx(step, abs=0.01)
    edges = list(edge.objects(edge.joined(edge.evidence(scene, RoadEdgeOptions()).pieces), RoadEdgeOptions(), {}))
    assert {o.attributes["side"] for o in edges} == {"left", "right"}
    for one in edges:
        x, y, z = shapely.get_coordinates(one.geometry, include_z=True).T
        assert (np.median(y) > 0.0) == (one.attributes["side"] == "left")
        # The height is the road's at the foot of the kerb, not one on its face.
        assert np.abs(z - (100.0 + 0.03 * x - 0.03 * np.minimum(np.abs(y), 4.0))).max() < 0.02


def test_the_edge_of_a_road_without_kerbs_is_where_its_verge_begins() -> None:
    """The simulated highway with a verge that falls by 15 % beyond a shoulder of 5 %, 8 mm of noise a cell."""
    plain = SimulatedScene.load("highway_three_lanes")
    scene = plain.changed(road={"verge_slope": 0.15})
    surface, paved = Surface(scene), scene.road.paved_m
    station, offset = np.arange(10.0, 60.0, 0.5), np.arange(1.0, paved + 4.0, 0.1)
    e, n, _ = surface.place(station[:, None], np.broadcast_to(offset, (station.size, offset.size)))
    height = surface.height_m(e, n, texture=False)
    height += np.random.default_rng(2).normal(0.0, 0.008, height.shape)
    step, bend = evidence_across(height, np.full(height.shape, 0.008), (0.5, 0.1))
    found = path_along(counted(np.fmax(np.abs(step), np.abs(bend))), (0.5, 0.1))
    assert np.median(np.abs(offset[found.cell] - paved)) <= 0.15
    assert np.mean(np.abs(offset[found.cell] - paved) <= 0.3) >= 0.9
    assert found.evidence.min() > 0.5


def test_a_shoulder_lies_between_line_and_edge() -> None:
    def line(y: float, z: float, **attributes: Any) -> AssetObject:
        geometry = shapely.LineString([(x, y, z) for x in np.arange(0.0, 41.0, 2.0)])
        return AssetObject(geometry, 0.03, 0.01, 0.9, 100, 1, 0, 1, attributes)

    others = {
        "road_edge": [line(-6.0, 9.9, side="right", type="verge")],
        "lane_line": [line(-4.0, 10.0), line(0.0, 10.1)],
    }
    kind = Shoulder()
    found = list(kind.objects(kind.piece_schema.empty_table(), ShoulderOptions(), others))
    assert len(found) == 1
    assert found[0].attributes["width_m"] == pytest.approx(2.0, abs=0.01)
    assert found[0].attributes["length_m"] == pytest.approx(40.0, abs=1.0)
    assert found[0].attributes["cross_slope"] == pytest.approx(0.05, abs=0.002)
    assert found[0].geometry.area == pytest.approx(80.0, rel=0.02)
