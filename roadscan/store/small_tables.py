"""Reads and writes small tables as whole files: the estimated clocks, mountings and trajectories; bytes of others.

No record of the manifest names them, and no run makes all of them. So each one itself says how to repair it. A list of
their digests (``manifest/held.json``) reveals damage that the checksums of pages do not cover whenever one is read;
it lists no table that someone put there and roadscan did not write.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.core.errors import DamagedError, StoreError
from roadscan.store.digest import bytes_digest, checked_json, parse_checked
from roadscan.store.schema import TableSchema, table_schema
from roadscan.store.store import Store

_DIGESTS: Final = "manifest/held.json"

REPAIR_HINT: Final = {
    "clocks": "`roadscan clocks` (or `roadscan run`) estimates the clocks anew",
    "clock_residuals": "`roadscan clocks` (or `roadscan run`) estimates the clocks anew",
    "mountings": "`roadscan calibrate` makes it anew of the survey file's evidence; if it is removed, the rig file's "
    "mountings hold",
    "mounting_corrections": "put it back, or adjust again; if it is removed, mountings hold as they were stated",
    "camera_corrections": "put it back, or adjust again; if it is removed, lenses and clocks hold as they were stated",
    "camera_covariances": "put it back, or adjust again; if it is removed, σ in pictures count as independent",
    "corrections": "put it back, or compute it again; if it is removed, trajectories hold as they were recorded",
}
"""How each table is repaired when it is damaged."""


def small_path(name: str) -> str:
    """Return the file of such a table, relative to the survey's root."""
    return f"tables/{name}/part-00000.parquet"


def read_small(store: Store, name: str) -> pa.Table | None:
    """Return the table, None where there is none.

    Raises
    ------
    DamagedError
        Says how to repair it.
    StoreError
        It cannot be read.
    """
    path = small_path(name)
    if not store.exists(path):
        return None
    change = REPAIR_HINT[name]
    content = store.read_bytes(path)
    known = _known(store).get(name)
    if known is not None and bytes_digest(content) not in (known.get("digest"), known.get("before")):
        raise DamagedError("the file is damaged: it is not as it was written", change=change, file=store.path(path))
    table = store.parse_table(content, path, change=change)
    missing = [c.name for c in table_schema(name).columns if not c.nullable and c.name not in table.column_names]
    if missing:
        raise DamagedError(
            f"the table `{name}` has no column `{missing[0]}`: another file stands in its place",
            change=change,
            file=store.path(path),
        )
    return table


def write_small(store: Store, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace the table; columns that a row does not name are null."""
    schema = table_schema(name)
    full = [{c.name: row.get(c.name) for c in schema.columns} for row in rows]
    table = pa.Table.from_pylist(full, schema.arrow()).sort_by([(c, "ascending") for c in schema.sort])
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, row_group_size=schema.row_group_rows, compression="zstd", write_page_checksum=True)
    content = sink.getvalue().to_pybytes()
    known = _known(store)
    of = known.get(name, {})
    held = bytes_digest(store.read_bytes(small_path(name))) if store.exists(small_path(name)) else None
    before = held if held in (of.get("digest"), of.get("before")) else None  # the last writing may have been cut short
    both = {"bytes": len(content), "digest": bytes_digest(content)}
    store.write_bytes(_DIGESTS, checked_json({**known, name: {**both, "before": before}}))
    store.write_bytes(small_path(name), content)


def small_records(store: Store) -> dict[str, tuple[int, str]]:
    """Return bytes and digest of the small tables that roadscan wrote, by their paths.

    One whose writing was cut short is the one before it.
    """
    found: dict[str, tuple[int, str]] = {}
    for name, of in _known(store).items():
        path = small_path(name)
        if store.exists(path) and bytes_digest(content := store.read_bytes(path)) == of.get("before"):
            found[path] = (len(content), str(of["before"]))
        else:
            found[path] = (int(of["bytes"]), str(of["digest"]))
    return found


def digests_fault(store: Store) -> str:
    """Return the fault of the list of digests; empty where it has none."""
    try:
        _listed(store)
    except StoreError as error:
        return str(error)
    except (ValueError, TypeError):
        tables = ", ".join(name for name in REPAIR_HINT if store.exists(small_path(name)))
        return (
            f"{_DIGESTS}: it is damaged, so that damage of {tables or 'small tables'} is not told by it; "
            "it lists each table again when that is written"
        )
    return ""


def _known(store: Store) -> dict[str, Any]:
    """Return the stored digests; none where their list has a fault, which :func:`digests_fault` tells."""
    try:
        return _listed(store)
    except (StoreError, ValueError, TypeError):
        return {}


def _listed(store: Store) -> dict[str, Any]:
    """Return the stored digests; raises what is wrong with their list."""
    if not store.exists(_DIGESTS):
        return {}
    parsed = parse_checked(store.read_bytes(_DIGESTS))
    return {name: of for name, of in parsed.items() if name in REPAIR_HINT and dict(of)}


def parquet_bytes(rows: pa.Table, schema: TableSchema) -> bytes:
    """Return the content of a small file of rows without lists of readings, as :func:`write_parquet` writes them."""
    stream = pa.BufferOutputStream()
    write_by_arrow(stream, rows, schema)
    content: bytes = stream.getvalue().to_pybytes()
    return content


def write_by_arrow(to: Path | pa.NativeFile, rows: pa.Table, schema: TableSchema) -> None:
    """Write rows with pyarrow, each column in the encoding that measured best for its kind."""
    encodings: dict[str, str] = {}
    strings: list[str] = []
    for column in schema.columns:
        leaf = f"{column.name}.list.element" if column.is_list else column.name
        kind = column.type[5:-1] if column.is_list else column.type
        if kind == "string":
            strings.append(leaf)
        elif column.encoding:
            encodings[leaf] = column.encoding
        elif kind.startswith("float"):
            encodings[leaf] = "BYTE_STREAM_SPLIT"
        elif kind != "uint8" and not column.variable:
            encodings[leaf] = "DELTA_BINARY_PACKED"
    pq.write_table(
        rows,
        to,
        row_group_size=schema.row_group_rows,
        compression=schema.compression,
        compression_level=1 if schema.compression == "zstd" else None,
        use_dictionary=strings,
        column_encoding=encodings,
        write_statistics=[c.name for c in schema.columns if not c.is_list],
        write_page_checksum=True,
    )
