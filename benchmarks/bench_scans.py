"""Profiles of a line scanner: written and read as the store does, beside Arrow, one thread each.

Nanoseconds are those of a reading: a range of 16 bits and an intensity of 8.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import duckdb
import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from fsspec.implementations.local import LocalFileSystem

from benchmarks.timing import Figure, best_seconds
from roadscan.store.readings.row_groups import ProfileReader
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import write_parquet

PROFILES, READINGS = 4096, 2000
SCHEMA = table_schema("scans")
OURS, THEIRS = "ours.parquet", "theirs.parquet"
COLUMNS: Final = ["epoch_gps_ns", "range", "intensity"]
ARROW: Final[dict[str, Any]] = {
    "row_group_size": SCHEMA.row_group_rows,
    "compression": "zstd",
    "compression_level": 1,
    "use_dictionary": False,
    "column_encoding": dict.fromkeys(["epoch_gps_ns", "range.list.element"], "DELTA_BINARY_PACKED"),
    "write_statistics": ["epoch_gps_ns"],
}
"""What measured best with Arrow's writer."""


def figures(folder: Path) -> Iterator[Figure]:
    """A road's surface, then one with readings lost in stripes and here and there."""
    store = Store(str(folder), "bench")
    Path(store.root).mkdir(parents=True)
    for name, rows in {"a road's surface": profiles(0.001), "a third without return": profiles(0.1, 600)}.items():
        yield from _figures(store, name, rows)
    yield from _ahead(folder)


def profiles(lost: float, stripe: int = 0) -> pa.Table:
    """Profiles of a crowned road with texture and markings; a stripe, and some others at random, have no return."""
    rng = np.random.default_rng(0)
    crown = 20_000 + 4e-4 * (np.arange(READINGS) - READINGS / 2) ** 2
    along = 60 * np.sin(np.arange(PROFILES) / 300)
    texture = rng.normal(0, 16, (PROFILES, READINGS))
    ranges = np.rint(crown + along[:, None] + texture).astype(np.uint16)
    bright = np.rint(90 + 70 * (np.arange(READINGS) // 100 % 7 == 0) + rng.normal(0, 2, ranges.shape)).astype(np.uint8)
    gone = rng.random(ranges.shape) < lost
    gone[:, 100 : 100 + stripe] = True
    ranges[gone], bright[gone] = 0, 0
    columns = {
        "epoch_gps_ns": 1_462_000_000_000_000_000 + np.arange(PROFILES) * 35_714,
        "range": pa.FixedSizeListArray.from_arrays(pa.array(ranges.ravel()), READINGS),
        "intensity": pa.FixedSizeListArray.from_arrays(pa.array(bright.ravel()), READINGS),
    }
    return pa.Table.from_batches([SCHEMA.conform(pa.RecordBatch.from_pydict(columns), READINGS)])


def _figures(store: Store, name: str, rows: pa.Table) -> Iterator[Figure]:
    ours, theirs = Path(store.path(OURS)), Path(store.path(THEIRS))
    written = best_seconds(lambda: write_parquet(ours, rows, SCHEMA))
    yield _figure(f"write {name}", written, best_seconds(lambda: pq.write_table(rows, theirs, **ARROW)), "Arrow")
    readings = rows.num_rows * READINGS
    size, other = ours.stat().st_size / readings, theirs.stat().st_size / readings
    yield Figure(f"bytes a reading of {name}", size, "B", other, "Arrow, zstd")
    read = best_seconds(lambda: _read(store))
    yield _figure(f"read {name}", read, best_seconds(lambda: _arrow(theirs)), "Arrow, its own file")
    yield _figure(f"read {name}, by Arrow", best_seconds(lambda: _arrow(ours)), best_seconds(lambda: _arrow(theirs)),
                  "Arrow, its own file")  # fmt: skip
    yield _figure(f"read {name}, by DuckDB", best_seconds(lambda: _duckdb(ours)), best_seconds(lambda: _duckdb(theirs)),
                  "DuckDB, Arrow's file")  # fmt: skip


def _figure(what: str, seconds: float, other: float, against: str) -> Figure:
    scale = 1e9 / (PROFILES * READINGS)
    return Figure(what, seconds * scale, "ns", other * scale, against)


def _read(store: Store) -> None:
    reader = ProfileReader(store, OURS)
    for group in range(-(-PROFILES // SCHEMA.row_group_rows)):
        reader.read([group])


def _arrow(path: Path) -> None:
    with pq.ParquetFile(path) as file:
        for group in range(file.num_row_groups):
            file.read_row_group(group, columns=COLUMNS, use_threads=False)


def _duckdb(path: Path) -> None:
    with duckdb.connect(config={"threads": 1}) as connection:
        statement = f"SELECT sum(list_sum(range)), sum(list_sum(intensity)) FROM read_parquet('{path}')"
        connection.execute(statement).fetchall()


# --- reading ahead ----------------------------------------------------------------------------------

ANSWER_S, BYTES_PER_S = 0.03, 150e6
COMPUTING_S = 0.018
"""Of a piece of two row groups at line rate."""
PIECES_AHEAD = 4


class DistantFile:
    """A file whose every read is a request."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.seek, self.close = stream.seek, stream.close

    def __enter__(self) -> DistantFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def readinto(self, room: memoryview) -> int:
        """Fill `room`, late."""
        count: int = self._stream.readinto(room)
        time.sleep(ANSWER_S + count / BYTES_PER_S)
        return count

    def read(self, size: int = -1) -> bytes:
        """Bytes, late."""
        content: bytes = self._stream.read(size)
        time.sleep(ANSWER_S + len(content) / BYTES_PER_S)
        return content


class DistantStore(LocalFileSystem):
    """A folder as far away as an object store."""

    protocol = "distant"

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(LocalFileSystem._strip_protocol(str(path).removeprefix("distant://")))

    def open(self, path: str, mode: str = "rb", **kwargs: Any) -> Any:
        """A file of it."""
        return DistantFile(super().open(path, mode, **kwargs))

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **kwargs: Any) -> bytes:
        """A part of a file: one request."""
        with self.open(path) as file:
            file.seek(start or 0)
            return file.read(-1 if end is None else end - (start or 0))


def _ahead(folder: Path) -> Iterator[Figure]:
    fsspec.register_implementation("distant", DistantStore, clobber=True)
    store = Store(f"distant://{folder}", "bench")
    pieces = PROFILES // SCHEMA.row_group_rows // 2
    with_it, without = (best_seconds(lambda ahead=ahead: _compute(store, pieces, ahead)) for ahead in (PIECES_AHEAD, 0))
    what = f"{pieces} times 2 row groups, answered after 30 ms, and {COMPUTING_S * 1e3:g} ms of computing"
    yield Figure(what, with_it, "s", without, "without reading ahead")


def _compute(store: Store, pieces: int, ahead: int) -> None:
    reader = ProfileReader(store, OURS)
    for k in range(-ahead, pieces):
        if ahead and k + ahead < pieces:
            reader.expect([2 * (k + ahead), 2 * (k + ahead) + 1])
        if k >= 0:
            reader.read([2 * k, 2 * k + 1])
            time.sleep(COMPUTING_S)
