"""Reads row groups of a data file as an Arrow table.

What roadscan's pages hold of profiles and returns is decoded by kernels, all else by Arrow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

from roadscan.store.codecs.choice import LIBRARY
from roadscan.store.damage import ROWS_CHANGE, damage_named
from roadscan.store.readings.group_reader import Footer, opened_footer
from roadscan.store.readings.packed_returns import as_returns, is_packed, stored_columns
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

if TYPE_CHECKING:
    import numpy as np

_OF_ARROW: Final = b"ARROW:schema"  # Entry of a footer that Arrow leaves out of the schema that it reads.

Columns: TypeAlias = dict[str, pa.Array | pa.ChunkedArray]


def read_groups(store: Store, file: str, groups: Sequence[int], columns: list[str] | None = None) -> pa.Table:
    """Return row groups of a data file; those of packed returns as rows of ``returns``."""
    what, record = "ingested rows cannot be read", f"row groups {groups[0]}–{groups[-1]}"
    with damage_named(what, file, ROWS_CHANGE, record):
        footer = source, metadata, ours = opened_footer(store, file)
        schema = _schema(metadata, columns)
        found = _decoded(store, file, footer, groups, schema) if ours and not LIBRARY else {}
        rest = [name for name in schema.names if name not in found]
        if rest:
            source.stream.seek(0)
            opened = pq.ParquetFile(source.stream, metadata=metadata, page_checksum_verification=True)
            own = stored_columns(rest if found else columns, opened.schema_arrow.names)
            rows = as_returns(opened.read_row_groups(list(groups), columns=own, use_threads=False), columns)
            if not found:
                return rows
            found |= {name: rows.column(name) for name in rest}
        return pa.Table.from_arrays([found[name] for name in schema.names], schema=schema)


def _schema(metadata: pq.FileMetaData, columns: list[str] | None) -> pa.Schema:
    """Return the schema of the wanted columns of a file."""
    held = metadata.schema.to_arrow_schema()
    about = {name: value for name, value in (metadata.metadata or {}).items() if name != _OF_ARROW}
    if is_packed(held.names):
        held, about = table_schema("returns").arrow(), {}
    return pa.schema([field for field in held if columns is None or field.name in columns], about or None)


def _decoded(store: Store, file: str, footer: Footer, groups: Sequence[int], schema: pa.Schema) -> Columns:
    """Return those of the wanted columns that kernels decode, of a file with roadscan's pages."""
    if "x_sensor_m" in schema.names:
        from roadscan.store.readings.returns import ReturnsReader

        more = {"laser", "sweep"}.intersection(schema.names)
        returns = vars(ReturnsReader(store, file, footer, more=more).read(groups))
        return {
            name: pa.array(values) for name, values in returns.items() if name in schema.names and values is not None
        }
    if {"range", "intensity"} <= set(schema.names):
        from roadscan.store.readings.profiles import ProfileReader

        profiles = ProfileReader(store, file, footer).read(groups)
        epochs = {"epoch_gps_ns": pa.array(profiles.epoch_gps_ns)} if "epoch_gps_ns" in schema.names else {}
        return epochs | _lists(schema, range=profiles.range, intensity=profiles.intensity)
    return {}


def _lists(schema: pa.Schema, **columns: np.ndarray | None) -> Columns:
    """Return lists of one size of (n, m) numbers; those that some rows do not have are left out."""
    return {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), type=schema.field(name).type)
        for name, values in columns.items()
        if values is not None and pa.types.is_fixed_size_list(schema.field(name).type)
    }
