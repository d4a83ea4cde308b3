"""Schemas of the inventory: each kind's table as people see it, and the rows of evidence behind it."""

from __future__ import annotations

import functools
from typing import Final

import pyarrow as pa

from roadscan.store.asset_schema import AssetColumn, asset_kind_names, asset_schema, inventory_columns
from roadscan.store.schema import table_schema

GEOMETRY: Final = "geometry"

EDITED_BY_PEOPLE: Final = frozenset(
    {"status", "condition", "comments", "parent", "valid_from", "valid_to", "road", "station_m", "offset_m", "lane"}
)
"""Columns of all kinds that people may change, beside the kind's specific columns and the geometry."""


@functools.cache
def kinds_by_table() -> dict[str, str]:
    """Return the kind of each table by name."""
    return {asset_schema(kind).table: kind for kind in asset_kind_names()}


@functools.cache
def asset_columns(kind: str) -> tuple[AssetColumn, ...]:
    """Return the columns of a kind's table without the geometry: the inventory's, the kind's, the common ones."""
    schema = asset_schema(kind)
    return (*inventory_columns(), *schema.own, *schema.common)


@functools.cache
def editable_columns(kind: str) -> frozenset[str]:
    """Return the columns of a kind that people may change, without the geometry and those about its evidence."""
    return EDITED_BY_PEOPLE | {c.name for c in asset_schema(kind).own if not c.is_evidence}


@functools.cache
def asset_table(kind: str) -> pa.Schema:
    """Return the Arrow schema of a kind's inventory table; all columns may be null, the geometry (WKB) is last."""
    fields = [c.field().with_nullable(True) for c in asset_columns(kind)]
    return pa.schema([*fields, pa.field(GEOMETRY, pa.binary())])


@functools.cache
def evidence_table() -> pa.Schema:
    """Return the Arrow schema of the table `assets_found`: its specific columns and those of all kinds."""
    fields = {field.name: field for field in table_schema("assets_found").arrow()}
    for kind in asset_kind_names():
        for field in asset_table(kind):
            fields.setdefault(field.name, field.remove_metadata())
    return pa.schema([fields.pop("commit"), *fields.values()])
