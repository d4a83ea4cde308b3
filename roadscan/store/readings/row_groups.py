"""Reads row groups of a data file as an Arrow table."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa

from roadscan.store.codecs.parquet.page_file import opened_parquet
from roadscan.store.damage import ROWS_CHANGE, damage_named
from roadscan.store.readings.packed_returns import as_returns, stored_columns
from roadscan.store.store import Store


def read_groups(store: Store, file: str, groups: Sequence[int], columns: list[str] | None = None) -> pa.Table:
    """Return row groups of a data file; those of packed returns as rows of ``returns``."""
    what, record = "ingested rows cannot be read", f"row groups {groups[0]}–{groups[-1]}"
    with damage_named(what, file, ROWS_CHANGE, record), store.opened(file) as stream:
        opened = opened_parquet(stream)
        own = stored_columns(columns, opened.schema_arrow.names)
        return as_returns(opened.read_row_groups(list(groups), columns=own, use_threads=False), columns)
