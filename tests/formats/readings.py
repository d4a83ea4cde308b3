"""Reads logs of readings through the public door, for the tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from roadscan.core.witness import Finding
from roadscan.ingest.reading.format import LogSource, Reject, Rows, format_named
from roadscan.store.schema import table_schema

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
    findings: list[Finding] = field(default_factory=list)

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
    findings: list[Finding] = []
    batches: list[pa.RecordBatch] = []
    for item in log_format.read(source, header):
        if isinstance(item, Finding):
            findings.append(item)
            continue
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
    return Readings(
        header.attributes, pa.Table.from_batches(batches, schema.arrow(header.list_size)), rows, rejects, findings
    )


def read_ellipsoidal(name: str, path: Path, options: dict[str, Any] | None = None, **stated: Any) -> Readings:
    """As `read`, of a log whose heights are stated as ellipsoidal where nothing else is stated."""
    return read(name, path, options, **({"height": "ellipsoidal"} | stated))
