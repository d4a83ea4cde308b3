"""Values of a GeoPackage that are not of their column's type: SQLite stores any value, and OGR reads these as 0."""

from __future__ import annotations

import contextlib
import datetime as dt
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa

from roadscan.core.witness import Witness

STORED_VALUES: Final = Witness(
    name="stored_values",
    input="inventory edits",
    fault="A cell of a GeoPackage holds what its column cannot: a text in a number, 3.7 in a whole number, a day that "
    "there is not.",
    asks="the type under which SQLite stores each cell",
    does="the row is named with what arrived, and not taken in",
    told=("error",),
)
_WANTED: Final = {
    "double": "a number", "int32": "a whole number", "int64": "a whole number", "string": "a text",
    "bool": "true or false (1 or 0)", "date32[day]": "a date such as 2026-05-04",
}  # fmt: skip
_STORED: Final = {"double": ("real", "integer"), "string": ("text",)}
"""Storage classes of SQLite that a column of each type may have, beside null."""


class OddValue(NamedTuple):
    """A cell whose value is not of its column's type."""

    fid: int
    asset_id: str | None
    column: str
    reason: str


def odd_values(file: Path, layer: str, schema: pa.Schema) -> list[OddValue]:
    """Returns the cells of a layer whose values are not of their column's type, by row; of the columns in `schema`."""
    with contextlib.closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as connection:
        connection.text_factory = lambda content: content.decode("utf-8", "replace")
        there = {name for _, name, *_ in connection.execute(f'PRAGMA table_info("{layer}")')}
        found = [odd for field in schema if field.name in there for odd in _of_column(connection, layer, field, there)]
    return sorted(found)


def _of_column(connection: sqlite3.Connection, layer: str, field: pa.Field, there: set[str]) -> Iterator[OddValue]:
    kind = str(field.type)
    if kind not in _WANTED:
        return
    stored = ", ".join(f"'{one}'" for one in ("null", *_STORED.get(kind, ())))
    name = '"asset_id"' if "asset_id" in there else "NULL"
    query = f"""SELECT rowid, {name}, typeof("{field.name}"), "{field.name}" FROM "{layer}"
                WHERE typeof("{field.name}") NOT IN ({stored})"""
    for fid, asset_id, held, value in connection.execute(query):
        if not _is_value(kind, held, value):
            asset = asset_id if isinstance(asset_id, str) and asset_id else None
            yield OddValue(fid, asset, field.name, f"{field.name} is {_shown(held, value)}, expected {_WANTED[kind]}")


def _is_value(kind: str, held: str, value: Any) -> bool:
    """Returns True if a stored value is valid in a column that permits several storage classes."""
    if kind == "bool":
        return held in ("integer", "real") and value in (0, 1)
    if kind in ("int32", "int64"):
        most = 2 ** (int(kind.removeprefix("int")) - 1)
        return held in ("integer", "real") and float(value).is_integer() and -most <= value < most
    return kind == "date32[day]" and held == "text" and _is_day(value)


def _is_day(text: str) -> bool:
    """Returns True for a day, and for a day at midnight, as some programs write it."""
    try:
        moment = dt.datetime.fromisoformat(text)
    except ValueError:
        return False
    return moment.time() == dt.time(0)


def _shown(held: str, value: Any) -> str:
    if held == "text":
        return f"the text '{value[:40]}'" if value else "an empty text"
    return f"{len(value)} bytes" if held == "blob" else f"{value:.15g}" if held == "real" else str(value)
