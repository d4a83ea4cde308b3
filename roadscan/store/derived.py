"""Computes columns from incoming rows, so that no log has to contain them.

They stand beside the raw readings for their statistics: a reader learns what a row group holds without decoding it.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from roadscan.compute.kernels.profile_bounds import range_bounds
from roadscan.store.schema import TableSchema


def with_derived(schema: TableSchema, rows: pa.RecordBatch) -> pa.RecordBatch:
    """Return the rows of a table with computed derived columns, whatever these contained."""
    if schema.name != "scans":
        return rows
    lists = rows.column("range")
    ranges = lists.flatten().to_numpy().reshape(rows.num_rows, lists.type.list_size)
    low, high = np.empty(rows.num_rows, np.uint16), np.empty(rows.num_rows, np.uint16)
    range_bounds(ranges, low, high)
    for name, values in (("range_low", low), ("range_high", high)):
        at = rows.schema.get_field_index(name)
        rows = rows.set_column(at, rows.schema.field(at), pa.array(values))
    return rows
