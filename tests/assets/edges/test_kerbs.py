"""Kerbs against hand labels, a city's map, and a simulated street whose every height is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import shapely
from scipy.spatial import cKDTree

from benchmarks.street_scores import points_along, share_within
from roadscan.assets import classes
from roadscan.assets.edges import find
from roadscan.assets.edges.find import Edge, edges_of_raster, kerb_parts
from roadscan.assets.edges.profiles import Chain, Nodes, even_nodes
from roadscan.assets.edges.rings import share_within_rings
from roadscan.assets.edges.steps import Places, of_cells
from roadscan.assets.kind import AssetObject
from roadscan.assets.kinds.kerb import Kerb, KerbOptions
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from tests.assets.edges.simulated import SimulatedStreet, town_street
from tests.assets.edges.streets import amsterdam_street, returns_of
from tests.assets.scenes import recordings_folder

FACE_OFFSET_M = 5.26
"""Middle of the kerb's face in `urban_street`: 5.25 m of lanes and shoulder, and a face of 2 cm."""


def kerbs_of(scene: Scene) -> list[AssetObject]:
    kind = Kerb()
    return list(kind.objects(kind.evidence(scene, KerbOptions()).pieces, KerbOptions(), {}))


def lines_of(kerbs: list[AssetObject]) -> list[shapely.Geometry]:
    return [k.geometry for k in kerbs]


def test_kerbs_of_a_city_map() -> None:
    """Amsterdam, tile 2293_9698: the carriageway's edge, but for that which it shares with a parking bay (no step)."""
    street, polygons = amsterdam_street(recordings_folder() / "amsterdam_kerb")
    tile = Box(0.0, 0.0, 50.0, 50.0)
    found = points_along(lines_of(kerbs_of(make_scene(street.returns, tile, tile, street.drive))))
    box = shapely.box(*tile)
    ways = [p.buffer(0.0) for p in polygons["rijbaan_lokale_weg"]]
    bays = shapely.union_all([p.buffer(0.0) for p in polygons["parkeervlak"]])
    edge = shapely.union_all([w.boundary for w in ways]).intersection(box).difference(bays.buffer(0.1))
    places = np.concatenate(
        [shapely.get_coordinates(shapely.segmentize(line, 0.1)) for line in shapely.get_parts(edge)]
    )
    seen = cKDTree(np.column_stack([street.returns.x_m, street.returns.y_m]))
    covered = np.array([len(seen.query_ball_point(p, 0.3)) >= 20 for p in places])
    assert covered.sum() > 90
    assert share_within(places[covered], found, 0.3) >= 0.95
    known = shapely.union_all([p.boundary for group in polygons.values() for p in group])
    assert np.mean(shapely.distance(shapely.points(found), known) > 0.3) <= 0.10


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    return town_street(30.0, 4)


@pytest.fixture(scope="module")
def town(street: SimulatedStreet) -> Scene:
    x, y = truth_line(street, 1.0, 0.0, np.array([0.0, 29.0])).T
    box = Box(x.min() - 9.0, y.min() - 9.0, x.max() + 9.0, y.max() + 9.0)
    inside = box.holds(street.street.returns.x_m, street.street.returns.y_m)
    return make_scene(street.street.returns.at(inside), box, box, street.street.drive)


def truth_line(street: SimulatedStreet, side: float, offset_m: float, station_m: Any) -> np.ndarray[Any, Any]:
    e, n, _ = street.surface.place(station_m, np.full(len(station_m), side * offset_m))
    return np.column_stack([e, n]) - street.corner_m[:2]


@pytest.mark.slow
def test_kerbs_of_a_simulated_street(street: SimulatedStreet, town: Scene) -> None:
    """HDL-32E, both directions, parked cars on the right: 5 cm and 8 mm."""
    kerbs = kerbs_of(town)
    found = points_along(lines_of(kerbs), 0.02)
    station = np.arange(1.0, 29.0, 0.1)
    for side in (-1.0, 1.0):
        assert share_within(truth_line(street, side, FACE_OFFSET_M, station), found, 0.05) >= 0.97
    at, offset = street.surface.station_offset_m(found[:, 0] + street.corner_m[0], found[:, 1] + street.corner_m[1])
    stretch = (at > 0.0) & (at < 30.0)
    assert np.mean(np.abs(np.abs(offset[stretch]) - FACE_OFFSET_M) <= 0.05) >= 0.98
    heights = {k.attributes["type"]: [] for k in kerbs}
    for kerb in kerbs:
        heights[kerb.attributes["type"]].append(kerb.attributes["step_m"])
    assert np.median(heights["upright"]) == pytest.approx(0.12, abs=0.008)
    # The ramp on the left at station 30.
    assert heights["dropped"][0] == pytest.approx(0.02, abs=0.012)


@pytest.mark.slow
def test_lines_are_cut_at_tiles_and_joined_to_the_same(town: Scene) -> None:
    """Four tiles with halos of 8 m: their joined kerbs are those of the whole."""
    whole, kind = kerbs_of(town), Kerb()
    window = town.window
    x, y = (window.x_min_m + window.x_max_m) / 2, (window.y_min_m + window.y_max_m) / 2
    pieces = []
    for y0, y1 in ((window.y_min_m, y), (y, window.y_max_m)):
        for x0, x1 in ((window.x_min_m, x), (x, window.x_max_m)):
            halo = Box(x0 - 8.0, y0 - 8.0, x1 + 8.0, y1 + 8.0)
            rows = halo.holds(town.returns.x_m, town.returns.y_m)
            part = Scene(
                town.returns.at(rows), Box(x0, y0, x1, y1), halo, town.ground, town.above_ground_m[rows],
                town.classes[rows], town.drive_xyh_m,
            )  # fmt: skip
            pieces.append(kind.evidence(part, KerbOptions()).pieces)
            for row in pieces[-1].to_pylist():
                inside = shapely.box(x0, y0, x1, y1).buffer(1e-6)
                places = np.column_stack([row["easting_m"], row["northing_m"]])
                assert shapely.contains_xy(inside, *places.T).all()
    joined = list(kind.objects(pa.concat_tables(pieces), KerbOptions(), {}))
    a, b = points_along(lines_of(whole), 0.05), points_along(lines_of(joined), 0.05)
    assert share_within(a, b, 0.04) >= 0.98
    assert share_within(b, a, 0.04) >= 0.98
    assert len(joined) <= len(whole) + 1


def test_nodes_of_a_line_are_the_same_wherever_a_square_lets_it_begin() -> None:
    at = np.linspace(0.0, 40.0, 400)
    line = np.column_stack([at - 7.3, 3.0 * np.sin(at / 7.0) + 1.0])
    whole, part = even_nodes(line, 0.5), even_nodes(line[37:-51], 0.5)
    away, _ = cKDTree(whole).query(part)
    inside = (part[:, 0] > 0.5) & (part[:, 0] < 24.0)  # from the first crossing of the lattice of 6 m to the last
    assert inside.sum() > 40 and away[inside].max() < 1e-4
    np.testing.assert_allclose(np.hypot(*np.diff(whole, axis=0).T), 0.5, atol=0.05)


@pytest.mark.slow
def test_returns_on_the_face_are_marked(town: Scene) -> None:
    marked = Kerb().evidence(town, KerbOptions()).marked
    assert [m.code for m in marked] == [classes.KERB]
    assert len(marked[0].rows) > 1000
    assert np.abs(town.above_ground_m[marked[0].rows]).max() < 0.45


@pytest.mark.slow
def test_cells_alone_are_enough(street: SimulatedStreet) -> None:
    """Only a mean height a cell of 0.1 m, with 5 mm of noise."""
    x, y = truth_line(street, 1.0, 0.0, np.array([2.0, 26.0])).T
    x0, y0 = x.min() - 7.0, y.min() - 7.0
    rows, columns = int((y.max() + 7.0 - y0) / 0.1), int((x.max() + 7.0 - x0) / 0.1)
    at_x, at_y = np.meshgrid(x0 + 0.1 * (np.arange(columns) + 0.5), y0 + 0.1 * (np.arange(rows) + 0.5))
    height = street.surface.height_m(at_x + street.corner_m[0], at_y + street.corner_m[1], texture=False)
    height += np.random.default_rng(1).normal(0.0, 0.005, height.shape)
    count = np.where(np.isfinite(height), 5, 0).astype(np.int32)
    raster = of_cells(x0, y0, 0.1, count, np.nan_to_num(height), np.full(height.shape, 0.01))
    lines = [shapely.LineString(np.column_stack([e.nodes.x_m, e.nodes.y_m])) for e in edges_of_raster(raster)]
    found = points_along(lines, 0.02)
    for side in (-1.0, 1.0):
        assert share_within(truth_line(street, side, FACE_OFFSET_M, np.arange(4.0, 24.0, 0.1)), found, 0.05) >= 0.97
    _, offset = street.surface.station_offset_m(found[:, 0] + street.corner_m[0], found[:, 1] + street.corner_m[1])
    assert np.mean(np.abs(np.abs(offset) - FACE_OFFSET_M) <= 0.05) >= 0.98


@pytest.mark.parametrize("away_m", [0.5, 0.8])
def test_a_path_that_leaves_a_hidden_kerb_does_not_bend_it(monkeypatch: pytest.MonkeyPatch, away_m: float) -> None:
    """A kerb of 12 cm at y = 0 behind two cars, 2 m of it seen between them; chance places on flat ground behind."""
    x, y = np.meshgrid(np.arange(0.05, 26.0, 0.1), np.arange(-3.95, 4.0, 0.1))
    seen = (x < 8.0) | ((x > 11.5) & (x < 13.5)) | (x > 18.0) | (y > 0.25)
    height = np.where(y > 0.0, 0.12, 0.0) + np.random.default_rng(3).normal(0.0, 0.003, x.shape)
    count = np.where(seen, 5, 0).astype(np.int32)
    raster = of_cells(0.0, -4.0, 0.1, count, np.where(seen, height, 0.0), np.full(x.shape, 0.003))
    parts = [
        np.arange(0.2, 8.0, 0.25),
        [9.2, 10.4],
        np.arange(11.6, 13.5, 0.25),
        [14.8, 16.4],
        np.arange(18.1, 25.8, 0.25),
    ]
    at = np.concatenate(parts)
    off = np.repeat([0.0, away_m, 0.0, away_m, 0.0], [len(part) for part in parts])
    flat = np.zeros(at.size)
    places = Places(at, off, flat - 1.0, flat, flat + 8.0, flat + 0.12).at(np.arange(at.size)[::-1])
    monkeypatch.setattr(find, "paths_of", lambda _: [Chain(places, np.full(at.size - 1, 1.0))])
    edges = edges_of_raster(raster)
    middle, length = np.abs(np.concatenate([edge.nodes.y_m for edge in edges])), sum(len(edge.seen) for edge in edges)
    assert length >= 2 * 25
    assert middle.max() <= 0.03


def test_the_foot_of_a_fence_is_no_kerb() -> None:
    rng = np.random.default_rng(8)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 20.0, 0.05), np.arange(-8.0, 8.0, 0.05)))
    x, y = x + rng.uniform(-0.02, 0.02, x.size), y + rng.uniform(-0.02, 0.02, y.size)
    z = 100.0 + np.where(np.abs(y) > 5.0, 0.08, 0.0) + rng.normal(0.0, 0.005, x.size)
    fence = np.column_stack([rng.uniform(0.0, 20.0, 9000), np.full(9000, -5.0), 100.0 + rng.uniform(0.0, 1.4, 9000)])
    points = np.concatenate([np.column_stack([x, y, z]), fence])
    sensor = np.column_stack([points[:, 0], np.zeros(len(points)), np.full(len(points), 102.0)])
    returns = returns_of(points, np.full(len(points), 1000.0), np.arange(len(points)), sensor)
    drive = np.column_stack([np.arange(0.0, 20.0), np.zeros(20), np.full(20, 102.0), np.ones(20)])
    box = Box(0.0, -8.0, 20.0, 8.0)
    found = kerbs_of(make_scene(returns, box, box, drive))
    assert found and all(one.geometry.centroid.y > 4.5 for one in found)


def test_the_border_of_a_bed_of_plants_is_no_kerb() -> None:
    """Plants of 5 to 25 cm behind y = 5 m, ground seen between them; a kerb of 8 cm on the other side."""
    rng = np.random.default_rng(9)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 20.0, 0.05), np.arange(-8.0, 8.0, 0.05)))
    x, y = x + rng.uniform(-0.02, 0.02, x.size), y + rng.uniform(-0.02, 0.02, y.size)
    grown = np.where((y > 5.0) & (rng.random(x.size) < 0.8), rng.uniform(0.05, 0.25, x.size), 0.0)
    z = 100.0 + np.where(y < -5.0, 0.08, 0.0) + grown + rng.normal(0.0, 0.005, x.size)
    points = np.column_stack([x, y, z])
    sensor = np.column_stack([points[:, 0], np.zeros(len(points)), np.full(len(points), 102.0)])
    returns = returns_of(points, np.full(len(points), 1000.0), np.arange(len(points)), sensor)
    drive = np.column_stack([np.arange(0.0, 20.0), np.zeros(20), np.full(20, 102.0), np.ones(20)])
    box = Box(0.0, -8.0, 20.0, 8.0)
    found = kerbs_of(make_scene(returns, box, box, drive))
    assert found and all(one.geometry.centroid.y < -4.5 for one in found)


@pytest.mark.parametrize(
    ("height_m", "grass_m", "passes_m"), [(0.12, 0.015, 0.0), (0.06, 0.06, 0.0), (0.08, 0.08, 0.0), (0.12, 0.0, 0.075)]
)
def test_kerbs_stay_with_grass_behind_them_and_where_passes_differ(
    height_m: float, grass_m: float, passes_m: float
) -> None:
    """A road 8 m wide with a kerb to the left; a half of the returns is that of a pass that lies higher."""
    rng = np.random.default_rng(5)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 30.0, 0.05), np.arange(-8.0, 8.0, 0.05)))
    y = y + rng.uniform(-0.02, 0.02, y.size)
    z = np.where(y > 4.0, height_m + np.where(y > 4.15, np.abs(rng.normal(0.0, 1.0, y.size)) * grass_m, 0.0), 0.0)
    ahead = np.tile(np.arange(0.0, 30.0, 0.01), 3)
    face = np.column_stack([ahead, np.full(ahead.size, 4.0), rng.uniform(0.0, height_m, ahead.size)])
    points = np.concatenate([np.column_stack([x, y, z]), face])
    points[:, 1:] += rng.normal(0.0, 0.008, (len(points), 2))
    points[::2, 2] += passes_m
    sensor = np.column_stack([points[:, 0], np.zeros(len(points)), np.full(len(points), 2.0)])
    returns = returns_of(points, np.full(len(points), 1000.0), np.arange(len(points)), sensor)
    drive = np.column_stack([np.arange(0.0, 30.0), np.zeros(30), np.full(30, 2.0), np.ones(30)])
    box = Box(0.0, -8.0, 30.0, 8.0)
    found = points_along(lines_of(kerbs_of(make_scene(returns, box, box, drive))))
    along = np.arange(1.0, 29.0, 0.1)
    assert share_within(np.column_stack([along, np.full(along.size, 4.0)]), found, 0.1) >= 0.95


@pytest.mark.parametrize("hidden", [False, True])
def test_an_edge_goes_on_where_its_step_is_hidden_and_not_where_both_sides_are_seen_without_one(hidden: bool) -> None:
    along, flat = 0.5 * np.arange(40.0), np.zeros(40)
    seen = (along < 9.0) | (along >= 11.0)
    one, step = np.ones(40), np.where(seen, 0.1, 0.01)
    sigma = np.where(seen | np.bool_(not hidden), 0.005, np.nan)
    nodes = Nodes(along, flat, flat, one, flat, step, sigma, flat, flat, one, one, one, flat, one)
    parts = kerb_parts(Edge(nodes, seen, one), np.where(seen, 0.8, 0.1))
    assert [float(np.ptp(part.nodes.x_m)) for part in parts] == ([19.5] if hidden else [8.0, 8.0])


def test_a_step_between_rings_is_no_kerb() -> None:
    """Rings cross y = 4 at 20°; those seen mostly beyond it are stated 12 cm too high. A kerb of 12 cm at y = -4."""
    rng = np.random.default_rng(3)
    off, way = (a.ravel() for a in np.meshgrid(np.arange(-60.0, 30.0, 0.12), np.arange(0.0, 30.0, 0.08), indexing="ij"))
    ring = np.repeat(np.arange(750), 375)
    x, y, high = off + way * np.cos(np.radians(20.0)), -2.0 + way * np.sin(np.radians(20.0)), ring % 2 == 1
    rows = np.flatnonzero((x > 0.0) & (x < 30.0) & (y < 8.0) & np.where(high, y > 3.9, y < 4.1))
    beside = np.column_stack([rng.uniform(0.0, 30.0, 70_000), rng.uniform(-8.0, -2.0, 70_000), np.zeros(70_000)])
    beside[:, 2] = np.where(beside[:, 1] < -4.0, 0.12, 0.0)
    points = np.concatenate([np.column_stack([x, y, 0.12 * high])[rows], beside])
    points[:, 2] += rng.normal(0.0, 0.006, len(points))
    number = np.concatenate([ring[rows], np.full(len(beside), 1000)])
    sensor = np.column_stack(
        [points[:, 0] + 3.0, points[:, 1] - 8.0 * np.sign(points[:, 1]), np.full(len(points), 2.0)]
    )
    returns = returns_of(points, np.full(len(points), 1000.0), number // 64 * 100_000_000, sensor)
    returns = replace(returns, laser=(number % 64).astype(np.uint16))
    drive = np.column_stack([np.arange(0.0, 30.0), np.zeros(30), np.full(30, 2.0), np.ones(30)])
    box = Box(0.0, -8.0, 30.0, 8.0)
    found = kerbs_of(make_scene(returns, box, box, drive))
    assert found and all(one.geometry.centroid.y < -3.5 for one in found)
    assert sum(one.geometry.length for one in found) >= 28.0


@pytest.mark.parametrize("slope", [-0.06, 0.0, 0.06])
def test_rings_that_cross_an_edge_show_its_step_however_its_sides_slope(slope: float) -> None:
    rng = np.random.default_rng(4)
    across = np.tile(np.arange(-1.0, 1.0, 0.04), 100)
    ring = np.repeat(np.arange(100), 50)
    height = 0.03 * (across > 0.0) + slope * across + rng.normal(0.0, 0.004, across.size)
    points = np.column_stack([0.1 * ring, -across, height + rng.normal(0.0, 0.03, 100)[ring]])
    returns = returns_of(points, np.ones(len(points)), 100_000_000 * ring, points)
    place = np.column_stack([np.arange(1.0, 9.0, 0.5), np.zeros(16), np.ones(16), np.zeros(16)])
    share = share_within_rings(returns, np.arange(len(points)), place, np.full(16, 0.03))
    assert share.min() > 0.6 and share.max() < 1.4
    low = np.flatnonzero(across < 0.0)
    assert np.isnan(share_within_rings(returns, low, place, np.full(16, 0.03))).all()
