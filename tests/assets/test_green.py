"""Green ground from pictures: the index of colours, agreement of pictures, and the edges that it gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import shapely

from roadscan.assets.edges.beside import BESIDE_PIECES
from roadscan.assets.edges.road_edges import EDGE_LINES
from roadscan.assets.green import colours
from roadscan.assets.green.areas import GREEN_CELLS, Sums, green_rows, mosaic_of
from roadscan.assets.green.cells import CELL_M, ground_cells
from roadscan.assets.green.colours import FINE, FINE_M, Ground, Look, PlacedGround, greenness, linear
from roadscan.assets.kinds.landscape_area import PIECE_SCHEMA, WHOLE, LandscapeArea, LandscapeOptions
from roadscan.assets.kinds.road_edge import RoadEdge
from roadscan.assets.kinds.sidewalk import Sidewalk
from roadscan.assets.scene import Box, GroundModel, Returns, Scene

ASPHALT, GRASS, DRY = (120, 119, 116), (76, 100, 50), (100, 96, 66)
EDGE_M = 3.1
"""Lawn lies to the east of this easting, which is no corner of a cell (m)."""
SIDE = 40
"""Edge of the window (cells)."""
NO_COLOURS = np.zeros((0, 3), np.uint8), np.zeros(0, np.bool_)
"""Colours of fine cells, which green ground does not use."""


def lit(colour: tuple[int, int, int], gains: tuple[float, float, float]) -> np.ndarray:
    """The digital numbers of a colour in another light or exposure: gains of linear red, green and blue."""
    light = linear(np.array(colour, np.uint8)) * gains
    return np.round(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)).astype(
        np.uint8
    )


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0), (2.5, 2.5, 2.5), (0.4, 0.4, 0.4), (0.8, 1.0, 1.4), (1.5, 1.2, 0.8)])
def test_greenness_knows_grass_in_any_light(gains: tuple[float, float, float]) -> None:
    paved = linear(lit(ASPHALT, gains))
    colours = np.stack([lit(one, gains) for one in (ASPHALT, GRASS, DRY, (235, 179, 47), (15, 122, 70), (70, 90, 160))])
    index = greenness(colours, paved)
    assert index[0] == pytest.approx(0.0, abs=0.01)
    assert index[1] > 0.15
    assert (index[2:] < 0.02).all()  # dry grass, yellow and green paint, a blue car


def test_greenness_says_nothing_of_black_and_of_white() -> None:
    index = greenness(np.array([(3, 5, 3), (255, 255, 255)], np.uint8), linear(np.array(ASPHALT, np.uint8)))
    assert np.isnan(index).all()


@pytest.mark.parametrize(("moved_m", "expected"), [(0.0, False), (1.5, True), (-3.0, True)])
def test_a_picture_that_shows_the_ground_elsewhere_is_not_believed(
    moved_m: float, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spots of paint at random, as the lidar sees them and as a picture does that is off to the east."""
    spots = np.random.default_rng(5).random((60, 60)) < 0.2
    row, column = (a.ravel() for a in np.indices((SIDE, SIDE)))
    none = np.zeros(row.size)

    def painted(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return spots[np.floor(y_m / 0.5).astype(int) + 15, np.floor(x_m / 0.5).astype(int) + 15]

    def shown(picture: object, one: object, worlds_m: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        place = worlds_m[0].reshape(-1, 3)
        bright = np.where(painted(place[:, 0] - moved_m, place[:, 1]), 200, 90).astype(np.uint8)
        return np.repeat(bright[:, None], 3, axis=1), np.ones(len(place), np.bool_)

    x_m, y_m = (column + 0.5) * CELL_M, (row + 0.5) * CELL_M
    intensity = np.where(painted(x_m, y_m), 190.0, 60.0)
    ground = Ground(column, row, none, intensity, none, none > 0.0, np.zeros((row.size, 2)))
    placed = PlacedGround(ground, (ground.places_m,), (np.eye(3),))
    monkeypatch.setattr(colours, "_colours", shown)
    nothing: Any = None
    assert colours._lies_elsewhere(nothing, nothing, placed, np.arange(row.size)) is expected


def whole_window() -> tuple[np.ndarray, np.ndarray]:
    row, column = (a.ravel() for a in np.indices((SIDE, SIDE)))
    return row, column


def look(edge_m: float = EDGE_M) -> Look:
    """A picture of a lawn to the east of an edge."""
    _, column = whole_window()
    at = column[:, None] * CELL_M + (np.tile(np.arange(FINE), FINE) + 0.5) * FINE_M
    index = 0.2 * np.clip((at - edge_m) / FINE_M + 0.5, 0.0, 1.0)
    return Look(np.arange(SIDE**2), index, np.full(SIDE**2, 0.06), *NO_COLOURS)


def green_of(looks: list[tuple[Look, int]], drive_m: float = 5.0) -> pa.Table:
    row, column = whole_window()
    sums = Sums(SIDE**2)
    for one, half in looks:
        sums.add(one, half)
    mosaic = mosaic_of(sums, np.arange(SIDE**2), (row, column), (SIDE, SIDE), np.full(SIDE**2, drive_m))
    return green_rows(mosaic, (0, 0), ground(), (0.0, 0.0, SIDE * CELL_M, SIDE * CELL_M))


def ground() -> pa.Table:
    """Rows of the window's cells."""
    row, column = whole_window()
    return pa.table({
        "column": column, "row": row, "height_m": np.zeros(SIDE**2), "returns": np.full(SIDE**2, 3, np.int32),
        "passes": pa.array([[1]] * SIDE**2, pa.list_(pa.int32())),
        "first_epoch_gps_ns": np.full(SIDE**2, 5), "last_epoch_gps_ns": np.full(SIDE**2, 9),
    })  # fmt: skip


def test_windows_of_squares_change_no_cell() -> None:
    row, column = whole_window()
    random = np.random.default_rng(3)
    base = look()
    noisy = [
        (Look(base.cells, base.index + random.normal(0, 0.03, base.index.shape), base.pixel_m, *NO_COLOURS), h)
        for h in (0, 1, 1)
    ]
    whole = green_of(noisy)
    sums = Sums(SIDE**2)
    for one, half in noisy:
        sums.add(one, half)
    parts = []
    for first, last, west, east in ((0, 32, 0, 20), (8, 40, 20, 40)):
        own = np.flatnonzero((column >= first) & (column < last))
        at = row[own], column[own] - first
        mosaic = mosaic_of(sums, own, at, (SIDE, last - first), np.full(own.size, 5.0))
        parts.append(green_rows(mosaic, (0, first), ground(), (west * CELL_M, 0.0, east * CELL_M, SIDE * CELL_M)))
    both = pa.concat_tables(parts).sort_by([("row", "ascending"), ("column", "ascending")])
    assert both["mask"].to_pylist() == whole["mask"].to_pylist()
    assert both["sigma_m"].to_numpy() == pytest.approx(whole["sigma_m"].to_numpy(), rel=1e-9)


def areas(pieces: pa.Table, green: pa.Table | None) -> list:
    kind = LandscapeArea()
    held = pieces if green is None else kind.with_pictures(pieces, green)
    return list(kind.objects(held, LandscapeOptions(), {}))


def grown(columns: range, rows: range) -> pa.Table:
    """Cells that the scatter of heights tells."""
    cells = [(c, r) for r in rows for c in columns]
    count = len(cells)
    return pa.table(
        {"column": [c for c, _ in cells], "row": [r for _, r in cells], "height_m": [0.0] * count,
         "probability": [0.9] * count, "returns": [4] * count, "passes": [[1]] * count,
         "first_epoch_gps_ns": [5] * count, "last_epoch_gps_ns": [9] * count}, PIECE_SCHEMA,
    )  # fmt: skip


def test_the_edge_of_a_lawn_lies_where_pictures_show_it() -> None:
    (lawn,) = areas(PIECE_SCHEMA.empty_table(), green_of([(look(), 0), (look(), 1)]))
    west = shapely.get_coordinates(lawn.geometry)[:, 0].min()
    assert west == pytest.approx(EDGE_M, abs=FINE_M)
    assert lawn.sigma_horizontal_m < 0.08
    assert lawn.geometry.area == pytest.approx((SIDE * CELL_M - EDGE_M) * SIDE * CELL_M, rel=0.02)


def test_one_picture_tells_nothing_nor_do_pictures_that_disagree() -> None:
    assert green_of([(look(), 0)]).num_rows == 0
    green = green_of([(look(), 0), (look(6.0), 1)])
    columns = green["column"].to_numpy()[green["mask"].to_numpy() != 0]
    assert columns.min() * CELL_M > 5.5  # between 3.1 and 6.0 one says lawn, one does not


def test_no_lawn_lies_where_the_vehicle_drove() -> None:
    assert green_of([(look(), 0), (look(), 1)], drive_m=0.8).num_rows == 0


def test_two_sets_of_pictures_that_see_the_edge_elsewhere_make_sigma_larger() -> None:
    (same,) = areas(PIECE_SCHEMA.empty_table(), green_of([(look(), 0), (look(), 1)]))
    (apart,) = areas(PIECE_SCHEMA.empty_table(), green_of([(look(3.0), 0), (look(3.2), 1)]))
    assert apart.sigma_horizontal_m > 1.15 * same.sigma_horizontal_m


def test_grown_cells_end_where_green_ground_does_and_others_stay() -> None:
    green = green_of([(look(), 0), (look(), 1)])
    plants = grown(range(11, 30), range(5, 30))  # a cell too far to the west, as pooling makes them
    (lawn,) = areas(plants, green)
    assert shapely.get_coordinates(lawn.geometry)[:, 0].min() == pytest.approx(EDGE_M, abs=FINE_M)
    apart = grown(range(-40, -20), range(5, 30))
    before, after = areas(apart, None), areas(apart, green)
    own = next(one for one in after if one.geometry.centroid.x < 0)
    assert [own] == before or shapely.equals_exact(own.geometry, before[0].geometry)
    assert own.sigma_horizontal_m == before[0].sigma_horizontal_m
    assert WHOLE == 2**25 - 1


def line_at(easting_m: float, names: list[str], **values: float) -> dict:
    count = 12
    row = {name: [values.get(name, 0.0)] * count for name in names}
    return row | {"easting_m": [easting_m] * count, "northing_m": [2.0 + 0.5 * k for k in range(count)]}


def rest() -> dict:
    return {"returns": 9, "passes": [1], "first_epoch_gps_ns": 5, "last_epoch_gps_ns": 9, "cut_first": False,
            "cut_last": False}  # fmt: skip


def test_a_verge_is_moved_to_the_lawn_and_a_kerb_is_not() -> None:
    kind = RoadEdge()
    names = [f.name for f in EDGE_LINES if pa.types.is_list(f.type) and f.name != "passes"]
    rows = [line_at(2.8, names, sigma_m=0.15) | rest(), line_at(2.8, names, sigma_m=0.02, by_kerb=1.0) | rest(),
            line_at(1.5, names, sigma_m=0.15) | rest()]  # fmt: skip
    pieces = pa.Table.from_pylist(rows, schema=EDGE_LINES)
    verge, kerb, far = kind.with_pictures(pieces, green_of([(look(), 0), (look(), 1)])).to_pylist()
    assert np.array(verge["easting_m"]) == pytest.approx(EDGE_M, abs=FINE_M)
    assert max(verge["sigma_m"]) < 0.08
    assert kerb == pieces.to_pylist()[1] and far == pieces.to_pylist()[2]


def test_a_sidewalk_ends_at_a_flush_lawn() -> None:
    names = [f.name for f in BESIDE_PIECES if pa.types.is_list(f.type) and f.name != "passes"]
    rows = [line_at(1.5, names, width_m=5.0, ends_down=1.0) | rest(), line_at(1.5, names, width_m=1.2) | rest()]
    pieces = pa.Table.from_pylist(rows, schema=BESIDE_PIECES)
    wide, narrow = Sidewalk().with_pictures(pieces, green_of([(look(), 0), (look(), 1)])).to_pylist()
    assert np.array(wide["width_m"]) == pytest.approx(EDGE_M - 1.5, abs=1.5 * FINE_M)
    assert min(wide["ends_known"]) == 1.0 and max(wide["ends_down"]) == 0.0
    assert narrow == pieces.to_pylist()[1]


def test_green_cells_have_the_columns_of_landscape_areas() -> None:
    assert GREEN_CELLS.names[: len(PIECE_SCHEMA.names)] == PIECE_SCHEMA.names


def test_ground_without_returns_is_dated_by_the_nearest_one() -> None:
    """Two passes saw one half each of a square of 6 m, and neither what lies between them."""
    random = np.random.default_rng(1)
    x, y = random.uniform(0.0, 6.0, (2, 4000))
    seen = np.abs(x - 3.0) > 1.0
    x, y, n = x[seen], y[seen], np.count_nonzero(seen)
    number, byte, zeros = (x > 3.0).astype(np.uint16), np.zeros(n, np.uint8), np.zeros(n)
    returns = Returns(
        (0.0, 0.0), x, y, zeros, np.ones(n, np.float32), np.where(number == 1, 900, 500), number, byte,
        np.zeros(n, np.uint16), byte + np.uint8(1), byte + np.uint8(1), zeros, zeros, zeros + 2.0,
    )  # fmt: skip
    flat, box = GroundModel(0.0, 0.0, 1.0, np.zeros((6, 6), np.float32), np.ones((6, 6), np.bool_)), Box(0, 0, 6, 6)
    drive = np.array([[3.0, 0.0, 0.0, 0.0], [3.0, 6.0, 0.0, 0.0]])
    cells = ground_cells(Scene(returns, box, box, flat, np.zeros(n, np.float32), byte, drive)).to_pylist()
    assert len(cells) == 24 * 24
    assert sum(one["returns"] == 0 for one in cells) >= 24 * 8
    for one in cells:
        east = (one["column"] + 0.5) * CELL_M > 3.0
        assert one["passes"] == [int(east)]
        assert one["first_epoch_gps_ns"] == one["last_epoch_gps_ns"] == (900 if east else 500)


def test_more_pictures_than_a_byte_counts_are_many() -> None:
    """A vehicle that waits at a light is seen by hundreds: their number stays the greatest."""
    sums = Sums(1)
    look = Look(np.array([0]), np.full((1, FINE * FINE), 0.1), np.array([0.02]), *NO_COLOURS)
    for _ in range(257):
        sums.add(look, 0)
    assert (sums.number[0] == 255).all()
