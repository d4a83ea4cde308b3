"""Reads row groups of a data file as an Arrow table."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import StoreError
from roadscan.store.store import Store


def read_groups(store: Store, file: str, groups: Sequence[int], columns: list[str] | None = None) -> pa.Table:
    """Return row groups of a data file."""
    try:
        with store.fs.open(store.path(file), "rb") as stream:
            opened = pq.ParquetFile(stream, page_checksum_verification=True)
            return opened.read_row_groups(list(groups), columns=columns, use_threads=False)
    except (OSError, pa.ArrowInvalid) as error:
        raise StoreError(
            f"ingested rows cannot be read ({error})",
            change="`roadscan verify` names damaged files; remove the log's record to ingest it again",
            file=file,
            record=f"row groups {groups[0]}–{groups[-1]}",
        ) from error
