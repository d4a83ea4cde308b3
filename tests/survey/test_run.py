"""Whole runs: the same bytes whatever the batching, nothing done twice, one fault costs one unit."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import duckdb
import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.cli.added_stages import _stated
from roadscan.core.errors import ConfigError, RunError
from roadscan.core.grid import Bounds, TileId
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.run.engine.compute import Inline
from roadscan.run.engine.compute_on import compute_on
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stages
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql import connect, query
from roadscan.store.store import Store
from roadscan.survey.status import survey_status, verify_store
from roadscan.tiles.stage import plan_tile_work
from roadscan.tiles.tasks.tile_plan import Block
from roadscan.tiles.tasks.tile_points import load_points
from tests.conftest import REPOSITORY
from tests.surveys import Simulated, changed, outputs

LONGEST_S = 2.6
"""Processor time within which a run is killed: one that has nothing to do takes 1 s, a whole one 4.5 s."""


def assert_same_files(a: Store, b: Store) -> None:
    one, other = outputs(a), outputs(b)
    assert sorted(one) == sorted(other)
    assert [p for p in one if one[p] != other[p]] == []


@pytest.mark.slow
@pytest.mark.parametrize(("edge", "limit"), [(1, 20_000_000), (16, 100_000)])
def test_block_size_changes_no_byte(finished: Simulated, edge: int, limit: int) -> None:
    name = f"store-{edge}-{limit}"
    finished.run(name, tiles__block_tiles=edge, tiles__max_block_readings=limit)
    assert_same_files(finished.store(), finished.store(name))


@pytest.mark.slow
def test_shuffled_row_groups_change_no_byte(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    for file in copy.survey_file.parent.glob("raw/*/profiler_*.parquet"):
        source = pq.ParquetFile(file)
        rows = source.read()
        parts = [rows.slice(k, 32) for k in range(0, rows.num_rows, 32)]
        random.Random(3).shuffle(parts)
        with pq.ParquetWriter(file, rows.schema) as writer:
            for part in parts:
                writer.write_table(part)
    copy.run()
    assert_same_files(finished.store(), copy.store())


@pytest.mark.slow
def test_shuffled_row_groups_of_the_tables_change_no_byte(finished: Simulated, tmp_path: Path) -> None:
    """Ties included: a whole sweep of returns is put at one epoch before."""
    copy = finished.copy_to(tmp_path / "survey")
    survey = Survey.load(copy.survey_file)
    results = []
    for name, shuffled in (("a", False), ("b", True)):
        store = copy.store(f"store-{name}")
        ingest(survey, store)
        for record in read_log_records(store):
            for file in record.tables.get("returns", ()):
                path = store.path(file.path)
                rows = pq.read_table(path, partitioning=None)
                tied = rows.column("epoch_gps_ns").to_numpy() // 50_000_000 * 50_000_000
                rows = rows.set_column(0, rows.schema.field(0), [tied])
                if shuffled:
                    rows = rows.take(np.random.default_rng(0).permutation(rows.num_rows))
                    rows = rows.take(np.argsort(rows.column("epoch_gps_ns").to_numpy(), kind="stable"))
                pq.write_table(rows, path, row_group_size=file.group_rows[0])
        copy.run(f"store-{name}")
        results.append(outputs(store))
    assert results[0] == results[1]


@pytest.mark.slow
@pytest.mark.parametrize("times", [4, pytest.param(10, marks=pytest.mark.nightly)])
def test_killed_and_resumed_at_random_points(finished: Simulated, tmp_path: Path, times: int) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    command = [sys.executable, "-m", "tests.survey.killed_run", "run", str(copy.survey_file), "--workers", "0"]
    chance = random.Random(11)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as runs:
        assert runs.stdin is not None and runs.stdout is not None
        kills = 0
        while kills < times:
            print(chance.uniform(0.0, LONGEST_S), file=runs.stdin, flush=True)
            if (ended := runs.stdout.readline().strip()) == "killed":
                kills += 1
                _nothing_half_written(copy.store())
                continue
            assert ended == "0"
            copy.store().remove("manifest/outputs")  # finished too soon: begin again, to be killed so many times in all
        print(1e9, file=runs.stdin, flush=True)
        assert runs.stdout.readline().strip() == "0"
        runs.stdin.close()
    assert_same_files(finished.store(), copy.store())
    assert verify_store(copy.store()) == []


def _nothing_half_written(store: Store) -> None:
    """Every visible table and product opens; what the manifest lists is there in its size."""
    for path in store.files("tiles/cells", ".parquet") + store.files("tables", ".parquet"):
        pq.read_metadata(store.path(path))
    for path in store.files("tiles/las"):
        with laspy.open(store.path(path)) as reader:
            assert reader.header.point_count > 0
    for record in Manifest(store).all():
        if record.path:
            assert store.size(record.path) == record.bytes


def test_second_run_does_nothing(finished: Simulated) -> None:
    store = finished.store()
    before = {p: store.fs.modified(store.path(p)) for p in outputs(store)}
    run = finished.run()
    assert run.raw_bytes_read == 0
    stages = (
        "ingest:",
        "navigate:",
        "footprints:",
        "video_frames:",
        "picture_ties:",
        "adjust:",
        "strips:",
        "tiles:",
        "pictures:",
        "surfaces:",
        "products:",
        "condition:",
        "assets:",
        "colours:",
    )
    assert all(line.startswith(("known:", "report:", *stages)) for line in _lines(run))
    assert {p: store.fs.modified(store.path(p)) for p in outputs(store)} == before
    assert survey_status(Session(Survey.load(finished.survey_file), store)).is_complete


@pytest.mark.parametrize(
    ("command", "said"), [("navigate", "no trajectory to compute"), ("clocks", "no clock to estimate")]
)
def test_what_has_nothing_to_do_says_so(finished: Simulated, command: str, said: str) -> None:
    assert said in CliRunner().invoke(app, [command, str(finished.survey_file)]).output


def test_reprocessing_a_tile_reads_little_and_gives_the_same_bytes(finished: Simulated) -> None:
    store = finished.store()
    before = outputs(store)
    tiles = [TileId.parse(u) for u, r in Manifest(store).of("tile").items() if r.path]
    run = finished.run(selection=Selection(named=(tiles[0],)))
    whole = sum(f.bytes for r in read_log_records(store) for t in r.tables for f in r.tables[t])
    assert 0 < run.raw_bytes_read < whole
    assert outputs(store) == before


def test_selections(finished: Simulated) -> None:
    store = finished.store()
    tile = TileId.parse(next(u for u, r in Manifest(store).of("tile").items() if r.path))
    inner = Bounds(tile.column * 10 + 1, tile.row * 10 + 1, tile.column * 10 + 2, tile.row * 10 + 2)
    assert finished.run(selection=Selection(box=inner)).raw_bytes_read > 0
    with pytest.raises(ConfigError, match="no reading touches tile 1_1"):
        finished.run(selection=Selection(named=(TileId(1, 1),)))
    with pytest.raises(ConfigError, match="no tile with readings"):
        finished.run(selection=Selection(span_gps_ns=(0, 1)))
    assert survey_status(
        Session(Survey.load(finished.survey_file), store)
    ).is_complete  # a refused choice is no failure


@pytest.mark.slow
def test_a_damaged_data_file_costs_its_tiles_only(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    record = next(r for r in read_log_records(store) if r.sensor == "profiler_left")
    path = Path(store.path(record.tables["scans"][0].path))
    whole = path.read_bytes()
    path.write_bytes(whole[:3000] + bytes(500) + whole[3500:])
    assert any("the content has changed" in f for f in verify_store(store))
    store.remove("tiles/las")
    with pytest.raises(RunError, match=r"units failed: tiles \d+_\d+: .*profiler_left.*cannot be read") as caught:
        copy.run()
    assert "the next run does only these" in str(caught.value)
    status = survey_status(Session(Survey.load(copy.survey_file), store))
    assert 0 < status.of("tiles").stale < status.of("tiles").current + status.of("tiles").stale
    assert len(status.failures) == status.of("tiles").stale
    path.write_bytes(whole)
    copy.run()
    assert_same_files(finished.store(), store)
    assert verify_store(store) == []


def test_a_changed_setting_makes_stale_what_depends_on_it(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    before = outputs(store)
    run = copy.run(products__options={"las": {"compress": False}})
    assert run.raw_bytes_read > 0
    after = outputs(store)
    assert not any(p.endswith(".laz") for p in after)
    cells = [p for p in before if p.startswith("tiles/cells")]
    assert all(after[p] == before[p] for p in cells)


def test_ingesting_twice_adds_nothing_and_a_new_clock_replaces(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    survey = Survey.load(copy.survey_file)
    store = copy.store()
    assert all(r.fresh for r in ingest(survey, store))
    files = store.files("tables")
    assert not any(r.fresh for r in ingest(survey, store))
    assert store.files("tables") == files
    text = copy.survey_file.read_text()
    late = text.replace('system = "utc_hour"', 'system = "utc_hour", offset_s = 0.25')
    copy.survey_file.write_text(late)
    again = ingest(Survey.load(copy.survey_file), store)
    moved = [r.record for r in again if r.fresh]
    assert {r.format for r in moved} == {"velodyne_pcap"}
    assert len(read_log_records(store)) == len(again)
    assert store.files("superseded/manifest/logs")


def test_files_open_with_other_programs(finished: Simulated) -> None:
    store = finished.store()
    table = duckdb.sql(f"SELECT count(*), sum(points) FROM '{store.path('products/tile_table')}/*.parquet'").fetchall()[
        0
    ]
    counts = []
    for path in store.files("tiles/las"):
        las = laspy.read(store.path(path))
        counts.append(las.header.point_count)
        assert str(las.header.version) == "1.4"
        assert set(np.unique(las.point_source_id)) <= {1, 2}
        assert las.header.parse_crs().to_2d().to_epsg() == 32632
    assert table == (len(counts), sum(counts))
    with rasterio.open(store.path("products/mosaic/height.tif")) as raster:
        assert raster.crs.to_epsg() == 32632
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        heights = raster.read(1)
    cells = query(store, "SELECT count(*) AS n, avg(height_robust_m) AS h FROM cells").to_pylist()[0]
    assert np.isfinite(heights).sum() == cells["n"]
    assert np.nanmean(heights.astype(np.float64)) == pytest.approx(cells["h"], abs=1e-4)


def test_a_halo_adds_neighbours_and_changes_no_core_tile(finished: Simulated) -> None:
    manifest = Manifest(finished.store())
    work = plan_tile_work(Session(Survey.load(finished.survey_file), finished.store(), Inline()))
    tiles = [TileId.parse(u) for u, r in manifest.of("tile").items() if r.path]  # those with points
    inner = next(t for t in tiles if TileId(t.column + 1, t.row) in tiles)
    (alone,) = work.planned.singly([inner])
    with_halo = work.planned.task(Block((inner,), halo_tiles=1))
    assert with_halo.keys == alone.keys
    a, b = dict(load_points(alone)), dict(load_points(with_halo))
    assert list(a) == [inner]
    assert TileId(inner.column + 1, inner.row) in b
    for name, value in vars(a[inner]).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, getattr(b[inner], name)), name


@pytest.mark.slow
def test_las_and_cells_agree(finished: Simulated) -> None:
    """The same points, counted and averaged once more by NumPy from the LAS file (written to 10 µm for this)."""
    finished.run("store-fine", products__make=["las"], products__options={"las": {"scale_m": 0.00001}})
    store = finished.store("store-fine")
    unit = max((r for r in Manifest(store).of("tile").values() if r.path), key=lambda r: r.figures()["points"]).unit
    las = laspy.read(next(store.path(p) for p in store.files("tiles/las") if unit in p))
    column, row = (int(v) for v in unit.split("_"))
    x, y, z = (np.rint(np.array(v) * 1e5).astype(np.int64) for v in (las.x, las.y, las.z))
    cell = (y - row * 1_000_000) // 5000 * 200 + (x - column * 1_000_000) // 5000
    cells = pq.read_table(store.path(f"tiles/cells/{unit}.parquet"))
    flat = cells.column("row").to_numpy().astype(int) * 200 + cells.column("column").to_numpy()
    counts = np.bincount(cell, minlength=40_000)
    assert np.array_equal(np.flatnonzero(counts), flat)
    assert np.array_equal(counts[flat], cells.column("count").to_numpy())
    sums = np.bincount(cell, weights=z - z.min(), minlength=40_000)[flat]
    mean = (z.min() + sums / counts[flat]) * 1e-5
    np.testing.assert_allclose(mean, cells.column("height_mean_m").to_numpy(), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_run_keeps_a_second_one_out(finished: Simulated) -> None:
    command = [sys.executable, "-m", "roadscan", "run", str(finished.survey_file), "--workers", "0"]
    with finished.store().lock():
        found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert "is working on this store" in found.stderr
    assert "Traceback" not in found.stderr


HEAVY = {
    "boto3", "dask", "distributed", "geopandas", "laspy", "matplotlib", "numba", "prefect", "rasterio", "requests",
    "scipy.interpolate", "scipy.linalg", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.sparse",
    "scipy.spatial", "scipy.special", "scipy.stats",
}  # fmt: skip
LOADED = """
import runpy, sys
sys.argv = ["roadscan", *sys.argv[1:]]
try:
    runpy.run_module("roadscan", run_name="__main__")
finally:
    print(*sys.modules, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "more", "less"),
    [
        (["--help"], {"numpy", "pandas", "pyarrow", "pyproj"}, set()),
        (["adjust", "--help"], {"numpy", "pandas", "pyarrow", "pyproj"}, set()),
        (["inspect", "CONTROL"], {"pandas"}, set()),
        (["sql", "SHOW TABLES", "--survey", "SURVEY"], {"pandas", "roadscan.formats.ros.topics"}, set()),
        (["status", "SURVEY"], {"llvmlite", "pandas", "roadscan.formats.ros.topics"}, set()),
    ],
)
def test_a_command_imports_no_library_that_it_does_not_use(
    command: list[str], more: set[str], less: set[str], finished: Simulated, tmp_path: Path
) -> None:
    """Seconds are not counted, which a busy machine stretches: these libraries take most of them.

    Which module holds a format is found once for new sources, by the first command that asks: so each runs twice.
    """
    control = tmp_path / "control.csv"
    control.write_text("name,easting_m,northing_m,height_m\nP1,691015.1,5335013.4,560.3\n", encoding="utf-8")
    files = {"CONTROL": str(control), "SURVEY": str(finished.survey_file)}
    words = [files.get(word, word) for word in command]
    for _ in range(2):
        found = subprocess.run([sys.executable, "-c", LOADED, *words], capture_output=True, text=True, check=False)
    loaded = set(found.stderr.splitlines()[-1].split())
    assert "roadscan.cli.added_stages" in loaded
    assert found.stdout and "leaked" not in found.stderr
    assert loaded & ((HEAVY | more) - less) == set()


def test_the_help_of_a_stage_is_its_title() -> None:
    """It is read from the text of its file."""
    known = {one.name: one.title for one in stages() if type(one).__module__.startswith("roadscan.")}
    assert _stated() == known


def test_fewer_than_no_workers_are_refused() -> None:
    with pytest.raises(ConfigError, match="-1 workers; expected 0"), compute_on(-1):
        pass


def test_a_pipe_that_knows_few_letters_gets_the_others_replaced() -> None:
    environment = os.environ | {"PYTHONIOENCODING": "latin-1"}
    command = [sys.executable, "-m", "roadscan", "formats"]
    found = subprocess.run(command, capture_output=True, check=True, env=environment)
    first, line, *rows = found.stdout.decode("latin-1").splitlines()
    assert (first.split(), set(line)) == (["format", "yields", "what"], {"?", " "})
    assert any(row.startswith("velodyne_pcap ") for row in rows)


def _lines(run: object) -> list[str]:
    return run.reporter.lines  # type: ignore[attr-defined]


@pytest.mark.slow
def test_one_missing_log_does_not_keep_the_others_out(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    lidar = copy.survey_file.parent / "raw/run-1/lidar.pcap"
    lidar.rename(tmp_path / "elsewhere.pcap")
    with pytest.raises(
        RunError, match=r"1 of 9 logs could not be ingested: .*run-1/lidar.pcap: the log does not exist"
    ):
        copy.run()
    assert len(read_log_records(copy.store())) == 8
    assert not survey_status(Session(Survey.load(copy.survey_file), copy.store())).is_complete
    (tmp_path / "elsewhere.pcap").rename(lidar)
    copy.run()
    assert_same_files(finished.store(), copy.store())


def test_raw_logs_may_be_archived_once_they_are_ingested(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.run()  # logs are known by their place
    (copy.survey_file.parent / "raw").rename(tmp_path / "archive")
    assert copy.run(products__make=["las", "tile_table"]).failures == []
    assert survey_status(Session(Survey.load(copy.survey_file), copy.store())).failures == []


@pytest.mark.slow
def test_a_tile_that_could_not_be_made_again_counts_as_stale(
    finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    unit = next(u for u, r in Manifest(store).of("tile").items() if r.path)

    def broken(*_: object) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr("roadscan.tiles.accumulator.cells_of", broken)
        with pytest.raises(RunError, match=rf"tiles {unit}: OSError: disk full"):
            copy.run(selection=Selection(named=(TileId.parse(unit),)))
    assert survey_status(Session(Survey.load(copy.survey_file), store)).of("tiles").stale == 1
    copy.run()
    assert_same_files(finished.store(), store)


@pytest.mark.slow
def test_files_that_a_stopped_run_had_not_recorded_go_with_the_next(
    finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    unit = next(u for u, r in Manifest(store).of("tile").items() if r.path)
    beside = store.path("products/calibration/calibration.txt")
    store.fs.makedirs(store.fs._parent(beside))
    store.fs.pipe_file(beside, b"of no product")

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Manifest, "add_packed", stopped)
        with pytest.raises(KeyboardInterrupt):
            copy.run(selection=Selection(named=(TileId.parse(unit),)), products__make=["pavement_intensity"])
    assert any(path.startswith("tiles/pavement_intensity/") for path in store.files("tiles"))
    copy.run()
    store.remove("products/calibration/calibration.txt")
    assert_same_files(finished.store(), store)


@pytest.mark.slow
def test_a_log_listed_twice_adds_nothing(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    raw = copy.survey_file.parent / "raw/run-1"
    (raw / "again.pcap").write_bytes((raw / "lidar.pcap").read_bytes())
    survey = Survey.load(copy.survey_file).config.model_dump(mode="json")
    logs = survey["runs"][0]["logs"]
    logs += [
        {**log, "path": path}
        for log in logs
        if log["sensor"] == "lidar"
        for path in (log["path"], "raw/run-1/again.pcap")
    ]
    copy.run(runs=survey["runs"])
    assert_same_files(finished.store(), copy.store())


@pytest.mark.slow
def test_adding_a_run_leaves_the_tiles_of_others_alone(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    runs = Survey.load(copy.survey_file).config.model_dump(mode="json")["runs"]
    for run in runs:  # on so short a road every tile is within reach of both runs' lidars
        run["logs"] = [log for log in run["logs"] if log["sensor"] != "lidar"]
    copy.run(runs=runs[:1], passes=[])
    before = {u: r.key for u, r in Manifest(copy.store()).of("tile").items()}
    both = changed(Survey.load(copy.survey_file), {"runs": runs, "passes": []})
    ingest(both, copy.store())
    told = survey_status(Session(both, copy.store()))
    profilers = sum(len(run["logs"]) - 1 for run in runs[1:])  # of each a data file, and its clock by ticks
    assert (told.of("footprints").stale, told.is_complete) == (2 * profilers, False)
    copy.run(runs=runs, passes=[])
    assert survey_status(Session(both, copy.store())).is_complete
    after = {u: r.key for u, r in Manifest(copy.store()).of("tile").items()}
    assert any(after[u] == key for u, key in before.items())
    swapped = copy.run("store-b", runs=runs[::-1], passes=[])
    copy.run(runs=runs[::-1], passes=[])
    assert_same_files(copy.store(), copy.store("store-b"))
    assert swapped.failures == []


@pytest.mark.slow
def test_a_tile_that_a_filter_empties_loses_its_files(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    record = max((r for r in Manifest(copy.store()).of("tile").values() if r.path), key=lambda r: r.figures()["points"])
    column, row = (int(v) for v in record.unit.split("_"))
    line = (
        f'{{"type":"LineString","coordinates":[[{column * 10 + 4},{row * 10 + 5}],[{column * 10 + 6},{row * 10 + 5}]]}}'
    )
    crs = '"crs":{"type":"name","properties":{"name":"urn:ogc:def:crs:EPSG::32632"}}'
    feature = (
        f'{{"type":"FeatureCollection",{crs},"features":[{{"type":"Feature","properties":{{}},"geometry":{line}}}]}}'
    )
    (copy.survey_file.parent / "line.geojson").write_text(feature)
    filters = {"filters__centre_line": "line.geojson", "filters__centre_line_buffer_m": 3.0}
    copy.run(**filters)
    copy.run("store-b", **filters)
    assert len(copy.store().files("tiles/las")) == 1
    assert_same_files(copy.store(), copy.store("store-b"))


@pytest.mark.slow
def test_a_damaged_or_missing_product_is_made_again(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store, survey = copy.store(), Survey.load(copy.survey_file)
    path = Path(store.path(store.files("tiles/las")[0]))
    whole = path.read_bytes()
    path.write_bytes(whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:])
    assert [f for f in verify_store(store) if path.name in f and "the next run makes it again" in f]
    store.remove("products/mosaic")
    assert not survey_status(Session(survey, store)).is_complete
    copy.run()
    assert survey_status(Session(survey, store)).is_complete
    assert verify_store(store) == []
    assert_same_files(finished.store(), store)


def test_a_statement_of_tables_that_a_run_made_opens_no_log(finished: Simulated) -> None:
    """The same answers as with all views; who reads a log's table, a macro or the list of tables gets all of them."""
    store, asked = finished.store(), []

    def logs() -> list[str]:
        asked.append(1)
        return [record.key for record in read_log_records(store)]

    def answer(statement: str) -> list[dict[str, Any]]:
        asked.clear()
        return query(store, statement, logs).to_pylist()

    with connect(store) as connection:
        everything = {
            statement: connection.sql(statement).to_arrow_table().to_pylist()
            for statement in (
                "WITH a AS (SELECT * FROM cells) SELECT count(*), max(points) FROM a, tiles",
                "SELECT (SELECT count(*) FROM tiles) FROM footprints LIMIT 1",
            )
        }
        views = connection.sql("SELECT view_name FROM duckdb_views() WHERE NOT internal ORDER BY 1").fetchall()
    for statement, rows in everything.items():
        assert answer(statement) == rows
        assert not asked
    assert answer("SELECT count(*) AS n FROM trajectory")[0]["n"] > 0
    assert asked
    answer("SELECT count(*) FROM tiles, trajectory_between(0, 1)")
    assert asked
    listed = answer("SELECT DISTINCT view_name FROM tiles, duckdb_views() WHERE NOT internal ORDER BY 1")
    assert [row["view_name"] for row in listed] == [name for (name,) in views]


@pytest.mark.slow
def test_sql_shows_the_logs_of_the_survey_only(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    sbet = copy.survey_file.parent / "raw/run-1/trajectory.sbet"
    sbet.write_bytes(sbet.read_bytes()[:-136])
    copy.run()
    command = [sys.executable, "-m", "roadscan", "sql", "--csv", "--survey", str(copy.survey_file)]
    asked = "SELECT count(*) = count(DISTINCT epoch_gps_ns) AS once FROM trajectory"
    found = subprocess.run([*command, asked], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ['"once"', "true"]
