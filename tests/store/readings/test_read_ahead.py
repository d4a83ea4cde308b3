"""Bytes on their way before they are needed: the same ones, fetched before the read, and faults where they belong."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from roadscan.core.errors import StoreError
from roadscan.store.readings.row_groups import ProfileReader, ReadAhead
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import write_parquet

FILE = "tables/scans/part-00000.parquet"
GROUP, GROUPS, READINGS = table_schema("scans").row_group_rows, 6, 40


class SlowStore(MemoryFileSystem):
    """An object store whose requests wait until they are let through."""

    protocol = "slow"
    store: dict[str, Any] = {}
    pseudo_dirs = [""]
    cachable = False
    gate = threading.Event()
    requests: list[tuple[int, int]] = []
    broken: set[int] = set()

    def cat_file(self, path: str, start: Any = None, end: Any = None, **kwargs: Any) -> Any:
        SlowStore.requests.append((start, end))
        if not SlowStore.gate.wait(20):
            raise TimeoutError("nobody opened the gate")
        if len(SlowStore.requests) in SlowStore.broken:
            raise OSError("the network is gone")
        return super().cat_file(path, start=start, end=end, **kwargs)


@pytest.fixture
def rows() -> pa.Table:
    rng = np.random.default_rng(0)
    n = GROUP * GROUPS
    ranges, bright = rng.integers(1, 65536, n * READINGS), rng.integers(0, 256, n * READINGS)
    columns = {
        "epoch_gps_ns": np.arange(n),
        "range": pa.FixedSizeListArray.from_arrays(pa.array(ranges.astype(np.uint16)), READINGS),
        "intensity": pa.FixedSizeListArray.from_arrays(pa.array(bright.astype(np.uint8)), READINGS),
    }
    return pa.Table.from_batches([table_schema("scans").conform(pa.RecordBatch.from_pydict(columns), READINGS)])


@pytest.fixture
def store(rows: pa.Table) -> Iterator[Store]:
    fsspec.register_implementation("slow", SlowStore, clobber=True)
    SlowStore.store.clear()
    SlowStore.gate.clear()
    SlowStore.requests.clear()
    SlowStore.broken.clear()
    put = Store("slow://there", "bench")
    with put.scratch() as scratch:
        write_parquet(scratch / "a", rows, table_schema("scans"))
        put.publish(scratch / "a", FILE)
    yield put
    SlowStore.gate.set()
    assert ended()


def ended() -> bool:
    """True once no thread reads ahead any more."""
    threads = [t for t in threading.enumerate() if t.name.startswith("read ahead")]
    for thread in threads:
        thread.join(20)
    return not any(t.is_alive() for t in threads)


def same(reader: ProfileReader, groups: list[int], rows: pa.Table) -> bool:
    found = reader.read(groups)
    wanted = pa.concat_tables([rows.slice(k * GROUP, GROUP) for k in groups]).combine_chunks()
    return (
        np.array_equal(found.epoch_gps_ns, wanted.column("epoch_gps_ns").to_numpy())
        and np.array_equal(found.range.ravel(), wanted.column("range").chunk(0).flatten().to_numpy())
        and np.array_equal(found.intensity.ravel(), wanted.column("intensity").chunk(0).flatten().to_numpy())
    )


@pytest.mark.own_codecs
def test_requests_go_out_before_their_groups_are_read(store: Store, rows: pa.Table) -> None:
    reader = ProfileReader(store, FILE)
    for groups in ([0, 1], [2, 3], [2, 3], [5]):
        reader.expect(groups)  # returns though no request has been answered
    SlowStore.gate.set()
    for groups in ([0, 1], [2], [3], [4], [5], [1, 0], [2, 3]):
        assert same(reader, groups, rows)
    assert len(SlowStore.requests) == 3  # a run of groups is one request, and none is made twice


@pytest.mark.own_codecs
def test_a_failed_request_is_told_where_its_groups_are_read(store: Store, rows: pa.Table) -> None:
    SlowStore.gate.set()
    SlowStore.broken.add(2)
    reader = ProfileReader(store, FILE)
    for groups in ([0], [1, 2], [3], [99]):
        reader.expect(groups)
        assert ended()  # so requests are numbered in this order
    assert same(reader, [0], rows)
    assert same(reader, [3], rows)
    with pytest.raises(StoreError, match="the network is gone") as caught:
        reader.read([1])
    assert (caught.value.file, caught.value.record) == (FILE, "row groups 1")
    assert same(reader, [2], rows)


def test_what_a_folder_expects_changes_nothing(tmp_path: Any, rows: pa.Table) -> None:
    store = Store(str(tmp_path), "bench")
    with store.scratch() as scratch:
        write_parquet(scratch / "a", rows, table_schema("scans"))
        store.publish(scratch / "a", FILE)
    reader = ProfileReader(store, FILE)
    reader.expect([0, 2, 1, 99])
    assert same(reader, [2, 0], rows)


def test_threads_end_with_their_reads_and_results_are_taken_once() -> None:
    ahead, calls, let = ReadAhead[int](), [], threading.Event()
    for key in ("a", "a", "b"):
        ahead.begin(key, lambda key=key: (let.wait(20), calls.append(key), len(key))[2])
    assert calls == []
    let.set()
    assert (ahead.take("b"), ahead.take("a")) == (1, 1)
    assert sorted(calls) == ["a", "b"]
    with pytest.raises(KeyError):
        ahead.take("a")
