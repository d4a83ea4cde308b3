"""Value lists and ranges of a GeoPackage's columns: its extension for schemas (OGC 12-128r19, F.9)."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from roadscan.store.asset_schema import AssetColumn, asset_schema
from roadscan.store.inventory_schema import asset_columns

_RANGE: Final = "INSERT INTO gpkg_data_column_constraints VALUES (?, 'range', NULL, ?, 1, ?, 1, NULL)"
_VALUE: Final = "INSERT INTO gpkg_data_column_constraints VALUES (?, 'enum', ?, NULL, NULL, NULL, NULL, NULL)"
_USE: Final = "UPDATE gpkg_data_columns SET constraint_name = ? WHERE table_name = ? AND column_name = ?"


def add_value_lists(file: Path, kinds: Sequence[str]) -> None:
    """Add those of some kinds to a file that OGR has just written and that nobody else uses yet.

    The extension's tables contain no features, so no trigger of a spatial index is called.
    """
    known: set[tuple[str, tuple[str, ...], float | None, float | None]] = set()
    with contextlib.closing(sqlite3.connect(file)) as connection, connection:
        for kind in kinds:
            for column in asset_columns(kind):
                name = constraint_name(kind, column)
                if name is None:
                    continue
                content = (name, column.values, column.min, column.max)
                if content not in known:
                    known.add(content)
                    _add(connection, name, column)
                connection.execute(_USE, (name, asset_schema(kind).table, column.name))


def constraint_name(kind: str, column: AssetColumn) -> str | None:
    """Returns the name of a column's value list or range, which all kinds share; None where it has none."""
    prefix = f"{kind}_" if column in asset_schema(kind).own else ""
    if column.values or (column.min is not None and column.max is not None):
        return f"{prefix}{column.name}"
    return None


def _add(connection: sqlite3.Connection, name: str, column: AssetColumn) -> None:
    if column.values:
        connection.executemany(_VALUE, [(name, value) for value in column.values])
    else:
        connection.execute(_RANGE, (name, column.min, column.max))
