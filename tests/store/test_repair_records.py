"""Damaged records: what they cost, what stays, and that nothing is lost where mending is cut short."""

from __future__ import annotations

import dataclasses
import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from roadscan.core.errors import DamagedError, StoreError
from roadscan.store import manifest as manifest_module
from roadscan.store.digest import bytes_digest
from roadscan.store.logs import (
    DataFile,
    LogRecord,
    copy_path,
    has_log,
    read_log_records,
    record_path,
    retire_log,
    write_log_record,
)
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.records import Packed, sound_rows, table_of
from roadscan.store.store import Store
from roadscan.store.verified import repair_records


@pytest.fixture(params=["folder", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return Store(str(tmp_path) if request.param == "folder" else f"memory://{tmp_path.name}", "s")


def flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "flipped": lambda content: flipped(content, 60),
}


def made(store: Store, unit: str, content: bytes) -> OutputRecord:
    """A file and its record."""
    path = f"tiles/pic/{unit}.bmp"
    store.write_bytes(path, content)
    digest = bytes_digest(content)
    return OutputRecord("pic", unit, f"key of {content!r}", path, len(content), digest)


@pytest.mark.parametrize("damage", sorted(DAMAGES))
@pytest.mark.parametrize("killed", [False, True])
def test_what_a_damaged_part_may_have_replaced_is_not_believed(
    store: Store, damage: str, killed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Part 1 told of a, b, c, d; the damaged one replaced b, forgot c and told of e; part 3 replaced d."""
    manifest = Manifest(store)
    first = {unit: made(store, unit, b"old " + unit.encode()) for unit in "abcd"}
    manifest.add(first.values())
    manifest.add([made(store, "b", b"new b"), made(store, "e", b"new e"), first["c"]._replace(key="")])
    store.write_bytes("tiles/pic/c.bmp", b"odd c")  # as `verify` forgets a file that is not whole
    (path,) = store.files("manifest/outputs")[1:]
    last = made(store, "d", b"new d")
    manifest.add([last])
    content = DAMAGES[damage](store.read_bytes(path))
    store.write_bytes(path, content)

    faults: list[StoreError] = []
    assert Manifest(store, faults).get("pic", "a") == first["a"]
    assert [str(fault).startswith(store.path(path)) for fault in faults] == [True]
    with pytest.raises(DamagedError, match="the next run sets it aside"):
        Manifest(store)
    if killed:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Store, "set_aside", _killed)
            repair_records(store)
    said: list[str] = []
    repair_records(store, said.append)
    assert Manifest(store).of("pic") == {"a": first["a"], "d": last}
    assert store.read_bytes(f"damaged/{path}") == content
    assert store.exists("manifest/changing")  # files without a record go with the next whole run
    assert len(said) == 1 and f"it was set aside (damaged/{path})" in said[0]
    repair_records(store, said.append)
    assert len(said) == 1


def _killed(*_: object) -> None:
    raise KeyboardInterrupt


def test_damage_costs_the_rows_around_it() -> None:
    rows = [OutputRecord("tile", f"{n}_0", f"{n:032x}", "", 0, "", "") for n in range(40_000)]
    content = Packed.of(table_of(rows), "lz4").content
    table, reason = sound_rows(flipped(content, len(content) // 2))
    units = set(table.column("unit").to_pylist())
    lost = [number for number, row in enumerate(rows) if row.unit not in units]
    assert reason and len(lost) == 8192 and lost == list(range(lost[0], lost[0] + 8192))
    assert sound_rows(content)[1] == ""


def test_a_part_is_not_written_over_a_damaged_one(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest_module, "_MOST_PARTS", 2)
    Manifest(store).add([made(store, "a", b"a")])
    (path,) = store.files("manifest/outputs")
    store.write_bytes(path, b"")
    manifest = Manifest(store, [])
    for unit in "bcde":
        manifest.add([made(store, unit, unit.encode())])
    assert store.read_bytes(path) == b""
    assert sorted(Manifest(store, []).of("pic")) == list("bcde")


def log_record(key: str) -> LogRecord:
    file = DataFile(f"tables/scans/run=r/sensor=s/log={key}/part-00000.parquet", 5, 9, "blake3:0", (5,), ((1, 4),))
    tables = {"scans": (file,)}
    return LogRecord(key, "r", "s", "format", "raw/x", "content", 1, tables, {"frame": "sensor"}, 5, 1, {"cut": 1})


@pytest.mark.parametrize("damage", [*DAMAGES, "other"])
@pytest.mark.parametrize("copy", ["there", "damaged", "missing"])
def test_a_damaged_log_record_is_mended_by_its_copy(store: Store, damage: str, copy: str) -> None:
    first, second = log_record("one"), log_record("two")
    for record in (first, second):
        write_log_record(store, record)
    path = record_path("one")
    store.write_bytes(path, DAMAGES.get(damage, lambda _: store.read_bytes(record_path("two")))(store.read_bytes(path)))
    if copy == "damaged":
        store.write_bytes(copy_path("one"), b"{}")
    elif copy == "missing":
        store.remove(copy_path("one"))
    faults: list[StoreError] = []
    assert read_log_records(store, damaged=faults) == [second]
    assert [fault.file for fault in faults] == [store.path(path)]
    with pytest.raises(DamagedError, match="the log record is damaged"):
        read_log_records(store)
    said: list[str] = []
    repair_records(store, said.append)
    assert len(said) == 1 and f"damaged/{path}" in said[0]
    assert read_log_records(store) == ([first, second] if copy == "there" else [second])
    assert has_log(store, "one") == (copy == "there")


def test_every_flipped_bit_of_a_log_record_is_seen(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s")
    record = log_record("one")
    write_log_record(store, record)
    content, chance = store.read_bytes(record_path("one")), random.Random(5)
    assert json.loads(content)["checksum"].startswith("blake3:")
    for place in range(0, len(content), 3):
        odd = bytearray(content)
        odd[place] ^= 1 << chance.randrange(8)
        store.write_bytes(record_path("one"), bytes(odd))
        with pytest.raises(DamagedError):
            read_log_records(store)


def test_records_of_older_versions_stay_readable_and_get_a_copy(store: Store) -> None:
    record = log_record("one")
    text = json.dumps(dataclasses.asdict(record), indent=1, sort_keys=True, default=list).encode()
    assert '"group_spans": [[1, 4]]' in " ".join(text.decode().split()).replace("[ ", "[").replace(" ]", "]")
    store.write_bytes(record_path("one"), text)
    assert read_log_records(store) == [record]
    repair_records(store)
    assert store.read_bytes(copy_path("one")) == text
    store.write_bytes(record_path("one"), text[:-5])
    repair_records(store)
    assert read_log_records(store) == [record]
    retire_log(store, record)
    assert not store.exists(copy_path("one"))


@pytest.mark.parametrize("path", ["manifest/outputs/part-00000000.parquet", record_path("one")])
def test_what_cannot_be_read_stays_where_it_is(tmp_path: Path, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rights and disks may be better tomorrow."""
    store = Store(str(tmp_path), "s")
    write_log_record(store, log_record("one"))
    Manifest(store).add([made(store, "a", b"a")])
    read = store.fs.cat_file

    def refusing(asked: str) -> bytes:
        if asked == store.path(path):
            raise PermissionError(13, "Permission denied", asked)
        return bytes(read(asked))

    with monkeypatch.context() as patch:
        patch.setattr(type(store.fs), "cat_file", lambda _, asked: refusing(asked))
        with pytest.raises(StoreError, match="cannot be read: Permission denied; see to its rights") as raised:
            repair_records(store)
    assert raised.value.file == store.path(path)
    assert store.exists(path) and not store.exists("damaged")
    repair_records(store)
    assert Manifest(store).get("pic", "a") is not None
