"""Logs side by side give what logs one after another give; digests of older stores hold; logs that cannot be read."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from blake3 import blake3

from roadscan.core.errors import ConfigError, RunError, StoreError
from roadscan.core.survey import Survey
from roadscan.ingest.ingest import ingest
from roadscan.ingest.reading.format import format_named, known_format, log_formats
from roadscan.ingest.sources import claimed_before, remembered_logs
from roadscan.run.engine.compute import Compute, Done, Inline, R, T
from roadscan.run.session import Session
from roadscan.store.digest import digest_holds, file_digest
from roadscan.store.logs import read_log_records
from roadscan.store.store import Store
from roadscan.survey.status import survey_status, verify_store

GEOMETRY = {"kind": "cartesian", "readings": 8, "first": 0.0, "step": 0.001, "range_offset_m": 1.5,
            "range_step_m": 0.0001}  # fmt: skip
EPOCH = 1_400_000_000_000_000_000


class Backwards(Inline):
    """The last task ends first; tasks and results travel as between processes."""

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        for task in reversed(tasks):
            for done in super().map(function, [pickle.loads(pickle.dumps(task))]):
                yield pickle.loads(pickle.dumps(done))


@pytest.fixture(autouse=True)
def all_logs_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roadscan.ingest.ingest._SMALL_BYTES", 0)


def write_log(path: Path, seed: int) -> None:
    """300 profiles over three partitions, not quite in order."""
    rng = np.random.default_rng(seed)
    columns = {
        "epoch_gps_ns": pa.array(EPOCH + np.argsort(np.arange(300) + rng.uniform(0, 60, 300)) * 100_000_000),
        "range": pa.FixedSizeListArray.from_arrays(pa.array(rng.integers(1, 9999, 2400).astype(np.uint16)), 8),
        "intensity": pa.FixedSizeListArray.from_arrays(pa.array(rng.integers(0, 255, 2400).astype(np.uint8)), 8),
    }
    table = pa.table(columns).replace_schema_metadata({"roadscan.scan_geometry": json.dumps(GEOMETRY)})
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table, 70)


def survey_of(folder: Path, logs: int = 4) -> Survey:
    lines = ['id = "s"', 'store = "store"', "[map]", 'crs = "EPSG:25832"', "[rig.sensors.head]", 'kind = "profiler"']
    for k in range(logs):
        if not (folder / f"{k}.arrow").exists():
            write_log(folder / f"{k}.arrow", k)
        lines += ["[[runs]]", f'id = "r{k}"', "[[runs.logs]]", f'path = "{k}.arrow"', 'sensor = "head"']
    (folder / "SURVEY.toml").write_text("\n".join(lines))
    return Survey.load(folder / "SURVEY.toml")


def ingested(survey: Survey, name: str, compute: Compute | None) -> tuple[Store, list[str]]:
    store, lines = Store(str(survey.folder / name), "s"), []
    ingest(survey, store, lines.append, compute)
    return store, lines


def tables_of(store: Store) -> dict[str, bytes]:
    return {path: store.read_bytes(path) for path in store.files("tables") + store.files("manifest/logs")}


def test_side_by_side_is_as_one_after_another(tmp_path: Path) -> None:
    survey = survey_of(tmp_path)
    one, lines = ingested(survey, "one", None)
    other, same_lines = ingested(survey, "other", Backwards())
    assert tables_of(one) == tables_of(other)
    assert lines == same_lines
    assert [line.split()[1] for line in lines] == [f"r{k}/head" for k in range(4)]
    assert [line[:6] for line in ingested(survey, "other", Backwards())[1]] == ["known:"] * 4


def test_little_memory_gives_the_same_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written out early and overlaps in time is merged."""
    survey = survey_of(tmp_path, 1)
    whole, _ = ingested(survey, "whole", None)
    monkeypatch.setattr("roadscan.store.writer.BUDGET_BYTES", 2000)
    monkeypatch.setattr("roadscan.formats.scanners.scans._CHUNK_BYTES", 2000)
    pieces, _ = ingested(survey, "pieces", None)
    assert len(whole.files("tables")) == 3 < len(pieces.files("tables"))
    one, other = (
        pa.concat_tables([pq.read_table(s.path(f), partitioning=None) for f in s.files("tables")])
        for s in (whole, pieces)
    )
    assert one.equals(other)


def test_one_bad_log_costs_itself(tmp_path: Path) -> None:
    survey = survey_of(tmp_path)
    (tmp_path / "1.arrow").write_bytes(b"ARROW1 and no more")
    (tmp_path / "3.arrow").unlink()
    lines: list[str] = []
    store = Store(str(tmp_path / "store"), "s")
    with pytest.raises(RunError, match=r"2 of 4 logs could not be ingested: .*3\.arrow.* \| .*1\.arrow"):
        ingest(Survey.load(_stated(tmp_path)), store, lines.append, Backwards())
    assert [line.split(":")[0] for line in lines] == ["failed", "read", "failed", "read"]
    assert [r.run for r in read_log_records(store)] == ["r0", "r2"]
    survey_of(tmp_path, 4)  # writes what is missing
    write_log(tmp_path / "1.arrow", 1)
    assert [r.fresh for r in ingest(survey, store, compute=Backwards())] == [False, True, False, True]


def _stated(folder: Path) -> Path:
    """The survey file with the format stated, so that a damaged log is planned."""
    file = folder / "SURVEY.toml"
    file.write_text(file.read_text().replace('sensor = "head"', 'sensor = "head"\nformat = "scans"'))
    return file


def test_the_same_bytes_under_another_clock_replace_each_their_own(tmp_path: Path) -> None:
    survey = survey_of(tmp_path, 3)
    store, _ = ingested(survey, "store", Backwards())
    geometry = ", ".join(f"{k} = {json.dumps(v)}" for k, v in GEOMETRY.items())
    text = (tmp_path / "SURVEY.toml").read_text()
    stated = text.replace('sensor = "head"', f'sensor = "head"\noptions = {{ scan_geometry = {{ {geometry} }} }}')
    (tmp_path / "SURVEY.toml").write_text(stated)
    before = {r.key for r in read_log_records(store)}
    ingested(Survey.load(tmp_path / "SURVEY.toml"), "store", Backwards())
    assert len(read_log_records(store)) == 3
    assert {Path(p).stem for p in store.files("superseded/manifest/logs")} == before
    assert len({p.split("/log=")[1][:16] for p in store.files("tables")}) == 3


def test_digests(tmp_path: Path) -> None:
    """The libraries' own one-call functions are the oracle."""
    for size in (0, 1, (1 << 18) - 1, 1 << 18, (1 << 19) + 5):
        content = np.random.default_rng(size).bytes(size)
        file = tmp_path / "file"
        file.write_bytes(content)
        assert file_digest(file) == "blake3:" + blake3(content).hexdigest(length=16)
        assert digest_holds(file, file_digest(file))
        old = hashlib.blake2b(content, digest_size=16).hexdigest()
        assert digest_holds(file, old)
        file.write_bytes(content + b"x")
        assert not digest_holds(file, old)
        assert not digest_holds(file, "blake3:" + blake3(content).hexdigest(length=16))


def test_a_store_with_older_digests_stays_sound_and_current(tmp_path: Path) -> None:
    survey = survey_of(tmp_path, 2)
    store = Store(str(tmp_path / "store"), "s")
    older = {str(f): hashlib.blake2b(f.read_bytes(), digest_size=16).hexdigest() for f in tmp_path.glob("*.arrow")}
    sources = {
        f: {"format": "scans", "files": {"": [Path(f).stat().st_size, Path(f).stat().st_mtime_ns, digest]}}
        for f, digest in older.items()
    }
    store.write_bytes("manifest/sources.json", json.dumps(sources).encode())
    ingest(survey, store)
    for path in store.files("manifest/logs"):
        record = json.loads(store.read_bytes(path))
        del record["checksum"]
        for files in record["tables"].values():
            for file in files:
                file["digest"] = hashlib.blake2b(store.read_bytes(file["path"]), digest_size=16).hexdigest()
        store.write_bytes(path, json.dumps(record).encode())
    store.remove("manifest/log_copies")
    assert verify_store(store) == []
    for file in older:
        os.utime(file)  # copied: another time, the same bytes
    assert [r.fresh for r in ingest(survey, store)] == [False, False]
    write_log(tmp_path / "1.arrow", 7)  # as long as before, other bytes
    assert [r.fresh for r in ingest(survey, store)] == [False, True]
    damaged = store.files("tables")[0]
    content = store.read_bytes(damaged)
    store.write_bytes(damaged, content[:50] + bytes([content[50] ^ 1]) + content[51:])
    assert [f.split(":")[0] for f in verify_store(store)] == [damaged]


def test_a_log_is_claimed_anew_where_it_or_the_code_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A format that was stated claims nothing: who takes the statement away wants the content to be asked."""
    survey_of(tmp_path, 2)
    with (tmp_path / "SURVEY.toml").open("a", encoding="utf-8") as file:
        file.write('\nformat = "scans"\n')  # of the second log
    survey, store = Survey.load(tmp_path / "SURVEY.toml"), Store(str(tmp_path / "store"), "s")
    ingest(survey, store)
    known = remembered_logs(store, survey.folder)
    first, second = tmp_path / "0.arrow", tmp_path / "1.arrow"
    assert claimed_before(first, known["0.arrow"]) == "scans"
    assert claimed_before(second, known["1.arrow"]) is None
    with monkeypatch.context() as patch:
        patch.setattr("roadscan.ingest.sources.claims_digest", lambda: "another code")
        assert claimed_before(first, known["0.arrow"]) is None
    os.utime(first, ns=(0, 0))
    assert claimed_before(first, known["0.arrow"]) is None
    first.unlink()
    assert claimed_before(first, known["0.arrow"]) is None


def test_a_format_found_alone_is_the_one_among_all() -> None:
    for name, one in log_formats().items():
        assert type(known_format(name)) is type(one)
    assert known_format("no_such_format") is None
    with pytest.raises(ConfigError, match=r"unknown format 'sbett'.*sbet"):
        format_named("sbett")


def test_a_disk_that_cannot_read_a_log_costs_that_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> str:
        if path.name == "0.arrow":
            raise OSError(5, "Input/output error")
        return file_digest(path)

    monkeypatch.setattr("roadscan.ingest.sources.file_digest", broken)
    store = Store(str(tmp_path / "store"), "s")
    with pytest.raises(RunError, match=r"1 of 2 logs .*0\.arrow: the log cannot be read: Input/output error"):
        ingest(survey_of(tmp_path, 2), store)
    assert len(read_log_records(store)) == 1


class Uploading(Inline):
    """While logs are read, one of them grows; the bytes of another are replaced by as many others."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def map(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Done[T, R]]:
        with (self.folder / "0.arrow").open("ab") as stream:
            stream.write(b"more")
        write_log(self.folder / "1.arrow", 17)
        yield from super().map(function, tasks)


def test_a_log_that_changes_while_it_is_read_is_read_when_it_rests(tmp_path: Path) -> None:
    """Its rows would stand under the fingerprint of other bytes, and come back with these."""
    survey = survey_of(tmp_path, 3)
    before = {name: (tmp_path / name).read_bytes() for name in ("0.arrow", "1.arrow")}
    store, untouched = Store(str(tmp_path / "store"), "s"), Store(str(tmp_path / "untouched"), "s")
    ingest(survey, untouched)
    with pytest.raises(RunError, match=r"2 of 3 logs .*1\.arrow: the log changed while it was read; run again"):
        ingest(survey, store, compute=Uploading(tmp_path))
    assert [r.run for r in read_log_records(store)] == ["r2"]
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    ingest(survey, store)
    assert tables_of(store) == tables_of(untouched)


@pytest.mark.parametrize("damage", [b"", b"{", b"\xff\xfe{not", b"[]", b'{"a": {"format": 1}}'])
def test_a_damaged_list_of_logs_or_failures_costs_itself(tmp_path: Path, damage: bytes) -> None:
    survey = survey_of(tmp_path, 2)
    store = Store(str(tmp_path / "store"), "s")
    ingest(survey, store)
    whole = json.loads(store.read_bytes("manifest/sources.json"))
    for name in ("sources", "failures"):
        store.write_bytes(f"manifest/{name}.json", damage)
    assert [log["state"] for log in survey_status(Session(survey, store)).logs] == ["ingested", "ingested"]
    assert json.loads(store.read_bytes("manifest/sources.json")) == whole
    store.write_bytes("manifest/sources.json", damage)
    (tmp_path / "1.arrow").rename(tmp_path / "away")
    assert any("the list of logs is damaged; its copy is used" in fault for fault in verify_store(store))
    assert [r.fresh for r in ingest(survey, store)] == [False, False]
    assert verify_store(store) == []
    for name in ("sources", "sources_copy"):
        store.write_bytes(f"manifest/{name}.json", damage)
    assert any("logs that were moved away have to be put back" in fault for fault in verify_store(store))
    with pytest.raises(RunError, match=r"1\.arrow: the log does not exist; .* put it back for one run"):
        ingest(survey, store)
    (tmp_path / "away").rename(tmp_path / "1.arrow")
    assert [r.fresh for r in ingest(survey, store)] == [False, False]


def test_who_may_only_read_the_store_can_ask_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = survey_of(tmp_path, 2)
    store = Store(str(tmp_path / "store"), "s")
    ingest(survey, store)
    os.utime(tmp_path / "0.arrow")
    before = tables_of(store)

    def refused(path: Path, mode: str = "r", *_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system", str(path))

    with monkeypatch.context() as patch:
        for name in ("replace", "mkdir", "unlink"):
            patch.setattr(Path, name, refused)
        assert [log["state"] for log in survey_status(Session(survey, store)).logs] == ["ingested", "ingested"]
        with pytest.raises(StoreError, match=r"manifest/lock: the store cannot be written: Read-only file system; see"):
            verify_store(store)
    assert tables_of(store) == before


def test_a_full_disk_costs_the_logs_it_cannot_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, rows: pa.Table, *_: object) -> None:
        if rows.num_rows > 50:
            raise OSError(28, "No space left on device", str(path))
        pq.write_table(rows, path)

    survey = survey_of(tmp_path, 3)
    short = pa.ipc.open_file(tmp_path / "1.arrow").read_all().slice(0, 20)
    with pa.OSFile(str(tmp_path / "1.arrow"), "wb") as sink, pa.ipc.new_file(sink, short.schema) as writer:
        writer.write_table(short)
    store = Store(str(tmp_path / "store"), "s")
    with monkeypatch.context() as patch:
        patch.setattr("roadscan.store.writer.write_parquet", full)
        with pytest.raises(
            RunError, match=r"2 of 3 logs .*2\.arrow: its rows cannot be kept: .*No space left .*see to"
        ):
            ingest(survey, store)
    assert [r.run for r in read_log_records(store)] == ["r1"]
    assert store.files(".staging") == []
    assert [r.fresh for r in ingest(survey, store)] == [True, False, True]
