"""Edges between grey surfaces: pictures show where, intensities whether, and a shadow's edge is none."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.edges.grey import with_pictured
from roadscan.assets.edges.line_pieces import joined_lines
from roadscan.assets.green.cells import CELL_M
from roadscan.assets.green.colours import FINE, FINE_M, Ground
from roadscan.assets.kinds.road_edge import RoadEdge, RoadEdgeOptions
from roadscan.assets.paint.brightness import BrightSums, Seen
from roadscan.assets.scene import Box
from roadscan.assets.tasks.objects import read_as
from roadscan.assets.tasks.pictured_edges import GREY_EDGES, grey_edges
from roadscan.assets.tasks.pictured_paint import Known, Window
from roadscan.core.errors import RunError
from roadscan.store.manifest import publish_table
from roadscan.store.store import Store

ROWS, COLUMNS = 72, 48
"""Ground of 18 m along a road and 12 m across (cells)."""
DRIVE_M, EDGE_M = 4.0, 7.62
"""Eastings of a drive to the north, and of the edge of the asphalt to its right (m)."""
ALL = Box(0.0, 0.0, COLUMNS * CELL_M, ROWS * CELL_M)


def drawn(
    bright_m: float | None,
    change: float,
    *,
    until_m: float = 99.0,
    line_m: float | None = None,
    rows: tuple[int, int] = (0, ROWS),
) -> tuple[BrightSums, Window]:
    """Ground in a window: brighter by a fifth from an easting on, intensities greater by a share from the edge on.

    until_m : where intensities are again those of the road. line_m : where a line of paint lies that returns show.
    """
    random = np.random.default_rng(7)
    row, column = (a.ravel() for a in np.indices((ROWS, COLUMNS)))
    part = np.arange(FINE * FINE)
    east = column[:, None] * CELL_M + (part % FINE + 0.5) * FINE_M
    level = random.normal(0.0, 0.1, east.shape)
    if bright_m is not None:
        level += 0.2 * np.clip((east - bright_m) / FINE_M + 0.5, 0.0, 1.0)
    share = (np.clip((east - EDGE_M) / FINE_M + 0.5, 0.0, 1.0) * (east < until_m)).mean(axis=1)
    intensity = 60.0 * (1.0 + change * share) * random.normal(1.0, 0.05, share.size)
    held = np.flatnonzero((row >= rows[0]) & (row < rows[1]))
    row, column, none, count = row[held], column[held], np.zeros(held.size), held.size
    aside = (column + 0.5) * CELL_M - DRIVE_M
    table = pa.table({
        "returns": np.full(count, 3), "passes": pa.array([[1]] * count, pa.list_(pa.int32())),
        "first_epoch_gps_ns": np.full(count, 5), "last_epoch_gps_ns": np.full(count, 9),
        "aside_m": aside.astype(np.float32), "heading_rad": np.full(count, np.pi / 2, np.float32),
    })  # fmt: skip
    ground = Ground(column, row, none, intensity[held], np.abs(aside), none > 0.0, np.zeros((count, 2)))
    sums = BrightSums(count)
    for _ in range(3):
        sums.add(np.arange(count), Seen(level[held], level[held]), np.full(count, 0.03))
    lines = shapely.Polygon() if line_m is None else shapely.box(line_m - 0.06, -99.0, line_m + 0.06, 99.0)
    corner = 0.0, rows[0] * CELL_M
    known = Known(shapely.transform(lines, lambda xy: xy - np.array(corner)), ())
    shape = rows[1] - rows[0], COLUMNS
    return sums, Window(np.arange(count), (row - rows[0], column), shape, ground, table, corner, known)


def found(sums: BrightSums, window: Window, box: Box = ALL) -> pa.Table:
    return grey_edges(sums, window, box, np.zeros((window.shape[0] * FINE, window.shape[1] * FINE), np.bool_))


def test_an_edge_lies_where_pictures_show_it_and_intensities_change() -> None:
    for change in (0.4, -0.25):
        (edge,) = (whole_edge() if change == 0.4 else found(*drawn(EDGE_M, change))).to_pylist()
        assert np.array(edge["easting_m"]) == pytest.approx(EDGE_M, abs=0.03)
        assert np.ptp(edge["northing_m"]) > 14.0 and edge["northing_m"][0] < edge["northing_m"][-1]
        assert set(edge["right"]) == {1.0} and set(edge["by_surface"]) == {1.0}
        assert 0.02 < np.mean(edge["sigma_m"]) < 0.06
        assert edge["passes"] == [1] and edge["first_epoch_gps_ns"] == 5


@pytest.mark.parametrize(
    "street",
    [
        {"bright_m": EDGE_M, "change": 0.0},  # the edge of a shadow, along the road
        {"bright_m": EDGE_M - 0.6, "change": 0.4},  # such a one beside an edge that pictures do not show
        {"bright_m": None, "change": 0.4},
        {"bright_m": EDGE_M, "change": 0.4, "until_m": EDGE_M + 1.2},  # a patch: the road goes on behind it
        {"bright_m": EDGE_M, "change": 0.4, "until_m": EDGE_M + 2.2},
        {"bright_m": EDGE_M, "change": 0.4, "line_m": EDGE_M + 0.1},  # lanes of other asphalt
    ],
)
def test_shadows_patches_and_lanes_are_no_edges(street: dict) -> None:
    assert found(*drawn(**street)).num_rows == 0


def test_a_lidar_with_one_constant_intensity_bears_out_nothing() -> None:
    sums, window = drawn(EDGE_M, 0.4)
    window.ground.intensity[:] = 60.0
    assert found(sums, window).num_rows == 0


def test_any_cut_gives_the_same_edge() -> None:
    whole = RoadEdge().objects(whole_edge(), RoadEdgeOptions(), {})
    middle_m, margin = 9.0, round(8.0 / CELL_M)
    at = round(middle_m / CELL_M)
    south = found(*drawn(EDGE_M, 0.4, rows=(0, at + margin)), Box(0.0, 0.0, COLUMNS * CELL_M, middle_m))
    low = at - margin
    north = found(*drawn(EDGE_M, 0.4, rows=(low, ROWS)),
                  Box(0.0, middle_m - low * CELL_M, COLUMNS * CELL_M, (ROWS - low) * CELL_M))  # fmt: skip
    assert (south["cut_last"].to_pylist(), north["cut_first"].to_pylist()) == ([True], [True])
    parts = RoadEdge().objects(pa.concat_tables([south, north]), RoadEdgeOptions(), {})
    (one,), (other,) = list(whole), list(parts)
    assert shapely.hausdorff_distance(one.geometry, other.geometry) < 1e-6
    assert one.attributes == {**other.attributes, "length_m": pytest.approx(other.attributes["length_m"])}
    assert one.attributes["type"] == "surface"
    assert one.probability == pytest.approx(other.probability)


@functools.cache
def whole_edge() -> pa.Table:
    return found(*drawn(EDGE_M, 0.4))


def returns_edge(easting_m: float, **values: float) -> dict:
    """An edge of returns to the right of the drive, from 3 to 15 m."""
    names = [f.name for f in GREY_EDGES if f.type == pa.list_(pa.float64())]
    row = {name: [values.get(name, 0.0)] * 25 for name in names}
    row |= {"easting_m": [easting_m] * 25, "northing_m": [3.0 + 0.5 * k for k in range(25)], "right": [1.0] * 25}
    return row | {"returns": 9, "passes": [1], "first_epoch_gps_ns": 5, "last_epoch_gps_ns": 9, "cut_first": False,
                  "cut_last": False}  # fmt: skip


@pytest.mark.parametrize(
    ("edge", "types"),
    [
        (returns_edge(EDGE_M + 2.5, by_barrier=1.0), {"surface"}),  # a façade behind the sidewalk
        (returns_edge(EDGE_M + 0.3, sigma_m=0.15), {"surface", "verge"}),  # moved, and longer at both ends
        (returns_edge(EDGE_M + 0.2, by_kerb=1.0), {"surface", "kerb"}),
        (returns_edge(EDGE_M + 2.5, by_kerb=1.0), {"surface", "kerb"}),
    ],
)
def test_of_two_edges_on_one_side_one_stays(edge: dict, types: set[str]) -> None:
    pieces = pa.Table.from_pylist([edge], schema=GREY_EDGES)
    settled = with_pictured(pieces, whole_edge())
    lines = joined_lines(settled)
    at = np.concatenate([line.column("northing_m") for line in lines])
    assert np.unique(np.round(at / 0.5)).size >= at.size - 2  # nowhere two, but at ends
    assert {o.attributes["type"] for o in RoadEdge().objects(settled, RoadEdgeOptions(least_length_m=1.0), {})} <= types
    easting = np.concatenate([line.column("easting_m") for line in lines])
    if edge["by_kerb"][0]:
        assert np.isclose(easting, edge["easting_m"][0]).sum() == 25
    else:
        assert easting == pytest.approx(EDGE_M, abs=0.05)


def edge_along(way: np.ndarray, right: bool, **values: float) -> dict:
    """An edge along places (n, 2)."""
    row = {
        name: [value[0]] * len(way) for name, value in returns_edge(0.0, **values).items() if isinstance(value, list)
    }
    return returns_edge(0.0) | row | {
        "easting_m": way[:, 0].tolist(), "northing_m": way[:, 1].tolist(), "right": [float(right)] * len(way),
        "passes": [1],
    }  # fmt: skip


AHEAD = np.arange(0.0, 30.1, 0.5)


@pytest.mark.parametrize("by", [{}, {"by_kerb": 1.0}])
@pytest.mark.parametrize(
    ("returns", "pictured", "right"),
    [
        # both left edges of a divided road, whose drives lead in opposite directions
        (np.column_stack([AHEAD * 0 - 3.0, AHEAD]), np.column_stack([AHEAD * 0 - 9.0, AHEAD[::-1]]), False),
        # the edges of a road and of a service road beside it
        (np.column_stack([AHEAD * 0 + 13.0, AHEAD]), np.column_stack([AHEAD * 0 + 4.0, AHEAD]), True),
        # the edges of two roads that meet at a corner
        (np.column_stack([AHEAD * 0 + 5.0, AHEAD - 30.0]), np.column_stack([AHEAD + 5.0, AHEAD * 0]), True),
    ],
)
def test_edges_of_other_roads_stay(returns: np.ndarray, pictured: np.ndarray, right: bool, by: dict) -> None:
    pieces = pa.Table.from_pylist([edge_along(returns, right, **by)], schema=GREY_EDGES)
    edges = pa.Table.from_pylist([edge_along(pictured, right, by_surface=1.0, sigma_m=0.05)], schema=GREY_EDGES)
    assert [len(row["easting_m"]) for row in with_pictured(pieces, edges).to_pylist()] == [AHEAD.size] * 2


def test_without_edges_in_pictures_pieces_stay_the_same() -> None:
    pieces = pa.Table.from_pylist([returns_edge(12.0)], schema=GREY_EDGES)
    assert with_pictured(pieces, GREY_EDGES.empty_table()) is pieces


def test_tables_of_an_earlier_version_are_named(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "street")
    whole = whole_edge()
    kept = publish_table(store, whole, "asset_evidence", "road_edge/3_4", "new", "")
    assert read_as(store, kept, GREY_EDGES)["easting_m"].to_pylist() == whole["easting_m"].to_pylist()
    older = publish_table(store, whole.drop_columns(["by_surface"]), "asset_evidence", "road_edge/3_5", "old", "")
    with pytest.raises(RunError, match=r"asset_evidence of road_edge/3_5 was written by another version.*by_surface"):
        read_as(store, older, GREY_EDGES)
