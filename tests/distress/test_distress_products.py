"""Cracks and potholes as products: pieces of tiles and the joined tables, read by geopandas."""

from __future__ import annotations

import dataclasses
import math

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.errors import ConfigError, StoreError
from roadscan.core.grid import TileId
from roadscan.distress.products.crack_pieces import CrackPieces
from roadscan.distress.products.cracks import Cracks
from roadscan.distress.products.pothole_pieces import PotholePieces
from roadscan.distress.products.potholes import Potholes
from roadscan.distress.settings import CrackDetection, CrackJoining, PotholeDetection, PotholeJoining
from roadscan.store.schema import table_schema
from roadscan.surface.regions import MEASURED
from roadscan.surface.tile import GridWindow, SurfaceTile
from roadscan.tiles.lane_direction import LaneDirections
from roadscan.tiles.product import product_named

CELL_M = 0.005
HALO = 210
AROUND = 540
"""Cells that are seen before smoothing."""
WEST, SOUTH = TileId(553_211, 6_020_119), TileId(553_212, 6_020_119)
"""Tiles of 1 m, side by side."""
DRIVEN = LaneDirections.of_path([(WEST.column + x, WEST.row) for x in range(3)])
"""A drive to the east."""
DETECT = CrackDetection(max_width_m=0.02)


def ground(easting_m, northing_m):
    """A crack across both tiles and a pothole on their border, on a slope."""
    x, y = easting_m - WEST.column, northing_m - WEST.row
    crack = 0.01 * (np.abs(y - 0.31 - 0.1 * x) < 0.006)
    hole = 0.04 * np.clip(1 - ((x - 1.02) ** 2 + (y - 0.7) ** 2) / 0.15**2, 0, 1)
    return 300.0 + 0.02 * x - np.maximum(crack, hole)


def surface(tile):
    wide = GridWindow(tile.column * 200, tile.row * 200, 200, 200, CELL_M, CELL_M).grown(AROUND)
    around = heights(wide)
    seen = slice(AROUND - HALO, HALO - AROUND)
    height = np.ascontiguousarray(around[seen, seen])
    full = np.full(height.shape, MEASURED, np.uint8)
    window = wide.grown(HALO - AROUND)
    return SurfaceTile(tile, window, HALO, height, height, full, full.astype(np.float32), 0.0003, around_m=around)


def heights(window):
    east, north = window.nodes_m()
    row, column = np.indices((window.rows, window.columns))
    noise = ((row + window.first_row) * 7919 + (column + window.first_column) * 104_729) % 1009 / 1009 - 0.5
    return ground(east[None, :], north[:, None]) + 0.0006 * noise


class Files:
    """What the store holds of the tiles' pieces."""

    def __init__(self, product, options, context, folder):
        self.name, self.content = product.name, {}
        for tile in (WEST, SOUTH):
            path = folder / f"{product.name}-{tile}.parquet"
            product.write(surface(tile), options, context, path)
            product.check(path)
            self.content[tile] = path.read_bytes()

    def file(self, product, tile):
        assert product == self.name
        return self.content.get(tile)

    def lanes(self):
        return DRIVEN


def summaries(workshop, context, tiles):
    plain = workshop.survey([TileId(1, 1)], context, count=10).summaries[0]
    return [dataclasses.replace(plain, tile=t) for t in tiles]


def joined(product, options, files, tiles, context, path):
    (output,) = product.outputs([one.tile for one in tiles], options, context)
    product.write(output, tiles, files, options, context, path)
    product.check(path)
    return geopandas.read_parquet(path)


@pytest.fixture(scope="module")
def context(workshop):
    return workshop.context(MapFrame("EPSG:25832"), CELL_M, 1.0)


@pytest.fixture(scope="module")
def tiles(workshop, context):
    return summaries(workshop, context, [SOUTH, WEST])


@pytest.fixture(scope="module")
def crack_files(context, tmp_path_factory):
    return Files(CrackPieces(), DETECT, context, tmp_path_factory.mktemp("cracks"))


@pytest.fixture(scope="module")
def pothole_files(context, tmp_path_factory):
    return Files(PotholePieces(), PotholeDetection(), context, tmp_path_factory.mktemp("potholes"))


def test_a_crack_over_two_tiles_is_one(crack_files, tiles, context, tmp_path):
    frame = joined(Cracks(), CrackJoining(), crack_files, tiles, context, tmp_path / "cracks.parquet")
    assert frame.crs.to_epsg() == 25_832
    # its line may end up in the hole, whose far wall is no crack
    row = frame.loc[frame["length_m"].idxmax()]
    assert row["type"] == "longitudinal" and row["tiles"] == f"{WEST} {SOUTH}"
    assert row["azimuth_deg"] == pytest.approx(90 - math.degrees(math.atan(0.1)), abs=1.5)
    assert row["lane_angle_deg"] == pytest.approx(math.degrees(math.atan(0.1)), abs=1.5)
    assert row["depth_mean_m"] == pytest.approx(0.01, rel=0.1)
    assert row["length_m"] == pytest.approx(2 * math.hypot(1, 0.1), rel=0.01)
    assert row["line"].length == pytest.approx(row["length_m"], rel=0.01)
    assert row["line"].geom_type == "MultiLineString" and len(row["line"].geoms) == 1


def test_a_pothole_on_a_border_is_one(pothole_files, tiles, context, tmp_path):
    frame = joined(Potholes(), PotholeJoining(), pothole_files, tiles, context, tmp_path / "potholes.parquet")
    (row,) = frame.to_dict("records")
    assert row["tiles"] == f"{WEST} {SOUTH}"
    assert row["area_m2"] == pytest.approx(math.pi * 0.15**2 * 0.8, rel=0.06)
    assert row["volume_m3"] == pytest.approx(math.pi * 0.15**2 * 0.02 * 0.96, rel=0.06)
    assert row["outline"].area == pytest.approx(row["area_m2"])
    assert (row["easting_m"], row["northing_m"]) == pytest.approx((WEST.column + 1.02, WEST.row + 0.7), abs=0.01)


@pytest.mark.parametrize("name", ["cracks", "potholes"])
def test_columns_are_those_of_the_schema(name, tiles, context, tmp_path):
    product = product_named(name)

    class Nothing:
        def file(self, product, tile):
            return None

        def lanes(self):
            return DRIVEN

    path = tmp_path / "empty.parquet"
    assert len(joined(product, product.options(), Nothing(), tiles, context, path)) == 0
    written, expected = pq.read_schema(path), table_schema(name).arrow()
    assert written.names[:-1] == expected.names
    for field in expected:
        assert written.field(field.name).equals(field), field.name


def test_units_of_the_map_and_same_bytes(crack_files, context, tmp_path):
    feet = dataclasses.replace(context, map=MapFrame("EPSG:6539"))
    for name, of in (("a", context), ("b", context), ("c", feet)):
        CrackPieces().write(surface(WEST), DETECT, of, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == crack_files.content[WEST]
    metres, in_feet = (geopandas.read_parquet(tmp_path / name) for name in "ac")
    assert in_feet.length.sum() * 1200 / 3937 == pytest.approx(metres.length.sum())
    with pytest.raises(StoreError, match="cannot be read"):
        (tmp_path / "a").write_bytes(b"PAR1")
        CrackPieces().check(tmp_path / "a")


def test_coarse_cells_are_refused(context, tmp_path):
    whole = surface(WEST)
    with pytest.raises(ConfigError, match=r"'crack_pieces' got cells of 0\.005 × 0\.005 m and 20 of"):
        CrackPieces().write(dataclasses.replace(whole, halo=20), DETECT, context, tmp_path / "x")
    with pytest.raises(ConfigError, match=r"'pothole_pieces' got cells of 0\.06 m; expected at most block_m, 0\.05 m"):
        PotholePieces().check_cells(PotholeDetection(), (0.06, 0.06), 20)


def test_the_lane_runs_as_the_vehicle_drove():
    angle = np.radians(np.arange(0.0, 90.0, 0.5))  # a bend of 100 m, begun northwards; every metre or so
    path = 1000.0 + 100.0 * np.stack([1.0 - np.cos(angle), np.sin(angle)], axis=-1)
    standing = path[-1] + np.array([[0, 0.1], [0.2, 0], [0, 0], [0.1, 0.1], [0, 0]])
    found = LaneDirections.of_path(np.concatenate([path, standing]))
    assert len(found.azimuth_rad) == len(path) - 1
    beside = path + 3.0 * np.stack([np.cos(angle), -np.sin(angle)], axis=-1)
    np.testing.assert_allclose(found.at(beside[1:-1]), angle[1:-1], atol=np.radians(0.3))
    assert np.isnan(found.at([[0.0, 0.0]])).all()
    assert np.isnan(LaneDirections.of_path([]).at([[0.0, 0.0]])).all()
