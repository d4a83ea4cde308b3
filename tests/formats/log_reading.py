"""Reads a log through the public door, as ingest does, for the tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.witness import Finding
from roadscan.ingest.reading.format import LogSource, Reject, Rows, format_named
from roadscan.store.schema import table_schema

GPS_SECONDS = Clock(TimeSystem.GPS)


@dataclass(frozen=True)
class Log:
    """All that a log yielded."""

    attributes: dict[str, Any]
    table: pa.Table
    rows: list[Rows]
    rejects: list[Reject]
    findings: list[Finding] = field(default_factory=list)

    def column(self, name: str) -> np.ndarray:
        return self.table.column(name).to_numpy()

    @property
    def epochs(self) -> np.ndarray:
        return self.column("epoch_gps_ns")

    @property
    def positions(self) -> np.ndarray:
        """(n, 3) world positions."""
        return np.stack([self.column(f"{a}_world_m") for a in "xyz"], axis=-1)

    @property
    def attitudes(self) -> Rotation:
        """World from body."""
        return Rotation.from_quat(np.stack([self.column(f"q{a}") for a in "xyzw"], axis=-1))


def source_of(name: str, path: Path, options: dict[str, Any] | None = None, **stated: Any) -> LogSource:
    return LogSource(path, format_named(name).options.parse(options or {}), **stated)


def read_log(name: str, path: Path, options: dict[str, Any] | None = None, **stated: Any) -> Log:
    """Read a log; every row has to fit its table's schema."""
    log_format = format_named(name)
    source = source_of(name, path, options, **stated)
    header = log_format.header(source)
    rows, rejects, findings, batches = [], [], [], []
    schema = table_schema(log_format.yields[0])
    for item in log_format.read(source, header):
        if isinstance(item, Finding):
            findings.append(item)
            continue
        if isinstance(item, Reject):
            rejects.append(item)
            continue
        assert item.table == schema.name
        assert 0 < item.batch.num_rows <= 100_000
        batch = schema.conform(item.batch)
        assert schema.faults(batch) == []
        rows.append(item)
        batches.append(batch)
    return Log(header.attributes, pa.Table.from_batches(batches, schema.arrow()), rows, rejects, findings)


def read_ellipsoidal(name: str, path: Path, options: dict[str, Any] | None = None, **stated: Any) -> Log:
    """As `read_log`, of a log whose heights are stated as ellipsoidal where nothing else is stated."""
    return read_log(name, path, options, **({"height": "ellipsoidal"} | stated))
