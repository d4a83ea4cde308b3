"""Road edges of a kerbed road: of both carriageways beside a median, and across squares that count from two corners."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import shapely
from scipy.spatial import cKDTree

from roadscan.assets.edges.once import FoundEdge, each_once
from roadscan.assets.kinds.road_edge import RoadEdge, RoadEdgeOptions
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from tests.assets.edges.streets import returns_of
from tests.assets.edges.test_cuts_of_edges import HALO_M, around, parts_of

Float64 = npt.NDArray[np.float64]
KIND, KERB_M = RoadEdge(), 0.12


def scene_of(
    box: Box, aside_m: Sequence[tuple[float, float]], drives: list[Float64], turn_rad: float = 0.0,
    island_m: tuple[float, float] = (0.0, 0.0), rope_m: float = 0.0,
) -> Scene:  # fmt: skip
    """Ground in a box with raised strips between two distances left of a line through its middle, seen with 6 mm noise.

    turn_rad : of that line from the x axis. drives : places (k, 2) of each pass. island_m : ends of an island 2 m wide
    on the line. rope_m : along so much of each 3 m of the line returns stand above it, from 0.4 to 0.8 m.
    """
    draw = np.random.default_rng(1)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(*box[::2], 0.07), np.arange(*box[1::2], 0.07)))
    x, y = (v + draw.uniform(-0.03, 0.03, v.size) for v in (x, y))
    middle = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    aside = (y - middle[1]) * np.cos(turn_rad) - (x - middle[0]) * np.sin(turn_rad)
    raised = np.any([(aside > low) & (aside < high) for low, high in aside_m], axis=0)
    raised |= (np.abs(aside) < 1.0) & (x > island_m[0]) & (x < island_m[1])
    points = np.column_stack([x, y, 100.0 + KERB_M * raised + draw.normal(0.0, 0.006, x.size)])[
        draw.random(x.size) < 0.6
    ]
    if rope_m:
        at = np.arange(box[0], box[2], 0.05)
        at = at[(at - box[0]) % 3.0 < rope_m]
        stands = [
            np.column_stack([at, np.full(at.size, middle[1]), np.full(at.size, h)]) for h in (100.4, 100.6, 100.8)
        ]
        points = np.concatenate([points, *stands])
    drive = np.concatenate([np.column_stack([d, np.full(len(d), 102.0), np.full(len(d), i + 1.0)])
                            for i, d in enumerate(drives)])  # fmt: skip
    near = cKDTree(drive[:, :2]).query(points[:, :2])[1]
    sensor = np.column_stack([drive[near, :2], np.full(len(points), 102.0)])
    returns = returns_of(points, np.full(len(points), 1e3), np.arange(len(points)), sensor, drive[near, 3])
    window = around(box, 2.0)
    return make_scene(returns, window, window, drive)


def lines_of(scenes: list[Scene]) -> list[shapely.LineString]:
    """Road edges, joined from the pieces of all scenes."""
    options = RoadEdgeOptions()
    pieces = pa.concat_tables([KIND.evidence(one, options).pieces for one in scenes])
    return [shapely.force_2d(one.geometry) for one in KIND.objects(KIND.joined(pieces), options, {})]


def straight(*corners: tuple[float, float]) -> Float64:
    """Places (k, 2) each 0.3 m along a line through corners."""
    return shapely.get_coordinates(shapely.segmentize(shapely.LineString(corners), 0.3))


@pytest.mark.parametrize("is_one_pass", [True, False])
@pytest.mark.parametrize(("median_m", "carriageway_m"), [(1.0, 3.5), (2.0, 5.0), (4.0, 3.5)])
def test_both_carriageways_of_a_divided_road_have_their_edges(
    median_m: float, carriageway_m: float, is_one_pass: bool
) -> None:
    inner, outer, middle = median_m / 2, median_m / 2 + carriageway_m, median_m / 2 + carriageway_m / 2
    there, back = ((1.0, -middle), (56.0, -middle)), ((56.0, middle), (1.0, middle))
    turn = [(56.0 + middle * np.cos(a), middle * np.sin(a)) for a in np.linspace(-1.4, 1.4, 15)]
    drives = [straight(*there, *turn, *back)] if is_one_pass else [straight(*there), straight(*back)]
    box = Box(0.0, -outer - 3.0, 60.0, outer + 3.0)
    strips = [(-inner, inner), (outer, outer + 9.0), (-outer - 9.0, -outer)]
    found = shapely.union_all(lines_of([scene_of(box, strips, drives)]))
    for offset in (-outer, -inner, inner, outer):
        places = np.column_stack([np.arange(3.0, 52.0, 0.5), np.full(98, offset)])
        assert np.mean(shapely.distance(shapely.points(places), found) <= 0.25) >= 0.97, offset


@pytest.mark.parametrize("turn_rad", [-0.28, -0.1, 0.03, 0.2])
def test_an_edge_goes_on_where_the_border_of_squares_is_a_line_of_the_lattice(turn_rad: float) -> None:
    """Stations lie on the border, and squares beside it count from corners 960 m apart."""
    along = np.arange(-18.0, 18.0, 0.33)[:, None]
    drive = np.array([960.03, 1000.0]) + along * [np.cos(turn_rad), np.sin(turn_rad)]
    whole = scene_of(Box(940.0, 984.0, 980.0, 1016.0), [(4.0, 30.0), (-30.0, -4.0)], [drive], turn_rad)
    parts = []
    for first in (880.0, 960.0):
        corner = np.array([960.0 * (first // 960.0), 960.0])
        tile = Box(first, 960.0, first + 80.0, 1040.0)
        window = around(tile, HALO_M)
        some = whole.returns.at(window.holds(whole.returns.x_m, whole.returns.y_m))
        returns = replace(
            some, corner_m=(float(corner[0]), 960.0), x_m=some.x_m - corner[0], y_m=some.y_m - corner[1],
            sensor_x_m=some.sensor_x_m - corner[0], sensor_y_m=some.sensor_y_m - corner[1],
        )  # fmt: skip
        shift = [*corner, *corner]
        boxes = (Box(*(a - b for a, b in zip(one, shift, strict=True))) for one in (tile, window))
        parts.append(make_scene(returns, *boxes, whole.drive_xyh_m - [*corner, 0.0, 0.0]))
    lengths = [sorted(one.length for one in lines_of(some)) for some in ([whole], parts)]
    assert len(lengths[0]) == 2 and np.allclose(*lengths, atol=0.01)


def times_seen(lines: list[shapely.LineString], offset_m: float) -> npt.NDArray[np.int64]:
    """How many lines lie within 0.25 m of places each half metre along a street, at an offset."""
    places = shapely.points(np.column_stack([np.arange(3.0, 52.0, 0.5), np.full(98, offset_m)]))
    return np.sum([shapely.distance(places, one) <= 0.25 for one in lines], axis=0)


@pytest.mark.parametrize("is_one_pass", [True, False])
def test_each_kerb_of_a_wide_street_driven_in_its_outer_lanes_is_one_edge(is_one_pass: bool) -> None:
    """There and back, 10.5 m apart with nothing between: both see both kerbs. Where it turns there is bare asphalt."""
    there, back = ((1.0, -5.25), (56.0, -5.25)), ((56.0, 5.25), (1.0, 5.25))
    turn = [(56.0 + 5.25 * np.cos(a), 5.25 * np.sin(a)) for a in np.linspace(-1.4, 1.4, 15)]
    drives = [straight(*there, *turn, *back)] if is_one_pass else [straight(*there), straight(*back)]
    found = lines_of([scene_of(Box(0.0, -10.0, 64.0, 10.0), [(7.0, 20.0), (-20.0, -7.0)], drives)])
    for offset in (-7.0, 7.0):
        assert np.mean(times_seen(found, offset) == 1) >= 0.97, offset
    assert np.abs(np.abs(shapely.get_coordinates(found)[:, 1]) - 7.0).max() <= 0.25


def halves(scene: Scene) -> list[Scene]:
    """A scene in squares of 23 m."""
    return list(parts_of(scene, 23.0, (4.0, 7.0)))


@pytest.mark.parametrize("rope_m", [3.0, 1.2])
def test_a_thin_barrier_between_two_drives_is_the_inner_edge_of_both(rope_m: float) -> None:
    """A rail, or a rope that is seen near its posts; kerbs beyond it are edges of the other drive alone."""
    there, back = straight((1.0, -2.5), (56.0, -2.5)), straight((56.0, 2.5), (1.0, 2.5))
    scene = scene_of(Box(0.0, -9.0, 60.0, 9.0), [(5.5, 20.0), (-20.0, -5.5)], [there, back], rope_m=rope_m)
    for found in (lines_of([scene]), lines_of(halves(scene))):
        for offset, times in ((-5.5, 1), (0.0, 2), (5.5, 1)):
            assert np.mean(times_seen(found, offset) == times) >= 0.93, offset


def test_beside_a_refuge_island_each_drive_has_an_edge_on_both_sides() -> None:
    there, back = straight((1.0, -2.5), (56.0, -2.5)), straight((56.0, 2.5), (1.0, 2.5))
    scene = scene_of(Box(0.0, -9.0, 60.0, 9.0), [(5.0, 20.0), (-20.0, -5.0)], [there, back], island_m=(24.0, 32.0))
    beside = slice(round((24.5 - 3.0) / 0.5), round((31.5 - 3.0) / 0.5))
    for found in (lines_of([scene]), lines_of(halves(scene))):
        for offset in (-1.0, 1.0):
            assert np.mean(times_seen(found, offset)[beside] == 1) >= 0.9, offset
        for offset in (-5.0, 5.0):
            assert np.mean(times_seen(found, offset) == 1) >= 0.93, offset


def along_x(first_m: float, last_m: float, northing_m: float, offset_m: float, is_left: bool = True) -> FoundEdge:
    """An edge along the x axis with a node each half metre, left or right of a drive so far from it."""
    x = np.arange(first_m, last_m + 0.1, 0.5)
    nodes = np.column_stack([x, np.full(x.size, northing_m), np.full(x.size, 100.0)])
    out = np.tile([0.0, 1.0 if is_left else -1.0], (x.size, 1))
    return FoundEdge(nodes, np.arange(x.size), np.ones(x.size, np.int64), out, np.full(x.size, offset_m))


def test_of_edges_on_one_another_that_of_the_nearest_drive_is_left() -> None:
    """Three of one kerb, one of them beside half of it; the other side of a thin barrier; a bridge above; a crossing.

    Their order changes nothing.
    """
    far, near, middle = along_x(0.0, 60.0, 0.0, 9.0), along_x(20.0, 40.0, 0.1, 2.0), along_x(0.0, 60.0, -0.1, 5.0)
    behind, above = along_x(0.0, 60.0, 0.1, 4.0, is_left=False), along_x(0.0, 60.0, 0.0, 9.5)
    above.nodes[:, 2] += 6.0
    across = along_x(-20.0, 20.0, 0.0, 9.9)
    across.nodes[:, :2] = across.nodes[:, 1::-1] + [30.0, 0.0]
    edges = [far, near, middle, behind, above, across]
    for order in itertools.permutations(range(6)):
        found = each_once([edges[k] for k in order])
        kept = sorted((float(e.offset_m[0]), *e.nodes[[0, -1], 0].tolist()) for e in found)
        assert kept == [(2.0, 20.0, 40.0), (4.0, 0.0, 60.0), (5.0, 0.0, 20.0), (5.0, 40.0, 60.0), (9.5, 0.0, 60.0),
                        (9.9, 30.0, 30.0)]  # fmt: skip
