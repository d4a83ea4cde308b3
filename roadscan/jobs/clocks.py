"""Clocks of sensors: estimate them, keep them in the tables ``clocks`` and ``clock_residuals``, load them."""

from __future__ import annotations

from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.navigation.clocks import ClockCorrection
from roadscan.tables.store import Store

CLOCKS: Final = "tables/clocks/part-00000.parquet"


def load_clocks(store: Store) -> dict[tuple[str, str], ClockCorrection]:
    """Corrections of ingested epochs by run ('*' for all) and sensor; none where nothing was estimated."""
    if not store.exists(CLOCKS):
        return {}
    rows = pq.read_table(pa.BufferReader(store.read_bytes(CLOCKS))).to_pylist()
    return {
        (row["run"], row["sensor"]): ClockCorrection(
            offset_s=row["offset_s"],
            drift=row["drift_ppm"] * 1e-6,
            reference_gps_ns=row["reference_gps_ns"],
            sigma_offset_s=row["sigma_offset_s"],
            sigma_drift=row["sigma_drift_ppm"] * 1e-6,
            correlation=row["correlation"],
            first_gps_ns=row["first_gps_ns"],
            last_gps_ns=row["last_gps_ns"],
        )
        for row in rows
        if row["applied"] == "epochs"
    }
