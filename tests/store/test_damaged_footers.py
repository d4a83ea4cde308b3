"""A footer with any bit flipped: readers of the store read the table, or say that the file is damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.core.errors import DamagedError, StoreError, may_pass
from roadscan.footprints.reach import opened
from roadscan.store.codecs.parquet.tables import write_list_table
from roadscan.store.digest import sealed_parquet
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

FILE = "tables/rows/part-00000.parquet"


def _spans(store: Store) -> None:
    with opened(store, SimpleNamespace(file=FILE)) as file:  # type: ignore[arg-type]
        assert file.schema_arrow.names
        assert file.metadata.row_group(0).column(0).statistics is not None


READERS: dict[str, Callable[[Store], Any]] = {
    "whole": lambda store: store.read_table(FILE),
    "row groups": lambda store: read_groups(store, FILE, [0]),
    "statistics": _spans,
}


def written(folder: Path, how: str) -> tuple[Store, Path, bytes, int]:
    """A store with one file, its path and content, and where its footer begins."""
    epochs = pa.array(np.arange(50))
    store = Store(str(folder / "store"), "street")
    path = Path(store.path(FILE))
    path.parent.mkdir(parents=True)
    if how == "plain":
        pq.write_table(pa.table({"epoch_gps_ns": epochs, "name": ["a", "b"] * 25}), path, write_page_checksum=True)
    elif how == "sealed":
        path.write_bytes(sealed_parquet(pa.table({"epoch_gps_ns": epochs, "name": ["a", "b"] * 25})))
    else:
        kind = pa.list_(pa.field("item", pa.uint16(), nullable=False), 3)
        ranges = pa.FixedSizeListArray.from_arrays(pa.array(np.arange(150), pa.uint16()), type=kind)
        rows = pa.Table.from_arrays([epochs, ranges], schema=pa.schema([("epoch_gps_ns", pa.int64()), ("range", kind)]))
        write_list_table(path, rows, 10)
    content = path.read_bytes()
    return store, path, content, len(content) - 8 - int.from_bytes(content[-8:-4], "little")


@pytest.mark.parametrize("reader", READERS)
def test_a_name_that_is_no_utf_8_is_damage(tmp_path: Path, reader: str) -> None:
    store, path, content, footer = written(tmp_path, "plain")
    at = content.index(b"epoch_gps_ns", footer)
    path.write_bytes(content[:at] + bytes([content[at] | 0x80]) + content[at + 1 :])
    with pytest.raises(DamagedError, match=r"part-00000\.parquet"):
        READERS[reader](store)


@pytest.mark.parametrize(
    ("how", "reader"), [("sealed", "whole"), ("readings", "row groups"), ("readings", "statistics")]
)
def test_any_flipped_bit_of_a_checked_footer_is_damage(tmp_path: Path, how: str, reader: str) -> None:
    """Arrow itself ends the process of some of them with SIGSEGV."""
    store, path, content, footer = written(tmp_path, how)
    for at in range(footer, len(content)):
        changed = bytearray(content)
        changed[at] ^= 1 << (at % 8)
        path.write_bytes(changed)
        with pytest.raises(DamagedError, match=r"part-00000\.parquet"):
            READERS[reader](store)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("error", [ConnectionResetError("reset by peer"), TimeoutError("timed out")])
def test_a_place_that_does_not_answer_is_no_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str, error: OSError
) -> None:
    store, *_ = written(tmp_path, "plain")

    def silent(*_: Any, **__: Any) -> Any:
        raise error

    for name in ("cat_file", "open"):
        monkeypatch.setattr(store.fs, name, silent)
    monkeypatch.setattr("roadscan.store.readings.row_groups.opened", silent)
    with pytest.raises((StoreError, OSError)) as told:
        READERS[reader](store)
    assert not isinstance(told.value, DamagedError) and may_pass(told.value) == "a place does not answer"
