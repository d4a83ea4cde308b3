"""Files of cells and overviews, read by other programs and back."""

from __future__ import annotations

from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.core.grid import TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.ingest.inspect.inspect import inspect
from roadscan.store.codecs.parquet.tables import Lists, write_number_groups
from roadscan.store.manifest import OutputRecord
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.accumulator import cells_of
from roadscan.tiles.cells import (
    TileCells,
    overview_factors,
    pyramid_of,
    read_cells,
    read_overview,
    write_cells,
    write_overviews,
)

GRID = TileGrid(10.0, 0.125)
ALWAYS = ["column", "row", "count", "height_robust_m", "intensity_mean"]


@pytest.fixture(scope="module")
def cells() -> TileCells:
    rng = np.random.default_rng(5)
    n = 20_000
    return cells_of(
        TilePoints(
            tile=TileId(-3, 7),
            x_quanta=rng.integers(0, 1_000_000, n).astype(np.int32),
            y_quanta=rng.integers(0, 600_000, n).astype(np.int32),
            height_quanta=rng.integers(40_000_000, 40_003_000, n).astype(np.int32),
            epoch_gps_ns=np.arange(n),
            intensity=rng.integers(0, 65_536, n).astype(np.uint16),
            classification=np.ones(n, np.uint8),
            pass_id=rng.integers(1, 4, n).astype(np.uint16),
        ),
        GRID,
    )


def stored(folder: Path, cells: TileCells, columns: str) -> tuple[Store, OutputRecord]:
    store = Store(str(folder), "yard")
    with store.scratch() as scratch:
        write_cells(scratch / "cells", cells, columns)
        store.publish(scratch / "cells", "tiles/cells/t.parquet")
    return store, OutputRecord("tile", str(cells.tile), "key", "tiles/cells/t.parquet", 0, "", "")


def test_full_cells_come_back_to_the_bit(cells, tmp_path):
    store, record = stored(tmp_path, cells, "full")
    back = read_cells(store, record, cells.cells_per_edge)
    for name, value in vars(cells).items():
        given = vars(back)[name]
        assert np.array_equal(given, value) and np.asarray(given).dtype == np.asarray(value).dtype, name
    path = store.path(record.path)
    rows = duckdb.sql(f"SELECT * FROM read_parquet('{path}', hive_partitioning = false)").fetchnumpy()
    assert list(rows) == [c.name for c in table_schema("cells").columns]
    assert np.array_equal(np.concatenate(rows["passes"]), cells.pass_ids)
    assert np.array_equal([len(one) for one in rows["passes"]], cells.pass_count)
    for name in ("height_mean_m", "height_std_m", "pass_count"):
        assert np.array_equal(rows[name], getattr(cells, name)), name


@pytest.mark.parametrize("sizes", [[1, 1, 1], [2, 2], [3, 1, 0, 2], [0, 0], [0, 5], list(range(40))])
def test_lists_of_any_size_are_read_by_other_programs(sizes, tmp_path):
    values = np.arange(sum(sizes), dtype=np.uint16) * 7
    kind = pa.list_(pa.field("element", pa.uint16(), nullable=False))
    schema = pa.schema([pa.field("n", pa.int32(), nullable=False), pa.field("ids", kind, nullable=False)])
    groups = [{"n": np.array(sizes, np.int32), "ids": Lists(np.array(sizes), values)}]
    write_number_groups(tmp_path / "a.parquet", schema, groups)
    cuts = np.split(values, np.cumsum(sizes)[:-1])
    for rows in (
        pq.read_table(tmp_path / "a.parquet", page_checksum_verification=True),
        duckdb.sql(f"SELECT * FROM '{tmp_path / 'a.parquet'}'").to_arrow_table(),
    ):
        assert rows["ids"].to_pylist() == [one.tolist() for one in cuts] and rows["n"].to_pylist() == sizes


def test_surface_has_place_count_height_and_intensity(cells, tmp_path):
    store, record = stored(tmp_path, cells, "surface")
    path = store.path(record.path)
    rows = duckdb.sql(f"SELECT * FROM read_parquet('{path}', hive_partitioning = false)").fetchnumpy()
    assert list(rows) == ALWAYS
    for name in ("column", "row", "count"):
        assert np.array_equal(rows[name], getattr(cells, name)), name
    assert np.abs(rows["height_robust_m"] - cells.height_robust_m).max() <= 2.0**-21
    assert not np.any(rows["height_robust_m"] % 2.0**-20)
    assert np.abs(rows["intensity_mean"] - cells.intensity_mean).max() <= 2.0**-7 + 65_536 * 2.0**-24
    assert inspect(Path(path)).what == "a Parquet table: roadscan's table cells"
    back = read_cells(store, record, cells.cells_per_edge)
    assert (
        np.isnan(back.height_std_m).all() and not back.pass_count.any() and back.pass_offsets.shape == (len(cells) + 1,)
    )
    assert all(np.array_equal(getattr(back, name), rows[name]) for name in ALWAYS)
    assert {n: v.dtype for n, v in vars(back).items() if isinstance(v, np.ndarray)} == {
        n: v.dtype for n, v in vars(cells).items() if isinstance(v, np.ndarray)
    }


def test_columns_that_may_be_left_out_are_those_that_are():
    assert [c.name for c in table_schema("cells").columns if not c.nullable] == ALWAYS


@pytest.mark.parametrize("columns", ["full", "surface"])
def test_same_cells_give_same_bytes(cells, columns, tmp_path):
    for name in ("one", "two"):
        write_cells(tmp_path / name, cells, columns)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_one_overview_is_read_without_the_others(cells, tmp_path):
    levels = pyramid_of(cells, overview_factors(cells.cells_per_edge))
    assert [level.factor for level in levels] == [2, 8, 40]
    store, record = (
        Store(str(tmp_path), "yard"),
        OutputRecord("overviews", "-3_7", "k", "tiles/overviews/t.parquet", 0, ""),
    )
    with store.scratch() as scratch:
        write_overviews(scratch / "overviews", levels)
        store.publish(scratch / "overviews", "tiles/overviews/t.parquet")
    assert pq.read_metadata(store.path("tiles/overviews/t.parquet")).num_row_groups == 3
    for level in levels:
        back = read_overview(store, record, level.factor)
        for name in ("column", "row", "count", "cells"):
            assert np.array_equal(getattr(back, name), getattr(level, name)), name
        assert np.abs(back.height_m - level.height_m).max() <= 2.0**-21
        assert np.abs(back.intensity - level.intensity).max() <= 2.0**-7 + 65_536 * 2.0**-24
    total = duckdb.sql(
        f"SELECT factor, sum(count)::BIGINT FROM '{store.path('tiles/overviews/t.parquet')}' GROUP BY 1 ORDER BY 1"
    ).fetchall()
    assert total == [(2, 20_000), (8, 20_000), (40, 20_000)]
    with pytest.raises(StoreError, match="no overview of 16 cells a pixel; expected 2, 8, 40"):
        read_overview(store, record, 16)
