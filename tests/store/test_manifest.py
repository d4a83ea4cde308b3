"""The manifest against a dictionary that is told the same, and its files as another program sees them."""

from __future__ import annotations

import pickle
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import StoreError
from roadscan.store import manifest as manifest_module
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.query.sql import query
from roadscan.store.records import Packed, latest, rows_of, table_of
from roadscan.store.store import Store
from tests.store.killed import dies_at_removal

_COLUMNS = {"product": "string", "unit": "string", "key": "string", "path": "string", "bytes": "int64"} | dict.fromkeys(
    ("digest", "detail"), "string"
)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(str(tmp_path), "s")


def record(product: str, number: int, key: str, suffix: str = ".tif") -> OutputRecord:
    path = f"tiles/{product}/{number}_0{suffix}" if suffix else ""
    return OutputRecord(product, f"{number}_0", key, path, number, f"blake3:{key}", f'{{"n": {number}}}')


def packed(*records: OutputRecord) -> Packed:
    return pickle.loads(pickle.dumps(Packed.of(table_of(records))))


def filed(store: Store, *records: OutputRecord) -> Packed:
    """As a worker does it: the files first."""
    for r in records:
        if r.path:
            store.write_bytes(r.path, b"x" * r.bytes)
    return packed(*records)


def paths(store: Store) -> list[str]:
    return [f.removeprefix("tiles/") for f in store.files("tiles")]


def test_parts_that_others_wrote_are_read(store: Store) -> None:
    """Parts as versions before wrote them: plain Parquet, a part a task, an empty key where a record is forgotten."""
    rows = [
        ("las", "1_0", "k1", "tiles/las/1_0.laz", 1, "d1", ""),
        ("tile", "1_0", "k1", "tiles/cells/1_0.parquet", 2, "blake3:d2", '{"points": 5}'),
        ("las", "2_0", "k2", "tiles/las/2_0.laz", 3, "d3", ""),
        ("las", "1_0", "k9", "tiles/las/1_0.laz", 4, "d4", ""),
        ("las", "2_0", "", "", 0, "", ""),
        ("tile", "3_0", "k3", "", 0, "", '{"points": 0}'),
    ]
    schema = pa.schema([(name, kind) for name, kind in _COLUMNS.items()])
    for number, (a, b) in enumerate([(0, 3), (3, 4), (4, 6)]):
        table = pa.table([list(c) for c in zip(*rows[a:b], strict=True)], schema=schema)
        file = Path(store.path(f"manifest/outputs/part-{number:08d}.parquet"))
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, file, use_dictionary=["product"], write_statistics=False)
    manifest = Manifest(store)
    assert manifest.all() == [OutputRecord(*rows[k]) for k in (3, 1, 5)]
    assert manifest.of("tile")["1_0"].figures() == {"points": 5}
    assert manifest.get("las", "2_0") is None
    manifest.compact()
    (file,) = store.files("manifest/outputs")
    statement = f"SELECT {', '.join(_COLUMNS)} FROM read_parquet('{store.path(file)}')"
    assert duckdb.sql(statement).fetchall() == [rows[k] for k in (3, 1, 5)]


def test_sql_shows_what_is_there_now(store: Store) -> None:
    """Between the parts of a run at work, too: an earlier record is replaced, a forgotten one gone."""
    manifest = Manifest(store)
    manifest.add([record("pic", 1, "k1"), record("pic", 2, "k1"), record("tile", 1, "k1", "")])
    manifest.add([record("pic", 1, "k2")])
    manifest.forget("pic", ["2_0"])
    found = query(store, "SELECT product, unit, key FROM outputs ORDER BY ALL").to_pylist()
    assert [tuple(row.values()) for row in found] == [("pic", "1_0", "k2"), ("tile", "1_0", "k1")]


@pytest.mark.parametrize("merged", [1, 3])
def test_parts_that_a_run_merges_meanwhile_are_read_from_their_successor(
    store: Store, merged: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = Manifest(store)
    for number in range(4):
        writer.add([record("pic", number, "k")])
    read, before = store.read_bytes, []

    def while_a_run_works(path: str) -> bytes:
        if len(before) < merged:
            before.append(path)
            writer.add([record("pic", 4 + len(before), "k")])
            writer.compact()
        return read(path)

    monkeypatch.setattr(store, "read_bytes", while_a_run_works)
    assert Manifest(store).all() == writer.all()
    assert len(writer.all()) == 4 + merged == 4 + len(before)


@pytest.mark.parametrize("damage", ["cut", "empty", "other"])
def test_a_damaged_part_is_named(store: Store, damage: str) -> None:
    manifest = Manifest(store)
    manifest.add([record("pic", 1, "k")])
    manifest.add([record("pic", 2, "k")])
    first, _ = store.files("manifest/outputs")
    file = Path(store.path(first))
    if damage == "other":
        pq.write_table(pa.table({"name": ["x"]}), file)
    else:
        file.write_bytes(file.read_bytes()[: 100 if damage == "cut" else 0])
    with pytest.raises(StoreError, match="part of the manifest is damaged") as raised:
        Manifest(store)
    assert first in str(raised.value)


def test_packed_and_single_records_say_the_same(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long run of all that is done with records, merged now and then, against a dictionary; files too."""
    monkeypatch.setattr(manifest_module, "_MOST_PARTS", 12)
    random, known, manifest = np.random.default_rng(3), {}, Manifest(store)
    for step in range(160):
        numbers = random.choice(40, random.integers(1, 5), replace=False).tolist()
        suffixes = random.choice([".tif", ".png", ""], len(numbers), p=[0.6, 0.2, 0.2]).tolist()
        made = [record(("a", "b")[n % 2], n, f"k{step}", s) for n, s in zip(numbers, suffixes, strict=True)]
        own = [r for r in known.values() if r.unit in {m.unit for m in made}]
        match step % 8:
            case 5:
                manifest.remove(own)
            case 6:
                manifest.forget("a", [r.unit for r in own])
                own = [r for r in own if r.product == "a"]
            case 7 | 3:
                manifest.add(made)
            case _:
                manifest.add_packed(packed(*made))
        if step % 8 in (5, 6):
            known = {u: r for u, r in known.items() if r not in own}
        else:
            known |= {m.unit: m for m in made}
        if step % 5 == 0:  # asked in between, so that its tables have to catch up
            assert manifest.of("a") == {u: r for u, r in known.items() if r.product == "a"}
        if step % 37 == 36:
            manifest = Manifest(store)
    expected = sorted(known.values())
    for one in (manifest, Manifest(store)):
        assert one.all() == expected
        assert [one.get(r.product, r.unit) for r in expected] == expected
        assert one.files() == {p: sum(r.product == p and r.path != "" for r in expected) for p in ("a", "b")}
        assert one.without_file("a") == {r.unit for r in expected if r.product == "a" and not r.path}
        units = {"3_0", "4_0", "999_0"}
        assert one.beside(["b"], units) == [r for r in expected if r.product == "b" and r.unit not in units]
        assert one.beside([], units) == []
    assert len(store.files("manifest/outputs")) <= 13
    manifest.compact()
    assert Manifest(store).all() == expected


@pytest.mark.parametrize("ends", ["settle", "compact", "merge", "killed"])
def test_a_file_under_an_older_name_goes(store: Store, ends: str, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = Manifest(store)
    manifest.add_packed(filed(store, record("pic", 1, "k1", ".png"), record("pic", 2, "k1", ".png")))
    manifest.add_packed(filed(store, record("pic", 1, "k2", ".bmp")))
    manifest.add_packed(packed())
    assert paths(store) == ["pic/1_0.bmp", "pic/1_0.png", "pic/2_0.png"]
    match ends:
        case "merge":
            monkeypatch.setattr(manifest_module, "_MOST_PARTS", 2)
            manifest.add_packed(filed(store, record("pic", 3, "k1", ".png")))
            assert paths(store).pop() == "pic/3_0.png"
            store.remove("tiles/pic/3_0.png")
        case "killed":  # before anything was removed
            manifest = Manifest(store)
            assert len(paths(store)) == 3  # who only looks removes nothing
            manifest.settle()
        case _:
            getattr(manifest, ends)()
    assert paths(store) == ["pic/1_0.bmp", "pic/2_0.png"]


@pytest.mark.parametrize("way", ["add", "packed", "merge"])
def test_a_file_that_another_unit_names_stays(store: Store, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = Manifest(store)
    first, second = record("pic", 1, "k1", ".png"), record("pic", 2, "k1", ".png")
    shared = second._replace(path=first.path)
    manifest.add_packed(filed(store, first, *(record("pic", n, "k1", "") for n in range(10, 60))))
    manifest.add_packed(packed(shared))
    later = filed(store, record("pic", 2, "k2", ".bmp"))
    if way == "add":
        manifest.add(list(map(OutputRecord._make, rows_of(later.table()))))
    else:
        monkeypatch.setattr(manifest_module, "_MOST_PARTS", 2 if way == "merge" else 99)
        manifest.add_packed(later)
    manifest.settle()
    assert paths(store) == ["pic/1_0.png", "pic/2_0.bmp"]
    assert manifest.is_current("pic", "1_0", "k1")


def test_an_older_name_goes_before_its_record_is_forgotten(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest_module, "_MOST_PARTS", 3)
    manifest = Manifest(store)
    for suffix in (".png", ".bmp"):
        manifest.add_packed(filed(store, record("pic", 6, suffix, suffix)))
    manifest.forget("pic", ["6_0"])
    manifest.add_packed(packed(record("pic", 7, "k", "")))  # parts are merged, and the run is killed
    Manifest(store).settle()
    assert paths(store) == ["pic/6_0.bmp"]


def test_a_file_that_came_back_stays(store: Store) -> None:
    manifest = Manifest(store)
    for key, suffix in (("k1", ".png"), ("k2", ".bmp")):
        manifest.add_packed(filed(store, record("pic", 1, key, suffix)))
    manifest.get("pic", "1_0")  # has seen that the picture moved
    manifest.add_packed(filed(store, record("pic", 1, "k3", ".png")))
    manifest.settle()
    assert paths(store) == ["pic/1_0.png"]
    manifest.forget("pic", ["1_0"])
    manifest.add_packed(filed(store, record("pic", 1, "k4", ".bmp")))
    manifest.compact()
    assert paths(store) == ["pic/1_0.bmp", "pic/1_0.png"]  # what is forgotten keeps its file


def test_last_rows_and_moved_files_as_told_one_by_one() -> None:
    random = np.random.default_rng(8)
    for _ in range(30):
        told: list[OutputRecord] = []
        for step in range(random.integers(0, 60)):
            product, number = ("x", "y", "z")[random.integers(3)], int(random.integers(6))
            if random.random() < 0.2:
                told.append(OutputRecord(product, f"{number}_0", "", "", 0, ""))
            else:
                told.append(record(product, number, f"k{step}", str(random.choice([".tif", ".png", ".bmp", ""]))))
        rows, moved = latest(table_of(told))
        last = {(r.product, r.unit): r for r in told}
        assert [tuple(row.values()) for row in rows.to_pylist()] == sorted(r for r in last.values() if r.key)
        kept, _ = latest(table_of(told), forgotten=True)
        assert [tuple(row.values()) for row in kept.to_pylist()] == sorted(last.values())
        gone: set[str] = set()
        for r in told:
            before = next((o for o in reversed(told[: told.index(r)]) if o[:2] == r[:2]), None)
            gone -= {r.path}
            if r.key and before is not None and before.path not in ("", r.path):
                gone |= {before.path}
        assert sorted(moved) == sorted(gone)


@pytest.mark.parametrize("dies_at", [0, 3, 11])
def test_killed_while_parts_are_merged(store: Store, dies_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest_module, "_MOST_PARTS", 8)
    manifest, known = Manifest(store), {}
    dies_at_removal(store, dies_at, monkeypatch)
    for step in range(60):
        made = [record("tile", n, f"k{step}", "") for n in (step % 7, 10 + step % 11)]
        known |= {r.unit: r for r in made}
        try:
            manifest.add_packed(packed(*made))
        except KeyboardInterrupt:
            manifest = Manifest(store)
        assert manifest.of("tile") == known
    assert Manifest(store).of("tile") == known
