"""Of a damaged file whose log is gone, row groups that are sound stay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from roadscan.core.gpstime import NS_PER_S
from roadscan.store.salvage import Lost, read_lost, salvaged, write_lost
from roadscan.store.store import Store
from tests.store.test_store import START, returns, write


@pytest.mark.parametrize("group", [0, 1, 2])
def test_sound_row_groups_stay(tmp_path: Path, group: int) -> None:
    store = Store(str(tmp_path / "store"), "s1")
    epochs = START * NS_PER_S + np.arange(150_000, dtype=np.int64) * 60_000
    (file,) = write(store, [returns(epochs)])["returns"]
    assert len(file.group_rows) == 3
    path = Path(store.path(file.path))
    whole = pq.ParquetFile(path)
    column = whole.metadata.row_group(group).column(2)
    first = column.data_page_offset if column.dictionary_page_offset is None else column.dictionary_page_offset
    content = bytearray(path.read_bytes())
    content[first + column.total_compressed_size - 5] ^= 1
    path.write_bytes(content)
    kept, lost, spans = salvaged(store, "returns", file, tmp_path / "kept.parquet")
    assert kept is not None and (lost, spans) == (file.group_rows[group], (file.group_spans[group],))
    found = pq.read_table(tmp_path / "kept.parquet").column("epoch_gps_ns").to_numpy()
    low, high = spans[0]
    assert np.array_equal(found, epochs[(epochs < low) | (epochs > high)])
    assert kept.rows == found.size and kept.path == file.path


def test_nothing_stays_of_a_file_without_a_footer(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "store"), "s1")
    (file,) = write(store, [returns(START * NS_PER_S + np.arange(50, dtype=np.int64))])["returns"]
    Path(store.path(file.path)).write_bytes(b"PAR1 and no more")
    assert salvaged(store, "returns", file, tmp_path / "kept.parquet") == (None, 50, file.group_spans)


def test_the_list_of_losses_comes_back(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "store"), "s1")
    (file,) = write(store, [returns(START * NS_PER_S + np.arange(50, dtype=np.int64) * NS_PER_S // 10)])["returns"]
    lost = [Lost("abc", "returns", file, 50, file.group_spans, "damaged/x")]
    write_lost(store, lost)
    assert read_lost(store) == lost
    assert "50 of 50 rows are lost, 2024-05-17T16:53:02" in str(lost[0])
    write_lost(store, [])
    assert read_lost(store) == []
