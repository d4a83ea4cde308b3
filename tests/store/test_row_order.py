"""Rows in the schema's order: by the fast ways as by sorting all rows by key and key."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.store import writer as row_order
from roadscan.store.digest import bytes_digest
from roadscan.store.schema import table_schema
from roadscan.store.writer import LogWriter, in_order, ordered, sorted_batch, sorted_rows
from tests.store.readings.test_returns import SCHEMA

START = 1_400_000_000 * 10**9
INT64 = np.iinfo(np.int64)


def epochs_of(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Epochs (count,) of a sweep."""
    steps = np.arange(count) * 1_000
    own = {
        "sorted": steps,
        "backwards": steps[::-1],
        "by ring": np.tile(np.arange(count // 8 + 1) * 50_000, 8)[:count],
        "some late": steps - 3_000 * (random.random(count) < 0.01),
        "one stamp": np.zeros(count, np.int64),
        "in any order": random.integers(0, 10**8, count),
        "few stamps": random.integers(0, 5, count),
    }
    return START + own[kind].astype(np.int64)


KINDS = ("sorted", "backwards", "by ring", "some late", "one stamp", "in any order", "few stamps")


def sweep(kind: str, count: int, seed: int, *, own_pose: bool = True) -> pa.RecordBatch:
    """A batch of returns; x numbers the rows."""
    random = np.random.default_rng(seed)
    epochs = epochs_of(kind, count, random)
    columns = [
        epochs, epochs if own_pose else np.full(count, START), np.arange(count, dtype=np.float32),
        random.normal(size=count).astype(np.float32), np.where(random.random(count) < 0.5, -0.0, 0.0).astype("f4"),
        random.integers(0, 1 << 16, count).astype(np.uint16), random.integers(0, 4, count).astype(np.uint8),
        np.full(count, seed, np.int32),
    ]  # fmt: skip
    return pa.RecordBatch.from_arrays(list(map(pa.array, columns)), schema=SCHEMA.arrow())


def slowly(rows: pa.Table) -> pa.Table:
    """The same rows by `numpy.lexsort` and Arrow."""
    return rows.take(pa.array(np.lexsort([rows.column(name).to_numpy() for name in SCHEMA.sort[::-1]])))


def bits(rows: pa.Table | pa.RecordBatch) -> dict[str, str]:
    """Digest of each column's bytes."""
    return {name: bytes_digest(np.asarray(rows.column(name)).tobytes()) for name in rows.schema.names}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("own_pose", [True, False])
def test_a_batch_is_sorted_to_the_bit_as_by_key_and_key(kind: str, own_pose: bool) -> None:
    for count in (1, 2, 7, 1_000):
        batch = sweep(kind, count, 3, own_pose=own_pose)
        found = sorted_batch(SCHEMA, batch)
        assert bits(found) == bits(slowly(pa.Table.from_batches([batch]))), count
        assert found.schema.equals(batch.schema, check_metadata=True)
        assert (found is batch) == in_order([np.asarray(batch.column(name)) for name in SCHEMA.sort])


@pytest.mark.parametrize("seed", range(40))
def test_batches_of_any_overlap_are_sorted_as_all_rows_are(seed: int) -> None:
    random = np.random.default_rng(seed)
    parts = []
    for k in range(6):
        batch = sweep(str(random.choice(KINDS)), int(random.integers(0, 200)), k)
        shift = int(random.choice([0, 50_000, 200_000, 10**8])) * k
        epochs = pa.array(np.asarray(batch.column("epoch_gps_ns")) + shift)
        parts.append(batch.set_column(0, batch.schema.field(0), epochs))
    rows = pa.Table.from_batches([parts[k] for k in random.permutation(6)] if seed % 2 else parts)
    assert bits(sorted_rows(SCHEMA, rows)) == bits(slowly(rows))


def test_a_log_in_order_is_not_copied() -> None:
    rows = pa.Table.from_batches([sweep("sorted", 50, 0)])
    assert sorted_rows(SCHEMA, rows) is rows


@pytest.mark.parametrize(
    "keys",
    [
        [np.array([INT64.max, INT64.min, 0, -1, INT64.max, 1])],
        [np.array([3, 1, 3, 1]), np.array([2.0, np.nan, 1.0, 0.5])],
        [np.array([-5, 7, -5, 7], np.int32), np.array([255, 0, 0, 255], np.uint8), np.array([9, 9, -9, -9], np.int16)],
        [np.array([1 << 60, 0, 5, 1 << 60]), np.array([INT64.max, 1, INT64.min, -1])],
        [np.array([2**64 - 1, 0, 2**63], np.uint64)],
        [np.zeros(0, np.int64)],
    ],
)  # fmt: skip
def test_keys_of_any_width_are_ordered(keys: list[np.ndarray]) -> None:
    order, found = ordered(keys)
    np.testing.assert_array_equal(order, np.lexsort(keys[::-1]))
    for key, own in zip(keys, found, strict=True):
        assert own.dtype == key.dtype and own.tobytes() == key[order].tobytes()


def test_nulls_and_names_are_sorted_too() -> None:
    schema = table_schema("encoder")
    ticks = {
        "epoch_gps_ns": [3, 1, 2, 1], "wheel": ["b", "b", "a", "a"],
        **{c.name: [4, 1, 3, 0] for c in schema.columns[2:] if not c.nullable},
    }  # fmt: skip
    batch = schema.conform(pa.RecordBatch.from_pydict(ticks))
    found = sorted_batch(schema, batch)
    assert found.column("wheel").to_pylist() == ["a", "b", "a", "b"]
    assert found.column("epoch_gps_ns").to_pylist() == [1, 1, 2, 3]
    assert found.schema.equals(batch.schema)


@pytest.mark.slow
@pytest.mark.parametrize("budget", [1, 20_000, 10**9])
def test_a_log_is_stored_the_same_by_the_slow_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, budget: int) -> None:
    monkeypatch.setattr("roadscan.store.writer.BUDGET_BYTES", budget)
    batches = [sweep(kind, 400, k) for k, kind in enumerate(KINDS)]

    def stored(folder: Path) -> list[dict[str, str]]:
        folder.mkdir()
        writer = LogWriter(folder, None)
        for batch in batches:
            writer.add("returns", batch)
        writer.finish()
        return [bits(pq.read_table(file, partitioning=None)) for file in sorted(folder.rglob("*.parquet"))]

    fast = stored(tmp_path / "fast")
    monkeypatch.setattr(row_order, "_stretches", lambda rows, _: iter([rows]))
    monkeypatch.setattr(row_order, "in_order", lambda _: False)
    monkeypatch.setattr(row_order, "ordered", lambda keys: (o := np.lexsort(keys[::-1]), [k[o] for k in keys]))
    assert stored(tmp_path / "slow") == fast
