"""Reads logs of readings through the public door, and damages them, for the tests of this folder."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from roadscan.model.errors import RoadscanError
from roadscan.sensors.base import LogSource, Reject, Rows, format_named
from roadscan.tables.schema import table_schema

LARGEST_CHUNK_BYTES = 12 << 20
LARGEST_CHUNK_ROWS = 1 << 18
SLOWEST_S = 20.0


@dataclass(frozen=True)
class Readings:
    """All that a log yielded."""

    attributes: dict[str, Any]
    table: pa.Table
    rows: list[Rows]
    rejects: list[Reject]

    def __getitem__(self, column: str) -> np.ndarray:
        return self.table.column(column).to_numpy()

    def __len__(self) -> int:
        return self.table.num_rows

    @property
    def epochs(self) -> np.ndarray:
        return self["epoch_gps_ns"]

    @property
    def xyz_sensor_m(self) -> np.ndarray:
        """(n, 3) float64."""
        return np.stack([self[f"{a}_sensor_m"].astype(np.float64) for a in "xyz"], axis=-1)

    @property
    def rejected(self) -> int:
        return sum(r.records for r in self.rejects)

    @property
    def reasons(self) -> set[str]:
        return {r.reason for r in self.rejects}


def read(name: str, path: Path, options: dict[str, Any] | None = None, **stated: Any) -> Readings:
    """Read a log as ingest does; every row has to fit its table, every chunk has to be small."""
    log_format = format_named(name)
    source = LogSource(path, log_format.options.parse(options or {}), **stated)
    header = log_format.header(source)
    schema = table_schema(log_format.yields[0])
    rows: list[Rows] = []
    rejects: list[Reject] = []
    batches: list[pa.RecordBatch] = []
    for item in log_format.read(source, header):
        if isinstance(item, Reject):
            assert item.records > 0
            rejects.append(item)
            continue
        assert item.table == schema.name
        assert 0 < item.batch.num_rows <= LARGEST_CHUNK_ROWS
        assert item.batch.nbytes <= LARGEST_CHUNK_BYTES
        batch = schema.conform(item.batch, header.list_size)
        assert schema.faults(batch) == []
        rows.append(item)
        batches.append(batch)
    return Readings(header.attributes, pa.Table.from_batches(batches, schema.arrow(header.list_size)), rows, rejects)


def mutations(data: bytes, count: int, seed: int) -> Iterator[bytes]:
    """Copies of `data` with wrong bytes, counts that claim too much, and bytes lost or added."""
    draw = random.Random(seed)
    for _ in range(count):
        bytes_ = bytearray(data)
        kind = draw.randrange(4)
        for _ in range(draw.choice((1, 1, 2, 8, 40))):
            end = len(bytes_) - 1
            near = min(end, int(draw.expovariate(1 / 200)))
            at = draw.choice((draw.randrange(end + 1), near, end - near))
            if kind == 0:
                bytes_[at] = draw.randrange(256)
            elif kind == 1:
                bytes_[at : at + 4] = draw.choice((b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", bytes(4), b"\0\0\0\x80"))
            elif kind == 2:
                bytes_[at] ^= 1 << draw.randrange(8)
            elif draw.random() < 0.5:
                del bytes_[at : at + draw.randrange(1, 400)]
            else:
                bytes_[at:at] = draw.randbytes(draw.randrange(1, 300))
            bytes_ = bytes_ or bytearray(b"x")
        yield bytes(bytes_)


def survive(
    name: str,
    path: Path,
    damaged: Path,
    *,
    count: int = 200,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    make: Callable[[], dict[str, Any]] = dict,
) -> tuple[int, int]:
    """Read the log `path` with its file `damaged` broken in `count` ways.

    Nothing but :class:`RoadscanError` may be raised, and no try may take long.

    Returns
    -------
    How many tries were read (some with rejects), and how many were refused.
    """
    sound = damaged.read_bytes()
    read_, refused = 0, 0
    for broken in mutations(sound, count, seed):
        damaged.write_bytes(broken)
        start = time.monotonic()
        assert format_named(name).sniff(path) in {True, False}
        try:
            read(name, path, options, **make())
            read_ += 1
        except RoadscanError as error:
            assert str(error)
            refused += 1
        assert time.monotonic() - start < SLOWEST_S
    damaged.write_bytes(sound)
    return read_, refused
