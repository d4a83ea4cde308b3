"""Damaged tables: SQL says of its answer what is wrong with it, and `verify --repair` reads the logs again."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from roadscan.core.errors import RoadscanError, StoreError
from roadscan.store.logs import copy_path, read_log_records, record_path
from roadscan.store.query.sql import query
from roadscan.store.schema import table_schema
from roadscan.store.small_tables import small_path, write_small
from roadscan.store.store import Store
from roadscan.store.verified import Stamp
from roadscan.survey.status import verify_store
from tests.survey.test_damage import MAKE, say
from tests.surveys import Simulated, outputs

OPENED = {
    "returns": "tables/packed_returns",
    "scans": "tables/scans",
    "trajectory": "tables/trajectory",
    "cells": "tiles/cells",
    "overviews": "tiles/overviews",
    "footprints": "tables/footprints",
    "tiles": "products/tile_table",
    "corrections": "tables/corrections",
}
"""Views and where their files lie."""
PLACES = (5, 0.35, 0.75, -300, -60, -9)
"""Bytes that are flipped: numbers from either end, or shares of the file."""


@pytest.fixture(scope="module")
def whole(finished: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """A store with files of all kinds that SQL opens, made by a run."""
    copy = finished.copy_with_store_to(tmp_path_factory.mktemp("whole") / "survey")
    copy.run(**MAKE)
    values = {"string": "run-1", "int64": 0, "float64": 0.5}
    write_small(copy.store(), "corrections", [{c.name: values[c.type] for c in table_schema("corrections").columns}])
    return copy


def flip(file: Path, place: float) -> None:
    """Change a byte of a file where it lies."""
    size = file.stat().st_size
    at = int(place * size) if isinstance(place, float) else place % size
    with file.open("r+b") as stream:
        stream.seek(at)
        byte = stream.read(1)[0]
        stream.seek(at)
        stream.write(bytes([byte ^ 0x24]))


def largest(store: Store, folder: str) -> Path:
    return max((Path(store.path(p)) for p in store.files(folder, ".parquet")), key=lambda f: f.stat().st_size)


def rows(store: Store, view: str, damaged: list[StoreError]) -> str:
    """Number and hash of all rows of a view."""
    return str(query(store, f"SELECT count(*), bit_xor(hash(one)) FROM {view} AS one", damaged=damaged).to_pylist())


@pytest.mark.slow
@pytest.mark.parametrize("view", sorted(OPENED))
def test_no_flipped_byte_makes_a_silent_answer(whole: Simulated, view: str) -> None:
    store = whole.store()
    file = largest(store, OPENED[view])
    content, right = file.read_bytes(), rows(store, view, [])
    try:
        for place in PLACES:
            flip(file, place)
            damaged: list[StoreError] = []
            try:
                rows(store, view, damaged)
                assert damaged, f"{file} at {place}"
            except RoadscanError:
                pass
            if place == PLACES[1]:
                code, words = say("sql", "--survey", whole.survey_file, f"SELECT sum(hash(one)) FROM {view} AS one")
                assert code != 0 and str(file.relative_to(store.root)) in words, words
            file.write_bytes(content)
    finally:
        file.write_bytes(content)
    damaged = []
    assert rows(store, view, damaged) == right and damaged == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["log record", "manifest"])
def test_no_flipped_byte_of_a_record_makes_a_silent_answer(whole: Simulated, kind: str) -> None:
    store = whole.store()
    view = "returns" if kind == "log record" else "outputs"
    record = next(r for r in read_log_records(store) if "returns" in r.tables)
    path = record_path(record.key) if kind == "log record" else store.files("manifest/outputs")[0]
    file = Path(store.path(path))
    content, right = file.read_bytes(), rows(store, view, [])
    try:
        for place in (*PLACES, *(k / 13 for k in range(13))):
            flip(file, place)
            damaged: list[StoreError] = []
            with contextlib.suppress(RoadscanError):
                assert rows(store, view, damaged) == right or damaged, f"{file} at {place}"
            file.write_bytes(content)
    finally:
        file.write_bytes(content)


def test_a_query_names_the_damaged_files_that_it_opens_and_no_others(whole: Simulated) -> None:
    store = whole.store()
    file = largest(store, "tables/trajectory")
    content = file.read_bytes()
    flip(file, 0.5)
    try:
        ask = ("sql", "--survey", whole.survey_file)
        code, words = say(*ask, "SELECT max(epoch_gps_ns), avg(x_world_m), avg(qw) FROM trajectory")
        assert code != 0 and "damaged: the answer is made of a damaged file" in words and "verify --repair" in words
        assert str(file.relative_to(store.root)) in words
        assert say(*ask, "SELECT count(*) FROM returns")[0] == 0
    finally:
        file.write_bytes(content)


def test_a_table_whose_file_is_missing_is_not_called_unmade(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    record = next(r for r in read_log_records(store) if "control_points" in r.tables)
    (file,) = record.tables["control_points"]
    Path(store.path(file.path)).unlink()
    code, words = say("sql", "--survey", copy.survey_file, "SELECT count(*) FROM control_points")
    assert code == 2 and "No such file" in words and file.path in words
    assert "not made yet" not in words and "Traceback" not in words
    code, words = say("sql", "--survey", copy.survey_file, "SELECT count(*) AS n FROM scans")
    assert code == 1 and "not shown: table 'control_points'" in words


@pytest.mark.slow
def test_whole_files_are_looked_at_and_not_read_again(whole: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a run, after `verify`, and after a query that read them."""
    store = whole.store()
    held: list[str] = []
    from roadscan.store import verified

    real = verified.fault_of
    monkeypatch.setattr(verified, "fault_of", lambda *a: held.append(a[2]) or real(*a))
    note = store.path("manifest/verified.parquet")
    whole.run(**MAKE)
    Path(note).unlink()
    verify_store(store)
    held.clear()
    query(store, "SELECT count(*), avg(x_world_m) FROM trajectory")
    assert held == []
    Path(note).unlink()
    query(store, "SELECT count(*), avg(x_world_m) FROM trajectory")
    first = list(held)
    assert first and all(path.startswith("tables/trajectory") for path in first)
    query(store, "SELECT count(*), avg(x_world_m) FROM trajectory")
    assert held == first
    path = Path(store.path(first[0]))
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    query(store, "SELECT count(*), avg(x_world_m) FROM trajectory")
    assert held == [*first, first[0]]


@pytest.mark.slow
def test_a_run_notes_what_it_wrote(finished: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    copy.run()
    asked: list[str] = []
    from roadscan.store import verified

    monkeypatch.setattr(verified, "fault_of", lambda *a: asked.append(a[2]))
    for view in ("returns", "trajectory", "cells", "footprints"):
        query(copy.store(), f"SELECT * FROM {view}")
    assert asked == []


def damaged_tables(store: Store) -> list[Path]:
    return [largest(store, OPENED[view]) for view in ("returns", "scans", "trajectory")]


@pytest.mark.slow
def test_repair_reads_damaged_logs_again_and_nothing_is_stale(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.run()
    store = copy.store()
    before, made = {p: store.read_bytes(p) for p in store.files("tables")}, outputs(store)
    touched = damaged_tables(store)
    for file in touched:
        flip(file, 0.5)
    touched[0].unlink()
    stamps = {p: stamp(store, p) for p in before}
    code, words = say("verify", copy.survey_file)
    assert code == 1 and words.count("`roadscan verify --repair` reads its log again") == 3
    code, words = say("verify", "--repair", copy.survey_file)
    assert code == 0 and "every file is whole" in words, words
    assert words.count("mended, its log was read again (byte for byte as it was)") == 3
    assert {p: store.read_bytes(p) for p in store.files("tables")} == before
    others = before.keys() - {str(f.relative_to(store.root)) for f in touched}
    assert {p: stamp(store, p) for p in others} == {p: stamps[p] for p in others}
    assert len(store.files("damaged/tables")) == 2  # one was missing
    run = copy.run()
    assert run.raw_bytes_read == 0 and outputs(store) == made
    assert say("sql", "--survey", copy.survey_file, "SELECT * FROM returns")[0] == 0


def stamp(store: Store, path: str) -> Stamp:
    found = Path(store.path(path)).stat() if store.exists(path) else None
    return Stamp(found.st_ino, str(found.st_mtime_ns)) if found else Stamp(0, "")


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["gone", "changed"])
def test_what_a_lost_log_costs_is_said_and_brought_back(finished: Simulated, tmp_path: Path, fate: str) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.run()
    store = copy.store()
    before, made = {p: store.read_bytes(p) for p in store.files("tables")}, outputs(store)
    record = next(r for r in read_log_records(store) if "scans" in r.tables)
    file = record.tables["scans"][0]
    raw = copy.survey_file.parent / record.path
    raw_bytes, raw_stat = raw.read_bytes(), raw.stat()
    if fate == "gone":
        raw.rename(tmp_path / "archived")
    else:
        flip(raw, 0.5)
        os.utime(raw, ns=(raw_stat.st_atime_ns, raw_stat.st_mtime_ns))  # as a bad disk does it
    flip(Path(store.path(file.path)), 0.5)
    code, words = say("verify", "--repair", copy.survey_file)
    lost = file.rows
    assert f"{file.path}: {lost:,} of {file.rows:,} rows are lost, " in words, words
    assert ("is gone" if fate == "gone" else "holds other bytes now") in words and "put the log back" in words
    assert code == 1 and store.files("damaged/tables")
    assert words.splitlines()[-1] == f"every file is whole; {lost:,} rows are lost"
    (left,) = query(store, f"SELECT count(*) AS n FROM scans WHERE log = '{record.key}'").to_pylist()
    assert left["n"] == sum(f.rows for f in record.tables["scans"]) - lost
    assert say("sql", "--survey", copy.survey_file, "SELECT count(*) FROM scans")[0] == 0
    for command in ("verify", "status"):
        code, words = say(command, copy.survey_file)
        assert code == 1 and f"lost: {file.path}" in words and "`roadscan verify --accept-losses`" in words
    if fate == "gone":
        copy.run()  # what they touched is made anew, without them
        assert outputs(store) != made
    for command in (("verify", "--accept-losses"), ("verify",), *([("status",)] if fate == "gone" else [])):
        code, words = say(*command, copy.survey_file)
        assert code == 0 and f"lost: {file.path}: {lost:,} of {lost:,} rows are lost (accepted)" in words, words
    raw.write_bytes(raw_bytes)
    os.utime(raw, ns=(raw_stat.st_atime_ns, raw_stat.st_mtime_ns))
    code, words = say("verify", "--repair", copy.survey_file)
    assert code == 0 and "lost" not in words and "byte for byte as it was" in words, words
    made_by_runs = (
        "footprints",
        "ties",
        "tie_residuals",
        "corrections",
        "_accuracy",
        "control_residuals",
        "_sightings",
    )
    now = {p: store.read_bytes(p) for p in store.files("tables")}
    ingested, was = (
        {p: content for p, content in files.items() if not any(name in p for name in made_by_runs)}
        for files in (now, before)
    )
    assert ingested == was
    copy.run()
    assert outputs(store) == made


def test_damage_beside_the_rows_costs_none(finished: Simulated, tmp_path: Path) -> None:
    """The raw log is gone, and the same rows make the same bytes."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.run()
    store = copy.store()
    record = next(r for r in read_log_records(store) if "returns" in r.tables)
    (copy.survey_file.parent / record.path).rename(tmp_path / "archived")
    file = Path(store.path(record.tables["returns"][0].path))
    content = file.read_bytes()
    at = content.rindex(b"parquet-cpp") if b"parquet-cpp" in content else content.rindex(b"roadscan")
    file.write_bytes(content[:at] + b"X" + content[at + 1 :])
    code, words = say("verify", "--repair", copy.survey_file)
    assert code == 0 and "only what stands beside its rows was damaged" in words
    assert file.read_bytes() == content


def test_repair_of_a_log_that_is_listed_otherwise_leaves_it(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    record = next(r for r in read_log_records(store) if "trajectory" in r.tables)
    file = Path(store.path(record.tables["trajectory"][0].path))
    flip(file, 0.5)
    spoilt = file.read_bytes()
    text = copy.survey_file.read_text()
    copy.survey_file.write_text(text.replace(record.path, f"{record.path}.other"))
    code, words = say("verify", "--repair", copy.survey_file)
    assert code == 1 and "lists its log" in words and file.read_bytes() == spoilt


def test_damaged_records_are_mended_before_tables(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    copy.run()
    store = copy.store()
    record = next(r for r in read_log_records(store) if "returns" in r.tables)
    store.write_bytes(record_path(record.key), b"{}")
    flip(Path(store.path(record.tables["returns"][0].path)), 0.5)
    code, words = say("verify", "--repair", copy.survey_file)
    assert code == 0 and "its copy put in its place" in words and "its log was read again" in words
    assert store.read_bytes(copy_path(record.key)) == store.read_bytes(record_path(record.key))


def test_a_small_table_that_was_put_there_is_believed(tmp_path: Path) -> None:
    """One that is not of roadscan's writing has no record."""
    store, other = Store(str(tmp_path / "a"), "s"), Store(str(tmp_path / "b"), "s")
    values = {"string": "run-1", "int64": 0, "float64": 0.5}
    write_small(other, "corrections", [{c.name: values[c.type] for c in table_schema("corrections").columns}])
    store.write_bytes(small_path("corrections"), other.read_bytes(small_path("corrections")))
    assert query(store, "SELECT count(*) AS n FROM corrections").to_pylist() == [{"n": 1}]
    assert verify_store(store) == []


def test_a_damaged_list_of_digests_is_named_by_verify_and_by_a_run(whole: Simulated, tmp_path: Path) -> None:
    copy = whole.copy_with_store_to(tmp_path / "survey")
    held = Path(copy.store().path("manifest/held.json"))
    content = held.read_bytes()
    held.write_bytes(content[:-2] + b"\x0b}")
    assert ["manifest/held.json" in fault for fault in verify_store(copy.store())] == [True]
    code, words = say("run", copy.survey_file, "--workers", "0")
    assert code == 0 and "manifest/held.json: it is damaged, so that damage of corrections is not told by it" in words
