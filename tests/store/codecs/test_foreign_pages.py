"""Pages of Parquet files: damaged headers are found before rows of different columns stand side by side."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from roadscan.store.codecs.parquet.foreign_pages import ParquetPages

ROWS = 20_000
NUMBERS = np.arange(ROWS, dtype=np.int64)


def write(path: Path, **how: object) -> bytes:
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.repeat(NUMBERS, 3).astype(np.uint16)), 3)
    columns = {"a": NUMBERS, "b": NUMBERS, "c": lists, "d": pa.array([None, 1.5] * (ROWS // 2))}
    made = {"use_dictionary": False, "data_page_size": 8000, "write_batch_size": 1000, "row_group_size": 9000} | how
    pq.write_table(pa.table(columns), path, **made)
    return path.read_bytes()


def faults(path: Path, columns: list[str]) -> list[str]:
    with pq.ParquetFile(path) as file:
        return [ParquetPages(path).fault(i, columns) for i in range(file.num_row_groups)]


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize(
    "how",
    [{}, {"use_dictionary": True}, {"compression": "zstd"}, {"write_statistics": True}, {"write_page_checksum": True},
     {"column_encoding": {"a": "DELTA_BINARY_PACKED"}}],
)  # fmt: skip
def test_sound_files(tmp_path: Path, version: str, how: dict[str, object]) -> None:
    write(tmp_path / "a", data_page_version=version, **how)
    assert faults(tmp_path / "a", ["a", "b", "c", "d"]) == ["", "", ""]


def test_a_page_of_unknown_type(tmp_path: Path) -> None:
    """Arrow passes over it; the rest of the column then moves up."""
    data = bytearray(write(tmp_path / "a", compression="none"))
    assert data[4:6] == b"\x15\x00"  # the first page's header: field 1, data page
    data[5] = 0x7E
    (tmp_path / "a").write_bytes(data)
    with pq.ParquetFile(tmp_path / "a") as file:
        batch = next(file.iter_batches(500, columns=["a", "b"]))
    assert not batch.column(0).equals(batch.column(1))  # what has to be noticed
    assert faults(tmp_path / "a", ["a", "b"]) == ["column 'a': a page's header is damaged", "", ""]
    assert faults(tmp_path / "a", ["b"]) == ["", "", ""]


def test_damaged_headers_never_shift_rows(tmp_path: Path) -> None:
    data = write(tmp_path / "a", compression="none", write_statistics=False)
    heads = [at for at in range(len(data) - 4) if data[at : at + 2] == b"\x15\x00" and data[at + 2] == 0x15]
    rng = random.Random(3)
    found = 0
    for _ in range(300):
        broken = bytearray(data)
        broken[rng.choice(heads) + rng.randrange(12)] = rng.randrange(256)
        (tmp_path / "a").write_bytes(broken)
        try:
            file = pq.ParquetFile(tmp_path / "a")
        except (pa.ArrowException, OSError):
            continue
        pages = ParquetPages(tmp_path / "a")
        with file:
            for i in range(file.num_row_groups):
                if pages.fault(i, ["a", "b"]):
                    found += 1
                    continue
                try:
                    batches = list(file.iter_batches(500, row_groups=[i], columns=["a", "b"]))
                except (pa.ArrowException, OSError):
                    continue
                a, b = (np.concatenate([x.column(k).to_numpy() for x in batches]) for k in (0, 1))
                assert np.count_nonzero(a != b) <= 1100  # values of the page itself, or a first byte of its data
    assert found > 50


def test_damaged_statistics_in_the_footer(tmp_path: Path) -> None:
    """pyarrow's own metadata of a column chunk would end the process here."""
    data = write(tmp_path / "a", compression="none")
    rng = random.Random(4)
    end = len(data) - 8
    start = end - int.from_bytes(data[end : end + 4], "little")
    found = 0
    for _ in range(500):
        broken = bytearray(data)
        broken[rng.randrange(start, end)] = rng.randrange(256)
        (tmp_path / "a").write_bytes(broken)
        found += ParquetPages(tmp_path / "a").fault(0, ["a", "b", "c", "d"]) != ""
    assert 50 < found < 500
