"""The runs of a survey: a small sealed file a run, written once; nothing else rests on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import pyarrow as pa

from roadscan.core.errors import DamagedError, StoreError
from roadscan.store.digest import bears_seal, sealed_parquet
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

TABLE: Final = "run_history"
_CHANGE: Final = "remove the file: no other output rests on it, and that run is then missing from the history"


def write_history(store: Store, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write the rows of one run under a name that no other run has."""
    schema = table_schema(TABLE)
    table = pa.Table.from_pylist(list(rows), schema.arrow()).sort_by([(c, "ascending") for c in schema.sort])
    content = sealed_parquet(table, row_group_size=schema.row_group_rows, compression="zstd")
    store.write_bytes(f"{schema.location}/{name}.parquet", content)


def last_run(store: Store) -> dict[str, Any] | None:
    """Return the first row of the run that began last, None where the history is empty.

    Raises
    ------
    DamagedError
        Its file is damaged.
    """
    paths = store.files(str(table_schema(TABLE).location), ".parquet")
    if not paths:
        return None
    rows: list[dict[str, Any]] = _read(store, paths[-1]).to_pylist()
    return rows[0]


def history_faults(store: Store, paths: Iterable[str] | None = None) -> dict[str, str]:
    """Return the faults of files of the history (of all, where none are named) by their paths."""
    folder = str(table_schema(TABLE).location)
    found: dict[str, str] = {}
    for path in store.files(folder, ".parquet") if paths is None else paths:
        if not path.startswith(f"{folder}/"):
            continue
        try:
            _read(store, path)
        except StoreError as error:
            found[path] = str(error)
    return found


def _read(store: Store, path: str) -> pa.Table:
    content = store.read_bytes(path)
    if not bears_seal(content):
        raise DamagedError("the file bears no seal", change=_CHANGE, file=store.path(path))
    return store.parse_table(content, path, change=_CHANGE)
