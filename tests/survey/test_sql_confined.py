"""`roadscan sql` reaches the store and memory: whatever a statement tries, it writes no file and reads no other."""

from __future__ import annotations

import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import RoadscanError
from roadscan.store.query.sql import Limits, connect, query
from roadscan.store.query.sql_files import StoreFiles
from roadscan.store.store import Store
from tests.survey.test_damage import say
from tests.surveys import Simulated

SECRET = "nobody knows"
NORMAL = (
    "SHOW TABLES",
    "DESCRIBE returns",
    "SUMMARIZE trajectory",
    "SELECT count(*) AS n FROM returns",
    "SELECT count(*) AS n FROM returns_between(0, 4000000000000000000)",
    "SELECT run, sensor, min(gps_bin_s) FROM scans GROUP BY ALL",
    "SELECT count(*) FROM cells WHERE filename LIKE '%.parquet'",
    "SELECT product, count(*) FROM outputs GROUP BY product",
    "SELECT count(*) FROM rejects",
    "CREATE TABLE mine AS SELECT * FROM trajectory; INSERT INTO mine FROM trajectory; SELECT count(*) FROM mine",
    "EXPLAIN ANALYZE SELECT count(*) FROM returns",
    "PIVOT (SELECT sensor, laser FROM returns) ON sensor USING count(*)",
    "SELECT count(*) FROM glob('store://survey={id}/tables/**/*.parquet')",
    "SELECT count(*) FROM '{file}'",
    "SELECT count(*) FROM read_parquet('store://survey={id}/tables/packed_returns/**/*.parquet')",
)
READS = (
    "SELECT * FROM read_text('/etc/passwd')",
    "SELECT * FROM read_blob('{outside}')",
    "SELECT * FROM read_text('file:///etc/passwd')",
    "SELECT * FROM read_csv('{outside}')",
    "SELECT * FROM '{outside}'",
    "SELECT * FROM sniff_csv('{outside}')",
    "SELECT * FROM read_json('{outside}')",
    "SELECT * FROM parquet_metadata('{outside}')",
    "SELECT * FROM glob('{folder}/*')",
    "SELECT * FROM read_text('store://{outside}')",
    "SELECT * FROM read_text('store://survey={id}/../outside.csv')",
    "SELECT * FROM read_text('store://survey={id}/tables/../../../outside.csv')",
    "SELECT * FROM read_text('store://survey=other/secret.txt')",
    "SELECT * FROM read_text('store://survey={id}/link.csv')",
    "SELECT * FROM read_text('store://survey={id}/linked/outside.csv')",
    "SELECT * FROM read_csv('https://example.com/x.csv')",
    "SELECT * FROM read_parquet('s3://bucket/x.parquet')",
    "SELECT * FROM query('SELECT * FROM read_text(''{outside}'')')",
    "CREATE VIEW v AS SELECT * FROM read_text('{outside}')",
    "CREATE TABLE t (a VARCHAR); COPY t FROM '{outside}'",
    "IMPORT DATABASE '{folder}'",
    "SELECT getenv('HOME')",
    "SELECT * FROM store",
)
WRITES = (
    "COPY (SELECT 1) TO '{folder}/new.csv'",
    "COPY (SELECT 1) TO '/dev/stdout'",
    "COPY (SELECT 1) TO 'new.csv'",
    "COPY (SELECT 1 AS a) TO '{file}'",
    "COPY (SELECT 1 AS a) TO 'store://survey={id}/tables/new.parquet'",
    "COPY (SELECT 1 AS a) TO 'store://survey={id}/tables/new' (FORMAT parquet, PARTITION_BY a)",
    "WITH w AS (COPY (SELECT 1 AS a) TO '{file}') SELECT * FROM w",
    "EXPLAIN ANALYZE COPY (SELECT 1 AS a) TO '{file}'",
    "PREPARE p AS COPY (SELECT 1 AS a) TO '{file}'; EXECUTE p",
    "EXPORT DATABASE '{folder}/all'",
    "EXPORT DATABASE 'store://survey={id}/all'",
    "ATTACH '{folder}/new.db' AS n; CREATE TABLE n.t AS SELECT 1",
    "ATTACH 'store://survey={id}/new.db' AS n; CREATE TABLE n.t AS SELECT 1",
    "PRAGMA profiling_output = '{folder}/new.json'",
    "SET log_query_path = '{folder}/new.log'",
    "CALL enable_logging(storage = 'file', storage_config = {{'path': '{folder}/logs'}})",
    "SET temp_directory = '{folder}/spilt'",
)
DOORS = (
    "INSTALL httpfs",
    "/* quiet */ FORCE INSTALL httpfs FROM 'http://localhost:1'",
    "SELECT 1; INSTALL spatial FROM community",
    "UPDATE EXTENSIONS",
    "LOAD httpfs",
    "LOAD '{outside}'",
    "SET enable_external_access = true",
    "RESET enable_external_access",
    "SET lock_configuration = false",
    "SET disabled_filesystems = ''",
    "RESET disabled_filesystems",
    "SET allowed_directories = ['/']",
    "SET allowed_paths = ['{outside}']",
    "SET GLOBAL allow_unsigned_extensions = true",
    "SET autoinstall_known_extensions = true",
    "SET secret_directory = '{folder}'",
    "CREATE PERSISTENT SECRET s (TYPE s3)",
)


@pytest.fixture(scope="module")
def attacked(finished: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """A store with links that lead out of it, and a file beside it."""
    copy = finished.copy_with_store_to(tmp_path_factory.mktemp("attacked") / "survey")
    root = Path(copy.store().root)
    outside = root.parent / "outside.csv"
    outside.write_text(f"word\n{SECRET}\n")
    (root / "link.csv").symlink_to(outside)
    (root / "linked").symlink_to(root.parent)
    (root.parent / "survey=other").mkdir()
    (root.parent / "survey=other" / "secret.txt").write_text(SECRET)
    return copy


def filled(statement: str, copy: Simulated) -> str:
    store = copy.store()
    outside = Path(store.root).parent / "outside.csv"
    file = f"store://survey={store.survey_id}/{store.files('tables/trajectory', '.parquet')[0]}"
    return statement.format(outside=outside, folder=outside.parent, id=store.survey_id, file=file)


def all_files(folder: Path) -> dict[str, bytes]:
    return {str(f): f.read_bytes() for f in folder.rglob("*") if f.is_file() and not f.is_symlink()}


@pytest.mark.parametrize("statement", NORMAL)
def test_questions_to_the_store_are_answered(attacked: Simulated, statement: str) -> None:
    assert query(attacked.store(), filled(statement, attacked)).num_rows >= 1


@pytest.mark.parametrize("statement", [*READS, *WRITES, *DOORS])
def test_what_leads_out_is_refused(attacked: Simulated, statement: str, monkeypatch: pytest.MonkeyPatch) -> None:
    top = attacked.survey_file.parent
    monkeypatch.chdir(top)
    monkeypatch.setenv("HOME", str(top))
    before = all_files(top)
    with pytest.raises(RoadscanError) as raised:
        query(attacked.store(), filled(statement, attacked))
    after = all_files(top)
    after.pop(f"{attacked.store().root}/manifest/verified.parquet", None)
    before.pop(f"{attacked.store().root}/manifest/verified.parquet", None)
    assert after == before
    assert SECRET not in str(raised.value) and "Traceback" not in str(raised.value)


def test_a_link_inside_the_store_is_followed(attacked: Simulated) -> None:
    """One that stays inside is a file like others."""
    store = attacked.store()
    inside = Path(store.root) / "inside.parquet"
    inside.symlink_to(Path(store.path(store.files("tables/trajectory", ".parquet")[0])))
    try:
        (row,) = query(
            store, f"SELECT count(*) AS n FROM 'store://survey={store.survey_id}/inside.parquet'"
        ).to_pylist()
        assert row["n"] > 0
    finally:
        inside.unlink()


def test_a_store_behind_a_link_is_a_store(attacked: Simulated, tmp_path: Path) -> None:
    store = attacked.store()
    (tmp_path / "link").symlink_to(Path(store.root).parent)
    linked = Store(str(tmp_path / "link"), store.survey_id)
    assert query(linked, "SELECT count(*) AS n FROM returns") == query(store, "SELECT count(*) AS n FROM returns")


def test_unconfined_statements_read_and_write_but_fetch_nothing(attacked: Simulated, tmp_path: Path) -> None:
    outside, written = filled("{outside}", attacked), tmp_path / "mine.parquet"
    ask = ("sql", "--survey", attacked.survey_file, "--unconfined")
    code, words = say(*ask, f"COPY (SELECT word FROM '{outside}') TO '{written}'")
    assert code == 0 and pq.read_table(written).to_pydict() == {"word": [SECRET]}
    for statement in ("INSTALL httpfs", "/**/force install httpfs", "SELECT 1; UPDATE EXTENSIONS"):
        code, words = say(*ask, statement)
        assert code == 2 and "it fetches an extension" in words
    with connect(attacked.store(), unconfined=True) as connection:
        ((fetches,),) = connection.sql("SELECT current_setting('autoinstall_known_extensions')").fetchall()
    assert fetches is False


def test_the_command_says_what_it_refused_and_what_lifts_it(attacked: Simulated) -> None:
    for statement, reason in (
        ("SELECT * FROM read_text('/etc/passwd')", "has been disabled"),
        ("COPY (SELECT 1 AS a) TO '{file}'", "cannot be written: SQL only reads the store"),
        ("SELECT * FROM read_text('store://survey={id}/link.csv')", "is a link that leads out of the store"),
    ):
        code, words = say("sql", "--survey", attacked.survey_file, filled(statement, attacked))
        assert code == 2 and "the query was refused" in words and reason in words and "`--unconfined`" in words
        assert "root:" not in words


def test_statements_over_an_object_store_reach_that_store_alone() -> None:
    """Other objects of the same account, in the same process, included."""
    store = Store("memory://bucket/town", "s1")
    buffer = pa.BufferOutputStream()
    pq.write_table(pa.table({"a": [1, 2]}), buffer)
    store.write_bytes("products/tile_table/tiles.parquet", buffer.getvalue().to_pybytes())
    store.fs.pipe_file("/bucket/private.csv", b"word\n1\n")
    assert query(store, "SELECT sum(a) AS s FROM tiles").to_pylist() == [{"s": 3}]
    before = sorted(store.fs.find("/bucket"))
    for statement in (
        "SELECT * FROM read_csv('memory://bucket/private.csv')",
        "SELECT * FROM read_csv('store://survey=s1/../private.csv')",
        "SELECT * FROM read_text('/etc/passwd')",
        "COPY (SELECT 1 AS a) TO 'store://survey=s1/products/tile_table/tiles.parquet'",
        "COPY (SELECT 1 AS a) TO 'memory://bucket/town/survey=s1/products/new.parquet'",
    ):
        with pytest.raises(RoadscanError):
            query(store, statement)
    assert sorted(store.fs.find("/bucket")) == before
    assert query(store, "SELECT sum(a) AS s FROM tiles").to_pylist() == [{"s": 3}]
    store.fs.rm("/bucket", recursive=True)


def test_threads_that_share_a_file_read_each_its_own_bytes(tmp_path: Path) -> None:
    """DuckDB's threads seek and read a file that they share, in two calls."""
    content = bytes(range(256)) * 4096
    for store in (Store(str(tmp_path), "s1"), Store("memory://shared", "s1")):
        store.write_bytes("a.bin", content)
        shared = StoreFiles(store).open("store://survey=s1/a.bin")

        def at(start: int, shared: Any = shared) -> bool:
            for step in range(300):
                place = (start * 977 + step * 3001) % (len(content) - 5000)
                shared.seek(place)
                if shared.tell() != place or shared.read(5000) != content[place : place + 5000]:
                    return False
            return True

        with ThreadPoolExecutor(8) as threads:
            assert all(threads.map(at, range(32)))
        shared.close()
        assert shared.closed


def test_a_store_that_cannot_be_written_is_asked_all_the_same(attacked: Simulated, tmp_path: Path) -> None:
    copy = attacked.survey_file.parent
    shutil.copytree(copy, tmp_path / "survey", symlinks=True)
    note = Path(attacked.store().root) / "manifest" / "verified.parquet"
    held = tmp_path / "survey" / note.relative_to(copy)
    held.unlink(missing_ok=True)
    held.mkdir()  # nothing can be published under its name
    store = Simulated(tmp_path / "survey" / attacked.survey_file.name).store()
    assert query(store, "SELECT count(*) AS n FROM trajectory").num_rows == 1


ENDLESS = "SELECT count(*) FROM range(3000000) a, range(3000000) b WHERE a.range * b.range % 7 = 3"


def test_a_statement_is_stopped_after_its_time(finished: Simulated) -> None:
    started = time.perf_counter()
    with pytest.raises(RoadscanError, match=r"stopped after 0\.5 s.*--timeout"):
        query(finished.store(), ENDLESS, limits=Limits(time_s=0.5))
    assert time.perf_counter() - started < 8.0  # a hundred hours else


def test_the_command_takes_time_and_memory(finished: Simulated) -> None:
    code, text = say("sql", ENDLESS, "--survey", finished.survey_file, "--timeout", "0.5")
    assert (code, "stopped after 0.5 s" in text) == (2, True)
    code, text = say("sql", "SELECT * FROM range(100000000)", "--survey", finished.survey_file, "--memory", "0.1")
    assert (code, "the answer is larger than 0.1 GB" in text) == (2, True)


@pytest.mark.slow
@pytest.mark.parametrize("unconfined", [False, True])
def test_a_statement_takes_no_more_memory_than_it_is_given(finished: Simulated, unconfined: bool) -> None:
    """Groups of 0.5 GB, with 50 MB of memory and, where it may write, 200 MB of disk."""
    limits = Limits(memory_bytes=50_000_000)
    statement = "SELECT h, list(range) FROM (SELECT range, hash(range) AS h FROM range(30000000)) GROUP BY h LIMIT 1"
    with pytest.raises(RoadscanError, match="--memory"):
        query(finished.store(), statement, unconfined=unconfined, limits=limits)


def test_an_answer_has_a_bound_of_its_own(finished: Simulated) -> None:
    """DuckDB's bound does not count what has left it."""
    with pytest.raises(RoadscanError, match=r"the answer is larger than 0\.1 GB"):
        query(finished.store(), "SELECT * FROM range(2000000000)", limits=Limits(memory_bytes=100_000_000))
    answer = query(finished.store(), "SELECT * FROM range(1000000)", limits=Limits(memory_bytes=100_000_000))
    assert answer.column(0).to_pylist()[-1] == 999_999


@pytest.mark.slow
def test_what_is_spilt_is_bounded_and_removed(
    finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    statement = "SELECT count(*) FROM (SELECT hash(range) AS h FROM range(12000000) ORDER BY h LIMIT 10000000)"
    limits = Limits(memory_bytes=120_000_000)
    with pytest.raises(RoadscanError, match="--memory"):
        query(finished.store(), statement, limits=limits)
    answer = query(finished.store(), statement, unconfined=True, limits=limits)
    assert answer.column(0).to_pylist() == [10_000_000]
    assert not list(tmp_path.iterdir())


def test_what_fails_after_the_first_rows_is_an_error_of_roadscan(finished: Simulated, tmp_path: Path) -> None:
    """A file that is damaged, and time that is up, while rows come already."""
    store = finished.copy_with_store_to(tmp_path / "survey").store()
    last = Path(store.path(max(store.files("tiles/cells", ".parquet"))))
    last.write_bytes(last.read_bytes()[:-200])
    with pytest.raises(RoadscanError, match=r"roadscan verify"):
        query(store, "SELECT * FROM cells")
    with pytest.raises(RoadscanError, match=r"was stopped after 0\.3 s"):
        query(store, "SELECT range AS n FROM range(1_000_000_000_000)", limits=Limits(time_s=0.3))
