"""Tile table: GeoParquet for geopandas and pyogrio, plain columns for DuckDB, types of the schema."""

from __future__ import annotations

import json

import duckdb
import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileId
from roadscan.store.schema import table_schema
from roadscan.tiles.product import NoOptions, product_named
from roadscan.tiles.products.tile_table import TileTable


@pytest.fixture
def table() -> TileTable:
    return TileTable()


@pytest.fixture
def survey(workshop, place):
    tiles = [TileId(place.tile.column + c, place.tile.row + r) for c, r in ((2, 0), (0, 0), (0, 1), (-1, 5))]
    return workshop.survey(tiles, workshop.context(place.map), count=40)


def write(table, survey, path):
    options = NoOptions()
    (output,) = table.outputs(list(survey.tiles), options, survey.context)
    assert output.name == "tiles.parquet" and set(output.tiles) == set(survey.tiles)
    table.write(output, survey.summaries, survey.load_cells, options, survey.context, path)
    table.check(path)


def test_geopandas_reads_it(table, survey, place, tmp_path):
    path = tmp_path / "tiles.tmp"
    write(table, survey, path)
    frame = geopandas.read_parquet(path)
    assert frame["tile"].tolist() == [str(t) for t in sorted(survey.tiles)]
    by_tile = {one.tile: one for one in survey.summaries}
    for row in frame.itertuples():
        tile = TileId(row.tile_column, row.tile_row)
        one = by_tile[tile]
        assert (row.points, row.cells) == (one.points, one.cells) == (40, len(survey.tiles[tile].cells))
        assert row.area_m2 == pytest.approx(0.25 * one.cells)
        assert (row.height_min_m, row.height_mean_m, row.height_max_m) == (
            one.height_min_m,
            one.height_mean_m,
            one.height_max_m,
        )
        assert (row.height_std_median_m, row.intensity_mean) == (one.height_std_median_m, one.intensity_mean)
        assert list(row.passes) == [1, 2, 40_000]
        assert (row.first_epoch_gps_ns, row.last_epoch_gps_ns) == (one.first_epoch_gps_ns, one.last_epoch_gps_ns)
        west, south = tile.column * 10 / place.unit_m, tile.row * 10 / place.unit_m
        size = 10 / place.unit_m
        assert row.outline.bounds == pytest.approx((west, south, west + size, south + size), rel=1e-12)
        assert row.outline.exterior.is_ccw
    if place.map.crs is None:
        assert frame.crs is None
    else:
        assert frame.crs.to_epsg() == int(place.map.crs[5:])
    assert (
        frame.total_bounds.tolist() == json.loads(pq.read_schema(path).metadata[b"geo"])["columns"]["outline"]["bbox"]
    )


def test_columns_are_those_of_the_schema(table, survey, tmp_path):
    write(table, survey, tmp_path / "tiles")
    written = pq.read_schema(tmp_path / "tiles")
    expected = table_schema("tiles").arrow()
    assert written.names == [*expected.names, "outline"]
    for field in expected:
        assert written.field(field.name).equals(field), field.name
    assert table_schema("tiles").sort == ("tile_column", "tile_row")
    assert pq.ParquetFile(tmp_path / "tiles").metadata.num_row_groups == 1


def test_duckdb_reads_the_plain_columns(table, survey, tmp_path):
    path = tmp_path / "tiles.parquet"
    write(table, survey, path)
    with duckdb.connect(config={"autoinstall_known_extensions": "false", "autoload_known_extensions": "false"}) as db:
        total = db.execute(f"select sum(points), min(height_min_m), max(easting_min_m) from '{path}'").fetchone()
        with_pass = db.execute(f"select count(*) from '{path}' where list_contains(passes, 40000)").fetchone()
    summaries = survey.summaries
    assert total == (
        160,
        min(s.height_min_m for s in summaries),
        max(s.tile.column for s in summaries) * 10.0,
    )
    assert with_pass == (4,)


def test_same_tiles_give_same_bytes(table, survey, workshop, tmp_path):
    write(table, survey, tmp_path / "a.partial")
    again = workshop.survey(list(survey.tiles)[::-1], survey.context, count=40)
    write(table, again, tmp_path / "b")
    assert (tmp_path / "a.partial").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_survey_without_tiles_is_an_empty_table(table, workshop, places, tmp_path):
    write(table, workshop.survey([], workshop.context(places["utm_north"].map)), tmp_path / "tiles")
    assert len(geopandas.read_parquet(tmp_path / "tiles")) == 0


def test_damage_is_found(table, survey, tmp_path, damage):
    good, bad = tmp_path / "good", tmp_path / "bad"
    write(table, survey, good)
    whole, found = pq.read_table(good), 0
    for what, content in damage(good.read_bytes()):
        bad.write_bytes(content)
        try:
            table.check(bad)
        except StoreError as error:
            assert str(bad) in str(error)
            found += 1
            continue
        assert pq.read_table(bad).equals(whole), what  # a bit of the metadata
    assert found >= 10


def test_other_parquet_is_no_product(table, tmp_path):
    frame = geopandas.GeoDataFrame({"a": [1]}, geometry=geopandas.points_from_xy([1.0], [2.0]))
    frame.to_parquet(tmp_path / "foreign.parquet")
    with pytest.raises(StoreError, match="lacks 'tile'"):
        table.check(tmp_path / "foreign.parquet")


def test_area_is_that_of_the_outlines(table, survey, place, tmp_path):
    write(table, survey, tmp_path / "tiles")
    frame = geopandas.read_parquet(tmp_path / "tiles")
    assert np.allclose(frame.area * place.unit_m**2, 100.0, rtol=1e-6)
    assert isinstance(product_named("tile_table"), TileTable)
