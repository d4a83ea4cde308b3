"""Writes tables as comma-separated values, or as JSON, for scripts."""

from __future__ import annotations

import base64
import datetime as dt
import decimal
import json
import math
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.csv

_STYLE = pyarrow.csv.WriteOptions(quoting_style="needed")


def write_csv(table: pa.Table, out: BinaryIO) -> None:
    """Write a table as CSV (UTF-8, a header, commas, points in numbers).

    Instants are ISO 8601, those with a zone in UTC with a ``Z``; lists and structures are JSON; bytes are Base64; a
    missing value is empty.
    """
    columns = [_plain(column) for column in table.columns]
    pyarrow.csv.write_csv(pa.Table.from_arrays(columns, names=table.column_names), out, _STYLE)


def write_json(table: pa.Table, out: BinaryIO) -> None:
    """Write a table as a JSON list of objects; values as in CSV, numbers that are none (NaN, infinity) as null."""
    rows = [{name: _finite(value) for name, value in row.items()} for row in table.to_pylist()]
    out.write((json.dumps(rows, indent=1, ensure_ascii=False, default=_unusual, allow_nan=False) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(name): _finite(one) for name, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list) else value


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    kind = column.type
    if pa.types.is_timestamp(kind):
        return _texts(column, _instant)
    if pa.types.is_nested(kind) or pa.types.is_interval(kind) or pa.types.is_duration(kind):
        return _texts(column, lambda value: json.dumps(value, default=_unusual, ensure_ascii=False))
    if pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
        return _texts(column, _unusual)
    if pa.types.is_decimal(kind) or pa.types.is_null(kind):
        return column.cast(pa.string())
    return column


def _texts(column: pa.ChunkedArray, text: Any) -> pa.ChunkedArray:
    return pa.chunked_array([pa.array([None if v is None else text(v) for v in column.to_pylist()], pa.string())])


def _instant(value: dt.datetime) -> str:
    return value.isoformat().replace("+00:00", "Z")


def _unusual(value: Any) -> str | int | float:
    if isinstance(value, decimal.Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    return _instant(value) if isinstance(value, dt.datetime) else str(value)
