"""Small tables that are held whole, a file each: what was estimated of clocks, mountings and trajectories.

No record of the manifest names them, and no run makes all of them. So each says by itself what mends it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.model.errors import DamagedError
from roadscan.tables.schema import table_schema
from roadscan.tables.store import Store

WAY_OUT: Final = {
    "clocks": "`roadscan clocks` (or `roadscan run`) estimates the clocks anew",
    "clock_residuals": "`roadscan clocks` (or `roadscan run`) estimates the clocks anew",
    "mountings": "`roadscan calibrate` makes it anew of the survey file's evidence; if it is removed, the rig file's "
    "mountings hold",
    "corrections": "put it back, or compute it again; if it is removed, trajectories hold as they were recorded",
}
"""What mends each of the tables where it is damaged."""


def held_path(name: str) -> str:
    """File of such a table, relative to the survey's root."""
    return f"tables/{name}/part-00000.parquet"


def read_held(store: Store, name: str) -> pa.Table | None:
    """The table, None where there is none.

    Raises
    ------
    DamagedError
        Says what mends it.
    StoreError
        It cannot be read.
    """
    path = held_path(name)
    if not store.exists(path):
        return None
    change = WAY_OUT[name]
    table = store.read_table(path, change=change)
    missing = [c.name for c in table_schema(name).columns if not c.nullable and c.name not in table.column_names]
    if missing:
        raise DamagedError(
            f"the table `{name}` has no column `{missing[0]}`: another file stands in its place",
            change=change,
            file=store.path(path),
        )
    return table


def write_held(store: Store, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace the table; columns that a row does not name are null."""
    schema = table_schema(name)
    full = [{c.name: row.get(c.name) for c in schema.columns} for row in rows]
    table = pa.Table.from_pylist(full, schema.arrow()).sort_by([(c, "ascending") for c in schema.sort])
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, row_group_size=schema.row_group_rows, compression="zstd", write_page_checksum=True)
    store.write_bytes(held_path(name), sink.getvalue().to_pybytes())
