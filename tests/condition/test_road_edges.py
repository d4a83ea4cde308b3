"""Edges of a road against the simulated surface that the readings were made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from roadscan.condition.edge_raster import TilePoints, tile_points
from roadscan.condition.lane_data import EdgeRows, edges_on_lane
from roadscan.condition.road_edges import KINDS, LEAD_M, RoadEdges, RoadStretch, road_edges, road_surfaces
from roadscan.condition.road_line import Lane, RoadLine
from roadscan.core.grid import TileId
from roadscan.simulate import Scene
from roadscan.simulate.surface import Surface
from roadscan.tiles.cells import TileCells
from tests.assets.scenes import semantic_kitti_returns

LENGTH_M = 20.0
KERBS = [{"side": "left", "height_m": 0.12}, {"side": "right", "height_m": 0.08}]
RUTS = [
    {"offset_m": c + s * 0.85, "width_m": 0.8, "depth_m": 0.025} for c in (-1.75, 1.75) for s in (-1.0, 1.0)
]  # fmt: skip
LINES = [{"offset_m": 3.3}, {"offset_m": -3.3}]
ALIKE = {"verge_slope": 0.025, "brightness": {"verge": 70}}
"""A verge that nothing tells from the road."""


class Street:
    """A bend of 150 m radius, a point each 0.1 m along and 0.05 m across, with noise of height and of intensity."""

    def __init__(self, noise_m: float = 0.003, grey: float = 6.0, **road: Any) -> None:
        bend = [{"kind": "arc", "length_m": 90.0, "radius_m": 150.0}]
        values = {"id": "edges", "length_m": 80.0, "passes": [{"lane": 1}], "road": {"alignment": bend, **road}}
        self.scene = Scene.parse(values)
        surface, rng = Surface(self.scene), np.random.default_rng(1)
        along, across = np.arange(0.0, LENGTH_M + 2.0 * LEAD_M + 3.0, 0.1), np.arange(-8.0, 8.0, 0.05)
        station, offset = (a.ravel() for a in np.meshgrid(along, across, indexing="ij"))
        offset = offset + rng.uniform(-0.02, 0.02, offset.size)
        e, n, _ = surface.place(station, offset)
        height = surface.height_m(e, n, texture=False) + rng.normal(0.0, noise_m, e.size)
        shade = surface.intensity(e, n) + rng.normal(0.0, grey, e.size)
        self.points = TilePoints(np.column_stack([e, n]), height, shade, np.ones(e.size))
        nodes = np.arange(0.0, along[-1] + 2.0)
        e, n, _ = surface.place(nodes, np.zeros(nodes.size))
        self.line = RoadLine("A", np.column_stack([e, n]))
        self.lanes = tuple(
            Lane("A", str(k), 1, 0, np.full(nodes.size, middle), 3.5, "stated", ())
            for k, middle in enumerate((-1.75, 1.75))
        )

    @property
    def edge_m(self) -> float:
        """Distance of both edges from the reference line."""
        return float(self.scene.road.paved_m)

    def edges(self, points: TilePoints | None = None, polygons: shapely.Geometry | None = None) -> RoadEdges:
        """The edges found."""
        stretch = RoadStretch(self.line, self.lanes, LEAD_M, LEAD_M + LENGTH_M)
        return road_edges([points or self.points], stretch, 4.0, 0.3, polygons)


def errors(street: Street, found: RoadEdges) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the edges found from the true ones, outward, and their standard deviations."""
    both = [(-found.sides["left"].offset_m, "left"), (found.sides["right"].offset_m, "right")]
    away = np.concatenate([offset - street.edge_m for offset, _ in both])
    return away, np.concatenate([found.sides[name].found.sigma_m for _, name in both])


@pytest.mark.parametrize(
    ("road", "kind", "most_m"),
    [
        ({"kerbs": KERBS}, "kerb", 0.03),
        ({"kerbs": KERBS, "ruts": RUTS, "shoulder_width_m": 0.5, "noise_m": 0.010}, "kerb", 0.04),
        ({"verge_slope": 0.15, "brightness": {"verge": 70}}, "slope", 0.05),
        ({"verge_slope": 0.025}, "intensity", 0.03),
    ],
    ids=["kerbs", "kerbs beside ruts and noise", "a verge that falls", "a verge of another shade"],
)
def test_edges_are_where_the_road_ends(road: dict[str, Any], kind: str, most_m: float) -> None:
    street = Street(**road)
    found = street.edges()
    away, sigma = errors(street, found)
    assert np.isfinite(away).all()
    assert np.abs(away).max() <= most_m
    assert np.sqrt(np.mean((away / sigma) ** 2)) <= 1.3
    assert {KINDS[k] for side in found.sides.values() for k in side.found.kind} == {kind}
    if kind == "kerb":
        for kerb in KERBS:
            own = found.sides[str(kerb["side"])].found
            # The foot of the kerb's face is the edge; its top is behind 2 cm.
            assert np.median(own.drop_m) == pytest.approx(-float(str(kerb["height_m"])), abs=0.003)
            assert np.abs((own.drop_m + float(str(kerb["height_m"]))) / own.sigma_drop_m).mean() < 2.0


def test_the_painted_line_stands_for_an_edge_that_nothing_tells() -> None:
    street = Street(**ALIKE, markings=LINES)
    found = street.edges()
    away, _ = errors(street, found)
    assert away == pytest.approx(np.full(away.size, 3.3 - 3.5), abs=0.02)
    assert {KINDS[k] for k in found.sides["left"].found.kind} == {"marking"}
    bare = Street(**ALIKE).edges()
    assert np.isnan(bare.sides["left"].offset_m).all()
    assert not list(road_surfaces(bare, street.line))


def test_the_surface_between_the_edges_is_the_road() -> None:
    street = Street(kerbs=KERBS)
    (surface,) = road_surfaces(street.edges(), street.line)
    station = np.arange(LEAD_M, LEAD_M + LENGTH_M + 0.1, 0.5)
    border = [street.line.places(station, side * street.edge_m)[:, :2] for side in (1.0, -1.0)]
    true = shapely.Polygon(np.concatenate([border[0], border[1][::-1]]))
    assert surface.outline.intersection(true).area >= 0.99 * surface.outline.union(true).area
    assert surface.width_m == pytest.approx(2.0 * street.edge_m, abs=0.04)
    assert (surface.from_m, surface.to_m) == (LEAD_M, LEAD_M + LENGTH_M)


def test_borders_of_polygons_are_the_edges_where_they_are_stated() -> None:
    street = Street(kerbs=KERBS)
    station = np.arange(0.0, LENGTH_M + 2.0 * LEAD_M, 0.5)
    border = [street.line.places(station, offset)[:, :2] for offset in (3.1, -2.9)]
    stated = shapely.Polygon(np.concatenate([border[0], border[1][::-1]]))
    found = street.edges(polygons=stated)
    assert found.sides["right"].offset_m == pytest.approx(np.full(41, 3.1), abs=0.01)
    assert found.sides["left"].offset_m == pytest.approx(np.full(41, -2.9), abs=0.01)
    assert np.isnan(found.sides["left"].found.sigma_m).all()
    wide = street.edges(polygons=stated.buffer(50.0))
    assert np.isnan(wide.sides["right"].offset_m).all()


def test_what_is_not_measured_has_no_edge() -> None:
    street = Street(kerbs=KERBS)
    station, offset = street.line.along(street.points.place_m, LEAD_M + 0.5 * LENGTH_M)
    seen = (offset > -2.5) & ~((offset > 2.5) & (station > LEAD_M + 10.0))
    p = street.points
    part = TilePoints(p.place_m[seen], p.height_m[seen], p.intensity[seen], p.readings[seen])
    found = street.edges(part)
    assert np.isnan(found.sides["left"].offset_m).all()
    right = np.isfinite(found.sides["right"].offset_m)
    assert right[: 2 * 6].all()
    assert not right[-2 * 5 :].any()


def test_blocks_of_cells_have_the_means_of_their_readings() -> None:
    rng = np.random.default_rng(3)
    cell = np.flatnonzero(rng.uniform(size=400) < 0.7)
    column, row = (cell % 20).astype(np.uint16), (cell // 20).astype(np.uint16)
    count, height = rng.integers(1, 9, cell.size).astype(np.uint32), rng.normal(100.0, 1.0, cell.size)
    grey, nan = rng.uniform(1, 99, cell.size).astype(np.float32), np.full(cell.size, np.nan)
    cells = TileCells(
        TileId(0, 0), 20, column, row, count, height, height, nan, nan, nan.astype(np.float32), grey,
        np.ones(cell.size, np.uint16), np.zeros(cell.size + 1, np.int32), np.empty(0, np.uint16),
    )  # fmt: skip
    found = tile_points(cells, (1000.0, 2000.0), 0.01)
    own = (column // 5 == 1) & (row // 5 == 2)
    at = np.argmin(np.hypot(*(found.place_m - (1000.075, 2000.125)).T))
    assert found.readings[at] == count[own].sum()
    assert found.height_m[at] == pytest.approx(np.average(height[own], weights=count[own]))
    assert found.intensity[at] == pytest.approx(np.average(grey[own], weights=count[own]))
    assert found.place_m[at, 0] == pytest.approx(1000.0 + 0.01 * (np.average(column[own], weights=count[own]) + 0.5))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_lane_sees_its_edges_in_the_direction_of_travel(sign: int) -> None:
    lane = Lane("A", "1", sign, 0, np.full(11, 1.0), 3.5, "stated", ())
    station = np.array([2.0, 2.5, 3.0])

    def rows(offset_m: float, drop_m: float) -> EdgeRows:
        return EdgeRows(station, np.full(3, offset_m), np.full(3, 0.03), np.full(3, drop_m), np.full(3, 0.002))

    held = {"left": rows(-4.0, 0.05), "right": rows(3.0, -0.12)}
    edges = edges_on_lane(held, lane, (0.0, 10.0), {"left": False, "right": True})
    near, far = ("right", "left") if sign > 0 else ("left", "right")
    assert edges.sides[near].away_m[4:7].tolist() == [2.0] * 3
    assert edges.sides[far].away_m[4:7].tolist() == [5.0] * 3
    assert np.isnan(edges.sides[near].away_m[7:]).all()
    assert edges.sides[near].drop_m[4] == -0.12
    own = np.array([1.9, 2.1, -4.9, -5.1]) * sign
    assert edges.inside(np.full(4, 2.6), own).tolist() == [True, False, True, False]
    assert edges.inside(np.full(4, 8.0), own).all()


@pytest.mark.nightly
def test_edges_of_a_labelled_street() -> None:
    """SemanticKITTI 00, 20 m beside parked cars: where the returns that hand labels call road end."""
    returns, labels, drive = semantic_kitti_returns()
    place = np.column_stack([returns.x_m, returns.y_m])
    ahead = (drive[-1, :2] - drive[0, :2]) / np.hypot(*(drive[-1, :2] - drive[0, :2]))
    line = RoadLine("A", drive[0, :2] + np.arange(-40.0, 41.0)[:, None] * ahead)
    cell, inverse = np.unique(np.floor(place / 0.05), axis=0, return_inverse=True)
    count = np.bincount(inverse.ravel()).astype(np.float64)
    height, grey = (np.bincount(inverse.ravel(), v) / count for v in (returns.height_m, returns.intensity))
    points = TilePoints(0.05 * (cell + 0.5), height, grey, count)
    lane = Lane("A", "1", 1, 0, np.zeros(81), 3.0, "stated", ())
    found = road_edges([points], RoadStretch(line, (lane,), 38.0, 58.0), 8.0, 0.3)
    station, offset = line.along(place, 40.0 + (place - drive[0, :2]) @ ahead)
    road = np.isin(labels, (40, 60))
    away, known = [], 0
    for side, sign in (("left", -1.0), ("right", 1.0)):
        for at, edge in zip(found.station_m, found.sides[side].offset_m, strict=True):
            own = np.abs(station - at) <= 1.0
            bins = np.floor(sign * offset[own] / 0.2).astype(int)
            inside = (bins >= 0) & (bins < 50)
            on, off = (np.bincount(bins[inside & one], minlength=50) for one in (road[own], ~road[own]))
            # The first place from the lane outward that holds other things than road.
            ends = [b for b in range(6, 49) if off[b] > on[b] and off[b] >= 3]
            if ends and np.isfinite(edge):
                away.append(sign * edge - 0.2 * ends[0])
            known += bool(ends)
    assert len(away) >= 0.8 * known  # 0.98
    assert np.mean(np.abs(np.array(away)) <= 0.5) >= 0.8  # 0.85; within 0.3 m 0.53
